"""UMAP in PyTorch: without labels, trained on from retrain to retrain, and exportable. The file
holds `UmapReducer`, the reducer "umap", and `UmapEncoder`, the module that places a new trace among
its references. The graph of neighbours is in `umap_graph`, the layout in `umap_layout`.

A training takes these steps; each line says what differs from the library umap-learn.

1. `Frames` averages each trace to about 100 frames, between which distances are measured.
   umap-learn takes whole traces; on force traces the neighbours are nearly the same.
2. `Neighbors` holds the exact nearest neighbours of each trace. umap-learn searches them at every
   fit, from 4,096 traces on approximately. Here they are kept from training to training, and only
   those that new or missing traces change are searched.
3. `membership_strengths` and `fuzzy_simplicial_set` are umap-learn's.
4. `spectral_start` places the traces of a first training, as in umap-learn. Later trainings go on
   from the last embedding, and new traces begin where step 6 puts them.
5. `optimize_layout` moves the points by attraction and repulsion.
6. `UmapEncoder` starts a new trace at the mean of its nearest references' points, weighted by their
   membership strengths, and moves it to where their attraction balances. umap-learn starts there
   and goes on with stochastic steps of attraction and repulsion.

References
----------
McInnes, Healy and Melville (2018), UMAP: Uniform manifold approximation and projection for
dimension reduction, arXiv:1802.03426; the library umap-learn 0.5.
"""

from dataclasses import dataclass
from math import log2
from typing import Any, Self

import numpy as np
import torch
from numpy.random import Generator
from numpy.typing import ArrayLike
from scipy.sparse import csr_matrix
from sklearn.utils.validation import check_is_fitted
from torch import Tensor, nn

from ..decision.scripting import arrays_with_prefix, module_state, restore
from ..errors import SettingError, expect
from ..records import Arrays, State, is_number, is_whole
from .base import (
    FitReport,
    Floats,
    Ints,
    Reducer,
    StopRule,
    as_points,
    check_integers,
    draw_seed,
    embed_in_chunks,
)
from .umap_graph import (
    CHUNK,
    Frames,
    Neighbors,
    frames_for,
    fuzzy_simplicial_set,
    membership_strengths,
)
from .umap_layout import (
    NOISE,
    attraction_coefficients,
    find_ab_params,
    optimize_layout,
    spectral_start,
)

FIRST_EPOCHS = 200  # that a layout needs from a spectral start, in one training or in several
MIN_EPOCHS = 60  # of a later training
MAX_EPOCHS = 200
WORK = 240_000  # traces times epochs of a later training, between these two
MAX_WORK = 400_000  # traces times epochs of any `train`, which bounds its time
N_ITERATIONS = 5  # that move a new trace to where attraction balances; 20 decide hardly more parts
SMALLEST_SQUARE = 1e-3  # of a distance between points, at which attraction is infinite
MIN_SLOTS = 256  # for references in an encoder: many versions share one compiled module


