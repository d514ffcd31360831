"""Labelled reference points, and the counts of labels within a radius of a query: `RadiusIndex`
holds the points, and `label_agreement` says how much repeated labels of one part are worth. The
engine's model, the scikit-learn classifier and the exported file count by it.

    >>> index = RadiusIndex(dim=2, capacity=10_000)
    >>> index.add(points, labels, spaces)
    >>> n_success, n_failure = index.count_near(index.squared_distances(query), radius=0.3)

The search is brute force in float32. It takes tens of microseconds and compiles to TorchScript, so
one implementation counts in the engine, in the scikit-learn classifier and in the exported file.

Trials must be independent to be counted. A part is known by a hash of its number, or of its trace.
Its own references have no vote on it, and m references of one part are worth m / (1 + (m - 1) rho)
votes, where rho is an upper confidence bound on the intraclass correlation of its labels, and 1
while few parts came twice.

References: Kish (1965), Survey Sampling, the design effect; Rao and Scott (1992), Biometrics 48,
for counts of clusters.
"""

import hashlib
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn

from ..records import Arrays, Floats, Ints, State

FEWEST_PARTS = 20  # that came at least twice; fewer say nothing about agreement
N_NEIGHBOURS = 30  # of other parts, whose labels say what is usual around a point
SAMPLE = 3000  # newest points that are looked at: the work does not grow
COLUMNS = ("points", "labels", "spaces", "parts", "numbers")  # of an index, by `column`
CONFIDENCE = 1.645  # standard errors above the estimate: 95 %, one-sided


def label_agreement(
    points: NDArray[np.float32],
    labels: NDArray[np.int8],
    spaces: Ints,
    parts: Ints,
) -> float:
    """Bound from above how strongly the labels of one part agree: their intraclass correlation.

    It is computed after the success rate among the 30 nearest points of other parts in the same
    space is subtracted from each label (`_success_rate_around`), because neighbouring parts agree
    as well.

    Parameters
    ----------
    points : array of float32, shape (n, d)
        Reference points. The work grows with the square of their number.
    labels : array of int, shape (n,)
        1 is success, 0 is failure.
    spaces : array of int64, shape (n,)
        Embedding space of each point, the number of the encoder that embedded it; all points of a
        part are in one space.
    parts : array of int64, shape (n,)
        Hash of each point's part; 0 for an unknown part.

    Returns
    -------
    float
        Upper confidence bound on the intraclass correlation, one-sided at 95 %, from 0 to 1; 1 if
        fewer than 20 (`FEWEST_PARTS`) known parts are among these points at least twice.
    """
    _, part, n_times = np.unique(parts, return_inverse=True, return_counts=True)
    is_repeated = (n_times[part] > 1) & (parts != 0)
    repeated = part[is_repeated]
    if len(np.unique(repeated)) < FEWEST_PARTS:
        return 1.0
    residuals = np.zeros(len(labels))
    for space in np.unique(spaces):
        rows = np.flatnonzero(spaces == space)
        residuals[rows] = labels[rows] - _success_rate_around(
            points[rows], labels[rows], part[rows]
        )
    residuals = residuals[is_repeated]
    sums, squares, m = (
        np.bincount(repeated, weights, len(n_times)) for weights in (residuals, residuals**2, None)
    )
    products = sums**2 - squares  # of the residuals of different points of one part
    n_pairs = m * (m - 1.0)
    variance = (residuals**2).mean()
    rho = products.sum() / (n_pairs.sum() * variance)
    deviations = products / variance - rho * n_pairs
    error = np.sqrt((deviations**2).sum()) / n_pairs.sum()
    return float(np.clip(rho + CONFIDENCE * error, 0.0, 1.0))


def _success_rate_around(
    points: NDArray[np.float32], labels: NDArray[np.int8], part: Ints
) -> Floats:
    """Return for each point the success rate among the nearest points of other parts, float64 (n,).

    `points` are (n, d), of one embedding space; `labels` (n,) are 1 for success, 0 for failure;
    `part` (n,) is a number that is the same for all points of a part. The 30 nearest points are
    taken (`N_NEIGHBOURS`), or all if there are fewer. Half a success in one trial is added to the
    counts: the rate is one half without points of other parts. All unknown parts share one value of
    `part` and so count as one part.
    """
    from scipy.spatial.distance import cdist

    distances = cdist(points, points, "sqeuclidean")
    distances[part[:, None] == part] = np.inf
    k = min(N_NEIGHBOURS, len(points) - 1)
    nearest = np.argpartition(distances, k - 1, axis=1)[:, :k]
    others = np.take_along_axis(distances, nearest, axis=1) < np.inf
    return np.asarray(((labels[nearest] * others).sum(1) + 0.5) / (others.sum(1) + 1.0))


