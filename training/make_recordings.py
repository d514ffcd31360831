"""Write recordings as a robot cell makes them, from the bundled data set: examples for an import.

    python training/make_recordings.py --out recordings --n 200 --broken 3
    dengine data recordings
    python training/make_recordings.py --out plants --plants --n 120

The first command writes one CSV file per insertion, as UR cells record them, for example
`insertion_0001_True.csv`: 960 to 1040 rows at 500 Hz, the simulated force in FZ_Base, small noise
in the other columns, and the label in the name. A recording that is longer than the simulated one
stays at its last level, with the noise of its sensor; a shorter one stops earlier. Of three broken
files the first is empty, the second is cut in its last line, and the third has another name for the
force. The same seed writes the same files.

--plants writes the same insertions, 200 samples at 100 Hz, as five plants might: CSV files in
Latin-1 with decimal commas and labels in another file; the long Parquet table of a historian; a
wide CSV of two channels; a ROS 2 bag; and an .npz file with other names.
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
SHORTEST = 960  # rows of a recording
LONGEST = 1040
TAIL = 50  # samples at the end that give the level and the noise of a longer recording
PLANT_RATE_HZ = 100
PLANT_STEP = 5  # of the 500 Hz samples, a plant has every fifth
CYCLE_SECONDS = 12.0  # from one recording to the next

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


def record(force: NDArray[np.float32], rng: np.random.Generator) -> Floats:
    """Return a force (T,) as a recording (rows, channels) of a random length."""
    n_rows = int(rng.integers(SHORTEST, LONGEST + 1))
    tail = force[-TAIL:].astype(np.float64)
    rest = tail.mean() + rng.normal(0.0, tail.std(), max(0, n_rows - len(force)))
    values = rng.normal(0.0, NOISE, (n_rows, len(CHANNELS)))
    values[:, FORCE] = np.concatenate([force, rest])[:n_rows]
    values[:, CHANNELS.index("TCP_Z")] += np.linspace(0.25, 0.21, n_rows)
    return values


def to_csv(values: Floats, start_s: float, rate_hz: float) -> str:
    """Return a recording as CSV text: the seconds of the controller, then the channels."""
    frame = pd.DataFrame(values, columns=CHANNELS)
    frame.insert(0, "Timestamp", start_s + np.arange(len(values)) / rate_hz)
    return str(frame.to_csv(index=False, float_format="%.7g"))


def break_text(text: str, index: int) -> str:
    """Return a file's text broken in one of three ways, which follow each other by `index`.

    It is empty, or cut off in its last line, or its force has another name.
    """
    if index % 3 == 0:
        return ""
    if index % 3 == 1:
        return text[: text.rindex(",") - 10]
    return text.replace("FZ_Base", "FZ")


def write_recordings(
    folder: Path, n: int = 200, n_broken: int = 3, seed: int = 0, rate_hz: float = 500.0
) -> list[str]:
    """Write n recordings as CSV files, some of them broken; return the names of the broken ones.

    Raises SystemExit unless 0 <= n_broken <= n, and n is at most the number of bundled traces.
    """
    rng = np.random.default_rng(seed)
    data = load_dataset("insertion")
    if not 0 <= n_broken <= n <= len(data):
        raise SystemExit(
            f"Expected 0 <= --broken <= --n <= {len(data)}, got --broken {n_broken} and --n {n}."
        )
    folder.mkdir(parents=True, exist_ok=True)
    rows = rng.permutation(len(data))[:n]
    broken = sorted(rng.choice(n, n_broken, replace=False).tolist())
    broken_names = []
    for i, row in enumerate(rows):
        name = f"insertion_{i + 1:04d}_{bool(data.y[row])}.csv"
        text = to_csv(record(data.X[row], rng), 1000.0 + CYCLE_SECONDS * i, rate_hz)
        if i in broken:
            text = break_text(text, broken.index(i))
            broken_names.append(name)
        (folder / name).write_text(text, encoding="utf-8")
    return broken_names


def write_plants(folder: Path, n: int = 120, seed: int = 0) -> None:
    """Write five folders of n insertions each: latin, historian, wide, bag and lab."""
    rng = np.random.default_rng(seed)
    data = load_dataset("insertion")
    rows = rng.permutation(len(data))[:n]
    force = data.X[rows][:, ::PLANT_STEP].astype(np.float64)  # (n, T)
    good = data.y[rows] == 1
    side_force = rng.normal(0.0, 0.4, force.shape)
    for name in ("latin", "historian", "wide", "bag", "lab"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    write_latin(folder / "latin", force, good)
    write_historian(folder / "historian" / "export.parquet", force, good)
    write_wide(folder / "wide" / "shift.csv", {"FX": side_force, "FZ": force}, good)
    np.savez(folder / "lab" / "runs.npz", force=force, torque=side_force, accepted=good)
    write_messages(folder / "bag" / "cell.mcap", cell_messages(force, good))


def sample_times(n_samples: int) -> Floats:
    """Return the seconds of a plant's samples."""
    return np.arange(n_samples) / PLANT_RATE_HZ


def write_latin(folder: Path, force: Floats, good: Bools) -> None:
    """Write a file for each force of (n, T), and one with all labels, as a German Excel does."""
    form: dict[str, Any] = {"sep": ";", "decimal": ",", "encoding": "latin-1", "index": False}
    names = [f"P{i + 1:04d}" for i in range(len(force))]
    for name, trace in zip(names, force, strict=True):
        frame = pd.DataFrame({"Zeit": sample_times(len(trace)), "Stößelkraft": trace})
        frame.to_csv(folder / f"{name}.csv", **form)
    labels = pd.DataFrame({"Datei": names, "Ergebnis": np.where(good, "i.O.", "n.i.O.")})
    labels.to_csv(folder / "Prüfung.csv", **form)


