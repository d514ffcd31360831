"""The layout of `UmapReducer`: each trace gets a point, near those that it is joined to.
`spectral_start` places the points of a graph by eigenvectors. `optimize_layout` then moves them by
the `attraction` of neighbours and the `repulsion` of other points, until both are in balance.

umap-learn takes stochastic steps along one edge at a time. Here an epoch is one step of all points
along the expectation of umap-learn's steps, semi-implicit, so that a learning rate of 1 is stable.

References
----------
McInnes, Healy and Melville (2018), UMAP: Uniform manifold approximation and projection for
dimension reduction, arXiv:1802.03426; the library umap-learn 0.5. Damrich and Hamprecht (2021), On
UMAP's true loss function, NeurIPS, arXiv:2103.14608: the expectation of umap-learn's steps.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Self

import numpy as np
import torch
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.optimize import curve_fit
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import ArpackNoConvergence, eigsh
from torch import Tensor

from .base import StopRule

CLOSING_EPOCHS = 10  # in which the learning rate falls to 0 when a layout has to end early
NEGATIVE_SAMPLES = 16  # of each point in an epoch
NEGATIVE_SAMPLE_RATE = 5.0  # weight of all of them together, as in umap-learn
CLIP = 4.0  # of each coordinate of a repulsion, as in umap-learn
EXTENT = 10.0  # largest coordinate of a start, as in umap-learn
NOISE = 1e-4  # added to a start, as in umap-learn: points that coincide would never part
DENSE_TRACES = 200  # up to which a spectral start computes all eigenvectors
PCA_TRACES = 256  # from which principal components are computed


def spectral_start(
    graph: csr_matrix,
    frames: Tensor,
    n_components: int,
    rng: Generator,
) -> Tensor:
    """Place traces by eigenvectors of their graph, as the start of a layout.

    They are the eigenvectors of the normalised Laplacian with the smallest eigenvalues, without the
    first. Principal components of the frames take their place in two cases: if the graph is not
    connected, because eigenvectors then say nothing of the points within a connected component, and
    if the solver does not converge. umap-learn places each connected component by eigenvectors of
    its own.

    Parameters
    ----------
    graph : csr_matrix of float32, shape (n, n)
        The fuzzy simplicial set: weights of the edges between neighbours.
    frames : Tensor of float32, shape (n, F)
        Averages of each trace over stretches of samples (`umap_graph.Frames`), for the principal
        components.
    n_components : int
        Dimension of the points.
    rng : numpy.random.Generator
        Draws the noise, and the start of the eigenvalue solver.

    Returns
    -------
    Tensor of float32, shape (n, n_components)
        Centred and scaled so that the largest coordinate is 10 or -10, plus noise with a standard
        deviation of 0.0001.

    References
    ----------
    Algorithm 4 of McInnes et al. (2018). Belkin and Niyogi (2003), Laplacian eigenmaps, Neural
    Computation 15(6).
    """
    points = None
    if connected_components(graph, directed=False, return_labels=False) == 1:
        points = leading_eigenvectors(graph, n_components, rng)
    if points is None:
        points = principal_components(frames, n_components)
    points = points - points.mean(0)
    points = points * (EXTENT / max(np.abs(points).max(), 1e-12))
    noise = rng.normal(scale=NOISE, size=points.shape)
    return torch.from_numpy((points + noise).astype(np.float32))


def leading_eigenvectors(
    graph: csr_matrix,
    n: int,
    rng: Generator,
) -> NDArray[np.float64] | None:
    """Compute n eigenvectors of D^(-1/2) A D^(-1/2), where A is the graph and D its degrees.

    They belong to the n largest eigenvalues after the very largest. Returns them as columns,
    float64 (number of traces, n), in the order of increasing eigenvalues, or None if the solver
    does not converge. `rng` draws the vector from which the solver starts. For up to 200 traces, or
    up to 4 n if that is more, all eigenvectors are computed instead, without `rng`.
    """
    root = np.sqrt(np.asarray(graph.sum(1), dtype=np.float64)).ravel()
    edges = graph.tocoo()
    edges.data = edges.data / (root[edges.row] * root[edges.col])
    normalised = edges.tocsr()
    size = len(root)
    if size <= max(DENSE_TRACES, 4 * n):
        _, all_vectors = torch.linalg.eigh(torch.from_numpy(normalised.toarray()))
        return np.asarray(all_vectors[:, -1 - n : -1])
    start = rng.standard_normal(size)
    try:
        _, vectors = eigsh(normalised, n + 1, which="LA", v0=start, ncv=max(16, 4 * n), tol=1e-3)
    except ArpackNoConvergence:
        return None
    return np.asarray(vectors[:, :n])


def principal_components(frames: Tensor, n: int) -> NDArray[np.float64]:
    """Return the first n principal components of frames (m, F), float64 (m, n).

    `frames` has a row of F numbers for each trace. The mean of all rows is subtracted; the axes are
    then computed from at most 256 of the rows, evenly spaced. If there are fewer than n components,
    the last columns are 0.
    """
    centred = (frames - frames.mean(0)).double()
    axes = torch.linalg.svd(centred[:: 1 + len(centred) // PCA_TRACES], full_matrices=False).Vh[:n]
    components = np.zeros((len(frames), n))
    components[:, : len(axes)] = (centred @ axes.T).numpy()
    return components


@cache
def find_ab_params(min_dist: float) -> tuple[float, float]:
    """Fit a and b of the membership strength ``1 / (1 + a * d ** (2 * b))`` at a distance d.

    The curve approximates 1 up to `min_dist`, and ``exp(min_dist - d)`` beyond it. The result is
    cached for each `min_dist`.

    Parameters
    ----------
    min_dist : float
        From 0 to 1.

    Returns
    -------
    a, b : float

    References
    ----------
    Definition 11 of McInnes et al. (2018). The curve is fitted at the 300 distances from 0 to 3 of
    umap-learn's `find_ab_params`.
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
        The two points that an edge joins.
    strength : Tensor of float32, shape (E,)
        Divided by the largest one: an edge's share of the epochs in which umap-learn samples it.
    counts : Tensor of int64, shape (n,)
        Number of edges with each point as head.
    """

    head: Tensor
    tail: Tensor
    strength: Tensor
    counts: Tensor

    @classmethod
    def from_graph(cls, graph: csr_matrix) -> Self:
        """Return the edges of a symmetric graph (n, n) of points, each edge in both directions.

        An edge joins a point, its `head`, to another, its `tail`; row i of the graph holds the
        strengths of the edges with head i. The strengths are divided by the largest one. The edges
        are in the order of their heads, and `counts` (n,) is the number of edges of each head.
        """
        counts = torch.from_numpy(np.diff(graph.indptr).astype(np.int64))
        strength = torch.from_numpy(graph.data.astype(np.float32))
        return cls(
            head=torch.repeat_interleave(torch.arange(len(counts)), counts),
            tail=torch.from_numpy(graph.indices.astype(np.int64)),
            strength=strength / strength.max(),
            counts=counts,
        )

    def sum_by_head(self, values: Tensor) -> Tensor:
        """Sum values of edges (d, E) over the edges of each head: (d, n), 0 without edges."""
        return torch.segment_reduce(
            values, "sum", lengths=self.counts.expand(len(values), -1).contiguous(), axis=1
        )


def attraction_coefficients(strengths: Tensor, squared: Tensor, a: float, b: float) -> Tensor:
    """Compute how strongly edges pull: ``strength * d^(2b - 2) / (1 + a d^(2b))``.

    In the gradient of UMAP's loss this factor stands with 4 a b. `squared` holds the squared
    distances d^2, which must be above 0; it has the shape of `strengths`, and so has the result.
    `a` and `b` are those of `find_ab_params`.
    """
    power = squared.pow(b)
    return strengths * power / (squared * (1.0 + a * power))


def attraction(points: Tensor, edges: Edges, a: float, b: float) -> tuple[Tensor, Tensor]:
    """Compute the pull of each point towards its neighbours.

    An edge pulls with the coefficient ``4 a b d^(2b - 2) / (1 + a d^(2b))`` times its strength,
    along the offset to the neighbour. Here d is the distance between the two, and d^2 counts as
    1e-8 at least. This is twice the negative gradient of the edge's term in the cross entropy: the
    factor is 4, not 2, since umap-learn moves both ends of an edge and holds each edge twice.

    Parameters
    ----------
    points : Tensor of float32, shape (d, n)
        One column per trace.
    edges : Edges
        The graph between them.
    a, b : float
        From `find_ab_params`.

    Returns
    -------
    pull : Tensor of float32, shape (d, n)
        Direction and size of the move; the points are not moved here.
    stiffness : Tensor of float32, shape (n,)
        For each point the sum over its edges of coefficient times strength, by which the caller
        damps the move.

    References
    ----------
    Section 3.2 of McInnes et al. (2018).
    """
    offsets = points.index_select(1, edges.tail) - points.index_select(1, edges.head)
    squared = offsets.square().sum(0).clamp(min=1e-8)
    coefficient = attraction_coefficients((4.0 * a * b) * edges.strength, squared, a, b)
    sums = edges.sum_by_head(torch.cat([offsets * coefficient, coefficient.unsqueeze(0)]))
    return sums[:-1], sums[-1]


def negative_samples(
    points: Tensor,
    count: int,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor]:
    """Draw `count` other points for each point: the next ones after it in a shuffled circle.

    umap-learn draws each sample independently. Here every point is drawn equally often.

    Parameters
    ----------
    points : Tensor of float32, shape (d, n)
        One column per trace.
    count : int
        Samples of each point, fewer than n.
    generator : torch.Generator
        Draws the order.

    Returns
    -------
    order : Tensor of int64, shape (n,)
        Columns of `points` in the order of the circle.
    samples : Tensor of float32, shape (d, n, count)
        The points that were drawn for point ``order[i]`` are ``samples[:, i]``.
    """
    order = torch.randperm(points.size(1), generator=generator)
    shuffled = points[:, order]
    circle = torch.cat([shuffled, shuffled[:, :count]], 1)
    return order, circle.unfold(1, count, 1)[:, 1:]


def repulsion(points: Tensor, samples: Tensor, a: float, b: float) -> Tensor:
    """Compute the mean push of each point away from its negative samples.

    A sample at the distance d pushes with ``2 b / ((0.001 + d^2) (1 + a d^(2b)))`` times the offset
    from it. Each coordinate of this push is clipped at ±4, before the mean is taken.

    Parameters
    ----------
    points : Tensor of float32, shape (d, n)
        One column per trace.
    samples : Tensor of float32, shape (d, n, count)
        The negative samples of each point.
    a, b : float
        From `find_ab_params`.

    Returns
    -------
    Tensor of float32, shape (d, n)
        Direction and size of the move; the points are not moved here.

    References
    ----------
    Section 3.2 of McInnes et al. (2018).
    """
    offsets = points.unsqueeze(2) - samples
    squared = offsets.square().sum(0)
    coefficient = 2.0 * b / ((0.001 + squared) * (1.0 + a * squared.pow(b)))
    return (offsets * coefficient).clamp(-CLIP, CLIP).mean(2)


def learning_rates(n_epochs: int, stop: StopRule) -> Iterator[float]:
    """Yield the learning rate of each of `n_epochs` epochs, which falls from 1 towards 0.

    `stop`, a limit on the number of epochs, a deadline, or both, is asked before each epoch. If it
    limits the number (`max_steps`), the rate falls within that number. After its deadline at most
    ten more epochs are taken, over which the rate falls quickly, in equal steps towards 0: at a
    high rate the points would stay scattered by the negative samples (random points that repel) of
    the last epoch. There are never more than `n_epochs` rates, and none if `max_steps` is 0.
    """
    if stop.max_steps is not None:
        n_epochs = min(n_epochs, stop.max_steps)
    epoch = 0
    while epoch < n_epochs and not stop.exhausted(epoch):
        yield 1.0 - epoch / n_epochs
        epoch += 1
    closing = min(CLOSING_EPOCHS, n_epochs - epoch)
    for n_left in range(closing, 0, -1):
        yield (1.0 - epoch / n_epochs) * n_left / (closing + 1)


def optimize_layout(
    points: Tensor,
    graph: csr_matrix,
    min_dist: float,
    n_epochs: int,
    stop: StopRule,
    generator: torch.Generator,
) -> tuple[Tensor, int]:
    """Move points to where attraction and repulsion are in balance.

    Each point has at most 16 negative samples in an epoch, random points that push it away. Their
    mean push is multiplied by 5 times the sum of the strengths of the point's edges. The strength
    of an edge is its weight in `graph`, divided by the largest weight.

    Parameters
    ----------
    points : Tensor of float32, shape (n, d)
        Points from which the layout starts; the tensor is not changed.
    graph : csr_matrix of float32, shape (n, n)
        The fuzzy simplicial set: weights of the edges between neighbours, from 0 to 1.
    min_dist : float
        Distance below which neighbours hardly attract each other any more.
    n_epochs : int
        Epochs to take at most. The learning rate falls from 1 towards 0 over them.
    stop : StopRule
        Limit on the number of epochs, a deadline, or both; asked before each epoch. Its `max_steps`
        lowers `n_epochs`. After its deadline at most ten more epochs are taken, over which the rate
        falls quickly.
    generator : torch.Generator
        Draws the negative samples.

    Returns
    -------
    points : Tensor of float32, shape (n, d)
        The points after the last epoch.
    n_epochs : int
        Number of epochs that were taken.
    """
    a, b = find_ab_params(min_dist)
    edges = Edges.from_graph(graph)
    count = min(NEGATIVE_SAMPLES, len(points) - 1)
    weight = NEGATIVE_SAMPLE_RATE * edges.sum_by_head(edges.strength.unsqueeze(0))  # (1, n)
    points = points.T.contiguous()  # (d, n)
    n_taken = 0
    for rate in learning_rates(n_epochs, stop):
        pull, stiffness = attraction(points, edges, a, b)
        order, samples = negative_samples(points, count, generator)
        push = torch.empty_like(points)
        push[:, order] = repulsion(points[:, order], samples, a, b)
        # Semi-implicit: the pull is that at the end of the step, were its coefficients constant.
        points = points + rate * (pull + weight * push) / (1.0 + rate * stiffness)
        n_taken += 1
    return points.T.contiguous(), n_taken
