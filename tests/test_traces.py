"""Where a trace enters: shapes and types are the caller's, faults are the world's."""

import numpy as np
import pytest
import torch

from dengine import Reason, TraceError, TraceSpec
from dengine.decision.rule import script
from dengine.traces import REASONS, TraceGate, as_trace, as_traces, spec_of

LENGTHS, CHANNELS = (152, 800, 1000), (1, 2, 3, 6)


def ramp(samples: int = 100, channels: int = 1) -> np.ndarray:
    return np.tile(np.linspace(0, 20, samples, dtype=np.float32), (channels, 1))


def reason_of(x: np.ndarray, limit: float | None = None, compiled: bool = False) -> Reason:
    gate = TraceGate(TraceSpec(samples=x.shape[1], channels=x.shape[0], limit=limit))
    return REASONS[(script(gate) if compiled else gate)(torch.from_numpy(x))[0]]


# --------------------------------------------------------------------------------------------- shapes and types


@pytest.mark.parametrize("samples", LENGTHS)
@pytest.mark.parametrize("channels", CHANNELS)
def test_any_length_and_number_of_channels_becomes_channels_by_samples(samples: int, channels: int) -> None:
    x = ramp(samples, channels)
    spec = TraceSpec(samples=samples, channels=channels)
    assert as_trace(x, None).shape == as_trace(x, spec).shape == (channels, samples)
    assert spec_of(as_trace(x, None)) == spec
    assert as_traces(np.stack([x, x, x]), spec).shape == (3, channels, samples)


def test_a_flat_trace_is_one_channel() -> None:
    np.testing.assert_array_equal(as_trace(ramp()[0], None), ramp())
    np.testing.assert_array_equal(as_traces(ramp(channels=4), None), ramp(channels=4)[:, None, :])


@pytest.mark.parametrize("dtype", ["f2", "f4", "f8", ">f4", ">f8", "i1", "i2", ">i2", "i4", "i8", "u2", "?"])
def test_every_real_dtype_is_cast_to_float32(dtype: str) -> None:
    x = np.arange(100).astype(dtype)
    got = as_trace(x, None)
    assert got.dtype == np.float32
    assert got.flags.c_contiguous
    np.testing.assert_array_equal(got[0], x.astype(np.float32))


def test_lists_and_strided_views_are_traces_too() -> None:
    x = ramp(200)
    np.testing.assert_array_equal(as_trace(x[0].tolist(), None), x)
    np.testing.assert_array_equal(as_trace(x[0, ::-2], None)[0], x[0, ::-2])


def test_a_float64_beyond_float32_becomes_an_infinity_that_the_gate_finds() -> None:
    x = ramp(10).astype(np.float64)
    x[0, 3] = 1e300
    assert reason_of(as_trace(x, None)) is Reason.NOT_FINITE


@pytest.mark.parametrize("bad", [np.float32(3.0), np.zeros((2, 3, 4)), np.zeros(0), np.zeros((1, 0)), np.zeros((0, 5))])
def test_what_is_not_one_trace_says_what_was_expected_and_what_came(bad) -> None:
    with pytest.raises(TraceError, match=r"Expected one trace, \(samples,\) or \(channels, samples\), got shape"):
        as_trace(bad, None)


@pytest.mark.parametrize("bad", [np.zeros(5), np.zeros((2, 0)), np.zeros((1, 2, 3, 4))])
def test_what_is_not_a_block_of_traces_says_so(bad) -> None:
    with pytest.raises(TraceError, match=r"Expected traces \(n, samples\)"):
        as_traces(bad)


@pytest.mark.parametrize("bad", [np.array(["a", "b"]), np.array([1 + 2j]), np.array([None, 1]), "force"])
def test_what_is_not_real_numbers_names_its_dtype(bad) -> None:
    with pytest.raises(TraceError, match="Expected real numbers, got dtype"):
        as_trace(bad, None)


def test_a_wrong_length_says_what_was_expected_what_came_and_what_to_do() -> None:
    with pytest.raises(TraceError, match=r"^Expected 1000 samples, got 998; resample the trace to 500 Hz x 2 s\.$"):
        as_trace(np.ones(998), TraceSpec(samples=1000))


def test_a_wrong_number_of_channels_says_what_was_expected_what_came_and_what_to_do() -> None:
    with pytest.raises(TraceError, match=r"Expected 6 channel\(s\), got 1; pass \(channels, samples\)"):
        as_trace(np.ones(100), TraceSpec(samples=100, channels=6))


# -------------------------------------------------------------------------------------------------- the world


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("where", [0, 57, 99])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_one_sample_that_is_not_finite_is_found_anywhere(value, where, channels, compiled) -> None:
    x = ramp(100, channels)
    x[-1, where] = value
    assert reason_of(x, compiled=compiled) is Reason.NOT_FINITE


@pytest.mark.parametrize("level", [0.0, -3.5, 25.0])
@pytest.mark.parametrize("channels", [1, 2])
def test_a_trace_constant_as_a_whole_is_a_dead_sensor(level: float, channels: int) -> None:
    assert reason_of(np.full((channels, 50), level, dtype=np.float32)) is Reason.CONSTANT


def test_a_plateau_is_no_fault_and_neither_is_one_quiet_channel() -> None:
    plateau = ramp(100)
    plateau[0, 40:] = plateau[0, 40]
    quiet = ramp(100, 2)
    quiet[1] = 0.0
    assert reason_of(plateau) is Reason.CERTAIN
    assert reason_of(quiet) is Reason.CERTAIN


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_sample_at_the_sensors_range_saturates_on_either_side(sign: float) -> None:
    x = sign * ramp(100)  # reaches 20
    assert reason_of(x, limit=20.0) is Reason.SATURATED
    assert reason_of(x, limit=20.5) is Reason.CERTAIN
    assert reason_of(x) is Reason.CERTAIN
