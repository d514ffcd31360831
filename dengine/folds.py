"""Permanent hashes of traces and parts: they assign folds, draw audits and recognise parts. The
reducers, the decider, the store and the imports compute with them.

A label may be counted for a query only in an embedding that never saw that label, so every trace
has a fold for life. The fold must not depend on ids, order or time: it comes from the number of the
part if that is given, else from the content of the trace, so that a controller that knows only the
samples computes the same. The content hash also decides at random, but repeatably, which parts are
audited. The arithmetic is on 64-bit integers that wrap around, the same in NumPy, TorchScript and
C++. `traces.TraceGate` computes the content hash and `decision.decider.Decider` the random integers
of audits in TorchScript.
"""

import math

import numpy as np
from numpy.typing import NDArray

from .records import Ints

QUANTUM = 65536.0  # steps per unit: 15 µN for newtons, below any sensor's noise
CLAMP = float(2**46)  # |value * QUANTUM| stays below 2**62: the cast to int64 is defined everywhere
MIX = -0x61C8864680B583EB  # odd, the golden ratio's 64 bits as a signed integer (Knuth)
AUDIT_SALT = 0x2545F4914F6CDD1D
COIN_BITS = 30
BLOCK_SIZE = 256  # traces hashed at once: float64 and int64 copies of a large store miss the cache


def hash_weights(size: int) -> Ints:
    """Return pseudo-random odd integers, one for each sample of a trace; the same at each call.

    Parameters
    ----------
    size : int
        Number of samples of a trace, all channels together.

    Returns
    -------
    array of int64, shape (size,)

    References
    ----------
    Steele, Lea and Flood (2014), OOPSLA: the SplitMix64 sequence.
    """
    with np.errstate(over="ignore"):
        z = np.arange(1, size + 1, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        z = (z ^ (z >> np.uint64(31))) | np.uint64(1)
    return z.view(np.int64)


def content_hash(X: NDArray[np.floating]) -> Ints:
    """Hash the content of traces, a weighted sum of the samples that wraps around at 64 bits.

    Each sample is first cast to float32, clipped to ±2**46 and rounded down to 1/65,536 of its
    unit. Traces that are equal after this have equal hashes.

    Parameters
    ----------
    X : array of float, shape (n, T) or (n, C, T)
        A trace is read channel after channel. Samples that are not finite, in float32, count as
        zero. n may be 0.

    Returns
    -------
    array of int64, shape (n,)
    """
    X = np.asarray(X, dtype=np.float32)
    flat = X.reshape(len(X), math.prod(X.shape[1:]))
    weights = hash_weights(flat.shape[1])
    hashes = np.empty(len(flat), dtype=np.int64)
    for start in range(0, len(flat), BLOCK_SIZE):
        rows = slice(start, start + BLOCK_SIZE)
        block = np.nan_to_num(flat[rows].astype(np.float64), nan=0.0, posinf=0.0, neginf=0.0)
        steps = np.floor(np.clip(block, -CLAMP, CLAMP) * QUANTUM).astype(np.int64)
        hashes[rows] = (steps * weights).sum(axis=1)
    return hashes


def part_hash(part: str) -> int:
    """Hash the number of a part, the text that names it, to a signed 64-bit integer, never 0.

    A hash of 0 would stand for a part without a number, so it becomes 1. Equal texts have equal
    hashes, in every process. Raises UnicodeEncodeError for a text that is not valid Unicode.

    References
    ----------
    Fowler, Noll and Vo: FNV-1a, 64 bits, of the UTF-8 bytes.
    """
    h = 0xCBF29CE484222325
    for byte in part.encode():
        h = ((h ^ byte) * 0x100000001B3) & (2**64 - 1)
    return (h - 2**64 if h >= 2**63 else h) or 1


def trace_hash(content: int, part: str | None) -> int:
    """Return the hash that a trace goes by: of its part's number if known, else of its content."""
    return content if part is None else part_hash(part)


def toss(hashes: Ints | int, salt: int = 0) -> Ints:
    """Return a pseudo-random integer from 0 to 2**30 - 1 for each hash, int64, in their shape.

    It is a fixed function of the hash and the salt, an integer that makes another sequence: the
    same arguments give the same integers.
    """
    with np.errstate(over="ignore"):
        h = np.asarray(hashes, dtype=np.int64) ^ np.int64(salt)
        h = (h ^ (h >> 32)) * np.int64(MIX)
        h = (h ^ (h >> 32)) * np.int64(MIX)
        return (h >> (63 - COIN_BITS)) & np.int64(2**COIN_BITS - 1)


def fold_of(hashes: Ints | int, folds: int) -> Ints:
    """Return the fold of each hash, 0 .. folds - 1, as int64 in the shape of the hashes.

    The fold depends on the hash and the number of folds alone, so it stays for life.
    """
    return toss(hashes) % folds


def content_fold(X: NDArray[np.floating], folds: int) -> Ints:
    """Return the fold of each trace of (n, T) or (n, C, T) by its content, int64 (n,).

    A fold is 0 .. folds - 1. Equal traces are in one fold, whatever their parts' numbers.
    """
    return fold_of(content_hash(X), folds)


def audit_salt(seed: int) -> int:
    """Return the salt of `toss` for audits under a seed; it differs from the folds' salt, 0.

    Only the lowest 31 bits of the seed count.
    """
    return AUDIT_SALT ^ (seed & 0x7FFFFFFF)
