"""The estimator: the empty ball, and one bound whoever computes it; scikit-learn's checks are in
test_estimators.
"""

import numpy as np
import pytest
from sklearn.datasets import make_blobs

from dengine import INTERVALS, Action, Policy, WilsonRadiusClassifier
from dengine.errors import SettingError


def blobs() -> tuple[np.ndarray, np.ndarray]:
    """Points of two classes, mostly of the second one."""
    X, y = make_blobs(400, centers=[[-1, -1], [1, 1], [1, 1]], cluster_std=0.4, random_state=0)
    return X.astype(np.float32), np.minimum(y, 1)


@pytest.mark.parametrize("interval", ["wilson", "binomial", "jeffreys"])
def test_an_empty_ball_abstains_in_decide_and_never_in_predict(interval):
    model = WilsonRadiusClassifier(radius=0.5, interval=interval).fit(*blobs())
    far = np.full((3, 2), 50.0)
    assert list(model.decide(far)) == [Action.VERIFY] * 3
    np.testing.assert_array_equal(model.predict_interval(far), [[0.0] * 3, [1.0] * 3])
    np.testing.assert_array_equal(model.predict_proba(far), np.full((3, 2), 0.5))
    assert set(model.predict(far)) <= {0, 1}


@pytest.mark.parametrize("interval", INTERVALS)
def test_decisions_follow_from_the_interval_and_the_interval_from_the_counts(interval):
    queries = np.random.default_rng(1).uniform(-2, 2, (100, 2))
    policy = Policy(0.1, 0.9, interval)
    model = WilsonRadiusClassifier(0.4, 0.1, 0.9, interval=interval).fit(*blobs())
    bounds = model.predict_interval(queries)
    np.testing.assert_allclose(bounds, policy.bound(*model.count(queries)), atol=1e-12)
    decisions = model.decide(queries)
    assert list(decisions) == list(map(policy.action, *bounds))
    assert set(decisions) == set(Action)


@pytest.mark.parametrize(("radius", "alpha"), [(0.0, 0.1), (1e19, 0.1), (np.inf, 0.1), (0.5, 2.0)])
def test_settings_out_of_range_are_setting_errors(radius, alpha):
    with pytest.raises(SettingError):
        WilsonRadiusClassifier(radius, alpha).fit(np.zeros((2, 2)), [0, 1])
