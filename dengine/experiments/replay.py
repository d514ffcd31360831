"""One stream through one engine, cycle by cycle: the paper's prototype online environment, and live runs.

>>> replay("insertion", "conv", seed=0).summary()["certain"]
>>> watch(DataEngine(), SimulatedCell(cycles=600), cycles=600).stretches(6)
"""

import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..cells.base import Cell
from ..cells.replay import ReplayCell
from ..datasets import load_dataset
from ..engine.engine import DataEngine
from ..errors import DataError, SettingError, expect
from ..recipe import RECIPES, Recipe
from ..records import Action, Cycle, Decision, Outcome, Reason, RetrainReport
from ..reducers.base import Reducer
from ..representation import to_html
from .baselines import BASELINES, make_baseline
from .metrics import VERIFY_SECONDS, Costs

if TYPE_CHECKING:
    import pandas as pd

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
EVIDENCE: dict[str, Any] = dict.fromkeys(("action", "reason"), np.str_)  # of a decision, and how it is kept
EVIDENCE |= dict.fromkeys(("lower", "upper"), np.float64) | dict.fromkeys(("n_success", "n_failure"), np.int64)
COUNTED = ("verified", "accepted", "rejected", "false_positive", "false_negative", "novel", "safe_mode", "outside")


@dataclass(frozen=True)
class Contender:
    """Who plays a stream: dengine by a recipe, or a baseline method in the same loop.

    >>> Contender.load("conv")        # a recipe's name, a TOML file, module:Class, a transformer, a Recipe
    >>> Contender.load("knn")         # a name in `baselines.BASELINES`

    name : in tables, pictures and file names.
    recipe : every setting of the engine; of a baseline's, those of the loop and the policy that the baseline is made with.
    baseline : a name in `BASELINES` that decides in place of reducer and neighbours.  params : the baseline's own settings.
    """

    name: str
    recipe: Recipe
    baseline: str | None = None
    params: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def load(cls, asked: Any) -> "Contender":
        """A contender itself, a baseline's name, or what `Recipe.load` takes; SettingError for else."""
        if isinstance(asked, Contender):
            return asked
        if isinstance(asked, str) and asked in BASELINES:
            # The schedule of conv is its own.
            recipe = Recipe(retrain_every=Reducer.default_retrain_every)
            return cls(asked, recipe, asked, BASELINES[asked].tries[BASELINES[asked].chosen])
        recipe = Recipe.load(asked)
        by_name = isinstance(asked, str | os.PathLike) and (str(asked) in RECIPES or Path(asked).is_file())
        return cls(Path(asked).stem if by_name else recipe.name, recipe)

    def with_policy(self, **changes: Any) -> "Contender":
        """The same with another alpha, lower_bound, interval, guarantee or stops."""
        return replace(self, recipe=self.recipe.with_policy(**changes))

    def engine(self, seed: int) -> DataEngine:
        """A fresh engine in memory that repeats exactly under a seed."""
        baseline = None if self.baseline is None else make_baseline(self.baseline, self.recipe.policy, seed, **self.params)
        return DataEngine(recipe=self.recipe, model=baseline, seed=seed, replaying=True)


