"""Labelled traces by name, file, folder or frame: the face of `recordings`.

>>> load_dataset("insertion")                          # 1503 simulated insertions, shipped with the package
>>> load_dataset("recorded.npz", samples=400)          # X (n, T) or (n, C, T), y (n,)
>>> load_dataset("cell_3/", channel="FZ_Base,FX_Base") # a CSV file an insertion, its label in its name
"""

from __future__ import annotations

from .recordings import BUNDLED, Dataset, Fault, load_dataset, make_dataset

__all__ = ["BUNDLED", "Dataset", "Fault", "load_dataset", "make_dataset"]
