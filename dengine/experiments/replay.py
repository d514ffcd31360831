"""One stream of parts through one engine: `replay` plays recordings, `watch` drives any cell.
`grid` plays by `replay`, `dengine run` by `observe_cycles` and `to_replay`.

Both return a `Replay`, the record of each cycle. `replay` uses a fresh engine, as the paper's
prototype online environment does. A `Contender` says who plays: a recipe or a baseline.

>>> replay("insertion", "conv", seed=0).summary()["certain"]
>>> watch(DataEngine(), SimulatedCell(cycles=600), cycles=600).stretches(6)
"""

import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..cells.base import Cell
from ..cells.replay import ReplayCell
from ..datasets import load_dataset
from ..decision.neighbours import fade
from ..decision.policy import Policy
from ..engine.engine import DataEngine
from ..errors import SettingError, expect
from ..history.sentences import BOUNDED
from ..recipe import RECIPES, Recipe, without_none
from ..records import (
    ACTIONS,
    Action,
    Cycle,
    Decision,
    Floats,
    Ints,
    Outcome,
    Reason,
    RetrainReport,
    TraceSpec,
)
from ..reducers import has_own_unit
from ..reducers.base import Reducer
from .baselines import BASELINES, make_baseline
from .metrics import VERIFY_SECONDS, Costs, share_right

if TYPE_CHECKING:
    import pandas as pd

Bools = NDArray[np.bool_]
Row = dict[str, Any]  # of a table, by column
ObservedCycle = tuple[Cycle, float]  # a finished cycle, and whether the part was good
# Fields of a decision that a replay keeps -> their type in its arrays.
DECISION_FIELDS: dict[str, Any] = {
    "action": np.str_,
    "reason": np.str_,
    "lower": np.float64,
    "upper": np.float64,
    "n_success": np.int64,
    "n_failure": np.int64,
}
# Fields of a replay that mark cycles, and are counted in its stretches.
COUNTED = (
    "verified",
    "accepted",
    "rejected",
    "false_positive",
    "false_negative",
    "novel",
    "safe_mode",
    "outside",
)
# Settings of a policy that are columns of tables.
POLICY_COLUMNS: tuple[str, ...] = ("interval", "alpha", "lower_bound", "guarantee", "stops")


@dataclass(frozen=True)
class Contender:
    """Who plays a stream: dengine with a recipe, or a baseline in the same loop.

    >>> Contender.load("conv")        # a name, TOML file, module:Class, transformer, Recipe
    >>> Contender.load("knn")         # a name in `baselines.BASELINES`

    Parameters
    ----------
    name : str
        For tables, pictures and file names.
    recipe : Recipe
        All settings of the engine. For a baseline those of the loop, and the policy that it is made
        with.
    baseline : str or None, default None
        A name in `BASELINES` that decides instead of the reducer and its neighbours.
    """

    name: str
    recipe: Recipe
    baseline: str | None = None

    @classmethod
    def load(cls, recipe: Any) -> "Contender":
        """Return the contender, who plays a stream of parts, for a recipe or for a baseline's name.

        It is dengine with a recipe (all settings of an engine), or a baseline (a method to compare
        with).

        Parameters
        ----------
        recipe : Contender, str or object
            A contender is returned as it is. A baseline's name gives the baseline with its default
            settings, in a default `Recipe` whose `retrain_every` is the default of the base class
            `Reducer`. Otherwise anything that `Recipe.load` takes. A contender from a TOML file has
            the name of the file without its suffix, and one from a name in `RECIPES` has this name;
            any other has `Recipe.name`, so `Recipe` objects with one reducer have one name.

        Raises
        ------
        SettingError
            For anything else, and for a file of a recipe that cannot be read.
        """
        if isinstance(recipe, Contender):
            return recipe
        if isinstance(recipe, str) and recipe in BASELINES:
            # conv has a schedule of its own; baselines retrain by the default one.
            return cls(recipe, Recipe(retrain_every=Reducer.default_retrain_every), recipe)
        loaded = Recipe.load(recipe)
        is_path = isinstance(recipe, str | os.PathLike)
        is_named = is_path and (str(recipe) in RECIPES or Path(recipe).is_file())
        return cls(Path(recipe).stem if is_named else loaded.name, loaded)

    def with_policy(self, **changes: Any) -> "Contender":
        """Return a copy with other settings of the policy, such as alpha, lower_bound or guarantee.

        Name and baseline stay. Prices may imply a guarantee and audits, as for `Policy.changed`.
        Raises SettingError for one that is out of range, TypeError for a name that is no setting.
        """
        return replace(self, recipe=self.recipe.with_policy(**changes))

    def engine(self, seed: int, trace: TraceSpec | None = None) -> DataEngine:
        """Return a new engine, with its store in memory, for this contender's recipe or baseline.

        A recipe is all settings of an engine. A baseline is a method to compare with; it is the
        model of the engine, whose other settings are the recipe's. `trace` is the shape, rate and
        units of the traces; None: the first trace sets it. A training ends after a number
        of steps and not by the time budget, so that the same seed gives the same decisions. The
        call limits this thread to one torch thread. Raises SettingError for settings that
        `DataEngine` refuses, such as force limits in seconds at an unknown rate, and for a baseline
        that cannot be made.
        """
        model = None
        if self.baseline is not None:
            model = make_baseline(self.baseline, self.recipe.policy, seed)
        return DataEngine(recipe=self.recipe, model=model, trace=trace, seed=seed, replaying=True)


