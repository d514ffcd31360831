"""The data engine: decide, report, retrain, run. Source: the paper's section "Data engine".

engine = DataEngine(reducer="conv", policy=Policy(alpha=0.05, lower_bound=0.95), store="engine.db")
for cycle in engine.run(cell, cycles=1503):
    ...
"""

from __future__ import annotations

import _signal  # type: ignore[import-not-found]  # `signal` looks each handler up among enumerations: 10 us a decision
import gc
import logging
import os
import threading
import time
import weakref
from collections.abc import Callable, Collection, Iterator
from concurrent.futures import Executor
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import replace
from signal import SIGINT
from types import FrameType
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from ..cells.base import Cell, must_be_cell
from ..decision.certificate import Certificate
from ..decision.policy import Policy
from ..errors import ExportError, NotTakenError, StoreError, UnknownDecisionError
from ..history.explain import Explanation, explain
from ..history.status import NEWEST, Status, as_frame, history, retrain_fault, status
from ..model.base import EngineModel, Exportable, Model
from ..recipe import Recipe
from ..records import (
    Action,
    Cycle,
    Decision,
    Outcome,
    Reason,
    RetrainReport,
    TraceSpec,
    as_id,
    as_outcome,
    as_success,
    source_of,
)
from ..reducers.base import Reducer
from ..representation import to_html
from ..store.opening import UNHURRIED, opening
from ..store.outbox import CLOSE_SECONDS, Outbox
from ..store.records import StoredDecision
from ..traces import convert_trace
from .corrections import Changed, Corrections
from .decide import DecisionMaker, as_part, decided_before, unasked
from .feedback import Feedback
from .settings import (
    EngineSettings,
    SettingsInForce,
    as_peers,
    chosen_recipe,
    classes_of,
    peers_trace,
    refuse_idle,
)
from .trainer import Clock, Limits, Retrainer, Window
from .versions import ModelVersions

if TYPE_CHECKING:
    import pandas as pd

    from ..store.sql import SqlStore

    StoreLike = str | os.PathLike[str] | SqlStore

log = logging.getLogger("dengine")
WARM_UP = 100  # cycles of a loop: what is there by then stays


@contextmanager
def frozen_objects() -> Iterator[None]:
    """Python's collector leaves alone what is there now, until the block ends.

    It goes through 280,000 objects of imported libraries in 150 ms, to find nothing: so not before the block either. Of the
    process that owns a loop.
    """
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


@contextmanager
def uncollected() -> Iterator[None]:
    """Python's collector waits until the block ends."""
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collects:
            gc.enable()


def _close(outbox: Outbox) -> None:
    try:
        outbox.close()
    except StoreError as error:  # nobody is there any more to be told by an exception
        log.error("%s", error)


class Alone:
    """Refuses other threads, and holds SIGINT back until the block ends: a label is stored and counted, or neither."""

    def __init__(self) -> None:
        self._used = threading.RLock()
        self._before: list[Any] = []  # handlers of SIGINT, of blocks within one another
        self._held: list[tuple[int, FrameType | None]] = []

    def __enter__(self) -> None:
        if not self._used.acquire(blocking=False):
            raise StoreError(
                "Expected an engine that one thread uses, got a call while another thread is in one; use it in one thread."
            )
        try:
            # Python delivers signals to the main thread alone. An ignored one interrupts nothing, nor one that C handles.
            before = _signal.getsignal(SIGINT) if threading.current_thread() is threading.main_thread() else None
            if callable(before):
                _signal.signal(SIGINT, self._hold)
        except BaseException:
            self._used.release()
            raise
        self._before.append(before)

    def _hold(self, number: int, frame: FrameType | None) -> None:
        self._held.append((number, frame))

    def __exit__(self, *exception: object) -> None:
        before = self._before.pop()
        try:
            if callable(before):
                _signal.signal(SIGINT, before)
                held, self._held = self._held, []
                if held:
                    before(*held[0])
        finally:
            self._used.release()


