"""Convert the public screw-driving recordings to one data set: 5,000 runs in the order of time.

    git clone --depth 1 https://github.com/nikolaiwest/2023-anomaly-detection-hicss
    python training/make_screw_driving.py 2023-anomaly-detection-hicss/data --out screw_driving.npz

Each run is a JSON file of tightening steps. Its torque (N·m) is interpolated on one grid of 1.2 ms.
Runs that are shorter than the grid repeat their last value. `y` is the controller's result, 1 for
OK. Source: West and Deuse, HICSS 2024; MIT licence, Copyright (c) 2023 Nikolai West.
"""

import argparse
import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import track

N_SAMPLES = 800
STEP_S = 0.0012


def read_run(path: Path, n_samples: int) -> tuple[np.ndarray, dict[str, Any]]:
    """Read one file.

    Returns
    -------
    torque : array of float32, shape (n_samples,)
        Interpolated at the multiples of `STEP_S`, from 0.
    run : dict
        Everything in the file.
    """
    run = json.loads(path.read_text(encoding="utf-8"))
    graphs = [step["graph"] for step in run["tightening steps"]]
    seconds = np.concatenate([graph["time values"] for graph in graphs])
    torque = np.concatenate([graph["torque values"] for graph in graphs])
    # A step begins with the last sample of the step before.
    seconds, first_rows = np.unique(seconds, return_index=True)
    grid = np.arange(n_samples) * STEP_S
    return np.interp(grid, seconds, torque[first_rows]).astype(np.float32), run


def convert(folder: Path, n_samples: int = N_SAMPLES) -> dict[str, np.ndarray]:
    """Return the arrays of the data set; those of the runs have a row for each run.

    Raises SystemExit if the folder has no recordings.
    """
    paths = sorted(folder.glob("Ch_*.json"))
    if not paths:
        raise SystemExit(
            f"Expected files Ch_*.json in {folder}, found none; "
            "give the `data` folder of the repository."
        )
    traces = []
    labels = []
    workpieces = []
    run_numbers = []  # of a workpiece, from 0
    n_runs = Counter[str]()
    for path in track(paths, description="reading"):
        torque, run = read_run(path, n_samples)
        workpiece = run["id code"]
        traces.append(torque)
        labels.append(run["result"] == "OK")
        workpieces.append(workpiece)
        run_numbers.append(n_runs[workpiece])
        n_runs[workpiece] += 1
    return {
        "X": np.stack(traces),
        "y": np.array(labels, dtype=np.int8),
        "workpiece": np.array(workpieces),
        "nth_run": np.array(run_numbers, dtype=np.int16),
        "rate_hz": np.array(1.0 / STEP_S),
        "unit": np.array("N·m"),
    }


def main() -> None:
    """Convert the recordings, write the data set, and print its size."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, help="the folder `data` of the public repository")
    parser.add_argument(
        "--samples",
        type=int,
        default=N_SAMPLES,
        help="samples of a trace, 1.2 ms each (default: 800)",
    )
    parser.add_argument(
        "--out", type=Path, default=Path("screw_driving.npz"), help="the .npz file to write"
    )
    arguments = parser.parse_args()
    arrays = convert(arguments.folder, arguments.samples)
    # The stub takes the first keyword for a bool.
    np.savez_compressed(arguments.out, **arrays)  # type: ignore[arg-type]
    n_runs = len(arrays["y"])
    n_good = int(arrays["y"].sum())
    n_workpieces = len(set(arrays["workpiece"]))
    print(
        f"Wrote {arguments.out}: {n_runs} runs of {n_workpieces} workpieces, "
        f"{n_good} OK and {n_runs - n_good} NOK."
    )


if __name__ == "__main__":
    main()
