"""One recorded stream through one engine: the paper's prototype online environment.

>>> replay("insertion", "conv", seed=0).summary()["certain"]

What happened while an engine drove a cell, cycle by cycle: one record of live runs and of replays.

log = watch(DataEngine(), SimulatedCell(cycles=600), cycles=600)
log.stretches(6)
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..cells.base import Cell
from ..cells.replay import ReplayCell
from ..datasets import Dataset, load_dataset
from ..engine.engine import DataEngine
from ..errors import SettingError
from ..recipe import Recipe
from ..records import Action, Cycle, Decision, Outcome, Reason, RetrainReport
from .contenders import Contender
from .metrics import Costs, decided_rates

if TYPE_CHECKING:
    import pandas as pd

COLUMNS = (  # of a run as a frame
    "action", "reason", "truth", "lower", "upper", "n_success", "n_failure", "stopped", "safe_mode", "version"
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class RunLog:
    """One run of a cell; n cycles were finished, which may be none.

    action : (n,) str, the engine's.  stopped : (n,) bool, the system stopped on an accepted part.
    truth : (n,) 1 good, 0 bad, NaN where the cell does not tell: real ones tell only what was verified.
    lower, upper, n_success, n_failure : (n,) the evidence.
    position : (n, d) scaled embedding, mean over the spaces; NaN where no model embedded the trace.
    reason : (n,) str, why each decision is what it is, as in `Reason`.
    version : (n,) of the model that answered; 0 before the first retrain.
    safe_mode : (n,) bool, every part is verified after this cycle, whatever the model says.
    decide_seconds : (n,) wall time of each decision.
    clock_s : (n,) seconds of production when the cycle was done; None for a cell without a clock.
    retrains : the reports of those that ended in this run.
    """

    action: NDArray[np.str_]
    truth: NDArray[np.float64] | NDArray[np.bool_]
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    n_success: NDArray[np.int64]
    n_failure: NDArray[np.int64]
    position: NDArray[np.float64]
    decide_seconds: NDArray[np.float64]
    stopped: NDArray[np.bool_]
    reason: NDArray[np.str_]
    version: NDArray[np.int64]
    safe_mode: NDArray[np.bool_]
    clock_s: NDArray[np.float64] | None = None
    retrains: tuple[RetrainReport, ...] = ()

    def __len__(self) -> int:
        return len(self.action)

    @property
    def verified(self) -> NDArray[np.bool_]:
        """(n,) the part was checked."""
        return np.asarray(self.action == Action.VERIFY)

    @property
    def accepted(self) -> NDArray[np.bool_]:
        """(n,) the part went on without a check."""
        return np.asarray(self.action == Action.ACCEPT)

    @property
    def rejected(self) -> NDArray[np.bool_]:
        """(n,) the part went back to the bin without a check."""
        return np.asarray(self.action == Action.REJECT)

    @property
    def false_positive(self) -> NDArray[np.bool_]:
        """(n,) accepted and bad, as far as the truth is known."""
        return np.asarray(self.accepted & (self.truth == 0.0))

    @property
    def false_negative(self) -> NDArray[np.bool_]:
        """(n,) rejected and good, as far as the truth is known."""
        return np.asarray(self.rejected & (self.truth == 1.0))

    @property
    def novel(self) -> NDArray[np.bool_]:
        """(n,) verified as unlike all that was learned from."""
        return np.asarray(self.reason == Reason.NOVEL)

    @property
    def embedded(self) -> bool:
        """Whether any trace was embedded; rivals embed none."""
        return bool(np.isfinite(self.position).any())

    @property
    def finished(self) -> NDArray[np.bool_]:
        """(n,) a good part was passed on, as far as the truth is known."""
        return np.asarray(~self.rejected & (self.truth == 1.0))

    @property
    def retrain_seconds(self) -> NDArray[np.float64]:
        """Wall time of each retrain."""
        return np.array([each.seconds for each in self.retrains], dtype=np.float64)

    def to_frame(self) -> pd.DataFrame:
        """A row a cycle, numbered from 1: what was decided, why, on what evidence, and what was true."""
        import pandas as pd

        told = {name: getattr(self, name) for name in COLUMNS}
        axes = {f"embedding_{d + 1}": self.position[:, d] for d in range(self.position.shape[1])}
        clock = {} if self.clock_s is None else {"clock_s": self.clock_s}
        index = pd.RangeIndex(1, len(self) + 1, name="cycle")
        return pd.DataFrame(told | {"decide_us": 1e6 * self.decide_seconds} | axes | clock, index=index)

    def summary(self) -> dict[str, Any]:
        """Counts over all cycles; parts an hour where there is a clock."""
        return self.stretch(slice(None))

    def stretches(self, n: int) -> list[dict[str, Any]]:
        """The run cut into at most n stretches of about equal length, each as in `stretch`."""
        edges = np.unique(np.linspace(0, len(self), n + 1).round().astype(int)).tolist()
        return [self.stretch(slice(a, b)) for a, b in pairwise(edges)]

    def stretch(self, part: slice) -> dict[str, Any]:
        """Counts over some of the cycles; parts an hour where there is a clock."""
        begin, end, _ = part.indices(len(self))
        return {
            "first_cycle": begin + 1,
            "last_cycle": end,
            "verified_share": float(self.verified[part].mean()) if end > begin else float("nan"),
            "verified": int(self.verified[part].sum()),
            "accepted": int(self.accepted[part].sum()),
            "rejected": int(self.rejected[part].sum()),
            "false_positive": int(self.false_positive[part].sum()),
            "false_negative": int(self.false_negative[part].sum()),
            "stops": int(self.stopped[part].sum()),
            "novel": int(self.novel[part].sum()),
            "safe_mode": int(self.safe_mode[part].sum()),
            "parts_per_hour": self._parts_per_hour(begin, end),
        }

    def _parts_per_hour(self, begin: int, end: int) -> float | None:
        if self.clock_s is None or end <= begin:
            return None
        seconds = self.clock_s[end - 1] - (self.clock_s[begin - 1] if begin else 0.0)
        return float(3600.0 * self.finished[begin:end].sum() / seconds) if seconds > 0 else None


@dataclass(frozen=True, slots=True)
class _Seen:
    """One cycle, and what the cell told about it on the side."""

    cycle: Cycle
    truth: float
    clock: float | None


class RunRecorder:
    """Gathers a run while it happens, so that one that is broken off can still be shown.

        recorder = RunRecorder(cell)
        with suppress(KeyboardInterrupt):
            recorder.follow(engine, cycles=600)
        recorder.log()

    `truth` and `clock` are read off a cell that has them.
    """

    def __init__(self, cell: Cell) -> None:
        self.cell = cell
        self._seen: list[_Seen] = []

    def follow(self, engine: DataEngine, cycles: int, on_cycle: Callable[[Cycle], None] | None = None) -> None:
        """Let the engine drive the cell, and gather every cycle. on_cycle : called after each."""
        for cycle in engine.run(self.cell, cycles):
            self.add(cycle)
            if on_cycle is not None:
                on_cycle(cycle)

    def add(self, cycle: Cycle) -> None:
        """Take in the cycle that was just finished, before the cell's next part."""
        known = getattr(self.cell, "truth", cycle.success)
        truth = float("nan") if known is None else float(known)
        self._seen.append(_Seen(cycle, truth, getattr(self.cell, "clock", None)))

    def log(self) -> RunLog:
        """What was gathered so far."""
        cycles = [each.cycle for each in self._seen]
        decisions = [cycle.decision for cycle in cycles]
        return RunLog(
            action=np.array([str(d.action) for d in decisions], dtype=np.str_),
            truth=np.array([each.truth for each in self._seen], dtype=np.float64),
            lower=np.array([d.lower for d in decisions], dtype=np.float64),
            upper=np.array([d.upper for d in decisions], dtype=np.float64),
            n_success=np.array([d.n_success for d in decisions], dtype=np.int64),
            n_failure=np.array([d.n_failure for d in decisions], dtype=np.int64),
            position=_positions(decisions),
            decide_seconds=np.array([cycle.decide_seconds for cycle in cycles], dtype=np.float64),
            stopped=np.array([cycle.outcome == Outcome.STOPPED for cycle in cycles], dtype=np.bool_),
            reason=np.array([str(d.reason) for d in decisions], dtype=np.str_),
            version=np.array([d.model_version for d in decisions], dtype=np.int64),
            safe_mode=np.array([cycle.safe_mode != "" for cycle in cycles], dtype=np.bool_),
            clock_s=self._clock(),
            retrains=tuple(cycle.retrain for cycle in cycles if cycle.retrain is not None),
        )

    def _clock(self) -> NDArray[np.float64] | None:
        if getattr(self.cell, "clock", None) is None:
            return None
        return np.array([each.clock for each in self._seen], dtype=np.float64)