class UmapEncoder(nn.Module):
    """Embed raw traces among references: (B, C, T) -> (B, 1, dim).

    A trace starts at the mean of its nearest references' points, weighted by their membership
    strengths, and moves from there to where their attraction balances. The strengths of the
    `n_neighbors` nearest references sum to ``log2(n_neighbors)``; that of the nearest one is 1.
    sigma is interpolated between fixed multiples of the mean distance, where a training bisects.

    Parameters
    ----------
    make_frames : Frames
    references : Tensor of float32, shape (n, F)
        Frames of the references, as `make_frames` computes them.
    points : Tensor of float32, shape (n, dim)
        Embedding of the references.
    n_neighbors : int
        Less than n.
    min_dist : float
        Of the layout: it determines how attraction depends on the distance.

    Notes
    -----
    The buffers are padded to a power of two of references, so that one compiled module serves
    many versions. Empty slots are infinitely far from every trace.
    """

    references: Tensor
    half_norms: Tensor
    points: Tensor
    rates: Tensor

    def __init__(
        self,
        make_frames: Frames,
        references: Tensor,
        points: Tensor,
        n_neighbors: int,
        min_dist: float,
    ) -> None:
        super().__init__()
        self.make_frames = make_frames
        self.n_neighbors = n_neighbors
        self.a, self.b = find_ab_params(min_dist)
        self.n_iterations = N_ITERATIONS
        self.smallest_square = SMALLEST_SQUARE
        self.total_strength = log2(n_neighbors)
        self.dim = points.size(1)
        self.register_buffer("references", padded(references, 0.0))
        self.register_buffer("half_norms", padded(0.5 * references.square().sum(1), torch.inf))
        self.register_buffer("points", padded(points, 0.0))
        # 1 / sigma, in units of 1 / the mean of the distances beyond rho
        self.register_buffer("rates", torch.logspace(-2.0, 3.0, 48))

    def forward(self, x: Tensor) -> Tensor:
        """Raw traces (B, C, T) -> points in the only space (B, 1, dim); see `embed_frames`."""
        return self.embed_frames(self.make_frames(x)).unsqueeze(1)

    @torch.jit.export
    def embed_frames(self, frames: Tensor) -> Tensor:
        """Embed traces, each a vector of F frames, among the references: (B, F) -> (B, dim).

        A frame is a scaled sum of a few samples; the references are the traces of the training,
        whose frames and points the module holds. A trace starts at the mean of the points of its
        `n_neighbors` nearest references, weighted by their membership strengths (`strengths`). It
        is then moved five times to the mean of the same points, weighted by how strongly UMAP
        attracts it to each of them at its current distances (whose squares are raised by 0.001).
        """
        # Half the squared distances, less half the squared norm of each trace.
        half_squared = self.half_norms - frames @ self.references.T
        nearest = half_squared.topk(self.n_neighbors, 1, False)[1]
        offsets = self.references[nearest] - frames.unsqueeze(1)
        strengths = self.strengths(offsets.square().sum(2).sqrt())
        points = self.points[nearest]
        embedded = weighted_mean(points, strengths)
        for _ in range(self.n_iterations):
            squared = (points - embedded.unsqueeze(1)).square().sum(2) + self.smallest_square
            coefficients = attraction_coefficients(strengths, squared, self.a, self.b)
            embedded = weighted_mean(points, coefficients)
        return embedded

    def strengths(self, distances: Tensor) -> Tensor:
        """Compute the membership strengths of nearest references from their distances.

        The distances are (B, n_neighbors), a row for each trace, and so is the result; references
        are the traces of the training. A strength is ``exp(-beyond / sigma)``, where `beyond` is
        the distance less that of the nearest reference; so it is 1 for the nearest. sigma is chosen
        for each row, from 0.001 to 100 times the row's mean of `beyond`, so that the strengths sum
        to about ``log2(n_neighbors)``, as far as this range allows; if all distances of a row are
        equal, all strengths are 1.
        """
        beyond = distances - distances.amin(1, keepdim=True)
        beyond = beyond / (beyond.mean(1, keepdim=True) + 1e-12)
        totals = torch.exp(-beyond.unsqueeze(2) * self.rates).sum(1)  # (B, rates), falling
        after = (totals > self.total_strength).sum(1, keepdim=True)
        after = after.clamp(1, self.rates.size(0) - 1)
        total_before = totals.gather(1, after - 1)
        total_after = totals.gather(1, after)
        share = (total_before - self.total_strength) / (total_before - total_after + 1e-12)
        rate_before = self.rates[after - 1]
        rate_after = self.rates[after]
        rate = rate_before + share.clamp(0.0, 1.0) * (rate_after - rate_before)
        return torch.exp(-beyond * rate)


def weighted_mean(points: Tensor, weights: Tensor) -> Tensor:
    """Return the means (B, dim) of points (B, n, dim), weighted by `weights` (B, n).

    The weights of a row need not sum to 1; NaN if they sum to 0.
    """
    return (weights.unsqueeze(2) * points).sum(1) / weights.sum(1, keepdim=True)


