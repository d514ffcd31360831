"""Counting known successes and failures around a query: exact, growing by one label at a time, in K spaces at once.

    >>> index = RadiusIndex(dim=2, capacity=10_000)
    >>> index.add(points, labels, spaces)
    >>> n_success, n_failure = index.count(queries, radius=0.3)

Brute force, in float32, takes tens of microseconds and scripts to TorchScript: one implementation counts in the engine, in
the scikit-learn classifier and in the exported file. Trials must be independent to be counted. A part, known by a hash of
its number or of its trace, has no vote on itself, and m trials of it are worth m / (1 + (m - 1) rho): rho, the intraclass
correlation of its labels, is an upper confidence bound, and 1 while few parts came twice.

Sources: Kish (1965), Survey Sampling, the design effect; Rao and Scott (1992), Biometrics 48, for counts of clusters.
"""

import hashlib
from collections.abc import Mapping
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn

FEWEST_PARTS = 20  # that came at least twice; fewer say nothing
NEIGHBOURS = 30  # of other parts, that say what is usual where a trace lies
SAMPLE = 3000  # of the newest points: the work does not grow
FILTER_SIZE = 2**16  # bits, a power of two
CONFIDENCE = 1.645  # standard errors above the estimate: 95 %, one-sided


def label_agreement(
    points: NDArray[np.float32], labels: NDArray[np.int8], spaces: NDArray[np.int64], parts: NDArray[np.int64]
) -> float:
    """Upper bound on the intraclass correlation, in [0, 1], of labels within a part beyond what its place explains.

    points (n, d), labels (n,), spaces (n,), parts (n,) hashes, 0 for a point of no known part; a part lies in one space.
    """
    points, labels, spaces, parts = points[-SAMPLE:], labels[-SAMPLE:], spaces[-SAMPLE:], parts[-SAMPLE:]
    _, part, times = np.unique(parts, return_inverse=True, return_counts=True)
    again = (times[part] > 1) & (parts != 0)
    if len(np.unique(part[again])) < FEWEST_PARTS:
        return 1.0
    rest = np.zeros(len(labels))  # of a label, beyond what its place explains
    for space in np.unique(spaces):
        here = np.flatnonzero(spaces == space)
        rest[here] = labels[here] - _rate_of_others(points[here], labels[here], part[here])
    own, squares, m = (np.bincount(part[again], w, len(times)) for w in (rest[again], rest[again] ** 2, None))
    alike, pairs = own**2 - squares, m * (m - 1.0)  # products of different traces of one part, and their number
    spread = float((rest[again] ** 2).mean())
    rho = float(alike.sum() / (pairs.sum() * spread))
    error = float(np.sqrt(((alike / spread - rho * pairs) ** 2).sum()) / pairs.sum())
    return float(np.clip(rho + CONFIDENCE * error, 0.0, 1.0))


def _rate_of_others(points: NDArray[np.float32], labels: NDArray[np.int8], part: NDArray[np.int64]) -> NDArray[np.float64]:
    """(n,) success rate among the nearest points of other parts; one half where there is none."""
    from scipy.spatial.distance import cdist

    distances = cdist(points, points, "sqeuclidean")
    distances[part[:, None] == part] = np.inf
    k = min(NEIGHBOURS, len(points) - 1)
    nearest = np.argpartition(distances, k - 1, axis=1)[:, :k]
    return np.asarray((labels[nearest].sum(1) + 0.5) / (k + 1.0))


Counts = tuple[NDArray[np.int64], NDArray[np.int64]]


