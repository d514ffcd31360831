"""One recorded stream through one engine: the paper's prototype online environment.

>>> replay("insertion", "conv", seed=0).summary()["certain"]
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..cells.replay import ReplayCell
from ..datasets import Dataset, load_dataset
from ..engine import DataEngine
from ..errors import SettingError
from ..recipe import Recipe
from ..records import Action, RetrainReport

VERIFY_SECONDS = 5.0  # what a height check costs a cycle, in the paper's cell


@dataclass(frozen=True)
class Replay:
    """What happened in one replay, cycle by cycle.

    action : (n,) str, the engine's. truth : (n,) bool, whether the part was good.
    lower, upper, n_success, n_failure : (n,) the evidence.  position : (n, d) scaled embedding, mean over the spaces.
    decide_seconds : (n,) wall time of each decision.  retrain_seconds : of each retrain.  retrains : their reports.
    """

    recipe: Recipe
    dataset: str
    seed: int
    action: NDArray[np.str_]
    truth: NDArray[np.bool_]
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    n_success: NDArray[np.int64]
    n_failure: NDArray[np.int64]
    position: NDArray[np.float64]
    decide_seconds: NDArray[np.float64]
    retrain_seconds: NDArray[np.float64]
    retrains: tuple[RetrainReport, ...] = field(default=())

    def summary(self) -> dict[str, Any]:
        """One row of a table: counts over the whole stream; precision and NPV are NaN where nothing was decided."""
        accepted, rejected = self.action == Action.ACCEPT, self.action == Action.REJECT
        false_positive, false_negative = int((accepted & ~self.truth).sum()), int((rejected & self.truth).sum())
        n_accepted, n_rejected = int(accepted.sum()), int(rejected.sum())
        policy = self.recipe.policy
        return {
            "recipe": self.recipe.reducer,
            "interval": policy.interval,
            "alpha": policy.alpha,
            "lower_bound": policy.lower_bound,
            "seed": self.seed,
            "cycles": len(self.action),
            "certain": n_accepted + n_rejected,
            "accepted": n_accepted,
            "rejected": n_rejected,
            "false_positive": false_positive,
            "false_negative": false_negative,
            "precision": 1.0 - false_positive / n_accepted if n_accepted else float("nan"),
            "npv": 1.0 - false_negative / n_rejected if n_rejected else float("nan"),
            "retrains": len(self.retrain_seconds),
            "retrain_p50_s": _quantile(self.retrain_seconds, 0.5),
            "retrain_max_s": _quantile(self.retrain_seconds, 1.0),
            "decide_p50_us": 1e6 * _quantile(self.decide_seconds, 0.5),
            "decide_p99_us": 1e6 * _quantile(self.decide_seconds, 0.99),
            "saved_s": VERIFY_SECONDS * (n_accepted + n_rejected),
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
    confirm : whether accepted good parts are confirmed; by default only stops are seen.
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
    rows, retrains = [], []
    for cycle in engine.run(cell, len(cell.order)):
        d = cycle.decision
        position = np.mean(d.embedding, axis=0) if d.embedding else None
        rows.append((str(d.action), d.lower, d.upper, d.n_success, d.n_failure, position, cycle.decide_seconds))
        if cycle.retrain is not None:
            retrains.append(cycle.retrain)
        if on_cycle is not None:
            on_cycle(cycle.index + 1)
    action, lower, upper, n_success, n_failure, position, seconds = zip(*rows, strict=True)
    return Replay(
        recipe=engine.recipe,
        dataset=data.name,
        seed=seed,
        action=np.array(action),
        truth=data.y[cell.order].astype(bool),
        lower=np.array(lower),
        upper=np.array(upper),
        n_success=np.array(n_success),
        n_failure=np.array(n_failure),
        position=_stack(position),
        decide_seconds=np.array(seconds),
        retrain_seconds=np.array([r.seconds for r in retrains]),
        retrains=tuple(retrains),
    )


def _order(data: Dataset, seed: int, cycles: int | None, shuffle: bool) -> NDArray[np.int64]:
    n = len(data) if cycles is None else cycles
    if not 1 <= n <= len(data):
        raise SettingError(f"Expected 1 to {len(data)} cycles from {data.name}, got {n}.")
    order = np.random.default_rng(seed).permutation(len(data)) if shuffle else np.arange(len(data))
    return order[:n]


def _stack(positions: tuple[Any, ...]) -> NDArray[np.float64]:
    known = [p for p in positions if p is not None]
    blank = np.full(len(known[0]) if known else 2, np.nan)
    return np.stack([blank if p is None else p for p in positions])


def _quantile(values: NDArray[np.float64], q: float) -> float:
    return float(np.quantile(values, q)) if len(values) else float("nan")
