"""One engine behind every interface: who asks waits in a queue, not for ever, for the one thread that owns it.

    service = CellService(lambda: DataEngine.open_or_create("cell.db"), "cell.db")
    answer = await service.decide(trace, "order-7")

What only reads does so by a second connection to the store (`look`), so that no decision waits for it.
"""

from __future__ import annotations

import asyncio
import logging
import os
import queue
import threading
import time
import uuid
from collections.abc import AsyncIterator, Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from numpy.typing import ArrayLike

from ..engine.engine import DataEngine, core_of
from ..errors import BusyError
from ..history.status import NEWEST, Status, status
from ..records import Decision, Reason, RetrainReport, as_id, as_success
from ..store.opening import open_store
from ..store.records import StoredDecision

if TYPE_CHECKING:
    from ..store.sql import SqlStore

log = logging.getLogger("dengine")
T = TypeVar("T")
CLOSING = "The server is closing: verify the part, and ask again when it is back."
DEADLINE = 0.5  # seconds in line, after which who asked verifies
MOST = 32  # requests in line
SOON = 0.0005  # seconds after an answer, in which whoever waits in line is heard first
IDLE = 0.05  # seconds between two looks at what the engine has to do while nobody asks


class Job(NamedTuple):
    """Work for the engine's thread: called with the engine, and with whether nobody waits for the answer any more."""

    future: Future[Any]
    work: Callable[[DataEngine, bool], Any]
    looks: bool = False

    def run(self, engine: DataEngine) -> None:
        """Do it, also where whoever asked has cancelled the future meanwhile."""
        wanted = self.future.set_running_or_notify_cancel()
        try:
            result = self.work(engine, not wanted)
            if wanted:
                self.future.set_result(result)
        except BaseException as error:  # whoever asked is told
            self.future.set_exception(error) if wanted else log.error("a decision that came too late failed: %s", error)


@dataclass(frozen=True, slots=True)
class Answer:
    """What is answered to a trace.  decision : as it is recorded.  seconds : from the request to the answer."""

    decision: Decision
    seconds: float

    @property
    def late(self) -> bool:
        """Whether it is VERIFY since the line was too long for the deadline; the engine records it as such."""
        return self.decision.reason is Reason.LATE


@dataclass(frozen=True, slots=True)
class Told:
    """What became of a report.  seconds : from the request to the answer.

    repeated : the same label was reported before, and nothing changed.  retrain : what it set off in line, if anything.
    """

    decision_id: str
    success: bool
    repeated: bool
    retrain: RetrainReport | None
    seconds: float


