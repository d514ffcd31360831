"""UMAP, the paper's reducer: label-free, so one space serves every fold."""

from __future__ import annotations

import warnings
from typing import Any, Self

import numpy as np
from sklearn.base import BaseEstimator, TransformerMixin
from sklearn.utils.validation import check_is_fitted

from ..errors import SettingError


class UMAPReducer(TransformerMixin, BaseEstimator):  # type: ignore[misc]  # scikit-learn ships no types
    """umap-learn's UMAP under a seed: fitted on one thread, so that a run repeats exactly.

    dim : of the embedding.  n_neighbors, min_dist, n_epochs : as in umap-learn.  seed : of its random state.
    It is refitted, not warm-started; a trace transformed alone moves by up to 0.1 against the same in a batch.
    Source: McInnes, Healy and Melville (2018), arXiv:1802.03426.
    """

    single_tolerance = 0.3

    def __init__(
        self, *, dim: int = 2, n_neighbors: int = 15, min_dist: float = 0.1, n_epochs: int | None = None, seed: int = 0
    ) -> None:
        self.dim = dim
        self.n_neighbors = n_neighbors
        self.min_dist = min_dist
        self.n_epochs = n_epochs
        self.seed = seed

    def fit(self, X: Any, y: Any = None) -> Self:
        """Fit on rows X (n, features); labels are ignored. SettingError for fewer rows than n_neighbors + 1."""
        X = np.asarray(X, dtype=np.float32)
        if len(X) <= self.n_neighbors:
            raise SettingError(f"UMAP needs more than n_neighbors = {self.n_neighbors} traces, got {len(X)}.")
        from umap import UMAP

        with _Quiet():
            self.umap_ = UMAP(
                n_components=self.dim,
                n_neighbors=self.n_neighbors,
                min_dist=self.min_dist,
                n_epochs=self.n_epochs,
                random_state=self.seed,
                n_jobs=1,
            ).fit(X)
        self.embedding_ = np.asarray(self.umap_.embedding_, dtype=np.float32)
        return self

    def transform(self, X: Any) -> Any:
        """(n, features) -> (n, dim) float32."""
        check_is_fitted(self, "umap_")
        with _Quiet():
            return np.asarray(self.umap_.transform(np.asarray(X, dtype=np.float32)), dtype=np.float32)


class _Quiet(warnings.catch_warnings):
    """umap-learn warns that a seed means one thread, which is what is asked for; spectral fallbacks are its own."""

    def __enter__(self) -> None:
        super().__enter__()
        warnings.filterwarnings("ignore", module=r"umap\..*")
        warnings.filterwarnings("ignore", module=r"sklearn\.manifold\..*")