@dataclass(frozen=True, kw_only=True, repr=False)
class Replay:
    """One run of a cell, a replay or a live one, of n finished cycles, which may be none.

    action, reason : (n,) str.  stopped : (n,) bool, the system stopped on an accepted part.
    truth : (n,) good or not: bool in a replay; in a live run float, NaN where the cell does not tell.
    lower, upper, n_success, n_failure : (n,) the evidence.  version : (n,) of the model; 0 before the first retrain.
    position : (n, d) scaled embedding, mean over the spaces; NaN where no model embedded the trace.
    safe_mode : (n,) bool, every part is verified after this cycle, whatever the model says.
    decide_seconds : (n,) wall time of each decision.
    clock_s : (n,) seconds of production when the cycle was done; None for a cell without a clock.
    retrains : those that ended in this run.  recipe : of the engine.  name : of who played, in tables.

    Of a replay alone:
    index : (n,) position in the data set of the trace that each cycle played.  dataset : its name.
    seed : of the shuffle and of the engine.  confirm : whether accepted good parts were confirmed by the cell.
    seconds : wall time of the whole replay.
    """

    action: NDArray[np.str_]
    truth: NDArray[Any]
    lower: Floats
    upper: Floats
    n_success: NDArray[np.int64]
    n_failure: NDArray[np.int64]
    position: Floats
    decide_seconds: Floats
    stopped: Bools
    reason: NDArray[np.str_]
    version: NDArray[np.int64]
    safe_mode: Bools
    clock_s: Floats | None = None
    retrains: tuple[RetrainReport, ...] = ()
    recipe: Recipe = field(default_factory=Recipe)
    name: str = ""
    index: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    dataset: str = ""
    seed: int = 0
    confirm: bool = False
    seconds: float = float("nan")

    def __len__(self) -> int:
        return len(self.action)

    def __repr__(self) -> str:
        counts, where = self.stretch(), f" on {self.dataset}, seed {self.seed}" if self.dataset else ""
        told = ", ".join(f"{counts[name]} {name.replace('_', ' ')}" for name in COUNTED[:5])
        told += f"; {len(self.dropped)} retrains dropped, the last {self.dropped[-1]}" if self.dropped else ""
        cycles = f"{self.recipe.policy.summary}, {len(self)} cycles"
        return f"<Replay of {self.name or 'a run'}{where}: {cycles}, {told}>"

    _repr_html_ = to_html

    @property
    def dropped(self) -> list[str]:
        """Why retrains were dropped, each; a reducer that fails at every one leaves a model that is sure of nothing."""
        return [each.reason for each in self.retrains if not each.accepted]

    @property
    def verified(self) -> Bools:
        """(n,) the part was checked."""
        return np.asarray(self.action == Action.VERIFY)

    @property
    def accepted(self) -> Bools:
        """(n,) the part went on without a check."""
        return np.asarray(self.action == Action.ACCEPT)

    @property
    def rejected(self) -> Bools:
        """(n,) the model sent the part back to the bin, without a check."""
        return np.asarray((self.action == Action.REJECT) & ~self.outside)

    @property
    def false_positive(self) -> Bools:
        """(n,) accepted and bad, as far as the truth is known."""
        return np.asarray(self.accepted & (self.truth == 0.0))

    @property
    def false_negative(self) -> Bools:
        """(n,) rejected and good, as far as the truth is known."""
        return np.asarray(self.rejected & (self.truth == 1.0))

    @property
    def novel(self) -> Bools:
        """(n,) verified as unlike all that was learned from."""
        return np.asarray(self.reason == Reason.NOVEL)

    @property
    def outside(self) -> Bools:
        """(n,) left an operator's window, and was verified or rejected for it: no decision of the model."""
        return np.asarray(self.reason == Reason.OUTSIDE)

    @property
    def finished(self) -> Bools:
        """(n,) a good part was passed on, as far as the truth is known."""
        return np.asarray((self.action != Action.REJECT) & (self.truth == 1.0))

    def to_frame(self) -> "pd.DataFrame":
        """A row a cycle, numbered from 1, and a column each field of (n,); the position's are embedding_1, embedding_2 …"""
        import pandas as pd

        known = {each.name: getattr(self, each.name) for each in fields(self)}
        one_a_cycle = (len(self),)  # a live run has no index of its parts
        columns = {name: x for name, x in known.items() if isinstance(x, np.ndarray) and x.shape == one_a_cycle}
        columns |= {f"embedding_{d + 1}": self.position[:, d] for d in range(self.position.shape[1])}
        return pd.DataFrame(columns, index=pd.RangeIndex(1, len(self) + 1, name="cycle"))

    def stretches(self, n: int) -> list[dict[str, Any]]:
        """The run cut into at most n stretches of about equal length, each as in `stretch`."""
        edges = np.unique(np.linspace(0, len(self), n + 1).round().astype(int)).tolist()
        return [self.stretch(slice(a, b)) for a, b in pairwise(edges)]

    def stretch(self, part: slice = slice(None)) -> dict[str, Any]:
        """Counts over some of the cycles; parts an hour where there is a clock."""
        begin, end, _ = part.indices(len(self))
        counts = {name: int(getattr(self, name)[part].sum()) for name in COUNTED} | {"stops": int(self.stopped[part].sum())}
        share, rate = float("nan"), None
        if end > begin:
            share = counts["verified"] / (end - begin)
            clock_s = np.zeros(0) if self.clock_s is None else np.diff(self.clock_s, prepend=0.0)[begin:end]
            rate = float(3600.0 * self.finished[part].sum() / clock_s.sum()) if clock_s.sum() > 0 else None
        about = {"first_cycle": begin + 1, "last_cycle": end, "verified_share": share}
        return about | counts | {"parts_per_hour": rate}

    def summary(self, check_seconds: float = VERIFY_SECONDS) -> dict[str, Any]:
        """One row of a table: counts over the whole stream; NaN where there is nothing to take a share or a time of.

        check_seconds : that a verification takes in the cell, for what was saved.  dropped : why the last retrain that was
        dropped was; "" where none was.
        """
        counts, policy, nan = self.stretch(), self.recipe.policy, float("nan")
        accepted, rejected, *wrong = (counts[name] for name in COUNTED[1:5])
        certain, retrain_s = accepted + rejected, np.array([each.seconds for each in self.retrains])
        costs, dropped = Costs(check_seconds), self.dropped

        def quantile(values: Floats, q: float) -> float:
            return float(np.quantile(values, q)) if len(values) else nan

        return {
            "recipe": self.name,
            **{name: getattr(policy, name) for name in ("interval", "alpha", "lower_bound", "guarantee", "stops")},
            "confirm": self.confirm,
            "seed": self.seed,
            "cycles": len(self),
            "certain": certain,
            "first_certain": float(np.argmax(self.accepted | self.rejected) + 1) if certain else nan,  # counted from 1
            **{name: counts[name] for name in COUNTED[1:]},
            "precision": 1.0 - wrong[0] / accepted if accepted else nan,
            "npv": 1.0 - wrong[1] / rejected if rejected else nan,
            "accuracy": 1.0 - sum(wrong) / certain if certain else nan,
            "retrains": len(self.retrains),
            "retrains_dropped": len(dropped),
            "dropped": dropped[-1] if dropped else "",
            "retrain_p50_s": quantile(retrain_s, 0.5),
            "retrain_max_s": quantile(retrain_s, 1.0),
            "decide_p50_us": 1e6 * quantile(self.decide_seconds, 0.5),
            "decide_p99_us": 1e6 * quantile(self.decide_seconds, 0.99),
            "saved_s": costs.saved(certain),
            "net_s": costs.saved(certain, *wrong),
            "seconds": self.seconds,
        }


