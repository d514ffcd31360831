"""Every public estimator keeps scikit-learn's habits: its own checks, and what they do not ask of traces."""

import pickle
import warnings
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from sklearn.base import clone
from sklearn.decomposition import PCA
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.exceptions import NotFittedError
from sklearn.linear_model import LogisticRegression
from sklearn.model_selection import GridSearchCV, cross_val_score
from sklearn.neighbors import NeighborhoodComponentsAnalysis
from sklearn.pipeline import make_pipeline
from sklearn.utils.estimator_checks import estimator_checks_generator, parametrize_with_checks

from dengine import ConvReducer, CrossFitted, PcaReducer, RocketReducer, UmapReducer, WilsonRadiusClassifier
from dengine.errors import SettingError
from dengine.reducers.base import Reducer
from dengine.reducers.cross_fitting import LabelFree
from dengine.reducers.umap import _Contained

ESTIMATORS = (
    WilsonRadiusClassifier(),
    WilsonRadiusClassifier(fraction=0.1, reject_fraction=0.05),
    WilsonRadiusClassifier(interval="jeffreys"),
    ConvReducer(),
    RocketReducer(),
    PcaReducer(),
    UmapReducer(n_neighbors=5, n_epochs=20),  # some checks have 20 rows, or 12: UMAP wants more than n_neighbors
    CrossFitted(LinearDiscriminantAnalysis(), 2),
    CrossFitted(NeighborhoodComponentsAnalysis(n_components=2, max_iter=20, random_state=0), 2),
)

BATCH = (
    "UMAP lays the rows of a batch out together, with random repulsion drawn row after row from one stream, so a row's "
    "place depends on those beside it. Laying out each row alone would mend this and break "
    "`fit_transform(X) == fit(X).transform(X)`: the fit's own rows would move by up to a quarter of the map. An engine "
    "asks for one trace at a time, and references keep the place that the fit gave them."
)
# By estimator, by check: why it is right that it fails.
EXCLUDED: dict[type, dict[str, str]] = {
    UmapReducer: {
        "check_methods_sample_order_invariance": BATCH,
        "check_methods_subset_invariance": BATCH,
    },
    CrossFitted: {
        "check_fit2d_1feature": (
            "Ten rows of one feature: outside one of the two folds, which are dealt by content, there are three rows, all "
            "of one class. That is refused, and named as what is wrong; the check wants to read of the number of features, "
            "which is not."
        ),
    },
}


def excluded(estimator: Any) -> dict[str, str]:
    """Check -> reason of its exclusion."""
    return EXCLUDED.get(type(estimator), {})


SMALL: dict[str, Reducer] = {
    "conv": ConvReducer(),
    "rocket": RocketReducer(),
    "pca": PcaReducer(),
    "umap": UmapReducer(n_neighbors=5, n_epochs=20),
    "cross-fitted": CrossFitted(LinearDiscriminantAnalysis(), 2),
    "label-free": LabelFree(PCA(2, random_state=0)),
}
SEEDED = [name for name, reducer in SMALL.items() if "random_state" in reducer.get_params(deep=False)]
LABELLED = [name for name, reducer in SMALL.items() if reducer.uses_labels]
every_reducer = pytest.mark.parametrize("name", SMALL)
seeded = pytest.mark.parametrize("name", SEEDED)
label_using = pytest.mark.parametrize("name", LABELLED)


@parametrize_with_checks(list(ESTIMATORS), expected_failed_checks=excluded)  # xfail_strict: an exclusion must fail
def test_scikit_learns_estimator_checks_pass(estimator: Any, check: Any) -> None:
    check(estimator)


