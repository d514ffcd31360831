"""`RobotCalls`: the methods that a robot's program or a PLC can call, over XML-RPC and OPC UA.

They use only the types that such programs have: int, bool, float, string, list, and a struct of
these. A controller that has base64 sends a trace as bytes, raw float32, little-endian, in a tenth
of the time that numbers take.

    id = begin()                      # a new part; the recorder waits for its insertion
    answer = decide_recorded(id)      # answer.action: 0 verify, 1 accept, 2 reject
    kept = report(id, True)

A fault would end a robot's program. So the response to a full queue, a recording that did not come
or an unavailable store is "verify" or False. Only the caller's errors (a wrong type, another trace
under a used id) are faults.
"""

from __future__ import annotations

import asyncio
import uuid
from collections import OrderedDict
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ..errors import (
    BusyError,
    DengineError,
    SettingError,
    StoreError,
    TraceError,
    UnknownDecisionError,
    expect,
    log,
    shortened,
)
from ..records import ACTIONS, Decision, TraceArray, as_id
from .api import as_samples
from .service import CellService

if TYPE_CHECKING:
    from ..cells.ur.recorder import RtdeRecorder

RECORD_SECONDS = 1.0  # for a recording to be complete after the insertion
MAX_PARTS = 8  # parts whose pieces of a trace are kept; the oldest is given up for one more
MAX_SAMPLES = 200_000  # of all pieces of a part
BUSY = "busy"  # reasons beside `Reason`, if nothing was recorded
NOT_RECORDED = "not_recorded"

CALLS = (  # names of the methods that are served over XML-RPC
    "begin",
    "add",
    "decide",
    "decide_added",
    "decide_recorded",
    "action",
    "action_added",
    "action_recorded",
    "report",
    "status",
)
Struct = dict[str, Any]
# A VERIFY that was not recorded, but for its reason.
UNRECORDED: Struct = {"action": 0, "id": "", "lower": 0.0, "upper": 1.0, "version": 0}


