"""What a robot's program may call, in the few types that it knows: int, bool, float, string, list, and a struct of these.
A controller that has base64 sends a trace as bytes, raw float32, little-endian: a tenth of the time that its numbers take.

    id = begin()                      # a new part; the recorder waits for its insertion
    answer = decide_recorded(id)      # answer.action: 0 verify, 1 accept, 2 reject
    kept = report(id, True)

What is the world's fault (a full line, a recording that did not come, a store that is away) is answered, by "verify" and by
False: a fault ends a robot's program. What is the caller's bug (a wrong type, another trace under a known id) is a fault.
"""

import asyncio
import logging
import uuid
from collections import OrderedDict
from collections.abc import Awaitable, Callable
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import BusyError, DengineError, SettingError, StoreError, TraceError, UnknownDecisionError, expect, shortened
from ..records import ACTIONS, Action, Decision, as_id
from .api import as_samples
from .service import CellService

log = logging.getLogger("dengine")
PATIENCE = 1.0  # seconds that a recording may take to arrive after the insertion
OPEN = 8  # parts whose pieces are on their way; one more gives up the oldest
SAMPLES = 200_000  # of all pieces of a part
BUSY, NOT_RECORDED = "busy", "not_recorded"  # beside the names in `Reason`: nothing of the part is known

CALLS = "begin", "add", "decide", "decide_added", "decide_recorded", "action", "action_added", "action_recorded"
Answered = dict[str, Any]
Call = Callable[..., Awaitable[Any]]


class Recorder(Protocol):
    """Cuts insertions out of what a robot sends, as `RtdeRecorder` does; its calls may block."""

    def arm(self) -> None:
        """Look for an insertion from now on."""

    def record(self, timeout: float) -> Any:
        """The next insertion, whose `trace` is (T,) or (C, T), NaN where none came; an error after `timeout` seconds."""


