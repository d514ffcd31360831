"""Bags and long tables: one recording, cut into parts by a trigger or by a listing, as described."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from dengine import Dataset, describe, load_dataset
from dengine.cli.options import parse_stated
from dengine.errors import DataError

pytest.importorskip("mcap_ros2.writer", reason='mcap is not installed: pip install "dengine[mcap]"')

STEP = 2_000_000  # nanoseconds
BEGIN = 1_700_000_000_000_000_000
# of a part, and between two
SAMPLES = 60
REST = 40
FORCE = "/ft/wrench"
PHASE = "/phase"
CHECK = "/height_check/ok"
FZ = f"{FORCE}.wrench.force.z"

VECTOR = "=" * 80 + "\nMSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n"
WRENCH = "geometry_msgs/Vector3 force\ngeometry_msgs/Vector3 torque\n"
STAMPED = (
    "std_msgs/Header header\ngeometry_msgs/Wrench wrench\n"
    f"{'=' * 80}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
    f"{'=' * 80}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
    f"{'=' * 80}\nMSG: geometry_msgs/Wrench\n{WRENCH}"
)
TYPES = {
    PHASE: ("std_msgs/msg/Int32", "int32 data"),
    CHECK: ("std_msgs/msg/Bool", "bool data"),
}


class Bag:
    """Writes a recording of 8 parts; what a test changes of it are the times, and which messages
    are left out.
    """

    def __init__(self) -> None:
        rng = np.random.default_rng(0)
        self.good = rng.random(8) < 0.6
        self.traces = rng.normal(0.0, 1.0, (8, 6, SAMPLES)) + 10.0
        length = 8 * (SAMPLES + REST) + REST
        self.wrench = np.zeros((length, 6))
        self.phase = np.zeros(length, dtype=int)
        self.starts = [REST + i * (SAMPLES + REST) for i in range(8)]
        for start, trace in zip(self.starts, self.traces, strict=True):
            self.wrench[start : start + SAMPLES] = trace.T
            self.phase[start : start + SAMPLES] = 1
        self.stamps = BEGIN + STEP * np.arange(length)
        self.logged = self.stamps + 500_000
        self.lost: set[int] = set()
        self.stamped = True
        self.told = {i: bool(good) for i, good in enumerate(self.good)}

    @property
    def fz(self) -> np.ndarray:
        return self.traces[:, 2].astype(np.float32)

    def write(self, path: Path, rows: slice = slice(None), chunk_bytes: int = 2**20) -> Path:
        from mcap_ros2.writer import Writer

        kind, text = "geometry_msgs/msg/Wrench", WRENCH + VECTOR
        if self.stamped:
            kind, text = "geometry_msgs/msg/WrenchStamped", STAMPED + VECTOR
        path.parent.mkdir(exist_ok=True)
        with path.open("wb") as file:
            writer = Writer(file, chunk_size=chunk_bytes)
            types = TYPES | {FORCE: (kind, text)}
            schemas = {topic: writer.register_msgdef(*about) for topic, about in types.items()}
            for i, (time, topic, message) in enumerate(self.messages(rows)):
                writer.write_message(topic, schemas[topic], message, time, time, i)
            writer.finish()
        return path

    def messages(self, rows: slice) -> Iterator[tuple[int, str, dict]]:
        ends = {start + SAMPLES + 10: i for i, start in enumerate(self.starts)}
        for i in range(len(self.wrench))[rows]:
            time = int(self.logged[i])
            yield time, PHASE, {"data": int(self.phase[i])}
            if i not in self.lost:
                yield time, FORCE, self.message(i)
            if ends.get(i) in self.told:
                yield time, CHECK, {"data": self.told[ends[i]]}

    def message(self, i: int) -> dict:
        x = self.wrench[i].tolist()
        vectors = (dict(zip("xyz", v, strict=True)) for v in (x[:3], x[3:]))
        wrench = dict(zip(("force", "torque"), vectors, strict=True))
        sec, nanosec = divmod(int(self.stamps[i]), 10**9)
        header = {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": "tool0"}
        return {"header": header, "wrench": wrench} if self.stamped else wrench


@pytest.fixture
def bag() -> Bag:
    return Bag()


STATED = {
    "windows.trigger": f"register=1@{PHASE}",
    "label.topic": CHECK,
    "traces.samples": SAMPLES,
}


def read(path: Path, **stated: object) -> Dataset:
    """Read a bag by its proposal and three stated keys: its trigger, its labels and its lengths."""
    return load_dataset(path, describe(path, {**STATED, **stated}))


def test_a_bag_that_cannot_be_opened_is_refused(
    bag: Bag, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = bag.write(tmp_path / "a.mcap")
    description = describe(path, STATED)
    monkeypatch.setattr(Path, "open", lambda path, *_: path.mkdir())  # which raises an OSError
    for read in (describe, lambda path: load_dataset(path, description)):
        with pytest.raises(DataError, match=r"a.mcap: Expected a whole MCAP file.*File exists"):
            read(path)


def listing(bag: Bag, path: Path, first: int = 0) -> None:
    """Write from when to when each part ran, in ISO times; parts have the numbers from first on."""
    times = [bag.stamps[start] for start in bag.starts]
    ends = [time + STEP * SAMPLES for time in times]
    iso = [[f"{np.datetime64(int(t), 'ns')}Z" for t in some] for some in (times, ends)]
    words = ["OK" if good else "NOK" for good in bag.good]
    numbered = enumerate(zip(*iso, words, strict=True), first)
    rows = [f"{i},{a},{b},{w}" for i, (a, b, w) in numbered]
    path.write_text("part,start,end,result\n" + "\n".join(rows) + "\n")


@pytest.mark.parametrize("stamped", [True, False])
def test_a_bag_is_cut_by_its_trigger_and_labelled_by_a_topic(
    bag: Bag, tmp_path: Path, stamped: bool
) -> None:
    bag.stamped = stamped
    proposal = describe(bag.write(tmp_path / "cell.mcap"))
    assert sorted(proposal.open_keys) == sorted(STATED)
    for key in ("windows.trigger", "label.topic"):
        assert "/phase (1: 480, 0: 360)" in proposal.notes[key]
        assert f"{CHECK} (" in proposal.notes[key]
    data = read(tmp_path / "cell.mcap")
    np.testing.assert_array_equal(data.X, bag.fz)
    assert data.y.tolist() == bag.good.tolist()
    assert (data.rate_hz, data.unit) == (500.0, "N")
    column = f"{FORCE}.wrench.force.x" if stamped else f"{FORCE}.force.x"
    both = read(tmp_path / "cell.mcap", channels={column: "N", column[:-1] + "z": "N"})
    np.testing.assert_array_equal(both.X[:, 0], bag.traces[:, 0].astype(np.float32))


def test_a_listing_of_starts_and_ends_cuts_a_bag(bag: Bag, tmp_path: Path) -> None:
    bag.write(tmp_path / "cell.mcap")
    listing(bag, tmp_path / "cycles.csv")
    windows = '{listing="cycles.csv", key="part", start="start", end="end", format="iso"}'
    label = '{listing="cycles.csv", key="part", column="result", good="OK", bad="NOK"}'
    stated = parse_stated([f"windows={windows}", f"label={label}", f"traces.samples={SAMPLES}"])
    data = load_dataset(tmp_path, describe(tmp_path, stated))
    np.testing.assert_array_equal(data.X, bag.fz)
    assert data.y.tolist() == bag.good.tolist()
    assert data.part is not None
    assert data.part.tolist() == [str(i) for i in range(8)]


def test_a_folder_of_several_files_is_one_recording(bag: Bag, tmp_path: Path) -> None:
    half = bag.starts[4] + 20
    bag.write(tmp_path / "bag" / "bag_0.mcap", slice(0, half))
    bag.write(tmp_path / "bag" / "bag_1.mcap", slice(half, None))
    (tmp_path / "bag" / "metadata.yaml").write_text("rosbag2_bagfile_information:\n")
    data = read(tmp_path / "bag")
    np.testing.assert_array_equal(data.X, bag.fz)
    assert data.y.tolist() == bag.good.tolist()


def test_a_lost_message_and_a_missing_label_are_faults_and_nothing_is_filled_in(
    bag: Bag, tmp_path: Path
) -> None:
    bag.lost = {bag.starts[2] + 10}
    del bag.told[5]
    data = read(bag.write(tmp_path / "cell.mcap"))
    np.testing.assert_array_equal(data.X, np.delete(bag.fz, [2, 5], axis=0))
    texts = sorted(map(str, data.faults))
    assert [text.partition(":")[0].partition(", column")[0] for text in texts] == [
        "cell.mcap, 3",
        "cell.mcap, 6",
    ]
    assert "got 0.004 s before row 11" in texts[0]


def test_a_file_that_was_not_closed_or_is_damaged_is_a_fault_and_read_up_to_there(
    bag: Bag, tmp_path: Path
) -> None:
    path = bag.write(tmp_path / "cell.mcap", chunk_bytes=4096)
    description = describe(path, STATED)
    content = path.read_bytes()
    cut = int(len(content) * 0.6)
    for damaged in (content[:cut], content[:cut] + b"\xff" * 2000 + content[cut + 2000 :]):
        path.write_bytes(damaged)
        assert describe(path, STATED).time == description.time
        data = load_dataset(path, description)
        assert 3 <= len(data) < 8
        np.testing.assert_array_equal(data.X, bag.fz[: len(data)])
        assert data.y.tolist() == bag.good[: len(data)].tolist()
        assert data.faults[0].source == "cell.mcap"
        assert "messages are read" in str(data.faults[0])
    path.write_bytes(b"")
    with pytest.raises(DataError, match="Expected a whole MCAP file"):
        load_dataset(path, description)
    with pytest.raises(DataError, match="Expected a whole MCAP file"):
        describe(path)


def test_a_damaged_file_before_others_is_refused_where_a_trigger_cuts(
    bag: Bag, tmp_path: Path
) -> None:
    half = bag.starts[4] + 20
    path = bag.write(tmp_path / "bag" / "bag_0.mcap", slice(0, half), chunk_bytes=4096)
    bag.write(tmp_path / "bag" / "bag_1.mcap", slice(half, None))
    description = describe(tmp_path / "bag", STATED)
    content = path.read_bytes()
    for size in range(len(content) // 2, len(content) - 1, 97):
        path.write_bytes(content[:size])
        with pytest.raises(DataError, match=r"whole files before bag_1\.mcap"):
            load_dataset(tmp_path / "bag", description)


def test_files_of_another_storage_are_refused_with_how_to_convert_them(tmp_path: Path) -> None:
    (tmp_path / "bag_0.db3").write_bytes(b"SQLite format 3\0")
    with pytest.raises(DataError, match=r"got bag_0\.db3; `ros2 bag convert`"):
        describe(tmp_path)


def test_a_long_table_is_cut_like_a_bag(bag: Bag, tmp_path: Path) -> None:
    rows = zip(bag.stamps, bag.wrench[:, 2], bag.phase, strict=True)
    text = "".join(f"{np.datetime64(int(t), 'ns')}Z,{z:.9g},{p}\n" for t, z, p in rows)
    (tmp_path / "shift.csv").write_text(f"time,FZ,phase\n{text}")
    listing(bag, tmp_path / "cycles.csv", first=1)  # a trigger's parts have the numbers from 1 on
    description = {
        "files": "shift.csv",
        "channels": {"FZ": "N"},
        "time": {"column": "time", "format": "iso", "rate_hz": 500.0},
        "windows": {"trigger": "register=1@phase"},
        "label": {
            "listing": "cycles.csv",
            "key": "part",
            "column": "result",
            "good": "OK",
            "bad": "NOK",
        },
        "traces": {"samples": SAMPLES},
    }
    data = load_dataset(tmp_path, description)
    np.testing.assert_allclose(data.X, bag.fz, rtol=1e-6)
    assert data.y.tolist() == bag.good.tolist()
