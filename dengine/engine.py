"""The data engine: decide, report, retrain, run. Source: the paper's section "Data engine".

engine = DataEngine(reducer="conv", policy=Policy(alpha=0.05, lower_bound=0.95), store="engine.db")
for cycle in engine.run(cell, cycles=1503):
    ...
"""

from __future__ import annotations

import logging
import os
import time
import weakref
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from typing import Any, Self

import torch
from numpy.typing import ArrayLike

from .cells.base import Cell
from .corrections import Corrections
from .deciding import DecisionMaker, as_decision, as_part, decided_before
from .decision.policy import Policy
from .errors import StoreError
from .feedback import Feedback, unknown_stop
from .fleet import agreed, as_sisters
from .interrupts import uninterrupted
from .keeping import CLOSE, Keeper
from .labels import as_id, as_success
from .lateness import LateDecisions
from .loop import drive
from .model.base import EngineModel, Model
from .recipe import Recipe
from .records import Cycle, Decision, Reason, RetrainReport, TraceSpec
from .resuming import Telling
from .retraining import Clock, EncoderTime, Limits, Retrainer
from .reviewing import EngineReview
from .settings import EngineSettings, chosen_recipe, object_of, refuse_idle
from .store.base import Store, opening
from .store.records import DecidedTrace, StoredDecision
from .versions import ModelVersions
from .window import Window

log = logging.getLogger("dengine")
OPTIONS = ("model", "executor", "replaying", "clock", "on_safe_mode")  # of an opened engine
OnSafeMode = Callable[[str], object] | None
StoreLike = str | os.PathLike[str] | Store


