"""What several tests do with an engine: have it run over a stretch of a dataset's parts, in order."""

import numpy as np

from dengine import DataEngine, Dataset, ReplayCell


def drive(engine: DataEngine, data: Dataset, first: int, last: int) -> list:
    """The cycles of the parts first..last."""
    order = np.arange(first, last)
    return list(engine.run(ReplayCell(data, order), len(order)))