class RobotCalls:
    """The methods that a robot's program can call, on one service.

    They run in the server's event loop. The pieces of traces that `add` took are only in this
    object, not in the store; XML-RPC and OPC UA have an object each.

    Parameters
    ----------
    service : CellService
    recorder : RtdeRecorder, optional
        Records the traces for `decide_recorded`, which needs it.
    """

    def __init__(self, service: CellService, recorder: RtdeRecorder | None = None) -> None:
        self._service = service
        self._recorder = recorder
        self._pieces: OrderedDict[str, list[TraceArray]] = OrderedDict()
        self._armed: str | None = None  # id of the part that is recorded
        self._recorder_lock = asyncio.Lock()

    async def begin(self, request: Any = "") -> str:
        """Begin a new part, and have the recorder wait for its insertion.

        The trace of the part can be recorded by the server, or sent: as a whole by `decide`, or in
        pieces (some samples each) by `add`. Pieces that were added under this id before are
        discarded. Pieces are kept for the newest `MAX_PARTS` (8) parts; for an older part call this
        again.

        The recorder, if the server has one, records the force of one insertion for
        `decide_recorded`. It works for the newest part alone: the recording of an earlier part that
        was not decided on is dropped. With a recorder the call waits for a `decide_recorded` that
        is under way. If the recorder fails, that is logged, and `decide_recorded` then answers
        "verify" (check the part).

        Parameters
        ----------
        request : str
            The caller's id of the part; "": a new one.

        Returns
        -------
        str
            The id.

        Raises
        ------
        ReportError
            For an invalid id.
        """
        id_ = uuid.uuid4().hex if request == "" else as_id(request)
        self._pieces.pop(id_, None)
        self._pieces[id_] = []
        while len(self._pieces) > MAX_PARTS:
            self._pieces.popitem(last=False)
        if self._recorder is not None:
            async with self._recorder_lock:
                self._armed = None
                try:
                    await asyncio.to_thread(self._recorder.arm)
                    self._armed = id_
                except (DengineError, OSError) as error:  # the part will be verified
                    log.warning("the recorder does not listen: %s", error)
        return id_

    async def add(self, request: Any, samples: Any) -> int:
        """Add a piece (some samples) to a part's trace of one channel, after the pieces so far.

        Parameters
        ----------
        request : str
            The part's id, as `begin` returned it.
        samples : list of float, or bytes
            Bytes are raw float32, little-endian.

        Returns
        -------
        int
            Number of samples so far.

        Raises
        ------
        TraceError
            For a part that was not begun, is not among the newest `MAX_PARTS` (8) any more, or was
            decided on by `decide_added` since `begin`; for a piece of another type, without
            samples, or with a list for each channel, and for bytes that are no float32; and for
            more than `MAX_SAMPLES` (200,000) samples of the part. A refused piece is not added.
        ReportError
            For an invalid id.
        """
        pieces = self._pieces.get(as_id(request))
        if pieces is None:
            raise TraceError(
                f"Expected begin before add, got pieces of {shortened(request)}; the newest "
                f"{MAX_PARTS} parts are kept."
            )
        piece = as_samples(samples)
        if isinstance(samples, bytes):
            piece = piece[0]
        if piece.ndim != 1:
            raise TraceError(
                "Expected a piece of one channel, a list of numbers; use decide for several "
                "channels."
            )
        n = sum(map(len, pieces)) + len(piece)
        expect(n <= MAX_SAMPLES, f"at most {MAX_SAMPLES} samples of a part", n, error=TraceError)
        pieces.append(piece)
        return n

    async def decide(self, trace: Any, request: Any = "", part: Any = "") -> Struct:
        """Decide on a whole trace.

        Parameters
        ----------
        trace : list of float, list of list of float, or bytes
            A list for one channel, a list of lists for several channels, or bytes (float32) for one
            channel.
        request : str
            The caller's id; "": a new one.
        part : str or int
            The part's number; "": none.

        Returns
        -------
        struct
            A dict: action (0 verify, 1 accept, 2 reject), id, reason, lower, upper and version. If
            the queue is full, or the service or its engine is closed, which is logged: verify, an
            id "" and the reason "busy"; nothing is recorded.

        Raises
        ------
        TraceError, ReportError
            For a trace that cannot be read, and a trace, part or id that the engine does not take.
        SettingError
            For a first trace that the settings do not allow.
        """
        return await self.decide_array(as_samples(trace), request, part)

    async def decide_added(self, request: Any, part: Any = "") -> Struct:
        """Decide on the trace whose pieces `add` took; return a dict, like `decide`.

        The dict has the action (0 verify, that is, check the part; 1 accept; 2 reject), id, reason,
        lower and upper (bounds of the success probability) and version of the model. `request` is
        the id that `begin` returned, and `part` the part's number, "" for none. If the id already
        has a decision, this is returned again, and the pieces are ignored. A new decision drops the
        pieces, even if the store did not record it (reason "no_store"). If the queue of requests is
        full, or the service or its engine is closed, the result is VERIFY with an empty id and the
        reason "busy", and the pieces stay, so that the call can be repeated.

        Raises TraceError if there are no pieces (also for an id that has a decision, if it cannot
        be looked up now), for a trace whose shape or values the engine refuses, and for an invalid
        part number; ReportError for an invalid id; and SettingError if the engine's first trace
        does not fit its settings.
        """
        if (stored := await self._find(request)) is not None:
            return stored
        pieces = self._pieces.get(request)
        if not pieces:
            raise TraceError(
                "Expected begin and add before decide_added, got no pieces of "
                f"{shortened(request)}."
            )
        result = await self.decide_array(np.concatenate(pieces), request, part)
        if result["id"]:
            self._pieces.pop(request, None)
        return result

    async def decide_recorded(self, request: Any = "", part: Any = "") -> Struct:
        """Decide on the trace that the server's recorder took of the insertion since `begin`.

        If the id already has a decision, it is returned again. Otherwise, or if the id cannot be
        looked up now, the call waits up to `RECORD_SECONDS` (1 s) for the recording to be complete.
        Samples that are missing then are NaN, so the part is verified, and the trace is stored with
        that fault. Only the part of the newest `begin` has a recording, and only one call can use
        it, even if that call raises or gets "busy". If there is no recording, or the recorder
        fails, which is logged, the result is verify with an id "" and the reason "not_recorded",
        and nothing is stored.

        Parameters
        ----------
        request : str
            As `begin` returned it; "": of the newest `begin`. With "" a second call does not find
            the decision of the first: it gets the reason "not_recorded".
        part : str or int
            The part's number; "": none.

        Returns
        -------
        struct
            A dict: action (0 verify, that is, check the part; 1 accept; 2 reject), id, reason,
            lower and upper (bounds of the success probability) and version of the model. If the
            queue of requests is full, or the service or its engine is closed, verify with an id ""
            and the reason "busy".

        Raises
        ------
        SettingError
            For a server without a recorder, and if the engine's first trace does not fit its
            settings.
        TraceError, ReportError
            TraceError for a trace whose shape or values the engine refuses, or an invalid part
            number, ReportError for an invalid id.
        """
        if self._recorder is None:
            raise SettingError(
                "Expected a recorder, got none; start the server with --robot, or send the trace."
            )
        async with self._recorder_lock:
            id_ = self._armed if request == "" else as_id(request)
            if id_ is not None and (stored := await self._find(id_)) is not None:
                return stored
            # Another part was begun, or the server was restarted meanwhile.
            if id_ is None or id_ != self._armed:
                return UNRECORDED | {"reason": NOT_RECORDED}
            self._armed = None
            try:
                recording = await asyncio.to_thread(self._recorder.record, RECORD_SECONDS)
            except (DengineError, OSError) as error:
                log.warning("no recording of %s: %s", shortened(id_), error)
                return UNRECORDED | {"reason": NOT_RECORDED}
            return await self.decide_array(recording.trace, id_, part)

    async def action(self, trace: Any, request: Any, part: Any = "") -> int:
        """Return only the action of `decide` (0 verify, 1 accept, 2 reject), for a controller
        without structs.

        `report` needs the id, which is therefore the caller's own. Raises what `decide` raises; if
        the queue is full, or the service is closed, the action is 0 and nothing is recorded.
        """
        return int((await self.decide(trace, request, part))["action"])

    async def action_added(self, request: Any, part: Any = "") -> int:
        """Return only the action of `decide_added`: 0 verify, 1 accept, 2 reject.

        Raises what `decide_added` raises. It is 0, too, if nothing was recorded.
        """
        return int((await self.decide_added(request, part))["action"])

    async def action_recorded(self, request: Any, part: Any = "") -> int:
        """Return only the action of `decide_recorded`: 0 verify, 1 accept, 2 reject.

        Raises what `decide_recorded` raises. It is 0, too, if there is no recording.
        """
        return int((await self.decide_recorded(request, part))["action"])

    async def decide_array(self, trace: ArrayLike, request: Any, part: Any) -> Struct:
        """Decide on a trace of shape (T,) or (C, T); return the decision as a dict.

        The dict has the action (0 verify, that is, check the part; 1 accept; 2 reject), id, reason,
        lower and upper (bounds of the success probability) and version of the model.

        `request` is the caller's id of the trace, "" for a new one; `part` is the part's number, ""
        for none. If an id comes again with the same trace, its decision is returned again. If a
        request waits in the queue for longer than the service's deadline, a new decision is VERIFY
        with the reason "late" or a fault of the trace, and if the store fails with the reason
        "no_store"; such a decision may be missing from the store (`CellService.decide`). If the
        queue is full, or the service or its engine is closed, that is logged, and the dict is an
        unrecorded VERIFY with an id "" and the reason "busy". Raises TraceError for a trace whose
        shape or values the engine refuses, an invalid part number and an id that belongs to another
        trace, ReportError for an invalid id, and SettingError if the engine's first trace does not
        fit its settings.
        """
        id_ = as_id(request) if request != "" else None
        try:
            response = await self._service.decide(trace, id_, None if part == "" else part)
        except (BusyError, StoreError) as error:
            log.warning("verified without a record: %s", error)
            return UNRECORDED | {"reason": BUSY}
        return _as_struct(response.decision)

    async def report(self, decision_id: Any, success: Any) -> bool:
        """Report the outcome of the part with this decision, and wait until it is on disk.

        `success` is True or 1 for a good part, False or 0 for a bad one.

        Returns
        -------
        bool
            True if the label is on disk, also if it was reported before. False if the id is "" or
            unknown: do not repeat the call. False also if the report cannot be stored now, which is
            logged: repeat it later.

        Raises
        ------
        ReportError
            For a report that contradicts an earlier label; but a report that an accepted part was
            bad is taken even if the part counted as good before; it corrects the label. Also for
            any report if a person withdrew the label, for a value that is no label, and for an
            invalid id.
        """
        if decision_id == "":  # of an unrecorded VERIFY
            return False
        try:
            await self._service.report(decision_id, success)
        except UnknownDecisionError:
            return False
        except (BusyError, StoreError) as error:
            log.warning("a report on %s was not kept: %s", shortened(decision_id), error)
            return False
        return True

    async def status(self) -> Struct:
        """Return how the robot cell is doing, in plain numbers and texts.

        First the engine writes to the store what it has recorded (`CellService.read`); this waits
        in the queue of requests, and may discard a training under way or retrain the model. While
        the store is then read no decision waits, unless the store is in memory.

        Returns
        -------
        struct
            A dict. decisions, accepted, rejected, bad (accepted parts that were bad): counts so
            far. verified_share: share of verified (checked) parts among the newest 500 decisions, 1
            if there are none. version: number of the model version that decides. safe_mode: why the
            safe mode began, in which every part is verified; alarm: what a person must look at;
            both are texts, "" if there is nothing. shadow: whether every part is verified while the
            model only predicts. waiting: requests in the queue. late, busy: since the start,
            numbers of decisions that the engine had not begun within the service's `deadline`, and
            of requests refused because the queue was full.

        Raises
        ------
        BusyError, StoreError
            If the queue is full or the service is closing, or if the store cannot be read.
        SettingError
            For a stored recipe (the engine's settings) that cannot be read.
        """
        service = self._service
        status = await service.status()
        share = status.newest.verified_share
        counts = status.ever
        return {
            "decisions": counts.decisions,
            "verified_share": 1.0 if share is None else share,
            "accepted": counts.accepted,
            "rejected": counts.rejected,
            "bad": counts.false_accepts,
            "version": status.version,
            "safe_mode": status.safe_mode,
            "shadow": status.shadow,
            "alarm": status.alarm,
            "waiting": service.waiting,
            "late": service.late,
            "busy": service.busy,
        }

    async def _find(self, request: Any) -> Struct | None:
        """Return the decision that was made under the id `request`, as a dict (`_as_struct`).

        None if the id has no decision, and also if the queue for the engine's thread is full, the
        service is closing, or the store cannot look the id up. Raises ReportError for an invalid
        id.
        """
        try:
            stored = await self._service.find(as_id(request))
        except (BusyError, StoreError):
            return None
        return None if stored is None else _as_struct(stored.decision)


def one_line(text: str) -> str:
    """Return a text as one line: each unprintable character, like a line break, becomes a space,
    and what is beyond 300 characters is cut off.
    """
    return "".join(c if c.isprintable() else " " for c in text)[:300]


def _as_struct(decision: Decision) -> Struct:
    """Return a decision as a dict of plain types, for a robot's program.

    It has the action (0 verify, that is, check the part; 1 accept; 2 reject), id, reason (a text),
    lower and upper (bounds of the success probability), and version, the number of the model
    version that decided.
    """
    return {
        "action": ACTIONS.index(decision.action),
        "id": decision.id,
        "reason": str(decision.reason),
        "lower": decision.lower,
        "upper": decision.upper,
        "version": decision.model_version,
    }
