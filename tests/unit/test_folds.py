"""The permanent hash: of content alone, the same everywhere, for ever."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy import stats

from dengine import TraceSpec
from dengine.decision.decider import Decider, DecisionConditions, VerifyAll
from dengine.decision.scripting import script
from dengine.errors import SettingError
from dengine.folds import content_fold, content_hash, fold_of, toss
from dengine.records import Reason
from dengine.reducers.base import folds_of
from dengine.traces import TraceGate

any_float32 = st.floats(width=32, allow_nan=True, allow_infinity=True)
traces = hnp.arrays(
    np.float32,
    hnp.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=12),
    elements=any_float32,
)


def noise(n: int, samples: int = 50, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(0, 10, (n, samples)).astype(np.float32)


def audited(hashes: np.ndarray, rate: float, seed: int) -> np.ndarray:
    """What the decider's coin says of each hash."""
    decider = Decider(VerifyAll(Reason.NO_MODEL), DecisionConditions(TraceSpec(20), seed=seed))
    return np.array([decider.is_audited(int(h), rate) for h in hashes])


def golden_traces() -> dict[str, np.ndarray]:
    ramp = np.arange(1000, dtype=np.float32) / 8
    odd = np.array(
        [0.5, np.nan, -np.inf, np.inf, -1.25, 3e38, -3e38, 1e-20, -0.0], dtype=np.float32
    )
    return {"zeros": np.zeros(1000, np.float32), "ramp": ramp, "falling": -ramp[::-1].copy(), "odd": odd,
            "two channels": np.stack([ramp[:152], ramp[152:304]])}  # fmt: skip


GOLDEN = {  # (hash, toss, fold of 2, fold of 5): a store, a controller and an exported file rely on every one
    "zeros": (0, 0, 0, 0),
    "ramp": (8548868241147854848, 1036997479, 1, 4),
    "falling": (8255207352831803392, 100986282, 0, 2),
    "odd": (-1704657004933038080, 40023773, 1, 3),
    "two channels": (-6115420420893392896, 790665473, 1, 3),
}


@pytest.mark.parametrize("name", GOLDEN)
def test_the_hash_of_a_trace_never_changes(name):
    x = np.atleast_2d(golden_traces()[name])
    h = content_hash(x[None])
    assert (*h, *toss(h), *fold_of(h, 2), *fold_of(h, 5)) == GOLDEN[name]
    gate = script(TraceGate(x.size))
    assert gate(torch.from_numpy(x))[1] == h[0]  # compiled, as in an exported file


def test_a_hash_depends_on_the_values_of_its_trace_alone():
    X = np.round(noise(20)).astype(np.int16)
    hashes = content_hash(X)
    for same in (X.astype(np.float64), np.asfortranarray(X), X[:, None, :]):
        np.testing.assert_array_equal(content_hash(same), hashes)
    np.testing.assert_array_equal(content_hash(X[::-3]), hashes[::-3])


@given(traces)
def test_the_scripted_gate_hashes_as_numpy_does_for_any_float(x):
    assert TraceGate(x.size)(torch.from_numpy(x))[1] == content_hash(x[None])[0]


@pytest.mark.parametrize("step", [2.0**-20, 1.0])  # of a sensor: low bits of a raw hash are zeros
@pytest.mark.parametrize("folds", [2, 5])
def test_folds_are_balanced(folds, step):
    X = np.round(noise(10_000, 20) / step) * step
    assert stats.chisquare(np.bincount(content_fold(X, folds), minlength=folds)).pvalue > 1e-4


@pytest.mark.parametrize("folds", [[0], [0, 2], [-1, 0]])
def test_each_trace_needs_a_fold_within_the_range(folds):
    with pytest.raises(SettingError, match="2 folds from 0 to 1"):
        folds_of(noise(2), 2, folds)


@pytest.mark.parametrize("rate", [0.02, 0.5])
def test_the_audit_coin_keeps_its_rate_and_ignores_the_fold(rate):
    h = content_hash(noise(8_000, 20))
    coin, fold = audited(h, rate, seed=3), fold_of(h, 2)
    assert stats.binomtest(int(coin.sum()), len(h), rate).pvalue > 1e-4
    assert stats.chi2_contingency(np.bincount(2 * coin + fold).reshape(2, 2)).pvalue > 1e-4


def test_engines_of_different_seeds_audit_different_traces():
    h = content_hash(noise(8_000, 20))
    first, other = audited(h, 0.5, seed=1), audited(h, 0.5, seed=2)
    assert stats.binomtest(int((first == other).sum()), len(h), 0.5).pvalue > 1e-4
    np.testing.assert_array_equal(first, audited(h, 0.5, seed=1))