class Seen(NamedTuple):
    """A finished cycle, and what its cell told on the side. truth : NaN where it tells none.  clock : seconds, or None."""

    cycle: Cycle
    truth: float
    clock: float | None


def follow(engine: DataEngine, cell: Cell, cycles: int) -> Iterator[Seen]:
    """Let the engine drive a cell, of which `truth` and `clock` are read where it has them: each cycle as it ends."""
    for cycle in engine.run(cell, cycles):
        known = getattr(cell, "truth", cycle.success)
        yield Seen(cycle, float("nan") if known is None else float(known), getattr(cell, "clock", None))


def gather(seen: Sequence[Seen], recipe: Recipe) -> Replay:
    """The run of these cycles, which may be one that was broken off."""
    cycles = [each.cycle for each in seen]
    decisions = [cycle.decision for cycle in cycles]
    clocks = [each.clock for each in seen if each.clock is not None]
    known: dict[str, Any] = {
        name: np.array([getattr(each, name) for each in decisions], dtype=kind) for name, kind in EVIDENCE.items()
    }
    return Replay(
        truth=np.array([each.truth for each in seen], dtype=np.float64),
        position=_positions(decisions),
        decide_seconds=np.array([each.decide_seconds for each in cycles], dtype=np.float64),
        stopped=np.array([each.outcome is Outcome.STOPPED for each in cycles], dtype=np.bool_),
        version=np.array([each.model_version for each in decisions], dtype=np.int64),
        safe_mode=np.array([each.safe_mode != "" for each in cycles], dtype=np.bool_),
        clock_s=np.array(clocks, dtype=np.float64) if clocks else None,
        retrains=tuple(cycle.retrain for cycle in cycles if cycle.retrain is not None),
        recipe=recipe,
        name=recipe.name,
        **known,
    )