def write_historian(path: Path, force: Floats, good: Bools) -> None:
    """Write a Parquet table with a row for each sample of the forces (n, T)."""
    n, n_samples = force.shape
    seconds = CYCLE_SECONDS * np.arange(n)[:, None] + sample_times(n_samples)
    start = pd.Timestamp("2026-03-02 06:00:00")
    columns = {
        "timestamp": start + pd.to_timedelta(seconds.ravel(), unit="s"),
        "serial": np.repeat(np.arange(n) + 40001, n_samples),
        "force_z": force.ravel(),
        "verdict": np.repeat(np.where(good, "OK", "NOK"), n_samples),
    }
    pd.DataFrame(columns).to_parquet(path)


def write_wide(path: Path, channels: dict[str, Floats], good: Bools) -> None:
    """Write a CSV table with a row for each insertion and a column for each sample of a channel."""
    columns = {
        f"{name}_{i}": values for name, X in channels.items() for i, values in enumerate(X.T)
    }
    frame = pd.DataFrame(columns).assign(result=np.where(good, "pass", "fail"))
    frame.to_csv(path, index=False)


# ROS 2 message definitions: a wrench with and without a header, each with what it consists of.
WRENCH_FIELDS = "geometry_msgs/Vector3 force\ngeometry_msgs/Vector3 torque\n"
DEFINITIONS = {
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec\n",
    "geometry_msgs/Wrench": WRENCH_FIELDS,
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z\n",
}
PARTS = {name: f"{'=' * 80}\nMSG: {name}\n{text}" for name, text in DEFINITIONS.items()}
WRENCH = WRENCH_FIELDS + PARTS["geometry_msgs/Vector3"]
STAMPED_FIELDS = "std_msgs/Header header\ngeometry_msgs/Wrench wrench\n"
STAMPED_WRENCH = STAMPED_FIELDS + "".join(PARTS.values())
TOPICS = {
    "/phase": ("std_msgs/msg/Int32", "int32 data"),
    "/height_check/ok": ("std_msgs/msg/Bool", "bool data"),
    "/part_id": ("std_msgs/msg/String", "string data"),
}
Message = tuple[int, str, dict[str, Any]]  # nanoseconds, topic, content


def write_messages(
    path: Path,
    messages: Iterable[Message],
    stamped: bool = False,
    wrench: str = "/wrench",
    chunk_bytes: int = 2**20,
) -> Path:
    """Write ROS 2 messages as an MCAP file.

    Parameters
    ----------
    path : Path
    messages : iterable of Message
        Of the `TOPICS` and of the wrench.
    stamped : bool, default False
        Whether the wrenches have a header with a stamp.
    wrench : str, default "/wrench"
        Topic of the wrenches.
    chunk_bytes : int, default 2**20
        Size of a chunk, unpacked.

    Returns
    -------
    path : Path
    """
    from mcap_ros2.writer import Writer

    wrench_type = ("geometry_msgs/msg/Wrench", WRENCH)
    if stamped:
        wrench_type = ("geometry_msgs/msg/WrenchStamped", STAMPED_WRENCH)
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=chunk_bytes)
        schemas = {
            topic: writer.register_msgdef(*message_type)
            for topic, message_type in (TOPICS | {wrench: wrench_type}).items()
        }
        for number, (time, topic, message) in enumerate(messages):
            writer.write_message(topic, schemas[topic], message, time, time, number)
        writer.finish()  # type: ignore[no-untyped-call]  # it has no types
    return path


def cell_messages(forces: Floats, good: Bools) -> Iterator[Message]:
    """Yield the messages of a cell: wrench and phase at 100 Hz, and the label after each insertion.

    Half a second of rest lies before and after each insertion.
    """
    rest = [0.0] * 50
    zero = {"x": 0.0, "y": 0.0, "z": 0.0}
    time = 10**18
    for force, is_good in zip(forces, good, strict=True):
        for i, z in enumerate([*rest, *force, *rest]):
            time += 10**9 // PLANT_RATE_HZ
            is_insertion = len(rest) <= i < len(rest) + len(force)
            yield time, "/phase", {"data": int(is_insertion)}
            yield time, "/wrench", {"force": zero | {"z": float(z)}, "torque": zero}
            if i == len(rest) + 10 + len(force):
                yield time, "/height_check/ok", {"data": bool(is_good)}


def main() -> None:
    """Write the recordings; print the names of the broken ones."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--out", type=Path, required=True, help="the folder to write; created if it is missing"
    )
    parser.add_argument("--n", type=int, default=200, help="files (default: 200)")
    parser.add_argument(
        "--broken", type=int, default=3, help="how many of these cannot be read (default: 3)"
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="the same seed, the same files (default: 0)"
    )
    parser.add_argument(
        "--plants", action="store_true", help="write five folders, as five plants do"
    )
    arguments = parser.parse_args()
    if arguments.plants:
        write_plants(arguments.out, arguments.n, arguments.seed)
        return
    names = write_recordings(arguments.out, arguments.n, arguments.broken, arguments.seed)
    broken = ", ".join(names) or "none"
    print(f"Wrote {arguments.n} recordings to {arguments.out}; broken: {broken}.")


if __name__ == "__main__":
    main()
