"""A label-free plane for people to look at: the encoder's features, laid out by parametric UMAP's loss.

    x (B, C, T) -> encoder, untrained (encoder.py)              (B, 2*W)
                -> linear                                       (B, 1, d)

UMAP lays out the traces that it is given; here a map is trained to do so, and a new trace has its place at once, the map
exports, and a retrain goes on from the last one instead of turning the picture around. Traces that are neighbours in the
features are joined by a fuzzy graph; joined ones are drawn together, others, drawn at random, pushed apart. It begins as
the plane of the first principal components. No label is read, so one space serves every fold.

Sources: Sainburg, McInnes and Gentner (2021), Parametric UMAP embeddings, Neural Computation 33(11), for training a map by
UMAP's loss, here a linear one: a hidden layer kept neighbours no better; and those of fuzzy_graph.py.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from sklearn.utils.validation import check_is_fitted
from torch import Tensor, nn

from ..errors import SettingError
from .base import FitReport, Floats, Ints, Reducer, StopRule, as_points, seed_of
from .encoder import ConvEncoder, averaging
from .features import Carry, KeptFeatures
from .fuzzy_graph import cross_entropy, fuzzy_graph
from .scored import in_chunks

SIZES = (28, 5, 3, 64)  # kernels, dilations, regions and width of the encoder, as in `ConvReducer`
GRAPH_TRACES = 2000  # that lay the plane out in one fit, so that it ends in time however many references there are
EDGES = 1024  # drawn for a step
REPELLED = 5  # pairs drawn at random for each edge
RATE = 1e-2  # of Adam
EXTENT = 4.0  # root mean square radius of the plane before it is trained: UMAP's pictures are about so wide


class PlaneReducer(Reducer):
    """Trace -> point of a plane that keeps neighbours together.

    n_components : d; 2 is a picture.  n_neighbors : of each trace in the graph, fewer where there are no more.
    n_steps : of Adam in one training, at most.
    random_state : of all that is drawn; None draws anew at each fit.
    `train` goes on from the present map; `n_iter_` counts the steps of the last one.
    """

    net_: PlaneEmbedding
    _kept: KeptFeatures

    def __init__(self, *, n_components: int = 2, n_neighbors: int = 15, n_steps: int = 50, random_state: Any = 0) -> None:
        self.n_components = n_components
        self.n_neighbors = n_neighbors
        self.n_steps = n_steps
        self.random_state = random_state

    def fit(self, X: ArrayLike, y: ArrayLike | None = None) -> Self:
        """Fit afresh on traces (n, T) or (n, C, T); labels are ignored. SettingError for too few traces."""
        self._start(self.check_traces(X, reset=True))
        self._lay_out(self.check_traces(X), None)
        return self

    def train(self, X: Floats, y: Ints, folds: Ints, stop: StopRule | None = None) -> Floats:
        """Go on from the present map; the encoder's kernels stay those of the first training. See `Reducer.train`."""
        if "net_" not in vars(self):
            self._start(self.check_traces(X, reset=True))
        return self._lay_out(self.check_traces(X), stop)

    def _start(self, traces: Floats) -> None:
        """Learn the encoder's kernels, and forget an earlier plane."""
        self.check()
        if len(traces) <= self.n_components + 1:
            raise SettingError(
                f"A plane of {self.n_components} dimensions needs more than {self.n_components + 1} traces, "
                f"got n_samples = {len(traces)}; collect more first."
            )
        rng = np.random.default_rng(seed_of(self.random_state))
        self._build(untrained_encoder(torch.from_numpy(traces), rng))
        self.n_fits_ = 0

    def _lay_out(self, traces: Floats, stop: StopRule | None) -> Floats:
        """Train the map from where it is; returns the traces' places (n, d)."""
        draw = torch.Generator()
        draw.manual_seed(int(np.random.default_rng([seed_of(self.random_state) or 0, self.n_fits_]).integers(2**62)))
        with torch.no_grad():
            g, carry = self.net_.encoder.standardise(self._pooled(traces))
            if self.n_fits_:
                self.net_.carry_over(carry)
            else:
                self.net_.begin(g)
        some = g[torch.randperm(len(g), generator=draw)[:GRAPH_TRACES]]
        self.n_iter_ = self.net_.lay_out(some, self.n_neighbors, self.n_steps, stop or StopRule(), draw)
        self.n_fits_ += 1
        return as_points(self.net_.place(g))

    def _pooled(self, traces: Floats) -> Tensor:
        """(n, C, T) -> (n, P), computed once a trace: no kernel ever changes."""
        return self._kept.of(traces, lambda new: in_chunks(self.net_.encoder.raw, new))

    def transform(self, X: ArrayLike) -> Floats:
        """(n, T) or (n, C, T) -> (n, d); each trace alone, so that none moves by what is beside it."""
        traces = torch.from_numpy(self.check_traces(X))
        with torch.inference_mode():
            alone = [self.net_(traces[i : i + 1])[:, 0] for i in range(max(1, len(traces)))]
            return as_points(torch.cat(alone))

    def embed(self, X: Floats) -> Floats:
        """(n, C, T) -> (n, 1, d)."""
        traces = torch.from_numpy(self.check_traces(X))
        with torch.inference_mode():
            return as_points(in_chunks(self.net_, traces))

    def module(self) -> nn.Module:
        """(B, C, T) -> (B, 1, d)."""
        check_is_fitted(self, "net_")
        return self.net_

    def get_state(self) -> dict[str, NDArray[Any]]:
        """Plain arrays: encoder and map, the shape of a trace, and what the next training draws from."""
        check_is_fitted(self, "net_")
        own = {"shape": self.trace_shape_, "average": self.net_.encoder.average, "n_fits": self.n_fits_}
        state = {name: np.array(value) for name, value in (own | {"n_steps": self.n_iter_}).items()}
        return state | {f"net.{name}": value.numpy().copy() for name, value in self.net_.state_dict().items()}

    def set_state(self, state: Mapping[str, NDArray[Any]]) -> Self:
        """Become what `get_state` was taken from; the parameters must be the same."""
        channels, samples = (int(n) for n in state["shape"])
        self.trace_shape_, self.n_features_in_ = (channels, samples), channels * samples
        self._build(ConvEncoder(channels, samples, int(state["average"]), *SIZES))
        net = {name[4:]: torch.from_numpy(np.array(value)) for name, value in state.items() if name.startswith("net.")}
        self.net_.load_state_dict(net)
        self.n_fits_, self.n_iter_ = int(state["n_fits"]), int(state["n_steps"])
        return self

    @property
    def report(self) -> FitReport:
        """Steps of the last training."""
        check_is_fitted(self, "net_")
        return FitReport(self.n_iter_)

    def check(self) -> None:
        """Raise SettingError for a parameter out of its range."""
        for name, least in (("n_components", 1), ("n_neighbors", 2), ("n_steps", 0)):
            value = getattr(self, name)
            if not isinstance(value, int | np.integer) or value < least:
                raise SettingError(f"Expected {name} >= {least}, an integer, got {value!r}.")

    def _build(self, encoder: ConvEncoder) -> None:
        self.net_ = PlaneEmbedding(encoder, self.n_components).eval()
        self._kept = KeptFeatures(len(encoder.gain))