def _positions(decisions: list[Decision]) -> Floats:
    """(n, d) of the newest embedding's width: a reducer may widen as it sees more traces."""
    means = [np.mean(each.embedding, axis=0) if each.embedding else np.empty(0) for each in decisions]
    width = next((len(mean) for mean in reversed(means) if len(mean)), 2)
    unknown = np.full(width, np.nan)
    return np.array([mean if len(mean) == width else unknown for mean in means]).reshape(len(means), width)


def watch(engine: DataEngine, cell: Cell, cycles: int, on_cycle: Callable[[Cycle], None] | None = None) -> Replay:
    """Drive a cell and keep what figures and tables need; on_cycle : called after each."""
    seen = []
    for each in follow(engine, cell, cycles):
        seen.append(each)
        if on_cycle is not None:
            on_cycle(each.cycle)
    return gather(seen, engine.recipe)


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
    """Play a data set through a fresh engine in memory: one shuffled pass, or its first `cycles`.

    dataset : anything `load_dataset` takes.
    recipe : anything `Recipe.load` takes, the name of a baseline (`experiments.baselines.BASELINES`), a `Contender`,
        or a fresh engine, by which a model of your own comes in.
    seed : of the shuffle and of the engine; the same seed gives the same decisions.
    alpha, lower_bound : of the policy; None: the recipe's, by default 0.05 and 0.95.
    shuffle : False plays the stream as it was recorded, drift and all.
    confirm : whether accepted good parts are confirmed by the cell; by default only stops are seen. With
        `Policy(stops="all")` the engine takes the silence after them for as much.
    on_cycle : called with the number of cycles done, for a progress bar.
    """
    numbers = {"alpha": alpha, "lower_bound": lower_bound}
    numbers = {name: value for name, value in numbers.items() if value is not None}
    data, who = load_dataset(dataset), None
    if not isinstance(recipe, DataEngine):
        who = Contender.load(recipe).with_policy(**numbers)
    elif numbers:
        got = f"{' and '.join(numbers)} beside an engine, which has its own"
        raise SettingError(f"Expected the policy of an engine on the engine, got {got}; make it with them.")
    n = len(data) if cycles is None else cycles
    expect(1 <= n <= len(data), f"1 to {len(data)} cycles from {data.name}", n)
    order = (np.random.default_rng(seed).permutation(len(data)) if shuffle else np.arange(len(data)))[:n]
    engine: DataEngine = recipe if who is None else who.engine(seed)
    if data.rate_hz is None and any(window.along is None for window in engine.policy.windows):
        raise DataError(f"Expected the rate of {data.name}, for windows are in seconds; state it, rate_hz=...")
    begin = time.perf_counter()
    log = watch(engine, ReplayCell(data, order, confirm), n, on_cycle and (lambda cycle: on_cycle(cycle.index + 1)))
    return replace(
        log,
        truth=log.truth.astype(np.bool_),
        index=order,
        confirm=confirm,
        name=log.name if who is None else who.name,
        dataset=data.name,
        seed=seed,
        seconds=time.perf_counter() - begin,
    )
