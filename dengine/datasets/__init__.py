"""Read labelled traces from folders of CSV files, tables, arrays, archives and bags.

>>> load_dataset("insertion")  # 1503 simulated insertions, shipped with the package
>>> load_dataset("recorded.npz", samples=400)  # X (n, T) or (n, C, T), y (n,)
>>> load_dataset("cell_3/", channel="FZ_Base,FX_Base")  # a CSV file for each insertion

`load_dataset` reads them into one `Dataset`, `make_dataset` makes one of arrays;
`importing.import_labelled` puts them into a store.
"""

from .dataset import Dataset, Fault, make_dataset
from .loading import BUNDLED, load_dataset

__all__ = ["BUNDLED", "Dataset", "Fault", "load_dataset", "make_dataset"]
