"""A permanent hash of a part: it deals the folds of honest counting, and knows a part that comes twice.

A label may be counted for a query only in an embedding that never saw that label. So every trace has a fold for
life, and it must not depend on ids, order or time: that of its part's number where one is given, or of its content, so
that a controller that knows only the samples computes the same. The content's hash also tosses the coin of an audit. The
arithmetic is 64-bit integers that wrap around, the same in NumPy, TorchScript and C++.
"""

import numpy as np
from numpy.typing import NDArray

QUANTUM = 65536.0  # steps per unit: 15 µN for newtons, below any sensor's noise
CLAMP = float(2**46)  # |value * QUANTUM| stays below 2**62: the cast to int64 is defined on every platform
MIX = -0x61C8864680B583EB  # odd, the golden ratio's 64 bits as a signed integer (Knuth's multiplicative hashing)
AUDIT_SALT = 0x2545F4914F6CDD1D
COIN_BITS = 30
FoldArray = NDArray[np.int64]


def hash_weights(size: int) -> FoldArray:
    """`size` odd int64 weights, one per sample position: the SplitMix64 sequence (Steele, Lea and Flood, 2014)."""
    with np.errstate(over="ignore"):
        z = (np.arange(1, size + 1, dtype=np.uint64)) * np.uint64(0x9E3779B97F4A7C15)
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        z = (z ^ (z >> np.uint64(31))) | np.uint64(1)
    return z.view(np.int64)


def content_hash(X: NDArray[np.floating]) -> FoldArray:
    """(n,) int64 hashes of n traces, (n, T) or (n, C, T). Samples that are not finite count as zero."""
    X = np.asarray(X, dtype=np.float32)
    flat = X.reshape(len(X), int(np.prod(X.shape[1:])))
    weights = hash_weights(flat.shape[1])
    out = np.empty(len(flat), dtype=np.int64)
    for start in range(0, len(flat), 256):  # float64 and int64 copies of a large store would not fit the cache
        block = np.nan_to_num(flat[start : start + 256].astype(np.float64), nan=0.0, posinf=0.0, neginf=0.0)
        steps = np.floor(np.clip(block, -CLAMP, CLAMP) * QUANTUM).astype(np.int64)
        out[start : start + 256] = (steps * weights).sum(axis=1)
    return out


def part_hash(part: str) -> int:
    """The int64 hash of a part's number: 64-bit FNV-1a of its UTF-8 (Fowler, Noll and Vo), read as signed; never 0."""
    h = 0xCBF29CE484222325
    for byte in part.encode():
        h = ((h ^ byte) * 0x100000001B3) & (2**64 - 1)
    return (h - 2**64 if h >= 2**63 else h) or 1


def own_hash(content: int, part: str | None) -> int:
    """The hash that a trace goes by: of its part's number where that is known, else of its content."""
    return content if part is None else part_hash(part)


def toss(hashes: FoldArray, salt: int = 0) -> FoldArray:
    """Uniform integers in [0, 2**30), a fixed function of hash and salt."""
    with np.errstate(over="ignore"):
        h = np.asarray(hashes, dtype=np.int64) ^ np.int64(salt)
        h = (h ^ (h >> 32)) * np.int64(MIX)
        h = (h ^ (h >> 32)) * np.int64(MIX)
        return (h >> (63 - COIN_BITS)) & np.int64(2**COIN_BITS - 1)


def fold_of(hashes: FoldArray, folds: int) -> FoldArray:
    """(n,) fold of each hash, 0 .. folds - 1."""
    return toss(hashes) % folds


def content_fold(X: NDArray[np.floating], folds: int) -> FoldArray:
    """(n,) permanent fold of each trace, 0 .. folds - 1."""
    return fold_of(content_hash(X), folds)


def audit_salt(seed: int) -> int:
    """The salt of an engine's audits: another coin than the folds', another one for each seed."""
    return AUDIT_SALT ^ (seed & 0x7FFFFFFF)


def audited(hashes: FoldArray, audit_rate: float, seed: int) -> NDArray[np.bool_]:
    """Whether each trace is audited if the model is certain of it: a coin of probability `audit_rate`."""
    return toss(hashes, audit_salt(seed)) < int(audit_rate * 2**COIN_BITS)
