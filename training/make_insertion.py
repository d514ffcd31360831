"""Make the bundled data set `insertion`, its pictures and its card.

    python training/make_insertion.py --out dengine/data
    python training/make_insertion.py --card-only     # keep the traces; measure and draw again

It simulates insertions, keeps as many good and bad ones as the paper has, and writes
insertion.npz. The card insertion.md keeps its words; every table and figure in it is measured here:
how many traces each cause has, how well simple models do, and whether anything beside the force of
the insertion gives the label away.
"""

import argparse
import re
import time
from collections.abc import Iterable
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from matplotlib.axes import Axes
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

Floats = NDArray[np.float64]
Labels = NDArray[np.int8]
Bools = NDArray[np.bool_]

N_SUCCESSES = 803  # as in the paper
N_FAILURES = 700
N_CYCLES = 2000  # simulated, of which the first of each label are kept
SEED = 1503  # not 0: a cell run on the default seed must not meet the bundled parts again
CARD = Path(__file__).parents[1] / "dengine" / "data" / "insertion.md"
N_DRAWN = 30  # traces of each cause
NEAR_MM = 4.0  # from the seat, for a final height that is not seated
BEFORE_CONTACT = 80  # samples; even the longest wrong part starts further from the rim than 0.16 s
CONTACT_N = 3.0  # force beyond its level before contact that counts as contact
COLOURS = {1: "tab:blue", 0: "tab:red"}


def select_first(
    insertions: Iterable[SimulatedInsertion], n_successes: int, n_failures: int
) -> list[SimulatedInsertion]:
    """Return the first successes and the first failures, in their order.

    Raises
    ------
    ValueError
        There are too few of one label.
    """
    missing = {True: n_successes, False: n_failures}
    selected = []
    for insertion in insertions:
        if missing[insertion.success] > 0:
            missing[insertion.success] -= 1
            selected.append(insertion)
    if any(missing.values()):
        raise ValueError(
            f"Expected {missing[True]} successes and {missing[False]} failures more; "
            "simulate more cycles."
        )
    return selected


def save_with_conditions(path: Path, insertions: list[SimulatedInsertion]) -> None:
    """Write the data set, and for each insertion how it ended and what was drawn for it."""
    with np.load(save_insertions(path, insertions, force=True)) as saved:
        arrays = dict(saved)
    rows = [asdict(insertion.conditions) | asdict(insertion.sensor) for insertion in insertions]
    names = [name for name in rows[0] if name != "fault"]
    np.savez_compressed(
        path,
        **arrays,
        cause=np.array([insertion.cause for insertion in insertions]),
        height_mm=np.array([insertion.height_mm for insertion in insertions], dtype=np.float32),
        cycle=np.array([insertion.cycle for insertion in insertions], dtype=np.int32),
        conditions=np.array([[row[name] for name in names] for row in rows], dtype=np.float32),
        condition_names=np.array(names),
        seed=np.int64(SEED),
    )


def draw_causes(data: Dataset, path: Path) -> None:
    """Draw `N_DRAWN` traces of each cause, in panels of one scale, and save the picture."""
    figure = Figure(figsize=(13, 5.5), layout="constrained")
    panels = figure.subplots(2, 4, sharex=True, sharey=True).flat
    time_s = np.arange(data.X.shape[1]) / RATE_HZ
    for axes, cause in zip(panels, CAUSES, strict=True):
        rows = np.flatnonzero(data.cause == cause)
        axes.plot(time_s, data.X[rows[:N_DRAWN]].T, linewidth=0.5, alpha=0.7)
        axes.set_title(f"{cause_title(cause)} ({len(rows)} of {len(data)})", fontsize=10)
    figure.supxlabel("time in s")
    figure.supylabel("simulated z-force in N")
    figure.savefig(path, dpi=70)


