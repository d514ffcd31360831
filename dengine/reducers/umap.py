"""UMAP, the paper's reducer: label-free, so one space serves every fold."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import ArrayLike
from sklearn.utils.validation import check_is_fitted

from ..errors import SettingError
from .base import Floats, Ints, Reducer, StopRule, as_points, as_rows


@dataclass(eq=False, repr=False, kw_only=True)
class UmapReducer(Reducer):
    """umap-learn's UMAP, fitted on one thread where a random_state is given, so that a run repeats exactly.

    n_components : of the embedding.  n_neighbors, min_dist, n_epochs, random_state : as in umap-learn.
    It is refitted, not warm-started; a trace transformed alone moves by up to 0.1 against the same in a batch.
    Source: McInnes, Healy and Melville (2018), arXiv:1802.03426.
    """

    single_tolerance = 0.3

    n_components: int = 2
    n_neighbors: int = 15
    min_dist: float = 0.1
    n_epochs: int | None = None
    random_state: Any = 0

    def fit(self, X: ArrayLike, y: ArrayLike | None = None) -> Self:
        """Fit on traces (n, T) or (n, C, T); labels are ignored. SettingError for fewer than n_neighbors + 1 traces."""
        traces = self.check_traces(X, reset=True)
        if (n := len(traces)) <= self.n_neighbors:
            raise SettingError(f"UMAP needs more than n_neighbors = {self.n_neighbors} traces, got n_samples = {n}.")
        from umap import UMAP

        with _contained():
            self.umap_ = UMAP(**self.get_params(), n_jobs=1).fit(as_rows(traces))
        return self

    def train(self, X: Floats, y: Ints, folds: Ints, stop: StopRule | None = None, numbers: Ints | None = None) -> Floats:
        """Fit; the fit has placed its traces, a transform would place them anew, slowly."""
        return as_points(self.fit(X).umap_.embedding_)

    def transform(self, X: ArrayLike) -> Floats:
        check_is_fitted(self, "umap_")
        traces = self.check_traces(X)
        with _contained():
            return np.asarray(self.umap_.transform(as_rows(traces)), dtype=np.float32)


@contextmanager
def _contained() -> Iterator[None]:
    """Keep umap-learn's warnings and its number of threads out of the process.

    Its first kernel makes numba set OpenMP's threads for the whole process, torch's too: forty times as slow for others.
    """
    threads = torch.get_num_threads()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", module=r"(umap|sklearn\.manifold)\..*")
        try:
            yield
        finally:
            if torch.get_num_threads() != threads:
                torch.set_num_threads(threads)
