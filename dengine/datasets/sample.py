"""Recordings to try an import on: `write_sample` writes a part of the bundled set as CSV files of a
robot cell, one of them broken, for `dengine data --sample`.
"""

import numpy as np
import pandas as pd

from ..files import FilePath, new_folder
from .loading import load_dataset

RATE_HZ = 500.0
CYCLE_SECONDS = 12.0  # from one recording to the next
BROKEN = 44  # the file that is cut off in its last line; the last, if there are fewer


def write_sample(folder: FilePath, n: int = 200) -> None:
    """Write n recordings of the set `insertion` as CSV files, like `insertion_0001_True.csv`.

    The set comes with dengine and has the forces of 1503 simulated insertions of a part. They are
    drawn at random, none twice; the same call always writes the same files. Each file has 960 to
    1000 rows at 500 Hz, with the time in Timestamp, the force in FZ_Base, the height in TCP_Z,
    which is only noise, and the label in its name: True is good. Times are in seconds; file 1
    begins at 1012, and each file 12 s after the one before. File 44, or the last one of fewer,
    lacks its last 16 characters. Numbers have 7 digits; so from file 750 on, at 10000 s, times are
    rounded to 0.01 s and repeat.

    Parameters
    ----------
    folder : path
        A new or an empty folder.
    n : int, default 200
        Number of files, 0 or more, which is not checked. With more than 1503, 1503 files are
        written.

    Raises
    ------
    OutputError
        If the folder holds something or cannot be written.
    """
    rng = np.random.default_rng(0)
    data = load_dataset()
    with new_folder(folder) as target:
        for i, row in enumerate(rng.permutation(len(data))[:n], 1):
            rows = rng.integers(960, 1001)
            frame = pd.DataFrame(
                {
                    "Timestamp": np.arange(rows) / RATE_HZ + (1000.0 + CYCLE_SECONDS * i),
                    "FZ_Base": data.X[row, :rows],
                    "TCP_Z": rng.normal(0.0, 2e-5, rows),  # the noise of a robot that stands still
                }
            )
            text = frame.to_csv(index=False, float_format="%.7g")
            path = target / f"insertion_{i:04d}_{bool(data.y[row])}.csv"
            path.write_text(text[:-16] if i == min(BROKEN, n) else text, encoding="utf-8")
