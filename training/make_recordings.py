"""A folder of CSV files as UR cells record them, from the bundled data set: what one's own may look like.

    python training/make_recordings.py --out recordings --n 200 --broken 3
    dengine data recordings

A file an insertion, `insertion_0001_True.csv`: 960 to 1040 rows at 500 Hz, the force that was simulated in FZ_Base, small
noise in the other columns, the label in the name. A longer recording goes on at the level where the simulated one ends,
with its sensor's noise; a shorter one stops earlier. Broken files are, in turn, one without content, one whose last line is
cut, and one without the force. The same seed writes the same files.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dengine import load_dataset

FORCES = ("FX_Base", "FY_Base", "FZ_Base")
TORQUES = ("MuX_Base", "MuY_Base", "MuZ_Base")
POSE = ("TCP_X", "TCP_Y", "TCP_Z", "TCP_RX", "TCP_RY", "TCP_RZ")
CHANNELS = (*FORCES, *TORQUES, *POSE)
NOISE = (0.4, 0.4, 0.0, 0.02, 0.02, 0.02, 2e-5, 2e-5, 2e-5, 1e-4, 1e-4, 1e-4)  # N, Nm, m, rad
FORCE = CHANNELS.index("FZ_Base")
SHORTEST, LONGEST = 960, 1040
TAIL = 50  # samples that tell the level and the noise of the end


def record(force: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float64]:
    """(T,) force -> (samples, channels), of a length by chance."""
    samples = int(rng.integers(SHORTEST, LONGEST + 1))
    tail = force[-TAIL:].astype(np.float64)
    longer = tail.mean() + rng.normal(0.0, tail.std(), max(0, samples - len(force)))
    values = rng.normal(0.0, NOISE, (samples, len(CHANNELS)))
    values[:, FORCE] = np.concatenate([force, longer])[:samples]
    values[:, CHANNELS.index("TCP_Z")] += np.linspace(0.25, 0.21, samples)
    return values


def as_csv(values: NDArray[np.float64], start_s: float, rate_hz: float, leave_out: tuple[str, ...] = ()) -> str:
    """The text of a file: seconds since the controller was switched on, then the channels."""
    kept = [i for i, name in enumerate(CHANNELS) if name not in leave_out]
    lines = [",".join(["Timestamp", *(CHANNELS[i] for i in kept)])]
    for step, row in enumerate(values[:, kept].tolist()):
        lines.append(f"{start_s + step / rate_hz:.3f}," + ",".join(f"{value:.5g}" for value in row))
    return "\n".join(lines) + "\n"


def broken(values: NDArray[np.float64], start_s: float, rate_hz: float, kind: int) -> str:
    """What a file looks like that was never written, cut while it was, or written by another program."""
    if kind % 3 == 0:
        return ""
    if kind % 3 == 1:
        text = as_csv(values, start_s, rate_hz)
        return text[: text.rindex(",") - 10]
    return as_csv(values, start_s, rate_hz, leave_out=("FZ_Base",))


def write_recordings(folder: Path, n: int = 200, n_broken: int = 3, seed: int = 0, rate_hz: float = 500.0) -> list[str]:
    """Write n files of which some are broken; returns the names of these."""
    rng, data = np.random.default_rng(seed), load_dataset("insertion")
    if not 0 <= n_broken <= n <= len(data):
        raise SystemExit(f"Expected 0 <= --broken <= --n <= {len(data)}, got --broken {n_broken} and --n {n}.")
    folder.mkdir(parents=True, exist_ok=True)
    rows = rng.permutation(len(data))[:n]
    kinds = dict(zip(sorted(rng.choice(n, n_broken, replace=False).tolist()), range(n_broken), strict=True))
    names = []
    for i, row in enumerate(rows):
        name = f"insertion_{i + 1:04d}_{bool(data.y[row])}.csv"
        values, start_s = record(data.X[row], rng), 1000.0 + 12.0 * i
        text = broken(values, start_s, rate_hz, kinds[i]) if i in kinds else as_csv(values, start_s, rate_hz)
        (folder / name).write_text(text, encoding="utf-8")
        names += [name] if i in kinds else []
    return names


def main() -> None:
    """Parse, write, say what is broken."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="the folder to write; made if need be")
    parser.add_argument("--n", type=int, default=200, help="files (default: 200)")
    parser.add_argument("--broken", type=int, default=3, help="of these so many that cannot be read (default: 3)")
    parser.add_argument("--seed", type=int, default=0, help="the same seed, the same files (default: 0)")
    args = parser.parse_args()
    names = write_recordings(args.out, args.n, args.broken, args.seed)
    print(f"Wrote {args.n} recordings to {args.out}; broken: {', '.join(names) or 'none'}.")


if __name__ == "__main__":
    main()
