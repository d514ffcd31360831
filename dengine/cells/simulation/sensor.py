"""The simulated force sensor: what its faults make of the true wrench.

Its randomness comes from a stream of its own, so that nothing in the reading but the force itself can tell the outcome.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from .conditions import RATE_HZ, CellParameters


@dataclass(frozen=True, slots=True)
class SensorFaults:
    """One trace's draw. All in newtons, but for `ripple_hz` and `dropped_share`."""

    noise_n: float
    ripple_n: float
    ripple_hz: float
    bias_n: float
    drift_n: float
    step_n: float
    dropped_share: float


def draw_sensor(parameters: CellParameters, rng: np.random.Generator) -> SensorFaults:
    """Draw the faults of one trace, independent of the insertion."""
    p = parameters
    return SensorFaults(
        noise_n=float(rng.uniform(*p.noise_n)),
        ripple_n=float(rng.uniform(*p.ripple_n)),
        ripple_hz=float(rng.uniform(*p.ripple_hz)),
        bias_n=float(rng.uniform(*p.bias_n)) + p.bias_offset_n,
        drift_n=float(rng.uniform(*p.drift_n)),
        step_n=float(rng.uniform(*p.step_n)),
        dropped_share=float(rng.uniform(*p.dropped_share)),
    )


def read_sensor(
    wrench: NDArray[np.float64], faults: SensorFaults, parameters: CellParameters, rng: np.random.Generator
) -> NDArray[np.float32]:
    """What the sensor reports of a true wrench (samples, 6), as (6, samples) float32: newtons and newton metres."""
    true = _low_pass(wrench.T, parameters.bandwidth_hz)  # (6, samples)
    unit = np.array([1.0] * 3 + [parameters.torque_scale_m] * 3)[:, None]  # newtons to each channel's own unit
    sign = rng.choice((-1.0, 1.0), size=(6, 1))
    sign[2] = 1.0  # the z-force keeps the sign that was drawn, the other channels get one of their own
    samples = true.shape[1]
    time_s = np.arange(samples) / RATE_HZ
    phase = rng.uniform(0, 2 * np.pi, size=(6, 1))
    slow = faults.bias_n + faults.drift_n * time_s / time_s[-1]
    ripple = faults.ripple_n * np.sin(2 * np.pi * faults.ripple_hz * time_s + phase)
    noise = faults.noise_n * rng.standard_normal(true.shape)
    reading = true / unit + sign * slow + ripple + noise
    steps = np.round(reading / faults.step_n) * faults.step_n
    held = _hold(steps, np.asarray(rng.random(samples) < faults.dropped_share))
    return np.asarray(held * unit, dtype=np.float32)


def _low_pass(signal: NDArray[np.float64], bandwidth_hz: float) -> NDArray[np.float64]:
    """First-order low-pass, as in the sensor's own electronics."""
    keep = float(np.exp(-2 * np.pi * bandwidth_hz / RATE_HZ))
    filtered: NDArray[np.float64] = lfilter([1 - keep], [1, -keep], signal, axis=-1)
    return filtered


def _hold(reading: NDArray[np.float64], dropped: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Replace each dropped sample by the last one that arrived, in all channels at once."""
    arrived = np.where(dropped, 0, np.arange(dropped.size))
    return reading[:, np.maximum.accumulate(arrived)]
