"""UMAP in PyTorch: label-free, trained on from retrain to retrain, and exportable.

A training takes these steps; with each stands what differs from the library umap-learn.

1. `Frames` averages each trace to about 100 frames, between which distances are measured.
   umap-learn takes whole traces; on force traces the neighbours are nearly the same.
2. `Neighbors` holds the exact nearest neighbours of each trace. umap-learn searches them anew at
   every fit, from 4,096 traces on approximately. Here they are kept from training to training,
   and only what arrived or left is searched.
3. `membership_strengths` and `fuzzy_simplicial_set` are umap-learn's.
4. `spectral_start` places the traces of a first training, as in umap-learn. Later trainings go on
   from the places of the last one, and new traces begin where step 6 puts them.
5. `optimize_layout` moves the places by `attraction` and `repulsion`. umap-learn takes stochastic
   steps along one edge at a time. Here an epoch is one step of all places along the expectation
   of umap-learn's steps, semi-implicit, so that a learning rate of 1 is stable.
6. `UmapEncoder` places a new trace at the mean of its nearest references' places, weighted by
   their membership strengths. umap-learn starts there and goes on with stochastic steps.

References
----------
McInnes, Healy and Melville (2018), UMAP: Uniform manifold approximation and projection for
dimension reduction, arXiv:1802.03426; the library umap-learn 0.5. Damrich and Hamprecht (2021), On
UMAP's true loss function, NeurIPS, arXiv:2103.14608: the expectation of umap-learn's steps.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from math import log2
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import curve_fit
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import ArpackNoConvergence, eigsh
from sklearn.utils.validation import check_is_fitted
from torch import Tensor, nn

from ..decision.scripting import arrays_with_prefix, restore
from ..errors import SettingError, expect
from ..records import is_number, is_whole
from .base import FitReport, Floats, Ints, Reducer, StopRule, as_points, seed_of
from .preprocessing import averaging

FRAMES = 100  # of a channel at least, as far as it has so many samples
SPARE = 3  # candidates beyond the nearest ones, as rounding may have changed their order
CHUNK = 256  # traces that are searched or embedded at once, so that memory stays small
BISECTIONS = 32  # of sigma
MIN_SIGMA = 1e-3  # of the mean distance; umap-learn's MIN_K_DIST_SCALE
FIRST_EPOCHS = 200  # that a layout needs from a spectral start, in one training or in several
LEAST_EPOCHS = 60  # of a later training
MOST_EPOCHS = 200
WORK = 240_000  # traces times epochs of a later training, between these two
MOST_WORK = 400_000  # traces times epochs of any training, which bounds its time
CLOSING_EPOCHS = 10  # in which the learning rate falls to 0 when a layout has to end early
NEGATIVE_SAMPLES = 16  # of each place in an epoch
NEGATIVE_SAMPLE_RATE = 5.0  # weight of all of them together, as in umap-learn
CLIP = 4.0  # of each coordinate of a repulsion, as in umap-learn
EXTENT = 10.0  # largest coordinate of a start, as in umap-learn
NOISE = 1e-4  # added to a start, as in umap-learn: places that coincide would never part
DENSE = 200  # traces up to which a spectral start computes all eigenvectors
LEAST_SLOTS = 256  # for references in an encoder: many versions share one compiled module


class Frames(nn.Module):
    """Average traces to frames: (B, C, T) -> (B, F), where F counts the frames of all channels.

    A frame is the sum over a stretch of samples, divided by the root of the stretch's length. The
    Euclidean distance between frames is then that between traces, without what averages out
    within a stretch. The stretches are of nearly equal length and cover the whole trace. The mean
    trace is subtracted, and one scale for all frames keeps them near 1, whatever their unit.

    Parameters
    ----------
    channels, samples : int
        C and T.
    n_frames : int
        Frames of each channel, `samples` at most.
    """

    pool: Tensor
    centre: Tensor
    scale: Tensor

    def __init__(self, channels: int, samples: int, n_frames: int) -> None:
        super().__init__()
        self.n_frames = n_frames
        self.n_features = channels * n_frames
        edges = torch.linspace(0.0, samples, n_frames + 1).round()
        sample = torch.arange(samples)[:, None]
        inside = ((sample >= edges[:-1]) & (sample < edges[1:])).float()  # (T, n_frames)
        self.register_buffer("pool", inside / inside.sum(0).sqrt(), persistent=False)
        self.register_buffer("centre", torch.zeros(channels, samples))
        self.register_buffer("scale", torch.ones(1))

    @torch.jit.unused
    def learn(self, traces: Tensor) -> None:
        """Set centre and scale from traces (n, C, T)."""
        self.centre.copy_(traces.double().mean(0))
        deviation = self(traces).double().square().mean().sqrt()
        self.scale.copy_(torch.where(deviation > 0.0, deviation, 1.0))

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, T) -> (B, F)."""
        # The difference has memory that torch aligned. A product of other memory, or of other
        # strides, would differ in its last bits.
        rows = (x - self.centre).flatten(0, 1)
        return (rows @ self.pool).view(x.size(0), self.n_features) / self.scale


