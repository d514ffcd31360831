"""Make the bundled data set `insertion`, its pictures and its card.

python training/make_insertion.py --out dengine/data
"""

from __future__ import annotations

import time
from dataclasses import fields
from pathlib import Path
from typing import Any

import click
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import mujoco
import numpy as np
from check_simulation import forest, halve_step, predict_folds, report_hardness, report_shortcuts, report_step
from numpy.typing import NDArray

from dengine.cells.simulation.cell import CAUSES
from dengine.cells.simulation.conditions import RATE_HZ, SCENARIOS, CellParameters
from dengine.cells.simulation.generate import SimulatedTraces, save_traces, simulate, simulate_balanced
from dengine.datasets import Dataset, load_dataset

SUCCESSES, FAILURES = 803, 700  # as in the paper
SEED = 1503  # not 0: a cell run on the default seed must not meet the bundled parts again
SHOWN = 30  # traces a cause
NEAR_MM = 4.0
TITLES = {"none": "success"}
COLOURS = {1: "tab:blue", 0: "tab:red"}


def draw_causes(data: Dataset, path: Path) -> None:
    """Thirty traces of each cause, in panels of one scale."""
    figure, axes = plt.subplots(2, 4, figsize=(13, 5.5), sharex=True, sharey=True, layout="constrained")
    for axis, cause in zip(axes.flat, CAUSES, strict=True):
        _draw_cause(axis, data, cause)
    figure.supxlabel("time in s")
    figure.supylabel("simulated z-force in N")
    _save(figure, path)


def _draw_cause(axis: Any, data: Dataset, cause: str) -> None:
    rows = np.flatnonzero(data.cause == cause)
    time_s = np.arange(data.X.shape[1]) / data.rate_hz
    axis.plot(time_s, data.X[rows[:SHOWN]].T, linewidth=0.5, alpha=0.7)
    axis.set_title(f"{TITLES.get(cause, cause.replace('_', ' '))} ({len(rows)} of {len(data)})", fontsize=10)


def draw_heights(data: Dataset, heights_mm: NDArray[np.float32], wrong: NDArray[np.bool_], path: Path) -> None:
    """Final heights about the tolerance, and those of the parts that a forest gets wrong."""
    figure, axes = plt.subplots(1, 2, figsize=(10, 3.2), layout="constrained")
    edges = np.linspace(-1, 3, 41)
    for axis, chosen, title in (
        (axes[0], np.ones(len(data), dtype=bool), "all simulated parts"),
        (axes[1], wrong, f"the {wrong.sum()} that a random forest gets wrong"),
    ):
        for label, colour in COLOURS.items():
            axis.hist(heights_mm[chosen & (data.y == label)], edges, color=colour, alpha=0.7)
        axis.axvline(CellParameters().height_tolerance_mm, color="black", linestyle=":")
        axis.axvline(-CellParameters().height_tolerance_mm, color="black", linestyle=":")
        axis.set_title(title, fontsize=10)
        axis.set_xlabel("final height in mm (blue: success, red: failure; dotted: tolerance)", fontsize=8)
    _save(figure, path)


def draw_scenarios(path: Path, n: int = 160, seed: int = 1, n_jobs: int = -1) -> None:
    """What each scenario changes in the force: the median trace of each outcome in the first and the last quarter."""
    figure, axes = plt.subplots(1, len(SCENARIOS), figsize=(15, 3.6), sharex=True, sharey=True, layout="constrained")
    for axis, scenario in zip(axes, SCENARIOS, strict=True):
        draw_scenario(axis, simulate(n, seed, scenario, n_jobs=n_jobs))
    axes[0].set_ylabel("simulated z-force in N")
    axes[0].legend(fontsize=7)
    figure.supxlabel("time in s (line: median; band: middle half)")
    _save(figure, path)