def draw_heights(data: Dataset, heights_mm: NDArray[np.float32], wrong: Bools, path: Path) -> None:
    """Draw histograms of final heights near the tolerance, and save the picture.

    Parameters
    ----------
    data : Dataset
    heights_mm : array of float32, shape (n,)
    wrong : array of bool, shape (n,)
        Whether a random forest predicts the wrong label.
    path : Path
    """
    figure = Figure(figsize=(10, 3.2), layout="constrained")
    tolerance = CellParameters().height_tolerance_mm
    selections = {
        "all simulated parts": np.ones_like(wrong),
        f"the {wrong.sum()} that a random forest gets wrong": wrong,
    }
    bins = np.linspace(-1, 3, 41)
    x_label = "final height in mm (blue: success, red: failure; dotted: tolerance)"
    for axes, (title, selected) in zip(figure.subplots(1, 2), selections.items(), strict=True):
        for label, colour in COLOURS.items():
            axes.hist(heights_mm[selected & (data.y == label)], bins, color=colour, alpha=0.7)
        for edge in (tolerance, -tolerance):
            axes.axvline(edge, color="black", linestyle=":")
        axes.set_title(title, fontsize=10)
        axes.set_xlabel(x_label, fontsize=8)
    figure.savefig(path, dpi=70)


def draw_scenarios(path: Path, n: int = 160, seed: int = 1, n_jobs: int = -1) -> None:
    """Simulate n insertions of each scenario, draw how the force changes, and save the picture."""
    figure = Figure(figsize=(15, 3.6), layout="constrained")
    panels = figure.subplots(1, len(SCENARIOS), sharex=True, sharey=True)
    for axes, scenario in zip(panels, SCENARIOS, strict=True):
        draw_scenario(axes, simulate(n, seed, scenario, n_jobs), scenario)
    panels[0].set_ylabel("simulated z-force in N")
    panels[0].legend(fontsize=7)
    figure.supxlabel("time in s (line: median; band: middle half)")
    figure.savefig(path, dpi=70)


