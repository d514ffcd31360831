"""Bags and long tables: one recording, cut into parts by a trigger or by a listing, as described."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dengine import Dataset, describe, load_dataset
from dengine.cli.options import parse_stated
from dengine.errors import DataError

pytest.importorskip("mcap_ros2.writer", reason='mcap is not installed: pip install "dengine[mcap]"')

STEP = 2_000_000  # nanoseconds
BEGIN = 1_700_000_000_000_000_000
PARTS = 8
# of a part, and between two
SAMPLES = 60
REST = 40
STARTS = [REST + i * (SAMPLES + REST) for i in range(PARTS)]
HALF = STARTS[4] + 20
FORCE = "/ft/wrench"
PHASE = "/phase"
CHECK = "/height_check/ok"

LINE = "=" * 80
VECTOR = f"{LINE}\nMSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n"
WRENCH = "geometry_msgs/Vector3 force\ngeometry_msgs/Vector3 torque\n"
STAMPED = f"""std_msgs/Header header\ngeometry_msgs/Wrench wrench
{LINE}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id
{LINE}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec
{LINE}\nMSG: geometry_msgs/Wrench\n{WRENCH}{VECTOR}"""
TYPES = {
    PHASE: ("std_msgs/msg/Int32", "int32 data"),
    CHECK: ("std_msgs/msg/Bool", "bool data"),
    FORCE: ("geometry_msgs/msg/WrenchStamped", STAMPED),
}


class Bag:
    """Writes a recording of 8 parts; a test may leave out messages."""

    def __init__(self) -> None:
        rng = np.random.default_rng(0)
        self.good = rng.random(PARTS) < 0.6
        traces = rng.normal(10.0, 1.0, (PARTS, SAMPLES, 3))
        rest_first = np.pad(traces, ((0, 0), (REST, 0), (0, 0))).reshape(-1, 3)
        self.force = np.pad(rest_first, ((0, REST), (0, 0)))
        self.traces = traces.astype(np.float32)
        self.fz = self.traces[..., 2]
        self.phase = self.force.any(axis=1).astype(int)
        self.stamps = BEGIN + STEP * np.arange(len(self.force))
        self.labels = {
            start + SAMPLES + 10: good for start, good in zip(STARTS, self.good, strict=True)
        }
        self.lost: set[int] = set()
        self.types = TYPES

    def write(self, path: Path, rows: slice = slice(None), chunk_bytes: int = 2**20) -> Path:
        from mcap_ros2.writer import Writer

        path.parent.mkdir(exist_ok=True)
        with path.open("wb") as file:
            writer = Writer(file, chunk_size=chunk_bytes)
            schemas = {topic: writer.register_msgdef(*kind) for topic, kind in self.types.items()}
            for i in range(len(self.force))[rows]:
                logged = int(self.stamps[i]) + 500_000
                for topic, message in self.messages(i).items():
                    writer.write_message(topic, schemas[topic], message, logged, logged, i)
            writer.finish()
        return path

    def messages(self, i: int) -> dict[str, dict]:
        """Return what is written at a step, by its topic."""
        messages = {PHASE: {"data": int(self.phase[i])}}
        if i not in self.lost:
            vector = dict(zip("xyz", self.force[i].tolist(), strict=True))
            wrench = {"force": vector, "torque": vector}
            sec, nanosec = divmod(int(self.stamps[i]), 10**9)
            header = {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": "tool0"}
            is_stamped = self.types is TYPES
            messages[FORCE] = {"header": header, "wrench": wrench} if is_stamped else wrench
        if i in self.labels:
            messages[CHECK] = {"data": bool(self.labels[i])}
        return messages


@pytest.fixture
def bag():
    return Bag()


TABLE = f"""files=shift.csv
channels={{FZ="N"}}
time={{column="time", format="iso", rate_hz=500.0}}
windows={{trigger="register=1@phase"}}
label={{listing="cycles.csv", key="part", column="result", good="OK", bad="NOK"}}
traces={{samples={SAMPLES}}}"""
STATED = {
    "windows.trigger": f"register=1@{PHASE}",
    "label.topic": CHECK,
    "traces.samples": SAMPLES,
}


def read(path: Path, **stated: object) -> Dataset:
    """Read a bag by its proposal and three stated keys: its trigger, its labels and its lengths."""
    return load_dataset(path, describe(path, {**STATED, **stated}))


def assert_read(data: Dataset, bag: Bag, rows: Any = slice(None)) -> None:
    """Check that these parts are read with their labels."""
    np.testing.assert_allclose(data.X, bag.fz[rows], rtol=1e-6)
    assert data.y.tolist() == bag.good[rows].tolist()


def listing(bag: Bag, path: Path, first: int = 0) -> None:
    """Write from when to when each part ran, in ISO times; parts have the numbers from first on."""
    rows = ["part,start,end,result"]
    for i, start in enumerate(STARTS):
        times = (np.datetime64(int(bag.stamps[row]), "ns") for row in (start, start + SAMPLES))
        rows.append(f"{i + first},{'Z,'.join(map(str, times))}Z,{'OK' if bag.good[i] else 'NOK'}")
    path.write_text("\n".join(rows))


@pytest.mark.parametrize("stamped", [True, False])
def test_a_bag_is_cut_by_its_trigger_and_labelled_by_a_topic(bag, tmp_path, stamped):
    if not stamped:
        bag.types = TYPES | {FORCE: ("geometry_msgs/msg/Wrench", WRENCH + VECTOR)}
    path = bag.write(tmp_path / "cell.mcap")
    proposal = describe(path)
    assert sorted(proposal.open_keys) == sorted(STATED)
    for key in ("windows.trigger", "label.topic"):
        assert "/phase (1: 480, 0: 360)" in proposal.notes[key]
        assert f"{CHECK} (" in proposal.notes[key]
    data = read(path)
    assert_read(data, bag)
    assert (data.rate_hz, data.unit) == (500.0, "N")
    column = f"{FORCE}.wrench.force" if stamped else f"{FORCE}.force"
    both = read(path, channels={f"{column}.x": "N", f"{column}.z": "N"})
    np.testing.assert_array_equal(both.X[:, 0], bag.traces[..., 0])


def test_a_listing_of_starts_and_ends_cuts_a_bag(bag, tmp_path):
    bag.write(tmp_path / "cell.mcap")
    listing(bag, tmp_path / "cycles.csv")
    windows = '{listing="cycles.csv", key="part", start="start", end="end", format="iso"}'
    label = '{listing="cycles.csv", key="part", column="result", good="OK", bad="NOK"}'
    stated = parse_stated([f"windows={windows}", f"label={label}", f"traces.samples={SAMPLES}"])
    data = load_dataset(tmp_path, describe(tmp_path, stated))
    assert_read(data, bag)
    assert data.part.tolist() == [*"01234567"]


def test_a_folder_of_several_files_is_one_recording_unless_one_before_others_is_damaged(
    bag, tmp_path
):
    folder = tmp_path / "bag"
    first = bag.write(folder / "bag_0.mcap", slice(0, HALF), chunk_bytes=4096)
    bag.write(folder / "bag_1.mcap", slice(HALF, None))
    (folder / "metadata.yaml").write_text("rosbag2_bagfile_information:\n")
    assert_read(read(folder), bag)
    description, content = describe(folder, STATED), first.read_bytes()
    for size in range(len(content) // 2, len(content) - 1, 2500):
        first.write_bytes(content[:size])
        with pytest.raises(DataError, match=r"whole files before bag_1\.mcap"):
            load_dataset(folder, description)


def test_a_lost_message_and_no_label_or_two_are_faults_and_nothing_is_filled_in(bag, tmp_path):
    bag.lost = {STARTS[2] + 10}
    del bag.labels[STARTS[5] + SAMPLES + 10]
    bag.labels[STARTS[3] + SAMPLES + 20] = not bag.good[3]
    data = read(bag.write(tmp_path / "cell.mcap"))
    assert_read(data, bag, [0, 1, 4, 6, 7])
    faults = sorted(map(str, data.faults))
    assert [re.split("[:,] ", fault)[1] for fault in faults] == ["3", "4", "6"]
    assert "got 0.004 s before row 11" in faults[0]


def test_a_file_that_was_not_closed_or_is_damaged_is_a_fault_and_read_up_to_there(bag, tmp_path):
    path = bag.write(tmp_path / "cell.mcap", chunk_bytes=4096)
    description, content = describe(path, STATED), path.read_bytes()
    cut = int(len(content) * 0.6)
    for damaged in (content[:cut], content[:cut] + b"\xff" * 2000 + content[cut + 2000 :]):
        path.write_bytes(damaged)
        assert describe(path, STATED).time == description.time
        data = load_dataset(path, description)
        assert 3 <= len(data) < 8
        assert_read(data, bag, slice(len(data)))
        assert "messages are read" in str(data.faults[0])
    path.write_bytes(b"")
    for refuse in (describe, lambda path: load_dataset(path, description)):
        with pytest.raises(DataError, match="Expected a whole MCAP file"):
            refuse(path)


def test_files_of_another_storage_are_refused_with_how_to_convert_them(tmp_path):
    (tmp_path / "bag_0.db3").write_bytes(b"SQLite format 3\0")
    with pytest.raises(DataError, match=r"got bag_0\.db3; `ros2 bag convert`"):
        describe(tmp_path)


def test_a_long_table_is_cut_like_a_bag(bag, tmp_path):
    rows = zip(bag.stamps, bag.force[:, 2], bag.phase, strict=True)
    text = "".join(f"{np.datetime64(int(t), 'ns')}Z,{z:.9g},{p}\n" for t, z, p in rows)
    (tmp_path / "shift.csv").write_text(f"time,FZ,phase\n{text}")
    path = tmp_path / "cycles.csv"
    listing(bag, path, first=1)  # a trigger's parts have the numbers from 1 on
    description = parse_stated(TABLE.splitlines())
    assert_read(load_dataset(tmp_path, description), bag)
    path.write_text(path.read_text().rpartition("\n")[0])
    with pytest.raises(DataError, match=r"a row of cycles\.csv for each of 8 starts"):
        load_dataset(tmp_path, description)
