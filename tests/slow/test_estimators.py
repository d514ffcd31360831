"""Every public estimator keeps scikit-learn's habits: its own checks, and what they do not ask of
traces.
"""

import numpy as np
import pytest
from sklearn.base import clone
from sklearn.decomposition import PCA
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.model_selection import cross_val_score
from sklearn.neighbors import NeighborhoodComponentsAnalysis
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.utils.estimator_checks import parametrize_with_checks

from dengine import (
    ConvReducer,
    CrossFitted,
    PcaReducer,
    RocketReducer,
    UmapLearnReducer,
    UmapReducer,
    WilsonRadiusClassifier,
)
from dengine.errors import SettingError
from dengine.reducers.base import LabelFree
from dengine.testing import toy_traces

ESTIMATORS = (
    WilsonRadiusClassifier(),
    ConvReducer(fit_steps=2),
    RocketReducer(),
    PcaReducer(),
    UmapReducer(
        n_neighbors=5, n_epochs=20
    ),  # some checks have 20 rows, or 12: UMAP wants more than n_neighbors
    UmapLearnReducer(n_neighbors=5, n_epochs=20),
    CrossFitted(LinearDiscriminantAnalysis(), 2),
    CrossFitted(NeighborhoodComponentsAnalysis(n_components=2, max_iter=20, random_state=0), 2),
)

# Each row alone would mend this and break `fit_transform(X) == fit(X).transform(X)`; an engine asks
# for one at a time.
BATCH = (
    "umap-learn lays the rows of a batch out together, so a row's place depends on those beside it."
)
# By estimator, by check: why it is right that it fails.
EXCLUDED = {
    UmapLearnReducer: {
        "check_methods_sample_order_invariance": BATCH,
        "check_methods_subset_invariance": BATCH,
    },
    CrossFitted: {
        "check_fit2d_1feature": "Of ten rows, those outside one of the two folds are of one class, and that is said first."
    },
}


SMALL = {
    "conv": ConvReducer(fit_steps=30),
    "rocket": RocketReducer(),
    "pca": PcaReducer(),
    "umap": UmapReducer(n_neighbors=5, n_epochs=20),
    "umap-learn": UmapLearnReducer(n_neighbors=5, n_epochs=20),
    "cross-fitted": CrossFitted(LinearDiscriminantAnalysis(), 2),
    "label-free": LabelFree(PCA(2, random_state=0)),
}
label_using = pytest.mark.parametrize("name", ["conv", "rocket", "cross-fitted"])


# An exclusion must fail: `xfail_strict`.
@parametrize_with_checks(
    list(ESTIMATORS), expected_failed_checks=lambda item: EXCLUDED.get(type(item), {})
)
def test_scikit_learns_estimator_checks_pass(estimator, check):
    check(estimator)


def traces(n: int = 80) -> tuple[np.ndarray, np.ndarray]:
    X, y = toy_traces(n, 30, failures=0.35)
    return X, y.astype(int)


@pytest.mark.parametrize("name", ["conv", "umap", "umap-learn"])
def test_random_state_is_an_integer_or_a_random_state(name):
    X, y = traces()
    reducer = clone(SMALL[name])
    for states in ((np.int64(3), 3), map(np.random.RandomState, (7, 7))):
        fits = [reducer.set_params(random_state=state).fit_transform(X, y) for state in states]
        np.testing.assert_array_equal(*fits)
    with pytest.raises(ValueError, match="RandomState"):
        reducer.set_params(random_state=np.random.default_rng(0)).fit(X, y)


@label_using
def test_of_two_classes_the_larger_is_the_success(name):
    X, y = traces()
    expected = clone(SMALL[name]).fit(X, y).transform(X)
    for names in (("bad", "good"), (False, True), (1, 2)):
        result = clone(SMALL[name]).fit(X, np.array(names)[y]).transform(X)
        np.testing.assert_array_equal(result, expected)


@label_using
@pytest.mark.parametrize(
    ("labels", "message"),
    [
        (
            np.arange(80) % 3,
            "Only binary classification is supported. The type of the target is mu",
        ),
        (np.linspace(0.0, 1.0, 80), "Unknown label type: continuous"),
        (np.where(np.arange(80) == 3, np.nan, 1.0), "Input y contains NaN"),
        (None, "requires y to be passed, but the target y is None"),
    ],
)
def test_labels_that_are_not_of_two_classes_are_refused_in_scikit_learns_words(
    name, labels, message
):
    with pytest.raises(SettingError, match=message):
        clone(SMALL[name]).fit(traces()[0], labels)


@pytest.mark.parametrize("name", SMALL)
def test_a_pipeline_of_a_reducer_and_our_classifier_beats_the_base_rate(name):
    X, y = traces()
    in_one_unit = StandardScaler(), WilsonRadiusClassifier(radius=0.5)
    pipeline = make_pipeline(clone(SMALL[name]), *in_one_unit)
    assert cross_val_score(pipeline, X, y, cv=3, error_score="raise").mean() > y.mean() + 0.1


@pytest.mark.parametrize("name", [n for n in SMALL if n not in ("umap-learn", "label-free")])
def test_a_transform_places_a_trace_bit_for_bit_whatever_is_beside_it(name):
    X, y = traces(200)
    reducer = clone(SMALL[name]).fit(X, y)
    Z, order = reducer.transform(X), np.random.default_rng(0).permutation(len(X))
    np.testing.assert_array_equal(reducer.transform(X[order]), Z[order])
    np.testing.assert_array_equal(np.concatenate([reducer.transform(x[None]) for x in X]), Z)
