"""PCA: the plainest label-free reducer, closed-form, exportable."""

from collections.abc import Mapping
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, TransformerMixin
from sklearn.decomposition import PCA
from sklearn.utils.validation import check_is_fitted
from torch import Tensor, nn

from ..errors import SettingError


class PCAReducer(TransformerMixin, BaseEstimator):  # type: ignore[misc]  # scikit-learn ships no types
    """The first `dim` principal components of the samples, by scikit-learn's randomised solver under a seed.

    Source: Halko, Martinsson and Tropp (2011), SIAM Review 53(2).
    """

    single_tolerance = 1e-4

    def __init__(self, *, dim: int = 2, seed: int = 0) -> None:
        self.dim = dim
        self.seed = seed

    def fit(self, X: Any, y: Any = None) -> Self:
        """Fit on rows X (n, features); labels are ignored. SettingError for no more rows than dimensions."""
        X = np.asarray(X, dtype=np.float32)
        if len(X) <= self.dim:
            raise SettingError(f"PCA to {self.dim} dimensions needs more than {self.dim} traces, got {len(X)}.")
        pca = PCA(n_components=self.dim, svd_solver="randomized", random_state=self.seed).fit(X)
        self.mean_ = pca.mean_.astype(np.float32)
        self.components_ = pca.components_.astype(np.float32)
        return self

    def transform(self, X: Any) -> Any:
        """(n, features) -> (n, dim) float32."""
        check_is_fitted(self, "components_")
        return (np.asarray(X, dtype=np.float32) - self.mean_) @ self.components_.T

    def module(self) -> nn.Module:
        """(B, C, T) -> (B, 1, dim)."""
        return _Projection(torch.from_numpy(self.mean_), torch.from_numpy(self.components_))

    def get_state(self) -> dict[str, NDArray[Any]]:
        """Mean and components."""
        return {"mean": self.mean_, "components": self.components_}

    def set_state(self, state: Mapping[str, NDArray[Any]]) -> Self:
        """Restore mean and components."""
        self.mean_, self.components_ = np.array(state["mean"]), np.array(state["components"])
        return self


class _Projection(nn.Module):
    mean: Tensor
    components: Tensor

    def __init__(self, mean: Tensor, components: Tensor) -> None:
        super().__init__()
        self.register_buffer("mean", mean)
        self.register_buffer("components", components.T.contiguous())

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, T) -> (B, 1, dim)."""
        return ((x.flatten(1) - self.mean) @ self.components).unsqueeze(1)
