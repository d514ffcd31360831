"""The first trace sets the contract of all that follow: not a bad one, not one of three samples,
and not in silence.
"""

import numpy as np
import pytest

from dengine import Action, DataEngine, Reason, TraceSpec
from dengine.errors import TraceError
from dengine.traces import MIN_SAMPLES
from tests.support.driving import learn

BAD = {Reason.NOT_FINITE: np.full(7_000, np.nan), Reason.CONSTANT: np.zeros((3, 500))}


@pytest.mark.parametrize("reason", BAD, ids=str)
def test_a_bad_first_trace_is_verified_and_the_contract_stays_open(tmp_path, reason, make_data):
    data = make_data(80)
    with DataEngine("pca", retrain_every=60, store=tmp_path / "engine.db") as engine:
        for _ in range(2):
            decision = engine.decide(BAD[reason])
            assert (decision.action, decision.reason, engine.trace) == (Action.VERIFY, reason, None)
            engine.report(decision.id, True)  # kept, never trained on
        learn(engine, data, range(len(data)))
        assert engine.trace == TraceSpec(100)
        assert engine.version == 1
        assert engine.store.decisions.counts()["quarantined"] == 2
        assert engine.decide(data.X[0]).reason is not Reason.MODEL_ERROR


@pytest.mark.parametrize("samples", [1, MIN_SAMPLES - 1])
def test_a_first_trace_of_a_few_samples_is_refused_and_nothing_is_stored(samples):
    match = rf"got 1 x {samples}; record longer, or start with DataEngine\(trace="
    with DataEngine("pca") as engine:
        with pytest.raises(TraceError, match=match):
            engine.decide(np.arange(samples))
        assert (engine.trace, engine.store.decisions.counts()["decisions"]) == (None, 0)
        buffer = np.arange(MIN_SAMPLES)
        first = engine.decide(buffer)
        buffer[:] = 0  # it is the caller's, and may be used again
        assert engine.find(first.id).trace[0].tolist() == [*range(MIN_SAMPLES)]
        assert engine.trace == TraceSpec(MIN_SAMPLES)
    with DataEngine("pca", trace=TraceSpec(samples)) as engine:  # it is meant
        assert engine.decide(np.arange(samples)).reason in (Reason.NO_MODEL, Reason.CONSTANT)
