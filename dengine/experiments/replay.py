"""One recorded stream through one engine: the paper's prototype online environment.

>>> replay("insertion", "conv", seed=0).summary()["certain"]
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..cells.replay import ReplayCell
from ..datasets import Dataset, load_dataset
from ..engine import DataEngine
from ..errors import SettingError
from ..recipe import Recipe
from .contenders import Contender
from .live import RunLog, watch
from .rates import Costs, decided_rates


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