def draw_scenario(axis: Any, traces: SimulatedTraces) -> None:
    """One scenario: first quarter dotted, last quarter solid, successes blue, failures red."""
    n = len(traces.y)
    time_s = np.arange(traces.X.shape[1]) / RATE_HZ
    quarters = {"first quarter": (traces.cycle < n // 4, ":"), "last quarter": (traces.cycle >= n - n // 4, "-")}
    for when, (inside, style) in quarters.items():
        for label, name in ((1, "success"), (0, "failure")):
            low, middle, high = np.quantile(traces.X[inside & (traces.y == label)], (0.25, 0.5, 0.75), axis=0)
            axis.plot(time_s, middle, style, color=COLOURS[label], linewidth=1, label=f"{name}, {when}")
            axis.fill_between(time_s, low, high, color=COLOURS[label], alpha=0.12, linewidth=0)
    first, last = (100 * traces.y[inside].mean() for inside, _ in quarters.values())
    axis.set_title(f"{traces.scenario}: success {first:.0f} % → {last:.0f} %", fontsize=10)


def _save(figure: Any, path: Path) -> None:
    figure.savefig(path, dpi=70)
    plt.close(figure)


def parameter_table() -> str:
    """Every setting of the nominal cell, as it was used."""
    cell = CellParameters()
    rows = [f"| `{field.name}` | {_value(getattr(cell, field.name))} |" for field in fields(cell)]
    return "\n".join(["| parameter | value |", "| --- | --- |", *rows])


def _value(value: Any) -> str:
    return f"{value[0]:g} to {value[1]:g}" if isinstance(value, tuple) else f"{value:g}"


def cause_table(data: Dataset) -> str:
    rows = [f"| {TITLES.get(c, c.replace('_', ' '))} | {np.sum(data.cause == c)} |" for c in CAUSES]
    return "\n".join(["| cause | traces |", "| --- | --- |", *rows])


def ambiguity(data: Dataset, heights_mm: NDArray[np.float32], wrong: NDArray[np.bool_]) -> str:
    """How the errors of a forest concentrate where the physics is undecided."""
    seated = np.abs(heights_mm)
    tolerance = CellParameters().height_tolerance_mm
    zones = {
        f"{tolerance:g} to 1.5 mm off the seat": (seated > tolerance) & (seated <= 1.5),
        f"1.5 to {NEAR_MM:g} mm off": (seated > 1.5) & (seated <= NEAR_MM),
        "further off": seated > NEAR_MM,
        "seated": seated <= tolerance,
    }
    rows = [f"| {name} | {inside.sum()} | {100 * wrong[inside].mean():.1f} % |" for name, inside in zones.items()]
    return "\n".join(["| final height | parts | the forest errs on |", "| --- | --- | --- |", *rows])


CARD = """# `insertion`: {n} simulated peg insertions

**Simulated.** Every trace was computed with MuJoCo {mujoco}; none was recorded on a robot. The counts are those of the
paper that the method comes from ({successes} successes, {failures} failures); its own recordings are not public.

    from dengine import load_dataset
    data = load_dataset("insertion")        # X (1503, 1000) float32 newtons, y (1503,), cause (1503,)

## How it was made

    python training/make_insertion.py --out dengine/data --seed {seed}   # this file, its pictures and this card
    dengine simulate --n {cycles} --seed {seed} --out traces.npz         # the same cycles, before the choice below

The nominal `SimulatedCell` ran until it had {successes} successes and {failures} failures, which took {cycles} cycles;
the first ones of each label were kept, in the order of their cycles. Trace *i* of a seed depends on (seed, cycle) alone,
not on the number of processes; another MuJoCo or processor may differ in the last digits. The label is the final height
alone: a success rests within ±{tolerance} mm of its seat.

A gripper holds a square part (16 mm wide, 40 mm long) by dry friction, on a wrist of six springs, and pushes it down
into a chamfered hole 12 mm deep, at a set speed, until it reaches its target or the force limit. A force sensor between
wrist and tool, zeroed with the part in hand, is read at 500 Hz for 2 s. Pushing is positive.

| key | what |
| --- | --- |
| `X` | ({n}, 1000) int16; times `scale` it is the z-force in `unit` (N) at `rate_hz` |
| `y` | 1 = success, 0 = failure |
| `cause` | why a part failed; `none` for a success |
| `height_mm` | of the part's top over its seated height; −40 where there was no part |
| `cycle` | of the cell, with this `seed`, that made the trace |
| `conditions`, `condition_names` | everything that was drawn for it, physical and of the sensor |

## What it looks like

![Thirty simulated traces of each cause](insertion_causes.png)

Real insertions of this kind look so: a failure meets the rim early and climbs to a plateau of 25 to 65 N, or slides
off; a success shows a small bump at the chamfer and meets the bottom late, at 10 to 50 N.

{causes}

A cause names the fault that was drawn where it took effect, else where the part came to rest: on the rim or its chamfer
(rim contact), in the hole (wedging), within 4 mm of its seat (stuck), or pushed up in the gripper by more than 1 mm (slip).
A drawn fault does not make a failure: thin debris, or a weak grip on a well aligned part, ends as a success.

## How hard it is

Five folds, shuffled, three times (mean ± standard deviation over the three):

{hardness}

The undecided zone is physical, no label was flipped:

{ambiguity}

Short wrong parts go in like right ones and only the height tells; a part on a chip one millimetre thick meets the
bottom hardly earlier than a part that was gripped one millimetre lower; a part that drags along the wall seats or sticks.

![Final heights](insertion_heights.png)

## No shortcut

Accuracy of a random forest that sees one thing only, five folds. What comes before the first contact tells nothing of
the outcome. The last two rows are physics, and may tell something:

{shortcuts}

Noise, ripple, bias, drift, quantisation and dropped samples are drawn from a stream of random numbers of their own,
which neither the world nor the label ever reads.

## The time step

MuJoCo steps 0.5 ms. At 0.25 ms, {step}.

## The scenarios of the simulated cell

The data set is nominal. `simulate(n, scenario=...)` and `SimulatedCell(scenario=...)` know three more: `wear` (friction
grows), `variant` (from half way on another part: heavier, tighter, with a smaller chamfer) and `bias_jump` (half way the
sensor's offset jumps).

![What each scenario changes in the force](insertion_scenarios.png)

## What it is not

One geometry of part and hole, rigid bodies, Coulomb friction, no vibration of the arm beyond a ripple. Square
edges against a chamfer chatter more than rounded ones. A detector's accuracy here is no promise for a real cell.

## Parameters of the nominal cell

Two numbers are the ends of a uniform draw; `_sd` is the standard deviation of a normal one. Units are in the names;
`dengine.cells.parameters.CellParameters` says what each means.

{parameters}
"""


def write_card(out: Path, steps: int, jobs: int) -> str:
    """The pictures and the card of the data set in this folder, every figure measured here and now."""
    data = load_dataset(out / "insertion.npz")
    with np.load(out / "insertion.npz", allow_pickle=False) as stored:
        heights_mm, seed, cycles = stored["height_mm"], int(stored["seed"]), int(stored["cycle"][-1]) + 1
    wrong = predict_folds(data.X, data.y, forest()) != data.y
    draw_causes(data, out / "insertion_causes.png")
    draw_heights(data, heights_mm, wrong, out / "insertion_heights.png")
    draw_scenarios(out / "insertion_scenarios.png", n_jobs=jobs)
    text = CARD.format(
        n=len(data),
        mujoco=mujoco.__version__,
        successes=SUCCESSES,
        failures=FAILURES,
        seed=seed,
        cycles=cycles,
        tolerance=CellParameters().height_tolerance_mm,
        causes=cause_table(data),
        hardness=report_hardness(data),
        ambiguity=ambiguity(data, heights_mm, wrong),
        shortcuts=report_shortcuts(data),
        step=report_step(halve_step(steps, seed, jobs)),
        parameters=parameter_table(),
    )
    (out / "insertion.md").write_text(text, encoding="utf-8")
    return text


@click.command()
@click.option(
    "--out", type=click.Path(path_type=Path), default=Path("dengine/data"), show_default=True, help="Folder to write to."
)
@click.option("--seed", default=SEED, show_default=True, help="Seed of the simulated cell, an integer.")
@click.option("--steps", default=200, show_default=True, help="Insertions to repeat at half the time step.")
@click.option("--jobs", default=-1, show_default=True, help="Processes; -1: one a core.")
@click.option("--card-only", is_flag=True, help="Keep the traces that are there; measure and draw them anew.")
def main(out: Path, seed: int, steps: int, jobs: int, card_only: bool) -> None:
    """Write insertion.npz, insertion.md and the card's pictures."""
    if not card_only:
        start = time.perf_counter()
        traces = simulate_balanced(SUCCESSES, FAILURES, seed, jobs, lambda done, of: click.echo(f"{done} of {of} kept"))
        click.echo(f"{time.perf_counter() - start:.0f} s for {int(traces.cycle[-1]) + 1} cycles")
        save_traces(out / "insertion.npz", traces, force=True)
    click.echo(write_card(out, steps, jobs))


if __name__ == "__main__":
    main()
