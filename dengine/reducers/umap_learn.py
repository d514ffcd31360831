"""UMAP by the library umap-learn: `UmapLearnReducer`, the reducer "umap-learn", to compare with
`dengine.reducers.umap`. It fits anew at every training and cannot be exported.
"""

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
from .base import Floats, Ints, Reducer, as_points, as_rows


@dataclass(eq=False, repr=False, kw_only=True)
class UmapLearnReducer(Reducer):
    """Embed traces by umap-learn.

    Every training fits anew, which takes seconds. There is no module to export and no state to
    store, so an engine that is opened fits again. With a `random_state` the library uses one
    thread, and a run repeats exactly.

    `transform` places the traces of a batch together: the point of a trace depends on the other
    traces by up to a tenth of the embedding's radius. `embed` places each trace alone, as a cell
    does.

    Parameters
    ----------
    n_components : int, default 2
        Dimension of the embedding.
    n_neighbors : int, default 15
        Size of a neighbourhood.
    min_dist : float, default 0.1
        Distance in the embedding up to which neighbours are drawn together.
    n_epochs : int, optional
        Epochs of a fit. None: as many as umap-learn chooses.
    random_state : int, RandomState or None, default 0
        Seed of the fit.

    References
    ----------
    McInnes, Healy and Melville (2018), UMAP: Uniform manifold approximation and projection for
    dimension reduction, arXiv:1802.03426.
    """

    n_components: int = 2
    n_neighbors: int = 15
    min_dist: float = 0.1
    n_epochs: int | None = None
    random_state: Any = 0

    def fit(self, X: ArrayLike, y: ArrayLike | None = None) -> Self:
        """Fit umap-learn's UMAP on traces, which takes seconds, and keep it as `umap_`.

        Parameters
        ----------
        X : array of float, shape (n, T) or (n, C, T)
            Traces.
        y : ignored
            Labels are not used.

        Returns
        -------
        self

        Raises
        ------
        SettingError
            If there are `n_neighbors` traces or fewer.
        TraceError, ValueError, TypeError
            If X is not of one of these shapes or sparse, a value is not finite, or all samples are
            below 1e-12 but not all are 0 (`check_traces`). ValueError also for a parameter that
            umap-learn refuses.
        ImportError
            If umap-learn is not installed.
        """
        traces = self.check_traces(X, reset=True)
        n = len(traces)
        if n <= self.n_neighbors:
            raise SettingError(
                f"UMAP needs more than n_neighbors = {self.n_neighbors} traces, "
                f"got n_samples = {n}."
            )
        from umap import UMAP

        with shielded():
            self.umap_ = UMAP(**self.get_params(), n_jobs=1).fit(as_rows(traces))
        return self

    def train(self, X: Floats, y: Ints, folds: Ints, *_: object, **__: object) -> Floats:
        """Fit anew on traces X (n, C, T), and return the points of the fit, float32 (n, d).

        `embed` may place the same traces elsewhere. Labels, folds, `stop` and `numbers` are not
        read. Raises what `fit` raises.
        """
        # The fit has placed its traces; `embed` would place them again, slowly.
        return as_points(self.fit(X).umap_.embedding_)

    def transform(self, X: ArrayLike) -> Floats:
        """Place traces (n, T) or (n, C, T) together: float32 (n, d); see the class.

        Raises NotFittedError before `fit`, and the errors of `check_traces`.
        """
        check_is_fitted(self, "umap_")
        return self._transform_batch(self.check_traces(X))

    def embed(self, X: Floats) -> Floats:
        """Embed traces (n, C, T) one by one, in a single space; return float32 (n, 1, d).

        Each trace is placed alone, so its point does not depend on the other traces. Raises
        NotFittedError before `fit`, and the errors of `check_traces`.
        """
        check_is_fitted(self, "umap_")
        return np.array(
            [self._transform_batch(trace[None]) for trace in self.check_traces(X)], dtype=np.float32
        ).reshape(-1, 1, self.n_components)

    def _transform_batch(self, traces: Floats) -> Floats:
        """Place traces (n, C, T) by umap-learn, together: float32 (n, d)."""
        with shielded():
            return np.asarray(self.umap_.transform(as_rows(traces)), dtype=np.float32)


@contextmanager
def shielded() -> Iterator[None]:
    """Keep umap-learn's warnings and thread count out of the process, within a `with` block.

    Warnings of umap and of scikit-learn's manifolds are ignored within the block. At its end the
    number of threads of torch is set back to what it was, also after an exception: numba sets it
    for the whole process when it runs its first kernel, and other work would then take up to forty
    times as long.
    """
    threads = torch.get_num_threads()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", module=r"(umap|sklearn\.manifold)\..*")
        try:
            yield
        finally:
            if torch.get_num_threads() != threads:
                torch.set_num_threads(threads)
