"""`DataEngine`, the public face of dengine (decide, report, retrain, run), and two blocks that keep
Python's garbage collector away from decisions.

Source: the paper's section "Data engine".

engine = DataEngine(reducer="conv", policy=Policy(alpha=0.05, lower_bound=0.95), store="engine.db")
for cycle in engine.run(cell, cycles=1503):
    ...

How a decision and a report walk through an engine is in `core.EngineCore`.
"""

from __future__ import annotations

import gc
import logging
import os
import time
import weakref
from collections.abc import Callable, Collection, Iterator
from concurrent.futures import Executor
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Self

from numpy.typing import ArrayLike

from ..cells.base import Cell, check_cell
from ..decision.certificate import Certificate
from ..decision.policy import Policy
from ..errors import NotTakenError, StoreError, expect
from ..files import FilePath
from ..history.explain import Explanation, explain
from ..history.status import NEWEST, Status, as_frame, history, status
from ..model.base import EngineModel, Model
from ..recipe import Recipe
from ..records import (
    Action,
    Cycle,
    Decision,
    Outcome,
    PartNumber,
    RetrainReport,
    TraceSpec,
    as_id,
    as_outcome,
    as_success,
    source_of,
)
from ..reducers.base import Reducer
from ..representation import to_html
from ..store.opening import LONG_WAIT, opening
from ..store.outbox import Outbox
from ..store.records import StoredDecision
from ..traces import check_rate
from .core import EngineCore
from .corrections import Changed, Corrections
from .settings import (
    EngineSettings,
    agreed_trace_spec,
    check_model_settings,
    choose_recipe,
    fill_from_peers,
    named_classes,
    read_peers_trace_spec,
)
from .trainer import Clock

if TYPE_CHECKING:
    import pandas as pd

    from ..store.opening import StoreLike
    from ..store.sql import SqlStore


log = logging.getLogger("dengine")


@contextmanager
def frozen_objects() -> Iterator[None]:
    """Let Python's garbage collector ignore, until the block ends, all objects that exist now.

    A collection would go through 420,000 objects of imported libraries in 250 ms and free nothing.
    None is run when the block begins. The whole process is affected, and the end of the block
    unfreezes what others froze, too: use it in the process that owns the loop.
    """
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