class RadiusIndex(nn.Module):
    """A bounded block of labelled points in K spaces, and counts around queries. The oldest leaves first, blind to labels.

    dim : dimension d of a point.  capacity : points held at most.
    points (d, capacity) float32; labels (2, capacity) float32, ones, and 1.0 or 0.0; spaces (capacity,) int64; parts
    (capacity,) int64 hashes, 0 for no known part; first (capacity,) int64, the slot that a part's votes are gathered in;
    repeats () int64, points of parts that are there already; agreement () float64, `label_agreement`; total () int64,
    points ever added.
    numbers (capacity,) int64 of the labels, 0 for none.  known : hashes of all parts that are held, and of some that
    have left: a query of another part need not be compared. Neither compiles.
    """

    points: Tensor
    labels: Tensor
    spaces: Tensor
    parts: Tensor
    first: Tensor
    repeats: Tensor
    agreement: Tensor
    total: Tensor
    part_filter: Tensor

    def __init__(self, dim: int, capacity: int = 10_000) -> None:
        super().__init__()
        self.dim, self.capacity = dim, capacity
        self.register_buffer("points", torch.zeros(dim, capacity))
        self.register_buffer("labels", torch.ones(2, capacity))
        self.register_buffer("spaces", torch.zeros(capacity, dtype=torch.int64))
        self.register_buffer("parts", torch.zeros(capacity, dtype=torch.int64))
        self.register_buffer("first", torch.arange(capacity))
        self.register_buffer("repeats", torch.zeros((), dtype=torch.int64))
        self.register_buffer("agreement", torch.ones((), dtype=torch.float64))
        self.register_buffer("total", torch.zeros((), dtype=torch.int64))
        self.register_buffer("part_filter", torch.zeros(FILTER_SIZE, dtype=torch.bool))
        self.filter_mask = FILTER_SIZE - 1
        self.numbers = np.zeros(capacity, dtype=np.int64)

    def __len__(self) -> int:
        return self.size()

    def held(self, name: str) -> NDArray[Any]:
        """Of the n points held, in the order of their places: points (n, d), labels (n,), spaces, parts or numbers."""
        block = self.numbers if name == "numbers" else getattr(self, name).numpy()
        held: NDArray[Any] = block[..., : len(self)]
        return held.T if name == "points" else held[1].astype(np.int8) if name == "labels" else held

    @torch.jit.export
    def size(self) -> int:
        """Points held."""
        return min(int(self.total.item()), self.capacity)

    @torch.jit.export
    def put(self, point: Tensor, label: float, space: int, part: int = 0) -> None:
        """Add one point (d,) of space `space` and of `part`; on a full block it takes the oldest one's place."""
        total = int(self.total.item())
        slot = total % self.capacity
        self.points[:, slot] = point
        self.labels[1, slot] = label
        self.spaces[slot] = space
        self.total.fill_(total + 1)
        self.join(slot, part)

    @torch.jit.export
    def join(self, slot: int, part: int) -> None:
        """Make `part` that of a slot that is held, and find the slot in which its votes are gathered."""
        leaving = int(self.parts[slot].item())
        if leaving != 0 and int(self.repeats.item()) > 0:
            same = self.parts == leaving
            if int(same.sum().item()) > 1:  # the leaving part's others stay together
                same[slot] = False
                self.first.masked_fill_(same, int(same.nonzero()[0].item()))
                self.repeats.sub_(1)
        self.parts[slot] = part
        self.first[slot] = slot
        if part != 0:
            self.part_filter[part & self.filter_mask] = True
            same = self.parts == part
            if int(same.sum().item()) > 1:
                self.first.masked_fill_(same, int(same.nonzero()[0].item()))
                self.repeats.add_(1)

    @torch.jit.export
    def squared_distances(self, z: Tensor, part: int = 0) -> Tensor:
        """(K, d) one query in every space -> (size,) squared distance to each point, in that point's own space.

        part : of the query; its own points are infinitely far.
        """
        n = self.size()
        own = z.t()  # (d, K)
        if z.size(0) > 1:
            own = own.index_select(1, self.spaces[:n])  # (d, size): a reference of fold k is met in space k only
        distances = (self.points.narrow(1, 0, n) - own).square_().sum(0)
        # The filter spares nearly all queries of new parts the comparison with every reference.
        if part != 0 and bool(self.part_filter[part & self.filter_mask].item()):
            distances.masked_fill_(self.parts[:n] == part, float("inf"))
        return distances

    @torch.jit.export
    def count_near(self, distances: Tensor, radius: float) -> tuple[int, int]:
        """(successes, failures) within `radius`. Several points of one part are worth less than as many parts: `votes`."""
        n = distances.size(0)
        if n == 0:
            return 0, 0
        limit = radius * radius
        if int(self.repeats.item()) > 0:
            return self.votes(distances <= limit)
        inside = torch.le(distances, limit, out=torch.empty_like(distances))  # in float32, as the product takes it
        counts: list[float] = torch.mv(self.labels.narrow(1, 0, n), inside).tolist()  # exact below 2**24 points
        return int(counts[1]), int(counts[0]) - int(counts[1])

    def votes(self, inside: Tensor) -> tuple[int, int]:
        """(successes, failures) of the points `inside`, (size,) bool, in votes: m points of a part are worth
        m / (1 + (m - 1) agreement), one vote where its labels always agree. Rounded: bounds are of whole trials.
        """
        slots = inside.nonzero().flatten()
        own = self.first.index_select(0, slots)
        ones = torch.ones(own.size(0), dtype=torch.float64)
        times = torch.zeros(self.capacity, dtype=torch.float64).index_add_(0, own, ones)
        worth = 1.0 / (1.0 + (times.index_select(0, own) - 1.0) * self.agreement)
        successes = float((worth * self.labels[1].index_select(0, slots)).sum().item())
        failures = float(worth.sum().item()) - successes
        return int(successes + 0.5), int(failures + 0.5)

    def keep(self, point: Tensor, label: float, space: int, part: int = 0, number: int = 0) -> None:
        """Add one point (d,), as `put`; number : of its label."""
        self.numbers[int(self.total) % self.capacity] = number
        self.put(point, label, space, part)

    def renumber(self, was: int, number: int) -> None:
        """Give the point of a label another number; one that has left needs none."""
        self.numbers[self.numbers == was] = number

    def add(
        self, points: ArrayLike, labels: ArrayLike, spaces: ArrayLike | None = None,
        parts: ArrayLike | None = None, numbers: ArrayLike | None = None,
    ) -> None:  # fmt: skip
        """Add points (n, d) with labels (n,), 1 = success, 0 = failure.

        spaces : (n,) the space each lives in, 0 if None.  parts : (n,) int64 hashes of their parts; None: of no known part.
        numbers : (n,) of their labels; None: 0.
        """
        z, y = np.array(points, dtype=np.float32), np.array(labels, dtype=np.float32)  # copies: torch needs writable ones
        k, own = (np.zeros(len(z), np.int64) if v is None else np.array(v, dtype=np.int64) for v in (spaces, parts))
        if z.ndim != 2 or z.shape[1] != self.dim or {y.shape, k.shape, own.shape} != {(len(z),)}:
            got = f"{z.shape}, {y.shape}, {k.shape} and {own.shape}"
            raise ValueError(f"Expected points (n, {self.dim}) with n labels, n spaces and n parts, got {got}.")
        total = int(self.total)
        keep = slice(max(0, len(z) - self.capacity), None)  # of more than fit, the newest
        slots = (total + np.arange(len(z))[keep]) % self.capacity
        self.points[:, slots] = torch.from_numpy(z[keep].T)
        self.labels[1, slots] = torch.from_numpy(y[keep])
        self.spaces[slots] = torch.from_numpy(k[keep])
        self.parts[slots] = torch.from_numpy(own[keep])
        self.numbers[slots] = 0 if numbers is None else np.asarray(numbers)[keep]
        self.total.fill_(total + len(z))
        if own.any() or int(self.repeats) > 0:
            self._gather_parts()

    def relabel(self, number: int, part: int, label: int | None) -> bool:
        """Give the point of a label another one, or take it out where `label` is None; the others keep their order of age.

        A point that has left already needs nothing. Returns False, and changes nothing, where the point is another part's.
        """
        held = np.flatnonzero(self.held("numbers") == number)
        if not len(held):
            return True
        slot, n = int(held[0]), len(self)
        if int(self.parts[slot]) != part:
            return False
        if label is not None:
            self.labels[1, slot] = float(label)
            return True
        order = (int(self.total) - n + torch.arange(n)) % self.capacity  # oldest first
        order = order[order != slot]
        for block in (self.points, self.labels, self.spaces, self.parts, torch.from_numpy(self.numbers)):
            block[..., : n - 1] = block[..., order]
            block[..., n - 1 :] = 0
        self.labels[:, n - 1 :] = 1.0
        self.total.fill_(n - 1)
        self._gather_parts()
        return True

    def weigh(self) -> None:
        """Estimate how far the labels of one part go together, for all counts from now on."""
        if int(self.repeats) > 0:
            self.agreement.fill_(label_agreement(*map(self.held, ("points", "labels", "spaces", "parts"))))

    def _gather_parts(self) -> None:
        """Find for every slot the first one of its part, and how many are not that."""
        n, parts, slots = len(self), self.held("parts"), np.arange(self.capacity)
        _, first, inverse = np.unique(parts, return_index=True, return_inverse=True)
        slots[:n] = np.where(parts != 0, first[inverse], slots[:n])
        self.first.copy_(torch.from_numpy(slots))
        self.repeats.fill_(int((slots != np.arange(self.capacity)).sum()))
        self.part_filter.zero_()
        self.part_filter[torch.from_numpy(parts & self.filter_mask)] = True

    def count(self, queries: ArrayLike, radius: float) -> Counts:
        """(n_success, n_failure), each (n,): labels around each query (n, d), or (n, K, d) for K spaces.

        radius : of the ball, its surface included.
        """
        z = torch.from_numpy(np.array(queries, dtype=np.float32))
        z = z[:, None, :] if z.dim() == 2 else z  # (n, K, d)
        found = [self.count_near(self.squared_distances(query), radius) for query in z]
        counts = np.array(found, dtype=np.int64).reshape(-1, 2)
        return counts[:, 0], counts[:, 1]

    def get_state(self) -> dict[str, NDArray[Any]]:
        """Plain arrays, copies: points (d, n), labels, spaces, parts and numbers (n,), and total, points ever added."""
        own = {name: self.held(name).copy() for name in ("labels", "spaces", "parts", "numbers")}
        whole = {name: getattr(self, name).numpy().copy() for name in ("agreement", "total")}
        return {"points": self.held("points").T.copy()} | own | whole

    @classmethod
    def from_state(cls, state: Mapping[str, NDArray[Any]], capacity: int) -> Self:
        """The index that `get_state` was taken from: the same points in the same places."""
        index = cls(len(state["points"]), capacity)
        index.add(state["points"].T, *(state[name] for name in ("labels", "spaces", "parts", "numbers")))
        index.agreement.fill_(float(state["agreement"]))
        index.total.fill_(int(state["total"]))
        return index

    def digest(self) -> str:
        """SHA-256 of what is held: points as (d, n) float32, labels as float32, spaces as int64, one after the other."""
        arrays = self.held("points").T, self.held("labels").astype(np.float32), self.held("spaces")
        return hashlib.sha256(b"".join(np.ascontiguousarray(each).tobytes() for each in arrays)).hexdigest()
