"""Labelled traces as people have them: folders of CSV files, tables, arrays, archives; read into one `Dataset`.

>>> load_dataset("cell_3/", channel="FZ_Base")         # a CSV file an insertion, its label in its name
>>> load_dataset("traces.parquet")                     # a row an insertion
"""

from __future__ import annotations

from .dataset import Dataset, Fault, make_dataset
from .loading import BUNDLED, load_dataset

__all__ = ["BUNDLED", "Dataset", "Fault", "load_dataset", "make_dataset"]