@dataclass(frozen=True, kw_only=True, repr=False)
class Replay:
    """One run of a robot cell, recorded or live, of n finished cycles, where n may be 0.

    Attributes
    ----------
    action, reason : array of str, shape (n,)
    truth : array, shape (n,)
        Whether the part was good: bool in a replay; float in a live run, NaN if the cell does not
        tell.
    lower, upper : array of float, shape (n,)
        Bounds of the success probability, like those of `Decision`.
    n_success, n_failure : array of int, shape (n,)
        Labels that were counted.
    position : array of float, shape (n, d)
        Scaled embedding, the mean over the spaces; NaN if no model embedded the trace.
    decide_seconds : array of float, shape (n,)
        Wall time of each decision.
    stopped : array of bool, shape (n,)
        The line stopped at an accepted part.
    version : array of int, shape (n,)
        Of the model; 0 before the first retrain.
    safe_mode : array of bool, shape (n,)
        After this cycle every part is verified, whatever the model says.
    retrains : tuple of RetrainReport
        Those that ended in this run.
    recipe : Recipe
        Of the engine.
    name : str
        Name of the method that played, for tables.
    index : array of int, shape (n,)
        Of a replay: position of each cycle's trace in the data set. In a live run it is empty, and
        the fields below have their defaults.
    dataset : str
        Name of the data set.
    seed : int
        Of the shuffle and of the engine.
    confirm : bool
        Whether the cell confirmed accepted good parts.
    seconds : float
        Wall time of the whole replay.
    """

    action: NDArray[np.str_]
    truth: NDArray[Any]
    lower: Floats
    upper: Floats
    n_success: Ints
    n_failure: Ints
    position: Floats
    decide_seconds: Floats
    stopped: Bools
    reason: NDArray[np.str_]
    version: Ints
    safe_mode: Bools
    retrains: tuple[RetrainReport, ...] = ()
    recipe: Recipe = field(default_factory=Recipe)
    name: str = ""
    index: Ints = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    dataset: str = ""
    seed: int = 0
    confirm: bool = False
    seconds: float = float("nan")

    def __len__(self) -> int:
        """Return the number of finished cycles."""
        return len(self.action)

    def __repr__(self) -> str:
        """Return one line: name, policy, cycles, decisions, errors, and dropped retrains if any."""
        counts = self.stretch()
        summary = ", ".join(f"{counts[name]} {name.replace('_', ' ')}" for name in COUNTED[:5])
        if self.dropped:
            summary += f"; {len(self.dropped)} retrains dropped, the last {self.dropped[-1]}"
        policy = self.recipe.policy.summary
        return f"<Replay of {self.name}: {policy}, {len(self)} cycles, {summary}>"

    @property
    def dropped(self) -> list[str]:
        """Reasons of the retrains whose version was not put in force, in their order.

        A reducer that fails at every retrain leaves a model that is certain of nothing.
        """
        return [report.reason for report in self.retrains if not report.accepted]

    @property
    def verified(self) -> Bools:
        """The part was checked, for whatever reason: `action` is verify; (n,) bool."""
        return np.asarray(self.action == Action.VERIFY)

    @property
    def accepted(self) -> Bools:
        """The part went on without a check; (n,) bool."""
        return np.asarray(self.action == Action.ACCEPT)

    @property
    def rejected(self) -> Bools:
        """The model rejected the part without a check; (n,) bool.

        A part that the operator's force limits rejected does not count.
        """
        return np.asarray((self.action == Action.REJECT) & ~self.outside)

    @property
    def false_positive(self) -> Bools:
        """Accepted and bad, as far as the truth is known; (n,) bool."""
        return np.asarray(self.accepted & (self.truth == 0.0))

    @property
    def false_negative(self) -> Bools:
        """Rejected and good, as far as the truth is known; (n,) bool."""
        return np.asarray(self.rejected & (self.truth == 1.0))

    @property
    def novel(self) -> Bools:
        """Verified because the trace is unlike everything learned; (n,) bool."""
        return np.asarray(self.reason == Reason.NOVEL)

    @property
    def outside(self) -> Bools:
        """The trace left the operator's force limits, so the model was not asked; (n,) bool.

        Such a part was verified or rejected.
        """
        return np.asarray(self.reason == Reason.OUTSIDE)

    def to_frame(self) -> "pd.DataFrame":
        """Return a DataFrame with a row for each cycle, which is one part, numbered from 1.

        Its columns are the fields that have a value for each cycle, and one for each dimension of
        `position`, the embedding: embedding_1, embedding_2, ... The index is named "cycle".
        """
        import pandas as pd

        # The shape leaves out the index of a live run, which is empty.
        columns = {
            name: value
            for name, value in vars(self).items()
            if isinstance(value, np.ndarray) and value.shape == (len(self),)
        }
        for d in range(self.position.shape[1]):
            columns[f"embedding_{d + 1}"] = self.position[:, d]
        return pd.DataFrame(columns, index=pd.RangeIndex(1, len(self) + 1, name="cycle"))

    def stretches(self, n: int) -> list[Row]:
        """Cut the run into n stretches of about equal length; return the counts of each, as the
        method `stretch` returns them.

        A stretch is a number of consecutive cycles. If there are fewer cycles than n, each has a
        stretch of its own, so the list is shorter; without cycles it is empty.
        """
        edges = np.unique(np.linspace(0, len(self), n + 1).round().astype(int)).tolist()
        return [self.stretch(slice(begin, end)) for begin, end in pairwise(edges)]

    def stretch(self, cycles: slice = slice(None)) -> Row:
        """Count decisions, errors and line stops over some of the cycles.

        Parameters
        ----------
        cycles : slice, default all
            The cycles to count, numbered from 0; a slice without a step.

        Returns
        -------
        counts : dict
            first_cycle and last_cycle, counted from 1. verified_share, NaN without cycles. Numbers
            of cycles: verified, accepted, rejected (by the model), false_positive (accepted and
            known to be bad), false_negative (rejected and known to be good), novel (verified
            because the trace is unlike all learned ones), safe_mode (it was in force at the end of
            the cycle: every part is verified, because of an alarm), outside (the trace left an
            operator's force limits), and stops (an accepted part was bad and stopped the line).
        """
        begin, end, _ = cycles.indices(len(self))
        counts = {name: int(getattr(self, name)[cycles].sum()) for name in COUNTED}
        return {
            "first_cycle": begin + 1,
            "last_cycle": end,
            "verified_share": counts["verified"] / (end - begin) if end > begin else float("nan"),
            **counts,
            "stops": int(self.stopped[cycles].sum()),
        }

    def summary(self, check_seconds: float = VERIFY_SECONDS) -> dict[str, Any]:
        """Return one row of a table: settings, counts, shares and times over the whole run.

        Shares, quantiles and `first_certain` are NaN if there is nothing to compute them from, and
        `seconds` is NaN in a live run. A decision on a part of unknown truth counts as right.

        Parameters
        ----------
        check_seconds : float, default 5.0
            How long a verification takes in the robot cell, to compute the time saved.

        Returns
        -------
        row : dict
            The settings: recipe; interval, alpha, lower_bound, guarantee and stops of its `Policy`;
            confirm (whether the cell confirmed accepted good parts), seed. cycles, their number.
            Numbers of cycles: accepted, rejected (by the model), false_positive (accepted and bad),
            false_negative (rejected and good), novel (verified because the trace is unlike all
            learned ones), safe_mode (after which every part is verified, because of an alarm),
            outside (the trace left an operator's force limits). certain, the number of parts that
            the model accepted or rejected; first_certain, the cycle of the first of them, counted
            from 1. precision and npv, the shares of right decisions among the accepted and the
            rejected parts, and accuracy, among both. retrains, their number; retrains_dropped, the
            number of those whose model was not put in use; dropped, the reason of the last of
            these, or "". retrain_p50_s and retrain_max_s, the median and largest time of a retrain;
            decide_p50_us and decide_p99_us, the median and 99th percentile of a decision's, in µs;
            seconds, those of the replay. saved_s, the seconds of checks that the certain parts
            saved; and net_s, which is saved_s minus the cost of errors, in seconds, by the defaults
            of `Costs`.

        Raises
        ------
        SettingError
            For `check_seconds` that is not finite or not above 0.
        """
        nan = float("nan")
        counts = self.stretch()
        accepted = counts["accepted"]
        rejected = counts["rejected"]
        false_positive = counts["false_positive"]
        false_negative = counts["false_negative"]
        certain = accepted + rejected
        retrain_seconds = np.array([report.seconds for report in self.retrains])
        costs = Costs(check_seconds)
        dropped = self.dropped

        def quantile(values: Floats, q: float) -> float:
            return float(np.quantile(values, q)) if len(values) else nan

        first_certain = float(np.argmax(self.accepted | self.rejected) + 1) if certain else nan
        return {
            "recipe": self.name,
            **{name: getattr(self.recipe.policy, name) for name in POLICY_COLUMNS},
            "confirm": self.confirm,
            "seed": self.seed,
            "cycles": len(self),
            "certain": certain,
            "first_certain": first_certain,
            **{name: counts[name] for name in COUNTED[1:]},
            "precision": share_right(false_positive, accepted),
            "npv": share_right(false_negative, rejected),
            "accuracy": share_right(false_positive + false_negative, certain),
            "retrains": len(self.retrains),
            "retrains_dropped": len(dropped),
            "dropped": dropped[-1] if dropped else "",
            "retrain_p50_s": quantile(retrain_seconds, 0.5),
            "retrain_max_s": quantile(retrain_seconds, 1.0),
            "decide_p50_us": 1e6 * quantile(self.decide_seconds, 0.5),
            "decide_p99_us": 1e6 * quantile(self.decide_seconds, 0.99),
            "saved_s": costs.saved(certain),
            "net_s": costs.saved(certain, false_positive, false_negative),
            "seconds": self.seconds,
        }


