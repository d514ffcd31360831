"""Make the bundled data set `insertion`, its pictures and its card.

python training/make_insertion.py --out dengine/data
"""

import argparse
import re
import time
from collections.abc import Iterable
from dataclasses import fields
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from sklearn.ensemble import RandomForestClassifier
from sklearn.model_selection import StratifiedKFold, cross_val_predict
from sklearn.neighbors import KNeighborsClassifier

from dengine.cells.simulation.cell import CAUSES, SimulatedInsertion
from dengine.cells.simulation.conditions import RATE_HZ, SCENARIOS, CellParameters
from dengine.cells.simulation.generate import save_insertions, simulate
from dengine.cells.simulation.world import TIME_STEP_S
from dengine.datasets import Dataset, load_dataset

SUCCESSES, FAILURES = 803, 700  # as in the paper
CYCLES = 2000  # simulated, of which the first of each label are kept
SEED = 1503  # not 0: a cell run on the default seed must not meet the bundled parts again
CARD = Path(__file__).parents[1] / "dengine" / "data" / "insertion.md"
SHOWN = 30  # traces a cause
NEAR_MM = 4.0
BEFORE_CONTACT = 80  # samples; even the longest wrong part starts further from the rim than 0.16 s
CONTACT_N = 3.0
COLOURS = {1: "tab:blue", 0: "tab:red"}


def first_of_each(
    insertions: Iterable[SimulatedInsertion], successes: int, failures: int
) -> list[SimulatedInsertion]:
    """So many insertions of each label, the first ones, in their order; ValueError where there are fewer."""
    wanted, kept = {True: successes, False: failures}, []
    for each in insertions:
        if wanted[each.success] > 0:
            wanted[each.success] -= 1
            kept.append(each)
    if any(wanted.values()):
        raise ValueError(
            f"Expected {wanted[True]} successes and {wanted[False]} failures more; simulate more cycles."
        )
    return kept


def draw_causes(data: Dataset, path: Path) -> None:
    """Thirty traces of each cause, in panels of one scale."""
    figure = Figure(figsize=(13, 5.5), layout="constrained")
    time_s = np.arange(data.X.shape[1]) / data.spec.rate_hz
    for axes, cause in zip(
        figure.subplots(2, 4, sharex=True, sharey=True).flat, CAUSES, strict=True
    ):
        rows = np.flatnonzero(data.cause == cause)
        axes.plot(time_s, data.X[rows[:SHOWN]].T, linewidth=0.5, alpha=0.7)
        axes.set_title(f"{said(cause)} ({len(rows)} of {len(data)})", fontsize=10)
    figure.supxlabel("time in s")
    figure.supylabel("simulated z-force in N")
    figure.savefig(path, dpi=70)


def draw_heights(
    data: Dataset, heights_mm: NDArray[np.float32], wrong: NDArray[np.bool_], path: Path
) -> None:
    """Final heights about the tolerance, and those of the parts that a forest gets wrong."""
    figure, tolerance = (
        Figure(figsize=(10, 3.2), layout="constrained"),
        CellParameters().height_tolerance_mm,
    )
    titles = {
        "all simulated parts": wrong | True,
        f"the {wrong.sum()} that a random forest gets wrong": wrong,
    }
    for axes, (title, chosen) in zip(figure.subplots(1, 2), titles.items(), strict=True):
        for label, colour in COLOURS.items():
            axes.hist(
                heights_mm[chosen & (data.y == label)],
                np.linspace(-1, 3, 41),
                color=colour,
                alpha=0.7,
            )
        for edge in (tolerance, -tolerance):
            axes.axvline(edge, color="black", linestyle=":")
        axes.set_title(title, fontsize=10)
        axes.set_xlabel(
            "final height in mm (blue: success, red: failure; dotted: tolerance)", fontsize=8
        )
    figure.savefig(path, dpi=70)


def draw_scenarios(path: Path, n: int = 160, seed: int = 1, n_jobs: int = -1) -> None:
    """What each scenario changes in the force: the median trace of each outcome in the first and the last quarter."""
    figure = Figure(figsize=(15, 3.6), layout="constrained")
    panels = figure.subplots(1, len(SCENARIOS), sharex=True, sharey=True)
    for axes, scenario in zip(panels, SCENARIOS, strict=True):
        draw_scenario(axes, simulate(n, seed, scenario, n_jobs), scenario)
    panels[0].set_ylabel("simulated z-force in N")
    panels[0].legend(fontsize=7)
    figure.supxlabel("time in s (line: median; band: middle half)")
    figure.savefig(path, dpi=70)


