"""Measure how hard the simulated insertions are, whether a shortcut gives the label away, and what the time step does.

python training/check_simulation.py --data insertion --steps 200
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import click
import numpy as np
from numpy.typing import NDArray
from sklearn.base import ClassifierMixin
from sklearn.ensemble import RandomForestClassifier
from sklearn.model_selection import StratifiedKFold, cross_val_predict
from sklearn.neighbors import KNeighborsClassifier

from dengine.cells.simulation.conditions import RATE_HZ
from dengine.cells.simulation.generate import simulate
from dengine.cells.simulation.world import TIME_STEP_S
from dengine.datasets import Dataset, load_dataset

FOLDS = 5
BEFORE_CONTACT = 80  # samples; even the longest wrong part starts further from the rim than 0.16 s
CONTACT_N = 3.0


@dataclass(frozen=True, slots=True)
class StepCheck:
    """The same n cycles under a time step and under half of it.

    flipped_mm : both heights of each part whose label differs.
    shift_mm : how far the height moves: median, 95th percentile, largest.
    """

    n: int
    flipped_mm: tuple[tuple[float, float], ...]
    shift_mm: tuple[float, float, float]


def forest(seed: int = 0) -> RandomForestClassifier:
    return RandomForestClassifier(200, random_state=seed, n_jobs=-1)


def predict_folds(X: NDArray[np.floating], y: NDArray[np.int8], model: ClassifierMixin, seed: int = 0) -> NDArray[Any]:
    """Every label, predicted by a model that was fitted on the other folds."""
    folds = StratifiedKFold(FOLDS, shuffle=True, random_state=seed)
    return np.asarray(cross_val_predict(model, X, y, cv=folds))


def accuracy(X: NDArray[np.floating], y: NDArray[np.int8], model: ClassifierMixin, seed: int = 0) -> float:
    return float(np.mean(predict_folds(X, y, model, seed) == y))


def hardness(data: Dataset, repeats: int = 3) -> dict[str, tuple[float, float]]:
    """Accuracy of 1-NN and of a random forest on the raw traces: mean and standard deviation over shuffled 5-folds."""
    models = {"1-NN": KNeighborsClassifier(1), "random forest": forest()}
    scores = {name: [accuracy(data.X, data.y, m, seed) for seed in range(repeats)] for name, m in models.items()}
    return {name: (float(np.mean(values)), float(np.std(values))) for name, values in scores.items()}


def first_contact(X: NDArray[np.float32]) -> NDArray[np.float64]:
    """Seconds until the force first leaves its level before contact, (n,); 2 s where it never does."""
    away = np.abs(X - X[:, :BEFORE_CONTACT].mean(axis=1, keepdims=True)) > CONTACT_N
    return np.asarray(np.where(away.any(axis=1), away.argmax(axis=1), X.shape[1]) / RATE_HZ)


def held_samples(X: NDArray[np.float32]) -> NDArray[np.float64]:
    """How many samples repeat the one before, and the longest such run, before contact, (n, 2)."""
    same = np.diff(X[:, :BEFORE_CONTACT], axis=1) == 0
    run = np.zeros(len(X))
    longest = np.zeros(len(X))
    for column in same.T:
        run = np.where(column, run + 1, 0)
        longest = np.maximum(longest, run)
    return np.stack([same.sum(axis=1), longest], axis=1)


def shortcuts(data: Dataset) -> dict[str, float]:
    """Accuracy of a random forest that sees one thing only that must not give the label away."""
    X, y = data.X, data.y
    before = X[:, :BEFORE_CONTACT]
    features = {
        "offset before contact (mean)": before.mean(axis=1, keepdims=True),
        "noise before contact (standard deviation of differences)": np.diff(before).std(axis=1, keepdims=True),
        "drift before contact (slope)": np.polyfit(np.arange(BEFORE_CONTACT), before.T, 1)[:1].T,
        "held samples before contact (count, longest run)": held_samples(X),
        f"all {BEFORE_CONTACT} samples before contact": before,
    }
    return {name: accuracy(feature, y, forest()) for name, feature in features.items()}


def physical_hints(data: Dataset) -> dict[str, float]:
    """The same for two single quantities that physics does make informative."""
    X, y = data.X, data.y
    hints = {
        "time of first contact": first_contact(X)[:, None],
        "final force (mean of the last 0.2 s)": X[:, -100:].mean(axis=1, keepdims=True),
    }
    return {name: accuracy(hint, y, forest()) for name, hint in hints.items()}


def halve_step(n: int, seed: int = 0, n_jobs: int = -1) -> StepCheck:
    """Simulate the same cycles at the time step and at half of it."""
    whole = simulate(n, seed, n_jobs=n_jobs)
    half = simulate(n, seed, n_jobs=n_jobs, time_step_s=TIME_STEP_S / 2)
    flipped = np.flatnonzero(whole.y != half.y)
    heights = tuple((float(whole.height_mm[i]), float(half.height_mm[i])) for i in flipped)
    median, most, largest = np.quantile(np.abs(whole.height_mm - half.height_mm), (0.5, 0.95, 1.0))
    return StepCheck(n, heights, (float(median), float(most), float(largest)))


def report_step(check: StepCheck) -> str:
    moved = ", ".join(f"{one:.2f} to {two:.2f} mm" for one, two in check.flipped_mm)
    median, most, largest = check.shift_mm
    return (
        f"{len(check.flipped_mm)} of {check.n} labels differ{f' ({moved})' if moved else ''}. The final height moves by "
        f"{median:.1g} mm in the median, {most:.1g} mm at the 95th percentile and {largest:.1g} mm at most"
    )


def report_hardness(data: Dataset) -> str:
    rows = [f"| {name} | {mean:.3f} ± {sd:.3f} |" for name, (mean, sd) in hardness(data).items()]
    return "\n".join(["| model on raw traces | accuracy |", "| --- | --- |", *rows])


def report_shortcuts(data: Dataset) -> str:
    majority = max(np.mean(data.y), 1 - np.mean(data.y))
    rows = [f"| {name} | {value:.3f} |" for name, value in (shortcuts(data) | physical_hints(data)).items()]
    head = ["| what the forest sees | accuracy |", "| --- | --- |", f"| nothing: the majority | {majority:.3f} |"]
    return "\n".join([*head, *rows])


@click.command()
@click.option("--data", default="insertion", show_default=True, help="A bundled set, or an .npz file with X and y.")
@click.option("--steps", default=0, show_default=True, help="Insertions to simulate at half the time step; 0: none.")
@click.option("--seed", default=0, show_default=True, help="Seed of those insertions, an integer.")
@click.option("--jobs", default=-1, show_default=True, help="Processes; -1: one a core.")
def main(data: str, steps: int, seed: int, jobs: int) -> None:
    """Print hardness, shortcuts and the time-step check, as in the data set's card."""
    traces = load_dataset(data)
    click.echo(report_hardness(traces))
    click.echo(report_shortcuts(traces))
    if steps:
        click.echo(report_step(halve_step(steps, seed, jobs)))


if __name__ == "__main__":
    main()
