"""Labelled traces as people have them: folders of CSV files, tables, arrays, archives; read into one `Dataset`.

>>> load_dataset("insertion")                          # 1503 simulated insertions, shipped with the package
>>> load_dataset("recorded.npz", samples=400)          # X (n, T) or (n, C, T), y (n,)
>>> load_dataset("cell_3/", channel="FZ_Base,FX_Base") # a CSV file an insertion, its label in its name
"""

from .dataset import Dataset, Fault, make_dataset
from .loading import BUNDLED, load_dataset

__all__ = ["BUNDLED", "Dataset", "Fault", "load_dataset", "make_dataset"]