class DataEngine(LateDecisions, EngineReview, Corrections):
    """Decides on traces, learns from reports, retrains within its budget, and remembers all of it.

    reducer : a name in `REDUCERS`, `module:Class`, or a scikit-learn transformer; None: the recipe's, or conv.
    policy : the user's two numbers.  trace : the traces' contract; None: the first sound trace sets it.
    radius, folds, retrain_every, budget : as in `Recipe`; None: the recipe decides.
    store : None (memory), a URL or path (SQLite, PostgreSQL), or a `Store`. One that is not empty wants `DataEngine.open`.
    seed : of the reducer and of the audits' coin.
    recipe : a `Recipe`, a name or a TOML file, for all settings that are not given beside it; it names its own reducer.
    model : any `Model`, a rival, in place of reducer and neighbours. It decides by its own rule: of a policy only
        audit_rate and stops count then.
    on_safe_mode : called with the reason when safe mode begins, "" when it ends.
    executor : None retrains in line, between cycles; a `concurrent.futures.Executor` retrains while the cell goes on.
    replaying : stop a retrain on steps alone and never on the clock, so that a seed repeats exactly.
    clock : seconds, of any origin, by which retrains and decisions are timed.

    One engine belongs to one thread, which it sets to one torch thread: steadier by far at these sizes.
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
        on_safe_mode: OnSafeMode = None,
    ) -> None:
        beside = {"radius": radius, "folds": folds, "retrain_every": retrain_every, "budget": budget, "policy": policy}
        if model is not None:
            refuse_idle(reducer, beside)
        settings = EngineSettings(chosen_recipe(reducer, recipe, beside), seed, trace=trace)
        settings, template = settings.with_template(model)  # before a store is made: a wrong setting leaves none behind
        with opening(store) as opened:
            if opened.settings():
                raise StoreError("The store is not empty; use DataEngine.open(url) to go on with it, or name a new one.")
            self._start(agreed(settings, opened), template, opened, executor, replaying, clock, on_safe_mode)
            with self._closed_on_failure():
                self.store.save_settings(self._settings.to_store())
                self._versions.join()

    def _start(
        self,
        settings: EngineSettings,
        template: EngineModel,
        store: Store,
        executor: Executor | None = None,
        replaying: bool = False,
        clock: Clock = time.perf_counter,
        on_safe_mode: OnSafeMode = None,
        reading: bool = False,
    ) -> None:
        torch.set_num_threads(1)
        limits = Limits(None if replaying else settings.recipe.budget, settings.recipe.max_steps)
        encoder_time = EncoderTime(settings.recipe.encoder_budget, in_steps=replaying)
        retrainer = Retrainer(Window(settings.recipe.window), limits, executor, clock, encoder_time)
        self._keeper = Keeper(store, owning=not reading, patient=replaying)
        weakref.finalize(self, self._keeper.close)  # of a program that forgot to
        telling, since = Telling(settings.told_since, settings.began_in), settings.policy_since
        self._versions = ModelVersions(template, retrainer, self._keeper, clock, telling)
        stops_all = settings.recipe.policy.stops == "all"
        self._feedback = Feedback(self._keeper, self._versions, stops_all, on_safe_mode, since)
        self._maker = DecisionMaker(settings.recipe.policy.audit_rate, settings.seed)
        self._settings, self.seed, self.store, self.clock, self.resumed = settings, settings.seed, store, clock, False
        self._settings_waiting = False
        if settings.trace is not None:
            self._maker.agree_on(settings.trace)

    @contextmanager
    def _closed_on_failure(self) -> Iterator[None]:
        try:
            yield
        except BaseException:
            self._keeper.close()
            raise

    @classmethod
    def from_recipe(cls, recipe: Recipe | str | os.PathLike[str], store: Any = None, **options: Any) -> Self:
        """An engine with every setting from a recipe: a `Recipe`, a name or a TOML file."""
        return cls(recipe=recipe, store=store, **options)

    @classmethod
    def open(
        cls, url: StoreLike, *, reducer: Any = None, model: Model | None = None, wait: float | None = None, **options: Any
    ) -> Self:
        """Go on with a store: the same version, the same decisions, bit for bit.

        wait : seconds for a file or URL, as `SqlStore` takes it.
        reducer, model : where the engine had an object of yours that the store cannot name, the same one again.
        options : executor, replaying, clock and on_safe_mode, as `DataEngine` takes them; reading=True looks at a
            store that another engine may own, to export it for one, and neither decides nor learns.
        Raises StoreError where there is nothing to go on with or another engine owns the cell, SettingError where an object
        is missing.
        """
        engine = cls.__new__(cls)
        with opening(url, must_exist=True, wait=wait) as store:
            name = "the store" if isinstance(url, Store) else str(url)
            settings = EngineSettings.from_store(store.settings(), name, reducer, model)
            engine._start(*settings.with_template(model), store, **options)
            with engine._closed_on_failure():
                engine._versions.resume()
                engine._feedback.resume()
        engine.resumed = True
        return engine

    @classmethod
    def open_or_create(
        cls, store: StoreLike | None, seed: int | None = None, *, wait: float | None = None, **settings: Any
    ) -> Self:
        """Go on with a store that has been used, or start on a new one: the same line at every start of a program.

        wait : as for `open`.
        settings : as `DataEngine` takes them. Those given must be what a used store was made with, or a SettingError
            says so: a running cell's settings do not change in silence.
        """
        with opening(store, wait=wait) as opened:
            if not opened.settings():
                return cls(store=opened, **as_sisters(settings | {"seed": seed}, opened))
            options = {name: settings.pop(name) for name in OPTIONS if name in settings}
            engine = cls.open(opened, reducer=object_of(**settings), **options)
            with engine._closed_on_failure():
                engine._settings.must_agree_with(settings | {"seed": seed})
            return engine

    def decide(
        self,
        trace: ArrayLike,
        part: str | int | None = None,
        *,
        wait: bool = False,
        decision_id: str | None = None,
        late: bool = False,
    ) -> Decision:
        """Decide on one trace, (T,), (channels, T), or a DataFrame whose rows are samples.

        TraceError for a wrong shape, and for a first trace of less than 10 samples; whatever else fails becomes VERIFY, a
        store that is away too.
        part : the part's number, where one is known: a part that comes again then has one vote, and none on itself.
        wait : return only when the decision is in the store; by default it is there before any report on it returns.
        decision_id : of the caller's, used once, so that whoever died before the answer asks again: the same id and trace
            have the same decision for ever, which is on the disk, in the store's journal at least, when this returns.
            TraceError for the id of another trace, ReportError for what is no id.
        late : whoever asked waits no more and verifies: that is the decision, so that its label can be reported.
        """
        self._keeper.check()
        with uninterrupted():
            id_ = None if decision_id is None else as_id(decision_id)
            if id_ is not None and (known := self._known(id_)) is not None:
                return decided_before(known, trace, self.trace)
            self._versions.collect()
            self.encoder_time.earn()
            x, number = self._as_trace(trace), as_part(part)
            self._feedback.settle()
            unasked = Reason.NO_STORE if self._keeper.away else Reason.LATE if late else None
            known = self._put(self._maker.decide(x, number, self._versions.answering, self.version, unasked, id_))
            if wait:
                self._keeper.flush()
            elif id_ is not None:
                self._keeper.secure()
        return as_decision(known)

    def _put(self, item: DecidedTrace) -> StoredDecision:
        known = self._record(item)
        self._feedback.decided(known)
        return known

    def report(
        self, decision_id: str, success: bool, trace: ArrayLike | None = None, part: str | int | None = None
    ) -> RetrainReport | None:
        """Tell what became of a decision; the label survives a killed process once this returns.

        success : what the verification said; False for a system stop after an accept, True for a part known to be fine.
        trace, part : only for a system stop whose decision was lost: it is then stored with this trace.
        Returns the retrain that this label set off, if any. Raises ReportError for an unknown id, a second report, a report
        on a rejected part, or a label that is neither a bool nor exactly 1 or 0; StoreError where neither the store nor its
        journal can be written: nothing is taken then.
        """
        said, id_ = as_success(success), as_id(decision_id)  # refused before anything is written
        self._keeper.check()
        with uninterrupted():
            self._versions.collect()
            known = self._keeper.find(id_) or self._lost_stop(id_, said, trace, part)
            self._feedback.report(known, said)
            return None if known.quarantined else self._versions.work(self.recipe.retrain_every)

    def _lost_stop(self, decision_id: str, success: bool, trace: ArrayLike | None, part: Any) -> StoredDecision:
        if trace is None or success:
            raise unknown_stop(decision_id)
        item = self._maker.lost_accept(self._as_trace(trace), as_part(part), decision_id, self.version)
        return self._put(item)

    def retrain(self) -> RetrainReport:
        """Retrain now, in line; a candidate that fails its gate, or cannot be stored, is dropped and recorded."""
        self._keeper.check()
        with uninterrupted():
            return self._versions.retrain()

    def start_retrain(self) -> RetrainReport | None:
        """Retrain in the executor while the cell goes on; without one in line, as `retrain`, which returns its report."""
        return self._versions.start_retrain()

    def run(self, cell: Cell, cycles: int) -> Iterator[Cycle]:
        """Drive a cell; iterate: a record a cycle, as it happens. What the cell raises propagates, after all is written."""
        return drive(self, cell, cycles)

    def settle(self, brief: bool = False) -> RetrainReport | None:
        """Do what need not wait for a report: a retrain, a new version, a slice of training; the newest retrain, once.

        brief : bring a version that an executor has trained a step further, a few milliseconds, and not to the end.
        """
        with uninterrupted():
            self._versions.collect(to_the_end=not brief)
            self._versions.work(self.recipe.retrain_every)
            return self._versions.take_news()

    def close(self) -> None:
        """Finish a retrain under way, within seconds, write everything, and let the store go; a second time does nothing.

        StoreError where something is left that neither the store nor its journal takes; close again when there is room.
        """
        with uninterrupted():
            if self._keeper.usable:
                self._feedback.store_waiting()
                self._versions.collect(CLOSE)
            self._keeper.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()
