"""The public screw-driving recordings as one data set: 5,000 runs of a production-type station, in the order of time.

    git clone --depth 1 https://github.com/nikolaiwest/2023-anomaly-detection-hicss
    python training/make_screw_driving.py 2023-anomaly-detection-hicss/data --out screw_driving.npz

Each run is a JSON file of tightening steps. Its torque (N·m) is put on one grid of 1.2 ms; runs shorter than the grid
repeat their last value. `y` is the controller's result, 1 for OK. Source: West and Deuse, HICSS 2024; MIT licence,
Copyright (c) 2023 Nikolai West.
"""

import argparse
import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import track

SAMPLES = 800
STEP_S = 0.0012


def read_run(path: Path, samples: int) -> tuple[np.ndarray, dict[str, Any]]:
    """One file -> torque (samples,) float32 on the grid, and the rest of what it says."""
    run = json.loads(path.read_text(encoding="utf-8"))
    graphs = [step["graph"] for step in run["tightening steps"]]
    seconds = np.concatenate([graph["time values"] for graph in graphs])
    torque = np.concatenate([graph["torque values"] for graph in graphs])
    seconds, first = np.unique(
        seconds, return_index=True
    )  # a step begins with the last sample of the one before
    return np.interp(np.arange(samples) * STEP_S, seconds, torque[first]).astype(np.float32), run


def convert(folder: Path, samples: int = SAMPLES) -> dict[str, np.ndarray]:
    """The arrays of the data set, a row a run."""
    paths = sorted(folder.glob("Ch_*.json"))
    if not paths:
        raise SystemExit(
            f"Expected files Ch_*.json in {folder}, found none; give the `data` folder of the repository."
        )
    X, labels, parts, nth, runs = [], [], [], [], Counter[str]()
    for path in track(paths, description="reading"):
        torque, run = read_run(path, samples)
        X.append(torque)
        labels.append(run["result"] == "OK")
        parts.append(run["id code"])
        nth.append(runs[run["id code"]])
        runs[run["id code"]] += 1
    return {
        "X": np.stack(X),
        "y": np.array(labels, dtype=np.int8),
        "workpiece": np.array(parts),
        "nth_run": np.array(nth, dtype=np.int16),
        "rate_hz": np.array(1.0 / STEP_S),
        "unit": np.array("N·m"),
    }


def main() -> None:
    """Parse, convert, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, help="the folder `data` of the public repository")
    parser.add_argument(
        "--samples",
        type=int,
        default=SAMPLES,
        help="samples of a trace, 1.2 ms each (default: 800)",
    )
    parser.add_argument(
        "--out", type=Path, default=Path("screw_driving.npz"), help="the .npz file to write"
    )
    args = parser.parse_args()
    arrays = convert(args.folder, args.samples)
    np.savez_compressed(args.out, **arrays)  # type: ignore[arg-type]  # its first keyword is a bool
    good, n = int(arrays["y"].sum()), len(arrays["y"])
    print(
        f"Wrote {args.out}: {n} runs of {len(set(arrays['workpiece']))} workpieces, {good} OK and {n - good} NOK."
    )


if __name__ == "__main__":
    main()
