"""The loop over a cell: insert, decide, then verify, go on or reject, report. Source: the paper's section "Data engine"."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from .cells.base import Cell
from .deciding import source_of
from .labels import as_outcome, as_success
from .records import Action, Cycle, Outcome

if TYPE_CHECKING:
    from .engine import DataEngine

KNOWN = {Outcome.STOPPED: False, Outcome.CONFIRMED: True}  # silence is not a success


def drive(engine: DataEngine, cell: Cell, cycles: int) -> Iterator[Cycle]:
    """Let an engine drive a cell; a record a cycle. What is known is written when the loop ends, whatever ends it.

    A cell that knows its parts' numbers tells that of the part it inserted last as `part`.
    """
    try:
        for index in range(cycles):
            yield _cycle(engine, cell, index)
    finally:
        engine.flush()


def _cycle(engine: DataEngine, cell: Cell, index: int) -> Cycle:
    trace = cell.insert()
    begin = engine.clock()
    decision = engine.decide(trace, getattr(cell, "part", None))
    seconds = engine.clock() - begin
    outcome, success, source = None, None, None
    if decision.action is Action.VERIFY:
        success = as_success(cell.verify(), f"decision {decision.id}, by verify()")
    elif decision.action is Action.ACCEPT:
        outcome = as_outcome(cell.proceed(), f"decision {decision.id}, by proceed()")
        success = KNOWN.get(outcome)
    else:
        cell.reject()
    if success is not None:
        source = source_of(decision.id, decision.action, decision.audit, success)
        engine.report(decision.id, success)
    return Cycle(index, decision, outcome, success, source, seconds, engine.settle(), engine.safe_mode)
