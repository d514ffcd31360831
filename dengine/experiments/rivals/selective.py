"""Selective classification with a guaranteed risk (SGR): the threshold that a held-out set allows.

Source: Geifman and El-Yaniv (2017), "Selective classification for deep neural networks", NIPS 30, Algorithm 1.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from .base import Floats, Labels


def risk_bound(n_wrong: int, n: int, delta: float) -> float:
    """The largest risk under which n_wrong or fewer errors in n have a probability of at least delta.

    The paper's B*, the inversion of the binomial tail: of all risks above it, seeing so few errors is less likely than
    delta. 1 where nothing was seen.
    """
    from scipy.special import betaincinv

    return 1.0 if n_wrong >= n else float(betaincinv(n_wrong + 1.0, n - n_wrong, 1.0 - delta))


def guaranteed_threshold(confidence: Floats, wrong: Labels, risk: float, delta: float) -> float:
    """The confidence from which on a classifier errs with at most `risk`; infinity where no threshold can be vouched for.

    confidence, wrong : (m,) of traces that the classifier was not trained on, and whether it errs on each.
    With probability 1 - delta over these traces the risk beyond the threshold is at most `risk`, if they are independent
    draws from what will be decided: ceil(log2 m) thresholds are looked at, each with its share of delta.
    """
    ordered = np.sort(confidence)
    m, found = len(ordered), math.inf
    looks = max(1, math.ceil(math.log2(max(m, 1))))
    low, high = 1, m  # ranks, as in the paper
    for _ in range(looks if m else 0):
        rank = math.ceil((low + high) / 2)
        beyond = confidence >= ordered[rank - 1]
        if risk_bound(int(wrong[beyond].sum()), int(beyond.sum()), delta / looks) < risk:
            high, found = rank, float(ordered[rank - 1])
        else:
            low = rank
    return found


def held_out(n: int, share: float, seed: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Positions of n traces to train on, and to hold out: a share of them, at random and blind to labels."""
    order = np.random.default_rng(seed).permutation(n)
    size = round(share * n)
    return np.sort(order[size:]), np.sort(order[:size])
