"""Counting known successes and failures around a query: exact, growing by one label at a time, in K spaces at once.

    >>> index = RadiusIndex(dim=2, capacity=10_000)
    >>> index.add(points, labels, spaces)
    >>> n_success, n_failure = index.count(queries, radius=0.3)

Brute force over at most `capacity` points takes tens of microseconds, needs no rebuilding, and scripts to TorchScript:
one implementation counts in the engine, in the scikit-learn classifier and in the exported file. Points and queries
are float32, as embeddings are, and so are the distances.
"""

import hashlib
from collections.abc import Mapping
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn

Counts = tuple[NDArray[np.int64], NDArray[np.int64]]


class ReferenceRing(nn.Module):
    """A bounded block of labelled points; the oldest leaves first, whatever its label.

    points (d, capacity) float32, one row a dimension; labels (2, capacity) float32, ones, and 1.0 or 0.0;
    spaces (capacity,) int64; total () int64, points ever added.
    """

    points: Tensor
    labels: Tensor
    spaces: Tensor
    total: Tensor

    def __init__(self, dim: int, capacity: int) -> None:
        super().__init__()
        self.dim = dim
        self.capacity = capacity
        self.register_buffer("points", torch.zeros(dim, capacity))
        self.register_buffer("labels", torch.ones(2, capacity))
        self.register_buffer("spaces", torch.zeros(capacity, dtype=torch.int64))
        self.register_buffer("total", torch.zeros((), dtype=torch.int64))

    @torch.jit.export
    def size(self) -> int:
        """Points held."""
        return min(int(self.total.item()), self.capacity)

    @torch.jit.export
    def put(self, point: Tensor, label: float, space: int) -> None:
        """Add one point (d,) of space `space`; on a full block it takes the oldest one's place."""
        total = int(self.total.item())
        slot = total % self.capacity
        self.points[:, slot] = point
        self.labels[1, slot] = label
        self.spaces[slot] = space
        self.total.fill_(total + 1)

    @torch.jit.export
    def squared_distances(self, z: Tensor) -> Tensor:
        """(K, d) one query in every space -> (size,) squared distance to each point, in that point's own space."""
        n = self.size()
        own = z.t()  # (d, K)
        if z.size(0) > 1:
            own = own.index_select(1, self.spaces[:n])  # (d, size): a reference of fold k is met in space k only
        return (self.points[:, :n] - own).square_().sum(0)

    @torch.jit.export
    def count_near(self, distances: Tensor, radius: float, fraction: float) -> tuple[int, int]:
        """(successes, failures) within `radius`, or, where 0 < fraction, among that fraction of the points, nearest first.

        The fraction is rounded up and ties at its edge are all counted, so that no order of the points matters.
        """
        n = distances.size(0)
        if n == 0:
            return 0, 0
        limit = radius * radius
        if fraction > 0.0:
            limit = float(distances.kthvalue(min(n, int(math_ceil(fraction * n))))[0].item())
            if not limit < float("inf"):
                return 0, 0  # beyond all measure: at an infinite distance every reference would tie
        inside = distances.clone().le_(limit)  # 1.0 or 0.0, without a mask in between
        counts: list[float] = torch.mv(self.labels[:, :n], inside).tolist()  # exact below 2**24 points
        return int(counts[1]), int(counts[0]) - int(counts[1])


def math_ceil(x: float) -> int:
    """Smallest integer not below x; `math.ceil` under a name that scripts in a method."""
    whole = int(x)
    return whole if x <= float(whole) else whole + 1


