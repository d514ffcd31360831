"""What a PLC, a SCADA and a robot's program may want to know of the cell, in a dozen plain numbers and texts."""

from __future__ import annotations

from dataclasses import dataclass

from ..engine import DataEngine
from ..standing import Standing, standing
from .service import CellService


@dataclass(frozen=True, slots=True)
class Overview:
    """How the cell is doing.

    decisions, accepted, rejected : since its birth.  verified_share : of the newest 500 decisions; 1 where there is none.
    bad : accepted parts that are known to have been bad, since its birth.
    version : of the model that answers; 0 before the first retrain.
    safe_mode : why everything is verified; "" where it is not.
    shadow : everything is verified, and the model only says what it would have done.
    waiting : requests in line.  late, busy : answers that came too late, and requests that were refused, since the start.
    alarm : what somebody should look at, a line; "" where there is nothing.
    """

    decisions: int
    verified_share: float
    accepted: int
    rejected: int
    bad: int
    version: int
    safe_mode: str
    shadow: bool
    waiting: int
    late: int
    busy: int
    alarm: str


async def overview(service: CellService) -> Overview:
    """How the cell is doing, by its store; no decision waits for it, but where the engine remembers in memory alone."""
    engine = service.engine
    doing = await service.read(lambda store: standing(store, engine.recipe))
    share = doing.newest.share(doing.newest.verified)
    return Overview(
        decisions=doing.ever.decisions,
        verified_share=1.0 if share is None else share,
        accepted=doing.ever.accepted,
        rejected=doing.ever.rejected,
        bad=doing.ever.bad_accepts.stops,
        version=engine.version,
        safe_mode=engine.safe_mode,
        shadow=engine.shadow,
        waiting=service.waiting,
        late=service.late,
        busy=service.busy,
        alarm=alarm(engine, doing),
    )


def alarm(engine: DataEngine, doing: Standing) -> str:
    """What somebody should look at, the worst first; "" where there is nothing."""
    newest, accepts = doing.newest, doing.newest.bad_accepts
    alarms = (
        (engine.store_fault, f"The store cannot be written: {engine.store_fault}"),
        (engine.safe_mode, f"Safe mode: {engine.safe_mode}"),
        (accepts.verdict == "broken", f"More accepted parts are bad than the tolerance of {accepts.tolerance:.1%} allows."),
        (newest.errors, f"The model failed on {newest.errors} of the newest decisions."),
    )
    return next((text for wrong, text in alarms if wrong), "")
