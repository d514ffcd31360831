"""Simulates many insertions in parallel (`simulate`) and saves them as a data set
(`save_insertions`). A seed gives the same insertions for any number of processes. `dengine
simulate` uses it.

    save_insertions("traces.npz", simulate(100, seed=0))
"""

from collections.abc import Callable, Sequence
from io import BytesIO
from pathlib import Path

import numpy as np

from ...errors import expect
from ...files import write_output
from .cell import SimulatedInsertion, insert_once
from .conditions import RATE_HZ, CellParameters, find_scenario
from .world import TIME_STEP_S


def simulate(
    n: int,
    seed: int = 0,
    scenario: str = "nominal",
    n_jobs: int = -1,
    progress: Callable[[int], object] = lambda n: None,
    time_step_s: float = TIME_STEP_S,
) -> list[SimulatedInsertion]:
    """Simulate the first n cycles of a robot cell in parallel processes; return their insertions.

    An insertion is one part that is pressed into its place, with its trace and label. In the
    scenario "nominal" insertion i depends on (seed, i) alone; in the others also on n.

    Parameters
    ----------
    n : int
        Number of cycles, one insertion in each.
    seed : int, default 0
    scenario : str, default "nominal"
        What changes in the course of the cycles, a name in `SCENARIOS`; "nominal": nothing.
    n_jobs : int, default -1
        Number of processes; -1: one for each core. It changes no result. `joblib.parallel_config`
        chooses the backend.
    progress : callable, optional
        Called with 1 after each insertion, in the order of the cycles.
    time_step_s : float
        Step of the physics in seconds.

    Returns
    -------
    list of SimulatedInsertion
        In the order of the cycles.

    Raises
    ------
    SettingError
        For an unknown scenario, n below 1, and a time step that does not divide 2 ms.
    DengineError
        If MuJoCo is not installed.
    ValueError
        For a negative seed, and for an `n_jobs` of 0.
    """
    from joblib import Parallel, delayed

    expect(n >= 1, "at least 1 trace to simulate", n, "raise n")
    base = CellParameters()
    change = find_scenario(scenario)
    tasks = (
        delayed(insert_once)(change(base, cycle, n), seed, cycle, time_step_s) for cycle in range(n)
    )
    insertions: list[SimulatedInsertion] = []
    for insertion in Parallel(n_jobs=n_jobs, return_as="generator")(tasks):
        insertions.append(insertion)
        progress(1)
    return insertions


def save_insertions(
    path: str | Path, insertions: Sequence[SimulatedInsertion], force: bool = False
) -> Path:
    """Write insertions as a compressed .npz file that `load_dataset` reads; return its path.

    The folder is created if it is missing, and the file is written in full or not at all. The
    arrays are X int16 (n, 1000), scale, y int8 (n,) with 1 for a good part and 0 for a bad one,
    rate_hz and unit. X * scale are the traces in newtons, rounded to multiples of `scale`, which is
    0.01 N or more.

    Parameters
    ----------
    path : str or path
        No suffix is added; `load_dataset` needs the suffix .npz.
    insertions : sequence of SimulatedInsertion
        At least one; ValueError if there is none.
    force : bool, default False
        Whether a file that exists is replaced; a database, a folder or a link never is.

    Returns
    -------
    Path

    Raises
    ------
    OutputError
        If the file exists and `force` is False, or is one that is never replaced, or cannot be
        written.
    """
    buffer = BytesIO()
    X = np.stack([insertion.trace for insertion in insertions])
    scale = max(0.01, float(np.abs(X).max()) / 32000)  # newtons per integer step
    np.savez_compressed(
        buffer,
        X=np.round(X / scale).astype(np.int16),
        scale=np.float32(scale),
        y=np.array([insertion.success for insertion in insertions], dtype=np.int8),
        rate_hz=np.float32(RATE_HZ),
        unit=np.array("N"),
    )
    return write_output(path, buffer.getvalue(), force, make_folder=True)
