"""A folder of CSV files as UR cells record them, from the bundled data set: what one's own may look like.

    python training/make_recordings.py --out recordings --n 200 --broken 3
    dengine data recordings
    python training/make_recordings.py --out plants --plants --n 120

A file an insertion, `insertion_0001_True.csv`: 960 to 1040 rows at 500 Hz, the force that was simulated in FZ_Base, small
noise in the other columns, the label in the name. A longer recording goes on at the level where the simulated one ends,
with its sensor's noise; a shorter one stops earlier. Broken files are, in turn, one without content, one whose last line is
cut, and one whose force has another name. The same seed writes the same files.

--plants writes the same insertions, 200 samples at 100 Hz, as five plants do: CSV files in Latin-1 with decimal commas and
their labels apart; a historian's long Parquet; a wide CSV of two channels; a ROS 2 bag; and .npz by other names.
"""

import argparse
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
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


def as_csv(values: NDArray[np.float64], start_s: float, rate_hz: float) -> str:
    """The text of a file: seconds since the controller was switched on, then the channels."""
    frame = pd.DataFrame(values, columns=CHANNELS)
    frame.insert(0, "Timestamp", start_s + np.arange(len(values)) / rate_hz)
    return str(frame.to_csv(index=False, float_format="%.7g"))


def broken(values: NDArray[np.float64], start_s: float, rate_hz: float, kind: int) -> str:
    """What a file looks like that was never written, cut while it was, or written by another program."""
    text = as_csv(values, start_s, rate_hz)
    return ("", text[: text.rindex(",") - 10], text.replace("FZ_Base", "FZ"))[kind % 3]


def write_recordings(
    folder: Path, n: int = 200, n_broken: int = 3, seed: int = 0, rate_hz: float = 500.0
) -> list[str]:
    """Write n files of which some are broken; returns the names of these."""
    rng, data = np.random.default_rng(seed), load_dataset("insertion")
    if not 0 <= n_broken <= n <= len(data):
        raise SystemExit(
            f"Expected 0 <= --broken <= --n <= {len(data)}, got --broken {n_broken} and --n {n}."
        )
    folder.mkdir(parents=True, exist_ok=True)
    rows = rng.permutation(len(data))[:n]
    kinds = dict(
        zip(sorted(rng.choice(n, n_broken, replace=False).tolist()), range(n_broken), strict=True)
    )
    names = []
    for i, row in enumerate(rows):
        name = f"insertion_{i + 1:04d}_{bool(data.y[row])}.csv"
        values, start_s = record(data.X[row], rng), 1000.0 + 12.0 * i
        text = (
            broken(values, start_s, rate_hz, kinds[i])
            if i in kinds
            else as_csv(values, start_s, rate_hz)
        )
        (folder / name).write_text(text, encoding="utf-8")
        names += [name] if i in kinds else []
    return names


