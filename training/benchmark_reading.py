"""Measure how long recordings take to describe and to read, beside plain pandas on the same files.

    python training/benchmark_reading.py --folder speed

Three sets are written into the folder, if they are not there: 1,500 CSV files of 1,000 rows, a long
table of 1.5 million rows, and 1,210 JSON files of 500 samples. Each is read in turn by pandas (of
JSON, by the standard library), by `load_dataset` with a saved description, checks included, and
described. The table shows medians and worst cases over the repeats, ratios within one repeat, and
the peak of the memory that reading the long table needs beside its arrays.
"""

import argparse
import json
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from dengine import Dataset, describe, load_dataset

N_FILES, N_ROWS, RATE_HZ = 1500, 1000, 500.0
N_JSON, N_SAMPLES = 1210, 500


def write_files(folder: Path, rng: np.random.Generator) -> None:
    """Write a CSV file for each part: a clock and three forces."""
    folder.mkdir(parents=True)
    seconds = np.arange(N_ROWS) / RATE_HZ
    for i in range(N_FILES):
        forces = {name: rng.normal(size=N_ROWS).round(4) for name in ("FX", "FY", "FZ")}
        frame = pd.DataFrame({"time": seconds, **forces})
        frame.to_csv(folder / f"part_{i:04d}_{'OK' if i % 3 else 'NOK'}.csv", index=False)


def write_long(folder: Path, rng: np.random.Generator) -> None:
    """Write one table with a row for each sample."""
    folder.mkdir(parents=True)
    parts = np.arange(N_FILES)
    seconds = np.tile(np.arange(N_ROWS) / RATE_HZ, N_FILES) + np.repeat(parts * 10.0, N_ROWS)
    frame = pd.DataFrame(
        {
            "time": seconds.round(3),
            "serial": np.repeat([f"S{i:04d}" for i in parts], N_ROWS),
            "verdict": np.repeat(np.where(parts % 3, "OK", "NOK"), N_ROWS),
            "FZ": rng.normal(size=N_FILES * N_ROWS).round(3),
        }
    )
    frame.to_csv(folder / "export.csv", index=False)


def write_json(folder: Path, rng: np.random.Generator) -> None:
    """Write a JSON object for each part."""
    folder.mkdir(parents=True)
    for i in range(N_JSON):
        force = rng.normal(size=N_SAMPLES).round(3).tolist()
        about = {"cycle": i, "result": "OK" if i % 3 else "NOK", "force": force}
        (folder / f"cycle_{i}.json").write_text(json.dumps(about), encoding="utf-8")


def read_csv(folder: Path) -> Any:
    """Read all CSV files of a folder by pandas."""
    return [pd.read_csv(path) for path in sorted(folder.glob("*.csv"))]


def read_json(folder: Path) -> Any:
    """Read all JSON files of a folder by the standard library."""
    return [json.loads(path.read_bytes()) for path in sorted(folder.glob("*.json"))]


def seconds_of(call: Callable[[], Any]) -> tuple[float, Any]:
    """Return how long a call takes, and its result."""
    begin = time.perf_counter()
    result = call()
    return time.perf_counter() - begin, result


def peak_of(call: Callable[[], Any]) -> float:
    """Return the peak of the memory that a call allocates, in MB."""
    tracemalloc.start()
    call()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak / 2**20


def main() -> None:
    """Write the sets, measure, and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--folder", type=Path, default=Path("speed"), help="Where the sets are.")
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args()
    rng = np.random.default_rng(0)
    sets = {
        "files": (write_files, read_csv),
        "long": (write_long, read_csv),
        "json": (write_json, read_json),
    }
    rows = []
    for name, (write, read_plain) in sets.items():
        folder = arguments.folder / name
        if not folder.exists():
            write(folder, rng)
        description = describe(folder)
        times: dict[str, list[float]] = {"plain": [], "read": [], "describe": []}
        data: Dataset = load_dataset(folder, description)
        for _ in range(arguments.repeats):
            times["plain"].append(seconds_of(lambda f=folder, r=read_plain: r(f))[0])  # type: ignore[misc]
            took, data = seconds_of(lambda f=folder, d=description: load_dataset(f, d))  # type: ignore[misc]
            times["read"].append(took)
            times["describe"].append(seconds_of(lambda f=folder: describe(f))[0])  # type: ignore[misc]
        row: dict[str, Any] = {"set": name, "traces": len(data)}
        row |= {f"{key}, s": float(np.median(values)) for key, values in times.items()}
        ratios = np.divide(times["read"], times["plain"])
        row |= {"read / plain": float(np.median(ratios)), "worst": float(ratios.max())}
        if name == "long":
            frame = read_csv(folder)[0]
            arrays = sum(frame[column].to_numpy().nbytes for column in frame) / 2**20
            peak = peak_of(lambda f=folder, d=description: load_dataset(f, d))  # type: ignore[misc]
            row |= {"peak, MB": peak, "arrays, MB": arrays}
        rows.append(row)
    print(pd.DataFrame(rows).to_string(index=False, float_format=lambda value: f"{value:.2f}"))


if __name__ == "__main__":
    main()
