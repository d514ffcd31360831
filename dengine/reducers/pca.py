"""PCA: the plainest label-free reducer, closed-form, exportable."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from sklearn.decomposition import PCA
from sklearn.utils.validation import check_is_fitted
from torch import Tensor, nn

from ..errors import SettingError
from .base import Floats, Reducer, as_rows


@dataclass(eq=False, repr=False, kw_only=True)
class PcaReducer(Reducer):
    """The first `n_components` principal components of the samples, by scikit-learn's randomised solver.

    Source: Halko, Martinsson and Tropp (2011), SIAM Review 53(2).
    """

    default_radius = 0.2

    n_components: int = 2
    random_state: Any = 0

    def fit(self, X: ArrayLike, y: ArrayLike | None = None) -> Self:
        """Fit on traces (n, T) or (n, C, T); labels are ignored. SettingError for no more traces than dimensions."""
        rows = as_rows(self.check_traces(X, reset=True))
        if len(rows) <= self.n_components:
            raise SettingError(f"PCA needs more than {self.n_components} traces, got n_samples = {len(rows)}.")
        if rows.shape[1] < self.n_components:
            raise SettingError(f"PCA needs {self.n_components} samples or more, got n_features = {rows.shape[1]}.")
        pca = PCA(n_components=self.n_components, svd_solver="randomized", random_state=self.random_state).fit(rows)
        self.mean_ = pca.mean_.astype(np.float32)
        self.components_ = pca.components_.astype(np.float32)
        return self

    def embed(self, X: Floats) -> Floats:
        return np.asarray((as_rows(self.check_traces(X)) - self.mean_) @ self.components_.T)[:, None, :]

    def module(self) -> nn.Module:
        check_is_fitted(self, "components_")
        return _Projection(torch.from_numpy(self.mean_), torch.from_numpy(self.components_))

    def get_state(self) -> dict[str, NDArray[Any]]:
        check_is_fitted(self, "components_")
        return {"mean": self.mean_, "components": self.components_, "shape": np.array(self.trace_shape_)}

    def set_state(self, state: Mapping[str, NDArray[Any]]) -> Self:
        self.mean_, self.components_ = np.array(state["mean"]), np.array(state["components"])
        self.n_features_in_ = len(self.mean_)
        self.trace_shape_ = tuple(int(n) for n in state["shape"])
        return self


class _Projection(nn.Module):
    mean: Tensor
    components: Tensor

    def __init__(self, mean: Tensor, components: Tensor) -> None:
        super().__init__()
        self.register_buffer("mean", mean)
        self.register_buffer("components", components.T.contiguous())

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, T) -> (B, 1, n_components)."""
        return ((x.flatten(1) - self.mean) @ self.components).unsqueeze(1)
