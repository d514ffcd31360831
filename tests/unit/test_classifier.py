"""The estimator: the empty ball, and one bound whoever computes it; scikit-learn's checks are in
test_estimators.
"""

import numpy as np
import pytest
from sklearn.neighbors import RadiusNeighborsClassifier

from dengine import INTERVALS, Action, Policy, WilsonRadiusClassifier
from dengine.errors import SettingError


def blobs(n: int = 400, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    y = (rng.random(n) < 0.7).astype(int)
    return (rng.normal(0, 0.4, (n, 2)) + np.where(y, 1.0, -1.0)[:, None]).astype(np.float32), y


@pytest.mark.parametrize("interval", ["wilson", "binomial", "jeffreys"])
def test_an_empty_ball_abstains_in_decide_and_never_in_predict(interval: str) -> None:
    model = WilsonRadiusClassifier(radius=0.5, interval=interval).fit(*blobs())
    far = np.full((3, 2), 50.0)
    assert list(model.decide(far)) == [Action.VERIFY] * 3
    np.testing.assert_array_equal(model.predict_interval(far), [[0.0] * 3, [1.0] * 3])
    np.testing.assert_array_equal(model.predict_proba(far), np.full((3, 2), 0.5))
    assert set(model.predict(far)) <= {0, 1}


@pytest.mark.parametrize("interval", INTERVALS)
def test_decisions_follow_from_the_interval_and_the_interval_from_the_counts(interval: str) -> None:
    queries = np.random.default_rng(1).uniform(-2, 2, (100, 2))
    policy = Policy(0.1, 0.9, interval)
    model = WilsonRadiusClassifier(0.4, 0.1, 0.9, interval=interval).fit(*blobs())
    bounds = model.predict_interval(queries)
    np.testing.assert_allclose(bounds, policy.bound(*model.count(queries)), atol=1e-12)
    decisions = model.decide(queries)
    assert list(decisions) == list(map(policy.action, *bounds))
    assert set(decisions) == set(Action)


def test_predictions_are_those_of_scikit_learns_radius_neighbours() -> None:
    Z, y = blobs()
    queries = Z[:100] + 0.01
    ours = WilsonRadiusClassifier(radius=0.5).fit(Z, y)
    theirs = RadiusNeighborsClassifier(radius=0.5).fit(Z, y)
    np.testing.assert_allclose(
        ours.predict_proba(queries), theirs.predict_proba(queries), atol=1e-12
    )


@pytest.mark.parametrize(("radius", "alpha"), [(0.0, 0.1), (1e19, 0.1), (np.inf, 0.1), (0.5, 2.0)])
def test_settings_out_of_range_are_setting_errors(radius: float, alpha: float) -> None:
    with pytest.raises(SettingError):
        WilsonRadiusClassifier(radius, alpha).fit(np.zeros((2, 2)), [0, 1])
