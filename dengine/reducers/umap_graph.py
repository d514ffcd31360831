"""The graph of `UmapReducer`: each trace is joined to its nearest neighbours. `Frames` shortens
traces to vectors, between which distances are measured. `Neighbors` holds the exact nearest
neighbours of each trace and searches only those that changed since the last training.
`membership_strengths` weighs the neighbours, and `fuzzy_simplicial_set` unites all neighbourhoods
to a symmetric graph, which `umap_layout` lays out.

References
----------
McInnes, Healy and Melville (2018), UMAP: Uniform manifold approximation and projection for
dimension reduction, arXiv:1802.03426; the library umap-learn 0.5.
"""

from dataclasses import dataclass
from math import log2
from typing import Self

import numpy as np
import torch
from scipy.sparse import csr_matrix
from torch import Tensor, nn

from .base import Floats, Ints
from .preprocessing import averaging

MIN_FRAMES = 100  # of each channel, unless a trace has fewer samples
SPARE = 3  # candidates beyond the k nearest ones, as rounding may have changed their order
CHUNK = 256  # traces that are searched at once, so that memory stays small
BISECTIONS = 32  # of sigma
MIN_SIGMA = 1e-3  # of the mean distance; umap-learn's MIN_K_DIST_SCALE


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

    def learn(self, traces: Tensor) -> None:
        """Set centre and scale of a new module, in place, from traces (n, C, T).

        The centre becomes the mean trace (C, T), the scale the root mean square of all frames of
        the centred traces, or 1 if all traces are the same. Call it once: it reads the old scale.
        """
        self.centre.copy_(traces.double().mean(0))
        deviation = self(traces).double().square().mean().sqrt()
        self.scale.copy_(torch.where(deviation > 0.0, deviation, 1.0))

    def forward(self, x: Tensor) -> Tensor:
        """Raw traces (B, C, T) -> centred, scaled frames (B, F), channel after channel."""
        # The difference has memory that torch aligned. A product of other memory, or of other
        # strides, would differ in its last bits.
        rows = (x - self.centre).flatten(0, 1)
        return (rows @ self.pool).view(x.size(0), self.n_features) / self.scale


