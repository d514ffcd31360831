"""`Directions`: a reducer that is trained in no time, cross-fits by itself and goes on from its last
training, so that honest counting can be computed again by hand.

Space k has two coordinates: the trace without its mean along the mean difference of good and bad
traces outside of fold k, to which `MEMORY` times that of the last training is added; and the mean of
its samples.
"""

from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn

from dengine import Reducer
from dengine.folds import content_fold

MEMORY = 0.5
Floats = NDArray[np.float32]
Ints = NDArray[np.int64]


class Encoder(nn.Module):
    """Directions (K, T) as a module, (B, 1, T) -> (B, K, 2)."""

    weights: Tensor

    def __init__(self, weights: Tensor) -> None:
        super().__init__()
        self.register_buffer("weights", weights)
        self.dim = 2

    def forward(self, x: Tensor) -> Tensor:
        samples = x[:, 0].double()
        mean = samples.mean(1, keepdim=True)
        along = (samples - mean) @ self.weights.t()
        return torch.stack([along, mean.expand(-1, along.size(1))], 2).float()


class Directions(Reducer):
    """Mean differences of classes, one for each fold's complement.

    Parameters
    ----------
    folds : int, default 5
    """

    uses_labels = True
    min_traces = 8
    default_radius = 0.4
    default_retrain_every = 12

    def __init__(self, folds: int = 5) -> None:
        self.folds = folds

    @property
    def n_spaces(self) -> int:
        return self.folds

    def fit(self, X: ArrayLike, y: ArrayLike | None = None) -> "Directions":
        self.__dict__.pop("weights_", None)
        traces = self.check_traces(X, reset=True)
        self.train(traces, np.asarray(y), content_fold(traces, self.folds))
        return self

    def train(self, X: Floats, y: Ints, folds: Ints, *_: Any, **__: Any) -> Floats:
        X = self.check_traces(X, reset=True)
        flat = X[:, 0].astype(np.float64)
        earlier = getattr(self, "weights_", np.zeros((self.folds, flat.shape[1])))
        self.weights_ = np.stack(
            [
                mean_difference(flat[folds != k], y[folds != k]) + MEMORY * earlier[k]
                for k in range(self.folds)
            ]
        )
        return self.embed_references(X, folds)

    def embed(self, X: Floats) -> Floats:
        encoder = Encoder(torch.from_numpy(self.weights_))
        points: Floats = encoder(torch.from_numpy(self.check_traces(X))).numpy()
        return points

    def module(self) -> nn.Module:
        return Encoder(torch.from_numpy(self.weights_))

    def get_state(self) -> dict[str, NDArray[Any]]:
        return {"weights": self.weights_, "shape": np.array(self.trace_shape_)}

    def set_state(self, state: Any) -> "Directions":
        self.restore_shape(state)
        self.weights_ = np.asarray(state["weights"])
        return self


def mean_difference(X: NDArray[np.float64], y: Ints) -> NDArray[np.float64]:
    """Return the mean of the good traces minus that of the bad ones; 0 without either."""
    if not 0 < y.sum() < len(y):
        return np.zeros(X.shape[1])
    return np.asarray(X[y == 1].mean(0) - X[y == 0].mean(0))
