"""One contract over every entry of `REDUCERS`, and over reducers that come from outside: whoever
joins keeps it.
"""

from contextlib import closing
from typing import Any

import numpy as np
import pytest
import torch
from sklearn.base import BaseEstimator, TransformerMixin
from sklearn.decomposition import PCA
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from torch import nn

from dengine import (
    REDUCERS,
    DataEngine,
    Dataset,
    ModelPrediction,
    Policy,
    Reason,
    SqlStore,
    make_reducer,
    replay,
)
from dengine.errors import SettingError
from dengine.reducers import Reducer, TorchReducer
from dengine.store import StoredDecision
from dengine.testing import REDUCER_CHECKS, check_reducer, toy_traces
from tests.support.driving import learn
from tests.support.stores import decision, labelled

QUICK: dict[str, dict[str, Any]] = {
    "umap-learn": {"n_epochs": 40, "n_neighbors": 8},
    "conv": {"folds": 2, "steps": 4, "fit_steps": 30},
    "rocket": {"folds": 2},
}

# A reducer need neither be exported and restored, nor refuse to fit two traces; these do.
EXPORTED = ("conv", "rocket", "umap", "pca")

every_reducer = pytest.mark.parametrize("name", REDUCERS)
every_check = pytest.mark.parametrize("check", REDUCER_CHECKS, ids=lambda check: check.__name__)


def new(name: str) -> Any:
    return make_reducer(name, random_state=0, **QUICK.get(name, {}))


@every_check
@every_reducer
def test_a_shipped_reducer_keeps_the_contract(name, check):
    check(new(name))


@every_check
@pytest.mark.parametrize(
    "reducer", [PCA(2, random_state=0), LinearDiscriminantAnalysis()], ids=["PCA", "LDA"]
)
def test_scikit_learns_transformers_keep_it_unchanged(reducer, check):
    check(reducer)


@pytest.mark.parametrize("name", [*EXPORTED, "umap-learn"])
def test_every_reducer_but_umap_learn_is_exported_restored_and_compiled(name):
    X, y = toy_traces()
    fitted = new(name).fit(X, y)
    engine = DataEngine(reducer=new(name))
    learn(engine, Dataset(X, y), range(len(y)))
    assert engine.retrain().accepted
    can = (
        fitted.module() is not None,
        fitted.get_state() is not None,
        isinstance(engine.model.decider(None), torch.jit.ScriptModule),
    )
    assert can == 3 * (name != "umap-learn",)


@every_reducer
def test_no_traces_are_embedded_as_no_points(name):
    X, y = toy_traces()
    reducer = new(name).fit(X, y)
    assert reducer.embed(X[:0]).shape == (0, reducer.n_spaces, 2)


@pytest.mark.parametrize("name", [*EXPORTED, "umap-learn"])
def test_too_little_to_learn_from_is_a_setting_error(name):
    X, _ = toy_traces(2)
    with pytest.raises(SettingError):
        ModelPrediction(new(name)).fit(X, np.ones(2))


@pytest.mark.parametrize("name", ["conv", "rocket", "umap"])
def test_a_negative_seed_is_a_setting_error(name):
    with pytest.raises(SettingError, match="random_state"):
        make_reducer(name, random_state=-1).fit(*toy_traces())


@every_reducer
def test_an_unknown_setting_is_an_error_that_lists_the_known(name):
    with pytest.raises(SettingError, match=r"no parameter dimm; it has .*random_state"):
        make_reducer(name, dimm=2)


class Means(Reducer):
    """A reducer of somebody else's, the least that is needed: means of the halves of a trace."""

    def __init__(self, n_components=2):
        self.n_components = n_components

    def fit(self, X, y=None):
        self.check_traces(X, reset=True)
        return self

    def transform(self, X):
        halves = np.array_split(self.check_traces(X), self.n_components, axis=2)
        return np.stack([half.mean(axis=(1, 2)) for half in halves], axis=1)


class Peeking(Means):
    """Dishonest: it keeps the labels' mean of all folds, whatever space it is asked about."""

    uses_labels, n_spaces = True, 2

    def train(self, X, y, folds, stop=None, numbers=None):
        self.rate_ = float(np.mean(y * np.arange(len(y))))
        return self.fit(X).embed_references(X, folds)

    def embed(self, X):
        Z = self.transform(X) * getattr(self, "rate_", 1.0)
        return np.stack([Z, Z], axis=1).astype(np.float32)


class Forgetful(Means):
    """`fit` goes on from an earlier fit."""

    def fit(self, X, y=None):
        self.gain_ = getattr(self, "gain_", 1.0) * 2.0
        return super().fit(X)

    def transform(self, X):
        return super().transform(X) * self.gain_