def observe_cycles(engine: DataEngine, cell: Cell, cycles: int) -> Iterator[ObservedCycle]:
    """Let the engine drive a robot cell for a number of cycles, and yield each cycle as it ends.

    With the cycle comes the truth: 1.0 if the part was good, 0.0 if it was bad. It is the cell's
    attribute `truth` if it has this attribute (NaN for None), otherwise the label that was
    reported, or NaN if none was. Raises what `DataEngine.run` raises. An exception of the cell is
    raised, too, after the engine has written its decisions and labels.
    """
    for cycle in engine.run(cell, cycles):
        truth = getattr(cell, "truth", cycle.success)
        yield cycle, float("nan") if truth is None else float(truth)


def to_replay(observed: Sequence[ObservedCycle], recipe: Recipe) -> Replay:
    """Return observed cycles, in their order, as a `Replay`; it is empty if there are none.

    `observed` has pairs of a cycle (one part) and whether the part was good: 1.0, 0.0, or NaN if
    unknown. `recipe` has the settings of the engine that drove the robot cell. The fields that only
    a replay of a recorded data set has (`index`, `dataset`, `seed`, `confirm`, `seconds`) keep
    their defaults. `name` is the recipe's name, and `retrains` has the reports that the cycles
    carry.
    """
    cycles = [cycle for cycle, _ in observed]
    decisions = [cycle.decision for cycle in cycles]
    arrays: dict[str, Any] = {
        name: np.array([getattr(decision, name) for decision in decisions], dtype=dtype)
        for name, dtype in DECISION_FIELDS.items()
    }
    return Replay(
        truth=np.array([truth for _, truth in observed], dtype=np.float64),
        position=_positions(decisions),
        decide_seconds=np.array([cycle.decide_seconds for cycle in cycles]),
        stopped=np.array([cycle.outcome is Outcome.STOPPED for cycle in cycles], dtype=np.bool_),
        version=np.array([decision.model_version for decision in decisions], dtype=np.int64),
        safe_mode=np.array([cycle.safe_mode != "" for cycle in cycles], dtype=np.bool_),
        retrains=tuple(cycle.retrain for cycle in cycles if cycle.retrain is not None),
        recipe=recipe,
        name=recipe.name,
        **arrays,
    )