class RobotCalls:
    """The calls by name, over one service. recorder : of the traces of `decide_recorded`; None: there is none."""

    def __init__(self, service: CellService, recorder: Recorder | None = None) -> None:
        self._service, self._recorder = service, recorder
        self._pieces: OrderedDict[str, list[NDArray[np.float32]]] = OrderedDict()
        self._armed: str | None = None
        self._recording = asyncio.Lock()  # one insertion at a time

    def table(self) -> dict[str, Call]:
        """Each call by its name; its signature says which arguments it takes."""
        return {name: getattr(self, name) for name in (*CALLS, "report", "status")}

    async def begin(self, request: Any = "") -> str:
        """A new part: its id, a new one or the caller's. The recorder waits for its insertion from now on."""
        id_ = uuid.uuid4().hex if request == "" else as_id(request)
        self._pieces.pop(id_, None)
        self._pieces[id_] = []
        while len(self._pieces) > OPEN:
            self._pieces.popitem(last=False)
        if self._recorder is not None:
            async with self._recording:
                self._armed = None
                try:
                    await asyncio.to_thread(self._recorder.arm)
                    self._armed = id_
                except (DengineError, OSError) as error:  # the part will be verified
                    log.warning("the recorder does not listen: %s", error)
        return id_

    async def add(self, request: Any, samples: Any) -> int:
        """A piece of a part's trace, one channel, in order; how many samples there are by now."""
        pieces = self._pieces.get(as_id(request))
        if pieces is None:
            kept = f"the newest {OPEN} parts are kept"
            raise TraceError(f"Expected begin before add, got pieces of {shortened(request)}; {kept}.")
        piece = as_samples(samples)[0] if isinstance(samples, bytes) else as_samples(samples)
        if piece.ndim != 1:
            raise TraceError("Expected a piece of one channel, a list of numbers; use decide for several channels.")
        n = sum(map(len, pieces)) + len(piece)
        expect(n <= SAMPLES, f"at most {SAMPLES} samples of a part", n, error=TraceError)
        pieces.append(piece)
        return n

    async def decide(self, trace: Any, request: Any = "", part: Any = "") -> Answered:
        """Decide on a whole trace, (T,) or (channels, T), of lists; or of one channel, as bytes."""
        return await self.decide_on(as_samples(trace), request, part)

    async def decide_added(self, request: Any, part: Any = "") -> Answered:
        """Decide on the pieces that were added; asked again, the answer is the same."""
        if (known := await self._known(request)) is not None:
            return known
        pieces = self._pieces.get(as_id(request))
        if not pieces:
            raise TraceError(f"Expected begin and add before decide_added, got no pieces of {shortened(request)}.")
        answer = await self.decide_on(np.concatenate(pieces), request, part)
        if answer["id"]:
            self._pieces.pop(request, None)
        return answer

    async def decide_recorded(self, request: Any = "", part: Any = "") -> Answered:
        """Decide on the insertion since `begin`, as the recorder has it; asked again, the answer is the same.

        request : as `begin` gave it; left out, the newest one's.
        """
        if self._recorder is None:
            raise SettingError("Expected a recorder, got none; start the server with --robot, or send the trace.")
        async with self._recording:
            id_ = self._armed if request == "" else as_id(request)
            if id_ is not None and (known := await self._known(id_)) is not None:
                return known
            if id_ is None or id_ != self._armed:  # another part's, or the server was started anew meanwhile
                return _unknown(NOT_RECORDED)
            try:
                recording = await asyncio.to_thread(self._recorder.record, PATIENCE)
            except (DengineError, OSError) as error:
                log.warning("no recording of %s: %s", shortened(id_), error)
                return _unknown(NOT_RECORDED)
            finally:
                self._armed = None
            return await self.decide_on(recording.trace, id_, part)

    async def action(self, trace: Any, request: Any, part: Any = "") -> int:
        """`decide`, answered by its action alone, for a controller that knows no structs; so are the next two."""
        return int((await self.decide(trace, request, part))["action"])

    async def action_added(self, request: Any, part: Any = "") -> int:
        """`decide_added`, answered by its action alone."""
        return int((await self.decide_added(request, part))["action"])

    async def action_recorded(self, request: Any, part: Any = "") -> int:
        """`decide_recorded`, answered by its action alone."""
        return int((await self.decide_recorded(request, part))["action"])

    async def decide_on(self, trace: ArrayLike, request: Any, part: Any) -> Answered:
        """Decide on a trace as an array; an empty request or part is none."""
        id_ = as_id(request) if request != "" else None
        try:
            answer = await self._service.decide(trace, id_, None if part == "" else part)
        except (BusyError, StoreError) as error:
            log.warning("verified without a record: %s", error)
            return _unknown(BUSY)
        return _answered(answer.decision)

    async def report(self, decision_id: Any, success: Any) -> bool:
        """What became of a part, True for good. False: nothing was recorded under this id, or it cannot be kept now."""
        if decision_id == "":  # as `decide_recorded` gave it
            return False
        try:
            await self._service.report(decision_id, success)
        except UnknownDecisionError:
            return False
        except (BusyError, StoreError) as error:
            log.warning("a report on %s was not kept: %s", shortened(decision_id), error)
            return False
        return True

    async def status(self) -> Answered:
        """How the cell is doing, in a dozen plain numbers and texts; no decision waits for it.

        verified_share : of the newest decisions; 1 where there is none.  late, busy : deadlines exceeded, requests refused.
        bad : accepted parts that are known to have been bad.  safe_mode, alarm : why, or "".  waiting : requests in line.
        """
        service, found = self._service, await self._service.status()
        share, ever = found.newest.verified_share, found.ever
        return {
            "decisions": ever.decisions,
            "verified_share": 1.0 if share is None else share,
            "accepted": ever.accepted,
            "rejected": ever.rejected,
            "bad": ever.false_accepts,
            **{name: getattr(found, name) for name in ("version", "safe_mode", "shadow", "alarm")},
            **{name: getattr(service, name) for name in ("waiting", "late", "busy")},
        }

    async def _known(self, request: Any) -> Answered | None:
        try:
            known = await self._service.find(as_id(request))
        except (BusyError, StoreError):
            return None
        return None if known is None else _answered(known.decision)


def one_line(text: str) -> str:
    """What is told of a refused call, of characters that print."""
    return "".join(c if c.isprintable() else " " for c in text)[:300]


def _answered(decision: Decision) -> Answered:
    return {
        "action": ACTIONS.index(decision.action),
        "id": decision.id,
        "reason": str(decision.reason),
        "lower": decision.lower,
        "upper": decision.upper,
        "version": decision.model_version,
    }


def _unknown(reason: str) -> Answered:
    """Verify; nothing was recorded, so there is no id to report on."""
    return {"action": ACTIONS.index(Action.VERIFY), "id": "", "reason": reason, "lower": 0.0, "upper": 1.0, "version": 0}
