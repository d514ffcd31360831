"""The data engine: decide, report, retrain, run. Source: the paper's section "Data engine".

engine = DataEngine(reducer="conv", policy=Policy(alpha=0.05, lower_bound=0.95), store="engine.db")
for cycle in engine.run(cell, cycles=1503):
    ...
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from dataclasses import replace
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from .cells.base import Cell
from .deciding import DecisionMaker, as_part
from .decision.certificate import Certificate, certificate_of
from .decision.policy import Policy
from .errors import StoreError
from .feedback import Feedback, unknown_stop
from .fleet import agreed, as_sisters, sisters_trace
from .loop import drive
from .model.base import EngineModel, Exportable, Model
from .recipe import Recipe
from .records import Cycle, Decision, RetrainReport, TraceSpec
from .retraining import Clock, EncoderTime, Limits, Retrainer, Window
from .settings import EngineSettings, chosen_recipe, object_of, refuse_idle
from .store.base import Store, opening
from .store.records import DecidedTrace, StoredDecision, stored_decision
from .traces import as_trace, spec_of
from .versions import ModelVersions

OPTIONS = ("model", "executor", "replaying", "clock", "on_safe_mode")  # of an opened engine
OnSafeMode = Callable[[str], object] | None
StoreLike = str | os.PathLike[str] | Store


class DataEngine:
    """Decides on traces, learns from reports, retrains within its budget, and remembers all of it.

    reducer : a name in `REDUCERS`, `module:Class`, or a scikit-learn transformer; None: the recipe's, or conv.
    policy : the user's two numbers.  trace : the traces' contract; None: the first trace sets it.
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
    ) -> None:
        torch.set_num_threads(1)
        limits = Limits(None if replaying else settings.recipe.budget, settings.recipe.max_steps)
        encoder_time = EncoderTime(settings.recipe.encoder_budget, in_steps=replaying)
        retrainer = Retrainer(Window(settings.recipe.window), limits, executor, clock, encoder_time)
        self._versions = ModelVersions(template, retrainer, store, clock)
        self._feedback = Feedback(store, self._versions, settings.recipe.policy.stops == "all", on_safe_mode)
        self._maker = DecisionMaker(settings.recipe.policy.audit_rate, settings.seed)
        self._settings, self.seed, self.store, self.clock, self.resumed = settings, settings.seed, store, clock, False
        if settings.trace is not None:
            self._maker.agree_on(settings.trace)

    @classmethod
    def from_recipe(cls, recipe: Recipe | str | os.PathLike[str], store: Any = None, **options: Any) -> Self:
        """An engine with every setting from a recipe: a `Recipe`, a name or a TOML file."""
        return cls(recipe=recipe, store=store, **options)

    @classmethod
    def open(cls, url: StoreLike, *, reducer: Any = None, model: Model | None = None, **options: Any) -> Self:
        """Go on with a store: the same version, the same decisions, bit for bit.

        (Of a part that a stop reached too late, the first engine keeps its success too until its next retrain.)
        reducer, model : where the engine had an object of yours that the store cannot name, the same one again.
        options : executor, replaying, clock and on_safe_mode, as `DataEngine` takes them.
        Raises StoreError where there is nothing to go on with, SettingError where an object is missing.
        """
        engine = cls.__new__(cls)
        with opening(url, must_exist=True) as store:
            name = "the store" if isinstance(url, Store) else str(url)
            settings = EngineSettings.from_store(store.settings(), name, reducer, model)
            engine._start(*settings.with_template(model), store, **options)
            engine._versions.resume()
            engine._feedback.resume()
        engine.resumed = True
        return engine

    @classmethod
    def open_or_create(cls, store: StoreLike | None, seed: int | None = None, **settings: Any) -> Self:
        """Go on with a store that has been used, or start on a new one: the same line at every start of a program.

        settings : as `DataEngine` takes them. Those given must be what a used store was made with, or a SettingError
            says so: a running cell's settings do not change in silence.
        """
        with opening(store) as opened:
            if not opened.settings():
                return cls(store=opened, **as_sisters(settings | {"seed": seed}, opened))
            options = {name: settings.pop(name) for name in OPTIONS if name in settings}
            engine = cls.open(opened, reducer=object_of(**settings), **options)
            engine._settings.must_agree_with(settings | {"seed": seed})
            return engine

    def decide(self, trace: ArrayLike, part: str | int | None = None, *, wait: bool = False) -> Decision:
        """Decide on one trace, (T,), (channels, T), or a DataFrame whose rows are samples.

        TraceError for a wrong shape; whatever else fails becomes VERIFY.
        part : the part's number, where one is known: a part that comes again then has one vote, and none on itself.
        wait : return only when the decision is on the disk; by default it is there before any report on it returns.
        """
        self._versions.collect()
        self.encoder_time.earn()
        x, number = self._as_trace(trace), as_part(part)
        self._feedback.settle()
        item = self._put(self._maker.decide(x, number, self._versions.answering, self.version))
        if wait:
            self.store.flush()
        return item.decision

    def _as_trace(self, trace: ArrayLike) -> NDArray[np.float32]:
        x = as_trace(trace, self.trace)
        if self.trace is None and (own := spec_of(x, trace)) != self.agree_on(own):
            return as_trace(trace, self.trace)  # a sister's trace came first
        return x

    def _put(self, item: DecidedTrace) -> DecidedTrace:
        self.store.put_decision(item.decision, item.trace, item.content_hash, item.quarantined, item.part)
        self._feedback.decided(item)
        return item

    def report(
        self, decision_id: str, success: bool, trace: ArrayLike | None = None, part: str | int | None = None
    ) -> RetrainReport | None:
        """Tell what became of a decision; the label survives a killed process once this returns.

        success : what the verification said; False for a system stop after an accept, True for a part known to be fine.
        trace, part : only for a system stop whose decision was lost: it is then stored with this trace.
        Returns the retrain that this label set off, if any. Raises ReportError for an unknown id, a second report, or a
        report on a rejected part.
        """
        self._versions.collect()
        known = self.store.get_decision(decision_id) or self._lost_stop(decision_id, success, trace, part)
        self._feedback.report(known, bool(success))
        return None if known.quarantined else self._versions.work(self.recipe.retrain_every)

    def _lost_stop(self, decision_id: str, success: bool, trace: ArrayLike | None, part: Any) -> StoredDecision:
        if trace is None or success:
            raise unknown_stop(decision_id)
        item = self._maker.lost_accept(self._as_trace(trace), as_part(part), decision_id, self.version)
        return stored_decision(self._put(item))

    def retrain(self) -> RetrainReport:
        """Retrain now, in line; a candidate that fails its gate is dropped and recorded."""
        return self._versions.retrain()

    @property
    def retraining(self) -> bool:
        """Whether a retrain is under way in the executor, or waits to be swapped in."""
        return self._versions.retrainer.busy

    def start_retrain(self) -> RetrainReport | None:
        """Retrain in the executor while the cell goes on; without one in line, as `retrain`, which returns its report."""
        return self._versions.start_retrain()

    def run(self, cell: Cell, cycles: int) -> Iterator[Cycle]:
        """Drive a cell; iterate: a record a cycle, as it happens. What the cell raises propagates, after all is written."""
        return drive(self, cell, cycles)

    def settle(self) -> RetrainReport | None:
        """Do what need not wait for a report, a retrain or a slice of training; returns the newest retrain, once."""
        self._versions.work(self.recipe.retrain_every)
        return self._versions.take_news()

    def flush(self) -> None:
        """Return when all that is known so far is on the disk."""
        self._feedback.store_waiting()
        self.store.flush()

    @property
    def encoder_time(self) -> EncoderTime:
        """What the encoder's training took so far."""
        return self._versions.retrainer.encoder_time

    @property
    def recipe(self) -> Recipe:
        """Every setting as it is in force; fixed once the engine is made."""
        return self._settings.recipe

    @property
    def policy(self) -> Policy:
        """The user's numbers as they are in force; for others make another engine."""
        return self._settings.recipe.policy

    @property
    def trace(self) -> TraceSpec | None:
        """The traces' contract; None before the first trace."""
        return self._settings.trace

    @property
    def model(self) -> Any:
        """The model that answers, a rival as its author knows it; None before the first retrain."""
        return None if self._versions.answering is None else self._versions.answering.user_model

    @property
    def version(self) -> int:
        """Of the model that answers; 0 before the first retrain."""
        return self._versions.version

    @property
    def safe_mode(self) -> str:
        """Why everything is verified, until fresh evidence keeps the tolerance again; "" where it is not."""
        return self._feedback.safe_mode

    def certificate(self) -> Certificate:
        """What can be said by now, at level 1 - alpha, of the parts that were decided without a check."""
        self.flush()
        return certificate_of(self.store.outcomes(), self.policy)

    @property
    def new_labels(self) -> int:
        """Labels since the last retrain began."""
        return self._versions.new_labels

    def exported(self, trace: TraceSpec | None = None) -> Exportable:
        """The decision as an exporter takes it. ExportError before the first retrain, and for a rival."""
        own, policy = self._versions.newest.exported(trace or self.trace), self.policy
        coin: dict[str, Any] = {"audit_rate": policy.audit_rate, "seed": self.seed, "stops_all": policy.stops == "all"}
        return replace(own, model_version=self.version, recipe=self.recipe.to_toml(), **coin)

    def close(self) -> None:
        """Finish a retrain under way, write everything, and let the store go."""
        self._feedback.store_waiting()
        self._versions.collect(wait=True)
        self.store.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def agree_on(self, trace: TraceSpec) -> TraceSpec:
        """Set the traces' contract, where none is set yet; returns the one in force."""
        if self.trace is None:
            trace = sisters_trace(self.store) or trace
            self._settings = replace(self._settings, trace=trace)
            self._maker.agree_on(trace)
            self.store.save_settings(self._settings.to_store())
        return self._settings.trace or trace
