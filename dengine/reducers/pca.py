"""PCA, the simplest reducer without labels: `PcaReducer`, the reducer "pca", which is fitted in
closed form at every training, and `PcaEncoder`, the module that it exports.
"""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import ArrayLike
from sklearn.decomposition import PCA
from sklearn.utils.validation import check_is_fitted
from torch import Tensor, nn

from ..errors import SettingError
from ..records import Arrays, State
from .base import Floats, Reducer, as_rows


@dataclass(eq=False, repr=False, kw_only=True)
class PcaReducer(Reducer):
    """Embed traces by their first principal components, with scikit-learn's randomised solver.

    Parameters
    ----------
    n_components : int, default 2
        Dimension of the embedding.
    random_state : int, RandomState or None, default 0
        Seed of the solver.

    References
    ----------
    Halko, Martinsson and Tropp (2011), Finding structure with randomness, SIAM Review 53(2).
    """

    default_radius = 0.2

    n_components: int = 2
    random_state: Any = 0

    def fit(self, X: ArrayLike, y: ArrayLike | None = None) -> Self:
        """Compute the principal axes of traces (`components_`) and their mean (`mean_`).

        A trace is one row, channel after channel; `n_components` axes are kept. The shape of the
        traces is kept, too, as `trace_shape_`.

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
            If there are `n_components` traces or fewer, or if a trace has fewer than `n_components`
            samples, all channels together.
        TraceError, ValueError, TypeError
            If X has another shape, has no trace or is sparse, if a value is not finite, or if no
            absolute value reaches 1e-12 but not all samples are 0 (`check_traces`). ValueError also
            for a parameter that scikit-learn refuses, such as `n_components=0`.
        """
        rows = as_rows(self.check_traces(X, reset=True))
        if self.n_components > min(len(rows) - 1, rows.shape[1]):
            raise SettingError(
                f"PCA needs more than {self.n_components} traces, and as many samples, got "
                f"n_samples = {len(rows)}, n_features = {rows.shape[1]}."
            )
        pca = PCA(self.n_components, svd_solver="randomized", random_state=self.random_state)
        pca.fit(rows)
        self.mean_ = pca.mean_.astype(np.float32)
        self.components_ = pca.components_.astype(np.float32)
        return self

    def embed(self, X: Floats) -> Floats:
        """Project traces (n, T) or (n, C, T) on the principal axes: float32 (n, 1, n_components).

        The mean of the fit is subtracted first. Raises the errors of `check_traces`.
        """
        centred = as_rows(self.check_traces(X)) - self.mean_
        return np.asarray(centred @ self.components_.T)[:, None, :]

    def module(self) -> nn.Module:
        """Return a new `PcaEncoder` with the fitted mean and axes; NotFittedError before `fit`."""
        check_is_fitted(self, "components_")
        return PcaEncoder(torch.from_numpy(self.mean_), torch.from_numpy(self.components_))

    def get_state(self) -> State:
        """Return arrays from which `set_state` restores the reducer bit for bit.

        They are "mean" (C * T,), "components" (n_components, C * T) and "shape", (C, T), where a
        trace has C channels of T samples. The first two are the reducer's own arrays, not copies.
        Raises NotFittedError before `fit`.
        """
        check_is_fitted(self, "components_")
        return {
            "mean": self.mean_,
            "components": self.components_,
            "shape": np.array(self.trace_shape_),
        }

    def set_state(self, state: Arrays) -> Self:
        """Restore what `get_state` returned, and return self.

        The constructor's parameters must be the same, which is not checked. The arrays are copied;
        the shape of the traces is set from "shape". Raises KeyError if an array is missing.
        """
        self.mean_ = np.array(state["mean"])
        self.components_ = np.array(state["components"])
        self.restore_shape(state)
        return self


class PcaEncoder(nn.Module):
    """Project raw traces on principal axes: (B, C, T) -> (B, 1, n_components).

    mean (C * T,) is subtracted first; components (n_components, C * T) are the axes. Both are
    float32 tensors, of traces whose channels stand one after another.
    """

    mean: Tensor
    components: Tensor

    def __init__(self, mean: Tensor, components: Tensor) -> None:
        super().__init__()
        self.register_buffer("mean", mean)
        self.register_buffer("components", components.T.contiguous())

    def forward(self, x: Tensor) -> Tensor:
        """Raw traces (B, C, T), less the mean, on the axes -> (B, 1, n_components)."""
        return ((x.flatten(1) - self.mean) @ self.components).unsqueeze(1)