def _positions(decisions: list[Decision]) -> Floats:
    """Return the embedding of each of n decisions, the mean over the embedding spaces, (n, d).

    A decision has one point in each embedding space. d is the dimension of the newest embedding, or
    2 if there is none. A reducer may give more dimensions as it sees more traces; a decision whose
    embedding has another dimension, or that has none, has a row of NaN.
    """
    means = [
        np.mean(decision.embedding, axis=0) if decision.embedding else np.empty(0)
        for decision in decisions
    ]
    width = next((len(mean) for mean in reversed(means) if len(mean)), 2)
    unknown = np.full(width, np.nan)
    return np.array([mean if len(mean) == width else unknown for mean in means]).reshape(-1, width)


def watch(
    engine: DataEngine,
    cell: Cell,
    cycles: int,
    on_cycle: Callable[[Cycle], None] | None = None,
) -> Replay:
    """Let an engine drive a robot cell, and return the run as a `Replay`.

    In each cycle the cell inserts a part, the engine decides, and the outcome is reported, from
    which the engine learns.

    Parameters
    ----------
    engine : DataEngine
    cell : Cell
    cycles : int
        Number of parts, one in each cycle.
    on_cycle : callable or None, default None
        Called with each finished cycle.

    Returns
    -------
    run : Replay
        The record of all `cycles`. An exception of the engine (as of `DataEngine.run`), of the cell
        or of `on_cycle` goes on to the caller; then nothing is returned, and only `on_cycle` has
        got the cycles before the exception.
    """
    observed = []
    for item in observe_cycles(engine, cell, cycles):
        observed.append(item)
        if on_cycle is not None:
            on_cycle(item[0])
    return to_replay(observed, engine.recipe)