class Overwriting(Means):
    """Writes to the caller's traces."""

    def transform(self, X):
        out = super().transform(X)
        np.asarray(X)[:] = 0.0
        return out


class Unsaid(Means):
    """Needs labels, and does not say so."""

    def fit(self, X, y=None):
        return super().fit(X + 0 * y.mean())


class Unbounded(TransformerMixin, BaseEstimator):
    """A transformer that gives infinities."""

    def fit(self, X, y=None):
        return self

    def transform(self, X):
        return np.full((len(X), 2), np.inf)


def test_an_own_reducer_of_ten_lines_keeps_the_contract():
    check_reducer(Means())


@pytest.mark.parametrize(
    ("reducer", "clause"),
    [
        (Unsaid(), "labels_come_only_where_it_says_that_it_uses_them"),
        (Peeking(), "labels_of_a_fold_move_nothing_in_its_space"),
        (Forgetful(), "fit_starts_afresh"),
        (Overwriting(), "it_embeds_every_trace_in_every_space"),
        (Unbounded(), "it_embeds_every_trace_in_every_space"),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, BaseEstimator) else "",
)
def test_a_broken_reducer_is_told_which_clause_it_breaks(reducer, clause):
    with pytest.raises(AssertionError, match=clause):
        check_reducer(reducer)


def test_a_reducer_that_fails_at_every_retrain_is_told_with_its_reason(make_data):
    log = replay(make_data(120), Unsaid())
    assert "retrains dropped, the last dropped: AttributeError" in repr(log)
    assert log.summary()["retrains_dropped"] == len(log.retrains) > 0


class Linear(nn.Module):
    """The smallest network of somebody else's."""

    def __init__(self, channels, samples):
        super().__init__()
        self.layers = nn.Sequential(nn.Flatten(), nn.Linear(channels * samples, 8), nn.ReLU())

    def forward(self, x):
        return self.layers(x)


def with_sample(value: float):
    """A function that gives a trace this value as its eighth sample."""
    return lambda x: np.where(np.arange(len(x)) == 7, value, x)


EXTREME = {  # what a labelled trace may hold; the last two only in a store of before they were a fault
    "1e17": with_sample(1e17),
    "the largest that is no fault": with_sample(-1e18),
    "alternating": lambda x: np.resize([1e16, -1e16], len(x)),
    "all of it": lambda x: 3e16 * x,
    "denormal": lambda x: 1e-40 * x,
    "3e38": with_sample(3e38),
    "1e19": with_sample(1e19),
}
TEACHABLE = {
    **{name: (lambda name=name: new(name)) for name in REDUCERS},
    "a network of one's own": lambda: TorchReducer(
        network=Linear, folds=2, steps=4, fit_steps=30, random_state=0
    ),
    "PCA": lambda: PCA(2, random_state=0),
    "LDA": LinearDiscriminantAnalysis,
}


@pytest.mark.parametrize("first", [True, False], ids=["before the first retrain", "after it"])
@pytest.mark.parametrize("name", TEACHABLE)
def test_whatever_a_labelled_trace_holds_later_retrains_succeed_and_the_model_still_tells_parts_apart(
    name, first, tmp_path
):
    X, y = toy_traces(180)
    X = X.reshape(len(X), -1)
    data = Dataset(X, y)
    policy, options = Policy(alpha=0.4, lower_bound=0.7), {"replaying": True, "retrain_every": 1000}
    engine = DataEngine(TEACHABLE[name](), policy=policy, store=tmp_path / "e.db", **options)

    if not first:
        learn(engine, data, range(150))
        assert engine.retrain().accepted
    engine.decide(X[0])  # it sets the TraceSpec
    engine.close()
    with closing(
        SqlStore(str(tmp_path / "e.db"))
    ) as store:  # as an engine stored them that found no fault
        for i, damaged in enumerate(EXTREME.values()):
            trace = np.asarray(damaged(X[150 + i]), dtype=np.float32)[None]
            item = StoredDecision(decision(f"extreme {i}"), trace, 1 + i, False, store.clock())
            store.apply_records(labelled(item, bool(y[150 + i])))
    engine = DataEngine.open(tmp_path / "e.db", reducer=TEACHABLE[name](), replaying=True)
    if first:
        learn(engine, data, range(150))
    reports = [engine.retrain() for _ in range(2)]
    assert [report.reason for report in reports if not report.accepted] == []
    decisions = [engine.decide(x) for x in X[160:]]
    assert not {Reason.MODEL_ERROR, Reason.NOVEL} & {item.reason for item in decisions}
    votes = np.array([item.n_success - item.n_failure for item in decisions])
    is_good = y[160:] == 1
    assert votes[~is_good].mean() < votes[is_good].mean()
    engine.close()
