"""Checks on recordings that were read, the same for every source.

Equal samples under two labels are a fault, and so is each repeat; `tolerance_note` compares a
policy with the share of bad parts.
"""

from collections import defaultdict
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..errors import listed, percent
from ..folds import content_hash
from .dataset import Dataset, Fault
from .table import Recording

Fitted = tuple[Recording, NDArray[np.float32]]
MOST_RATE_HZ = 1e6
LEAST_RATE_HZ = 1.0


def without_repeats(fitted: Sequence[Fitted]) -> tuple[list[Fitted], list[Fault]]:
    """Return the recordings without repeats of others, and the faults of those left out.

    Of equal traces (C, T) with one label the first is kept; if their labels differ, none is.
    Constant traces are no repeats, since a dead sensor gives the same whatever the part.
    """
    if not fitted:
        return [], []
    groups = defaultdict(list)
    for i, hash_ in enumerate(content_hash(np.stack([trace for _, trace in fitted])).tolist()):
        if np.ptp(fitted[i][1]) > 0:
            groups[hash_].append(i)
    faults = dict[int, str]()
    for group in groups.values():
        first = fitted[group[0]][0]
        if len({fitted[i][0].label for i in group}) > 1:
            for i in group:
                other = fitted[group[1] if i == group[0] else group[0]][0]
                message = f"Expected one label for equal samples, {other.source} has another one"
                faults[i] = message
            continue
        for i in group[1:]:
            is_other = fitted[i][0].part != first.part
            part = f" of another part, {first.part}" if is_other else ""
            faults[i] = (
                f"Expected other samples than those of {first.source}{part}, it repeats them"
            )
    kept = [item for i, item in enumerate(fitted) if i not in faults]
    return kept, [Fault(fitted[i][0].source, 0, text) for i, text in sorted(faults.items())]


def finished_notes(traces: NDArray[np.float32], sources: Sequence[str]) -> list[str]:
    """Return a note on the traces (n, C, T) in which samples are lost, if there are any."""
    is_lost = ~np.isfinite(traces.reshape(len(traces), -1))
    rows = np.flatnonzero(is_lost.any(axis=1))
    if not len(rows):
        return []
    names = listed(sources[row] for row in rows)
    text = f"{int(is_lost.sum())} samples are lost, in {len(rows)} of {len(traces)} recordings"
    return [f"{text}: {names}."]


def tolerance_note(data: Dataset, lower_bound: float) -> str:
    """Return why a policy's tolerance says nothing about these parts; "" if it does.

    So it is if at most so many parts are bad as the policy tolerates among the accepted ones.
    """
    share = 1 - float(data.y.mean())
    tolerance = 1 - lower_bound
    if share > tolerance:
        return ""
    return (
        f"{percent(share)} of the parts are bad, and LB {percent(lower_bound, '.4g')} tolerates "
        f"{percent(tolerance, '.4g')} among the accepted ones: accepting every part would meet it. "
        f"Choose a higher lower bound."
    )
