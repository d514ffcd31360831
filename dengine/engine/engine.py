"""`DataEngine`, the engine itself: it composes the objects that decide, learn and remember, and
calls them in order for each decision, report and retrain.

Source: the paper's section "Data engine".

engine = DataEngine(reducer="conv", policy=Policy(alpha=0.05, lower_bound=0.95), store="engine.db")
for cycle in engine.run(cell, cycles=1503):
    ...

`decide`, `report` and `retrain` name their steps in order. Users, `dengine serve` and the tests
call the same methods.
"""

from __future__ import annotations

import os
import time
import weakref
from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Self, TypedDict, Unpack, overload

import torch
from numpy.typing import ArrayLike

from ..cells.base import Cell, check_cell
from ..decision.certificate import Certificate
from ..decision.policy import Policy
from ..errors import NotTakenError, StoreError, expect, listed, log
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
from ..store.journalled import CLOSE_SECONDS
from ..store.opening import LONG_WAIT, open_outbox, opening
from ..store.outbox import Outbox
from ..store.records import Clock, StoredDecision, unknown_decision
from ..traces import check_rate
from .corrections import Changed, Corrections
from .decide import DecisionMaker, as_part
from .exclusive import ExclusiveUse
from .feedback import Feedback, Remedy, SafeModeListener
from .fleet import Peers
from .garbage import frozen_objects, uncollected
from .guard import NOT_PRECOMPUTED, guarded
from .learner import Learner
from .live_model import LiveModel
from .settings import (
    AllowedImports,
    EngineSettings,
    Settings,
    SettingsInForce,
    agreed_trace_spec,
    check_model_settings,
    choose_recipe,
    fill_from_peers,
    named_classes,
    read_peers_trace_spec,
)
from .state import EngineState
from .trainer import Retrainer, TrainingWindow

if TYPE_CHECKING:
    import pandas as pd

    from ..store.opening import StoreLike
    from ..store.sql import SqlStore


class RunOptions(TypedDict, total=False):
    """How an engine runs; nothing of it is stored, so it is given at every start."""

    executor: Executor | None
    replaying: bool
    clock: Clock
    on_safe_mode: SafeModeListener


def _close_forgotten(outbox: Outbox) -> None:
    """Close the outbox of an engine that a program did not close; a StoreError is logged.

    The outbox records decisions and labels; what it did not write to the store yet is written. This
    is called when the engine is garbage-collected or the program ends.
    """
    try:
        outbox.close()
    except StoreError as error:
        log.error("%s", error)