class RadiusIndex(nn.Module):
    """A bounded block of labelled points in K embedding spaces that counts labels around queries.

    In the engine, space k holds the points of the traces in fold k, embedded by the encoder that
    was trained without the labels of fold k. A point's position in the block is its slot. When the
    block is full, the oldest point leaves first, whatever its label. `put`, `squared_distances` and
    `count_near` compile to TorchScript; `numbers` and what uses it stay in Python.

    Parameters
    ----------
    dim : int
        Dimension d of a point.
    capacity : int, default 10000
        Largest number of points.

    Attributes
    ----------
    points : Tensor of float32, shape (d, capacity)
    labels : Tensor of float32, shape (2, capacity)
        A row of ones, and a row of 1.0 (success) or 0.0: one product counts both.
    spaces : Tensor of int64, shape (capacity,)
        Embedding space of each point.
    parts : Tensor of int64, shape (capacity,)
        Hash of each point's part; 0 for an unknown part.
    repeats : Tensor of int64, shape ()
        Number of points of known parts, less the number of these parts.
    agreement : Tensor of float64, shape ()
        How strongly repeated labels of a part agree, see `label_agreement`.
    total : Tensor of int64, shape ()
        Number of points ever added.
    numbers : array of int64, shape (capacity,)
        Sequence number of each point's label, 0 if there is none.
    """

    points: Tensor
    labels: Tensor
    spaces: Tensor
    parts: Tensor
    repeats: Tensor
    agreement: Tensor
    total: Tensor

    def __init__(self, dim: int, capacity: int = 10_000) -> None:
        super().__init__()
        self.dim = dim
        self.capacity = capacity
        buffers = {
            "points": torch.zeros(dim, capacity),
            "labels": torch.ones(2, capacity),
            "spaces": torch.zeros(capacity, dtype=torch.int64),
            "parts": torch.zeros(capacity, dtype=torch.int64),
            "repeats": torch.zeros((), dtype=torch.int64),
            "agreement": torch.ones((), dtype=torch.float64),
            "total": torch.zeros((), dtype=torch.int64),
        }
        for name, buffer in buffers.items():
            self.register_buffer(name, buffer)
        self.numbers = np.zeros(capacity, dtype=np.int64)

    def __len__(self) -> int:
        return self.size()

    def column(self, name: str) -> NDArray[Any]:
        """Return one attribute of the n points in the index, in the order of their slots.

        A slot is the position of a point. Until the index is full the slots are in the order of
        age; then new points overwrite the oldest ones.

        Parameters
        ----------
        name : {"points", "labels", "spaces", "parts", "numbers"}

        Returns
        -------
        array, shape (n,); for "points" (n, d)
            Labels are a copy, int8, 1 for success; the other attributes are views of the index: the
            points, the number of each point's embedding space, the hash of its part, and the
            sequence number of its label.
        """
        block = self.numbers if name == "numbers" else getattr(self, name).numpy()
        values: NDArray[Any] = block[..., : self.size()]
        if name == "points":
            return values.T
        return values[1].astype(np.int8) if name == "labels" else values

    @torch.jit.export
    def size(self) -> int:
        """Return the number of points in the index, which is at most `capacity`."""
        return min(int(self.total.item()), self.capacity)

    @torch.jit.export
    def put(self, point: Tensor, label: float, space: int, part: int = 0) -> None:
        """Add one point; in a full index it replaces the oldest.

        The sequence number of its label, in `numbers`, is not set; `add_one` sets it. All other
        attributes of the index are updated, except `agreement` (how strongly the labels of one part
        agree).

        Parameters
        ----------
        point : Tensor of float32, shape (d,)
        label : float
            1.0 is success, 0.0 is failure.
        space : int
            Embedding space of the point, from 0 to K - 1: which of a query's K embeddings it is
            compared with.
        part : int, default 0
            Hash of its part; 0 for an unknown part.
        """
        total = int(self.total.item())
        slot = total % self.capacity
        self.points[:, slot] = point
        self.labels[1, slot] = label
        self.spaces[slot] = space
        self.repeats.sub_(int(self.shares_part(slot)))
        self.parts[slot] = part
        self.repeats.add_(int(self.shares_part(slot)))
        self.total.fill_(total + 1)

    def shares_part(self, slot: int) -> bool:
        """Return whether another point is of the same known part as the point in this slot."""
        part = int(self.parts[slot].item())
        return part != 0 and int((self.parts == part).sum().item()) > 1

    @torch.jit.export
    def squared_distances(self, z: Tensor, part: int = 0) -> Tensor:
        """Return the squared distance from a query to each point, in the point's embedding space.

        Parameters
        ----------
        z : Tensor of float32, shape (K, d)
            One query, embedded in every space: by K encoders, each of which never saw the labels of
            the points in its space. A single row is compared with all points, whatever their space.
        part : int, default 0
            Hash of the part that the query is of; points of this part get an infinite distance. 0
            excludes none.

        Returns
        -------
        Tensor of float32, shape (n,)
            In the order of the slots, the positions of the points in the index; shape (0,) for an
            empty index.
        """
        n = self.size()
        query = z.t()  # (d, K)
        if z.size(0) > 1:
            query = query.index_select(1, self.spaces[:n])  # (d, n): in each point's own space
        distances = (self.points.narrow(1, 0, n) - query).square_().sum(0)
        if part != 0:
            distances.masked_fill_(self.parts[:n] == part, float("inf"))
        return distances

    @torch.jit.export
    def count_near(self, distances: Tensor, radius: float) -> tuple[int, int]:
        """Count the labels within a radius; several points of one part may count as fewer.

        Parameters
        ----------
        distances : Tensor of float32, shape (n,)
            Squared, as of `squared_distances`.
        radius : float
            Not squared. A point at this distance counts.

        Returns
        -------
        n_success, n_failure : int
            (0, 0) for an empty index. If any part in the index came more than once, the m points of
            one part count as one to m votes, depending on how strongly labels of a part agree
            (`count_votes`), and the sums are rounded to whole numbers.
        """
        limit = radius * radius
        if int(self.repeats.item()) > 0:
            return self.count_votes(distances <= limit)
        # In float32, as the product takes it; the sums are exact below 2**24 points.
        inside = torch.le(distances, limit, out=torch.empty_like(distances))
        labels = self.labels.narrow(1, 0, distances.size(0))
        counts: list[float] = torch.mv(labels, inside).tolist()
        return int(counts[1]), int(counts[0]) - int(counts[1])

    def count_votes(self, inside: Tensor) -> tuple[int, int]:
        """Count the points `inside`, (n,) bool; several points of one part may count as fewer.

        m of them that are of one part are worth m / (1 + (m - 1) * `agreement`) votes; the
        attribute, from 0 to 1, says how strongly labels of one part agree: one vote if the labels
        of a part always agree, m votes if they are independent. A point of an unknown part is one
        vote. Returns (successes, failures), each rounded to a whole number, because bounds need
        whole trials.
        """
        slots = inside.nonzero().flatten()
        parts = self.parts.index_select(0, slots)
        _, inverse, n_points = torch.unique(parts, return_inverse=True, return_counts=True)
        m = n_points.index_select(0, inverse).masked_fill_(parts == 0, 1).to(torch.float64)
        worth = 1.0 / (1.0 + (m - 1.0) * self.agreement)
        successes = float((worth * self.labels[1].index_select(0, slots)).sum().item())
        failures = float(worth.sum().item()) - successes
        return int(successes + 0.5), int(failures + 0.5)

    def add_one(
        self, point: Tensor, label: float, space: int, part: int = 0, number: int = 0
    ) -> None:
        """Add one point, like `put`, and set the sequence number of its label in `numbers`."""
        self.numbers[int(self.total) % self.capacity] = number
        self.put(point, label, space, part)

    def renumber(self, old: int, new: int) -> None:
        """Change the sequence number of a label; nothing happens if its point has left."""
        self.numbers[self.numbers == old] = new

    def add(
        self,
        points: ArrayLike,
        labels: ArrayLike,
        spaces: ArrayLike | None = None,
        parts: ArrayLike | None = None,
        numbers: ArrayLike | None = None,
    ) -> None:
        """Add many points, the first row as the oldest; in a full index they replace the oldest.

        `agreement` (how strongly the labels of one part agree) is not computed anew, see
        `estimate_agreement`. `total`, the number of points ever added, grows by n, also if fewer
        rows are added.

        Parameters
        ----------
        points : array, shape (n, d)
            If there are more than `capacity` rows, only the last ones are added.
        labels : array, shape (n,)
            1 is success, 0 is failure; not checked.
        spaces : array of int, shape (n,), optional
            Number of each point's embedding space; the points of one space come from one copy of
            the model. 0 if None.
        parts : array of int64, shape (n,), optional
            Hash of each point's part; unknown parts (0) if None.
        numbers : array of int64, shape (n,), optional
            Sequence numbers of the labels; 0 if None.

        Raises
        ------
        ValueError
            For other shapes; nothing is added then.
        """
        z = torch.tensor(np.asarray(points, dtype=np.float32))
        blocks = (self.labels[1], self.spaces, self.parts, torch.from_numpy(self.numbers))
        columns = [
            torch.tensor(np.zeros(z.shape[:1]) if values is None else np.asarray(values))
            for values in (labels, spaces, parts, numbers)
        ]
        if z.shape[1:] != (self.dim,) or any(column.shape != z.shape[:1] for column in columns):
            shapes = ", ".join(str(tuple(values.shape)) for values in (z, *columns))
            raise ValueError(
                f"Expected points (n, {self.dim}) with n labels, n spaces, n parts and n numbers, "
                f"got {shapes}."
            )
        newest = slice(-self.capacity, None)
        slots = (int(self.total) + torch.arange(len(z)))[newest] % self.capacity
        self.points[:, slots] = z[newest].T
        for block, column in zip(blocks, columns, strict=True):
            block[slots] = column[newest].to(block.dtype)
        self.total.add_(len(z))
        all_parts = self.column("parts")
        known = all_parts[all_parts != 0]
        self.repeats.fill_(len(known) - len(np.unique(known)))

    def relabel(self, number: int, part: int, label: int | None) -> bool:
        """Change the label of the point with a number, or remove the point.

        `agreement`, the estimate of how strongly repeated labels of a part agree, is not computed
        anew.

        Parameters
        ----------
        number : int
            Sequence number of the point's label.
        part : int
            Hash of the point's part.
        label : int or None
            1 is success, 0 is failure. None removes the point: the other points move to the first
            slots, the oldest first, and `total` becomes their number.

        Returns
        -------
        bool
            False, with nothing changed, if the point with this number is of another part. True if
            the change was made, or if the point has left the index already.
        """
        slots = np.flatnonzero(self.column("numbers") == number)
        if not len(slots):
            return True
        slot = int(slots[0])
        n = len(self)
        if int(self.parts[slot]) != part:
            return False
        if label is not None:
            self.labels[1, slot] = float(label)
            return True
        order = (int(self.total) - n + np.arange(n)) % self.capacity  # oldest first
        columns = [self.column(name)[order[order != slot]] for name in COLUMNS]
        for block in (self.points, self.labels[1], self.spaces, self.parts, self.total):
            block.zero_()
        self.numbers[:] = 0
        self.add(*columns)
        return True

    def estimate_agreement(self) -> None:
        """Set `agreement`, how strongly labels of one part agree, for all counts from now on.

        When the labels near a trace are counted, m labels of one part are worth m / (1 + (m - 1) *
        `agreement`) votes. It is computed from the last 3000 points (`SAMPLE`) in the index, see
        `label_agreement`. Nothing changes if no part has several points in it.
        """
        if int(self.repeats) > 0:
            newest = (self.column(name)[-SAMPLE:] for name in COLUMNS[:4])
            self.agreement.fill_(label_agreement(*newest))

    def get_state(self) -> State:
        """Return copies of the arrays of the index, by name, from which `from_state` restores it.

        `points` is (d, n). `labels` (1 success, 0 failure), `spaces`, `parts` (hashes) and
        `numbers` (of the labels) are (n,), in the order of the points. `agreement` (how strongly
        repeated labels of a part agree) and `total` (points ever added) have no dimension.
        """
        state = {"points": self.column("points").T.copy()}
        state |= {name: self.column(name).copy() for name in COLUMNS[1:]}
        return state | {name: getattr(self, name).numpy().copy() for name in ("agreement", "total")}

    @classmethod
    def from_state(cls, state: Arrays, capacity: int) -> Self:
        """Return a new index for `capacity` points with the points of a state.

        `state` is what `get_state` returned, and is not changed. With the same capacity each point
        has its old position. With a smaller `capacity` the newest points stay, as many as it holds.
        With a larger one the oldest point is at the first position, and `total` (the points ever
        added) no longer counts points that left.
        """
        n = state["points"].shape[1]
        index = cls(len(state["points"]), capacity)
        older = int(state["total"]) - n  # points that left
        index.total.fill_(older if capacity <= n else 0)
        order = (older + np.arange(n)) % max(n, 1)  # oldest first
        index.add(state["points"].T[order], *(state[name][order] for name in COLUMNS[1:]))
        index.agreement.fill_(float(state["agreement"]))
        return index

    def digest(self) -> str:
        """Return the SHA-256 of points, labels and embedding spaces as 64 hexadecimal digits.

        The bytes are points (d, n) float32, labels float32 and spaces int64, one after the other,
        each in the order of the slots, the positions of the points in the index.
        """
        arrays = (
            self.column("points").T,
            self.column("labels").astype(np.float32),
            self.column("spaces"),
        )
        return hashlib.sha256(b"".join(array.tobytes() for array in arrays)).hexdigest()
