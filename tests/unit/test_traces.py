"""Where a trace enters: shapes and types are the caller's, faults are the world's."""

import json
import math
from contextlib import nullcontext
from dataclasses import asdict, replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dengine import (
    DataEngine,
    DengineError,
    Reason,
    ReplayCell,
    TraceError,
    TraceSpec,
    export_torchscript,
    load_exported,
)
from dengine.decision.scripting import script
from dengine.errors import SettingError
from dengine.records import FITS, stored_trace_spec
from dengine.traces import REASONS, TraceGate, as_trace, can_fit_length
from tests.support.driving import learn
from tests.support.exports import row

NO_TRACES = (np.float32(3.0), np.zeros((2, 3, 4)), np.zeros(0), np.zeros((1, 0)), np.zeros((0, 5)))


def ramp(samples: int = 100, channels: int = 1) -> np.ndarray:
    return np.tile(np.linspace(0, 20, samples, dtype=np.float32), (channels, 1))


def reason_of(x: np.ndarray, limit: float | None = None, compiled: bool = False) -> Reason:
    gate = TraceGate(x.size)
    x = torch.from_numpy(x)
    return REASONS[(script(gate) if compiled else gate)(x, limit or math.inf)[0]]


UNITS = [
    ("N", ["N", "N"], "N"),
    (["N", "N"], ["N", "N"], "N"),
    (["N"], ["N"], "N"),
    (["kN", "mm"], ["kN", "mm"], ("kN", "mm")),
    ("kN, mm", ["kN", "mm"], ("kN", "mm")),
    ("mixed units", ["mixed units"] * 3, "mixed units"),
    ("N, ", ["N", ""], ("N", "")),
    *((unknown, ["", ""], None) for unknown in (None, "", " ", ["", ""], ", ")),
]


@pytest.mark.parametrize(("unit", "units", "stored"), UNITS)
def test_each_channel_has_a_unit(unit, units, stored):
    spec = TraceSpec(10, channels=len(units), unit=unit)
    assert (spec.unit, [*spec.units]) == (stored, units)
    assert stored_trace_spec({"trace": json.dumps(asdict(spec))}) == spec


@pytest.mark.parametrize("unit", [("kN",), ("kN", "mm", "V"), (), 5, (1, 2)])
def test_units_that_are_no_text_or_too_many_are_refused(unit):
    with pytest.raises(SettingError, match="unit"):
        TraceSpec(10, channels=2, unit=unit)


@pytest.mark.parametrize("dtype", ["f2", "f8", ">f4", "i1", ">i2", "i8", "u2", "?"])
def test_every_real_dtype_is_cast_to_float32(dtype):
    x = np.arange(100).astype(dtype)
    result = as_trace(x, None)
    assert result.dtype == np.float32
    assert result.flags.c_contiguous
    np.testing.assert_array_equal(result[0], x.astype(np.float32))
    assert as_trace(x.reshape(50, 2), TraceSpec(2, channels=50)).shape == (50, 2)  # it is agreed on


def test_a_cell_that_knows_its_traces_states_what_the_engine_does_not_know(make_data):
    data = replace(make_data(3), rate_hz=250.0, unit="kN")
    for stated, trace in (
        (None, TraceSpec(100, 250.0, unit="kN")),
        (TraceSpec(100, unit="N"), TraceSpec(100, 250.0, unit="N")),
        (TraceSpec(100, 500.0, fit="pad"), TraceSpec(100, 500.0, unit="kN", fit="pad")),
        (TraceSpec(50, fit="resample"), TraceSpec(50, fit="resample")),  # another rate
    ):
        with DataEngine("pca", trace=stated) as engine:
            assert len(list(engine.run(ReplayCell(data), 2))) == 2
            assert engine.trace == trace


NO_CONTRACTS = {
    "at least 1 sample": {"samples": 0},
    "rate above 0": {"samples": 10, "rate_hz": 0.0},
    "Expected fit to be one of strict, cut, pad, resample": {"samples": 10, "fit": "stretch"},
}


@pytest.mark.parametrize("message", NO_CONTRACTS)
def test_a_contract_that_no_trace_can_keep_is_refused(message):
    with pytest.raises(DengineError, match=message):
        TraceSpec(**NO_CONTRACTS[message])


ONE = r"Expected one trace, \(samples,\) or \(channels, samples\), got shape"
RESAMPLE = (
    "Expected 1000 samples, got 998, which fit='strict' does not allow; resample the trace to"
)
TRANSPOSED = r"got 1000 channels of 2 samples, which looks transposed; turn it, trace\.T"
PADDED = TraceSpec(100, fit="pad")


@pytest.mark.parametrize(
    ("trace", "spec", "message"),
    [
        *((bad, None, ONE) for bad in NO_TRACES),
        *(
            (bad, None, "Expected real numbers, got dtype")
            for bad in (["a"], [2j], [None], "force")
        ),
        (np.ones(998), TraceSpec(1000), RESAMPLE),
        (np.ones(100), TraceSpec(100, channels=6), r"Expected 6 channel\(s\), got 1; pass \(chann"),
        *((np.ones(shape), PADDED, "Expected") for shape in ((1, 0), (2, 90), (90, 1))),
        (np.ones((1000, 2)), None, TRANSPOSED),
    ],
)
def test_a_callers_mistake_says_what_was_expected_what_came_and_what_to_do(trace, spec, message):
    with pytest.raises(TraceError, match=message):
        as_trace(trace, spec)


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize(("channels", "where"), [(1, 0), (3, 57), (3, 99)])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_one_sample_that_is_not_finite_is_found_anywhere(value, where, channels, compiled):
    x = ramp(100, channels)
    x[-1, where] = value
    assert reason_of(x, compiled=compiled) is Reason.NOT_FINITE


