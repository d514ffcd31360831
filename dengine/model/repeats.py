"""Parts that seem to come twice although nobody says so: traces much closer to another one than to all the rest.

Labels are counted as independent trials. A part that is inserted again brings its label again, so its repeats must be
known as such (`part=`); where they are not, this notices the plain cases and says so. It reads no label, and changes no
decision: repeats that look as different as parts do, and those of which there are more than `NEIGHBOURS`, are not seen.
The independence of parts with different numbers is assumed.
"""

import numpy as np
from numpy.typing import NDArray

NEWEST = 500  # traces that are looked at: the work does not grow
FEWEST = 100
POINTS = 50  # of each channel, means of equal stretches: the sensor's noise is no difference
NEIGHBOURS = 10
NEAR = 0.12  # of the distance to the tenth neighbour; of parts of their own about one in two hundred is as near
SUSPICIOUS = 0.05  # share of such traces


def near_repeats(traces: NDArray[np.float32], parts: NDArray[np.int64]) -> int:
    """How many of the newest traces (n, C, T) nearly repeat one of another part; parts (n,) hashes."""
    x, own = traces[-NEWEST:], parts[-NEWEST:]
    if len(x) < FEWEST:
        return 0
    n, channels, samples = x.shape
    length = max(1, samples // POINTS)
    from scipy.spatial.distance import cdist

    whole = x[:, :, : samples // length * length].astype(np.float64)
    means = whole.reshape(n, channels, -1, length).mean(3)
    scale = means.std((0, 2), keepdims=True)
    rows = ((means - means.mean(0)) / np.where(scale > 0, scale, 1.0)).reshape(n, -1)
    distances = cdist(rows, rows)
    distances[own[:, None] == own] = np.inf
    nearest = np.partition(distances, NEIGHBOURS, axis=1)[:, [0, NEIGHBOURS]]
    with np.errstate(invalid="ignore"):
        return int((nearest[:, 0] < NEAR * nearest[:, 1]).sum())


def repeats_note(traces: NDArray[np.float32], parts: NDArray[np.int64]) -> str:
    """What to say of near repeats; "" where there are few."""
    n, looked_at = near_repeats(traces, parts), min(len(traces), NEWEST)
    if n <= SUSPICIOUS * looked_at:
        return ""
    return (
        f"{n} of the newest {looked_at} traces nearly repeat another one: if parts come twice, give their numbers (part=)"
    )
