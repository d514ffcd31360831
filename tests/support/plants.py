"""The bundled insertions as five plants might record them, 200 samples at 100 Hz: CSV files in Latin-1
with decimal commas and labels in another file; the long Parquet table of a historian; a wide CSV of
two channels; a ROS 2 bag; and an .npz file with other names.
"""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from dengine import load_dataset

PLANT_RATE_HZ = 100
PLANT_STEP = 5  # of the 500 Hz samples, a plant has every fifth
CYCLE_SECONDS = 12.0  # from one recording to the next

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


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
