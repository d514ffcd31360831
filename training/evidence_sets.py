"""The eight sets of parts that `evidence.py` plays.

Three sets are loaded: `insertion` is bundled, `insertion 1.2 s` is the same set cut to 1.2 seconds,
and `screw driving` is a file that `make_screw_driving.py` writes. Five sets are generated from a
seed, so that each seed has new parts. The parts of a generated set come in the order in which they
were generated, because two of the sets change over time.

>>> data = load_set("drift", seed=100)
"""

from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from dengine import Dataset, load_dataset
from dengine.cells.simulation.conditions import RATE_HZ

N_PARTS = 1000  # of a generated set
N_SAMPLES = 400  # of a generated trace
TRANSIENT = 200  # samples of a resonance that are dropped, until it has forgotten its start
# Engine noise: the share of good parts, the resonances in cycles per sample, how much a frequency
# scatters around its resonance, the poles' distance from zero, and the noise over it.
GOOD_SHARE = 0.6
RESONANCES = {"good": 0.1, "bad": 0.115}
SCATTER = 0.03
POLE_RADIUS = 0.97
NOISE = 0.6
SHORT_SECONDS = 1.2  # of the traces of `insertion 1.2 s`

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


def oscillation(rng: np.random.Generator) -> Dataset:
    """Generate engine noise: a good part has one resonance, a bad one a resonance 15 % higher.

    White noise lies over the resonance.
    """
    good = rng.random(N_PARTS) < GOOD_SHARE
    X = rng.normal(0.0, NOISE, (N_PARTS, N_SAMPLES))
    resonance = np.where(good, RESONANCES["good"], RESONANCES["bad"])
    frequencies = resonance * rng.normal(1.0, SCATTER, N_PARTS)  # cycles per sample
    for i, angle in enumerate(2.0 * np.pi * frequencies):
        excitation = rng.normal(size=N_SAMPLES + TRANSIENT)
        denominator = [1.0, -2.0 * POLE_RADIUS * np.cos(angle), POLE_RADIUS**2]
        ringing = lfilter([1.0], denominator, excitation)[TRANSIENT:]
        X[i] += ringing / ringing.std()
    return to_dataset(X, good)


def drift(rng: np.random.Generator) -> Dataset:
    """Generate insertions with a tool that wears from the first part to the last."""
    return to_dataset(*generate_contacts(rng, np.linspace(0.0, 1.0, N_PARTS)))


def variant(rng: np.random.Generator) -> Dataset:
    """Generate insertions of one kind of part, and of another kind from half way on."""
    wear = (np.arange(N_PARTS) >= N_PARTS // 2).astype(float)
    return to_dataset(*generate_contacts(rng, wear))


def two_channels(rng: np.random.Generator) -> Dataset:
    """Generate force and torque; a part is good if it snaps in by both."""
    force, is_force_good = generate_contacts(rng, np.zeros(N_PARTS))
    torque, is_torque_good = generate_contacts(rng, np.zeros(N_PARTS))
    return to_dataset(np.stack([force, torque], axis=1), is_force_good & is_torque_good)


def opposite(rng: np.random.Generator) -> Dataset:
    """Generate two products in random order; a trace that is good for one is bad for the other.

    The beginning of a trace tells the product, and its end is high or low. The set is meant to be
    hard for `conv`, whose heads are linear. Two of a hundred labels are wrong.
    """
    is_first_product = rng.random(N_PARTS) < 0.5
    is_high = rng.random(N_PARTS) < 0.5
    time = np.linspace(0.0, 1.0, N_SAMPLES)
    begin = np.where(is_first_product, 1.0, -1.0) + rng.normal(0.0, 0.3, N_PARTS)
    end = np.where(is_high, 1.0, -1.0) + rng.normal(0.0, 0.3, N_PARTS)
    X = begin[:, None] * (time < 0.1) + end[:, None] * (time > 0.9)
    X = X + rng.normal(0.0, 0.3, (N_PARTS, N_SAMPLES))
    is_label_wrong = rng.random(N_PARTS) < 0.02
    return to_dataset(X, (is_first_product == is_high) ^ is_label_wrong)


def generate_contacts(rng: np.random.Generator, wear: Floats) -> tuple[Floats, Bools]:
    """Generate forces that rise from contact on, and fall where the part snaps in.

    Parameters
    ----------
    rng : Generator
    wear : array of float, shape (N_PARTS,)
        From 0 to 1. With wear, friction and stiffness grow, contact comes sooner and the force
        falls less.

    Returns
    -------
    force : array of float, shape (N_PARTS, N_SAMPLES)
    good : array of bool, shape (N_PARTS,)
        The force of a bad part hardly falls.
    """
    good = rng.random(N_PARTS) < 0.65
    time = np.linspace(0.0, 1.0, N_SAMPLES)
    fall = rng.normal(np.where(good, 1.5, 0.2) * (1.0 - 0.4 * wear), 0.3)[:, None]
    contact = (rng.normal(0.3, 0.04, N_PARTS) - 0.12 * wear)[:, None]
    stiffness = 3.0 + wear[:, None]
    friction = 0.8 * wear[:, None]
    force = stiffness * np.clip(time - contact, 0.0, None) + friction
    snap_delay = rng.normal(0.4, 0.05, (N_PARTS, 1))
    force -= fall / (1.0 + np.exp(-(time - contact - snap_delay) / 0.01))
    random_walk = np.cumsum(rng.normal(0.0, 0.02, force.shape), axis=1)
    return force + random_walk + rng.normal(0.0, 0.1, force.shape), good


def to_dataset(X: Floats, good: Bools) -> Dataset:
    """Return traces (n, T) or (n, C, T) and labels (n,) as a data set of the name "made".

    The name is part of the hash under which replays are kept: do not change it.
    """
    return Dataset(X.astype(np.float32), good.astype(np.int8), name="made")


GENERATORS = {
    "oscillation": oscillation,
    "drift": drift,
    "variant": variant,
    "two channels": two_channels,
    "opposite": opposite,
}
SETS = ("insertion", "insertion 1.2 s", "screw driving", *GENERATORS)


def load_set(name: str, seed: int, screw_driving: Path | None = None) -> Dataset:
    """Return one of the `SETS`.

    Parameters
    ----------
    name : str
    seed : int
        Of a generated set; the others do not depend on it.
    screw_driving : Path or None, default None
        The file of the set `screw driving`; only this set needs it.
    """
    if name in GENERATORS:
        return GENERATORS[name](np.random.default_rng(seed))
    return _load_recorded(name, screw_driving)


@cache
def _load_recorded(name: str, screw_driving: Path | None) -> Dataset:
    """Return a set that is not generated, loaded once."""
    if name == "screw driving":
        return load_dataset(screw_driving, samples=N_SAMPLES)
    data = load_dataset("insertion")
    if name == "insertion":
        return data
    return data.cut(round(SHORT_SECONDS * RATE_HZ))
