"""`dengine run`: an engine drives a cell, and goes on where its store left off."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from .options import RecipeChoice, data_options, example, json_option, out_option, read, recipe_options
from .output import progress, show, write_json

if TYPE_CHECKING:
    from ..cells.base import Cell
    from ..experiments.live import RunLog
    from ..store.base import Store

STRETCHES = 6


@click.command(epilog=example("dengine run --cell simulated --cycles 300 --store engine.db --alpha 0.1 --lower-bound 0.9"))
@click.option("--cell", "kind", type=click.Choice(["simulated", "replay"]), default="simulated", show_default=True)
@data_options()
@click.option("--scenario", default="nominal", show_default=True, help="Simulated cell: nominal, wear, variant, bias_jump.")
@click.option("--cycles", type=click.IntRange(1), default=300, show_default=True)
@click.option("--store", metavar="FILE|URL", help="Remembers everything; without one the run is forgotten.")
@recipe_options
@click.option("--seed", type=click.IntRange(0), help="Of a new store's engine, and of the simulated cell.  [default: 0]")
@out_option
@json_option
def run(
    choice: RecipeChoice,
    kind: str,
    data: str,
    samples: int | None,
    scenario: str,
    cycles: int,
    store: str | None,
    seed: int | None,
    out: Path | None,
    as_json: bool,
) -> None:
    """Drive a cell: verify, learn, and verify less.

    With a store that exists the engine goes on where it was. The simulated cell then makes new parts, and a recording goes
    on after its last part with a label in the store: no part is learned from twice.
    """
    from ..engine import DataEngine
    from ..experiments.live import watch

    engine = DataEngine.open_or_create(store, seed, recipe=choice.load() if choice.asked else None)
    with engine:
        cell, name = CELLS[kind](engine.store, engine.seed, data, samples, scenario, cycles)
        with progress(name, cycles, as_json) as advance:
            log = watch(engine, cell, cycles, lambda cycle: advance(1))
    _report(log, cell, kind, f"{name}, {engine.recipe.reducer}{', resumed' if engine.resumed else ''}", out, as_json)


def _simulated(store: Store, seed: int, data: str, samples: int | None, scenario: str, cycles: int) -> tuple[Cell, str]:
    from ..cells.simulation.cell import SimulatedCell

    # Another seed for a resumed run: the same parts again would be counted twice.
    seed += store.status()["decisions"]
    return SimulatedCell(scenario=scenario, seed=seed, cycles=cycles), f"simulated cell, {scenario}"


def _recorded(store: Store, seed: int, data: str, samples: int | None, scenario: str, cycles: int) -> tuple[Cell, str]:
    import numpy as np

    from ..cells.replay import ReplayCell
    from ..errors import SettingError
    from ..folds import content_hash

    dataset = read(data, samples)
    known = np.flatnonzero(np.isin(content_hash(dataset.X), store.labelled().hashes))
    first = int(known[-1]) + 1 if len(known) else 0
    left = len(dataset) - first
    if cycles > left:
        raise SettingError(
            f"Expected at most {left} cycles, got {cycles}: {first} of {len(dataset)} parts were played before."
        )
    return ReplayCell(dataset, np.arange(first, len(dataset))), f"recording {dataset.name} from part {first + 1}"


CELLS = {"simulated": _simulated, "replay": _recorded}


def _report(log: RunLog, cell: Cell, kind: str, title: str, out: Path | None, as_json: bool) -> None:
    from ..experiments.tables import retrain_line

    total, stretches = log.summary(), log.stretches(STRETCHES)
    clock = asdict(cell.report()) if hasattr(cell, "report") else None
    worst = max((r.seconds for r in log.retrains), default=None)
    files = _save(log, title, out) if out is not None else []
    if as_json:
        result = {"verb": "run", "title": title, "simulated": kind == "simulated", "total": total, "stretches": stretches}
        write_json(result | {"cell": clock, "retrains": log.retrains, "retrain_max_s": worst, "files": files})
        return
    show(_table([*stretches, total], title))
    if clock is not None:
        show(
            f"Simulated: {clock['parts_per_hour']:.1f} good parts an hour; {clock['seconds_saved']:.0f} s saved against "
            f"verifying every part, {clock['stops']} stops and {clock['sent_back']} good parts sent back taken off; "
            f"{clock['escapes']} bad parts escaped in silence."
        )
    show(retrain_line(log.retrains))
    show(*(f"Wrote {path}" for path in files))


def _table(rows: list[dict[str, Any]], title: str) -> Any:
    from rich.table import Table

    table = Table(title=title, title_justify="left")
    for name in ("cycles", "verified", "accepted", "FP", "of them stops", "rejected", "FN", "good parts/h"):
        table.add_column(name, justify="right")
    for i, row in enumerate(rows):
        if i == len(rows) - 1:
            table.add_section()
        rate = row["parts_per_hour"]
        table.add_row(
            f"{row['first_cycle']} to {row['last_cycle']}",
            f"{100 * row['verified_share']:.0f} %",
            *(str(row[name]) for name in ("accepted", "false_positive", "stops", "rejected", "false_negative")),
            "-" if rate is None else f"{rate:.1f}",
        )
    return table


def _save(log: RunLog, title: str, out: Path) -> list[Path]:
    import pandas as pd

    from ..experiments.figures import run_picture, save
    from ..experiments.tables import write_csv

    columns = {"action": log.action, "truth": log.truth, "stopped": log.stopped}
    frame = pd.DataFrame(columns | ({} if log.clock_s is None else {"clock_s": log.clock_s}))
    frame.insert(0, "cycle", range(1, len(log) + 1))
    return [write_csv(frame, out / "run.csv"), save(run_picture(log, title), out / "run.png")]