def draw_scenario(axes: Axes, insertions: list[SimulatedInsertion], scenario: str) -> None:
    """Draw the median force of good and bad parts in the first and the last quarter."""
    X = np.stack([insertion.trace for insertion in insertions])
    y = np.array([insertion.success for insertion in insertions])
    n = len(y)
    time_s = np.arange(X.shape[1]) / RATE_HZ
    cycle = np.arange(n)
    quarters = (
        ("first quarter", cycle < n // 4, ":"),
        ("last quarter", cycle >= n - n // 4, "-"),
    )
    for quarter, inside, line in quarters:
        for label, name in ((1, "success"), (0, "failure")):
            low, median, high = np.quantile(X[inside & (y == label)], (0.25, 0.5, 0.75), axis=0)
            colour = COLOURS[label]
            title = f"{name}, {quarter}"
            axes.plot(time_s, median, line, color=colour, linewidth=1, label=title)
            axes.fill_between(time_s, low, high, color=colour, alpha=0.12, linewidth=0)
    first, last = (100 * y[inside].mean() for _, inside, _ in quarters)
    axes.set_title(f"{scenario}: success {first:.0f} % → {last:.0f} %", fontsize=10)


def cause_title(cause: str) -> str:
    """Return a cause in words."""
    return "success" if cause == "none" else cause.replace("_", " ")


def markdown_table(head: str, rows: Iterable[tuple[object, ...]]) -> str:
    """Return rows as a Markdown table; the head has the columns' names with commas."""
    columns = head.split(", ")
    lines = [columns, ["---"] * len(columns), *([str(cell) for cell in row] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def cause_table(data: Dataset) -> str:
    """Return how many traces each cause has."""
    counts = [(cause_title(cause), np.sum(data.cause == cause)) for cause in CAUSES]
    return markdown_table("cause, traces", counts)


def parameter_table() -> str:
    """Return all settings of the nominal cell as a Markdown table."""
    rows = []
    for field in fields(CellParameters):
        value = getattr(CellParameters(), field.name)
        is_range = isinstance(value, tuple)
        text = f"{value[0]:g} to {value[1]:g}" if is_range else f"{value:g}"
        rows.append((f"`{field.name}`", text))
    return markdown_table("parameter, value", rows)


def make_forest(seed: int = 0) -> RandomForestClassifier:
    """Return an untrained random forest."""
    return RandomForestClassifier(200, random_state=seed, n_jobs=-1)


def cross_predict(X: NDArray[Any], y: Labels, model: Any, seed: int = 0) -> NDArray[Any]:
    """Predict each label (n,) with a model that was trained on the other four of five folds."""
    folds = StratifiedKFold(5, shuffle=True, random_state=seed)
    return np.asarray(cross_val_predict(model, X, y, cv=folds))


def hardness_table(data: Dataset, repeats: int = 3) -> str:
    """Return a Markdown table: the accuracy of 1-NN and of a random forest on the raw traces.

    It is the mean ± the standard deviation over `repeats` shuffles of the folds.
    """
    models = {"1-NN": KNeighborsClassifier(1), "random forest": make_forest()}
    rows = []
    for name, model in models.items():
        accuracies = [
            np.mean(cross_predict(data.X, data.y, model, seed) == data.y) for seed in range(repeats)
        ]
        rows.append((name, f"{np.mean(accuracies):.3f} ± {np.std(accuracies):.3f}"))
    return markdown_table("model on raw traces, accuracy", rows)


def ambiguity_table(heights_mm: NDArray[np.float32], wrong: Bools) -> str:
    """Return a Markdown table of the parts by their distance from the seat.

    It has the number of parts at each distance, and on which share of them a forest errs.
    """
    distance = np.abs(heights_mm)
    tolerance = CellParameters().height_tolerance_mm
    zones = {
        f"{tolerance:g} to 1.5 mm off the seat": (distance > tolerance) & (distance <= 1.5),
        f"1.5 to {NEAR_MM:g} mm off": (distance > 1.5) & (distance <= NEAR_MM),
        "further off": distance > NEAR_MM,
        "seated": distance <= tolerance,
    }
    rows = [
        (name, inside.sum(), f"{100 * wrong[inside].mean():.1f} %")
        for name, inside in zones.items()
    ]
    return markdown_table("final height, parts, the forest errs on", rows)


def first_contact(X: NDArray[np.float32]) -> Floats:
    """Return when the force first leaves its level before contact, in seconds, shape (n,).

    2 s, the length of a trace, where it never does.
    """
    level = X[:, :BEFORE_CONTACT].mean(axis=1, keepdims=True)
    is_contact = np.abs(X - level) > CONTACT_N
    samples = np.where(is_contact.any(axis=1), is_contact.argmax(axis=1), X.shape[1])
    return np.asarray(samples / RATE_HZ)


def repeated_samples(before: NDArray[np.float32]) -> Floats:
    """Return the number of samples that repeat the one before, and the longest run, (n, 2)."""
    is_repeated = np.diff(before, axis=1) == 0
    run = np.zeros(len(before))
    longest = np.zeros(len(before))
    for column in is_repeated.T:
        run = np.where(column, run + 1, 0)
        longest = np.maximum(longest, run)
    return np.stack([is_repeated.sum(axis=1), longest], axis=1)


def shortcut_table(data: Dataset) -> str:
    """Return a Markdown table: the accuracy of a forest that sees only one feature of the traces.

    The five features before contact must not give the label away; the last two may.
    """
    X = data.X
    before = X[:, :BEFORE_CONTACT]
    noise = np.diff(before).std(axis=1, keepdims=True)
    slope = np.polyfit(np.arange(BEFORE_CONTACT), before.T, 1)[:1].T
    features = {
        "offset before contact (mean)": before.mean(axis=1, keepdims=True),
        "noise before contact (standard deviation of differences)": noise,
        "drift before contact (slope)": slope,
        "held samples before contact (count, longest run)": repeated_samples(before),
        f"all {BEFORE_CONTACT} samples before contact": before,
        "time of first contact": first_contact(X)[:, None],
        "final force (mean of the last 0.2 s)": X[:, -100:].mean(axis=1, keepdims=True),
    }
    success_rate = np.mean(data.y)
    rows = [("nothing: the majority", f"{max(success_rate, 1 - success_rate):.3f}")]
    for name, feature in features.items():
        accuracy = np.mean(cross_predict(feature, data.y, make_forest()) == data.y)
        rows.append((name, f"{accuracy:.3f}"))
    return markdown_table("what the forest sees, accuracy", rows)


def compare_time_steps(n: int, seed: int, n_jobs: int) -> str:
    """Simulate the same cycles at half the time step; return what differs, as two sentences."""
    whole = simulate(n, seed, n_jobs=n_jobs)
    half = simulate(n, seed, n_jobs=n_jobs, time_step_s=TIME_STEP_S / 2)
    pairs = list(zip(whole, half, strict=True))
    flips = [
        f"{a.height_mm:.2f} to {b.height_mm:.2f} mm" for a, b in pairs if a.success != b.success
    ]
    distances = [abs(a.height_mm - b.height_mm) for a, b in pairs]
    median, percentile_95, largest = np.quantile(distances, (0.5, 0.95, 1.0))
    listed = f" ({', '.join(flips)})" if flips else ""
    return (
        f"{len(flips)} of {n} labels differ{listed}. The final height moves by {median:.1g} mm in "
        f"the median, {percentile_95:.1g} mm at the 95th percentile and {largest:.1g} mm at most"
    )


def replace_table(card: str, table: str) -> str:
    """Return the card with a table in place of the one that has the same head.

    Raises SystemExit unless exactly one table of the card has it.
    """
    head = re.escape(table.split("\n", 1)[0])
    pattern = rf"^{head}\n(\|.*\n)+"
    card, n_replaced = re.subn(pattern, lambda _: f"{table}\n", card, flags=re.MULTILINE)
    if n_replaced != 1:
        raise SystemExit(f"Expected one table in {CARD} with the head {head}, got {n_replaced}.")
    return card


def write_card(out: Path, n_steps: int, n_jobs: int) -> str:
    """Write the pictures and the card of the data set in a folder; return the card's text.

    It takes the text of `CARD`, and replaces its tables and measured numbers.

    Parameters
    ----------
    out : Path
        Has insertion.npz.
    n_steps : int
        Insertions that are repeated at half the time step.
    n_jobs : int
    """
    data = load_dataset(out / "insertion.npz")
    with np.load(out / "insertion.npz", allow_pickle=False) as stored:
        heights_mm = stored["height_mm"]
    wrong = cross_predict(data.X, data.y, make_forest()) != data.y
    draw_causes(data, out / "insertion_causes.png")
    draw_heights(data, heights_mm, wrong, out / "insertion_heights.png")
    draw_scenarios(out / "insertion_scenarios.png", n_jobs=n_jobs)
    tables = (
        cause_table(data),
        hardness_table(data),
        ambiguity_table(heights_mm, wrong),
        shortcut_table(data),
        parameter_table(),
    )
    text = CARD.read_text(encoding="utf-8")
    for table in tables:
        text = replace_table(text, table)
    text = re.sub(r"MuJoCo \d[\d.]*", f"MuJoCo {mujoco.__version__}", text)
    differences = compare_time_steps(n_steps, SEED, n_jobs)
    text = re.sub(r"At 0\.25 ms, .*", f"At 0.25 ms, {differences}.", text)
    (out / "insertion.md").write_text(text, encoding="utf-8")
    return text


def main() -> None:
    """Write insertion.npz, insertion.md and the card's pictures; print the card."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("dengine/data"), help="folder to write to")
    parser.add_argument(
        "--steps", type=int, default=200, help="insertions to repeat at half the time step"
    )
    parser.add_argument("--jobs", type=int, default=-1, help="processes; -1: one for each core")
    parser.add_argument(
        "--card-only", action="store_true", help="keep the traces; measure and draw again"
    )
    arguments = parser.parse_args()
    if not arguments.card_only:
        start = time.perf_counter()
        insertions = simulate(N_CYCLES, SEED, n_jobs=arguments.jobs)
        print(f"{time.perf_counter() - start:.0f} s for {N_CYCLES} cycles")
        selected = select_first(insertions, N_SUCCESSES, N_FAILURES)
        save_with_conditions(arguments.out / "insertion.npz", selected)
    print(write_card(arguments.out, arguments.steps, arguments.jobs))


if __name__ == "__main__":
    main()
