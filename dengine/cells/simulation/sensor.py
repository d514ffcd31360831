"""The simulated force sensor: what its faults make of the true wrench.

Its randomness comes from a stream of its own, so that nothing in the reading but the force itself can tell the outcome.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from .conditions import RATE_HZ, CellParameters


@dataclass(frozen=True, slots=True)
class SensorFaults:
    """One trace's draw, in this order. All in newtons, but for `ripple_hz` and `dropped_share`."""

    noise_n: float
    ripple_n: float
    ripple_hz: float
    bias_n: float
    drift_n: float
    step_n: float
    dropped_share: float


def draw_sensor(parameters: CellParameters, rng: np.random.Generator) -> SensorFaults:
    """Draw the faults of one trace, independent of the insertion."""
    drawn = {each.name: float(rng.uniform(*getattr(parameters, each.name))) for each in fields(SensorFaults)}
    return replace(SensorFaults(**drawn), bias_n=drawn["bias_n"] + parameters.bias_offset_n)


def read_sensor(
    wrench: NDArray[np.float64], faults: SensorFaults, parameters: CellParameters, rng: np.random.Generator
) -> NDArray[np.float32]:
    """What the sensor reports of a true wrench (samples, 6), as (6, samples) float32: newtons and newton metres."""
    keep = float(np.exp(-2 * np.pi * parameters.bandwidth_hz / RATE_HZ))
    true: NDArray[np.float64] = lfilter([1 - keep], [1, -keep], wrench.T, axis=-1)  # the first-order low-pass in the sensor
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
    arrived = np.where(rng.random(samples) < faults.dropped_share, 0, np.arange(samples))
    held = steps[
        :, np.maximum.accumulate(arrived)
    ]  # of a dropped sample the last one that arrived, in all channels at once
    return np.asarray(held * unit, dtype=np.float32)
