"""Simulated insertions in quantity: the same for a seed, however many processes make them.

As in `save_insertions("traces.npz", simulate(100, seed=0), seed=0)`.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict
from io import BytesIO
from pathlib import Path

import numpy as np

from ...errors import expect
from ...files import write_output
from .cell import Insertion, insert_once
from .conditions import RATE_HZ, CellParameters, find_scenario
from .world import TIME_STEP_S


def simulate(
    n: int,
    seed: int = 0,
    scenario: str = "nominal",
    n_jobs: int = -1,
    progress: Callable[[int], object] = lambda n: None,
    time_step_s: float = TIME_STEP_S,
) -> list[Insertion]:
    """The first n cycles of a cell, in their order.

    In the nominal scenario insertion i depends on (seed, i) alone; in the others on its place among the n as well.
    n_jobs : processes, as joblib counts them; the backend is the caller's, by `joblib.parallel_config`.
    progress : called with 1 as each insertion comes in.
    """
    from joblib import Parallel, delayed

    expect(n >= 1, "at least 1 trace to simulate", n, "raise n")
    base, change = CellParameters(), find_scenario(scenario)
    tasks = (delayed(insert_once)(change(base, cycle, n), seed, cycle, time_step_s) for cycle in range(n))
    insertions: list[Insertion] = []
    for insertion in Parallel(n_jobs=n_jobs, return_as="generator")(tasks):
        insertions.append(insertion)
        progress(1)
    return insertions


def save_insertions(
    path: str | Path, insertions: Sequence[Insertion], seed: int, scenario: str = "nominal", force: bool = False
) -> Path:
    """Write insertions as a compressed npz that loads with `allow_pickle=False`, and by `load_dataset`.

    Keys: X int16 with `scale` (X * scale is in `unit`), y int8, cause str, height_mm float32, cycle int32, the draws
    as `conditions` (n, m) float32 with their names `condition_names`, and rate_hz, unit, seed, scenario, simulated.
    OutputError where a file is there, without `force`.
    """
    buffer, X = BytesIO(), np.stack([each.trace for each in insertions])
    scale = max(0.01, float(np.abs(X).max()) / 32000)  # newtons of one integer step, more where the largest sample needs it
    rows = [asdict(each.conditions) | asdict(each.sensor) for each in insertions]
    names = [name for name in rows[0] if name != "fault"]
    np.savez_compressed(
        buffer,
        X=np.round(X / scale).astype(np.int16),
        scale=np.float32(scale),
        y=np.array([each.success for each in insertions], dtype=np.int8),
        cause=np.array([each.cause for each in insertions]),
        height_mm=np.array([each.height_mm for each in insertions], dtype=np.float32),
        cycle=np.array([each.cycle for each in insertions], dtype=np.int32),
        conditions=np.array([[row[name] for name in names] for row in rows], dtype=np.float32),
        condition_names=np.array(names),
        rate_hz=np.float32(RATE_HZ),
        unit=np.array("N"),
        seed=np.int64(seed),
        scenario=np.array(scenario),
        simulated=np.array(True),
    )
    return write_output(path, buffer.getvalue(), force, make_folder=True)
