"""Recordings to try an import on: `write_sample` writes a part of the bundled set as CSV files of
a robot cell, three of them broken, for `dengine data --sample`.
"""

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from ..files import FilePath, new_folder
from .loading import load_dataset

FORCE = "FZ_Base"
# Of a UR controller, three for each of NOISE, their standard deviations in N, Nm, m and rad.
COLUMNS = ["FX_Base", "FY_Base", FORCE, "MuX_Base", "MuY_Base", "MuZ_Base"]
COLUMNS += ["TCP_X", "TCP_Y", "TCP_Z", "TCP_RX", "TCP_RY", "TCP_RZ"]
NOISE = (0.4, 0.02, 2e-5, 1e-4)
CYCLE_SECONDS = 12.0  # from one recording to the next


def write_sample(folder: FilePath, n: int = 200) -> None:
    """Write n insertions of the bundled set as CSV files, such as `insertion_0001_True.csv`.

    Each file has 960 to 1040 rows at 500 Hz, the force in FZ_Base, noise in the other columns, and
    the label in its name. Three are broken: the first of them is empty, the next is cut off in its
    last line, and the last has another name for the force. The same call writes the same files.

    Parameters
    ----------
    folder : path
        A new or an empty folder.
    n : int, default 200
        Number of files, at least 3.

    Raises
    ------
    OutputError
        If the folder holds something or cannot be written.
    """
    rng = np.random.default_rng(0)
    data = load_dataset("insertion")
    rows = rng.permutation(len(data))[:n]
    empty, cut, renamed = sorted(rng.choice(n, 3, replace=False).tolist())
    with new_folder(folder) as target:
        for i, row in enumerate(rows):
            frame = record(data.X[row], rng)
            frame.index += 1000.0 + CYCLE_SECONDS * i
            text = frame.to_csv(float_format="%.7g")
            broken = {empty: "", cut: text[:-30], renamed: text.replace(FORCE, "FZ")}
            name = f"insertion_{i + 1:04d}_{bool(data.y[row])}.csv"
            (target / name).write_text(broken.get(i, text), encoding="utf-8")


def record(force: NDArray[np.float32], rng: np.random.Generator) -> pd.DataFrame:
    """Return a force (T,) as the cell records it, by the seconds from its beginning.

    It is a table of 960 to 1040 rows at 500 Hz, with noise in the columns that are not the force. A
    recording that is longer than the force stays at its last level, with the noise of its sensor; a
    shorter one stops earlier. The random numbers come from `rng`.
    """
    n_rows = int(rng.integers(960, 1041))
    tail = force[-50:]
    rest = rng.normal(tail.mean(), tail.std(), max(0, n_rows - len(force)))
    values = rng.normal(0.0, np.repeat(NOISE, 3), (n_rows, len(COLUMNS)))
    seconds = pd.Index(np.arange(n_rows) / 500, name="Timestamp")
    frame = pd.DataFrame(values, seconds, COLUMNS)
    return frame.assign(**{FORCE: np.concatenate([force, rest])[:n_rows]})
