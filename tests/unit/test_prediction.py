"""The model prediction: no label is counted in an embedding that saw it, and states and processes
carry it unchanged.
"""

import numpy as np
import pytest
import torch
from scipy.special import expit, logit
from sklearn.base import BaseEstimator, TransformerMixin
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.neighbors import NeighborhoodComponentsAnalysis

from dengine import (
    DataEngine,
    ModelPrediction,
    Policy,
    Reason,
    TraceError,
    TraceSpec,
    WilsonRadiusClassifier,
)
from dengine.decision.decider import DecisionConditions, trace_gate
from dengine.folds import content_fold, content_hash
from dengine.records import ACTIONS, REASONS
from dengine.reducers.base import space_scale

CLASSIFIER = WilsonRadiusClassifier(radius=0.5, alpha=0.1, lower_bound=0.9)


@pytest.mark.parametrize("part", [0, 7])
def test_the_decider_says_what_gate_and_prediction_say_one_after_the_other(part, make_data):
    data = make_data(120, samples=40)
    model = ModelPrediction("rocket", WilsonRadiusClassifier(radius=0.05), 5).fit(data.X, data.y)
    conditions = DecisionConditions(TraceSpec(40))
    for x in (*data.X[110:, None], *make_data(10, samples=40, seed=9).X[:, None]):
        decided = model.decide_one(x, part, conditions)
        fault, content, action, predicted, reason, *evidence, z, propensity = decided
        assert (fault, content) == trace_gate(*x.shape)(torch.from_numpy(x))
        assert (action, propensity) == (predicted, 0.0 if action else 1.0)
        expected = (ACTIONS[action], *evidence, tuple(map(tuple, z.tolist())), REASONS[reason])
        assert model.predict_one(x, part or content) == expected  # without a vote on itself


@pytest.mark.parametrize("folds", [2, 3])
@pytest.mark.parametrize(
    "reducer",
    [
        LinearDiscriminantAnalysis(),
        NeighborhoodComponentsAnalysis(n_components=2, max_iter=5, random_state=0),
    ],
    ids=["lda", "nca"],
)
def test_labels_of_fold_k_move_neither_its_references_nor_any_query_in_space_k(
    reducer, folds, make_data
):
    data = make_data(120, samples=40)
    queries = make_data(15, samples=40, seed=9).X[:, None, :]
    fold = content_fold(data.X, folds)
    honest = ModelPrediction(reducer, CLASSIFIER, folds).fit(data.X, data.y)
    assert (honest.index.spaces[:120].numpy() == fold).all()
    for k in range(folds):
        y, inside = data.y.copy(), np.flatnonzero(fold == k)
        y[inside] = np.random.default_rng(k).permutation(y[inside])
        other = ModelPrediction(reducer, CLASSIFIER, folds).fit(data.X, y)
        first, second = (model.spaces.embed(queries) for model in (honest, other))
        np.testing.assert_array_equal(second[:, k], first[:, k])
        np.testing.assert_array_equal(*[model.index.points[:, inside] for model in (honest, other)])
        assert other.scale[k] == honest.scale[k]
        assert not np.array_equal(second, first)  # the other spaces did see them


def test_a_label_added_later_is_counted_in_its_own_folds_space(data):
    model = ModelPrediction(LinearDiscriminantAnalysis(), CLASSIFIER, 2)
    model.fit(data.X[:150], data.y[:150])
    for x, y in zip(data.X[150:], data.y[150:], strict=True):
        model.add(x, y)
    ring, fold = model.index, content_fold(data.X, 2)
    assert (ring.spaces[:200].numpy() == fold).all()
    assert (ring.labels[1, :200].numpy() == data.y).all()
    places = model.spaces.embed_references(data.X[150:, None, :], fold[150:])
    places /= model.scale[fold[150:], None]
    np.testing.assert_allclose(ring.points[:, 150:200].numpy().T, places, atol=1e-5)


