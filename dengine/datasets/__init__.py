"""Read labelled traces: recordings by a description, files of dengine without one.

    description = describe("cell_3/")  # proposes what the recordings are
    description.save("cell_3/recordings.toml")
    load_dataset("cell_3/")  # a Dataset, read exactly by that file

    load_dataset("insertion")  # 1503 simulated insertions, shipped with the package

`make_dataset` makes a `Dataset` of arrays; `importing.import_labelled` puts one into a store.
"""

from .dataset import Dataset, Fault, make_dataset
from .describe import describe
from .description import Description
from .loading import BUNDLED, load_dataset

__all__ = [
    "BUNDLED",
    "Dataset",
    "Description",
    "Fault",
    "describe",
    "load_dataset",
    "make_dataset",
]