def write_plants(folder: Path, n: int = 120, seed: int = 0) -> None:
    """Write five folders of n insertions each."""
    rng, data = np.random.default_rng(seed), load_dataset("insertion")
    rows = rng.permutation(len(data))[:n]
    FZ, good = data.X[rows][:, ::5].astype(np.float64), data.y[rows] == 1
    FX, time = rng.normal(0.0, 0.4, FZ.shape), np.arange(FZ.shape[1]) / 100.0
    for name in ("latin", "historian", "wide", "bag", "lab"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    german, names = (
        {"sep": ";", "decimal": ",", "encoding": "latin-1", "index": False},
        [f"P{i + 1:04d}" for i in range(n)],
    )
    for name, force in zip(names, FZ, strict=True):
        pd.DataFrame({"Zeit": time, "Stößelkraft": force}).to_csv(
            folder / "latin" / f"{name}.csv", **german
        )
    told = pd.DataFrame({"Datei": names, "Ergebnis": np.where(good, "i.O.", "n.i.O.")})
    told.to_csv(folder / "latin" / "Prüfung.csv", **german)
    clock = pd.Timestamp("2026-03-02 06:00:00") + pd.to_timedelta(
        (12.0 * np.arange(n)[:, None] + time).ravel(), unit="s"
    )
    long = {
        "timestamp": clock,
        "serial": np.repeat(np.arange(n) + 40001, len(time)),
        "force_z": FZ.ravel(),
    }
    long["verdict"] = np.repeat(np.where(good, "OK", "NOK"), len(time))
    pd.DataFrame(long).to_parquet(folder / "historian" / "export.parquet")
    wide = {
        f"{name}_{i}": X[:, i] for name, X in (("FX", FX), ("FZ", FZ)) for i in range(len(time))
    }
    pd.DataFrame(wide).assign(result=np.where(good, "pass", "fail")).to_csv(
        folder / "wide" / "shift.csv", index=False
    )
    np.savez(folder / "lab" / "runs.npz", force=FZ, torque=FX, accepted=good)
    write_messages(folder / "bag" / "cell.mcap", messages_of(FZ, good))


VECTORS = "geometry_msgs/Vector3 force\ngeometry_msgs/Vector3 torque\n"
KINDS = {
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec\n",
    "geometry_msgs/Wrench": VECTORS,
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z\n",
}
SAID = [f"{'=' * 80}\nMSG: {kind}\n{text}" for kind, text in KINDS.items()]
STAMPED, BARE = (
    "".join(["std_msgs/Header header\ngeometry_msgs/Wrench wrench\n", *SAID]),
    VECTORS + SAID[-1],
)
TOPICS = {
    "/phase": ("std_msgs/msg/Int32", "int32 data"),
    "/height_check/ok": ("std_msgs/msg/Bool", "bool data"),
}
Message = tuple[int, str, dict[str, Any]]  # nanoseconds, topic, content


def write_messages(
    path: Path, messages: Iterable[Message], stamped: bool = False, wrench: str = "/wrench"
) -> Path:
    """ROS 2 messages as an MCAP file: a wrench, with stamps or without, a phase, and the height check's word."""
    from mcap_ros2.writer import Writer

    kind = (
        ("geometry_msgs/msg/WrenchStamped", STAMPED)
        if stamped
        else ("geometry_msgs/msg/Wrench", BARE)
    )
    with path.open("wb") as file:
        writer = Writer(file)
        schemas = {
            topic: writer.register_msgdef(*kind)
            for topic, kind in (TOPICS | {wrench: kind}).items()
        }
        for number, (time, topic, message) in enumerate(messages):
            writer.write_message(topic, schemas[topic], message, time, time, number)
        writer.finish()  # type: ignore[no-untyped-call]  # it has no types
    return path


def messages_of(FZ: NDArray[np.float64], good: NDArray[np.bool_]) -> Iterator[Message]:
    """A wrench at 100 Hz, half a second of rest around each insertion, and the height check's word after it."""
    time, zero = 10**18, {"x": 0.0, "y": 0.0, "z": 0.0}
    for force, ok in zip(FZ, good, strict=True):
        for i, z in enumerate([*[0.0] * 50, *force, *[0.0] * 50]):
            time += 10**7
            yield time, "/phase", {"data": int(50 <= i < 50 + len(force))}
            yield time, "/wrench", {"force": zero | {"z": float(z)}, "torque": zero}
            if i == 60 + len(force):
                yield time, "/height_check/ok", {"data": bool(ok)}


def main() -> None:
    """Parse, write, say what is broken."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--out", type=Path, required=True, help="the folder to write; made if need be"
    )
    parser.add_argument("--n", type=int, default=200, help="files (default: 200)")
    parser.add_argument(
        "--broken", type=int, default=3, help="of these so many that cannot be read (default: 3)"
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="the same seed, the same files (default: 0)"
    )
    parser.add_argument(
        "--plants", action="store_true", help="write five folders, as five plants do"
    )
    args = parser.parse_args()
    if args.plants:
        write_plants(args.out, args.n, args.seed)
        return
    names = write_recordings(args.out, args.n, args.broken, args.seed)
    print(f"Wrote {args.n} recordings to {args.out}; broken: {', '.join(names) or 'none'}.")


if __name__ == "__main__":
    main()