def frames_for(traces: Floats) -> Frames:
    """Return a new `Frames` module for traces (n, C, T), which has yet to `learn` them.

    It makes 100 to 199 frames of each channel, or more if an oscillation would be lost. Traces of
    fewer than 100 samples get a frame for each sample.
    """
    _, channels, samples = traces.shape
    return Frames(channels, samples, samples // averaging(torch.from_numpy(traces), MIN_FRAMES))


@dataclass(frozen=True, eq=False)
class Neighbors:
    """The exact nearest neighbours of traces. Each trace is identified by its label's number.

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
        """Return an object without traces, whose `update` finds k neighbours of each trace.

        `n_features` is F, the number of frames of a trace: the sums of short stretches of samples
        between which distances are measured.
        """
        return cls(
            numbers=np.zeros(0, dtype=np.int64),
            frames=torch.zeros(0, n_features),
            indices=torch.zeros(0, k, dtype=torch.int64),
            distances=torch.zeros(0, k),
        )

    def rows_of(self, numbers: Ints) -> Tensor:
        """Return in which row of this object each label number of an array (m,) is: int64 (m,).

        It is -1 for a number that this object does not have. The numbers may be in any order.
        """
        return torch.from_numpy(
            np.where(np.isin(numbers, self.numbers), np.searchsorted(self.numbers, numbers), -1)
        )

    def update(self, traces: Floats, numbers: Ints, make_frames: Frames) -> "Neighbors":
        """Return a new object with the neighbours among these traces; this one does not change.

        Neighbours are searched for the new traces, for traces that lost a neighbour, and for traces
        to which a new trace is nearer than their farthest neighbour. The neighbours of all other
        traces are copied. If more than half of the traces are new, they are searched for all.

        Parameters
        ----------
        traces : array of float32, shape (n, C, T)
            More than k, the number of neighbours of a trace.
        numbers : array of int64, shape (n,)
            Numbers of the labels, increasing; the same number stands for the same trace as before.
            A trace of this object whose number is not among them is dropped.
        make_frames : Frames
            The module that computed this object's `frames`, the sums of samples by which distances
            are measured.

        Returns
        -------
        Neighbors
        """
        n = len(numbers)
        k = self.indices.size(1)
        old_rows = self.rows_of(numbers)  # -1: the trace is new
        kept_rows = (old_rows >= 0).nonzero().flatten()
        new_rows = (old_rows < 0).nonzero().flatten()
        old_rows = old_rows[kept_rows]

        frames = torch.empty(n, self.frames.size(1))
        frames[kept_rows] = self.frames[old_rows]
        frames[new_rows] = make_frames(torch.from_numpy(traces[new_rows.numpy()]))

        row_of_old = torch.full((len(self.numbers),), -1)  # -1: the trace has left
        row_of_old[old_rows] = kept_rows
        indices = torch.full((n, k), -1)
        indices[kept_rows] = row_of_old[self.indices[old_rows]]
        distances = torch.full((n, k), torch.inf)
        distances[kept_rows] = self.distances[old_rows]

        complete = (indices >= 0).all(1) & (2 * len(new_rows) <= n)
        for rows in torch.split((~complete).nonzero().flatten(), CHUNK):
            candidates = nearest_rows(frames, rows, min(k + SPARE, n - 1))
            indices[rows], distances[rows] = nearest_candidates(frames, rows, candidates, k)
        if len(new_rows):
            for rows in torch.split(complete.nonzero().flatten(), CHUNK):
                near, nearest_new = nearest_new_rows(frames, rows, new_rows, distances[rows, -1])
                rows = rows[near]
                candidates = torch.cat([indices[rows], nearest_new[:, :k]], 1)
                indices[rows], distances[rows] = nearest_candidates(frames, rows, candidates, k)
        return Neighbors(numbers, frames, indices, distances)


def nearest_rows(frames: Tensor, rows: Tensor, count: int) -> Tensor:
    """Find the `count` nearest other traces of each row (B,).

    Returns int64 (B, count): rows of `frames` (n, F), in no order and without the row itself.
    `count` must be below n. Distances are rounded, so that the farthest of them may be wrong.
    """
    squared = squared_distances(frames[rows], frames)
    squared[torch.arange(len(rows)), rows] = torch.inf
    return squared.topk(count, dim=1, largest=False, sorted=False).indices


def nearest_new_rows(
    frames: Tensor,
    rows: Tensor,
    new_rows: Tensor,
    farthest: Tensor,
) -> tuple[Tensor, Tensor]:
    """Find the rows to which a new trace is nearer than their farthest neighbour.

    Parameters
    ----------
    frames : Tensor of float32, shape (n, F)
    rows : Tensor of int64, shape (B,)
        The rows to look at.
    new_rows : Tensor of int64, shape (m,)
        Rows of the new traces.
    farthest : Tensor of float32, shape (B,)
        Distance of each row to its farthest neighbour.

    Returns
    -------
    near : Tensor of bool, shape (B,)
        Whether a new trace is nearer, up to rounding.
    nearest : Tensor of int64, shape (near.sum(), m)
        For each of these rows all of `new_rows`, nearest first, up to rounding.
    """
    squared = squared_distances(frames[rows], frames[new_rows])
    near = squared.amin(1) < farthest.square()
    return near, new_rows[squared[near].argsort(1)]


def nearest_candidates(
    frames: Tensor,
    rows: Tensor,
    candidates: Tensor,
    k: int,
) -> tuple[Tensor, Tensor]:
    """Choose the k nearest of the candidates (B, m) of each row (B,) of `frames` (n, F).

    Distances are Euclidean and computed from differences, so they are exact. m must be at least k.
    A row among its own candidates would count at distance 0.

    Returns
    -------
    indices, distances : Tensor, shape (B, k)
        Nearest first.
    """
    offsets = frames[candidates] - frames[rows].unsqueeze(1)
    nearest = torch.linalg.vector_norm(offsets, dim=2).topk(k, dim=1, largest=False)
    return candidates.gather(1, nearest.indices), nearest.values


def squared_distances(x: Tensor, y: Tensor) -> Tensor:
    """Compute the squared distances between x (B, F) and y (m, F) by a matrix product: (B, m).

    They are rounded, so that a small one may be wrong or negative.
    """
    return torch.addmm(y.square().sum(1), x, y.T, alpha=-2.0).add_(x.square().sum(1, keepdim=True))


def membership_strengths(distances: Tensor, n_neighbors: int) -> Tensor:
    """Compute the membership strengths of the neighbours of each trace.

    A strength is ``exp(-(distance - rho) / sigma)``, but at most 1. rho is the distance to the
    nearest neighbour that is not identical, or 0 if all are. sigma is chosen such that the
    strengths of a trace sum to ``log2(n_neighbors)``. But it is at least 0.001 of the trace's mean
    distance, in which the trace itself counts as a neighbour at 0, or of the mean of this over all
    traces if rho is 0. The sum is larger if sigma is at this limit, or if many neighbours are as
    near as rho. The method is that of `smooth_knn_dist` and `compute_membership_strengths` in
    umap-learn, with 1 for its parameter `local_connectivity`.

    Parameters
    ----------
    distances : Tensor of float32, shape (n, n_neighbors - 1)
        Distances to the nearest other traces, increasing.
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
    nearest = torch.where(distances > 0.0, distances, torch.inf).amin(1, keepdim=True)
    rho = torch.where(nearest < torch.inf, nearest, 0.0)
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

    An edge joins two traces of which one is a neighbour of the other. It has the strength ``p + q -
    p * q``, where p and q are the strengths in its two directions; a direction that is missing has
    strength 0.

    Parameters
    ----------
    indices : Tensor of int64, shape (n, k)
        Neighbours of each trace, itself excluded.
    strengths : Tensor of float32, shape (n, k)
        Membership strengths of these neighbours.

    Returns
    -------
    csr_matrix of float32, shape (n, n)
        Strengths from 0 to 1.

    References
    ----------
    Algorithm 1 of McInnes et al. (2018).
    """
    n, k = indices.shape
    one_way = csr_matrix(
        (strengths.flatten().numpy(), indices.flatten().numpy(), np.arange(0, n * k + 1, k)), (n, n)
    )
    other_way = one_way.T.tocsr()
    return one_way + other_way - one_way.multiply(other_way)