def frames_for(traces: Floats) -> Frames:
    """Build the frames of traces (n, C, T); more than usual where an oscillation would be lost."""
    _, channels, samples = traces.shape
    n_frames = samples // averaging(torch.from_numpy(traces), FRAMES)
    return Frames(channels, samples, n_frames)


@dataclass(frozen=True, eq=False)
class Neighbors:
    """The exact nearest neighbours of traces that are known by number.

    Attributes
    ----------
    numbers : array of int64, shape (n,)
        Numbers of the traces' labels, increasing.
    frames : Tensor of float32, shape (n, F)
    indices : Tensor of int64, shape (n, k)
        Rows of the k nearest other traces, nearest first.
    distances : Tensor of float32, shape (n, k)
        Euclidean distances to these, in the unit of the frames.
    """

    numbers: Ints
    frames: Tensor
    indices: Tensor
    distances: Tensor

    @classmethod
    def empty(cls, n_features: int, k: int) -> Self:
        """Return the k neighbours of each of no traces."""
        return cls(
            numbers=np.zeros(0, dtype=np.int64),
            frames=torch.zeros(0, n_features),
            indices=torch.zeros(0, k, dtype=torch.int64),
            distances=torch.zeros(0, k),
        )

    def rows_of(self, numbers: Ints) -> Tensor:
        """Return the row of each number, or -1, shape (m,)."""
        row = np.searchsorted(self.numbers, numbers)
        return torch.from_numpy(np.where(np.isin(numbers, self.numbers), row, -1))

    def update(self, traces: Floats, numbers: Ints, make_frames: Frames) -> "Neighbors":
        """Return the neighbours among these traces; this object stays as it is.

        Searched are the traces that are new, those that lost a neighbour, and those to which a
        new trace is nearer than their farthest neighbour.

        Parameters
        ----------
        traces : array of float32, shape (n, C, T)
            More than k.
        numbers : array of int64, shape (n,)
            Increasing; the same number is the same trace as before.
        make_frames : Frames
            What `frames` were made by.
        """
        n = len(numbers)
        k = self.indices.size(1)
        before = self.rows_of(numbers)
        kept = (before >= 0).nonzero()[:, 0]
        arrived = (before < 0).nonzero()[:, 0]
        before = before[kept]

        frames = torch.empty(n, self.frames.size(1))
        frames[kept] = self.frames[before]
        frames[arrived] = make_frames(torch.from_numpy(traces[arrived.numpy()]))

        row_now = torch.full((len(self.numbers),), -1)
        row_now[before] = kept
        indices = torch.full((n, k), -1)
        indices[kept] = row_now[self.indices[before]]
        distances = torch.full((n, k), torch.inf)
        distances[kept] = self.distances[before]

        complete = (indices >= 0).all(1) & (2 * len(arrived) <= n)
        for rows in torch.split((~complete).nonzero()[:, 0], CHUNK):
            candidates = nearest_rows(frames, rows, min(k + SPARE, n - 1))
            indices[rows], distances[rows] = nearest_candidates(frames, rows, candidates, k)
        if len(arrived):
            for rows in torch.split(complete.nonzero()[:, 0], CHUNK):
                near, new = near_arrivals(frames, rows, arrived, distances[rows, -1])
                rows = rows[near]
                candidates = torch.cat([indices[rows], new[:, :k]], 1)
                indices[rows], distances[rows] = nearest_candidates(frames, rows, candidates, k)
        return Neighbors(numbers, frames, indices, distances)


def nearest_rows(frames: Tensor, rows: Tensor, count: int) -> Tensor:
    """Find the nearest other traces of each row, shape (B, count), up to rounding."""
    squared = squared_distances(frames[rows], frames)
    squared[torch.arange(len(rows)), rows] = torch.inf
    return squared.topk(count, dim=1, largest=False, sorted=False).indices


def near_arrivals(
    frames: Tensor,
    rows: Tensor,
    arrived: Tensor,
    farthest: Tensor,
) -> tuple[Tensor, Tensor]:
    """Find the rows (B,) to which an arrived one is nearer than `farthest`, and for these all
    arrived ones, nearest first, up to rounding.
    """
    squared = squared_distances(frames[rows], frames[arrived])
    near = squared.amin(1) < farthest.square()
    return near, arrived[squared[near].argsort(1)]


