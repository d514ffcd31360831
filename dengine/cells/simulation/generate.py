"""Simulated traces in quantity: the same for a seed, however many processes make them.

As in `save_traces("traces.npz", simulate(100, seed=0))`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import SettingError
from ...files import write_output
from .cell import Insertion, insert_once
from .conditions import CHANNELS, RATE_HZ, CellParameters, find_scenario
from .world import TIME_STEP_S

_BLOCK = 100  # cycles simulated between two looks at the quotas
_MOST_CYCLES_PER_TRACE = 20

Progress = Callable[[int, int], None]  # (done, of)


@dataclass(frozen=True, slots=True)
class SimulatedTraces:
    """Simulated insertions, in the order of their cycles.

    X : (n, 1000) or (n, 6, 1000) float32; newtons, and newton metres for the torques.
    y : (n,) int8, 1 = success, 0 = failure. cause : (n,) str, `"none"` for a success.
    height_mm : (n,) float32, of the part's top over its nominal seated height.
    cycle : (n,) int32, the cycle each came from. insertions : what was drawn for each.
    parameters, scenario, seed : what they were made with.
    """

    X: NDArray[np.float32]
    y: NDArray[np.int8]
    cause: NDArray[np.str_]
    height_mm: NDArray[np.float32]
    cycle: NDArray[np.int32]
    insertions: tuple[Insertion, ...]
    parameters: CellParameters
    scenario: str
    seed: int


def simulate(
    n: int,
    seed: int = 0,
    scenario: str = "nominal",
    n_jobs: int = -1,
    channels: str = "z",
    progress: Progress | None = None,
    parameters: CellParameters | None = None,
    time_step_s: float = TIME_STEP_S,
) -> SimulatedTraces:
    """Simulate the first n cycles of a cell.

    In the nominal scenario trace i depends on (seed, i) alone; in the others on its place among the n as well.
    n_jobs : processes, as joblib counts them; the backend is the caller's, by `joblib.parallel_config`.
    progress : called with (done, n) as traces come in.
    """
    if n < 1:
        raise SettingError(f"Expected at least 1 trace to simulate, got {n}; raise n.")
    if channels not in CHANNELS:
        raise SettingError(f"Expected channels of {', '.join(CHANNELS)}; got {channels!r}; choose one of these.")
    base, change = parameters or CellParameters(), find_scenario(scenario)
    tasks = [(change(base, cycle, n), seed, cycle, channels, time_step_s) for cycle in range(n)]
    insertions: list[Insertion] = []
    for insertion in _run(tasks, n_jobs):
        insertions.append(insertion)
        if progress is not None:
            progress(len(insertions), n)
    return _gather(insertions, range(n), base, scenario, seed)


def _run(tasks: Iterable[tuple[Any, ...]], n_jobs: int) -> Iterator[Insertion]:
    """Insertions in the order of their tasks, as they come in."""
    from joblib import Parallel, delayed

    yield from Parallel(n_jobs=n_jobs, return_as="generator")(delayed(insert_once)(*task) for task in tasks)


def _gather(
    insertions: Sequence[Insertion], cycles: Sequence[int], parameters: CellParameters, scenario: str, seed: int
) -> SimulatedTraces:
    return SimulatedTraces(
        X=np.stack([insertion.trace for insertion in insertions]),
        y=np.array([insertion.success for insertion in insertions], dtype=np.int8),
        cause=np.array([insertion.cause for insertion in insertions]),
        height_mm=np.array([insertion.height_mm for insertion in insertions], dtype=np.float32),
        cycle=np.array(cycles, dtype=np.int32),
        insertions=tuple(insertions),
        parameters=parameters,
        scenario=scenario,
        seed=seed,
    )


def simulate_balanced(
    successes: int = 803,
    failures: int = 700,
    seed: int = 0,
    n_jobs: int = -1,
    progress: Progress | None = None,
    parameters: CellParameters | None = None,
) -> SimulatedTraces:
    """Run the nominal cell until both quotas are filled; keep the first ones of each label, in order.

    The defaults are the counts of the paper's data. progress : called with (kept, of).
    """
    base, wanted = parameters or CellParameters(), {True: successes, False: failures}
    kept: list[tuple[int, Insertion]] = []
    for start in range(0, _MOST_CYCLES_PER_TRACE * (successes + failures), _BLOCK):
        cycles = range(start, start + _BLOCK)
        for cycle, insertion in zip(cycles, _run(((base, seed, cycle) for cycle in cycles), n_jobs), strict=True):
            if wanted[insertion.success] > 0:
                wanted[insertion.success] -= 1
                kept.append((cycle, insertion))
        if progress is not None:
            progress(len(kept), successes + failures)
        if not any(wanted.values()):
            return _gather([insertion for _, insertion in kept], [cycle for cycle, _ in kept], base, "nominal", seed)
    raise SettingError(
        f"Expected {successes} successes and {failures} failures, still missing {wanted[True]} and {wanted[False]} "
        f"after {_MOST_CYCLES_PER_TRACE} cycles for each; use parameters under which both happen."
    )


def save_traces(path: str | Path, traces: SimulatedTraces, force: bool = False) -> Path:
    """Write traces as a compressed npz that loads with `allow_pickle=False`.

    Keys: X int16 with `scale` (X * scale is in `unit`), y int8, cause str, height_mm float32, cycle int32, the draws
    as `conditions` (n, m) float32 with their names `condition_names`, and rate_hz, unit, seed, scenario, simulated.
    OutputError where a file is there, without `force`.
    """
    buffer = BytesIO()
    # Value of one integer step: 0.01 N, or as much more as the largest sample needs; torques have their own.
    if traces.X.ndim == 2:
        scale = np.asarray(max(0.01, float(np.abs(traces.X).max()) / 32000))
    else:
        scale = np.maximum(np.array([0.01] * 3 + [0.0003] * 3), np.abs(traces.X).max(axis=(0, 2)) / 32000)[:, None]
    rows = [asdict(insertion.conditions) | asdict(insertion.sensor) for insertion in traces.insertions]
    names = [name for name in rows[0] if name != "fault"]
    np.savez_compressed(
        buffer,
        X=np.round(traces.X / scale).astype(np.int16),
        scale=scale.astype(np.float32),
        y=traces.y,
        cause=traces.cause,
        height_mm=traces.height_mm,
        cycle=traces.cycle,
        conditions=np.array([[row[name] for name in names] for row in rows], dtype=np.float32),
        condition_names=np.array(names),
        rate_hz=np.float32(RATE_HZ),
        unit=np.array("N" if traces.X.ndim == 2 else "N, N·m"),
        seed=np.int64(traces.seed),
        scenario=np.array(traces.scenario),
        simulated=np.array(True),
    )
    return write_output(path, buffer.getvalue(), force, make_folder=True)