def padded(rows: Tensor, value: float) -> Tensor:
    """Return rows (n, ...) with rows of `value` appended, in a new tensor.

    The number of all rows is then the least power of two that is at least n and at least 256.
    """
    n = len(rows)
    slots = max(MIN_SLOTS, 1 << (n - 1).bit_length())
    return torch.cat([rows, torch.full((slots - n, *rows.shape[1:]), value)])


@dataclass(eq=False, repr=False, kw_only=True)
class UmapReducer(Reducer):
    """Embed traces by UMAP, without labels, within the time of a retrain.

    `fit` starts anew. `train` goes on from the embedding of the last training, as long as at least
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
        Epochs of every training. By default `fit` takes 200. `train` takes those that are missing
        to the first 200, and later 240,000 / n but at least 60; in both cases at most 200, and at
        most 400,000 / n, which bounds its time.
    random_state : int, RandomState or None, default 0
        Seed of the negative samples, and of the noise on the points from which a layout starts.

    Attributes
    ----------
    embedding_ : Tensor of float32, shape (n, n_components)
        Points of the traces of the last training.
    n_epochs_ : int
        Epochs since the spectral start.
    n_steps_left_ : int
        Epochs that are missing to the 200 that a layout needs from a spectral start. If there are
        some, an engine without a product trains again without waiting for new labels.

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
        """Compute a UMAP layout of traces anew, in `n_epochs` epochs, by default 200.

        The layout has a point for each trace. Earlier trainings are discarded.

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
            If a parameter is out of its range, `random_state` gives no seed, or there are
            `n_neighbors` or `n_components` traces or fewer.
        TraceError, ValueError, TypeError
            If X is not of one of these shapes or sparse, a value is not finite, or all samples are
            below 1e-12 but not all are 0 (`check_traces`).
        """
        traces = self._check(X, reset=True)
        self._initialize(traces)
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
        """Compute a layout of traces X (n, C, T), and embed by it from now on; return its points.

        The layout has a point for each trace. A new module `encoder_` places later traces among
        these. `numbers` (n,), the increasing numbers of the labels, identify the traces from
        training to training; labels and folds are not read. If at least half of the traces were in
        the last layout, the new one goes on from it. Otherwise, or without `numbers`, it starts
        anew. If none of the traces was in the last search of neighbours, or without `numbers`, a
        new seed is drawn as well, and the frames, sums of samples between which distances are
        measured, are set up anew.

        `n_epochs_due` epochs are taken, or fewer if `stop` (a limit on their number, a deadline, or
        both) ends them; after its deadline at most ten more are taken. What `precompute` found is
        used, unless seed and frames are new, and then dropped. The points are float32 (n,
        n_components) and share their memory with `embedding_`. Raises the errors of `check_traces`,
        and SettingError for a parameter out of its range, a `random_state` that gives no seed, or
        too few traces.
        """
        traces = self._check(X, reset=not self._is_fitted)
        if numbers is None or not self._has_searched_any(numbers):
            self._initialize(traces)
        self._train(traces, numbers, stop or StopRule())
        return as_points(self.embedding_.numpy())

    def n_epochs_due(self, n_traces: int) -> int:
        """Return the number of epochs that the next `train` takes on `n_traces` traces.

        If `n_epochs` was given, it is that, without a limit. Otherwise it is the number of epochs
        that are missing to the 200 that a first layout needs; if none is missing, it is 240,000 /
        n_traces but at least 60. Either of these numbers is then limited to 200, and to 400,000 /
        n_traces but at least 1; quotients are rounded down. `train` takes fewer if its `stop` ends
        it, and counts the first 200 from 0 again if more than half of its traces are new or it gets
        no numbers (of their labels, which identify them). Before the first training or `precompute`
        (the search of neighbours in advance) AttributeError is raised, unless `n_epochs` was given.
        """
        if self.n_epochs is not None:
            return self.n_epochs
        largest = min(MAX_EPOCHS, max(1, MAX_WORK // n_traces))
        return min(self.n_steps_left_ or max(MIN_EPOCHS, WORK // n_traces), largest)

    def precompute(self, X: Floats, numbers: Ints | None = None) -> None:
        """Search the neighbours of traces X (n, C, T), and keep them for the next training.

        `train` finds them again by `numbers`, the numbers of the traces' labels; without numbers
        nothing is done. Before the first training each call also sets the shape, draws the seed and
        sets up new frames, the sums of samples between which distances are measured. Raises the
        errors of `check_traces`, and SettingError for a parameter out of its range, a
        `random_state` that gives no seed, or too few traces.
        """
        if numbers is None:
            return
        traces = self._check(X, reset=not self._is_fitted)
        if not self._is_fitted:
            self._initialize(traces)
        self.precomputed_neighbors_: Neighbors | None = self.neighbors_.update(
            traces, numbers, self.make_frames_
        )

    @property
    def _is_fitted(self) -> bool:
        return "encoder_" in vars(self)

    def _has_searched_any(self, numbers: Ints) -> bool:
        """Return whether one of these traces was in the last search of neighbours.

        The traces are identified by the numbers of their labels, `numbers`. The last search is that
        of `precompute`, if no training came after it, else that of the last training. False if
        there was none.
        """
        if "neighbors_" not in vars(self):
            return False
        return bool(
            np.isin(numbers, (self.precomputed_neighbors_ or self.neighbors_).numbers).any()
        )

    def _initialize(self, traces: Floats) -> None:
        """Discard all trainings, draw the seed, and set up the frames of traces (n, C, T).

        `random_state` gives the seed; the counters of epochs become 0. A frame is the scaled sum of
        a short stretch of samples. The number of frames of a trace and their centre and scale come
        from at most 256 of the traces, evenly spaced. An earlier `encoder_`, the module that
        embeds, stays until the next training replaces it. Raises SettingError for a `random_state`
        that gives no seed (another type, a negative number or one above 2**32 - 1).
        """
        sample = traces[:: 1 + len(traces) // CHUNK]
        self.make_frames_ = frames_for(sample)
        self.make_frames_.learn(torch.from_numpy(sample))
        self.seed_ = draw_seed(self.random_state)
        self.neighbors_ = Neighbors.empty(self.make_frames_.n_features, self.n_neighbors - 1)
        self.precomputed_neighbors_ = None
        self.embedding_ = torch.zeros(0, self.n_components)
        self.n_epochs_ = 0
        self.n_steps_ = 0

    def _train(
        self,
        traces: Floats,
        numbers: Ints | None,
        stop: StopRule,
        n_epochs: int | None = None,
    ) -> None:
        """Compute a layout of traces (n, C, T), and embed by it from now on.

        `numbers` (n,), the increasing numbers of the labels, identify the traces. It finds
        neighbours (from those of `precompute` or of the last training), joins them to a graph, and
        moves the points of the traces for `n_epochs` epochs (None: `n_epochs_due`), or fewer if
        `stop`, a limit on their number or a deadline, ends them. Without numbers all traces count
        as new. If more than half of them are new, the layout starts anew, and `n_epochs_` from 0.
        Neighbours, points and `encoder_`, the module that embeds, are replaced, what `precompute`
        found is dropped, and the counters of epochs grow. Noise and negative samples (random points
        that repel) follow from `seed_` and `n_steps_`. Raises ValueError for a negative seed.
        """
        if numbers is None:
            numbers = np.arange(-len(traces), 0)  # numbers that no label has
        rng = np.random.default_rng([self.seed_, self.n_steps_])
        generator = torch.Generator().manual_seed(int(rng.integers(2**63)))
        last_neighbors = self.precomputed_neighbors_ or self.neighbors_
        neighbors = last_neighbors.update(traces, numbers, self.make_frames_)
        graph = fuzzy_simplicial_set(
            neighbors.indices, membership_strengths(neighbors.distances, self.n_neighbors)
        )
        points = self._starting_points(neighbors, graph, rng)
        n_epochs = n_epochs or self.n_epochs_due(len(traces))
        points, n_taken = optimize_layout(points, graph, self.min_dist, n_epochs, stop, generator)
        self._set_references(neighbors, points)
        self.n_new_steps_ = n_taken
        self.n_epochs_ += n_taken
        self.n_steps_ += n_taken

    def _starting_points(
        self,
        neighbors: Neighbors,
        graph: csr_matrix,
        rng: Generator,
    ) -> Tensor:
        """Return the points (n, n_components), float32, at which a layout starts.

        `neighbors` and `graph` are those of the n traces; `rng` draws the noise. If at least half
        of the traces were in the last training, these start at their last points, and a new trace
        starts where the last `encoder_` puts it, plus noise with a standard deviation of 0.0001.
        Otherwise all start at the points of `spectral_start` (from eigenvectors of the graph), and
        `n_epochs_` becomes 0.
        """
        last_rows = self.neighbors_.rows_of(neighbors.numbers)
        is_old = last_rows >= 0
        if 2 * is_old.sum() < len(last_rows):
            self.n_epochs_ = 0
            return spectral_start(graph, neighbors.frames, self.n_components, rng)
        points = torch.empty(len(last_rows), self.n_components)
        points[is_old] = self.embedding_[last_rows[is_old]]
        chunks = torch.split(neighbors.frames[~is_old], CHUNK)
        new_points = torch.cat([self.encoder_.embed_frames(frames) for frames in chunks])
        noise = rng.normal(scale=NOISE, size=new_points.shape)
        points[~is_old] = new_points + torch.from_numpy(noise).float()
        return points

    def _set_references(self, neighbors: Neighbors, points: Tensor) -> None:
        """Make traces and their points (n, n_components) the references of a new `encoder_`.

        `encoder_` is the module that embeds: it places a trace among its references. `neighbors`
        holds the frames (scaled sums of samples) of the traces and their nearest neighbours. This
        replaces `neighbors_`, `embedding_` (the points) and `encoder_`, and drops what `precompute`
        found.
        """
        self.neighbors_ = neighbors
        self.precomputed_neighbors_ = None
        self.embedding_ = points
        self.encoder_ = UmapEncoder(
            self.make_frames_, neighbors.frames, points, self.n_neighbors, self.min_dist
        ).eval()

    def embed(self, X: Floats) -> Floats:
        """Embed traces (n, T) or (n, C, T) among the references; return float32 (n, 1, d).

        Raises NotFittedError before a fit, and the errors of `check_traces`, such as ValueError for
        traces of another shape.
        """
        return embed_in_chunks(self.module(), torch.from_numpy(self.check_traces(X)), CHUNK)

    def untrained_module(self, X: Floats) -> UmapEncoder:
        """Return a module that can be compiled before the training on traces X (n, C, T).

        After a first training it is the present `encoder_` itself, the module that embeds. Before,
        it is a new one, whose references (the traces among which it places others) are all 0; no
        parameter is checked for it, and nothing is kept.
        """
        if self._is_fitted:
            return self.encoder_
        n = max(len(X), self.n_neighbors + 1)
        make_frames = frames_for(X)
        return UmapEncoder(
            make_frames,
            torch.zeros(n, make_frames.n_features),
            torch.zeros(n, self.n_components),
            self.n_neighbors,
            self.min_dist,
        ).eval()

    def module(self) -> UmapEncoder:
        """Return the present `encoder_` itself, (B, C, T) -> (B, 1, d).

        Later trainings replace it and do not change it. Raises NotFittedError before a fit.
        """
        check_is_fitted(self, "encoder_")
        return self.encoder_

    @property
    def n_steps_left_(self) -> int:
        """Return how many epochs the first layout still lacks, or 0.

        That is 200, or `n_epochs` if given, less `n_epochs_`.
        """
        return max(0, self._n_first_epochs - self.n_epochs_)

    @property
    def _n_first_epochs(self) -> int:
        """Return the epochs that a first layout needs: `n_epochs`, or 200 if that is None."""
        return FIRST_EPOCHS if self.n_epochs is None else self.n_epochs

    @property
    def report(self) -> FitReport:
        """Return the report of the last training: its epochs, and the epochs that are missing.

        A first layout, which starts from eigenvectors of the graph, takes 200 epochs (or
        `n_epochs`), in one training or in several. Raises NotFittedError before a fit.
        """
        check_is_fitted(self, "encoder_")
        return FitReport(self.n_new_steps_, n_steps_left=self.n_steps_left_)

    def get_state(self) -> State:
        """Return arrays from which `set_state` restores the reducer bit for bit, by name.

        They are the shape of the traces, the centre and scale of the frames (the scaled sums of
        samples between which distances are measured), the seed, and the counts of frames and
        epochs. Of the traces of the last training they are the numbers of the labels, the frames,
        the neighbours and their distances, and the points. Not all of them are copies. Neighbours
        that `precompute` found are not among them. Raises NotFittedError before a fit.
        """
        check_is_fitted(self, "encoder_")
        return module_state(self.make_frames_, "frames.") | {
            "shape": np.array(self.trace_shape_),
            "counts": np.array(
                [
                    self.make_frames_.n_frames,
                    self.seed_,
                    self.n_epochs_,
                    self.n_steps_,
                    self.n_new_steps_,
                ]
            ),
            "numbers": self.neighbors_.numbers,
            "references": self.neighbors_.frames.numpy(),
            "neighbors": self.neighbors_.indices.numpy().astype(np.int32),
            "distances": self.neighbors_.distances.numpy(),
            "embedding": self.embedding_.numpy(),
        }

    def set_state(self, state: Arrays) -> Self:
        """Restore what `get_state` returned, and return self.

        The constructor's parameters must be the same; they are not compared with the state. What
        `precompute` found in advance for the next training is dropped. Raises StoreError if the
        arrays of `Frames`, the module that shortens traces, are missing or have other sizes than
        the shape of the traces in `state` asks for, and KeyError if another array is missing; the
        reducer may be partly changed by then.
        """
        channels, samples = self.restore_shape(state)
        n_frames, *counts = map(int, state["counts"])
        self.seed_, self.n_epochs_, self.n_steps_, self.n_new_steps_ = counts
        self.make_frames_ = Frames(channels, samples, n_frames)
        restore(self.make_frames_, arrays_with_prefix(state, "frames."))
        self._set_references(
            Neighbors(
                numbers=np.array(state["numbers"]),
                frames=torch.from_numpy(np.array(state["references"])),
                indices=torch.from_numpy(state["neighbors"].astype(np.int64)),
                distances=torch.from_numpy(np.array(state["distances"])),
            ),
            torch.from_numpy(np.array(state["embedding"])),
        )
        return self

    def _check(self, X: ArrayLike, reset: bool) -> Floats:
        """Check traces and parameters; return the traces as float32 (n, C, T).

        With `reset` the traces set the shape that later ones must have, even if a parameter is
        refused.

        Raises SettingError for a parameter out of its range, or too few traces, and the errors of
        `check_traces`. n_components must be an integer from 1 to 100, n_neighbors from 2 to 1000,
        and there must be more traces than either. min_dist is from 0 to 1, n_epochs an integer from
        1 to 10**6 or None.
        """
        traces = self.check_traces(X, reset=reset)
        check_integers(self, n_components=(1, 100), n_neighbors=(2, 1000))
        expect(
            is_number(self.min_dist) and 0.0 <= self.min_dist <= 1.0,
            "min_dist from 0 to 1",
            self.min_dist,
        )
        epochs = self.n_epochs
        expect(epochs is None or is_whole(epochs, 1, 10**6), "n_epochs of 1 or more", epochs)
        smallest = max(self.n_neighbors, self.n_components)
        if len(traces) <= smallest:
            raise SettingError(
                f"UMAP needs more than {smallest} traces, got n_samples = {len(traces)}."
            )
        return traces
