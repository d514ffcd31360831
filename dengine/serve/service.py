"""`CellService`: the one engine that all interfaces of a server share, the thread that owns it, and
the queue of requests to it.

    service = CellService(lambda: DataEngine.open_or_create("cell.db"), "cell.db")
    response = await service.decide(trace, "order-7")

A request for a decision waits for the thread in a queue, at most until the deadline, after which
the part is verified. What only reads the store does so over a second connection
(`CellService.read`), so that no decision waits for it. HTTP, XML-RPC, OPC UA and the demonstration
are built on this module.
"""

from __future__ import annotations

import asyncio
import queue
import threading
import time
import uuid
from collections.abc import AsyncIterator, Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from numpy.typing import ArrayLike

from ..engine.engine import DataEngine
from ..errors import BusyError, NotTakenError, ReportConflictError, log
from ..files import FilePath
from ..history.status import Status, status
from ..records import Decision, PartNumber, Reason, RetrainReport, as_id, as_success
from ..store.opening import open_store
from ..store.records import StoredDecision

if TYPE_CHECKING:
    from ..store.sql import SqlStore

T = TypeVar("T")
CLOSING = "The server is closing: verify the part, and ask again when it is back."
DEADLINE = 0.5  # seconds that a decision waits in the queue before its part is verified
CHECK_SECONDS = 5.0  # duration of a verification: the paper's height check
MAX_WAITING = 32  # requests in the queue
SHORT_WAIT = 0.0005  # seconds that the engine's thread waits for a request before other work
IDLE_WAIT = 0.05  # the same, if no retrained version is being swapped in


class Job(NamedTuple):
    """Work for the engine's thread.

    Attributes
    ----------
    future : Future
        Gets the result.
    work : callable
        Called with the engine, and with whether the caller has timed out.
    read_only : bool
        The work changes nothing, so that listeners are not notified.
    """

    future: Future[Any]
    work: Callable[[DataEngine, bool], Any]
    read_only: bool

    def run(self, engine: DataEngine) -> None:
        """Do the work with the engine, and set the future's result or exception.

        If the future was cancelled, because its caller timed out or was cancelled, the work is told
        so, and done all the same (a decision is then VERIFY, to check the part, without asking the
        model); its result is dropped, and an exception is logged. Nothing is raised.
        """
        has_caller = self.future.set_running_or_notify_cancel()
        try:
            result = self.work(engine, not has_caller)
            if has_caller:
                self.future.set_result(result)
        except BaseException as error:
            if has_caller:
                self.future.set_exception(error)
            else:
                log.error("work for a caller that had gone failed: %s", error)


@dataclass(frozen=True, slots=True)
class ServiceResponse:
    """The response to a request for a decision.

    Attributes
    ----------
    decision : Decision
        As recorded.
    late : bool
        Whether it is VERIFY because the deadline passed while the request waited.
    seconds : float
        From the request to the response.
    """

    decision: Decision = field(metadata={"flat": True})
    late: bool
    seconds: float


@dataclass(frozen=True, slots=True)
class ReportResponse:
    """The response to a reported outcome.

    Attributes
    ----------
    decision_id : str
    success : bool
    repeated : bool
        The same label was reported before, and nothing changed.
    retrain : RetrainReport or None
        The retrain that the label set off and that is finished already, if any.
    seconds : float
        From the request to the response.
    """

    decision_id: str
    success: bool
    repeated: bool
    retrain: RetrainReport | None
    seconds: float


