"""Replays that are known by hand, and what two of one seed have in common."""

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np

from dengine import Recipe, Replay

TIMES = ("decide_seconds", "retrains", "seconds")


def replay_of(action: Sequence[str], truth: Sequence[Any], **values: Any) -> Replay:
    """A replay of these actions and truths, with `known` of its other fields; a part of number i is
    the i-th.
    """
    n, rng = len(action), np.random.default_rng(values.get("seed", 0))
    zeros, never = np.zeros(n, dtype=np.int64), np.zeros(n, dtype=bool)
    evidence = {
        "lower": np.zeros(n),
        "upper": np.ones(n),
        "n_success": zeros,
        "n_failure": zeros,
        "version": zeros,
    }
    evidence |= {
        "position": rng.normal(size=(n, 2)),
        "decide_seconds": np.full(n, 1e-4),
        "reason": np.full(n, "certain"),
    }
    about = {"name": "pca", "recipe": Recipe("pca"), "dataset": "by hand", "index": np.arange(n)}
    events = {"stopped": never, "safe_mode": never}
    return Replay(
        action=np.array(action), truth=np.array(truth), **evidence | events | about | values
    )


def same(first: Replay, other: Replay, *but: str) -> None:
    """Assert that two replays differ in their times alone, and in the fields that are named."""
    for f in fields(Replay):
        if f.name not in (*TIMES, *but):
            np.testing.assert_array_equal(
                getattr(first, f.name), getattr(other, f.name), err_msg=f.name
            )
    assert [replace(retrain, seconds=0.0) for retrain in first.retrains] == [
        replace(retrain, seconds=0.0) for retrain in other.retrains
    ]