class DataEngine(AbstractContextManager["DataEngine"]):
    """Decides on traces, learns from reports, retrains in a time budget, and remembers all of it.

    An engine belongs to one thread, in which it lets torch use only one thread.

    Parameters
    ----------
    reducer : str or object, optional
        A name in `REDUCERS`, `module:Class`, or a scikit-learn transformer; None: the recipe's, or
        conv.
    policy : Policy, optional
        The error level alpha, the lower bound, and what else the user decides.
    trace : TraceSpec, optional
        Shape, rate and unit of all traces. None: the first trace without a fault sets the shape,
        and rate and unit are unknown.
    radius, folds, retrain_every, budget : optional
        As in `Recipe`; None: the recipe decides, or the reducer.
    store : str, path or SqlStore, optional
        A file or a URL (SQLite, PostgreSQL); None remembers in memory. A store that is not empty is
        opened by `DataEngine.open`.
    seed : int
        The seed of the reducer and of the draw of audits.
    recipe : Recipe, str or path, optional
        A recipe, its name or a TOML file, for all settings that are not given as arguments. The
        reducer is part of the recipe: another `reducer` beside it is refused.
    model : Model, optional
        A baseline, no `ModelPrediction`; it decides by its own rule: of a policy only audit_rate,
        stops, label_within, force_limits and shadow count then.
    executor : concurrent.futures.Executor, optional
        Where retrains run while the robot cell goes on. None: in the calling thread, between
        cycles; making the first engine of a process then takes about a second longer, since it
        loads what a retrain imports.
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
    state : EngineState
        What only the running engine knows: new labels, faults, whether a retrain is under way.

    Raises
    ------
    SettingError
        For settings that are out of range or contradict each other, and for force limits in seconds
        while the rate of the traces is unknown.
    StoreError
        If the store is used.
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
        **options: Unpack[RunOptions],
    ) -> None:
        given = {
            "radius": radius,
            "folds": folds,
            "retrain_every": retrain_every,
            "budget": budget,
            "policy": policy,
        }
        # Before a store is made: a wrong argument leaves none behind.
        unknown = options.keys() - RunOptions.__annotations__.keys()
        expect(not unknown, "arguments of DataEngine", listed(unknown))
        settings, template = _new_settings(reducer, recipe, model, given, seed, trace)
        with opening(store) as opened:
            if settings.trace is None:
                settings = replace(settings, trace=read_peers_trace_spec(opened))
            self._compose(settings, template, opened, **options)
            with self._closed_on_failure():
                if opened.settings.read():  # now that the cell is owned, nobody else begins it
                    raise StoreError(
                        "The store is not empty; use DataEngine.open(url) to go on with it, "
                        "or name another store."
                    )
                self.store.settings.save(settings.to_store())
                if opened.product is not None:
                    self._resume()  # with what its peers learned

    def _compose(
        self,
        settings: EngineSettings,
        template: EngineModel,
        store: SqlStore,
        executor: Executor | None = None,
        replaying: bool = False,
        clock: Clock = time.perf_counter,
        on_safe_mode: SafeModeListener = None,
        reading: bool = False,
    ) -> None:
        """Make the objects of which the engine consists, on an opened store, and connect them.

        `template` is the untrained model, and the arguments from `executor` to `on_safe_mode` are
        those of `DataEngine`. One of the objects is the outbox, which records decisions and labels
        in the store, and before that in a journal on the local disk, unless the engine only reads
        (`reading`) or the store is in memory. With a journal it claims the robot cell, so that no
        other engine may run on it, and writes what an earlier process left in the journal to the
        store. It checks the store in any case (`open_outbox`); version and labels are not restored
        yet (`_resume`). When the engine is garbage-collected or the program ends,
        `_close_forgotten` closes the outbox, and with it a store that is not in memory. Without an
        executor, and unless the engine only reads, the modules that a retrain imports are loaded;
        what that raises, for a reducer of the user's, is raised. Limits this thread to one torch
        thread. Raises SettingError for force limits (an operator's limits of the signal) in seconds
        at an unknown rate, and StoreError if another engine owns the cell or the store cannot be
        used.
        """
        recipe = settings.recipe
        check_rate(recipe.policy.force_limits, settings.trace)
        torch.set_num_threads(1)
        self._retrains_in_line = executor is None and not reading
        if self._retrains_in_line:
            template.warm_up()  # or the first retrain would wait for it
        self.store = store
        self.seed = settings.seed
        self.resumed = False
        self._clock = clock
        self._exclusive = ExclusiveUse()
        self._outbox = open_outbox(store, recipe.window, reading=reading, patient=replaying)
        self._settings = SettingsInForce(settings, self._outbox)
        self._live = LiveModel(
            template, TrainingWindow(recipe.window), self._outbox, self._settings
        )
        peers = None if store.product is None else Peers(self._live, clock)
        self._feedback = Feedback(self._live, on_safe_mode)
        retrainer = Retrainer(
            self._live.window,
            None if replaying else recipe.budget,
            recipe.max_steps,
            executor,
            clock,
        )
        self._learner = Learner(self._live, self._feedback, peers, retrainer)
        self._maker = DecisionMaker(self._live)
        self._corrections = Corrections(self._learner)
        self.state = EngineState(self._learner)
        weakref.finalize(self, _close_forgotten, self._outbox)

    def _resume(self) -> None:
        """Restore what the store holds: version, references, rule, labels and awaited outcomes.

        References are labelled points that new traces are compared with, and the rule turns the
        bounds of a success probability into an action. The awaited outcomes are those of checked
        and accepted parts. The engine then decides bit for bit as before it was closed, with two
        exceptions: if the newest version is damaged, the newest intact one decides, and if the
        store differs from its ledger (its hash chain), every part is verified. A damaged version or
        trace is reported by an event (a row in the store's log). A new cell of a product (robot
        cells that share labels and versions) decides by the product's newest version. A model of
        which the store has only the numbers of its traces is trained on them again; if one of these
        is damaged or missing, no model is in force. A thread may be started that computes in
        advance for the next retrain. This method is called once, before the first decision, and
        waits for the store without a time limit. If retrains run in the calling thread, it also
        waits until the first retrain can begin without delay. Raises the errors of
        `LiveModel.resume` and `Feedback.resume`; StoreError if the store cannot be read is one of
        them.
        """
        self._learner.resume()
        self._feedback.resume()
        if self._retrains_in_line:
            self._wait_until_warm()

    def _wait_until_warm(self) -> None:
        """Wait until the first retrain can begin without delay.

        When it returns, the modules that a retrain imports are loaded, and the thread that computes
        in advance for the next training (`Learner.resume` may have started it) is done. If there
        are new labels and no version yet, the features of their traces are among what is computed,
        and the code for decisions is compiled if the model can be compiled. If a version is in
        force, nothing more is computed here: the next training itself computes the features of
        traces that came since. There is no time limit; if loading or computing fails, that is
        logged, and nothing is raised.
        """
        guarded(NOT_PRECOMPUTED, self._live.template.warm_up)
        if self.state.new_labels and not self.version:
            self._learner.precompute()
        self._learner.wait_until_precomputed()

    @contextmanager
    def _closed_on_failure(self) -> Iterator[None]:
        """Close the outbox and raise the error again if the block raises; else leave it open.

        The outbox records the decisions and labels of the engine; closing it also closes the store,
        unless that is in memory. If closing raises StoreError, that is raised instead.
        """
        try:
            yield
        except BaseException:
            self._outbox.close()
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
        allow_import: AllowedImports = False,
        reading: bool = False,
        **options: Unpack[RunOptions],
    ) -> Self:
        """Open a store that had an engine; go on with its version and decisions, bit for bit.

        The engine owns the robot cell until `close`, unless it only reads: no other engine may run
        on the cell. It limits this thread to one torch thread. Records that an earlier process left
        in the journal (the file on the local disk that gets each record first) are written to the
        store; an engine that only reads leaves them there and does not know them. If rows of the
        store are not as they were written, nothing is raised, but every part goes to the slow check
        (`EngineState.integrity_error`). If the newest version (trained model) is damaged, the
        newest intact one decides, and an event (a row in the store's log) says so, also with
        `reading`. Without an executor, unless it only reads, the call also waits until a retrain
        can begin at once. If it raises, a store that it opened is closed; an `SqlStore` that was
        passed may be closed, too.

        Parameters
        ----------
        url : str, path or SqlStore
            A file, a URL or an open store.
        reducer, model : object, optional
            If the engine had an object of yours that the store cannot name: the same object again.
            A reducer's name is accepted, but not compared with the store's.
        trace : TraceSpec, optional
            The `TraceSpec` (shape, rate and unit of all traces) as the store has it, perhaps with a
            rate, units or columns that were unknown so far; they are stored, unless `reading`. If
            the store has none yet, any may be given.
        wait : float, optional
            Seconds that a call waits for the database, like `wait` of `SqlStore`; not used for an
            open store.
        allow_import : bool or collection of str
            Whether a `module:Class` that the store names is imported, or which of these classes
            are. A class that `reducer` names is allowed.
        reading : bool
            Open the store only for reading, for example to export: calls that decide or learn raise
            StoreError. Another engine may own the cell.
        **options
            executor, replaying, clock and on_safe_mode, as `DataEngine` takes them. With an
            executor the ids of all decisions are read before this returns (a second for a million),
            so that `decide` looks up no new id in the store.

        Returns
        -------
        DataEngine

        Raises
        ------
        StoreError
            If the store does not exist, had no engine, is damaged or cannot be read, if another
            engine owns the cell, or if this dengine cannot restore the newest version (in rare
            cases KeyError, ValueError or NotImplementedError).
        Exception
            What an object of yours raises that is loaded, or trained again because the store has
            only the numbers of its traces.
        SettingError
            If an object of yours is missing or is another one than the engine had, if a `model` is
            given to an engine that has its own, if `trace` contradicts the stored `TraceSpec` or
            that of another cell of the product (robot cells that share labels and versions), if the
            stored recipe (the settings) cannot be read, or if its force limits (an operator's
            limits of the signal) do not fit the traces.
        ImportRefusedError
            A SettingError, if a class would have to be imported that is not allowed.
        """
        engine = cls.__new__(cls)
        with opening(url, must_exist=True, wait=wait) as store:
            name = str(url) if isinstance(url, str | os.PathLike) else "the store"
            stored = EngineSettings.from_store(
                store.settings.read(), name, reducer, model, allow_import
            )
            settings = replace(stored, trace=agreed_trace_spec(store, trace))
            settings.check_request({"trace": trace})
            engine._compose(*settings.with_template(model), store, reading=reading, **options)
            with engine._closed_on_failure():
                engine._resume()
                if settings.trace != stored.trace and not reading:
                    engine._settings.save()
                if options.get("executor") is not None:
                    engine._outbox.load_ids()
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
            None: the seed of the used store or, in a new cell of a product (robot cells that share
            labels and versions), of the first other cell; else 0.
        wait : float, optional
            Seconds that a call waits for the database; not used for an open store.
        allow_import : bool
            Whether any `module:Class` that the store names is imported. A class that the settings
            name is imported in any case.
        **settings
            As `DataEngine` takes them. For a used store, the given settings must be the settings in
            force, so that a running robot cell does not change unnoticed. Of a recipe (all settings
            in one object) or policy all fields are compared, also those at their defaults. The
            shadow mode (every part is verified), missing force limits (an operator's limits of the
            signal) and arguments that are left out are not compared
            (`EngineSettings.check_request`). As for `open`, a reducer that is an object and `model`
            must be the same object again, and `trace` may add a rate, units or columns that were
            unknown. How the engine runs (`executor`, `clock`, `replaying`, `on_safe_mode`) is not
            stored, so any may be given. A new cell of a product also takes the recipe of the first
            other cell, unless it is given a recipe, reducer or model, or the other cell was given
            an object as reducer or model.

        Returns
        -------
        DataEngine
            Its `resumed` says whether the store was used.

        Raises
        ------
        SettingError
            If a given setting differs from the used store's, contradicts that of another cell of
            the product, is unknown, or is out of range, if an object of yours is missing or is
            another one than the engine had, and if a stored recipe cannot be read. A store that was
            opened here is then closed; an `SqlStore` that was passed may be, too.
        StoreError
            If another engine owns the cell, the store cannot be used, or this dengine cannot
            restore its newest version (in rare cases KeyError, ValueError or NotImplementedError).
        Exception
            What an object of yours raises that is loaded, or trained again.
        ImportRefusedError
            If a class would have to be imported that is not allowed.
        """
        with opening(store, wait=wait) as opened:
            allowed = allow_import or named_classes(**settings)
            if not opened.settings.read():
                return cls(
                    store=opened, **fill_from_peers(settings | {"seed": seed}, opened, allowed)
                )
            names = ("model", "trace", *RunOptions.__annotations__)
            options = {name: settings.pop(name) for name in names if name in settings}
            recipe = settings.get("recipe")
            reducer = settings.get("reducer")
            if reducer is None and isinstance(recipe, Recipe):
                reducer = recipe.reducer
            engine = cls.open(opened, reducer=reducer, allow_import=allowed, **options)
            with engine._closed_on_failure():
                engine._settings.now.check_request(settings | {"seed": seed})
            return engine

    def close(self) -> None:
        """Finish a retrain under way, within seconds, write everything, and close the store.

        A training that is not done 5 s after this call is dropped. In a product (robot cells that
        share labels and versions) the call first takes in what the other cells stored; if that has
        a changed label or a rollback (to an earlier version), or the store does not answer, a
        retrain that is not in force yet is lost. A second call does nothing, nor does one in a
        forked process. Records that only the database does not take stay in the journal, a file on
        the local disk, and the next engine writes them. Records that the disk does not take are
        given up, and an error is logged; no call has said that they are on disk. If the disk hangs,
        the store stays open, and no other engine can own the cell until the process ends. An engine
        that replays recordings (`replaying=True`) waits for the disk and the database without a
        time limit. A store in memory stays open. Raises StoreError while another thread uses the
        engine.
        """
        with self._exclusive:
            if self._outbox.is_usable:
                self._learner.advance(to_the_end=True, wait=CLOSE_SECONDS)
            self._outbox.close()

    def flush(self, wait: float | None = None) -> None:
        """Wait until everything known so far is on disk, and in the store if that answers in time.

        If a part was confirmed as good and then stopped the line, or a check was reported after it
        had counted as overdue, the rule was updated with a wrong outcome; if the store has
        answered, the rule is put right, too. For a line stop a training under way is discarded
        before, and begins again; a model that cannot take a label back is retrained. Raises
        NotTakenError if the disk fails or takes longer than `wait` seconds; None: the store's own
        limit. The store is waited for up to its own limit.
        """
        self._outbox.flush(wait)
        self._learner.catch_up()

    # Decisions

    def decide(
        self,
        trace: ArrayLike,
        part: PartNumber = None,
        *,
        decision_id: str | None = None,
        timed_out: bool = False,
    ) -> Decision:
        """Decide whether the part of a trace is verified, accepted or rejected; record this.

        Before that, a version that the executor (a pool beside the engine) has trained is taken one
        step further (the steps are test, store, put in force; in a product, robot cells that share
        labels and versions, all are taken, after what the other cells stored, and the call waits
        for the store). Accepted parts without a report are confirmed as good with
        `Policy(stops="all")`, under which every bad one is reported in time; else they are counted
        as unreported. If a report has replaced an outcome that the decision rule was updated with,
        the rule is put right, as by `flush`, which may retrain the model. After the decision,
        checks without a report for too long (`Policy.label_within`) update the rule as wrong
        decisions; then, if a safe mode (after an alarm, parts are verified until new outcomes are
        good) began or ended, an event (a row in the store's log) is recorded, and `on_safe_mode` is
        called. For an id that has a decision nothing of this is done, and that decision is
        returned.

        Parameters
        ----------
        trace : array, shape (samples,) or (channels, samples)
            The first trace without a fault (like a NaN) sets the `TraceSpec` (the shape of all
            traces), if none is in force.
        part : str or int, optional
            The part's number. The labels of a part that comes again count less than those of
            different parts, and not at all for this part itself.
        decision_id : str, optional
            An id that the caller chooses. The same id and trace always have the same decision, and
            an ACCEPT or REJECT is on disk when this returns. None: a new id is made, and the call
            does not wait for the disk.
        timed_out : bool, default False
            The caller, who gave an id, does not wait any more and verifies the part. Record this as
            VERIFY with `Reason.LATE`, without asking the model. If the id has a decision already,
            that decision is returned, whatever it is. None of the steps above is done, and rule and
            model learn nothing of it. If the trace or the store has a fault, this fault is the
            reason instead. Any thread may make this call, also while another thread uses the
            engine; it waits for the disk, but not for that thread. With a store in memory, or while
            no `TraceSpec` is in force, the VERIFY is not recorded.

        Returns
        -------
        Decision
            If anything fails that is not an error below, the decision is VERIFY. If an id cannot be
            looked up, this VERIFY is not recorded.

        Raises
        ------
        TraceError
            For a wrong shape, values that are no real numbers, a first trace of less than 10
            samples, an id that belongs to another trace, and an invalid part number.
        SettingError
            For a first trace that the policy's force limits (an operator's limits of the signal) do
            not fit, and, once the store takes the new settings, for a `TraceSpec` that contradicts
            that of another robot cell of the product.
        ReportError
            For an invalid id, and with `timed_out` for none.
        StoreError
            For an engine that is closed, was opened for reading or before the process was forked,
            and, unless `timed_out`, for one that is in use by another thread.
        """
        self._outbox.check_usable()
        if timed_out:
            return self._maker.record_timeout(trace, part, decision_id)
        with self._exclusive:
            id_ = None if decision_id is None else as_id(decision_id)
            number = as_part(part)
            if id_ is not None:  # it has one answer for ever
                earlier = self._maker.find_earlier(id_, number, trace)
                if earlier is not None:
                    return earlier
            self._learner.advance()  # the newest version is to answer
            x = self._maker.convert(trace)  # a wrong trace raises before it confirms a part
            self._learner.catch_up()
            self._feedback.confirm_unreported()
            stored = self._maker.record(x, number, id_)
            if id_ is not None:
                stored = self._maker.sync(stored)
            self._feedback.record_decision(stored)
            self._feedback.announce_safe_mode()  # last: a user's function may fail
        return stored.decision

    def report(self, decision_id: str, success: bool) -> RetrainReport | None:
        """Report the outcome of a decision; once this returns, the label survives a power failure.

        (With a store in memory it ends with the process.) Before that, a version that the executor
        has trained is taken one step further (the steps are test, store, put in force; in a
        product, robot cells that share labels and versions, all are taken). After the label is
        learned, a safe mode (after an alarm, parts are verified until new outcomes are good) may
        begin or end; then an event (a row in the store's log) is recorded, and `on_safe_mode` is
        called. A retrain that is due runs in this thread or begins in the executor. In a product,
        newer versions of the other cells and their changes of labels may be taken over, too. The
        label of a trace with a fault, like a NaN, is stored, but not learned; no retrain follows
        then, and what the other cells stored is left for later.

        If a report or the next decision had confirmed the part as good already, the call also waits
        for the store, so that the decision rule is corrected now; if the store does not answer,
        this happens later. For such a correction a training under way is discarded and begins
        again, and a model that cannot take a label back, like one that the user handed in, is
        retrained in this thread, or, if it is pinned (kept in force by `rollback`), fitted again.

        Parameters
        ----------
        decision_id : str
        success : bool
            The result of the verification; False if an accepted part was bad and stopped the line,
            True for a part known to be good. A line stop that comes after the part was confirmed as
            good, however late, takes the confirmation back and counts as a correction. If somebody
            inspected a rejected part, its label is used for training, but does not update the rule.

        Returns
        -------
        RetrainReport or None
            The report of a retrain that was due and ran in this thread, if any.

        Raises
        ------
        ReportError
            For an unknown or invalid id, a second report on the decision, or an invalid label.
        StoreError
            If it is not certain that the label is on disk (NotTakenError): it is learned all the
            same, and the same report may come again. If the id cannot be looked up, or the stored
            trace is damaged: nothing is learned. Also for an engine that is closed, was opened for
            reading or before a fork, or is in use by another thread.
        Exception
            What the copying of a model that the user handed in raises, before a retrain; the label
            is on disk then.
        """
        label = as_success(success)  # refused before anything is written
        id_ = as_id(decision_id)
        self._outbox.check_usable()
        with self._exclusive:
            self._learner.advance()  # so that a version that is ready learns the label as well
            stored = self._outbox.find_decision(id_, unsynced=True)
            if stored is None:
                raise unknown_decision(id_)
            self._feedback.take_in(stored, label)
            self._outbox.sync()  # before anything else: nobody may hear of a label that can be lost
            self._feedback.note_synced(id_)
            if self._feedback.remedy is Remedy.CORRECT:
                with suppress(StoreError):  # then the rule is put right when the store is back
                    self._outbox.drain()
            self._learner.catch_up()  # the rule is put right, the label enters the window
            self._feedback.announce_safe_mode()  # a user's function that fails costs no label
            if stored.quarantined:
                return None
            # Last, since it may take its budget.
            return self._learner.retrain_if_due()

    def run(self, cell: Cell, cycles: int) -> Iterator[Cycle]:
        """Drive a robot cell, and yield a record of each cycle as it happens.

        In each cycle the cell inserts a part, the engine decides, and the cell verifies it, lets it
        go on or rejects it. A known outcome is reported, and retrains happen between cycles. When
        the iteration ends, also by an error of the cell, everything known is written. If the cell
        has a `TraceSpec` as its attribute `spec`, the engine takes from this spec what it does not
        know about the traces yet. The attribute `part`, if there is one, is each part's number.
        Python's garbage collector works between decisions, and only on objects that are newer than
        the first cycle (`gc.freeze`).

        Parameters
        ----------
        cell : Cell
        cycles : int
            Number of parts.

        Returns
        -------
        iterator of Cycle
            The first `next` waits until a retrain could begin without delay, and then inserts the
            first part.

        Raises
        ------
        SettingError
            Before the first part, for a cell that lacks one of its four methods, or whose `spec`
            cannot hold the force limits.
        TraceError
            If `decide` does not take a trace of the cell.
        ReportError
            If `verify` returns no label, or `proceed` returns no Outcome.
        StoreError
            For an engine that is closed, was opened for reading or before a fork, or is in use by
            another thread.
        NotTakenError
            At the end, if the disk does not take everything within 10 seconds. A label that the
            disk does not take meanwhile is logged, and the run goes on.
        """
        check_cell(cell)
        return self._run(cell, cycles)

    def _run(self, cell: Cell, cycles: int) -> Iterator[Cycle]:
        """Yield a record of each cycle; at the end, also after an error, write everything to disk.

        A cycle is what the cell does with one part. Before the first cycle this waits until a
        retrain could begin without delay, and takes from the cell's `spec`, a `TraceSpec`, what the
        engine does not know about the traces yet. From then until the end the garbage collector
        ignores the objects that exist at that moment. Raises the errors of `run`, for example
        NotTakenError if the disk does not take everything within 10 seconds.
        """
        self._wait_until_warm()
        spec = getattr(cell, "spec", None)
        if isinstance(spec, TraceSpec):
            self._outbox.check_usable()
            with self._exclusive:
                self._maker.set_trace_spec(spec)
        try:
            with frozen_objects():
                for index in range(cycles):
                    yield self._cycle(cell, index)
        finally:
            self.flush(LONG_WAIT)

    def _cycle(self, cell: Cell, index: int) -> Cycle:
        """Run a cycle: insert a part, decide, act on the decision, and report the outcome.

        `index` is the number of the cycle, from 0. The robot cell inserts the part, whose number is
        its attribute `part`, if it has one, and then verifies it, lets it go on or rejects it. A
        REJECT is not reported, nor is an ACCEPT if the cell does not know its outcome. A label that
        cannot be written to the disk is logged, and written later. A retrain that is due is begun
        or done (`poll`). An exception of the cell is raised unchanged, and so are the other errors
        of `decide`, `report` and `poll`; ReportError is raised if the cell returns no label or
        outcome. Returns the record of the cycle; its `decide_seconds` is the duration of the
        decision alone, during which Python's garbage collector is off.
        """
        trace = cell.insert()
        with uncollected():
            begin = self._clock()
            # A cell may know its parts' numbers.
            decision = self.decide(trace, getattr(cell, "part", None))
            seconds = self._clock() - begin
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
            source = source_of(decision, success)
            try:
                self.report(decision.id, success)
            except NotTakenError as error:
                # The label waits for the disk, and every part is verified until that is well.
                log.warning("the label of %s: %s", decision.id, error)
        retrain = self.poll()  # may change the safe mode
        return Cycle(index, decision, outcome, success, source, seconds, retrain, self.safe_mode)

    # Learning

    @overload
    def retrain(self) -> RetrainReport: ...

    @overload
    def retrain(self, wait: bool) -> RetrainReport | None: ...

    def retrain(self, wait: bool = True) -> RetrainReport | None:
        """Retrain now and return the report; with `wait` False begin to retrain in the executor.

        A version that is pinned (kept in force by `rollback`) is released first. In a product
        (robot cells that share labels and versions) newer versions, labels and changes of labels of
        the other cells are taken in. A retrain that fails, has no label to train on, or cannot be
        stored, is dropped: the report has `accepted` False then. If a version was pinned, its
        release announces a safe mode (after an alarm, parts are verified until new outcomes are
        good) that began or ended; otherwise the next `decide`, `report` or `poll` does. Raises
        StoreError if the release of a pinned version cannot be stored, if the labels that came
        before cannot be stored, in a product if the store does not answer, and for an engine that
        is closed, was opened for reading or before a fork, or is in use by another thread. What the
        copying of a model that the user handed in raises is raised, too.

        Parameters
        ----------
        wait : bool, default True
            True: a version that is already trained is first put in force or dropped, and a training
            that is not done is discarded. With an executor the first such call also loads the
            modules that a retrain imports; if that fails, it is logged. False: begin to retrain in
            the executor, and return None; `poll` brings it to its end. If a retrain is under way, a
            trained version is first taken one step further (in a product, all steps): from the
            executor, then through its test and the store into force. Another retrain is begun only
            if none is under way then. If the executor cannot begin yet, `poll` or `report` begins
            it. Without an executor, or if the executor takes no work because it died or hangs, the
            retrain runs in this thread, and its report is returned. Nothing is begun if another
            cell of the product pinned a version of which this cell had not heard yet.

        Returns
        -------
        RetrainReport or None
            None only with `wait` False.
        """
        if self._live.pinned:
            self.release()
        self._outbox.check_usable()
        with self._exclusive:
            if wait:
                # Its time is no part of the retrain's.
                guarded(NOT_PRECOMPUTED, self._live.template.warm_up)
                self._learner.end_training()  # what it would give lacks the newest labels
            else:
                self._learner.advance()
            return self._learner.retrain(wait)

    def poll(self, brief: bool = False) -> RetrainReport | None:
        """Put a trained version in force, retrain if that is due, and announce a safe mode.

        `run` calls it after each part. In a loop of your own `decide` and `report` together do the
        same, but each takes a version that the executor has trained only one step further (the
        steps are test, store, put in force). A training that is not done is not waited for. Without
        an executor a retrain that is due runs here, also with `brief`. Before a retrain begins,
        also one in the executor, the call waits until the store has all labels; if it does not take
        them in time, or has a fault, the retrain waits for a later call. In a product (robot cells
        that share labels and versions), newer versions of the other cells and their changes of
        labels are taken over; they are looked for once a second, and also when a retrain is due or
        its training is done. If a safe mode (after an alarm, parts are verified until new outcomes
        are good) began or ended, an event (a row in the store's log) is recorded, and
        `on_safe_mode` is called.

        Parameters
        ----------
        brief : bool, default False
            True: if the executor has trained a version, take it only one step further; the longest
            step, the test, takes some tens of milliseconds. False: take it through all steps, until
            it is in force or is dropped. In a product it is always taken through all steps.

        Returns
        -------
        RetrainReport or None
            The newest report, of a retrain that was accepted or dropped, or of a version that a
            rollback, a release or a new policy made. None if there is none, or if this method has
            returned it before. `report` and `retrain` may have returned it, too.

        Raises
        ------
        StoreError
            While another thread uses the engine, and if it is closed, was opened for reading or
            before a fork.
        Exception
            What the copying of a model that the user handed in raises, before a retrain.
        """
        self._outbox.check_usable()
        with self._exclusive:
            self._learner.advance(to_the_end=not brief)
            self._learner.retrain_if_due(once=True)
            self._feedback.announce_safe_mode()
            return self._learner.take_report()

    def correct(self, decision_id: str, success: bool, author: str = "") -> Changed:
        """Correct a wrong label, or let a forgotten one count again; see `Corrections.correct`."""
        with self._exclusive:
            return self._corrections.correct(decision_id, success, author)

    def forget(self, *decision_ids: str, author: str = "", reason: str = "") -> Changed:
        """Leave labels out of all that is learned and counted from now on.

        See `Corrections.forget`.
        """
        with self._exclusive:
            return self._corrections.forget(*decision_ids, author=author, reason=reason)

    def rollback(self, version: int, author: str = "") -> Changed:
        """Put an earlier version in force again until `release`; see `Corrections.rollback`."""
        with self._exclusive:
            return self._corrections.rollback(version, author)

    def release(self, author: str = "") -> Changed:
        """Let retrains replace a pinned version again; see `Corrections.release`."""
        with self._exclusive:
            return self._corrections.release(author)

    # Policy

    @property
    def policy(self) -> Policy:
        """The policy in force; `set_policy` changes it."""
        return self.recipe.policy

    def set_policy(self, policy: Policy, author: str = "") -> Changed:
        """Decide by another policy from the next decision on; see `Corrections.set_policy`."""
        with self._exclusive:
            return self._corrections.set_policy(policy, author)

    def set_shadow(self, on: bool, author: str = "") -> Changed:
        """Begin or end the shadow mode, in which every part is verified; see `set_policy`.

        If the shadow mode is in this state already, nothing changes.
        """
        return self.set_policy(replace(self.policy, shadow=on), author)

    def certificate(self) -> Certificate:
        """Return bounds, at confidence 1 - alpha, on the errors of the decisions without a check.

        One is on the mean probability that an accepted part was bad, the other that a rejected part
        was good. They follow from audits, random checks of parts that the model would accept or
        reject; the first follows from the outcomes of the accepted parts if all are known. Without
        either a bound is 1. Before that, everything is written to the disk, and to the store if it
        answers (`flush`); what the store does not take in time does not count. Decisions since the
        last change of policy (the settings of decisions) count. With `stops="all"` (every bad
        accepted part is reported) accepted parts of unknown outcome are left out. A forgotten
        (withdrawn) label and an overdue audit (without a label in time) count as wrong decisions.
        Raises NotTakenError if not everything is on disk in time, and StoreError if the store
        cannot be read.
        """
        self.flush()
        policy = self.policy
        tally = self.store.decisions.tally(
            since_version=self._settings.now.policy_since, within=policy.label_within
        )
        return policy.certificate(tally.outcomes)

    # Reading

    @property
    def recipe(self) -> Recipe:
        """Every setting in force; all but the policy are fixed once the engine is made."""
        return self._settings.now.recipe

    @property
    def trace(self) -> TraceSpec | None:
        """The `TraceSpec` in force; None before the first trace without a fault."""
        return self._settings.now.trace

    @property
    def model(self) -> Any:
        """The model in force; None before the first retrain.

        Of a baseline it is a trained deep copy of the object that the user handed in.
        """
        answering = self._live.answering
        return None if answering is None else answering.user_model

    @property
    def version(self) -> int:
        """Number of the version in force; 0 before the first retrain."""
        return self._live.version

    @property
    def safe_mode(self) -> str:
        """Why the engine is in safe mode; "" if it is not, and always for a rule without one.

        In safe mode it verifies parts until new outcomes allow accepting, or rejecting, again.
        """
        return self._live.newest.safe_mode

    def find(self, decision_id: str) -> StoredDecision | None:
        """Return a decision with its trace, and with its label if it has one; None for an
        unknown id.

        A decision is found as soon as it was made; a label is returned once it is on disk. Raises
        StoreError if the id cannot be looked up within the store's time limit or the stored trace
        is damaged, and ReportError for an invalid id.
        """
        return self._outbox.find_decision(as_id(decision_id))

    def status(self, last: int = NEWEST, watching: bool = False) -> Status:
        """Return how the engine is doing, once everything is written (`flush`); arguments and
        errors are those of `history.status.status`.

        If the disk or the store does not take everything in time, `store_fault` says why, and the
        counts lack the rest.
        """
        with suppress(NotTakenError):
            self.flush()
        return self.state.complete(status(self.store, last, watching))

    def history(self, last: int | None = None, **where: Any) -> Iterator[StoredDecision]:
        """Return an iterator over the decisions in the store, newest last, without their traces.

        Nothing is waited for: call `flush` before, or the newest decisions and labels may be
        missing. `last` is the number of newest decisions, and None all; `where` selects by action,
        reason, label, since, until, predicted or part. Raises SettingError for a value that these
        cannot have, TypeError for another name, and StoreError if the store cannot be read; see
        `history.status.history`.
        """
        return history(self.store, last, **where)

    def history_frame(self, last: int | None = None, **where: Any) -> pd.DataFrame:
        """Return `history` as a DataFrame with a row for each decision, indexed by its id.

        Arguments and errors are those of `history`.
        """
        return as_frame(self.history(last, **where))

    def explain(self, decision_id: str, neighbours: int = 10) -> Explanation:
        """Explain a decision by its nearest references, at most `neighbours` of them.

        It is read from the store, and nothing is waited for: a decision that is only in the journal
        is unknown until `flush`. In place of an id it takes the number of a part, too
        (`find_decision_id`). Raises the errors of `history.explain.explain`, for example
        ReportError for an unknown id.
        """
        return explain(self.store, decision_id, neighbours)

    def __exit__(self, *exception: object) -> None:
        self.close()


def _new_settings(
    reducer: Any,
    recipe: Any,
    model: Model | None,
    given: Settings,
    seed: int,
    trace: TraceSpec | None,
) -> tuple[EngineSettings, EngineModel]:
    """Return the settings of a new engine, and the untrained model that they describe.

    A recipe holds all settings. Without a `recipe` it is that of `reducer`, which maps traces to
    points, or of the reducer conv; `seed` and `trace` are kept as given. `given` holds the settings
    that the caller passed beside `recipe`, by name. They replace those of the recipe; a setting of
    None counts as not given. For a `model` that the user handed in, without a recipe, the other
    settings are those of the default recipe, but `retrain_every` (new labels between two retrains)
    is that of the class `Reducer`, not that of conv. Raises SettingError if `reducer`, or a setting
    in `given`, has no effect on such a model; those in `recipe` are not refused. Raises it also for
    settings that are out of range or contradict each other, if the reducer or the decision rule
    (which turns bounds into an action) cannot be made, for a `model` that is a class, lacks a
    method of `Model` or is one of dengine, and if the training window (the number of newest labels)
    is smaller than the model's `min_traces`, the number of labelled traces that its first training
    needs. Other errors of the constructor of a user's class are raised as they are.
    """
    if model is not None:
        check_model_settings(reducer, given)
        if recipe is None:
            # The schedule of conv is its own.
            recipe = Recipe(retrain_every=Reducer.default_retrain_every)
    settings, template = EngineSettings(
        choose_recipe(reducer, recipe, given), seed, trace=trace
    ).with_template(model)
    n_traces = template.min_traces
    expect(
        settings.recipe.window >= n_traces,
        f"a window of at least {n_traces} labelled traces, on which it trains first",
        settings.recipe.window,
    )
    return settings, template