class CellService:
    """The engine, its thread, and the line in front of it.

    make : opens the engine, in the thread that will own it; what it raises is raised here.
    store : the same store's name, for `reading`; None: the engine remembers in memory.
    deadline : seconds that a decision may wait in line; then the answer is VERIFY, `Reason.LATE`, and recorded so.
    most : requests in line; one more is a BusyError, and nothing of it is recorded.
    check_seconds : that the expensive verification takes, for the time that was saved: the paper's height check.
    """

    def __init__(
        self,
        make: Callable[[], DataEngine],
        store: str | os.PathLike[str] | None = None,
        deadline: float = DEADLINE,
        most: int = MOST,
        check_seconds: float = 5.0,
    ) -> None:
        self.deadline, self.check_seconds = deadline, check_seconds
        self.late = self.busy = 0  # answers since it began
        self.observers: list[Callable[[Answer | Told | RetrainReport], object]] = []  # told of each, in whatever thread
        self._jobs: queue.Queue[Job | None] = queue.Queue(most)
        self._using = threading.Lock()  # the engine, by its thread, or by the loop for what waits for nothing
        self._late = ThreadPoolExecutor(most, "dengine-late")  # of their own: others may be reading a store that is away
        self._listeners: set[tuple[asyncio.AbstractEventLoop, asyncio.Event]] = set()
        self._closing = self._listening_ended = False
        self._beat = time.monotonic()
        opened: Future[DataEngine] = Future()
        self._thread = threading.Thread(target=self._serve, args=(make, opened), name="dengine-engine")
        self._thread.start()
        self.engine = opened.result()  # its facts may be read in any thread, its verbs only by `ask`
        self.core = core_of(self.engine)
        self.reading = self.engine.store if store is None else open_store(store)

    async def decide(self, trace: ArrayLike, request: str | None = None, part: str | int | None = None) -> Answer:
        """Decide on a trace, (T,) or (channels, T).

        request : the caller's id, once for every trace; asked again, the answer is the same, also after a restart.
        TraceError, ReportError as `DataEngine.decide`; BusyError where too many wait.
        """
        begin = time.monotonic()
        if request is None and not (self.waiting or self._closing) and self._using.acquire(blocking=False):
            try:
                at_once = self.core.try_decide(trace, part)
            finally:
                self._using.release()
            if at_once is not None:
                self._tell()
                return self._heard(Answer(at_once, time.monotonic() - begin))
        id_ = uuid.uuid4().hex if request is None else as_id(request)
        # Under an id of its own it has to be on the disk before the answer; a caller that has none cannot ask again.

        def work(engine: DataEngine, late: bool) -> Decision:
            given = id_ if late or request is not None else None
            return core_of(engine).decide(trace, part, given, timed_out=late)

        future = self._put(work)
        answer = asyncio.wrap_future(future)
        await asyncio.wait([answer], timeout=self.deadline)
        if answer.done() or not future.cancel():
            decision = await answer
        else:
            record = partial(self.core.record_timeout, trace, part, decision_id=id_)
            decision = await asyncio.get_running_loop().run_in_executor(self._late, record)
            self.late += 1
        return self._heard(Answer(decision, time.monotonic() - begin))

    async def report(self, decision_id: str, success: float, author: str = "") -> Told:
        """Report what became of a decision; the label is on the disk when this returns. The same label twice is no error.

        author : of a person's report, for the event log; "": a machine's, which is not an event.
        ReportError as `DataEngine.report`; BusyError where too many wait.
        """
        begin, said = time.monotonic(), as_success(success)

        def work(engine: DataEngine) -> tuple[bool, RetrainReport | None]:
            known = engine.find(decision_id)
            if known is not None and known.success is said:
                return True, None
            retrain = engine.report(decision_id, said)
            if author:
                text = f"decision {decision_id} was {'good' if said else 'bad'}"
                engine.store.put_event("report", text, author=author)
            return False, retrain

        repeated, retrain = await self.ask(work)
        if retrain is not None:
            self._heard(retrain)
        return self._heard(Told(decision_id, said, repeated, retrain, time.monotonic() - begin))

    async def find(self, decision_id: str) -> StoredDecision | None:
        """A decision with its trace and label; None for an unknown id."""
        return await self.ask(lambda engine: engine.find(decision_id), looks=True)

    async def ask(self, work: Callable[[DataEngine], T], looks: bool = False) -> T:
        """Do something in the engine's thread, between two decisions; what it raises is raised here.

        looks : it changes nothing, so that nobody who listens to `changes` is told.
        """
        return await asyncio.wrap_future(self.submit(work, looks))

    def submit(self, work: Callable[[DataEngine], T], looks: bool = False) -> Future[T]:
        """As `ask`, from any thread and without waiting."""
        return self._put(lambda engine, late: work(engine), looks)

    async def look(self, work: Callable[[SqlStore], T]) -> T:
        """Read a store that holds all that was decided so far, in a thread of its own; one in memory in the engine's."""
        await self.ask(lambda engine: engine.flush(), looks=True)
        if self.reading is self.engine.store:
            return await self.ask(lambda engine: work(engine.store), looks=True)
        return await asyncio.to_thread(work, self.reading)

    async def status(self, last: int = NEWEST, watching: bool = False) -> Status:
        """How the cell is doing, as `history.status`: by its store, and by what the running engine alone knows."""
        return self.core.complete_status(await self.look(lambda store: status(store, last, watching)))

    @property
    def waiting(self) -> int:
        """Requests in line."""
        return self._jobs.qsize()

    @property
    def silent(self) -> float:
        """Seconds since the engine's thread last took a job, or looked for one; infinite where it has ended."""
        return time.monotonic() - self._beat if self._thread.is_alive() else float("inf")

    async def changes(self, quiet: float | None = None) -> AsyncIterator[bool]:
        """Yield True whenever something has changed since the last yield, at once for the first time.

        quiet : seconds without a change, after which False is yielded; None: never.
        """
        here = asyncio.get_running_loop(), asyncio.Event()
        self._listeners.add(here)
        try:
            changed = True
            while not self._listening_ended:
                yield changed
                with suppress(TimeoutError):
                    await asyncio.wait_for(here[1].wait(), quiet)
                changed = here[1].is_set()
                here[1].clear()
        finally:
            self._listeners.discard(here)

    def end_listening(self) -> None:
        """Let all that listen to `changes` go: the server is about to close."""
        self._listening_ended = True
        self._tell()

    def close(self) -> None:
        """Answer what is in line, close the engine, and end its thread; a second time does nothing."""
        if self._closing:
            return
        self._closing = True
        self._jobs.put(None)
        self._thread.join()
        with suppress(queue.Empty):
            while True:
                if (job := self._jobs.get_nowait()) is not None and job.future.set_running_or_notify_cancel():
                    job.future.set_exception(BusyError(CLOSING))  # it came while this began
        self._late.shutdown()
        self.end_listening()
        if self.reading is not self.engine.store:
            self.reading.close()

    def _put(self, work: Callable[[DataEngine, bool], T], looks: bool = False) -> Future[T]:
        job = Job(Future(), work, looks)
        if self._closing or not self._thread.is_alive():
            raise BusyError(CLOSING)
        try:
            self._jobs.put_nowait(job)
        except queue.Full:
            self.busy += 1
            raise BusyError(
                f"Expected at most {self._jobs.maxsize} requests in line: verify the part, nothing of it was recorded."
            ) from None
        return job.future

    def _heard(self, news: T) -> T:
        if isinstance(news, RetrainReport):  # decisions and reports are in the store
            log.info("version %d answers after a retrain of %.2f s: %s", news.version, news.seconds, news.reason)
        for observe in self.observers:
            observe(news)  # type: ignore[arg-type]  # only what the list is of
        return news

    def _serve(self, make: Callable[[], DataEngine], opened: Future[DataEngine]) -> None:
        try:
            engine = make()
            try:
                core_of(engine).load_decision_ids()
            except BaseException:
                engine.close()
                raise
        except BaseException as error:  # raised where the service is made
            opened.set_exception(error)
            return
        opened.set_result(engine)
        with engine:
            while (job := self._next(engine)) is not None:
                with self._using:
                    job.run(engine)
                if not job.looks:
                    self._tell()
            self._using.acquire()  # for good

    def _next(self, engine: DataEngine) -> Job | None:
        """The next one in line; while nobody asks, the engine does what it has to do: a new version is swapped in."""
        core = core_of(engine)
        patience = SOON  # right behind an answer, for the next part is farthest away then
        while True:
            self._beat = time.monotonic()
            with suppress(queue.Empty):
                return self._jobs.get(timeout=patience)
            try:
                with self._using:
                    report = core.process_retrains(brief=True)
                if report is not None:
                    self._heard(report)
                    self._tell()
            except Exception:  # whatever it is, the next request is answered
                log.exception("what the engine does between requests failed")
            patience = SOON if core.is_swapping else IDLE

    def _tell(self) -> None:
        for loop, changed in tuple(self._listeners):
            with suppress(RuntimeError):  # its loop has ended
                loop.call_soon_threadsafe(changed.set)
