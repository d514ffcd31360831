"""How far the labels of one part go together: the intraclass correlation that decides what its repeats count.

A part that comes m times is m independent trials only where its labels are no more alike than those of others that look the
same. With an intraclass correlation rho, m trials are worth m / (1 + (m - 1) rho): all of them at rho = 0, one at rho = 1.
Nothing is taken for independent until it was seen to be: rho is an upper confidence bound, and 1 while few parts came
twice.

Sources: Kish (1965), Survey Sampling, the design effect; Rao and Scott (1992), Biometrics 48, for counts of clusters.
"""

import numpy as np
from numpy.typing import NDArray

FEWEST_PARTS = 20  # that came at least twice; fewer say nothing
NEIGHBOURS = 30  # of other parts, that say what is usual where a trace lies
SAMPLE = 3000  # of the newest points: the work does not grow
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
    rest = np.zeros(len(labels))
    for space in np.unique(spaces):
        here = np.flatnonzero(spaces == space)
        rest[here] = labels[here] - _rate_of_others(points[here], labels[here], part[here])
    spread = float((rest[again] ** 2).mean())
    own = np.bincount(part[again], rest[again], len(times))
    alike = own**2 - np.bincount(part[again], rest[again] ** 2, len(times))  # products of different traces of one part
    pairs = np.where(times > 1, times * (times - 1.0), 0.0) * (np.bincount(part[again], minlength=len(times)) > 0)
    if spread == 0.0:
        return 1.0  # every label as its place says: nothing to see
    rho = float(alike.sum() / (pairs.sum() * spread))
    error = float(np.sqrt(((alike / spread - rho * pairs) ** 2).sum()) / pairs.sum())
    return float(np.clip(rho + CONFIDENCE * error, 0.0, 1.0))


def _rate_of_others(points: NDArray[np.float32], labels: NDArray[np.int8], part: NDArray[np.int64]) -> NDArray[np.float64]:
    """(n,) success rate among the nearest points of other parts."""
    from scipy.spatial.distance import cdist

    distances = cdist(points, points, "sqeuclidean")
    distances[part[:, None] == part] = np.inf
    k = min(NEIGHBOURS, len(points) - 1)
    if k < 1:
        return np.full(len(points), 0.5)
    nearest = np.argpartition(distances, k - 1, axis=1)[:, :k]
    return np.asarray((labels[nearest].sum(1) + 0.5) / (k + 1.0))