def traces(n: int = 80, channels: int = 1, samples: int = 30, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """(n, C, T) float32 ramps with noise, of two heights; y (n,): the higher ones are the successes."""
    rng = np.random.default_rng(seed)
    y = (np.arange(n) % 3 > 0).astype(np.int64)
    ramp = np.linspace(0.0, 1.0, samples) * (5.0 + 3.0 * y)[:, None, None]
    return (ramp + rng.normal(0.0, 1.0, (n, channels, samples))).astype(np.float32), y


def frame(X: np.ndarray) -> pd.DataFrame:
    rows = X[:, 0]
    return pd.DataFrame(rows, columns=[f"t{i}" for i in range(rows.shape[1])], index=[f"part{i}" for i in range(len(rows))])


# ------------------------------------------------------------------------------------------------- the list itself


def test_every_exclusion_names_a_check_that_is_run() -> None:
    for estimator in ESTIMATORS:
        names = {getattr(check, "func", check).__name__ for _, check in estimator_checks_generator(estimator)}
        assert set(excluded(estimator)) <= names


# ------------------------------------------------------------------------------------------------------------ fit


@every_reducer
def test_a_fit_on_a_and_then_on_b_is_a_fit_on_b_alone(name: str) -> None:
    A, B = traces(60, seed=1), traces(70, channels=2, samples=40, seed=2)
    twice, once = clone(SMALL[name]).fit(*A).fit(*B), clone(SMALL[name]).fit(*B)
    np.testing.assert_array_equal(twice.transform(B[0]), once.transform(B[0]))
    np.testing.assert_array_equal(twice.embed(B[0]), once.embed(B[0]))
    assert twice.n_features_in_ == once.n_features_in_ == 80


@every_reducer
def test_names_of_an_earlier_table_are_forgotten_by_a_fit_on_traces(name: str) -> None:
    X, y = traces()
    assert "feature_names_in_" not in vars(clone(SMALL[name]).fit(frame(X), y).fit(X, y))


@every_reducer
def test_one_channel_may_be_left_out_of_the_shape(name: str) -> None:
    X, y = traces()
    flat, full = clone(SMALL[name]).fit(X[:, 0], y), clone(SMALL[name]).fit(X, y)
    np.testing.assert_array_equal(flat.transform(X), full.transform(X[:, 0]))
    assert flat.trace_shape_ == full.trace_shape_ == (1, 30)


@every_reducer
def test_three_channels_are_embedded_and_all_of_them_are_read(name: str) -> None:
    X, y = traces(channels=3)
    reducer = clone(SMALL[name]).fit(X, y)
    Z = reducer.transform(X)
    assert Z.shape == (80, len(reducer.get_feature_names_out()))
    for channel in range(3):
        other = X.copy()
        other[:, channel] = X[::-1, channel]
        assert not np.array_equal(reducer.transform(other), Z)


@every_reducer
def test_a_fitted_reducer_survives_pickling_and_a_clone_of_it_is_unfitted(name: str) -> None:
    X, y = traces()
    reducer = clone(SMALL[name]).fit(X, y)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(reducer)).transform(X), reducer.transform(X))
    with pytest.raises(NotFittedError):
        clone(reducer).transform(X)
    with pytest.raises(NotFittedError):
        clone(reducer).get_feature_names_out()


@seeded
def test_random_state_is_none_an_integer_or_a_random_state(name: str) -> None:
    X, y = traces()
    fits = [
        clone(SMALL[name]).set_params(random_state=state).fit(X, y).transform(X)
        for state in (3, np.int64(3), np.random.RandomState(7), np.random.RandomState(7), None)
    ]
    np.testing.assert_array_equal(fits[0], fits[1])
    np.testing.assert_array_equal(fits[2], fits[3])
    assert np.isfinite(fits[4]).all()
    with pytest.raises(ValueError, match="RandomState"):
        clone(SMALL[name]).set_params(random_state=np.random.default_rng(0)).fit(X, y)


# --------------------------------------------------------------------------------------------------------- tables


@every_reducer
def test_a_table_goes_in_and_a_table_comes_out_with_names(name: str) -> None:
    X, y = traces()
    table, reducer = frame(X), clone(SMALL[name]).set_output(transform="pandas")
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)  # names are neither lost on the way nor missing
        Z = reducer.fit(table, pd.Series(y, index=table.index)).transform(table)
    assert list(reducer.feature_names_in_) == list(table.columns)
    assert list(Z.columns) == list(reducer.get_feature_names_out())
    assert list(Z.index) == list(table.index)
    np.testing.assert_array_equal(Z.to_numpy(), clone(SMALL[name]).fit(X, y).transform(X))
    assert type(reducer.embed(X)) is np.ndarray


@every_reducer
def test_output_names_are_the_class_and_a_number(name: str) -> None:
    X, y = traces()
    reducer = clone(SMALL[name]).fit(X, y)
    prefix = type(reducer).__name__.lower()
    assert list(reducer.get_feature_names_out()) == [f"{prefix}{i}" for i in range(reducer.transform(X).shape[1])]


@every_reducer
def test_columns_of_other_names_or_another_number_are_named(name: str) -> None:
    X, y = traces()
    reducer = clone(SMALL[name]).fit(frame(X), y)
    with pytest.raises(ValueError, match="unseen at fit time"):
        reducer.transform(frame(X).rename(columns={"t0": "other"}))
    said = f"X has 29 features, but {type(reducer).__name__} is expecting 30 features"
    with pytest.raises(ValueError, match=said):
        clone(reducer).fit(X, y).transform(X[:, 0, :29])


@every_reducer
def test_a_nan_or_an_infinity_is_refused_in_fit_and_in_transform(name: str) -> None:
    X, y = traces()
    reducer = clone(SMALL[name]).fit(X, y)
    for value, word in ((np.nan, "NaN"), (np.inf, "infinity"), (-np.inf, "infinity")):
        bad = X.copy()
        bad[3, 0, 4] = value
        for form in (bad, bad[:, 0], frame(bad)):
            with pytest.raises(ValueError, match=word):
                clone(reducer).fit(form, y)
            with pytest.raises(ValueError, match=word):
                reducer.transform(form)