PLATEAU = np.minimum(ramp(100), 8.0)
QUIET = ramp(100, 2) * np.array([[1.0], [0.0]], dtype=np.float32)


HUGE = as_trace(np.where(np.arange(10) == 3, 1e300, np.arange(10.0)), None)
LEVELS = [np.full((channels, 50), level) for channels in (1, 2) for level in (0.0, -3.5)]


@pytest.mark.parametrize(
    ("x", "limit", "reason"),
    [
        *((x, None, Reason.CONSTANT) for x in LEVELS),
        (HUGE, None, Reason.NOT_FINITE),
        *((x, 20.0, Reason.SATURATED) for x in (ramp(100), -ramp(100))),  # reaches 20
        *((x, 20.5, Reason.CERTAIN) for x in (ramp(100), -ramp(100), PLATEAU, QUIET)),
        *((x, None, Reason.CERTAIN) for x in (ramp(100), PLATEAU, QUIET)),
    ],
)
def test_dead_and_saturated_sensors_are_found_and_a_plateau_or_one_quiet_channel_is_no_fault(
    x, limit, reason
):
    assert reason_of(np.asarray(x, dtype=np.float32), limit) is reason


SAMPLES = 100


def test_cut_and_pad_keep_what_was_measured_at_its_own_time():
    x = ramp(160)[0]
    np.testing.assert_array_equal(as_trace(x, TraceSpec(SAMPLES, fit="cut"))[0], x[:SAMPLES])
    np.testing.assert_array_equal(as_trace(x[:60], PADDED)[0], [*x[:60], *[x[59]] * 40])


@given(have=st.integers(50, 200), channels=st.integers(1, 3), seed=st.integers(0, 99))
@settings(max_examples=60, deadline=None)
def test_resample_is_linear_interpolation_over_the_whole(have, channels, seed):
    x = np.random.default_rng(seed).normal(size=(channels, have)).astype(np.float32)
    result = as_trace(x, TraceSpec(SAMPLES, channels=channels, fit="resample"))
    grid = np.linspace(0, have - 1, SAMPLES)
    expected = np.stack([np.interp(grid, np.arange(have), row.astype(np.float64)) for row in x])
    np.testing.assert_allclose(result, expected, atol=1e-6)
    np.testing.assert_array_equal(result[:, 0], x[:, 0])


@given(
    have=st.integers(1, 500),
    samples=st.integers(1, 120),
    fit=st.integers(1, 3),
    seed=st.integers(0, 99),
)
@settings(max_examples=150, deadline=None)
def test_what_cannot_honestly_be_fitted_is_refused_and_nothing_else_is(have, samples, fit, seed):
    x = np.random.default_rng(seed).normal(size=(2, have)).astype(np.float32)
    spec = TraceSpec(samples, channels=2, fit=FITS[fit])
    honest = have >= samples if fit == 1 else samples <= 2 * have <= 4 * samples
    assert can_fit_length(have, samples, fit) == honest
    with nullcontext() if honest else pytest.raises(TraceError, match=f"samples, got {have}, "):
        fitted = as_trace(x, spec)
        assert fitted.shape == (2, samples)
        assert np.isfinite(fitted).all()


LENGTHS = (98, 100, 103, 60, 150, 199, 200, 50, 49, 201, 1, 2, 420)


@pytest.mark.parametrize("fit", FITS[1:])
def test_engine_and_exported_file_decide_alike_on_traces_of_two_channels_and_other_lengths(
    fit, make_data, tmp_path
):
    spec, actions = TraceSpec(SAMPLES, channels=2, fit=fit), set()
    engine = DataEngine("pca", trace=spec, retrain_every=10**6)
    learn(engine, make_data(300, SAMPLES, 2), range(300))
    engine.retrain()
    exported = load_exported(export_torchscript(engine, tmp_path / "fit.ts"))
    assert exported.trace == engine.trace
    for i, x in enumerate(make_data(130, SAMPLES, 2, seed=7).X):
        n = LENGTHS[i % 13]
        x = np.tile(x, 5)[:, :n]
        x[1, : i % 20 == 19] = np.nan
        if can_fit_length(n, SAMPLES, FITS.index(fit)):
            ours, theirs = engine.decide(x), exported.decide(x)
            # The compiled fit, as a cell program calls it.
            raw = exported.module.decide(torch.from_numpy(x))
            assert row(ours) == row(theirs)
            assert tuple(raw[2:6]) == row(ours)[2:]
            np.testing.assert_array_equal(raw[6].numpy(), theirs.embedding)
            assert (ours.reason is Reason.NOT_FINITE) == np.isnan(x).any()
            actions.add(ours.action)
        else:
            with pytest.raises(TraceError, match=f"got {n}"):
                exported.decide(x)
            with pytest.raises(torch.jit.Error, match="Expected one trace of 2 x 100 samples"):
                exported.module.decide(torch.from_numpy(x))
    assert "accept" in actions