class CellService:
    """An engine, the thread that owns it, and the queue of requests.

    Parameters
    ----------
    make : callable
        Opens the engine, in the thread that will own it. What it raises is raised here.
    store : str or path, optional
        Name of the same store, for `read`. None: the engine has a store in memory. If it cannot be
        opened, the engine is closed and the error raised.
    deadline : float, default 0.5
        Seconds that a decision may wait in the queue. Then the response is VERIFY with
        `Reason.LATE`, and is recorded as such.
    max_waiting : int, default 32
        Requests in the queue. One more raises BusyError, and nothing of it is recorded.
    check_seconds : float, default 5.0
        Duration of a verification, from which the saved time is computed.

    Attributes
    ----------
    engine : DataEngine
        Its properties may be read in any thread, its methods called only through `call`.
    late, busy : int
        Decisions past the deadline, and requests refused because the queue was full, so far.
    observers : list of callable
        Each is called with every ServiceResponse, ReportResponse and RetrainReport, in the thread
        where it arises.
    read_store : SqlStore
        The second connection to the store, by which `read` reads; the engine's own store if that is
        in memory.
    """

    def __init__(
        self,
        make: Callable[[], DataEngine],
        store: FilePath | None = None,
        deadline: float = DEADLINE,
        max_waiting: int = MAX_WAITING,
        check_seconds: float = CHECK_SECONDS,
    ) -> None:
        self.deadline = deadline
        self.check_seconds = check_seconds
        self.late = 0
        self.busy = 0
        self.observers: list[Callable[[Any], object]] = []
        self._jobs: queue.Queue[Job | None] = queue.Queue(max_waiting)
        # The default executor may be full of readers of a store that is unavailable.
        self._timeout_threads = ThreadPoolExecutor(max_waiting, "dengine-late")
        self._listeners: set[tuple[asyncio.AbstractEventLoop, asyncio.Event]] = set()
        self._closing = False
        self._listening_ended = False
        self._last_active = time.monotonic()
        opened: Future[DataEngine] = Future()
        self._thread = threading.Thread(
            target=self._run_jobs, args=(make, opened), name="dengine-engine"
        )
        self._thread.start()
        self.engine = opened.result()
        self.read_store = self.engine.store
        if store is not None:
            try:
                self.read_store = open_store(store)
            except BaseException:
                self.close()  # or its thread would keep the process alive
                raise

    async def decide(
        self, trace: ArrayLike, request: str | None = None, part: PartNumber = None
    ) -> ServiceResponse:
        """Decide on a trace in the engine's thread, for which the request waits in the queue.

        Parameters
        ----------
        trace : array, shape (T,) or (C, T)
        request : str, optional
            The caller's id, a different one for each trace. The same id and trace get the same
            decision, after a restart too, and an ACCEPT or REJECT is on disk when this returns,
            unless the store is in memory. None: a new id; the decision may reach the disk later.
        part : str or int, optional
            The part's number.

        Returns
        -------
        ServiceResponse
            The decision, whether it was late, and the seconds until the response. If the engine has
            begun the decision by the deadline (`deadline` seconds), the call waits for it.
            Otherwise the call decides without the model, and the attribute `late` counts it: the
            decision is the one that the id already has, or else VERIFY (check the part), with
            `Reason.LATE` or with a fault of the trace or the store as its reason. This VERIFY is
            recorded, but not with a store in memory, and not before the engine's `TraceSpec`
            (shape, rate and unit of its traces) is known. If the store cannot be written or cannot
            look up the id, the decision is VERIFY with `Reason.NO_STORE`, and may not be recorded.
            The response is also passed to each of `observers`, whose exceptions are raised.

        Raises
        ------
        TraceError
            For a wrong shape, values that are no real numbers, a first trace of less than 10
            samples, an invalid part number, or an id that belongs to another trace.
        SettingError
            For the engine's first trace, if an operator's limits of the force do not fit it, or if
            the `TraceSpec` made from it contradicts that of another robot cell with which this one
            shares labels and models.
        ReportError
            For an invalid id.
        StoreError
            For an engine that is closed or in use by another thread.
        BusyError
            If the queue is full, the service is closing, or the engine's thread has ended; nothing
            is recorded.
        """
        begin = time.monotonic()
        id_ = uuid.uuid4().hex if request is None else as_id(request)

        # With the caller's id the decision must be on disk before the response: the caller may
        # send the request again. Without one it cannot.
        def work(engine: DataEngine, late: bool) -> Decision:
            """Decide in the engine's thread; `late` says that the caller has timed out, so that the
            part is recorded as VERIFY under `id_` without asking the model.
            """
            decision_id = id_ if late or request is not None else None
            return engine.decide(trace, part, decision_id=decision_id, timed_out=late)

        future = self.submit(work)
        pending = asyncio.wrap_future(future)
        await asyncio.wait([pending], timeout=self.deadline)
        if pending.done() or not future.cancel():
            decision = await pending
        else:
            recording = self._timeout_threads.submit(
                self.engine.decide, trace, part, decision_id=id_, timed_out=True
            )
            decision = await asyncio.wrap_future(recording)
            self.late += 1
        return self._notify_observers(
            ServiceResponse(decision, decision.reason is Reason.LATE, time.monotonic() - begin)
        )

    async def report(self, decision_id: str, success: float, author: str = "") -> ReportResponse:
        """Report the outcome of a decision; the label is on disk when this returns.

        Parameters
        ----------
        decision_id : str
        success : bool or float
            1 or True: the part was good. If the decision has this label already, reported or
            corrected later by a person, nothing is done.
        author : str
            The person who reports; an event (a row in the store's log) then says so. "": a
            machine's report, of which no event is stored; nor of a repeated report.

        Returns
        -------
        ReportResponse
            Id, label, whether the report was repeated, the report of a retrain that the label set
            off, if that is finished, and the seconds that this took. It is also passed to each of
            `observers`; what an observer raises is raised. The report of a retrain is passed to
            them separately, later and from the engine's thread.

        Raises
        ------
        ReportError
            For an unknown or invalid id, for a value that is no label, and for another label than
            the one that the decision has. But a report that an accepted part was bad is taken even
            if the part counted as good before; it corrects the label. If a person withdrew the
            label of the decision, every report raises this error.
        StoreError
            If the label is not known to be on disk, or the id cannot be looked up: report it again.
            If the decision was not recorded because its id could not be looked up: decide again.
            Also if the stored trace is damaged, if the engine is closed, and if only the event
            cannot be stored; the event is then missing for good.
        Exception
            What the copying of a model raises that the user gave to the engine, before a retrain;
            the label is on disk then, and the event is missing.
        BusyError
            If the queue of calls for the engine's thread is full, the service is closing, or that
            thread has ended.
        """
        begin = time.monotonic()
        label = as_success(success)

        def work(engine: DataEngine) -> tuple[bool, RetrainReport | None]:
            """Report unless the decision has this label; return whether it had, and the retrain
            that was set off.

            If the report contradicts the label, everything is flushed, and the label is looked at
            once more. A new label with an author is recorded as an event. Raises the errors of
            `CellService.report`.
            """

            def has_label() -> bool:
                """Return whether the decision has the reported label already, as corrected; False
                for an unknown id, and without a label.
                """
                stored = engine.find(decision_id)
                return stored is not None and stored.success is label

            if has_label():
                return True, None
            try:
                retrain = engine.report(decision_id, label)
            except ReportConflictError:
                engine.flush()  # a confirmation by the next decision may not have been on disk yet
                if has_label():
                    return True, None
                raise
            if author:
                engine.store.events.put(
                    "report",
                    f"decision {decision_id} was {'good' if label else 'bad'}",
                    author=author,
                )
            return False, retrain

        repeated, retrain = await self.call(work)
        return self._notify_observers(
            ReportResponse(decision_id, label, repeated, retrain, time.monotonic() - begin)
        )

    async def find(self, decision_id: str) -> StoredDecision | None:
        """Return a decision with its trace and label, after waiting for the engine's thread.

        None for an unknown id. Listeners to `changes` are not notified. Raises BusyError if the
        queue is full or the service is closing, StoreError if the id cannot be looked up, and
        ReportError for an invalid id.
        """
        return await self.call(lambda engine: engine.find(decision_id), read_only=True)

    async def call(self, work: Callable[[DataEngine], T], read_only: bool = False) -> T:
        """Call a function with the engine in the engine's thread, and return or raise what it does.

        It waits in the queue, without a deadline; if the waiting is cancelled, the function is
        called all the same. With `read_only` the function changes nothing, and listeners to
        `changes` are not notified. Raises BusyError if the queue is full or the service is closing;
        nothing is called then.
        """
        return await asyncio.wrap_future(self.submit(lambda engine, late: work(engine), read_only))

    def submit(self, work: Callable[[DataEngine, bool], T], read_only: bool = False) -> Future[T]:
        """Put work into the queue for the engine's thread, from any thread, and return its future.

        `work` is called with the engine and with whether the future was cancelled. A cancelled
        future does not stop the work, but the result is dropped. After the work every iteration
        over `changes`, by which clients wait for changes, goes on, unless the work is `read_only`.
        Raises BusyError if the service is closing or the queue is full; only a full queue is
        counted, in `busy`. If the engine's thread has ended, the future raises BusyError.
        """
        job = Job(Future(), work, read_only)
        if self._closing:
            raise BusyError(CLOSING)
        try:
            self._jobs.put_nowait(job)
        except queue.Full:
            self.busy += 1
            raise BusyError(
                f"Expected at most {self._jobs.maxsize} requests in line: verify the part, "
                "nothing of it was recorded."
            ) from None
        if not self._thread.is_alive():  # it may have ended since
            self._refuse_jobs()
        return job.future

    async def read(self, work: Callable[[SqlStore], T]) -> T:
        """Have the engine write its records to the store, and return what `work(store)` returns.

        Records are decisions, labels and events. Their writing (`DataEngine.flush`) waits in the
        queue. If an outcome came late and contradicts what the engine had assumed of the part, the
        writing also corrects the engine's decision rule, and may discard a training under way or
        retrain the model. Records that the disk or the store does not take in time are missing,
        without an error. `work` must only read. It runs in another thread over a second connection
        to the store (`read_store`), or in the engine's thread if the store is in memory. Raises
        BusyError if the queue is full, the service is closing, or the engine's thread has ended,
        and whatever `work` raises.
        """
        with suppress(NotTakenError):
            await self.call(DataEngine.flush, read_only=True)
        if self.read_store is self.engine.store:
            return await self.call(lambda engine: work(engine.store), read_only=True)
        return await asyncio.to_thread(work, self.read_store)

    async def status(self, watching: bool = False) -> Status:
        """Return the status that `DataEngine.status` returns, but read the store like `read`.

        `watching` is the argument of `DataEngine.status`. Raises BusyError if the queue is full or
        the service is closing, StoreError if the store cannot be read, and SettingError for a
        stored recipe that cannot be read.
        """
        stored = await self.read(lambda store: status(store, watching=watching))
        return self.engine.state.complete(stored)

    @property
    def waiting(self) -> int:
        """Number of requests in the queue, without the one that the engine's thread works on."""
        return self._jobs.qsize()

    @property
    def silent_seconds(self) -> float:
        """Seconds since the engine's thread last began to wait for a job; infinity if it ended.

        They grow while it works on one job, or on a retrain that runs in this thread.
        """
        if not self._thread.is_alive():
            return float("inf")
        return time.monotonic() - self._last_active

    async def changes(self, quiet: float) -> AsyncIterator[bool]:
        """Yield True at once, and then whenever something has changed since the last yield.

        A change is each call of the engine that is not read-only, even if it raised, and each new
        model version or retrain that the engine reports between two calls (`DataEngine.poll`).
        Anything else that a read-only call changes does not count. After `quiet` seconds without a
        change False is yielded. The iteration ends when `end_listening` is called, and yields
        nothing if it was called before.
        """
        event = asyncio.Event()
        listener = (asyncio.get_running_loop(), event)
        self._listeners.add(listener)
        try:
            changed = True
            while not self._listening_ended:
                yield changed
                with suppress(TimeoutError):
                    await asyncio.wait_for(event.wait(), quiet)
                changed = event.is_set()
                event.clear()
        finally:
            self._listeners.discard(listener)

    def end_listening(self) -> None:
        """End every iteration over `changes`, for good, because the server is about to close.

        Requests are still answered. It returns at once, and may be called in any thread.
        """
        self._listening_ended = True
        self._notify_listeners()

    def close(self) -> None:
        """Answer the requests in the queue, close the engine and the stores, and end the threads.

        Every iteration over `changes`, by which clients wait for changes, ends. It blocks until all
        this is done. Requests that come after the call get BusyError. A second call does nothing;
        it does not wait for the first. An error of the engine's closing ends its thread and is not
        raised here.
        """
        if self._closing:
            return
        self._closing = True
        while self._thread.is_alive():  # if it has died, nobody makes room in a full queue
            with suppress(queue.Full):
                self._jobs.put(None, timeout=IDLE_WAIT)
                self._thread.join()
        self._refuse_jobs()
        self._timeout_threads.shutdown()
        self.end_listening()
        if self.read_store is not self.engine.store:
            self.read_store.close()

    def _refuse_jobs(self) -> None:
        """Empty the queue of an engine's thread that has ended; the futures raise BusyError.

        A request may be queued while the service closes, and also after `close` has called this.
        """
        with suppress(queue.Empty):
            while True:
                job = self._jobs.get_nowait()
                if job is not None and job.future.set_running_or_notify_cancel():
                    job.future.set_exception(BusyError(CLOSING))

    def _notify_observers(self, response: T) -> T:
        """Call each function in `observers` with a response or a `RetrainReport`; return it.

        A `RetrainReport` tells what came of a retrain, and is also logged. What an observer raises
        is raised; the observers after it are not called then.
        """
        # Decisions and reports are in the store: only a retrain needs a line of the log.
        if isinstance(response, RetrainReport):
            log.info(
                "a retrain of %.2f s left version %d in force (0: none): %s",
                response.seconds,
                response.version,
                response.reason,
            )
        for observe in self.observers:
            observe(response)
        return response

    def _run_jobs(self, make: Callable[[], DataEngine], opened: Future[DataEngine]) -> None:
        """Open the engine by `make`, run jobs until the queue gives None, and close the engine.

        This is the body of the engine's thread. `opened` gets the engine, or the exception that
        `make` raised; the thread ends after such an exception. While the queue is empty, the engine
        does its other work, like retrains (`_next_job`). After each job that is not `read_only` and
        each finished retrain, every iteration over `changes`, by which clients wait for changes,
        yields True. Exceptions of a job are not raised here.
        """
        try:
            engine = make()
        except BaseException as error:
            opened.set_exception(error)
            return
        opened.set_result(engine)
        with engine:
            while (job := self._next_job(engine)) is not None:
                job.run(engine)
                if not job.read_only:
                    self._notify_listeners()

    def _next_job(self, engine: DataEngine) -> Job | None:
        """Wait for the next job in the queue and return it; None means that the service ends.

        While the queue is empty, the engine does its other work (`DataEngine.poll`): it retrains if
        that is due, puts a trained version in force step by step, and calls `on_safe_mode`, a
        function that it was made with, if a safe mode (every part is checked after an alarm) began
        or ended. If this gives a report, of a retrain or of a version that a person's change made
        (like a return to an earlier version), each of `observers` is called with it; then every
        iteration over `changes`, by which clients wait for changes, goes on. An error in this work,
        or of an observer, is logged and not raised.
        """
        # The time right after a response is best for other work: the next part is farthest away.
        timeout = SHORT_WAIT
        while True:
            self._last_active = time.monotonic()
            with suppress(queue.Empty):
                return self._jobs.get(timeout=timeout)
            try:
                report = engine.poll(brief=True)
                if report is not None:
                    self._notify_observers(report)
                    self._notify_listeners()
            except Exception:  # the next request must still be answered
                log.exception("what the engine does between requests failed")
            timeout = SHORT_WAIT if engine.state.is_swapping else IDLE_WAIT

    def _notify_listeners(self) -> None:
        """Wake every iteration over `changes`, in its event loop; one whose loop has ended is
        passed over. It may be called in any thread.
        """
        for loop, event in tuple(self._listeners):
            with suppress(RuntimeError):  # the loop has ended
                loop.call_soon_threadsafe(event.set)