@every_reducer
def test_traces_of_other_dimensions_are_refused(name: str) -> None:
    X, y = traces()
    for bad in (X[0, 0], X[..., None], X[:, :, :0]):
        with pytest.raises(ValueError, match=r"Expected|minimum of 1"):
            clone(SMALL[name]).fit(bad, y[: len(bad)])


# --------------------------------------------------------------------------------------------------------- labels


@label_using
@pytest.mark.parametrize("names", [("bad", "good"), (False, True), (-1, 1), (1, 2), (0.0, 1.0)])
def test_of_two_classes_the_larger_is_the_success(name: str, names: tuple[Any, Any]) -> None:
    X, y = traces()
    renamed = np.array(names)[y]
    np.testing.assert_array_equal(
        clone(SMALL[name]).fit(X, renamed).transform(X), clone(SMALL[name]).fit(X, y).transform(X)
    )


@label_using
@pytest.mark.parametrize(
    ("labels", "message"),
    [
        (np.arange(80) % 3, "Only binary classification is supported. The type of the target is multiclass"),
        (np.linspace(0.0, 1.0, 80), "Unknown label type: continuous"),
        (np.arange(79) % 2, "inconsistent numbers of samples: 79"),
        (np.where(np.arange(80) == 3, np.nan, 1.0), "Input y contains NaN"),
        (np.ones(80, dtype=int), "Expected both classes outside fold 0"),
        (None, "requires y to be passed, but the target y is None"),
    ],
)
def test_labels_that_are_not_of_two_classes_are_refused_in_scikit_learns_words(name: str, labels, message: str) -> None:
    with pytest.raises(SettingError, match=message):
        clone(SMALL[name]).fit(traces()[0], labels)


# ----------------------------------------------------------------------------------------------- together with others


@every_reducer
def test_a_pipeline_of_a_reducer_and_our_classifier_beats_the_base_rate(name: str) -> None:
    X, y = traces()
    pipeline = make_pipeline(clone(SMALL[name]), WilsonRadiusClassifier(fraction=0.2))
    assert cross_val_score(pipeline, X, y, cv=3, error_score="raise").mean() > y.mean() + 0.1


@pytest.mark.parametrize(
    ("reducer", "grid"),
    [
        (ConvReducer(), {"n_components": [1, 2], "l2": [0.1, 10.0]}),
        (RocketReducer(dilations=1), {"n_components": [1, 2], "l2": [0.1, 10.0]}),
        (PcaReducer(), {"n_components": [1, 3]}),
        (UmapReducer(n_neighbors=5, n_epochs=20), {"n_components": [1, 2]}),
        (CrossFitted(LinearDiscriminantAnalysis()), {"folds": [2, 3], "reducer__tol": [1e-4, 1e-2]}),
    ],
    ids=lambda value: type(value).__name__,
)
def test_a_grid_search_tries_the_settings_of_a_reducer(reducer: Reducer, grid: dict[str, list[Any]]) -> None:
    X, y = traces()
    pipeline = make_pipeline(reducer, LogisticRegression())
    step = pipeline.steps[0][0]
    found = GridSearchCV(pipeline, {f"{step}__{k}": v for k, v in grid.items()}, cv=3, error_score="raise").fit(X[:, 0], y)
    assert len(found.cv_results_["params"]) == np.prod([len(values) for values in grid.values()])
    assert found.best_score_ > y.mean()


# ------------------------------------------------------------------------------------------- what a transform promises


@pytest.mark.parametrize("name", [n for n in SMALL if n not in ("umap", "label-free")])
def test_a_transform_places_a_trace_bit_for_bit_whatever_is_beside_it(name: str) -> None:
    X, y = traces(200)
    reducer = clone(SMALL[name]).fit(X, y)
    Z, order = reducer.transform(X), np.random.default_rng(0).permutation(len(X))
    np.testing.assert_array_equal(reducer.transform(X[order]), Z[order])
    np.testing.assert_array_equal(np.concatenate([reducer.transform(x[None]) for x in X]), Z)


@every_reducer
def test_a_transform_is_the_mean_over_the_spaces_of_the_embedding(name: str) -> None:
    X, y = traces()
    reducer = clone(SMALL[name]).fit(X, y)
    Z = reducer.embed(X)
    assert Z.shape[:2] == (80, reducer.n_spaces)
    np.testing.assert_allclose(reducer.transform(X), Z.mean(axis=1), rtol=1e-5, atol=1e-5)


def test_threads_that_numba_set_in_a_umap_are_put_back_for_others() -> None:
    before = torch.get_num_threads()
    with _Contained():
        torch.set_num_threads(before + 1)  # as numba's first kernel does to OpenMP's
    assert torch.get_num_threads() == before