def replay(
    dataset: Any,
    recipe: Any,
    seed: int = 0,
    cycles: int | None = None,
    *,
    alpha: float | None = None,
    lower_bound: float | None = None,
    shuffle: bool = True,
    confirm: bool = False,
    on_cycle: Callable[[int], None] | None = None,
) -> Replay:
    """Play a data set through a fresh engine in memory, in one pass; return what was decided.

    It limits this thread to one torch thread; if `recipe` is an engine, only if the engine's
    trainings run in this thread.

    Parameters
    ----------
    dataset : object
        Anything `load_dataset` takes.
    recipe : object
        Anything `Recipe.load` takes, the name of a baseline (a method to compare with, in
        `experiments.baselines.BASELINES`), a `Contender` (a named recipe or baseline), or, for a
        model of your own, a fresh engine. Afterwards this engine holds what it learned.
    seed : int, default 0
        Of the shuffle, and of the engine unless one is given; the same seed gives the same
        decisions, but not with an engine of yours whose trainings end by a time budget.
    cycles : int or None, default None
        Only the first so many parts, after the shuffle; None plays all.
    alpha, lower_bound : float or None, default None
        Error level, and success probability that accepted parts must have; None takes the recipe's,
        which are 0.05 and 0.95 by default.
    shuffle : bool, default True
        False plays the stream in its recorded order, drift included.
    confirm : bool, default False
        Whether the robot cell confirms accepted good parts. By default only line stops (bad
        accepted parts) become known. With `Policy(stops="all")` the engine takes the absence of a
        line stop as a confirmation anyway.
    on_cycle : callable or None, default None
        Called with the number of finished cycles, for a progress bar.

    Returns
    -------
    replay : Replay
        The record of each cycle (one part), with the reports of the retrains.

    Raises
    ------
    SettingError
        A number of cycles that the data set does not have, anything that is no recipe, a reducer,
        decision rule or baseline that cannot be made, alpha or lower_bound out of range or beside
        an engine, a malformed `windows.trigger` (where parts begin in a long recording) of the
        data's description, or a recipe with an operator's force limits in seconds for a data set of
        an unknown rate.
    DataError, ValueError
        A data set that cannot be read, see `load_dataset`.
    StoreError
        A store, given as the data set, that cannot be opened or read. For an engine of yours also
        if `DataEngine.run` raises it, for example because the engine is closed.
    TraceError
        For an engine of yours, traces that it does not take.
    """
    data = load_dataset(dataset)
    changes = without_none({"alpha": alpha, "lower_bound": lower_bound})
    n_parts = len(data)
    n_cycles = n_parts if cycles is None else cycles
    expect(1 <= n_cycles <= n_parts, f"1 to {n_parts} cycles from {data.name}", n_cycles)
    order = np.random.default_rng(seed).permutation(n_parts) if shuffle else np.arange(n_parts)
    order = order[:n_cycles]
    if not isinstance(recipe, DataEngine):
        contender = Contender.load(recipe).with_policy(**changes)
        engine = contender.engine(seed, data.spec)
        name = contender.name
    elif changes:
        raise SettingError(
            "Expected the policy of an engine on the engine, "
            f"got {' and '.join(changes)} beside an engine, which has its own; make it with them."
        )
    else:
        engine = recipe
        name = engine.recipe.name

    begin = time.perf_counter()
    report = None if on_cycle is None else lambda cycle: on_cycle(cycle.index + 1)
    run = watch(engine, ReplayCell(data, order, confirm), n_cycles, report)
    return replace(
        run,
        truth=run.truth.astype(np.bool_),
        index=order,
        confirm=confirm,
        name=name,
        dataset=data.name,
        seed=seed,
        seconds=time.perf_counter() - begin,
    )


