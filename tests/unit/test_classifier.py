"""The estimator: the empty ball, and one bound whoever computes it; scikit-learn's checks are in
test_estimators.
"""

import numpy as np
import pytest
import torch
from sklearn.neighbors import RadiusNeighborsClassifier

from dengine import INTERVALS, Action, Policy, WilsonRadiusClassifier
from dengine.decision.scripting import script
from dengine.errors import SettingError


def blobs(n: int = 400, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    y = (rng.random(n) < 0.7).astype(int)
    return (rng.normal(0, 0.4, (n, 2)) + np.where(y, 1.0, -1.0)[:, None]).astype(np.float32), y


@pytest.mark.parametrize(
    "settings_", [{}, {"interval": "binomial"}, {"interval": "jeffreys"}, {"alpha": 0.9}]
)
def test_an_empty_ball_abstains_in_decide_and_never_in_predict(settings_) -> None:
    Z, y = blobs()
    model = WilsonRadiusClassifier(radius=0.5, **settings_).fit(Z, y)
    far = np.full((3, 2), 50.0)
    assert list(model.decide(far)) == [Action.VERIFY] * 3
    np.testing.assert_array_equal(model.predict_interval(far), [[0.0] * 3, [1.0] * 3])
    np.testing.assert_array_equal(model.predict_proba(far), np.full((3, 2), 0.5))
    assert set(model.predict(far)) <= {0, 1}


@pytest.mark.parametrize("interval", INTERVALS)
def test_decisions_follow_from_the_interval_and_the_interval_from_the_counts(interval: str) -> None:
    Z, y = blobs()
    queries = np.random.default_rng(1).uniform(-2, 2, (100, 2))
    model = WilsonRadiusClassifier(0.4, alpha=0.1, lower_bound=0.9, interval=interval).fit(Z, y)
    policy = Policy(0.1, 0.9, interval)
    lower, upper = model.predict_interval(queries)
    np.testing.assert_allclose((lower, upper), policy.bound(*model.count(queries)), atol=1e-12)
    decisions = model.decide(queries)
    assert list(decisions) == [policy.action(*item) for item in zip(lower, upper, strict=True)]
    assert set(decisions) == set(Action)


def test_predictions_are_those_of_scikit_learns_radius_neighbours() -> None:
    Z, y = blobs()
    queries = Z[:100] + 0.01
    ours = WilsonRadiusClassifier(radius=0.5).fit(Z, y)
    theirs = RadiusNeighborsClassifier(radius=0.5).fit(Z, y)
    np.testing.assert_allclose(
        ours.predict_proba(queries), theirs.predict_proba(queries), atol=1e-12
    )


def test_scripted_the_rule_over_the_ring_answers_as_the_classifier_does() -> None:
    Z, y = blobs()
    model = WilsonRadiusClassifier(radius=0.4, alpha=0.1, lower_bound=0.9).fit(Z, y)
    scripted = script(model.neighbours_over(model.index_))
    queries = torch.rand(60, 1, 2, generator=torch.Generator().manual_seed(0)) * 4 - 2
    assert [scripted(q) for q in queries] == [model.neighbours_(q) for q in queries]


@pytest.mark.parametrize(
    "settings_", [{"radius": 0.0}, {"radius": 1e19}, {"radius": np.inf}, {"alpha": 2.0}]
)
def test_settings_out_of_range_are_setting_errors(settings_) -> None:
    with pytest.raises(SettingError):
        WilsonRadiusClassifier(**settings_).fit(np.zeros((2, 2)), [0, 1])
