"""One recorded stream through one engine: the paper's prototype online environment.

>>> replay("insertion", "conv", seed=0).summary()["certain"]
"""

from __future__ import annotations

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
from .live import RunLog, watch

VERIFY_SECONDS = 5.0  # what a height check costs a cycle, in the paper's cell


@dataclass(frozen=True, kw_only=True)
class Replay(RunLog):
    """What happened in one replay, cycle by cycle, as in `RunLog`; the truth is known of every part, as bool.

    recipe : of the engine.  dataset : its name.  seed : of the shuffle and of the engine.
    """

    truth: NDArray[np.bool_]
    recipe: Recipe
    dataset: str
    seed: int

    def summary(self) -> dict[str, Any]:
        """One row of a table: counts over the whole stream; precision and NPV are NaN where nothing was decided."""
        counts, policy = self.stretch(slice(None)), self.recipe.policy
        accepted, rejected = counts["accepted"], counts["rejected"]
        false_positive, false_negative = counts["false_positive"], counts["false_negative"]
        return {
            "recipe": self.recipe.name,
            "interval": policy.interval,
            "alpha": policy.alpha,
            "lower_bound": policy.lower_bound,
            "guarantee": policy.guarantee,
            "stops": policy.stops,
            "seed": self.seed,
            "cycles": len(self),
            "certain": accepted + rejected,
            "accepted": accepted,
            "rejected": rejected,
            "false_positive": false_positive,
            "false_negative": false_negative,
            "precision": 1.0 - false_positive / accepted if accepted else float("nan"),
            "npv": 1.0 - false_negative / rejected if rejected else float("nan"),
            "novel": counts["novel"],
            "safe_mode": counts["safe_mode"],
            "retrains": len(self.retrains),
            "retrain_p50_s": _quantile(self.retrain_seconds, 0.5),
            "retrain_max_s": _quantile(self.retrain_seconds, 1.0),
            "decide_p50_us": 1e6 * _quantile(self.decide_seconds, 0.5),
            "decide_p99_us": 1e6 * _quantile(self.decide_seconds, 0.99),
            "saved_s": VERIFY_SECONDS * (accepted + rejected),
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

    dataset : anything `load_dataset` takes.  recipe : anything `Recipe.load` takes.
    seed : of the shuffle and of the engine; the same seed gives the same decisions.
    shuffle : False plays the stream as it was recorded, drift and all.
    confirm : whether accepted good parts are confirmed by the cell; by default only stops are seen. With
        `Policy(stops="all")` the engine takes the silence after them for as much.
    on_cycle : called with the number of cycles done, for a progress bar.
    """
    data, recipe = load_dataset(dataset), Recipe.load(recipe)
    cell = ReplayCell(data, _order(data, seed, cycles, shuffle), confirm)
    engine = DataEngine.from_recipe(recipe, seed=seed, replaying=True)
    return collect(engine, cell, data, seed, on_cycle)


def collect(
    engine: DataEngine, cell: ReplayCell, data: Dataset, seed: int, on_cycle: Callable[[int], None] | None = None
) -> Replay:
    """Drive any engine over a replay cell and gather its cycles; a rival model comes in through the engine."""
    log = watch(engine, cell, len(cell.order), on_cycle and (lambda cycle: on_cycle(cycle.index + 1)))
    told = vars(log) | {"truth": log.truth.astype(np.bool_)}
    return Replay(**told, recipe=engine.recipe, dataset=data.name, seed=seed)


def _order(data: Dataset, seed: int, cycles: int | None, shuffle: bool) -> NDArray[np.int64]:
    n = len(data) if cycles is None else cycles
    if not 1 <= n <= len(data):
        raise SettingError(f"Expected 1 to {len(data)} cycles from {data.name}, got {n}.")
    order = np.random.default_rng(seed).permutation(len(data)) if shuffle else np.arange(len(data))
    return order[:n]


def _quantile(values: NDArray[np.float64], q: float) -> float:
    return float(np.quantile(values, q)) if len(values) else float("nan")