def test_a_trace_of_another_shape_is_refused_even_where_the_encoder_would_take_it(data):
    model = ModelPrediction("rocket", novelty=0).fit(data.X, data.y)
    longer = np.pad(data.X, ((0, 0), (0, 100)))
    with pytest.raises(TraceError, match="samples"):
        model.add(longer[0], 1)
    with pytest.raises(TraceError, match="samples"):
        model.count(longer)


class _Nosy(TransformerMixin, BaseEstimator):
    """Takes labels if it is handed any, and does not say so."""

    def fit(self, X, y=None):
        assert y is None, "a label-free reducer was handed labels"
        self.n_ = len(X)
        return self

    def transform(self, X):
        return np.asarray(X)[:, :2]


@pytest.mark.parametrize("reducer", ["pca", "rocket", "conv"])
def test_a_label_too_few_is_refused_and_leaves_the_references(data, reducer):
    model = ModelPrediction(reducer).fit(data.X, data.y)
    before = model.count(data.X[:5])
    with pytest.raises(ValueError, match="inconsistent"):
        model.fit(data.X, data.y[:-1])
    np.testing.assert_array_equal(model.count(data.X[:5]), before)


def test_a_reducer_that_does_not_say_it_uses_labels_is_never_handed_any(data):
    model = ModelPrediction(_Nosy(), CLASSIFIER).fit(data.X, data.y)
    assert model.n_spaces == 1
    assert model.spaces.reducer_.n_ == 200


@pytest.mark.parametrize("reducer", ["pca", LinearDiscriminantAnalysis()], ids=["pca", "lda"])
def test_the_unit_of_the_traces_does_not_matter(reducer, data):
    X, y, queries, hashes = data.X[:150], data.y[:150], data.X[150:], content_hash(data.X[:150])
    newtons = ModelPrediction(reducer, CLASSIFIER).fit(X, y, hashes=hashes)
    smaller = ModelPrediction(reducer, CLASSIFIER).fit(
        1024 * X, y, hashes=hashes
    )  # a power of two: exact in floats
    assert newtons.predict_interval(queries)[0].max() > 0.8
    np.testing.assert_array_equal(smaller.count(1024 * queries), newtons.count(queries))


def test_a_successor_learns_without_disturbing_its_parent(data):
    parent = ModelPrediction("pca", CLASSIFIER).fit(data.X[:100], data.y[:100])
    before = parent.predict_many(data.X[100:])
    child = parent.successor().fit(data.X[50:], 1 - data.y[50:])
    child.add(data.X[0], 1)
    assert parent.predict_many(data.X[100:]) == before
    assert child.predict_many(data.X[100:]) != before


def test_the_cost_guarantee_draws_probabilities_towards_one_half_while_labels_are_few(make_data):
    """A prior worth three labels: the logit of the members' mean is multiplied by n / (n + 3)."""
    data, policy = make_data(90, samples=40), Policy(guarantee="cost", stops="all")
    engine = DataEngine("rocket", policy=policy, replaying=True)
    for x, y in zip(data.X[:80], data.y, strict=False):
        engine.report(engine.decide(x).id, bool(y))
    n_compared = 0
    for n in range(80, 90):
        decision = engine.decide(data.X[n])
        if decision.reason is not Reason.NOVEL:
            mean = np.mean([space[0] for space in decision.embedding])
            assert decision.lower == pytest.approx(expit(logit(mean) * n / (n + 3)), abs=1e-5)
            n_compared += 1
        engine.report(decision.id, True)
    assert n_compared > 3


def test_a_glitch_among_the_references_spoils_no_training(data):
    X = data.X.copy()
    X[0, 5] = 1e30
    model = ModelPrediction("pca", CLASSIFIER).fit(X, data.y)
    assert model.predict_interval(data.X)[0].max() > 0.8


def test_the_scale_of_copies_of_one_trace_is_1_whatever_their_mean_rounds_to():
    for point in np.random.default_rng(0).uniform(-50.0, 50.0, (200, 2)).astype(np.float32):
        points = np.stack([point, point, point, point + np.float32(1e4)])  # the last is an outlier
        assert space_scale(points, np.zeros(4, np.int64), 1) == 1.0
