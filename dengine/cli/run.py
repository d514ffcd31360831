"""`dengine run`: an engine drives a cell, and goes on where its store left off."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any
from zlib import crc32

import click

from ..errors import CellError, SettingError, expect, percent
from . import options, output
from .options import DataChoice, RecipeChoice, short_name, verb
from .output import EndAskedError, Out, as_json, certificate_record, end_interrupted, facts, rows_of, steps, tell, written

if TYPE_CHECKING:
    from ..cells.base import Cell
    from ..engine.engine import DataEngine
    from ..experiments.replay import Replay
    from ..records import TraceSpec
    from ..store.sql import SqlStore

Driven = tuple["Cell", str, "TraceSpec | None"]  # what is driven, what it is called, and the form of its traces
STRETCHES = 6
KINDS = "replay: the parts of --data, in their order. simulated: physics in MuJoCo. ur: a Universal Robots controller."


@verb("dengine run --cell replay --cycles 100 --store engine.db --alpha 0.1 --lower-bound 0.9")
@click.option(
    "--cell", "kind", type=click.Choice(("replay", "simulated", "ur")), default="replay", show_default=True, help=KINDS
)
@click.option("--host", metavar="HOST[:PORT]", help="The robot's address, for --cell ur.")
@options.data_options()
@options.scenario_option
@options.check_option
@click.option("--cycles", type=options.COUNT, default=300, show_default=True, help="Parts to insert, one a cycle.")
@options.store_option("Remembers everything; without one the run is forgotten.")
@options.recipe_options
@options.new_seed_option
@options.allow_import_option
@click.option("--shadow", is_flag=True, help="Verify every part; the model only says what it would have done.")
@output.explain_option
@options.out_option
def run(
    choice: RecipeChoice,
    kind: str,
    cycles: int,
    store: str | None,
    seed: int | None,
    shadow: bool,
    allow_import: bool,
    check_seconds: float,
    out: Out | None,
    **cell_of: Any,
) -> None:
    """Drive a cell: verify, learn, and verify less.

    With a store that exists the engine goes on where it was. The simulated cell then makes new parts, and a recording goes
    on after its last part that was labelled or accepted: no part is learned from twice. A robot runs
    training/ur_cell.script, or a program of the same handshake; --trigger and --samples say what is recorded of it.
    Where too much goes wrong, or looks like nothing known, everything is verified until fresh evidence says otherwise: the
    safe mode. Ctrl-C or SIGTERM ends the run after the cycle that is under way and shows what was done; twice, at once.
    """
    if kind == "simulated":
        options.must_have("the simulated cell", "sim", "mujoco")
    from ..engine.engine import DataEngine, core_of

    used = DataEngine.open_or_create(store, seed, recipe=choice.if_asked(), allow_import=allow_import)
    with ExitStack() as opened, used as engine:
        if shadow:
            engine.set_shadow(True)
        cell_of |= {"store": engine.store, "seed": engine.seed, "cycles": cycles, "check_s": check_seconds}
        cell, name, form = CELLS[kind](**cell_of)
        if form is not None:
            core_of(engine).set_trace_spec(form)
        opened.callback(getattr(cell, "close", lambda: None))
        log, changes, failure = _drive(engine, cell, cycles, name)
        said: dict[str, Any] = {"check_seconds": check_seconds, "safe_mode": engine.safe_mode, "safe_mode_changes": changes}
        certificate = engine.certificate()
    title = f"{name}, {short_name(engine.recipe.name)}{', resumed' if engine.resumed else ''}"
    if len(log):
        said |= {"title": title, "simulated": kind == "simulated", "interrupted": len(log) < cycles}
        _report(log, said | {"certificate": certificate_record(certificate)}, cell, out)
    left = cycles - len(log)
    kept = f"Everything up to cycle {len(log)} is in {store}; the same command with --cycles {left} goes on there."
    if store is None:
        kept = "Nothing was stored: --store FILE keeps a run, and goes on with it."
    if failure is not None:
        raise CellError(f"{failure} {len(log)} of {cycles} cycles were done. {kept}") from failure
    if left:
        shown = "the table shows those" if len(log) else "there is nothing to show"
        end_interrupted(f"Interrupted: {len(log)} of {cycles} cycles were done; {shown}.", kept)


def _drive(engine: DataEngine, cell: Cell, cycles: int, name: str) -> tuple[Replay, list[dict[str, Any]], CellError | None]:
    """What was done, when the safe mode began or ended, and what ended the run, where the cell failed."""
    from ..experiments.replay import Seen, follow, gather

    seen, changes, mode, failure = list[Seen](), list[dict[str, Any]](), engine.safe_mode, None
    try:
        # Pressed twice, Ctrl-C ends even a cycle that does not end; what was done before it is known.
        with suppress(EndAskedError, KeyboardInterrupt), steps(name, cycles) as count:
            for each in follow(engine, cell, cycles):
                seen.append(each)
                if each.cycle.safe_mode != mode:
                    mode = each.cycle.safe_mode
                    changes.append({"cycle": each.cycle.index + 1, "reason": mode})
                    if not as_json():
                        click.echo(_mode_line(changes[-1]), err=True)
                count(1)  # which may end the run, between two cycles: no part is left half dealt with
    except CellError as error:
        failure = error
    return gather(seen, engine.recipe), changes, failure


def _mode_line(change: Mapping[str, Any]) -> str:
    """After which cycle the safe mode began, for a reason; or ended, for none."""
    what = f"safe mode, every part is verified: {change['reason']}" if change["reason"] else "safe mode ended"
    return f"After cycle {change['cycle']}: {what}."


def _simulated(
    store: SqlStore, seed: int, scenario: str, cycles: int, check_s: float, source: DataChoice, **others: Any
) -> Driven:
    from ..cells.simulation.cell import SimulatedCell
    from ..cells.simulation.conditions import CellParameters

    # Another seed for a resumed run: the same parts again would be counted twice.
    seed += store.status()["decisions"]
    if store.product is not None:  # peers have one seed, and parts of their own all the same
        seed += crc32(store.cell_id.encode())
    cell = SimulatedCell(scenario=scenario, seed=seed, cycles=cycles, parameters=CellParameters(verify_s=check_s))
    return cell, f"simulated cell, {scenario}", options.trace_of(source.how)


def _recorded(store: SqlStore, source: DataChoice, cycles: int, **others: Any) -> Driven:
    import numpy as np

    from ..cells.replay import ReplayCell
    from ..folds import content_hash

    dataset = source.load()
    # By content: of a part that comes twice the store's own hash would name both.
    played = store.labelled(cell_only=True)
    hashes = content_hash(played.traces)
    for id_ in store.unreported_accepts()[-1:]:
        newest = store.get_decision(id_)
        hashes = hashes if newest is None else np.append(hashes, content_hash(newest.trace[None]))
    known = np.flatnonzero(np.isin(content_hash(dataset.X), hashes))
    first = int(known[-1]) + 1 if len(known) else 0
    left = len(dataset) - first
    expect(cycles <= left, f"at most {left} cycles", cycles, f"{first} of {len(dataset)} parts were played before")
    cell = ReplayCell(dataset, np.arange(first, len(dataset)))
    return cell, f"recording {dataset.name} from part {first + 1}", dataset.spec


def _robot(source: DataChoice, host: str | None, **others: Any) -> Driven:
    from ..cells.ur.cell import UrCell

    if not host:
        raise SettingError("Expected the robot's address for --cell ur, as in --host 192.168.1.10, got none.")
    how = options.recorded_as(source.how) | options.given(trigger=source.how.get("trigger"))
    name, port = host_and_port(host)
    cell, said = UrCell(name, port=port, **how), {each: source.how[each] for each in ("unit", "fit") if each in source.how}
    return cell, f"robot at {host}", replace(cell.recorder.spec, **said)


def host_and_port(address: str) -> tuple[str, int]:
    """A controller's host, and its port, RTDE's where none is named; SettingError for what is no port."""
    from ..cells.ur.protocol import PORT

    host, _, port = address.partition(":")
    expect(not port or port.isdecimal(), "a host, or host:port", address)
    return host, int(port) if port else PORT


CELLS: dict[str, Callable[..., Driven]] = {"simulated": _simulated, "replay": _recorded, "ur": _robot}
CAPTION = (
    "FP: bad parts accepted; stops: those of them that stopped the system. FN: good parts rejected. Both as far as the "
    "cell tells the truth about parts that were not verified. novel: parts verified for being unlike all known ones; safe: "
    "cycles of safe mode; outside: parts that left a window, verified or rejected; good/h: good parts passed on an hour."
)
COLUMNS = {"accepted": "accepted", "FP": "false_positive", "stops": "stops", "rejected": "rejected"}
COLUMNS |= {"FN": "false_negative", "novel": "novel", "safe": "safe_mode", "outside": "outside"}


def _report(log: Replay, said: dict[str, Any], cell: Any, out: Out | None) -> None:
    """Tell what a run did, and what a robot's cell says of its recordings."""
    from ..experiments.figures import run_picture
    from ..experiments.metrics import Costs
    from ..experiments.tables import figures, retrain_line

    total, stretches = log.stretch(), log.stretches(STRETCHES)
    about = cell.report() if hasattr(cell, "report") else None
    rows = []
    for row in (*stretches, total):
        between = f"{row['first_cycle']} to {row['last_cycle']}"
        cells = {"cycles": between, "verified": percent(row["verified_share"], ".0f")}
        cells |= {title: str(row[name]) for title, name in COLUMNS.items() if name != "outside" or total[name]}
        if total["parts_per_hour"] is not None:
            cells["good/h"] = written("", row["parts_per_hour"])
        rows.append(cells)
    lines: list[Any] = [] if about is None else [facts("What the cell says of it", rows_of(about))]
    certain, costs = total["accepted"] + total["rejected"], Costs(said["check_seconds"])
    net = costs.saved(certain, total["stops"], total["false_negative"])
    lost = f"{costs.escape:g} s a stop and {costs.false_reject:g} s a good part sent back"
    lines += [f"{certain} checks of {costs.check:g} s were left out; less {lost} that saved {net:,.0f} s."]
    lines += [retrain_line(log.retrains), *map(_mode_line, said["safe_mode_changes"]), said["certificate"]["sentence"]]
    worst = max((each.seconds for each in log.retrains), default=None)
    said |= {"total": total | {"net_s": net}, "stretches": stretches, "cell": about}
    tell(
        said | {"retrains": log.retrains, "retrain_max_s": worst},
        figures(said["title"], rows, output.explained(CAPTION), total=True),
        *lines,
        out=out,
        made=lambda: {"run.csv": log.to_frame().reset_index(), "run.png": run_picture(log, said["title"])},
    )
