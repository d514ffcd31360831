"""The subcommand `dengine run`: an engine drives a cell, and continues where its store ended.

`CELLS` has a function for each kind of cell: the parts of a recording, the simulated cell, or a
Universal Robots controller.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from typing import TYPE_CHECKING, Any
from zlib import crc32

import click

from ..errors import CellError, SettingError, expect, percent
from . import options
from .options import DataChoice, RecipeChoice, short_name, verb
from .output import (
    Out,
    Record,
    StepInterruptedError,
    as_json,
    certificate_record,
    exit_interrupted,
    explain_option,
    field_rows,
    interruptible_steps,
    legend_or_hint,
    print_result,
    table_of_rows,
)

if TYPE_CHECKING:
    from ..cells.base import Cell
    from ..engine.engine import DataEngine
    from ..experiments.replay import Replay
    from ..records import TraceSpec

    # The `TraceSpec` of a cell, and a function that makes the cell and its name for people.
    CellToDrive = tuple[TraceSpec, Callable[[DataEngine], tuple[Cell, str]]]

STRETCHES = 6  # rows of the table


@verb("dengine run --cell replay --cycles 100 --store run.db --alpha 0.1 --lower-bound 0.9")
@click.option(
    "--cell",
    "kind",
    type=click.Choice(("replay", "simulated", "ur")),
    default="replay",
    help=(
        "replay: the parts of --data, in their order. simulated: physics in MuJoCo. ur: a "
        "Universal Robots controller."
    ),
)
@click.option("--host", metavar="HOST[:PORT]", help="The robot's address, for --cell ur.")
@options.data_options(live=True)
@options.scenario_option
@options.check_option
@click.option(
    "--cycles",
    type=options.COUNT,
    default=300,
    help="Number of parts to insert, one in each cycle.",
)
@options.store_option("Keeps everything; without a store the run is forgotten.")
@options.recipe_options
@options.new_seed_option
@options.allow_import_option
@options.verify_all_option
@explain_option
@options.out_option("run.csv", "run.png")
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
    **cell_settings: Any,
) -> None:
    """Drive a robot cell: verify, learn, and verify less.

    With a store that was used the engine continues where it was, with the store's recipe (all
    settings of the engine); an option of the recipe that states another value is refused. The
    simulated cell then makes new parts, and a recording continues after its last part that was
    labelled or accepted: no part is learned from twice. A recording that has fewer parts left than
    --cycles is refused. A robot runs dengine/cells/ur/ur_cell.script, or a program with the same
    handshake; --trigger says when its traces begin, and --samples how long they are.

    If too many decisions are wrong, or too many traces are unlike all known ones, the engine enters
    safe mode: parts are verified until new outcomes allow decisions again. There is no safe mode by
    default, under --guarantee local (a part is judged by its neighbourhood alone) with --stops some
    (bad accepted parts may stay unreported). --shadow (verify every part) stays in force in the
    store, until `dengine policy STORE --shadow off`. At the end a table shows what was decided,
    what was wrong and what was saved. Ctrl-C or SIGTERM ends the run after the current cycle, and a
    second Ctrl-C at once; what was done is shown, and the exit code is 130. A second SIGTERM ends
    the process, and nothing is shown. If the cell fails, what was done is shown, too, and the exit
    code is 1.
    """
    if kind == "simulated":
        options.require_modules("the simulated cell", "sim", "mujoco")
    from ..engine.engine import DataEngine
    from ..engine.settings import agreed_trace_spec
    from ..store.opening import opening

    recipe = choice.load_if_given(store)
    spec, make_cell = CELLS[kind](cycles=cycles, **cell_settings)
    with opening(store) as opened_store:
        opened = DataEngine.open_or_create(
            opened_store,
            seed,
            recipe=recipe,
            trace=agreed_trace_spec(opened_store, spec),
            allow_import=allow_import,
        )
    with ExitStack() as stack, opened as engine:
        if shadow:
            engine.set_shadow(True)
        cell, name = make_cell(engine)
        stack.callback(getattr(cell, "close", lambda: None))
        replay, changes, failure = _drive(engine, cell, cycles, name)
        record: Record = {
            "check_seconds": check_seconds,
            "safe_mode": engine.safe_mode,
            "safe_mode_changes": changes,
            "certificate": certificate_record(engine.certificate()),
        }
    n_done = len(replay)
    if n_done:
        resumed = ", resumed" if engine.resumed else ""
        record |= {
            "title": f"{name}, {short_name(engine.recipe.name)}{resumed}",
            "simulated": kind == "simulated",
            "interrupted": n_done < cycles,
        }
        _print_run(replay, record, cell, out)
    n_left = cycles - n_done
    kept = "Nothing was stored: --store FILE keeps a run, so that it can be continued."
    if store is not None:
        # The files of the cycles that were done cannot be made again.
        new_folder = " and another folder for --out" if out and n_done else ""
        kept = (
            f"Everything up to cycle {n_done} is in {store}; the same command with --cycles "
            f"{n_left}{new_folder} continues there."
        )
    if failure is not None:
        raise CellError(f"{failure} {n_done} of {cycles} cycles were done. {kept}") from failure
    if n_left:
        shown = "the table shows those" if n_done else "there is nothing to show"
        exit_interrupted(f"Interrupted: {n_done} of {cycles} cycles were done; {shown}.", kept)


def _drive(
    engine: DataEngine, cell: Cell, cycles: int, name: str
) -> tuple[Replay, list[Record], CellError | None]:
    """Let the engine drive the robot cell; return its cycles, changes of safe mode, and an error.

    In safe mode, after an alarm, every part is verified until outcomes allow decisions again.
    Returned are the record of the finished cycles (one part in each), the changes of safe mode, and
    the CellError that ended the run if the cell failed, which is not raised, else None; other
    errors are raised. A change has the `cycle` after which safe mode began or ended, and its
    `reason`, "" if it ended.

    The run ends after `cycles` parts, or after the current one at Ctrl-C or SIGTERM; a second
    Ctrl-C ends the run at once, without its last cycle, and a second SIGTERM ends the process. A
    progress bar named `name` is shown. When safe mode begins or ends, a line is printed to stderr,
    unless `--json`.
    """
    from ..experiments.replay import ObservedCycle, observe_cycles, to_replay

    observed = list[ObservedCycle]()
    changes = list[Record]()
    reason = engine.safe_mode
    failure = None
    try:
        # A second Ctrl-C ends even a cycle that does not end; the cycles before it are known.
        with (
            suppress(StepInterruptedError, KeyboardInterrupt),
            interruptible_steps(name, cycles) as count,
        ):
            for cycle, truth in observe_cycles(engine, cell, cycles):
                observed.append((cycle, truth))
                if cycle.safe_mode != reason:
                    reason = cycle.safe_mode
                    changes.append({"cycle": cycle.index + 1, "reason": reason})
                    if not as_json():
                        click.echo(_safe_mode_line(changes[-1]), err=True)
                count(1)  # may end the run here, between two cycles
    except CellError as error:
        failure = error
    return to_replay(observed, engine.recipe), changes, failure


def _safe_mode_line(change: Record) -> str:
    """Return a sentence: after which cycle safe mode began, and why, or that it ended.

    In safe mode, after an alarm, every part is verified. `change` has `cycle`, the number of the
    cycle (the work on one part), and the `reason`, "" if safe mode ended.
    """
    event = "safe mode ended"
    if change["reason"]:
        event = f"safe mode, parts are verified until outcomes allow decisions: {change['reason']}"
    return f"After cycle {change['cycle']}: {event}."


def _simulated_cell(scenario: str, cycles: int, source: DataChoice, **others: Any) -> CellToDrive:
    """Return the `TraceSpec` of the simulated cell, and a function that makes the robot cell.

    A `TraceSpec` says what shape, rate and unit traces have. It is the simulation's own, or what
    the options of `source` state; rate, unit and names of channels that these leave out are then
    the simulation's, if the shape is the same. The function takes the engine, and returns the cell
    and its name. The cell's seed depends on the engine's seed, on the number of decisions in the
    store, and in a product (cells that share labels) also on the cell, so that no part comes twice.
    `scenario` says what changes in the course of the `cycles`; for an unknown one SettingError is
    raised when the cell is made. `others` are settings of other kinds of cell, and are ignored.
    Raises what `trace_spec_from` raises.
    """
    from ..cells.simulation.cell import SimulatedCell

    def make(engine: DataEngine) -> tuple[Cell, str]:
        """Return the simulated cell for this engine's store, and its name; SettingError for an
        unknown scenario.
        """
        store = engine.store
        # Another seed for a resumed run: the same parts again would be counted twice.
        seed = engine.seed + store.decisions.counts()["decisions"]
        if store.product is not None:
            # The cells of one product have one seed, but each makes other parts.
            seed += crc32(store.cell_id.encode())
        return (
            SimulatedCell(scenario=scenario, seed=seed, cycles=cycles),
            f"simulated cell, {scenario}",
        )

    stated = options.trace_spec_from(source.options)
    spec = SimulatedCell.spec if stated is None else stated.completed(SimulatedCell.spec)
    return spec, make


def _replay_cell(source: DataChoice, cycles: int, host: str | None, **others: Any) -> CellToDrive:
    """Return the `TraceSpec` of a recording, and a function that makes a robot cell which plays it.

    A `TraceSpec` says what shape, rate and unit traces have. The recording is the data set of
    `source`, and is loaded at once. The function takes the engine, and returns the cell and its
    name. click.UsageError is raised for a `host`, or if `source` has an option of live traces, and
    SettingError for more `cycles` than parts. The cell begins after the last part that was played
    before. A part was played before if its trace equals one that has a label of this cell in the
    store (but no label that a person withdrew, and no trace with a fault), or that of this cell's
    newest accepted part without a report. Making the cell raises SettingError if fewer parts than
    `cycles` are left, and StoreError if the store cannot be read or the trace of that accepted part
    is damaged. `others` are ignored. Raises the errors of `DataChoice.load`.
    """
    import numpy as np

    from ..cells.replay import ReplayCell
    from ..folds import content_hash

    if host or source.options.keys() - {"channels", "samples"}:
        raise click.UsageError(
            "--cell replay takes rate, unit and length from the recordings; --host, --trigger, "
            "--rate-hz, --unit and --fit are for --cell ur or simulated."
        )
    dataset = source.load()
    expect(cycles <= len(dataset), f"--cycles of at most {len(dataset)}", cycles)

    def make(engine: DataEngine) -> tuple[Cell, str]:
        """Return the parts after the last one that this engine's store knows as a robot cell, and
        its name; SettingError if fewer than `cycles` are left.
        """
        store = engine.store
        # By the content of the traces: the store's own hash is one number for a part that comes
        # twice.
        hashes = content_hash(store.labels.with_traces(cell_only=True).traces)
        for id_ in store.decisions.unreported_accepts()[-1:]:
            newest = store.decisions.get(id_)
            if newest is not None:
                hashes = np.append(hashes, content_hash(newest.trace[None]))
        played = np.flatnonzero(np.isin(content_hash(dataset.X), hashes))
        first = int(played[-1]) + 1 if len(played) else 0
        n_left = len(dataset) - first
        expect(
            cycles <= n_left,
            f"--cycles of at most {n_left}",
            cycles,
            f"{first} of {len(dataset)} parts were played before",
        )
        return (
            ReplayCell(dataset, np.arange(first, len(dataset))),
            f"recording {dataset.name} from part {first + 1}",
        )

    return dataset.spec, make


def _robot_cell(source: DataChoice, host: str | None, **others: Any) -> CellToDrive:
    """Connect to a robot; return its `TraceSpec`, and a function that returns its cell.

    A `TraceSpec` says what shape, rate and unit traces have. The robot is a Universal Robots
    controller at `host`, HOST or HOST:PORT. The options of `source` say what is recorded, and when;
    `others` are settings of other kinds of robot cell, and are ignored. The function takes the
    engine, which it ignores, and returns the cell and its name. The cell's `close` ends the
    connection. It is connected before a store is made, because a new store keeps the settings that
    it is made with.

    Raises
    ------
    SettingError
        No host, a port that is no number, values that no trace can have, or a trigger or a channel
        that cannot be used.
    CellError
        The controller cannot be reached, or its program is not ready in time.
    """
    from ..cells.ur.cell import UrCell

    if not host:
        raise SettingError(
            "Expected the robot's address for --cell ur, as in --host 192.168.1.10, got none."
        )
    settings, spec = options.recorder_settings(source.options)
    if "trigger" in source.options:
        settings["trigger"] = source.options["trigger"]
    name, port = host_and_port(host)
    cell = UrCell(name, port=port, **settings)
    return spec, lambda engine: (cell, f"robot at {host}")


def host_and_port(address: str) -> tuple[str, int]:
    """Split HOST[:PORT] of a robot controller, and return both; the default of PORT is 30004.

    HOST may come back empty, for an `address` without one.

    Raises
    ------
    SettingError
        The port is not a number, like in an IPv6 address; whether it is in range is not checked,
        nor is the host.
    """
    from ..cells.ur.protocol import PORT

    host, _, port = address.partition(":")
    expect(not port or port.isdecimal(), "a host, or host:port", address)
    return host, int(port) if port else PORT


CELLS: dict[str, Callable[..., CellToDrive]] = {
    "simulated": _simulated_cell,
    "replay": _replay_cell,
    "ur": _robot_cell,
}
CAPTION = (
    "FP: bad parts accepted; stops: those of them that stopped the system. FN: good parts "
    "rejected. FP and FN count as far as the cell tells the truth about parts that were not "
    "verified. novel: parts verified because they are unlike all known ones; safe: cycles of safe "
    "mode; outside: parts beyond the force limits, verified or rejected."
)
COLUMNS = {  # title -> count of a stretch
    "accepted": "accepted",
    "FP": "false_positive",
    "stops": "stops",
    "rejected": "rejected",
    "FN": "false_negative",
    "novel": "novel",
    "safe": "safe_mode",
    "outside": "outside",
}


def _print_run(replay: Replay, record: Record, cell: Any, out: Out | None) -> None:
    """Print the result of a run: a table of stretches, the cell's own report, and sentences.

    A stretch is a number of consecutive cycles, each with one part. The cell's own report is shown
    if the robot cell has a method `report`. The sentences say how much time was saved (the checks
    left out, less 120 s for each accepted part that stopped the line and 47.5 s for each rejected
    good part), how the retrains went, when safe mode (every part is verified) began and ended, and
    what share of the accepted parts was bad at most (the certificate). The counts are added to
    `record`, which has the rest, in place, and `--json` prints it in place of all that. run.csv and
    run.png are written to `out`, if it is given; OutputError, if that fails, is raised after the
    printing.
    """
    from ..experiments.figures import curves
    from ..experiments.metrics import Costs
    from ..experiments.tables import retrain_line, table_of_numbers

    total = replay.stretch()
    stretches = replay.stretches(STRETCHES)
    cell_report = cell.report() if hasattr(cell, "report") else None
    parts: list[Any] = [
        table_of_numbers(
            record["title"],
            [_stretch_cells(stretch, total) for stretch in (*stretches, total)],
            legend_or_hint(CAPTION),
            total=True,
        )
    ]
    if cell_report is not None:
        parts.append(table_of_rows("What the cell reports", field_rows(cell_report)))
    n_certain = total["accepted"] + total["rejected"]
    costs = Costs(record["check_seconds"])
    net = costs.saved(n_certain, total["stops"], total["false_negative"])
    parts += [
        f"{n_certain} checks of {costs.check:g} s were left out; less {costs.escape:g} s a stop "
        f"and {costs.false_reject:g} s a good part sent back that saved {net:,.0f} s.",
        retrain_line(replay.retrains),
        *map(_safe_mode_line, record["safe_mode_changes"]),
        record["certificate"]["sentence"],
    ]
    record |= {
        "total": total | {"net_s": net},
        "stretches": stretches,
        "cell": cell_report,
        "retrains": replay.retrains,
        "retrain_max_s": max((retrain.seconds for retrain in replay.retrains), default=None),
    }
    print_result(
        record,
        *parts,
        out=out,
        make_files=lambda: {
            "run.csv": replay.to_frame().reset_index(),
            "run.png": curves({"this run": [replay]}, record["title"]),
        },
    )


def _stretch_cells(stretch: Mapping[str, Any], total: Mapping[str, Any]) -> dict[str, str]:
    """Return a table row, title -> cell, for the counts of a stretch of cycles.

    A stretch is a number of consecutive cycles, and a cycle handles one part. `stretch` and
    `total`, the counts of the whole run, are as `Replay.stretch` returns them. The cells are its
    first and last cycle, the share of verified parts in whole percent, and the counts in `COLUMNS`,
    such as accepted, rejected and wrongly decided parts and line stops. Parts outside the force
    limits that an operator set have no column if there were none in the whole run.
    """
    cells = {
        "cycles": f"{stretch['first_cycle']} to {stretch['last_cycle']}",
        "verified": percent(stretch["verified_share"], ".0f"),
    }
    for title, name in COLUMNS.items():
        if name != "outside" or total[name]:
            cells[title] = str(stretch[name])
    return cells