def replay_policy(scores: Replay, policy: Policy) -> Replay:
    """Let a policy decide on the predictions that a replay in shadow mode recorded.

    In shadow mode every part was verified, and the model's label counts and embeddings were
    recorded. The decision rule, of which `policy` holds the settings, decides on these; no model is
    asked. A rule whose bound only sorts parts (`DecisionRule.sorts`), like those of the guarantees
    "pooled" and "cost", takes no counts if the reducer predicts a probability of success: it takes
    this probability, the first axis of the embedding. If the rule has `prior_labels`, the
    probability is drawn towards 1/2 while few parts have come (`fade`). A rule learns only outcomes
    that it would know in a replay of its own: checks, audits (checks, drawn at random, of parts of
    which it is certain) and line stops (bad accepted parts), and with `stops="all"` (every bad
    accepted part is reported) also that an accepted part was good. Audits are drawn anew, by the
    seed of the replay. A part for which the model was not asked, such as a novel part (unlike all
    learned traces) or one that left an operator's force limits, is verified; the rule learns its
    outcome, too, with the bounds 0 and 1.

    Two differences to such a replay stay: the predictions come from a model that has learned all
    labels, and the force limits are those of `scores`; those of `policy` are not applied, since a
    replay has no traces.

    Parameters
    ----------
    scores : Replay
        A replay with `Policy(shadow=True)`; this is not checked.
    policy : Policy

    Returns
    -------
    replay : Replay
        A copy with the actions of the policy, and with the policy in its recipe; all else, also the
        reasons and bounds, is as in `scores`.

    Raises
    ------
    SettingError
        If the class of the policy's guarantee cannot be imported or made.
    """
    import torch

    rule = policy.rule()
    # A rule that only sorts takes the mean probability of the heads, if there is one.
    is_scored = rule.sorts and has_own_unit(scores.recipe.reducer)
    audited = np.random.default_rng(scores.seed).random(len(scores)) < policy.audited_share
    asked = np.isin(scores.reason, BOUNDED)
    novel = scores.novel
    actions = np.zeros(len(scores), dtype=np.int64)
    n_unreported = 0
    with torch.inference_mode():
        for i, success in enumerate(scores.truth.tolist()):
            predicted = 0
            lower = 0.0
            upper = 1.0
            if asked[i] and is_scored:
                # With i labels.
                lower = upper = fade(float(scores.position[i, 0]), i, rule.prior_labels)
                predicted = rule.action(lower, upper)
            elif asked[i]:
                predicted, lower, upper = rule(int(scores.n_success[i]), int(scores.n_failure[i]))
            actions[i] = 0 if audited[i] else predicted
            if actions[i] == 2:  # nobody learns whether a rejected part was good
                continue
            if actions[i] == 1 and success and policy.stops != "all":
                n_unreported += 1
                continue
            asked_with = policy.audited_share if predicted else 1.0
            rule.observe(n_unreported, bool(novel[i]))
            rule.update(lower, upper, success, predicted, 0.0 if actions[i] else asked_with)
            n_unreported = 0
    return replace(
        scores,
        action=np.array(ACTIONS)[actions].astype(np.str_),
        recipe=replace(scores.recipe, policy=policy),
    )