def nearest_candidates(
    frames: Tensor,
    rows: Tensor,
    candidates: Tensor,
    k: int,
) -> tuple[Tensor, Tensor]:
    """Choose the k nearest of the candidates (B, m) of each row, by exact distances.

    Returns
    -------
    indices, distances : Tensor, shape (B, k)
        Nearest first.
    """
    offsets = frames[candidates] - frames[rows].unsqueeze(1)
    nearest = torch.linalg.vector_norm(offsets, dim=2).topk(k, dim=1, largest=False, sorted=True)
    return candidates.gather(1, nearest.indices), nearest.values


def squared_distances(x: Tensor, y: Tensor) -> Tensor:
    """Squared distances between x (B, F) and y (m, F), shape (B, m), by a matrix product."""
    products = torch.addmm(y.square().sum(1), x, y.T, alpha=-2.0)
    return products.add_(x.square().sum(1, keepdim=True))


def membership_strengths(distances: Tensor, n_neighbors: int) -> Tensor:
    """Compute how strongly each trace holds its neighbours to be in its neighbourhood.

    The strength is ``exp(-(distance - rho) / sigma)``. rho is the distance to the nearest
    neighbour that is not at the same place, sigma is such that the strengths sum to
    ``log2(n_neighbors)``. It is umap-learn's `smooth_knn_dist` and `compute_membership_strengths`
    with a local connectivity of 1.

    Parameters
    ----------
    distances : Tensor of float32, shape (n, n_neighbors - 1)
        To the nearest other traces, increasing.
    n_neighbors : int
        A trace counts as one of its own neighbours.

    Returns
    -------
    Tensor of float32, shape (n, n_neighbors - 1)
        From 0 to 1.

    References
    ----------
    Algorithms 2 and 3 of McInnes et al. (2018).
    """
    apart = torch.where(distances > 0.0, distances, torch.inf).amin(1, keepdim=True)
    rho = torch.where(apart < torch.inf, apart, 0.0)
    beyond = (distances - rho).clamp(min=0.0)
    target = log2(n_neighbors)
    sigma = beyond.mean(1, keepdim=True) + 1e-12
    low = torch.zeros_like(sigma)
    high = torch.full_like(sigma, torch.inf)
    for _ in range(BISECTIONS):
        too_large = torch.exp(-beyond / sigma).sum(1, keepdim=True) > target
        high = torch.where(too_large, sigma, high)
        low = torch.where(too_large, low, sigma)
        sigma = torch.where(high < torch.inf, (low + high) / 2.0, 2.0 * sigma)
    mean = distances.sum(1, keepdim=True) / n_neighbors
    least = MIN_SIGMA * torch.where(rho > 0.0, mean, mean.mean())
    return torch.exp(-beyond / torch.maximum(sigma, least).clamp(min=1e-12))


def fuzzy_simplicial_set(indices: Tensor, strengths: Tensor) -> csr_matrix:
    """Unite the neighbourhoods of all traces to one symmetric graph.

    An edge has the strength ``p + q - p * q``, where p and q are the strengths in both directions.

    Parameters
    ----------
    indices : Tensor of int64, shape (n, k)
        Neighbours of each trace, itself excluded.
    strengths : Tensor of float32, shape (n, k)
        Their membership strengths.

    Returns
    -------
    csr_matrix of float32, shape (n, n)

    References
    ----------
    Algorithm 1 of McInnes et al. (2018).
    """
    n, k = indices.shape
    starts = np.arange(0, n * k + 1, k)
    one_way = csr_matrix((strengths.flatten().numpy(), indices.flatten().numpy(), starts), (n, n))
    other_way = one_way.T.tocsr()
    return one_way + other_way - one_way.multiply(other_way)


def spectral_start(
    graph: csr_matrix,
    frames: Tensor,
    n_components: int,
    rng: np.random.Generator,
) -> Tensor:
    """Place traces by the leading eigenvectors of their graph.

    These are the smallest ones of the normalised Laplacian, without the first. A graph that falls
    into several components says nothing of the places within each, so principal components of the
    frames stand in for it. umap-learn places each component by eigenvectors of its own.

    Parameters
    ----------
    graph : csr_matrix of float32, shape (n, n)
        The fuzzy simplicial set.
    frames : Tensor of float32, shape (n, F)
        Used where the graph falls into components.
    n_components : int
        Dimension of the places.
    rng : numpy.random.Generator
        Of the noise.

    Returns
    -------
    Tensor of float32, shape (n, n_components)
        Centred, with 10 as the largest coordinate, and a little noise.

    References
    ----------
    Algorithm 4 of McInnes et al. (2018). Belkin and Niyogi (2003), Laplacian eigenmaps, Neural
    Computation 15(6).
    """
    places = None
    if connected_components(graph, directed=False, return_labels=False) == 1:
        places = leading_eigenvectors(graph, n_components, rng)
    if places is None:
        places = principal_components(frames, n_components)
    places = places - places.mean(0)
    places = places * (EXTENT / max(float(np.abs(places).max()), 1e-12))
    noise = rng.normal(scale=NOISE, size=places.shape)
    return torch.from_numpy((places + noise).astype(np.float32))