@contextmanager
def uncollected() -> Iterator[None]:
    """Switch Python's garbage collector off until the block ends, then on again if it was on
    before.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


def core_of(engine: DataEngine) -> EngineCore:
    """Return the internal interface of an engine, which may change with any release.

    `dengine serve` and the tests use it.
    """
    return engine._core


def _close_forgotten(outbox: Outbox) -> None:
    """Close the outbox of an engine that a program did not close; an error is logged.

    It writes what was left, when the engine is garbage-collected or the program ends.
    """
    try:
        outbox.close()
    except StoreError as error:
        log.error("%s", error)


class DataEngine(AbstractContextManager["DataEngine"]):
    """Decides on traces, learns from reports, retrains within its budget, and remembers all of it.

    One engine belongs to one thread, which it limits to one torch thread.

    Parameters
    ----------
    reducer : str or object, optional
        A name in `REDUCERS`, `module:Class`, or a scikit-learn transformer; None: the recipe's, or
        conv.
    policy : Policy, optional
        The error level alpha, the lower bound, and what else the user decides.
    trace : TraceSpec, optional
        The contract of traces; None: the first sound trace sets it, and does not tell rate and
        unit.
    radius, folds, retrain_every, budget : optional
        As in `Recipe`; None: the recipe decides, or the reducer.
    store : str, path or SqlStore, optional
        A file or a URL (SQLite, PostgreSQL); None remembers in memory. A store that is not empty is
        opened by `DataEngine.open`.
    seed : int
        Of the reducer, and of the coin that draws audits.
    recipe : Recipe, str or path, optional
        A recipe, its name or a TOML file, for all settings that are not given beside it; it names
        its own reducer.
    model : Model, optional
        A baseline, which decides by its own rule: of a policy only audit_rate, stops, label_within,
        windows and shadow count then.
    executor : concurrent.futures.Executor, optional
        Where retrains run while the cell goes on. None: in the calling thread, between cycles;
        making the first engine of a process then takes about a second longer, since it loads what
        a retrain imports.
    replaying : bool
        End a retrain by steps alone, never by the clock, so that a seed repeats exactly.
    clock : callable
        Seconds, of any origin, by which retrains and decisions are timed.
    on_safe_mode : callable, optional
        Called with the reason when a safe mode begins, and with "" when it ends.

    Attributes
    ----------
    store : SqlStore
        The store, to be read.
    seed : int
    resumed : bool
        Whether the engine goes on with a used store.

    Raises
    ------
    SettingError
        For settings that are out of range or contradict each other, and for force limits in
        seconds while the rate of the traces is unknown.
    StoreError
        For a used store.
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
        recipe: Recipe | FilePath | None = None,
        model: Model | None = None,
        executor: Executor | None = None,
        replaying: bool = False,
        clock: Clock = time.perf_counter,
        on_safe_mode: Callable[[str], object] | None = None,
    ) -> None:
        given = {
            "radius": radius,
            "folds": folds,
            "retrain_every": retrain_every,
            "budget": budget,
            "policy": policy,
        }
        if model is not None:
            check_model_settings(reducer, given)
            if recipe is None:
                # The schedule of conv is its own.
                recipe = Recipe(retrain_every=Reducer.default_retrain_every)
        settings = EngineSettings(choose_recipe(reducer, recipe, given), seed, trace=trace)
        # Before a store is made: a wrong setting leaves none behind.
        settings, template = settings.with_template(model)
        n_traces = template.min_traces
        window = f"a window of at least {n_traces} labelled traces, on which it trains first"
        expect(settings.recipe.window >= n_traces, window, settings.recipe.window)
        with opening(store) as opened:
            if settings.trace is None:
                settings = replace(settings, trace=read_peers_trace_spec(opened))
            self._start(
                settings,
                template,
                opened,
                executor=executor,
                replaying=replaying,
                clock=clock,
                on_safe_mode=on_safe_mode,
            )
            with self._closed_on_failure():
                if opened.settings.read():  # now that the cell is owned, nobody else begins it
                    raise StoreError(
                        "The store is not empty; use DataEngine.open(url) to go on with it, "
                        "or name another store."
                    )
                self.store.settings.save(self._core.settings.now.to_store())
                if opened.product is not None:
                    self._core.resume()  # with what its peers learned

    def _start(
        self, settings: EngineSettings, template: EngineModel, store: SqlStore, **options: Any
    ) -> None:
        """Compose the engine's objects on an opened store.

        The options are executor, replaying, clock, on_safe_mode and reading. It sets `store`,
        `seed`, and `resumed` to False. From now on the store is closed when the engine is
        garbage-collected. Raises SettingError for force limits in seconds at an unknown rate.
        """
        check_rate(settings.recipe.policy.windows, settings.trace)
        self.store = store
        self.seed = settings.seed
        self.resumed = False
        self._core = EngineCore(settings, template, store, **options)
        self._corrections = Corrections(self._core)
        weakref.finalize(self, _close_forgotten, self._core.outbox)

    @contextmanager
    def _closed_on_failure(self) -> Iterator[None]:
        """Close the engine's store where the block raises, and raise the error again; else leave it
        open.
        """
        try:
            yield
        except BaseException:
            self._core.outbox.close()
            raise

    @classmethod
    def open(
        cls,
        url: StoreLike,
        *,
        reducer: Any = None,
        model: Model | None = None,
        trace: TraceSpec | None = None,
        wait: float | None = None,
        allow_import: bool | Collection[str] = False,
        **options: Any,
    ) -> Self:
        """Open a used store, and go on with the same version and the same decisions, bit for bit.

        Parameters
        ----------
        url : str, path or SqlStore
        reducer, model : object, optional
            The same object again, where the engine had one of yours that the store cannot name.
        trace : TraceSpec, optional
            The stored contract of traces, to state its rate, units or columns where they are
            unknown.
        wait : float, optional
            Seconds that a call waits for the database, as `SqlStore` takes it.
        allow_import : bool or collection of str
            Whether a `module:Class` that the store names is imported, or which of them. A class
            that `reducer` names is allowed.
        **options
            executor, replaying, clock and on_safe_mode, as `DataEngine` takes them. With
            reading=True the engine neither decides nor learns, and another engine may own the
            store: to export from it, for one.

        Returns
        -------
        DataEngine

        Raises
        ------
        StoreError
            Where the store does not exist or is not used, or another engine owns the cell.
        SettingError
            Where an object is missing or another than before, a model is not needed, or `trace`
            contradicts the stored contract.
        ImportRefusedError
            A SettingError, where a class would have to be imported that is not allowed.
        """
        engine = cls.__new__(cls)
        with opening(url, must_exist=True, wait=wait) as store:
            name = str(url) if isinstance(url, str | os.PathLike) else "the store"
            stored = EngineSettings.from_store(
                store.settings.read(), name, reducer, model, allow_import
            )
            settings = replace(stored, trace=agreed_trace_spec(store, trace))
            settings.check_request({"trace": trace})
            engine._start(*settings.with_template(model), store, **options)
            with engine._closed_on_failure():
                engine._core.resume()
                if settings.trace != stored.trace and not options.get("reading"):
                    engine._core.settings.save()
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
        """Open a used store and go on, or start on a new one; a program calls it at every start.

        Parameters
        ----------
        store : str, path, SqlStore or None
            None: a new one in memory.
        seed : int, optional
            None: that of the used store, of a peer, or 0.
        wait : float, optional
            Seconds that a call waits for the database; not used for an open store.
        allow_import : bool
            Whether any `module:Class` that the store names is imported. One that the settings name
            is imported in any case.
        **settings
            As `DataEngine` takes them. For a used store those that are given must be those in
            force: the settings of a running cell do not change in silence. `model` is as for
            `open`; `executor`, `clock`, `replaying` and `on_safe_mode` are not stored and taken as
            they are. A new cell of a product takes what is left open from its peers.

        Returns
        -------
        DataEngine
            Its `resumed` says whether the store was used.

        Raises
        ------
        SettingError
            Where a given setting is not the used store's.
        StoreError
            Where another engine owns the cell, or the store cannot be used.
        ImportRefusedError
            Where a class would have to be imported that is not allowed.
        """
        with opening(store, wait=wait) as opened:
            allowed = allow_import or named_classes(**settings)
            if not opened.settings.read():
                return cls(
                    store=opened, **fill_from_peers(settings | {"seed": seed}, opened, allowed)
                )
            names = ("model", "trace", "executor", "replaying", "clock", "on_safe_mode")
            options = {name: settings.pop(name) for name in names if name in settings}
            recipe = settings.get("recipe")
            reducer = settings.get("reducer")
            if reducer is None and isinstance(recipe, Recipe):
                reducer = recipe.reducer
            engine = cls.open(opened, reducer=reducer, allow_import=allowed, **options)
            with engine._closed_on_failure():
                engine._core.settings.now.check_request(settings | {"seed": seed})
            return engine

    def close(self) -> None:
        """Finish a retrain under way, within seconds, write everything, and close the store.

        A retrain that takes longer is dropped. A second call does nothing. What the disk does not
        take is given up, and an error is logged; no report on it was acknowledged. Raises
        StoreError while another thread uses the engine.
        """
        self._core.close()

    def flush(self, wait: float | None = None) -> None:
        """Wait until everything known so far is on disk, and in the store if that answers in time.

        Raises NotTakenError after `wait` seconds; None: the store's own limit.
        """
        self._core.flush(wait)

    # Decisions

    def decide(
        self, trace: ArrayLike, part: PartNumber = None, *, decision_id: str | None = None
    ) -> Decision:
        """Decide on one trace, and record the decision.

        Parameters
        ----------
        trace : array or DataFrame, shape (samples,) or (channels, samples)
            The rows of a DataFrame are samples.
        part : str or int, optional
            The part's number. A part that comes again has one vote, and none on itself.
        decision_id : str, optional
            An id of the caller's. The same id and trace have the same decision for ever, and an
            ACCEPT or REJECT is on disk when this returns.

        Returns
        -------
        Decision
            VERIFY where anything else than the errors below fails. Where an id cannot be looked up,
            the VERIFY is not recorded.

        Raises
        ------
        TraceError
            For a wrong shape, a first trace of less than 10 samples, an id that belongs to another
            trace, and a part's number that is none.
        SettingError
            For a first trace that the policy's force limits do not fit.
        ReportError
            For an id that is no id.
        StoreError
            For an engine that is closed, was opened for reading, or is in use by another thread.
        """
        return self._core.decide(trace, part, decision_id)

    def report(
        self,
        decision_id: str,
        success: bool,
        trace: ArrayLike | None = None,
        part: PartNumber = None,
    ) -> RetrainReport | None:
        """Report the outcome of a decision; the label survives a killed process once this returns.

        Parameters
        ----------
        decision_id : str
        success : bool
            The result of the verification; False for a line stop after an accept, True for a part
            known to be good. A line stop that comes after the part was confirmed, however late,
            takes that back and counts as a correction. The label of a rejected part that somebody
            looked at trains, and does not update the rule.
        trace, part : optional
            Only for a line stop whose decision was lost: it is then stored with this trace.

        Returns
        -------
        RetrainReport or None
            The report of a retrain in this thread that the label set off, if any.

        Raises
        ------
        ReportError
            For an unknown id, a second report, or what is no label.
        TraceError
            For a wrong trace or part's number of a lost decision.
        StoreError
            Where the label is not known to be on disk: report the same again. Also for an engine
            that is closed, was opened for reading, or is in use by another thread.
        """
        return self._core.report(decision_id, success, trace, part)

    def run(self, cell: Cell, cycles: int) -> Iterator[Cycle]:
        """Drive a cell, and yield a record of each cycle as it happens.

        In each cycle the cell inserts a part, the engine decides, and the cell verifies it, lets it
        go on or rejects it; a known outcome is reported, and retrains happen between cycles. When
        the iteration ends, also by an error of the cell, everything known is written. What the
        engine does not know of its traces is taken from a `TraceSpec` in the cell's attribute
        `spec`, if there is one. Python's garbage collector works between decisions, and only on
        objects that are newer than the first cycle (`gc.freeze`).

        Parameters
        ----------
        cell : Cell
        cycles : int
            Number of parts.

        Returns
        -------
        iterator of Cycle
            The first part is inserted with its first `next`, once a retrain can begin at once.

        Raises
        ------
        SettingError
            Before the first part, for a cell that lacks one of its four methods, or whose `spec`
            cannot hold the force limits.
        """
        check_cell(cell)
        return self._run(cell, cycles)

    def _run(self, cell: Cell, cycles: int) -> Iterator[Cycle]:
        """Yield a record of each cycle; at the end, also after an error, write everything to disk.

        The first cycle waits for what would otherwise delay the first retrain.
        From then on the garbage collector ignores the objects that exist, until the end. Raises
        NotTakenError where the disk does not take everything in time.
        """
        self._core.wait_until_warm()
        spec = getattr(cell, "spec", None)
        if isinstance(spec, TraceSpec):
            self._core.set_trace_spec(spec)
        with ExitStack() as ending:
            ending.callback(self.flush, LONG_WAIT)
            ending.enter_context(frozen_objects())
            for index in range(cycles):
                yield self._cycle(cell, index)

    def _cycle(self, cell: Cell, index: int) -> Cycle:
        """Have the cell insert one part, decide, do what the decision says, and report its outcome.

        An ACCEPT of which the cell learns nothing is not reported, nor is a REJECT. A label that
        cannot be written is logged and waits. A retrain that is due is begun or done. Returns the
        record of the cycle; `seconds` is the duration of the decision alone.
        """
        trace = cell.insert()
        with uncollected():
            begin = self._core.clock()
            # A cell may know its parts' numbers.
            decision = self.decide(trace, getattr(cell, "part", None))
            seconds = self._core.clock() - begin
        outcome = None
        success = None
        source = None
        if decision.action is Action.VERIFY:
            success = as_success(cell.verify(), f"decision {decision.id}, by verify()")
        elif decision.action is Action.ACCEPT:
            outcome = as_outcome(cell.proceed(), f"decision {decision.id}, by proceed()")
            # Silence is not a success.
            success = {Outcome.STOPPED: False, Outcome.CONFIRMED: True}.get(outcome)
        else:
            cell.reject()
        if success is not None:
            source = source_of(decision.action, decision.audit, success)
            try:
                self.report(decision.id, success)
            except NotTakenError as error:
                # The label waits for the disk, and every part is verified until that is well.
                log.warning("the label of %s: %s", decision.id, error)
        retrain = self._core.process_retrains()
        return Cycle(index, decision, outcome, success, source, seconds, retrain, self.safe_mode)

    # Learning

    def retrain(self) -> RetrainReport:
        """Retrain now, in this thread, and return the report; the new version is not pinned.

        It first waits for the imports that began with the engine, some two seconds after its start.
        A version that fails, or cannot be stored, is dropped: the report has `accepted` False then.
        Raises StoreError where the labels before it cannot be stored.
        """
        if self._core.live.pinned:
            self._corrections.release()
        return self._core.retrain()

    def correct(self, decision_id: str, success: bool, author: str = "") -> Changed:
        """Correct a wrong label, or let a forgotten one count again; see `Corrections.correct`."""
        return self._corrections.correct(decision_id, success, author)

    def forget(self, *decision_ids: str, author: str = "", reason: str = "") -> Changed:
        """Leave labels out of all that is learned and counted from now on.

        See `Corrections.forget`.
        """
        return self._corrections.forget(*decision_ids, author=author, reason=reason)

    def rollback(self, version: int, author: str = "") -> Changed:
        """Let an earlier version answer again until `release`; see `Corrections.rollback`."""
        return self._corrections.rollback(version, author)

    def release(self, author: str = "") -> Changed:
        """Let retrains replace a pinned version again; see `Corrections.release`."""
        return self._corrections.release(author)

    # Policy

    @property
    def policy(self) -> Policy:
        """The policy in force; `set_policy` changes it."""
        return self._core.settings.now.recipe.policy

    def set_policy(self, policy: Policy, author: str = "") -> Changed:
        """Decide by another policy from the next decision on; see `Corrections.set_policy`."""
        return self._corrections.set_policy(policy, author)

    def set_shadow(self, on: bool, author: str = "") -> Changed:
        """Begin or end the shadow mode, in which every part is verified; see `set_policy`."""
        return self.set_policy(replace(self.policy, shadow=on), author)

    def certificate(self) -> Certificate:
        """Flush, and return bounds, at confidence 1 - alpha, on the errors of unchecked decisions.

        Decisions since the last change of policy count. Raises NotTakenError where not everything
        is on disk in time, and StoreError where the store cannot be read.
        """
        self.flush()
        policy = self.policy
        since = self._core.settings.now.policy_since
        tally = self.store.decisions.tally(since_version=since, within=policy.label_within)
        return policy.certificate(tally.outcomes)

    # Reading

    @property
    def recipe(self) -> Recipe:
        """Every setting in force; all but the policy are fixed once the engine is made."""
        return self._core.settings.now.recipe

    @property
    def trace(self) -> TraceSpec | None:
        """The contract of traces; None before the first sound trace."""
        return self._core.settings.now.trace

    @property
    def model(self) -> Any:
        """The model that answers (of a baseline, the user's own object); None before a first
        retrain.
        """
        answering = self._core.live.answering
        return None if answering is None else answering.user_model

    @property
    def version(self) -> int:
        """Number of the version that answers; 0 before the first retrain."""
        return self._core.live.version

    @property
    def safe_mode(self) -> str:
        """Why every part is verified until fresh evidence keeps the tolerance; "" if none is."""
        return self._core.live.newest.safe_mode

    def find(self, decision_id: str) -> StoredDecision | None:
        """Return a decision with its trace, and with its label where it has one; None for an
        unknown id.

        Raises StoreError where the id cannot be looked up, and ReportError for what is no id.
        """
        return self._core.outbox.find_decision(as_id(decision_id))

    def status(self, last: int = NEWEST, watching: bool = False) -> Status:
        """Flush, and return how the engine is doing; arguments and errors as of
        `history.status.status`.

        Where the disk does not take everything, `store_fault` says why, and the counts lack it.
        """
        with suppress(NotTakenError):
            self.flush()
        return self._core.complete_status(status(self.store, last, watching))

    def history(self, last: int | None = None, **where: Any) -> Iterator[StoredDecision]:
        """Yield the decisions so far, newest last.

        Arguments and errors as of `history.status.history`.
        """
        return history(self.store, last, **where)

    def history_frame(self, last: int | None = None, **where: Any) -> pd.DataFrame:
        """Return `history` as a DataFrame with a row for each decision, indexed by its id."""
        return as_frame(self.history(last, **where))

    def explain(self, decision_id: str, neighbours: int = 10) -> Explanation:
        """Explain a decision by its nearest references, `neighbours` of them.

        Raises ReportError for an unknown id.
        """
        return explain(self.store, decision_id, neighbours)

    def __repr__(self) -> str:
        parts = [f"version {self.version}", self.policy.summary]
        if self.trace is None:
            parts.append("no trace yet")
        else:
            parts.append(f"traces {self.trace.channels} x {self.trace.samples}")
        parts.append(f"{self._core.new_labels} new labels")
        if self.safe_mode:
            parts.append("safe mode")
        elif self.policy.shadow:
            parts.append("shadow mode")
        return f"<DataEngine {self.recipe.name}: {', '.join(parts)}>"

    _repr_html_ = to_html

    def __exit__(self, *exception: object) -> None:
        self.close()