class DataEngine(AbstractContextManager["DataEngine"]):
    """Decides on traces, learns from reports, retrains within its budget, and remembers all of it.

    reducer : a name in `REDUCERS`, `module:Class`, or a scikit-learn transformer; None: the recipe's, or conv.
    policy : the user's two numbers.  trace : the traces' contract; None: the first sound trace sets it.
    radius, folds, retrain_every, budget : as in `Recipe`; None: the recipe decides, or the reducer.
    store : None (memory), a file or URL (SQLite, PostgreSQL), an `SqlStore`. One that is not empty wants `DataEngine.open`.
    seed : of the reducer and of the audits' coin.
    recipe : a `Recipe`, a name or a TOML file, for all settings that are not given beside it; it names its own reducer.
    model : any `Model`, a baseline, that decides by its own rule: of a policy only audit_rate and stops count then.
    on_safe_mode : called with the reason when safe mode begins, "" when it ends.
    executor : None retrains in line, between cycles; a `concurrent.futures.Executor` retrains while the cell goes on.
    replaying : stop a retrain on steps alone and never on the clock, so that a seed repeats exactly.
    clock : seconds, of any origin, by which retrains and decisions are timed.

    One engine belongs to one thread, which it sets to one torch thread.
    Raises SettingError for settings that are out of range or contradict each other, StoreError for a used store.
    """

    def __init__(
        self,
        reducer: Any = None,
        policy: Policy | None = None,
        trace: TraceSpec | None = None,
        radius: float | None = None,
        folds: int | None = None,
        retrain_every: int | None = None,
        budget: float | None = None,
        store: StoreLike | None = None,
        seed: int = 0,
        *,
        recipe: Recipe | str | os.PathLike[str] | None = None,
        model: Model | None = None,
        executor: Executor | None = None,
        replaying: bool = False,
        clock: Clock = time.perf_counter,
        on_safe_mode: Callable[[str], object] | None = None,
    ) -> None:
        beside = {"radius": radius, "folds": folds, "retrain_every": retrain_every, "budget": budget, "policy": policy}
        if model is not None:
            refuse_idle(reducer, beside)
        if model is not None and recipe is None:
            # The schedule of conv is its own.
            recipe = Recipe(retrain_every=Reducer.default_retrain_every)
        settings = EngineSettings(chosen_recipe(reducer, recipe, beside), seed, trace=trace)
        settings, template = settings.with_template(model)  # before a store is made: a wrong setting leaves none behind
        with opening(store) as opened:
            if settings.trace is None:
                settings = replace(settings, trace=peers_trace(opened))
            self._start(settings, template, opened, executor, replaying, clock, on_safe_mode)
            with self._closed_on_failure():
                if opened.settings():  # now that the cell is owned: nobody begins it meanwhile
                    raise StoreError(
                        "The store is not empty; use DataEngine.open(url) to go on with it, or name another store."
                    )
                self.store.save_settings(self._settings.now.to_store())
                if opened.product is not None:
                    self._versions.resume(self.policy.label_within, 0)  # on what the others of its product learned

    def _start(
        self,
        settings: EngineSettings,
        template: EngineModel,
        store: SqlStore,
        executor: Executor | None = None,
        replaying: bool = False,
        clock: Clock = time.perf_counter,
        on_safe_mode: Callable[[str], object] | None = None,
        reading: bool = False,
    ) -> None:
        torch.set_num_threads(1)
        limits = Limits(None if replaying else settings.recipe.budget, settings.recipe.max_steps)
        retrainer = Retrainer(Window(settings.recipe.window), limits, executor, clock)
        self._outbox = Outbox(store, settings.recipe.window, not reading, replaying)
        weakref.finalize(self, _close, self._outbox)  # of a program that forgot to
        self._alone = Alone()
        self.seed, self.store, self.clock, self.resumed, self._unseen = settings.seed, store, clock, False, True
        self._settings = SettingsInForce(settings, self._outbox)
        self._versions = ModelVersions(template, retrainer, self._outbox, clock, settings.evidence)
        self._feedback = Feedback(self._outbox, self._versions, self._settings, on_safe_mode)
        self._maker = DecisionMaker(self._settings, store.clock)
        self._corrections = Corrections(self._outbox, self._settings, self._versions, self._feedback)
        if replaying:
            template.warm_up()  # no cell waits, and the first retrain is timed without it
        elif not reading:
            threading.Thread(target=template.warm_up, name="dengine-warm-up").start()

    @contextmanager
    def _closed_on_failure(self) -> Iterator[None]:
        try:
            yield
        except BaseException:
            self._outbox.close()
            raise

    @classmethod
    def from_recipe(cls, recipe: Recipe | str | os.PathLike[str], store: Any = None, **options: Any) -> Self:
        """An engine with every setting from a recipe: a `Recipe`, a name or a TOML file."""
        return cls(recipe=recipe, store=store, **options)

    @classmethod
    def open(
        cls,
        url: StoreLike,
        *,
        reducer: Any = None,
        model: Model | None = None,
        wait: float | None = None,
        allow_import: bool | Collection[str] = False,
        **options: Any,
    ) -> Self:
        """Go on with a store: the same version, the same decisions, bit for bit.

        wait : seconds for a file or URL, as `SqlStore` takes it.
        reducer, model : where the engine had an object of yours that the store cannot name, the same one again.
        allow_import : whether a `module:Class` that the store names is imported, or which of them; what reducer names is.
        options : executor, replaying, clock and on_safe_mode, as `DataEngine` takes them; reading=True looks at a
            store that another engine may own, to export it for one, and neither decides nor learns.
        Raises StoreError where there is nothing to go on with or another engine owns the cell, SettingError where an object
        is missing, ImportRefusedError, a SettingError, where a class would have to be imported that is not allowed.
        """
        engine = cls.__new__(cls)
        with opening(url, must_exist=True, wait=wait) as store:
            name = str(url) if isinstance(url, str | os.PathLike) else "the store"
            settings = EngineSettings.from_store(store.settings(), name, reducer, model, allow_import)
            engine._start(*settings.with_template(model), store, **options)
            with engine._closed_on_failure():
                engine._versions.resume(settings.recipe.policy.label_within, settings.policy_since)
                engine._feedback.resume()
        engine.resumed = True
        return engine

    @classmethod
    def open_or_create(
        cls,
        store: StoreLike | None,
        seed: int | None = None,
        *,
        wait: float | None = None,
        allow_import: bool = False,
        **settings: Any,
    ) -> Self:
        """Go on with a store that has been used, or start on a new one: the same line at every start of a program.

        wait, allow_import : as for `open`; what the settings name is allowed.
        settings : as `DataEngine` takes them. Those given must be what a used store was made with, or a SettingError
            says so: a running cell's settings do not change in silence.
        """
        with opening(store, wait=wait) as opened:
            allowed = allow_import or classes_of(**settings)
            if not opened.settings():
                return cls(store=opened, **as_peers(settings | {"seed": seed}, opened, allowed))
            of_open = ("model", "executor", "replaying", "clock", "on_safe_mode")
            options = {name: settings.pop(name) for name in of_open if name in settings}
            recipe, own = settings.get("recipe"), settings.get("reducer")
            own = recipe.reducer if own is None and isinstance(recipe, Recipe) else own
            engine = cls.open(opened, reducer=own, allow_import=allowed, **options)
            with engine._closed_on_failure():
                engine._settings.now.must_agree_with(settings | {"seed": seed})
            return engine

    def decide(
        self, trace: ArrayLike, part: str | int | None = None, *, decision_id: str | None = None, late: bool = False
    ) -> Decision:
        """Decide on one trace, (T,), (channels, T), or a DataFrame whose rows are samples.

        part : the part's number, where one is known: a part that comes again has one vote, and none on itself.
        decision_id : of the caller's: the same id and trace have the same decision for ever, on the disk when this returns.
        late : whoever asked waits no more and verifies: that is the decision, so that its label can be reported.
        Raises TraceError for a wrong shape, a first trace of less than 10 samples, and the id of another trace; ReportError
        for what is no id. Whatever else fails becomes VERIFY; an id that cannot be looked up too, and that is not recorded.
        """
        self._outbox.check_usable()
        with self._alone:
            id_, number = None if decision_id is None else as_id(decision_id), as_part(part)
            if id_ is not None:
                try:
                    if (known := self._outbox.find_earlier(id_)) is not None:
                        return decided_before(known, trace, self.trace)
                except StoreError as error:
                    return self._unrecorded(id_, number, error)
            self._versions.collect()
            known = self._decided(trace, number, late, id_)
            try:
                if id_ is not None:
                    self._outbox.sync()
            except NotTakenError:
                # A decision that lets a part go on unchecked has to outlive this process, or an id would have two answers.
                if known.decision.action is not Action.VERIFY:
                    item = self._maker.decide(known.trace, number, None, self.version, Reason.NO_STORE, id_)
                    known = self._outbox.replace_decision(item)
            self._feedback.decided(known)
            self._feedback.announce()
        return known.decision

    def decide_at_once(self, trace: ArrayLike, part: str | int | None = None) -> Decision | None:
        """As `decide`, in any thread while no other uses the engine; None, and nothing was done, where that might wait.

        It waits for neither store nor disk, and runs no code of the user's, nor umap-learn's. It leaves to `settle` to
        bring in a version, and to tell of safe mode.
        """
        self._outbox.check_usable()
        with self._outbox.try_lock() as free, self._alone:
            ours = self._versions.newest.keeps_references and not self.recipe.user_classes
            quick = ours and (self._versions.answering is None or self._versions.answering.is_compiled)
            if not (free and quick) or self._unseen or self._settings.waiting or self._feedback.remedy:
                return None
            torch.set_num_threads(1)  # each thread has its own
            known = self._decided(trace, as_part(part))
            self._feedback.decided(known)
            return known.decision

    def _decided(self, trace: ArrayLike, part: str | None, late: bool = False, id_: str | None = None) -> StoredDecision:
        """A new decision, recorded without waiting."""
        x = self._as_trace(trace)
        self._feedback.settle()
        unasked = Reason.NO_STORE if self._outbox.verify_all_reason else Reason.LATE if late else None
        made = self._maker.decide(x, part, self._versions.answering, self.version, unasked, id_)
        return self._outbox.record_decision(made)

    def _unrecorded(self, decision_id: str, part: str | None, error: StoreError) -> Decision:
        """VERIFY for an id that may have a decision, which cannot be looked up: nothing of it is recorded."""
        log.warning("whether %r was decided before cannot be looked up; it is verified: %s", decision_id, error)
        return unasked(decision_id, part, self.version, Reason.NO_STORE)

    def decide_late(self, trace: ArrayLike, part: str | int | None = None, *, decision_id: str) -> Decision:
        """VERIFY, `Reason.LATE`, in any thread: what `decide` in the engine's own would say comes too late.

        It is on the disk when this returns; an id that has a decision keeps it. With a store in memory, and before a first
        trace has set the contract, `decide` has to record it, with `late`. Errors as of `decide`.
        """
        self._outbox.check_usable()
        id_, number = as_id(decision_id), as_part(part)
        try:
            known = self._outbox.find_earlier(id_)
        except StoreError as error:
            return self._unrecorded(id_, number, error)
        if known is None:
            if self.trace is None or self.store.wait is None:
                return unasked(id_, number, self.version, Reason.LATE)
            reason = Reason.NO_STORE if self._outbox.verify_all_reason else Reason.LATE
            x = convert_trace(trace, self.trace, False)
            known = self._outbox.record_decision(self._maker.decide(x, number, None, self.version, reason, id_))
        with suppress(NotTakenError):
            self._outbox.sync()
        return decided_before(known, trace, self.trace)

    def agree_on(self, trace: TraceSpec, inferred: bool = False) -> TraceSpec:
        """Set the traces' contract, where none is set yet; returns the one in force. inferred : from a first trace."""
        if self.trace is None:
            try:
                if self.store.product is not None:
                    trace = self._outbox.call_store(lambda: peers_trace(self.store)) or trace
            except StoreError:  # the cell's own first trace stands
                log.exception("the product's contract of traces cannot be had")
            settings = replace(self._settings.now, trace=trace, inferred=inferred)
            self._maker.agree_on(trace)
            self._settings.change(settings)
            self._settings.save()
        return self.trace or trace

    def _as_trace(self, trace: ArrayLike) -> NDArray[np.float32]:
        x = convert_trace(trace, self.trace, self._settings.now.inferred and self.version + self.new_labels == 0)
        if self.trace is None and (spec := self._maker.first_contract(x, trace)) is not None:
            if self.agree_on(spec, inferred=True) != spec:  # a peer's trace came first
                return convert_trace(trace, self.trace, False)
        elif self._settings.waiting:
            self._settings.save()
        if self._unseen and self.trace is not None and np.isfinite(x).all():
            self._unseen = False
            if not self.version:  # what will answer is compiled before there is much to do
                self._versions.template.precompute_safely(x[None])
        return x

    def report(
        self, decision_id: str, success: bool, trace: ArrayLike | None = None, part: str | int | None = None
    ) -> RetrainReport | None:
        """Tell what became of a decision; the label survives a killed process once this returns.

        success : what the verification said; False for a system stop after an accept, True for a part known to be fine. A
            stop that comes after the part was confirmed, however late, takes that back: it counts as a correction. Of a
            rejected part, what it turned out to be when somebody looked: the label trains, and the rule is not told.
        trace, part : only for a system stop whose decision was lost: it is then stored with this trace.
        Returns the retrain that this label set off, if any. Raises ReportError for an unknown id, a second report, or
        what is no label; StoreError where the label is not known to be taken: say the same again.
        """
        said, id_ = as_success(success), as_id(decision_id)  # refused before anything is written
        self._outbox.check_usable()
        with self._alone:
            self._versions.collect()
            known = self._outbox.find_decision(id_, unsynced=True) or self._lost_stop(id_, said, trace, part)
            self._feedback.report(known, said)
            return None if known.quarantined else self._versions.work(self.recipe)

    def _lost_stop(self, decision_id: str, success: bool, trace: ArrayLike | None, part: Any) -> StoredDecision:
        if trace is None or success:
            raise UnknownDecisionError(
                f"Expected the id of a decision of this cell, got {decision_id!r}, which is unknown; "
                "a system stop whose decision was lost can be reported with its trace."
            )
        item = self._maker.lost_accept(self._as_trace(trace), as_part(part), self.version, decision_id)
        known = self._outbox.record_decision(item)
        self._feedback.decided(known)
        return known

    def retrain(self) -> RetrainReport:
        """Retrain now, in line; a candidate that fails its gate, or cannot be stored, is dropped and recorded."""
        self._outbox.check_usable()
        with self._alone:
            return self._versions.retrain()

    def start_retrain(self) -> RetrainReport | None:
        """Retrain in the executor while the cell goes on; without one in line, as `retrain`, which returns its report."""
        return self._versions.start_retrain()

    def run(self, cell: Cell, cycles: int) -> Iterator[Cycle]:
        """Drive a cell; iterate: a record a cycle, as it happens. What the cell raises propagates, after all is written.

        Python's collector works between decisions, and after a hundred cycles only on what is newer: `gc.freeze`.
        Raises SettingError, before the first part, for a cell that lacks one of its four methods.
        """
        must_be_cell(cell)
        return self._run(cell, cycles)

    def _run(self, cell: Cell, cycles: int) -> Iterator[Cycle]:
        with ExitStack() as ending:
            ending.callback(self.flush, UNHURRIED if self.store.wait is not None else None)
            for index in range(cycles):
                if index == WARM_UP:
                    ending.enter_context(frozen_objects())
                yield self._cycle(cell, index)

    def _cycle(self, cell: Cell, index: int) -> Cycle:
        trace = cell.insert()
        with uncollected():
            begin = self.clock()
            decision = self.decide(trace, getattr(cell, "part", None))  # a cell may know its parts' numbers
            seconds = self.clock() - begin
        outcome, success, source = None, None, None
        if decision.action is Action.VERIFY:
            success = as_success(cell.verify(), f"decision {decision.id}, by verify()")
        elif decision.action is Action.ACCEPT:
            outcome = as_outcome(cell.proceed(), f"decision {decision.id}, by proceed()")
            success = {Outcome.STOPPED: False, Outcome.CONFIRMED: True}.get(outcome)  # silence is not a success
        else:
            cell.reject()
        if success is not None:
            source = source_of(decision.action, decision.audit, success)
            try:
                self.report(decision.id, success)
            except NotTakenError as error:  # it waits for the disk, and every part is verified until that is well
                log.warning("the label of %s: %s", decision.id, error)
        return Cycle(index, decision, outcome, success, source, seconds, self.settle(), self.safe_mode)

    def settle(self, brief: bool = False) -> RetrainReport | None:
        """Do what need not wait for a report: a retrain, a new version; the newest retrain, once.

        brief : bring a version that an executor has trained a step further, a few milliseconds, and not to the end.
        """
        with self._alone:
            self._versions.collect(to_the_end=not brief)
            self._versions.work(self.recipe, once=True)
            self._feedback.announce()
            return self._versions.take_news()

    def close(self) -> None:
        """Finish a retrain under way, within seconds, write everything, and let the store go; a second time does nothing.

        StoreError where something is left that the journal does not take; close again when the disk is well.
        """
        with self._alone:
            if self._outbox.is_usable:
                self._feedback.store_waiting()
                self._versions.collect(CLOSE_SECONDS)
            self._outbox.close()

    def correct(self, decision_id: str, success: bool, author: str = "") -> Changed:
        """Say that a label was wrong, or that a forgotten one counts again; see `Corrections.correct`."""
        return self._corrections.correct(decision_id, success, author)

    def forget(self, *decision_ids: str, author: str = "", reason: str = "") -> Changed:
        """Leave labels out of all that is learned and counted from now on; see `Corrections.forget`."""
        return self._corrections.forget(*decision_ids, author=author, reason=reason)

    def rollback(self, version: int, author: str = "") -> Changed:
        """Let an earlier version answer again, as a new version; see `Corrections.rollback`."""
        return self._corrections.rollback(version, author)

    def set_policy(self, policy: Policy, author: str = "") -> Changed:
        """Decide by another policy from the next decision on; see `Corrections.set_policy`."""
        return self._corrections.set_policy(policy, author)

    def set_shadow(self, on: bool, author: str = "") -> Changed:
        """Verify every part from the next decision on, or end that: `set_policy` with another `shadow`."""
        return self.set_policy(replace(self.policy, shadow=on), author)

    def find(self, decision_id: str) -> StoredDecision | None:
        """A decision with its trace, and with its label where it has one; None for an unknown id."""
        return self._outbox.find_decision(as_id(decision_id))

    def know_ids(self) -> None:
        """Learn which ids are taken (a second for a million), so that `decide` looks no new one up in the store."""
        self.flush()
        self._outbox.load_ids()

    def flush(self, wait: float | None = None) -> None:
        """Return when all that is known so far is on the disk; NotTakenError after `wait` seconds, None: the store's."""
        self._feedback.store_waiting()
        self._outbox.flush(wait)
        self._feedback.arrive()

    @property
    def retraining(self) -> bool:
        """Whether a retrain is under way in the executor, or waits to be swapped in."""
        return self._versions.busy

    @property
    def swapping(self) -> bool:
        """Whether a version that an executor has trained is on its way in, a step each time that the engine is asked."""
        return self._versions.swapping

    @property
    def recipe(self) -> Recipe:
        """Every setting as it is in force; all but the policy are fixed once the engine is made."""
        return self._settings.now.recipe

    @property
    def policy(self) -> Policy:
        """The user's numbers as they are in force; `set_policy` changes them."""
        return self._settings.now.recipe.policy

    @property
    def shadow(self) -> bool:
        """Whether every part is verified, and the model only says what it would have done; `set_shadow` changes it."""
        return self.policy.shadow

    @property
    def trace(self) -> TraceSpec | None:
        """The traces' contract; None before the first sound trace."""
        return self._settings.now.trace

    @property
    def model(self) -> Any:
        """The model that answers, a baseline as its author knows it; None before the first retrain."""
        return None if self._versions.answering is None else self._versions.answering.user_model

    @property
    def version(self) -> int:
        """Of the model that answers; 0 before the first retrain."""
        return self._versions.version

    @property
    def safe_mode(self) -> str:
        """Why everything is verified, until fresh evidence keeps the tolerance again; "" where it is not."""
        return self._versions.newest.safe_mode

    @property
    def store_fault(self) -> str:
        """Why the store, or its journal, cannot be written at present; "" where both can."""
        return self._outbox.fault

    @property
    def store_lag(self) -> float:
        """Age in seconds of the oldest record in the journal that the store has not taken; 0.0 where it has all."""
        return self._outbox.lag

    @property
    def retrain_fault(self) -> str:
        """What is wrong where retrains are dropped again and again; "" where they are not."""
        return retrain_fault(self._versions.dropped, self.version)

    def certificate(self) -> Certificate:
        """What can be said by now, at level 1 - alpha, of what was decided without a check under the policy in force."""
        self.flush()
        policy, since = self.policy, self._settings.now.policy_since
        return policy.certificate(self.store.tally(since_version=since, within=policy.label_within).outcomes)

    @property
    def new_labels(self) -> int:
        """Labels since the last retrain began."""
        return self._versions.new_labels

    def exported(self, trace: TraceSpec | None = None) -> Exportable:
        """The decision as an exporter takes it.

        ExportError before the first retrain, for a baseline, of a changed store.
        """
        if self._outbox.integrity_error:
            raise ExportError(f"Expected a store as it was written, to export from: {self._outbox.integrity_error}")
        own, policy = self._versions.newest.exported(trace or self.trace), self.policy
        coin: dict[str, Any] = {"audit_rate": policy.audited_share, "seed": self.seed, "stops_all": policy.stops == "all"}
        about: dict[str, Any] = {"model_version": self.version, "recipe": self.recipe.to_toml(), "windows": policy.limits}
        return replace(own, note=self._outbox.record_event, **about, **coin)

    def status(self, last: int = NEWEST, watching: bool = False) -> Status:
        """How it is doing, as a record; arguments and errors as in `history.status.status`."""
        self.flush()
        return self.as_it_runs(status(self.store, last, watching))

    def as_it_runs(self, found: Status) -> Status:
        """A status that was read from the store, with what only the running engine knows."""
        live = ("version", "shadow", "safe_mode", "new_labels", "store_fault", "store_lag", "retraining")
        return replace(found, **{name: getattr(self, name) for name in live})

    def __repr__(self) -> str:
        of = f"{self.recipe.name}: version {self.version}, {self.policy.summary}"
        form = "no trace yet" if self.trace is None else f"traces {self.trace.channels} x {self.trace.samples}"
        rest = ", safe mode" if self.safe_mode else ", shadow mode" if self.shadow else ""
        return f"<DataEngine {of}, {form}, {self.new_labels} new labels{rest}>"

    _repr_html_ = to_html

    def history_frame(self, last: int | None = None, **where: Any) -> pd.DataFrame:
        """`history` as a DataFrame, a row a decision by its id, with its label and its time as a datetime."""
        return as_frame(self.history(last, **where))

    def history(self, last: int | None = None, **where: Any) -> Iterator[StoredDecision]:
        """The decisions so far, newest last, as they were recorded; arguments and errors as in `history.status.history`."""
        return history(self.store, last, **where)

    def explain(self, decision_id: str, neighbours: int = 10) -> Explanation:
        """Why a decision came out as it did, with the `neighbours` nearest references; ReportError for an unknown id."""
        return explain(self.store, decision_id, neighbours)

    def __exit__(self, *exception: object) -> None:
        self.close()