class PlaneEmbedding(nn.Module):
    """(B, C, T) raw traces -> (B, 1, d): the encoder, and a linear map of its features that is laid out."""

    def __init__(self, encoder: ConvEncoder, n_components: int) -> None:
        super().__init__()
        self.encoder = encoder
        self.weight = nn.Parameter(torch.zeros(n_components, encoder.n_out), requires_grad=False)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, T) -> (B, 1, d)."""
        return self.place(self.encoder(x)).unsqueeze(1)

    def place(self, g: Tensor) -> Tensor:
        """(n, 2*W) features -> (n, d)."""
        return torch.mm(g, self.weight.t())

    def begin(self, g: Tensor) -> None:
        """The plane of the first principal components of features (n, 2*W), which are its first columns."""
        size = g[:, : len(self.weight)].var(0).sum().sqrt().clamp(min=1e-6)
        self.weight.copy_(torch.eye(*self.weight.shape) * EXTENT / size)

    def carry_over(self, carry: Carry) -> None:
        """Say the same of features that were standardised anew; where the plane's middle lies is of no account."""
        self.weight.copy_(carry(self.weight, torch.zeros(len(self.weight)))[0])

    def lay_out(self, g: Tensor, n_neighbors: int, n_steps: int, stop: StopRule, draw: torch.Generator) -> int:
        """Lower parametric UMAP's loss of features (n, 2*W) by Adam; returns steps taken, n_steps at most."""
        i, j, membership = fuzzy_graph(g, n_neighbors)
        adam = torch.optim.Adam([self.weight.requires_grad_(True)], lr=RATE, fused=True)
        step = 0
        while not stop.exhausted(step) and step < n_steps:  # asked first: it remembers when
            edges = torch.multinomial(membership, EDGES, replacement=True, generator=draw)
            strangers = torch.randint(len(g), (REPELLED * EDGES,), generator=draw)
            z = self.place(g)
            others = z.index_select(0, torch.cat([j[edges], strangers])).view(1 + REPELLED, EDGES, -1)
            adam.zero_grad()
            cross_entropy(z.index_select(0, i[edges]), others).backward()  # type: ignore[no-untyped-call]  # torch's own
            adam.step()
            step += 1
        self.weight.requires_grad_(False)
        return step


def untrained_encoder(traces: Tensor, rng: np.random.Generator) -> ConvEncoder:
    """The encoder as `ConvReducer` begins it, its kernels and thresholds set from traces (n, C, T)."""
    encoder = ConvEncoder(traces.size(1), traces.size(2), averaging(traces), *SIZES)
    encoder.learn(traces, rng)
    return encoder.eval()