def leading_eigenvectors(
    graph: csr_matrix,
    n: int,
    rng: np.random.Generator,
) -> NDArray[np.float64] | None:
    """Compute n eigenvectors of D^(-1/2) A D^(-1/2) after the first; None without convergence."""
    root = np.sqrt(np.asarray(graph.sum(1), dtype=np.float64)).ravel()
    coordinates = graph.tocoo()
    values = coordinates.data / (root[coordinates.row] * root[coordinates.col])
    normalised = csr_matrix((values, (coordinates.row, coordinates.col)), graph.shape)
    size = graph.shape[0]
    if size <= max(DENSE, 4 * n):
        _, all_vectors = torch.linalg.eigh(torch.from_numpy(normalised.toarray()))
        return np.asarray(all_vectors[:, -1 - n : -1])
    start = rng.standard_normal(size)
    try:
        _, vectors = eigsh(normalised, n + 1, which="LA", v0=start, ncv=max(16, 4 * n), tol=1e-3)
    except ArpackNoConvergence:
        return None
    return np.asarray(vectors[:, :n])


def principal_components(frames: Tensor, n: int) -> NDArray[np.float64]:
    """Compute the first n principal components of frames (m, F), zeros where there are fewer."""
    centred = (frames - frames.mean(0)).double()
    some = centred[:: 1 + len(centred) // CHUNK]
    axes = torch.linalg.svd(some, full_matrices=False).Vh[:n]
    places = np.zeros((len(frames), n))
    places[:, : len(axes)] = (centred @ axes.T).numpy()
    return places


@cache
def find_ab_params(min_dist: float) -> tuple[float, float]:
    """Fit a and b of the membership strength ``1 / (1 + a * d ** (2 * b))`` of two places.

    The curve approximates 1 up to `min_dist` and an exponential decay beyond it, at a spread of 1.

    Parameters
    ----------
    min_dist : float
        From 0 to 1.

    Returns
    -------
    a, b : float

    References
    ----------
    Definition 11 of McInnes et al. (2018); the grid is that of umap-learn's `find_ab_params`.
    """
    distance = np.linspace(0.0, 3.0, 300)
    strength = np.where(distance < min_dist, 1.0, np.exp(-(distance - min_dist)))
    (a, b), _ = curve_fit(lambda d, a, b: 1.0 / (1.0 + a * d ** (2.0 * b)), distance, strength)
    return float(a), float(b)


@dataclass(frozen=True, eq=False)
class Edges:
    """The edges of a graph in the order of their heads, each edge in both directions.

    Attributes
    ----------
    head, tail : Tensor of int64, shape (E,)
    strength : Tensor of float32, shape (E,)
        Divided by the largest one: an edge's share of the epochs in which umap-learn samples it.
    counts : Tensor of int64, shape (n,)
        Edges of each head.
    """

    head: Tensor
    tail: Tensor
    strength: Tensor
    counts: Tensor

    @classmethod
    def of(cls, graph: csr_matrix) -> Self:
        """Return the edges of a symmetric graph."""
        counts = torch.from_numpy(np.diff(graph.indptr).astype(np.int64))
        strength = torch.from_numpy(graph.data.astype(np.float32))
        return cls(
            head=torch.repeat_interleave(torch.arange(len(counts)), counts),
            tail=torch.from_numpy(graph.indices.astype(np.int64)),
            strength=strength / strength.max(),
            counts=counts,
        )

    def sum_by_head(self, values: Tensor) -> Tensor:
        """(d, E) -> (d, n)."""
        lengths = self.counts.expand(len(values), -1).contiguous()
        return torch.segment_reduce(values, "sum", lengths=lengths, axis=1)


def attraction(places: Tensor, edges: Edges, a: float, b: float) -> tuple[Tensor, Tensor]:
    """Compute the pull of each place's neighbours.

    The gradient of the cross entropy along an edge is ``-4 a b d^(2b - 2) / (1 + a d^(2b))`` times
    the offset, since umap-learn moves both ends of an edge and holds each edge twice.

    Parameters
    ----------
    places : Tensor of float32, shape (d, n)
        One column a trace.
    edges : Edges
        The graph between them.
    a, b : float
        As of `find_ab_params`.

    Returns
    -------
    pull : Tensor of float32, shape (d, n)
    stiffness : Tensor of float32, shape (n,)
        Sum of the coefficients of all offsets.

    References
    ----------
    Section 3.2 of McInnes et al. (2018).
    """
    offsets = places.index_select(1, edges.tail) - places.index_select(1, edges.head)
    squared = offsets.square().sum(0).clamp(min=1e-8)
    power = squared.pow(b)
    coefficient = (4.0 * a * b) * edges.strength * power / (squared * (1.0 + a * power))
    sums = edges.sum_by_head(torch.cat([offsets * coefficient, coefficient.unsqueeze(0)]))
    return sums[:-1], sums[-1]


def negative_samples(
    places: Tensor,
    count: int,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor]:
    """Draw other places for each place: those that follow it in a shuffled ring.

    umap-learn draws each sample by itself. Here a place is also drawn equally often by others.

    Parameters
    ----------
    places : Tensor of float32, shape (d, n)
        One column a trace.
    count : int
        Samples of each place, fewer than n.
    generator : torch.Generator
        Of the order.

    Returns
    -------
    order : Tensor of int64, shape (n,)
        The places in the order of the ring.
    samples : Tensor of float32, shape (d, n, count)
        The places that were drawn for place ``order[i]`` are ``samples[:, i]``.
    """
    order = torch.randperm(places.size(1), generator=generator)
    shuffled = places[:, order]
    ring = torch.cat([shuffled, shuffled[:, :count]], 1)
    return order, ring.unfold(1, count, 1)[:, 1:]


def repulsion(places: Tensor, samples: Tensor, a: float, b: float) -> Tensor:
    """Compute the mean push that places get from their negative samples.

    The gradient is ``2 b / ((0.001 + d^2) (1 + a d^(2b)))`` times the offset, clipped to 4.

    Parameters
    ----------
    places : Tensor of float32, shape (d, n)
        One column a trace.
    samples : Tensor of float32, shape (d, n, count)
        The negative samples of each place.
    a, b : float
        As of `find_ab_params`.

    Returns
    -------
    Tensor of float32, shape (d, n)

    References
    ----------
    Section 3.2 of McInnes et al. (2018).
    """
    offsets = places.unsqueeze(2) - samples
    squared = offsets.square().sum(0)
    coefficient = 2.0 * b / ((0.001 + squared) * (1.0 + a * squared.pow(b)))
    return (offsets * coefficient).clamp(-CLIP, CLIP).mean(2)


def learning_rates(n_epochs: int, stop: StopRule) -> Iterator[float]:
    """Yield the learning rate of each epoch, which falls from 1 towards 0.

    A limit in steps is known beforehand, so the rate falls within it. When the clock says that no
    epoch may begin, ten more at most are taken, over which the rate falls to 0: at a high rate
    the places are scattered by the negative samples of the last epoch.
    """
    if stop.max_steps is not None:
        n_epochs = min(n_epochs, stop.max_steps)
    epoch = 0
    while epoch < n_epochs and not stop.exhausted(epoch):
        yield 1.0 - epoch / n_epochs
        epoch += 1
    closing = min(CLOSING_EPOCHS, n_epochs - epoch)
    for left in range(closing, 0, -1):
        yield (1.0 - epoch / n_epochs) * left / (closing + 1)


def optimize_layout(
    places: Tensor,
    graph: csr_matrix,
    min_dist: float,
    n_epochs: int,
    stop: StopRule,
    generator: torch.Generator,
) -> tuple[Tensor, int]:
    """Move places to where attraction and repulsion are in balance.

    Parameters
    ----------
    places : Tensor of float32, shape (n, d)
        Where they start.
    graph : csr_matrix of float32, shape (n, n)
        The fuzzy simplicial set.
    min_dist : float
        Distance up to which neighbours are drawn together.
    n_epochs : int
        Epochs to take.
    stop : StopRule
        Asked before each epoch.
    generator : torch.Generator
        Of the negative samples.

    Returns
    -------
    places : Tensor of float32, shape (n, d)
    n_epochs : int
        Epochs that were taken.
    """
    a, b = find_ab_params(min_dist)
    edges = Edges.of(graph)
    n = len(places)
    count = min(NEGATIVE_SAMPLES, n - 1)
    weight = NEGATIVE_SAMPLE_RATE * edges.sum_by_head(edges.strength.unsqueeze(0))  # (1, n)
    places = places.T.contiguous()
    taken = 0
    for rate in learning_rates(n_epochs, stop):
        pull, stiffness = attraction(places, edges, a, b)
        order, samples = negative_samples(places, count, generator)
        push = torch.empty_like(places)
        push[:, order] = repulsion(places[:, order], samples, a, b)
        # Semi-implicit: the pull is that at the end of the step, were its coefficients constant.
        places = places + rate * (pull + weight * push) / (1.0 + rate * stiffness)
        taken += 1
    return places.T.contiguous(), taken


class UmapEncoder(nn.Module):
    """Embed raw traces among references: (B, C, T) -> (B, 1, dim).

    A trace lies at the mean of the places of its nearest references, weighted by their membership
    strengths. These sum to ``log2(n_neighbors)`` over `n_neighbors` references, the nearest one
    of strength 1. sigma is interpolated between fixed shares of the mean distance, where a
    training bisects.

    Parameters
    ----------
    make_frames : Frames
    references : Tensor of float32, shape (n, F)
        Frames of the references.
    places : Tensor of float32, shape (n, dim)
        Where these lie.
    n_neighbors : int
        Less than n.

    Notes
    -----
    The buffers have room for a power of two of references, so that one compiled module serves
    many versions. Empty slots are infinitely far from every trace.
    """

    references: Tensor
    half_norms: Tensor
    places: Tensor
    rates: Tensor

    def __init__(
        self,
        make_frames: Frames,
        references: Tensor,
        places: Tensor,
        n_neighbors: int,
    ) -> None:
        super().__init__()
        self.make_frames = make_frames
        self.n_neighbors = n_neighbors
        self.total_strength = log2(n_neighbors)
        self.dim = places.size(1)
        half_norms = 0.5 * references.square().sum(1)
        self.register_buffer("references", padded(references, 0.0))
        self.register_buffer("half_norms", padded(half_norms, torch.inf))
        self.register_buffer("places", padded(places, 0.0))
        # 1 / sigma, in units of 1 / the mean of the distances beyond rho
        self.register_buffer("rates", torch.logspace(-2.0, 3.0, 48))

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, T) raw -> (B, 1, dim)."""
        return self.place(self.make_frames(x)).unsqueeze(1)

    @torch.jit.export
    def place(self, frames: Tensor) -> Tensor:
        """(B, F) frames -> (B, dim)."""
        half_squared = self.half_norms - frames @ self.references.T  # less half the trace's norm
        nearest = half_squared.topk(self.n_neighbors, 1, False, True)[1]
        offsets = self.references[nearest] - frames.unsqueeze(1)
        strengths = self.strengths(offsets.square().sum(2).sqrt())
        weighted = strengths.unsqueeze(2) * self.places[nearest]
        return weighted.sum(1) / strengths.sum(1, keepdim=True)

    def strengths(self, distances: Tensor) -> Tensor:
        """(B, n_neighbors) -> (B, n_neighbors) membership strengths."""
        beyond = distances - distances.amin(1, keepdim=True)
        beyond = beyond / (beyond.mean(1, keepdim=True) + 1e-12)
        totals = torch.exp(-beyond.unsqueeze(2) * self.rates).sum(1)  # (B, rates), falling
        after = (totals > self.total_strength).sum(1, keepdim=True)
        after = after.clamp(1, self.rates.size(0) - 1)
        total_before, total_after = totals.gather(1, after - 1), totals.gather(1, after)
        share = (total_before - self.total_strength) / (total_before - total_after + 1e-12)
        rate_before, rate_after = self.rates[after - 1], self.rates[after]
        rate = rate_before + share.clamp(0.0, 1.0) * (rate_after - rate_before)
        return torch.exp(-beyond * rate)


def padded(rows: Tensor, value: float) -> Tensor:
    """Append rows of a value until their number is a power of two, 256 or more."""
    n = len(rows)
    slots = max(LEAST_SLOTS, 1 << (n - 1).bit_length())
    return torch.cat([rows, torch.full((slots - n, *rows.shape[1:]), value)])


@dataclass(eq=False, repr=False, kw_only=True)
class UmapReducer(Reducer):
    """Embed traces by UMAP, without labels, within the time of a retrain.

    `fit` starts anew. `train` goes on from the places of the last training, as long as at least
    half of the traces were in it. So references move little from version to version, and few
    epochs are enough.

    Parameters
    ----------
    n_components : int, default 2
        Dimension of the embedding.
    n_neighbors : int, default 15
        Size of a neighbourhood; a trace counts as one of its own neighbours.
    min_dist : float, default 0.1
        Distance in the embedding up to which neighbours are drawn together.
    n_epochs : int, optional
        Epochs of every training. By default `fit` takes 200; `train` takes 240,000 / n, from 60
        to 200, and at most 400,000 / n, which bounds its time.
    random_state : int, RandomState or None, default 0
        Of the negative samples and the noise on a start.

    Attributes
    ----------
    n_epochs_ : int
        Epochs since the spectral start.
    n_steps_left_ : int
        Epochs that are missing to the 200 that a layout needs from a spectral start; an engine
        then trains again after every cycle.

    References
    ----------
    McInnes, Healy and Melville (2018), UMAP: Uniform manifold approximation and projection for
    dimension reduction, arXiv:1802.03426.

    Examples
    --------
    >>> from dengine.testing import toy_traces
    >>> X, _ = toy_traces(60)  # (n, C, T)
    >>> UmapReducer().fit(X).transform(X).shape
    (60, 2)
    """

    n_components: int = 2
    n_neighbors: int = 15
    min_dist: float = 0.1
    n_epochs: int | None = None
    random_state: Any = 0

    def fit(self, X: ArrayLike, y: ArrayLike | None = None) -> Self:
        """Start anew, and lay the traces out to the end.

        Parameters
        ----------
        X : array of float, shape (n, T) or (n, C, T)
            Traces.
        y : ignored
            Labels are not used.

        Raises
        ------
        SettingError
            If a parameter is out of its range, or there are no more than `n_neighbors` traces.
        """
        traces = self.check_traces(X, reset=True)
        self.check(len(traces))
        self._start(traces)
        self._train(traces, None, StopRule(), self._n_first_epochs)
        return self

    def train(
        self,
        X: Floats,
        y: Ints,
        folds: Ints,
        stop: StopRule | None = None,
        numbers: Ints | None = None,
    ) -> Floats:
        traces = self.check_traces(X, reset=not self._is_fitted)
        self.check(len(traces))
        if numbers is None or not self._knows(numbers):
            self._start(traces)
        self._train(traces, numbers, stop or StopRule())
        return as_points(self.places_.numpy())

    def n_epochs_due(self, n_traces: int) -> int:
        """Epochs that the next training takes on so many traces."""
        if self.n_epochs is not None:
            return self.n_epochs
        most = min(MOST_EPOCHS, max(1, MOST_WORK // n_traces))
        due = self.n_steps_left_ or max(LEAST_EPOCHS, WORK // n_traces)
        return min(due, most)

    def precompute(self, X: Floats, numbers: Ints | None = None) -> None:
        """Search the neighbours of these traces, which the next training need not do."""
        if numbers is None:
            return
        traces = self.check_traces(X, reset=not self._is_fitted)
        self.check(len(traces))
        if not self._is_fitted:
            self._start(traces)
        ahead = self.neighbors_.update(traces, numbers, self.make_frames_)
        self.neighbors_ahead_: Neighbors | None = ahead

    @property
    def _is_fitted(self) -> bool:
        return "encoder_" in vars(self)

    def _knows(self, numbers: Ints) -> bool:
        """Whether the neighbours of any of these traces were searched before."""
        if "neighbors_" not in vars(self):
            return False
        neighbors = self.neighbors_ahead_ or self.neighbors_
        return bool(np.isin(numbers, neighbors.numbers).any())

    def _start(self, traces: Floats) -> None:
        """Forget all trainings, and fit the frames to traces (n, C, T)."""
        some = traces[:: 1 + len(traces) // CHUNK]
        self.make_frames_ = frames_for(some)
        self.make_frames_.learn(torch.from_numpy(some))
        seed = seed_of(self.random_state)
        self.seed_ = int(np.random.default_rng().integers(2**31)) if seed is None else seed
        n_features = self.make_frames_.n_features
        self.neighbors_ = Neighbors.empty(n_features, self.n_neighbors - 1)
        self.neighbors_ahead_ = None
        self.places_ = torch.zeros(0, self.n_components)
        self.n_epochs_ = 0
        self.n_steps_ = 0

    def _train(
        self,
        traces: Floats,
        numbers: Ints | None,
        stop: StopRule,
        n_epochs: int | None = None,
    ) -> None:
        if numbers is None:
            numbers = np.arange(-len(traces), 0)  # of no label
        rng = np.random.default_rng([self.seed_, self.n_steps_])
        generator = torch.Generator().manual_seed(int(rng.integers(2**63)))
        before = self.neighbors_ahead_ or self.neighbors_
        neighbors = before.update(traces, numbers, self.make_frames_)
        strengths = membership_strengths(neighbors.distances, self.n_neighbors)
        graph = fuzzy_simplicial_set(neighbors.indices, strengths)
        places = self._starting_places(neighbors, graph, rng)
        n_epochs = n_epochs or self.n_epochs_due(len(traces))
        places, taken = optimize_layout(places, graph, self.min_dist, n_epochs, stop, generator)
        self._keep(neighbors, places)
        self.n_new_steps_ = taken
        self.n_epochs_ += taken
        self.n_steps_ += taken

    def _starting_places(
        self,
        neighbors: Neighbors,
        graph: csr_matrix,
        rng: np.random.Generator,
    ) -> Tensor:
        """Return the places that a layout starts from: the last ones, if enough are known."""
        row = self.neighbors_.rows_of(neighbors.numbers)
        known = row >= 0
        if 2 * int(known.sum()) < len(row):
            self.n_epochs_ = 0
            return spectral_start(graph, neighbors.frames, self.n_components, rng)
        places = torch.empty(len(row), self.n_components)
        places[known] = self.places_[row[known]]
        chunks = torch.split(neighbors.frames[~known], CHUNK)
        new = [self.encoder_.place(frames) for frames in chunks]
        noise = rng.normal(scale=NOISE, size=(int((~known).sum()), self.n_components))
        places[~known] = torch.cat(new) + torch.from_numpy(noise).float()
        return places

    def _keep(self, neighbors: Neighbors, places: Tensor) -> None:
        """Let these references answer."""
        self.neighbors_ = neighbors
        self.neighbors_ahead_ = None
        self.places_ = places
        encoder = UmapEncoder(self.make_frames_, neighbors.frames, places, self.n_neighbors)
        self.encoder_ = encoder.eval()

    @torch.inference_mode()
    def embed(self, X: Floats) -> Floats:
        check_is_fitted(self, "encoder_")
        traces = torch.from_numpy(self.check_traces(X))
        return torch.cat([self.encoder_(chunk) for chunk in torch.split(traces, CHUNK)]).numpy()

    def untrained_module(self, X: Floats) -> UmapEncoder:
        if self._is_fitted:
            return self.encoder_
        n = max(len(X), self.n_neighbors + 1)
        make_frames = frames_for(X)
        references = torch.zeros(n, make_frames.n_features)
        places = torch.zeros(n, self.n_components)
        return UmapEncoder(make_frames, references, places, self.n_neighbors).eval()

    def module(self) -> UmapEncoder:
        check_is_fitted(self, "encoder_")
        return self.encoder_

    @property
    def n_steps_left_(self) -> int:
        return max(0, self._n_first_epochs - self.n_epochs_)

    @property
    def _n_first_epochs(self) -> int:
        return FIRST_EPOCHS if self.n_epochs is None else self.n_epochs

    @property
    def report(self) -> FitReport:
        check_is_fitted(self, "encoder_")
        left = self.n_steps_left_
        note = f"{left} epochs of the first layout to go" if left else ""
        return FitReport(self.n_new_steps_, note, left)

    def get_state(self) -> dict[str, NDArray[Any]]:
        check_is_fitted(self, "encoder_")
        counts = [self.make_frames_.n_frames, self.seed_]
        counts += [self.n_epochs_, self.n_steps_, self.n_new_steps_]
        state = {
            "shape": np.array(self.trace_shape_),
            "counts": np.array(counts),
            "numbers": self.neighbors_.numbers,
            "references": self.neighbors_.frames.numpy(),
            "neighbors": self.neighbors_.indices.numpy().astype(np.int32),
            "distances": self.neighbors_.distances.numpy(),
            "places": self.places_.numpy(),
        }
        for name, value in self.make_frames_.state_dict().items():
            state[f"frames.{name}"] = value.numpy().copy()
        return state

    def set_state(self, state: Mapping[str, NDArray[Any]]) -> Self:
        channels, samples = (int(value) for value in state["shape"])
        self.trace_shape_ = (channels, samples)
        self.n_features_in_ = channels * samples
        n_frames, self.seed_, *progress = (int(value) for value in state["counts"])
        self.n_epochs_, self.n_steps_, self.n_new_steps_ = progress
        self.make_frames_ = Frames(channels, samples, n_frames)
        restore(self.make_frames_, arrays_with_prefix(state, "frames."))
        neighbors = Neighbors(
            numbers=np.array(state["numbers"]),
            frames=torch.from_numpy(np.array(state["references"])),
            indices=torch.from_numpy(state["neighbors"].astype(np.int64)),
            distances=torch.from_numpy(np.array(state["distances"])),
        )
        self._keep(neighbors, torch.from_numpy(np.array(state["places"])))
        return self

    def check(self, n_traces: int) -> None:
        """Raise SettingError for a parameter out of its range, or too few traces."""
        expect(is_whole(self.n_components, 1, 100), "n_components from 1 to 100", self.n_components)
        expect(is_whole(self.n_neighbors, 2, 1000), "n_neighbors from 2 to 1000", self.n_neighbors)
        is_distance = is_number(self.min_dist) and 0.0 <= self.min_dist <= 1.0
        expect(is_distance, "min_dist from 0 to 1", self.min_dist)
        epochs = self.n_epochs
        expect(epochs is None or is_whole(epochs, 1, 10**6), "n_epochs of 1 or more", epochs)
        least = max(self.n_neighbors, self.n_components)
        if n_traces <= least:
            got = f"n_samples = {n_traces}"
            raise SettingError(f"UMAP needs more than {least} traces, got {got}.")
