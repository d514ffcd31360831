"""`dengine run`: an engine drives a cell, and goes on where its store left off."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from dataclasses import asdict
from typing import TYPE_CHECKING, Any
from zlib import crc32

import click

from ..errors import CellError, SettingError, percent
from . import options
from .options import DataChoice, OutFolder, RecipeChoice, short_name
from .output import EndAskedError, certificate_record, end_interrupted, figures, interruptible, progress, show, write_json
from .robot import host_option, open_robot, recording_line, recording_record

if TYPE_CHECKING:
    from ..cells.base import Cell
    from ..decision.certificate import Certificate
    from ..engine.engine import DataEngine
    from ..experiments.replay import Replay
    from ..records import Cycle
    from ..store.base import Store

STRETCHES = 6
RUN = "dengine run --cell simulated --cycles 100 --store engine.db --alpha 0.1 --lower-bound 0.9"
KINDS = "simulated: physics in MuJoCo. replay: the parts of --data, in their order. ur: a Universal Robots controller."
SEED = "An integer, of a new store's engine and of the simulated cell.  [default: 0]"


@click.command(epilog=options.example(RUN))
@click.option(
    "--cell", "kind", type=click.Choice(("simulated", "replay", "ur")), default="simulated", show_default=True, help=KINDS
)
@host_option
@options.data_options()
@options.scenario_option
@click.option("--cycles", type=options.COUNT, default=300, show_default=True, help="Parts to insert, one a cycle.")
@click.option("--store", metavar="FILE|URL", help="Remembers everything; without one the run is forgotten.")
@options.cell_options("--cell-id", product=True)
@options.recipe_options
@click.option("--seed", type=click.IntRange(0), help=SEED)
@click.option("--shadow", is_flag=True, help="Verify every part; the model only says what it would have done.")
@options.out_option
@options.json_option
def run(
    choice: RecipeChoice,
    kind: str,
    host: str | None,
    source: DataChoice,
    scenario: str,
    cycles: int,
    store: str | None,
    seed: int | None,
    shadow: bool,
    out: OutFolder | None,
    as_json: bool,
) -> None:
    """Drive a cell: verify, learn, and verify less.

    With a store that exists the engine goes on where it was. The simulated cell then makes new parts, and a recording goes
    on after its last part that was labelled or accepted: no part is learned from twice. A robot runs
    training/ur_cell.script, or a program of the same handshake; --trigger and --samples say what is recorded of it.
    Where too much goes wrong, or looks like nothing known, everything is verified until fresh evidence says otherwise: the
    safe mode. Ctrl-C ends the run after the cycle that is under way and shows what was done; pressed twice, at once.
    """
    if kind == "simulated":
        options.must_have_mujoco()
    from ..engine.engine import DataEngine

    with ExitStack() as opened, DataEngine.open_or_create(store, seed, recipe=choice.if_asked()) as engine:
        if shadow:
            engine.set_shadow(True)
        cell, name = CELLS[kind](
            store=engine.store, seed=engine.seed, source=source, scenario=scenario, cycles=cycles, host=host
        )
        opened.callback(getattr(cell, "close", lambda: None))
        log, changes, failure = _drive(engine, cell, cycles, name, as_json)
        said: dict[str, Any] = {"safe_mode": engine.safe_mode, "safe_mode_changes": changes}
        certificate = engine.certificate()
    title = f"{name}, {short_name(engine.recipe.name)}{', resumed' if engine.resumed else ''}"
    if len(log):
        said |= {"title": title, "simulated": kind == "simulated", "interrupted": len(log) < cycles}
        _report(log, said, certificate, cell, out, as_json)
    left = cycles - len(log)
    kept = f"Everything up to cycle {len(log)} is in {store}; the same command with --cycles {left} goes on there."
    if store is None:
        kept = "Nothing was stored: --store FILE keeps a run, and goes on with it."
    if failure is not None:
        raise CellError(f"{failure} {len(log)} of {cycles} cycles were done. {kept}") from failure
    if left:
        shown = "the table shows those" if len(log) else "there is nothing to show"
        end_interrupted(f"Interrupted: {len(log)} of {cycles} cycles were done; {shown}.", kept)


def _drive(
    engine: DataEngine, cell: Cell, cycles: int, name: str, quiet: bool
) -> tuple[Replay, list[dict[str, Any]], CellError | None]:
    """What was done, when the safe mode began or ended, and what ended the run, where the cell failed."""
    from ..experiments.replay import RunRecorder

    recorder, changes, mode = RunRecorder(cell), list[dict[str, Any]](), engine.safe_mode
    with interruptible() as asked, progress(name, cycles, quiet) as advance:

        def count(cycle: Cycle) -> None:
            nonlocal mode
            advance(1)
            if cycle.safe_mode != mode:
                mode = cycle.safe_mode
                changes.append({"cycle": cycle.index + 1, "reason": mode})
                if not quiet:
                    click.echo(_mode_line(changes[-1]), err=True)
            if asked():  # between two cycles: no part is left half dealt with
                raise EndAskedError

        # Pressed twice, Ctrl-C ends even a cycle that does not end; what was done before it is known.
        try:
            with suppress(EndAskedError, KeyboardInterrupt):
                recorder.follow(engine, cycles, count)
        except CellError as error:
            return recorder.log(), changes, error
    return recorder.log(), changes, None


def _mode_line(change: Mapping[str, Any]) -> str:
    """After which cycle the safe mode began, for a reason; or ended, for none."""
    what = f"safe mode, every part is verified: {change['reason']}" if change["reason"] else "safe mode ended"
    return f"After cycle {change['cycle']}: {what}."


def _simulated(store: Store, seed: int, scenario: str, cycles: int, **others: Any) -> tuple[Cell, str]:
    from ..cells.simulation.cell import SimulatedCell

    # Another seed for a resumed run: the same parts again would be counted twice.
    seed += store.status()["decisions"]
    if store.product is not None:  # peers have one seed, and parts of their own all the same
        seed += crc32(store.cell_id.encode())
    return SimulatedCell(scenario=scenario, seed=seed, cycles=cycles), f"simulated cell, {scenario}"


def _recorded(store: Store, source: DataChoice, cycles: int, **others: Any) -> tuple[Cell, str]:
    import numpy as np

    from ..cells.replay import ReplayCell
    from ..folds import content_hash

    dataset = source.load()
    # By content: of a part that comes twice the store's own hash would name both.
    played = store.own_labelled()
    hashes = content_hash(played.traces)
    for id_ in store.unreported_accepts()[-1:]:
        newest = store.get_decision(id_)
        hashes = hashes if newest is None else np.append(hashes, content_hash(newest.trace[None]))
    known = np.flatnonzero(np.isin(content_hash(dataset.X), hashes))
    first = int(known[-1]) + 1 if len(known) else 0
    left = len(dataset) - first
    if cycles > left:
        raise SettingError(
            f"Expected at most {left} cycles, got {cycles}: {first} of {len(dataset)} parts were played before."
        )
    return ReplayCell(dataset, np.arange(first, len(dataset))), f"recording {dataset.name} from part {first + 1}"


def _robot(source: DataChoice, host: str | None, **others: Any) -> tuple[Cell, str]:
    return open_robot(host, source), f"robot at {host}"


CELLS: dict[str, Callable[..., tuple[Cell, str]]] = {"simulated": _simulated, "replay": _recorded, "ur": _robot}


def _report(
    log: Replay, said: dict[str, Any], certificate: Certificate, cell: Cell, out: OutFolder | None, as_json: bool
) -> None:
    from ..experiments.figures import run_picture
    from ..experiments.tables import retrain_line

    total, stretches = log.stretch(), log.stretches(STRETCHES)
    clock = asdict(cell.report()) if hasattr(cell, "report") else None
    worst, recording = max((r.seconds for r in log.retrains), default=None), recording_record(cell)

    def save(out: OutFolder) -> None:
        out.table(log.to_frame().reset_index(), "run.csv")
        out.picture(run_picture(log, said["title"]), "run.png")

    with options.written(out, save) as files:
        if as_json:
            counts = {"total": total, "stretches": stretches, "cell": clock, "recording": recording, "files": files}
            retrains = {"retrains": log.retrains, "retrain_max_s": worst}
            write_json({"verb": "run"} | said | counts | retrains | {"certificate": certificate_record(certificate)})
            return
        timed = clock is not None
        rows = [_cells(row, timed) for row in (*stretches, total)]
        caption = CAPTION + (" good/h: good parts passed on an hour." if timed else "")
        show(figures(said["title"], rows, caption, total=True))
        show(*([] if clock is None else [_clock_line(clock)]), *([] if recording is None else [recording_line(recording)]))
        show(retrain_line(log.retrains), *map(_mode_line, said["safe_mode_changes"]), certificate.sentence)
        show(*(f"Wrote {path}" for path in files))


def _clock_line(clock: dict[str, Any]) -> str:
    """What the simulated clock says. Its seconds saved have the cost of stops and wrong rejects taken off already."""
    saved = clock["seconds_saved"]
    result = "nothing was saved" if abs(saved) < 0.5 else f"{abs(saved):.0f} s were {'saved' if saved > 0 else 'lost'}"
    silent = f" Bad parts that went on unnoticed: {clock['escapes']}." if clock["escapes"] else ""
    return (
        f"Simulated: {clock['parts_per_hour']:.1f} good parts an hour. Against verifying every part {result}; this counts "
        f"what stops ({clock['stops']}) and good parts sent back to the bin ({clock['sent_back']}) cost.{silent}"
    )


CAPTION = (
    "FP: bad parts accepted; stops: those of them that stopped the system. FN: good parts rejected. Both as far as the "
    "cell tells the truth about parts that were not verified. novel: parts verified for being unlike all known ones; safe: "
    "cycles of safe mode."
)


def _cells(row: dict[str, Any], timed: bool) -> dict[str, str]:
    names = {"accepted": "accepted", "FP": "false_positive", "stops": "stops", "rejected": "rejected"}
    names |= {"FN": "false_negative", "novel": "novel", "safe": "safe_mode"}
    cells = {"cycles": f"{row['first_cycle']} to {row['last_cycle']}", "verified": percent(row["verified_share"], ".0f")}
    cells |= {title: str(row[name]) for title, name in names.items()}
    rate = row["parts_per_hour"]
    return cells | ({"good/h": "-" if rate is None else f"{rate:.1f}"} if timed else {})