def draw_scenario(axes: Any, insertions: list[SimulatedInsertion], scenario: str) -> None:
    """One scenario: first quarter dotted, last quarter solid, successes blue, failures red."""
    X, y = (
        np.stack([each.trace for each in insertions]),
        np.array([each.success for each in insertions]),
    )
    n, time_s, cycle = len(y), np.arange(X.shape[1]) / RATE_HZ, np.arange(len(y))
    quarters = {"first quarter": (cycle < n // 4, ":"), "last quarter": (cycle >= n - n // 4, "-")}
    for when, (inside, style) in quarters.items():
        for label, name in ((1, "success"), (0, "failure")):
            low, middle, high = np.quantile(X[inside & (y == label)], (0.25, 0.5, 0.75), axis=0)
            axes.plot(
                time_s, middle, style, color=COLOURS[label], linewidth=1, label=f"{name}, {when}"
            )
            axes.fill_between(time_s, low, high, color=COLOURS[label], alpha=0.12, linewidth=0)
    first, last = (100 * y[inside].mean() for inside, _ in quarters.values())
    axes.set_title(f"{scenario}: success {first:.0f} % → {last:.0f} %", fontsize=10)


def said(cause: str) -> str:
    """A cause in words."""
    return "success" if cause == "none" else cause.replace("_", " ")


def table(heads: str, rows: Iterable[tuple[object, ...]]) -> str:
    """Rows as a Markdown table."""
    columns = heads.split(", ")
    lines = [columns, ["---"] * len(columns), *([str(each) for each in row] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def parameter_table() -> str:
    """Every setting of the nominal cell, as it was used."""
    values = {
        f"`{field.name}`": getattr(CellParameters(), field.name) for field in fields(CellParameters)
    }
    written = {
        k: f"{v[0]:g} to {v[1]:g}" if isinstance(v, tuple) else f"{v:g}" for k, v in values.items()
    }
    return table("parameter, value", written.items())


def forest(seed: int = 0) -> RandomForestClassifier:
    """The model that is to be fooled."""
    return RandomForestClassifier(200, random_state=seed, n_jobs=-1)


def predicted(X: NDArray[Any], y: NDArray[np.int8], model: Any, seed: int = 0) -> NDArray[Any]:
    """Every label (n,), predicted by a model that was fitted on the other four of five folds."""
    return np.asarray(
        cross_val_predict(model, X, y, cv=StratifiedKFold(5, shuffle=True, random_state=seed))
    )


def hardness(data: Dataset, repeats: int = 3) -> str:
    """Accuracy of 1-NN and of a random forest on the raw traces: mean and standard deviation over shuffled folds."""
    rows = []
    for name, model in {"1-NN": KNeighborsClassifier(1), "random forest": forest()}.items():
        scores = [
            np.mean(predicted(data.X, data.y, model, seed) == data.y) for seed in range(repeats)
        ]
        rows.append((name, f"{np.mean(scores):.3f} ± {np.std(scores):.3f}"))
    return table("model on raw traces, accuracy", rows)


def ambiguity(heights_mm: NDArray[np.float32], wrong: NDArray[np.bool_]) -> str:
    """How the errors of a forest concentrate where the physics is undecided."""
    seated, tolerance = np.abs(heights_mm), CellParameters().height_tolerance_mm
    zones = {
        f"{tolerance:g} to 1.5 mm off the seat": (seated > tolerance) & (seated <= 1.5),
        f"1.5 to {NEAR_MM:g} mm off": (seated > 1.5) & (seated <= NEAR_MM),
        "further off": seated > NEAR_MM,
        "seated": seated <= tolerance,
    }
    rows = [
        (name, inside.sum(), f"{100 * wrong[inside].mean():.1f} %")
        for name, inside in zones.items()
    ]
    return table("final height, parts, the forest errs on", rows)


def first_contact(X: NDArray[np.float32]) -> NDArray[np.float64]:
    """Seconds until the force first leaves its level before contact, (n,); 2 s where it never does."""
    away = np.abs(X - X[:, :BEFORE_CONTACT].mean(axis=1, keepdims=True)) > CONTACT_N
    return np.asarray(np.where(away.any(axis=1), away.argmax(axis=1), X.shape[1]) / RATE_HZ)


def held_samples(before: NDArray[np.float32]) -> NDArray[np.float64]:
    """How many samples repeat the one before, and the longest such run, (n, 2)."""
    same, run, longest = np.diff(before, axis=1) == 0, np.zeros(len(before)), np.zeros(len(before))
    for column in same.T:
        run = np.where(column, run + 1, 0)
        longest = np.maximum(longest, run)
    return np.stack([same.sum(axis=1), longest], axis=1)


def shortcuts(data: Dataset) -> str:
    """Accuracy of a forest that sees one thing only: five that must not give the label away, and two that physics may."""
    X, y, before = data.X, data.y, data.X[:, :BEFORE_CONTACT]
    features = {
        "offset before contact (mean)": before.mean(axis=1, keepdims=True),
        "noise before contact (standard deviation of differences)": np.diff(before).std(
            axis=1, keepdims=True
        ),
        "drift before contact (slope)": np.polyfit(np.arange(BEFORE_CONTACT), before.T, 1)[:1].T,
        "held samples before contact (count, longest run)": held_samples(before),
        f"all {BEFORE_CONTACT} samples before contact": before,
        "time of first contact": first_contact(X)[:, None],
        "final force (mean of the last 0.2 s)": X[:, -100:].mean(axis=1, keepdims=True),
    }
    rows = [
        (name, f"{np.mean(predicted(seen, y, forest()) == y):.3f}")
        for name, seen in features.items()
    ]
    majority = max(np.mean(y), 1 - np.mean(y))
    return table(
        "what the forest sees, accuracy", [("nothing: the majority", f"{majority:.3f}"), *rows]
    )


def halved_step(n: int, seed: int, n_jobs: int) -> str:
    """What becomes of the same cycles at half the time step."""
    whole, half = (
        simulate(n, seed, n_jobs=n_jobs),
        simulate(n, seed, n_jobs=n_jobs, time_step_s=TIME_STEP_S / 2),
    )
    flipped = [
        (a.height_mm, b.height_mm)
        for a, b in zip(whole, half, strict=True)
        if a.success != b.success
    ]
    moved = ", ".join(f"{a:.2f} to {b:.2f} mm" for a, b in flipped)
    apart = [abs(a.height_mm - b.height_mm) for a, b in zip(whole, half, strict=True)]
    median, most, largest = np.quantile(apart, (0.5, 0.95, 1.0))
    return (
        f"{len(flipped)} of {n} labels differ{f' ({moved})' if moved else ''}. The final height moves by "
        f"{median:.1g} mm in the median, {most:.1g} mm at the 95th percentile and {largest:.1g} mm at most"
    )


def with_table(card: str, new: str) -> str:
    """The card with this table in place of that of the same head."""
    head = re.escape(new.split("\n", 1)[0])
    card, n = re.subn(rf"^{head}\n(\|.*\n)+", lambda found: f"{new}\n", card, flags=re.MULTILINE)
    if n != 1:
        raise SystemExit(f"Expected one table in {CARD} with the head {head}, found {n}.")
    return card


def write_card(out: Path, steps: int, jobs: int) -> str:
    """The pictures and the card of the data set in this folder: its words, and every figure measured here and now."""
    data = load_dataset(out / "insertion.npz")
    with np.load(out / "insertion.npz", allow_pickle=False) as stored:
        heights_mm = stored["height_mm"]
    wrong = predicted(data.X, data.y, forest()) != data.y
    draw_causes(data, out / "insertion_causes.png")
    draw_heights(data, heights_mm, wrong, out / "insertion_heights.png")
    draw_scenarios(out / "insertion_scenarios.png", n_jobs=jobs)
    text = CARD.read_text(encoding="utf-8")
    causes = table(
        "cause, traces", [(said(cause), np.sum(data.cause == cause)) for cause in CAUSES]
    )
    for measured in (
        causes,
        hardness(data),
        ambiguity(heights_mm, wrong),
        shortcuts(data),
        parameter_table(),
    ):
        text = with_table(text, measured)
    text = re.sub(r"MuJoCo \d[\d.]*", f"MuJoCo {mujoco.__version__}", text)
    text = re.sub(r"At 0\.25 ms, .*", f"At 0.25 ms, {halved_step(steps, SEED, jobs)}.", text)
    (out / "insertion.md").write_text(text, encoding="utf-8")
    return text


def main() -> None:
    """Write insertion.npz, insertion.md and the card's pictures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("dengine/data"), help="folder to write to")
    parser.add_argument(
        "--steps", type=int, default=200, help="insertions to repeat at half the time step"
    )
    parser.add_argument("--jobs", type=int, default=-1, help="processes; -1: one a core")
    parser.add_argument(
        "--card-only",
        action="store_true",
        help="keep the traces that are there; measure and draw anew",
    )
    args = parser.parse_args()
    if not args.card_only:
        start = time.perf_counter()
        insertions = simulate(CYCLES, SEED, n_jobs=args.jobs)
        print(f"{time.perf_counter() - start:.0f} s for {CYCLES} cycles")
        save_insertions(
            args.out / "insertion.npz",
            first_of_each(insertions, SUCCESSES, FAILURES),
            SEED,
            force=True,
        )
    print(write_card(args.out, args.steps, args.jobs))


if __name__ == "__main__":
    main()
