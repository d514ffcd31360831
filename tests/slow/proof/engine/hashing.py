"""Folds, audits and hashes of parts and traces, written anew from `docs/explanation`, in plain
integers.

    >>> fold(hash_of_part("17"), 5)
    4

It shares no line with `dengine.folds`; `tests/unit/test_histories.py` compares the two.
"""

import math

import numpy as np
from numpy.typing import NDArray

BITS_64 = 2**64 - 1
GOLDEN = 0x9E3779B97F4A7C15
STEPS_PER_UNIT = 65536
AUDITS = 0x2545F4914F6CDD1D


def signed(value: int) -> int:
    """Return the signed 64-bit integer that has the lowest 64 bits of a value."""
    value &= BITS_64
    return value - 2**64 if value >= 2**63 else value


def hash_of_part(number: str) -> int:
    """Return the hash of a part's number: FNV-1a, 64 bits, and 1 in place of 0."""
    value = 0xCBF29CE484222325
    for byte in number.encode():
        value = (value ^ byte) * 0x100000001B3 & BITS_64
    return signed(value) or 1


def hash_of_trace(trace: NDArray[np.float32]) -> int:
    """Return the content hash of a finite trace: its samples in steps, weighted by SplitMix64."""
    total = 0
    state = 0
    for sample in trace.ravel().tolist():
        state = (state + GOLDEN) & BITS_64
        z = (state ^ state >> 30) * 0xBF58476D1CE4E5B9 & BITS_64
        z = (z ^ z >> 27) * 0x94D049BB133111EB & BITS_64
        total += math.floor(sample * STEPS_PER_UNIT) * ((z ^ z >> 31) | 1)
    return signed(total)


def mixed(value: int) -> int:
    """Return an integer from 0 to 2**30 - 1 that looks random and is a function of the value."""
    value = signed(value)
    for _ in range(2):
        value = signed((value ^ value >> 32) * GOLDEN)
    return value >> 33 & 2**30 - 1


def fold(hash_: int, n_folds: int) -> int:
    """Return the permanent fold of a part or trace."""
    return mixed(hash_) % n_folds


def is_audited(content: int, seed: int, rate: float) -> bool:
    """Return whether the coin of a trace, by its content, asks for an audit."""
    return mixed(content ^ AUDITS ^ seed & 0x7FFFFFFF) < int(rate * 2**30)