def watch(engine: DataEngine, cell: Cell, cycles: int, on_cycle: Callable[[Cycle], None] | None = None) -> RunLog:
    """Drive a cell and keep what figures and tables need; `RunRecorder` is for a run that may be broken off."""
    recorder = RunRecorder(cell)
    recorder.follow(engine, cycles, on_cycle)
    return recorder.log()


def _positions(decisions: list[Decision]) -> NDArray[np.float64]:
    """(n, d) of the newest embedding's width: a reducer may widen as it sees more traces."""
    means = [np.mean(each.embedding, axis=0) if each.embedding else None for each in decisions]
    known = [mean for mean in means if mean is not None]
    positions = np.full((len(means), len(known[-1]) if known else 2), np.nan)
    for i, mean in enumerate(means):
        if mean is not None and len(mean) == positions.shape[1]:
            positions[i] = mean
    return positions


@dataclass(frozen=True, kw_only=True)
class Replay(RunLog):
    """What happened in one replay, cycle by cycle, as in `RunLog`; the truth is known of every part, as bool.

    index : (n,) position in the data set of the trace that each cycle played.
    name : of who played, in tables.  recipe : of the engine.  dataset : its name.
    seed : of the shuffle and of the engine.  confirm : whether accepted good parts were confirmed by the cell.
    seconds : wall time of the whole replay.
    encoder_steps : of label-free training between cycles.  encoder_seconds : that were assumed for them, so many a step
        whatever they took, so that a seed repeats exactly.  slice_max_s : wall time of the longest slice of them.
    """

    truth: NDArray[np.bool_]
    index: NDArray[np.int64]
    name: str
    recipe: Recipe
    dataset: str
    seed: int
    confirm: bool = False
    seconds: float = float("nan")
    encoder_steps: int = 0
    encoder_seconds: float = 0.0
    slice_max_s: float = 0.0

    @property
    def first_certain(self) -> float:
        """Number of the first cycle that was decided without a check, from 1; NaN where none was."""
        certain = np.flatnonzero(~self.verified)
        return float(certain[0] + 1) if len(certain) else float("nan")

    def summary(self) -> dict[str, Any]:
        """One row of a table: counts over the whole stream; precision and NPV are NaN where nothing was decided."""
        counts, policy = self.stretch(slice(None)), self.recipe.policy
        certain = counts["accepted"] + counts["rejected"]
        wrong = {name: counts[name] for name in ("false_positive", "false_negative")}
        return {
            "recipe": self.name,
            "interval": policy.interval,
            "alpha": policy.alpha,
            "lower_bound": policy.lower_bound,
            "guarantee": policy.guarantee,
            "stops": policy.stops,
            "confirm": self.confirm,
            "seed": self.seed,
            "cycles": len(self),
            "certain": certain,
            "first_certain": self.first_certain,
            "accepted": counts["accepted"],
            "rejected": counts["rejected"],
            **wrong,
            **decided_rates(self.accepted, self.rejected, self.truth),
            "novel": counts["novel"],
            "safe_mode": counts["safe_mode"],
            "retrains": len(self.retrains),
            "retrain_p50_s": _quantile(self.retrain_seconds, 0.5),
            "retrain_max_s": _quantile(self.retrain_seconds, 1.0),
            "encoder_s": self.encoder_seconds,
            "slice_max_s": self.slice_max_s,
            "decide_p50_us": 1e6 * _quantile(self.decide_seconds, 0.5),
            "decide_p99_us": 1e6 * _quantile(self.decide_seconds, 0.99),
            "saved_s": Costs().saved(certain),
            "net_s": Costs().saved(certain, **wrong),
            "seconds": self.seconds,
        }


