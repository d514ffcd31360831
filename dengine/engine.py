"""The data engine: decide, report, retrain, run.

    engine = DataEngine(reducer="conv", policy=Policy(alpha=0.05, lower_bound=0.95), store="engine.db")
    for cycle in engine.run(cell, cycles=1503):
        ...

One loop for replay, simulation and a live cell. Source of the method: the paper's section "Data engine".
"""

from __future__ import annotations

import json
import logging
import os
import time
import uuid
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from . import __version__
from .cells.base import Cell
from .errors import ReportError, StoreError
from .factory import model_of, recipe_of
from .folds import audited
from .foreign import ForeignModel
from .judge import script
from .policy import Policy
from .prediction import Judgement, Model, ModelPrediction
from .recipe import Recipe
from .records import Action, Cycle, Decision, Outcome, Reason, RetrainReport, Source, TraceSpec
from .resuming import resume
from .retraining import Limits, Retrainer, Trained
from .store import Store, StoredDecision, open_store
from .traces import REASONS, TraceGate, as_trace, spec_of
from .window import AnyModel, Window, hold, place, prepare

log = logging.getLogger("dengine")
NOTHING_KNOWN = Judgement(Action.VERIFY, 0.0, 1.0, 0, 0, None)


class DataEngine:
    """Decides on traces, learns from reports, retrains within its budget, and remembers all of it.

    reducer : a name in `REDUCERS`.  policy : the user's two numbers.
    trace : the traces' contract; None: the first trace sets it.
    radius, folds, retrain_every, budget : as in `Recipe`; None: the reducer's recipe decides.
    store : None (memory), a URL or path (SQLite, PostgreSQL), or a `Store`. One that is not empty wants `DataEngine.open`.
    seed : of the reducer and of the audits' coin.
    recipe : all settings at once, instead of those above.
    model : any `Model`, a rival method, instead of reducer and radius neighbours.
    executor : None retrains in line, between cycles; a `concurrent.futures.Executor` retrains while the cell goes on.
    replaying : stop a retrain on `max_steps` alone and read no clock, so that a seed repeats exactly.

    One engine belongs to one thread, which it sets to one torch thread: steadier by far at these sizes.
    """

    def __init__(
        self,
        reducer: str = "conv",
        policy: Policy | None = None,
        trace: TraceSpec | None = None,
        radius: float | None = None,
        folds: int | None = None,
        retrain_every: int | None = None,
        budget: float | None = None,
        store: str | os.PathLike[str] | Store | None = None,
        seed: int = 0,
        *,
        recipe: Recipe | None = None,
        model: Model | None = None,
        executor: Executor | None = None,
        replaying: bool = False,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        torch.set_num_threads(1)
        self.recipe = recipe or recipe_of(reducer, policy, radius, folds, retrain_every, budget)
        self.policy = self.recipe.policy
        self.seed = seed
        self.clock = clock
        self.version = 0
        self.new_labels = 0
        self._template = ForeignModel(model) if model is not None else model_of(self.recipe, seed)
        self._model: AnyModel | None = None
        self._news: RetrainReport | None = None  # the newest retrain, until a cycle has told of it
        self._window = Window(self.recipe.window)
        limits = Limits(None if replaying else self.recipe.budget, self.recipe.max_steps)
        self._retrainer = Retrainer(self._window, limits, executor, clock)
        self._run, self._count = uuid.uuid4().hex[:12], 0
        self.store = open_store(store)
        if self.store.settings():
            raise StoreError("The store is not empty; use DataEngine.open(url) to go on with it, or name a new one.")
        self.trace: TraceSpec | None = None
        if trace is not None:
            self._agree_on(trace)
        self._save_settings()

    @classmethod
    def from_recipe(cls, recipe: Recipe | str | os.PathLike[str], store: Any = None, **options: Any) -> Self:
        """An engine with every setting from a recipe: a `Recipe`, a name or a TOML file."""
        return cls(recipe=Recipe.load(recipe), store=store, **options)  # type: ignore[arg-type]  # PathLike is a path

    @classmethod
    def open(
        cls, url: str | os.PathLike[str] | Store, *, model: Model | None = None, executor: Executor | None = None
    ) -> Self:
        """Go on with a store: the same version, the same decisions, bit for bit. A rival `model` must be handed in again.

        Raises StoreError where there is nothing to go on with.
        """
        if not isinstance(url, Store) and "://" not in str(url) and not Path(url).exists():
            raise StoreError(f"Expected a store that an engine has used, {url} does not exist; make a DataEngine with it.")
        store = open_store(url)
        settings = store.settings()
        if not settings:
            store.close()
            raise StoreError(f"Expected a store that an engine has used, {url} is empty; make a DataEngine with it.")
        recipe, seed = Recipe.from_toml(settings["recipe"]), int(settings["seed"])
        engine = cls(recipe=recipe, seed=seed, model=model, executor=executor)
        engine.store = store
        if "trace" in settings:
            engine._agree_on(TraceSpec(**json.loads(settings["trace"])), save=False)
        resumed = resume(store, engine._template, engine._window)
        engine._model, engine.version, engine.new_labels = resumed.model, resumed.version, resumed.new_labels
        return engine

    # ------------------------------------------------------------------------------------------------- decide

    def decide(self, trace: ArrayLike, *, wait: bool = False) -> Decision:
        """Decide on one trace, (T,) or (channels, T). TraceError for a wrong shape; whatever else fails becomes VERIFY.

        wait : return only when the decision is on the disk; by default it is there before any report on it returns.
        """
        self._collect()
        x = as_trace(trace, self.trace)
        if self.trace is None:
            self._agree_on(spec_of(x))
        fault, hash_ = self._gate(torch.from_numpy(x))
        judgement, reason = (NOTHING_KNOWN, REASONS[fault]) if fault else self._judge(x)
        decision = self._conclude(judgement, reason, hash_)
        self.store.put_decision(decision, x, hash_, quarantined=bool(fault))
        if wait:
            self.store.flush()
        return decision

    def _judge(self, x: NDArray[np.float32]) -> tuple[Judgement, Reason]:
        if self._model is None:
            return NOTHING_KNOWN, Reason.NO_MODEL
        try:
            judgement = self._model.judge(x)
        except Exception:  # no exception inside a model reaches the cell: it becomes VERIFY, recorded
            log.exception("the model failed on a trace; the part is verified")
            return NOTHING_KNOWN, Reason.MODEL_ERROR
        return judgement, Reason.UNCERTAIN if judgement.action is Action.VERIFY else Reason.CERTAIN

    def _conclude(self, judged: Judgement, reason: Reason, hash_: int) -> Decision:
        certain = judged.action is not Action.VERIFY
        rate = self.policy.audit_rate
        audit = certain and rate > 0.0 and bool(audited(np.array([hash_]), rate, self.seed)[0])
        self._count += 1
        return Decision(
            id=f"{self._run}-{self._count}",
            action=Action.VERIFY if audit else judged.action,
            predicted=judged.action,
            lower=judged.lower,
            upper=judged.upper,
            n_success=judged.n_success,
            n_failure=judged.n_failure,
            embedding=judged.embedding,
            model_version=self.version,
            reason=Reason.AUDIT if audit else reason,
            audit=audit,
            propensity=rate if certain else 1.0,
        )

    # ------------------------------------------------------------------------------------------------- report

    def report(self, decision_id: str, success: bool, trace: ArrayLike | None = None) -> RetrainReport | None:
        """Tell what became of a decision; the label survives a killed process once this returns.

        success : what the expensive verification said, or False for a system stop after an accept, or True for an
            accepted part that is known to be fine.
        trace : only for a system stop whose decision was lost: it is then stored with this trace.
        Returns the retrain that this label set off, if any. Raises ReportError for an unknown id, a second report, or a
        report on a rejected part.
        """
        self._collect()
        known = self.store.get_decision(decision_id) or self._lost_stop(decision_id, success, trace)
        source = _source_of(known, success)
        model = None if known.quarantined else self._model
        point = None if model is None else place(model, known.trace, known.content_hash)
        stored = point if isinstance(model, ModelPrediction) else None
        seq = self.store.put_label(decision_id, bool(success), source, self.version, stored)
        if known.quarantined:
            return None
        if model is not None and point is not None:
            hold(model, point, int(success), known.content_hash)
        self._window.add(known.trace, int(success), known.content_hash, seq)
        self.new_labels += 1
        return self.start_retrain() if self.new_labels >= self.recipe.retrain_every else None

    def _lost_stop(self, decision_id: str, success: bool, trace: ArrayLike | None) -> StoredDecision:
        if trace is None or success:
            raise ReportError(
                f"Expected the id of a decision of this cell, got {decision_id!r}, which is unknown; "
                "a system stop whose decision was lost can be reported with its trace."
            )
        x = as_trace(trace, self.trace)
        if self.trace is None:
            self._agree_on(spec_of(x))
        fault, hash_ = self._gate(torch.from_numpy(x))
        judged = replace(NOTHING_KNOWN, action=Action.ACCEPT)
        decision = replace(
            self._conclude(judged, Reason.CERTAIN, hash_),
            id=decision_id,
            action=Action.ACCEPT,
            reason=Reason.CERTAIN,  # the part went on unchecked, whatever the audit's coin says
            audit=False,
        )
        self.store.put_decision(decision, x, hash_, quarantined=bool(fault))
        known = self.store.get_decision(decision_id)
        if known is None:
            raise StoreError(f"The store lost decision {decision_id!r} on the way.")
        return known

    # ------------------------------------------------------------------------------------------------- retrain

    def retrain(self) -> RetrainReport:
        """Retrain now, in line; a candidate that fails its gate is dropped and recorded."""
        self._collect(wait=True)
        self.new_labels = 0
        return self._swap(self._retrainer.train(self._model or self._template))

    @property
    def retraining(self) -> bool:
        """Whether a retrain is under way in the executor, or waits to be swapped in."""
        return self._retrainer.busy

    def start_retrain(self) -> RetrainReport | None:
        """Retrain in the executor while the cell goes on; without one in line, as `retrain`, which returns its report."""
        self._collect()
        if self._retrainer.executor is None:
            return self.retrain()
        if not self._retrainer.busy:
            self.new_labels = 0
            self._retrainer.start(self._model or self._template)
        return None

    def _collect(self, wait: bool = False) -> None:
        """Swap in what an executor has finished."""
        trained = self._retrainer.finished(wait)
        if trained is not None:
            self._swap(trained)

    def _swap(self, trained: Trained) -> RetrainReport:
        model, seq = trained.candidate.model, trained.seq
        if model is not None:
            prepare(model, self._model)
            self._window.catch_up(model, int(seq[-1]))  # labels that came in meanwhile are in the new version
            self._model, self.version = model, self.version + 1  # one reference is swapped
        report = RetrainReport(
            version=self.version,
            seconds=trained.elapsed(),
            n_traces=len(seq),
            n_steps=trained.candidate.n_steps,
            accepted=model is not None,
            reason=trained.candidate.reason,
        )
        state = None if model is None else model.get_state() | {"trained_on": seq}
        self.store.put_version(report, self._window.newest_seq, state)
        self._news = replace(report, seconds=trained.elapsed())
        return self._news

    # ------------------------------------------------------------------------------------------------- run

    def run(self, cell: Cell, cycles: int) -> Iterator[Cycle]:
        """Drive a cell for a number of cycles; yields one record each. An exception of the cell itself propagates,
        after everything known is written.
        """
        try:
            for index in range(cycles):
                yield self._cycle(cell, index)
        finally:
            self.store.flush()

    def _cycle(self, cell: Cell, index: int) -> Cycle:
        trace = cell.insert()
        begin = self.clock()
        decision = self.decide(trace)
        seconds = self.clock() - begin
        outcome, success = None, None
        if decision.action is Action.VERIFY:
            success = bool(cell.verify())
        elif decision.action is Action.ACCEPT:
            outcome = cell.proceed()
            success = {Outcome.STOPPED: False, Outcome.CONFIRMED: True}.get(outcome)  # silence is not a success
        else:
            cell.reject()
        source = None if success is None else _source(decision.action, decision.audit, success)
        if success is not None:
            self.report(decision.id, success)
        retrain, self._news = self._news, None
        return Cycle(index, decision, outcome, success, source, seconds, retrain)

    # ------------------------------------------------------------------------------------------------- state

    @property
    def model(self) -> Any:
        """The model that answers; None before the first retrain."""
        return self._model.model if isinstance(self._model, ForeignModel) else self._model

    def close(self) -> None:
        """Finish a retrain under way, write everything, and let the store go."""
        self._collect(wait=True)
        self.store.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _agree_on(self, spec: TraceSpec, save: bool = True) -> None:
        self.trace = spec
        self._gate = script(TraceGate(spec))
        if save:
            self._save_settings()

    def _save_settings(self) -> None:
        settings = {"recipe": self.recipe.to_toml(), "seed": str(self.seed), "dengine": __version__}
        if self.trace is not None:
            settings["trace"] = json.dumps(asdict(self.trace))
        self.store.save_settings(settings)


def _source_of(known: StoredDecision, success: bool) -> Source:
    if known.action is Action.REJECT:
        raise ReportError(f"Decision {known.id!r} was a reject; the part went back to the bin and has no label to report.")
    return _source(known.action, known.audit, success)


def _source(action: Action, audit: bool, success: bool) -> Source:
    if action is Action.VERIFY:
        return Source.AUDIT if audit else Source.VERIFICATION
    return Source.CONFIRMED if success else Source.STOP
