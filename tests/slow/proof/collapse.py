"""A collapse: from one cycle on every part of the good region is bad, and later good again.

>>> collapse(guarantee="pooled", stops="all", seed=0)["bad_accepts"]
"""

from typing import Any

import numpy as np

from dengine import Dataset, replay
from dengine.recipe import RECIPES

from .truths import traces

BEGIN, END, CYCLES = 800, 1100, 1500
CALM = 50  # cycles in which nothing was accepted, or as much as before


def stream(seed: int) -> Dataset:
    """Parts of two kinds that are easily told apart, 97 % and 10 % good; in the collapse none is."""
    rng = np.random.default_rng([seed, 12])
    good = rng.random(CYCLES) < 0.7
    p = np.where(good, 0.97, 0.1)
    p[BEGIN:END] = 0.0
    X = traces(np.where(good, rng.uniform(0.2, 1.0, CYCLES), rng.uniform(-1.0, -0.2, CYCLES)), rng)
    return Dataset(X.astype(np.float32), (rng.random(CYCLES) < p).astype(np.int8), name="collapse")


def collapse(seed: int, guarantee: str, stops: str) -> dict[str, Any]:
    """Bad accepts in the collapse; cycles until nothing is accepted for good; cycles after it until half as much as before.

    NaN where that never happened.
    """
    recipe = RECIPES["conv"].with_policy(alpha=0.1, lower_bound=0.9, guarantee=guarantee, stops=stops)
    log = replay(stream(seed), recipe, seed=seed, shuffle=False)
    accepted = log.accepted
    usual = accepted[BEGIN - 200 : BEGIN].mean()
    within = np.flatnonzero(accepted[BEGIN:END])
    quiet = float(within[-1] + 1) if len(within) else 0.0
    back = [i for i in range(END, CYCLES - CALM) if accepted[i : i + CALM].mean() >= 0.5 * usual]
    return {
        "usual": float(usual),
        "bad_accepts": int(log.false_positive[BEGIN:END].sum()),
        "quiet_after": quiet if quiet <= END - BEGIN - CALM else float("nan"),
        "back_after": float(back[0] - END) if back and usual > 0 else float("nan"),
    }