def replay(
    dataset: Any,
    recipe: Any,
    seed: int = 0,
    cycles: int | None = None,
    *,
    shuffle: bool = True,
    confirm: bool = False,
    on_cycle: Callable[[int], None] | None = None,
) -> Replay:
    """Play a data set through a fresh engine in memory: one shuffled pass, or its first `cycles`.

    dataset : anything `load_dataset` takes.
    recipe : anything `Recipe.load` takes, the name of a rival method (`experiments.rivals.RIVALS`), or a `Contender`.
    seed : of the shuffle and of the engine; the same seed gives the same decisions.
    shuffle : False plays the stream as it was recorded, drift and all.
    confirm : whether accepted good parts are confirmed by the cell; by default only stops are seen. With
        `Policy(stops="all")` the engine takes the silence after them for as much.
    on_cycle : called with the number of cycles done, for a progress bar.
    """
    data, contender = load_dataset(dataset), Contender.load(recipe)
    cell = ReplayCell(data, order_of(data, seed, cycles, shuffle), confirm)
    return collect(contender.engine(seed), cell, data, seed, on_cycle, contender.name)


def collect(
    engine: DataEngine,
    cell: ReplayCell,
    data: Dataset,
    seed: int,
    on_cycle: Callable[[int], None] | None = None,
    name: str | None = None,
) -> Replay:
    """Drive any engine over a replay cell and gather its cycles; a model of your own comes in through the engine."""
    begin = time.perf_counter()
    log = watch(engine, cell, len(cell.order), on_cycle and (lambda cycle: on_cycle(cycle.index + 1)))
    told = vars(log) | {"truth": log.truth.astype(np.bool_), "index": cell.order, "confirm": cell.confirm}
    about: dict[str, Any] = {"name": name or engine.recipe.name, "recipe": engine.recipe, "seed": seed}
    spent = engine.encoder_time
    trained: dict[str, Any] = {"encoder_steps": spent.steps, "encoder_seconds": spent.seconds, "slice_max_s": spent.longest}
    return Replay(**told, **about, **trained, dataset=data.name, seconds=time.perf_counter() - begin)


def order_of(data: Dataset, seed: int, cycles: int | None = None, shuffle: bool = True) -> NDArray[np.int64]:
    """(cycles,) positions in the data set, in the order in which a replay plays them. SettingError for too many."""
    n = len(data) if cycles is None else cycles
    if not 1 <= n <= len(data):
        raise SettingError(f"Expected 1 to {len(data)} cycles from {data.name}, got {n}.")
    order = np.random.default_rng(seed).permutation(len(data)) if shuffle else np.arange(len(data))
    return order[:n]


def _quantile(values: NDArray[np.float64], q: float) -> float:
    return float(np.quantile(values, q)) if len(values) else float("nan")