class RadiusIndex:
    """Labelled points in K spaces, and counts around queries.

    dim : dimension d of a point.  capacity : points held at most; the oldest leave first, blind to labels.
    """

    def __init__(self, dim: int, capacity: int = 10_000) -> None:
        self.ring = ReferenceRing(dim, capacity)

    def __len__(self) -> int:
        return self.ring.size()

    @property
    def dim(self) -> int:
        """Dimension of a point."""
        return self.ring.dim

    @property
    def capacity(self) -> int:
        """Points held at most."""
        return self.ring.capacity

    @property
    def points(self) -> NDArray[np.float32]:
        """(n, d) the points held, in the order of their places in the block."""
        return self.ring.points[:, : len(self)].numpy().T

    @property
    def labels(self) -> NDArray[np.int8]:
        """(n,) 1 success, 0 failure, in the order of `points`."""
        return self.ring.labels[1, : len(self)].numpy().astype(np.int8)

    @property
    def spaces(self) -> NDArray[np.int64]:
        """(n,) the space each point lives in, in the order of `points`."""
        return self.ring.spaces[: len(self)].numpy()

    def add(self, points: ArrayLike, labels: ArrayLike, spaces: ArrayLike | None = None) -> None:
        """Add points (n, d) with labels (n,), 1 = success, 0 = failure, and the space each lives in (all 0 if None)."""
        z, y = np.array(points, dtype=np.float32), np.array(labels, dtype=np.float32)  # copies: torch needs writable ones
        k = np.zeros(len(z), dtype=np.int64) if spaces is None else np.asarray(spaces, dtype=np.int64)
        if z.ndim != 2 or z.shape[1] != self.dim or y.shape != (len(z),) or k.shape != (len(z),):
            raise ValueError(
                f"Expected points (n, {self.dim}) with n labels and n spaces, got {z.shape}, {y.shape} and {k.shape}."
            )
        ring, total = self.ring, int(self.ring.total)
        keep = slice(max(0, len(z) - ring.capacity), None)  # of more than fit, the newest
        slots = (total + np.arange(len(z))[keep]) % ring.capacity
        ring.points[:, slots] = torch.from_numpy(z[keep].T)
        ring.labels[1, slots] = torch.from_numpy(y[keep])
        ring.spaces[slots] = torch.from_numpy(k[keep])
        ring.total.fill_(total + len(z))

    def count(self, queries: ArrayLike, radius: float, fraction: float = 0.0) -> Counts:
        """(n_success, n_failure), each (n,): labels around each query (n, d), or (n, K, d) for K spaces.

        radius : of the ball, its surface included.
        fraction : where positive, the ball grows instead until it holds this share of all points.
        """
        z = torch.from_numpy(np.array(queries, dtype=np.float32))
        z = z[:, None, :] if z.dim() == 2 else z  # (n, K, d)
        n_success, n_failure = np.zeros(len(z), dtype=np.int64), np.zeros(len(z), dtype=np.int64)
        for i in range(len(z)):
            n_success[i], n_failure[i] = self.ring.count_near(self.ring.squared_distances(z[i]), radius, fraction)
        return n_success, n_failure

    def get_state(self) -> dict[str, NDArray[Any]]:
        """Plain arrays, copies: points (d, n), labels (n,), spaces (n,), and total, points ever added."""
        points, labels, spaces = self.points.T.copy(), self.labels, self.spaces.copy()
        return {"points": points, "labels": labels, "spaces": spaces, "total": self.ring.total.numpy().copy()}

    @classmethod
    def from_state(cls, state: Mapping[str, NDArray[Any]], capacity: int) -> Self:
        """The index that `get_state` was taken from: the same points in the same places."""
        index = cls(len(state["points"]), capacity)
        ring, n = index.ring, state["points"].shape[1]
        ring.points[:, :n] = torch.from_numpy(np.array(state["points"]))
        ring.labels[1, :n] = torch.from_numpy(np.array(state["labels"], dtype=np.float32))
        ring.spaces[:n] = torch.from_numpy(np.array(state["spaces"]))
        ring.total.fill_(int(state["total"]))
        return index

    def digest(self) -> str:
        """SHA-256 of what is held: points as (d, n) float32, labels as float32, spaces as int64, one after the other."""
        parts = self.points.T, self.labels.astype(np.float32), self.spaces
        return hashlib.sha256(b"".join(np.ascontiguousarray(part).tobytes() for part in parts)).hexdigest()
