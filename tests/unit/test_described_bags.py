"""Bags and long tables: one recording, cut into parts by a trigger or by a listing, as described."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dengine import Dataset, Description, describe, load_dataset
from dengine.cli.options import parse_stated
from dengine.errors import DataError
from tests.support.plants import Message, write_messages

pytest.importorskip("mcap_ros2.writer", reason='mcap is not installed: pip install "dengine[mcap]"')

STEP = 2_000_000  # nanoseconds
SAMPLES = 60  # of a part; 40 lie between two
STARTS = range(40, 840, 100)
STAMPS = 1_700_000_000_000_000_000 + STEP * np.arange(840)
FORCE, PHASE, CHECK = "/ft/wrench", "/phase", "/height_check/ok"
RNG = np.random.default_rng(0)
GOOD = (RNG.random(8) < 0.6).tolist()
WRENCH = np.zeros((840, 6))  # fx, fy, fz, tx, ty, tz
IN_PART = np.arange(840) % 100 >= 40
WRENCH[IN_PART] = RNG.normal(10.0, 1.0, (8 * SAMPLES, 6))
TRACES = WRENCH[IN_PART].reshape(8, SAMPLES, 6).astype(np.float32)
FX, FZ = TRACES[..., 0], TRACES[..., 2]


def messages(stamped: bool = True) -> list[Message]:
    """The messages of 8 parts: phase and wrench at 500 Hz, and a label after each part."""
    labels = dict(zip([start + SAMPLES + 10 for start in STARTS], GOOD, strict=True))
    written: list[Message] = []
    for i, (x, stamp) in enumerate(zip(WRENCH.tolist(), STAMPS.tolist(), strict=True)):
        force, torque = (dict(zip("xyz", v, strict=True)) for v in (x[:3], x[3:]))
        wrench: Any = {"force": force, "torque": torque}
        if stamped:
            sec, nanosec = divmod(stamp, 10**9)
            header = {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": "tool0"}
            wrench = {"header": header, "wrench": wrench}
        said = {PHASE: {"data": int(IN_PART[i])}, FORCE: wrench}
        said |= {CHECK: {"data": labels[i]}} if i in labels else {}
        written += [(stamp + 500_000, topic, message) for topic, message in said.items()]
    return written


def write(path: Path, written: list[Message], **options: Any) -> Path:
    return write_messages(path, written, **{"stamped": True, "wrench": FORCE, **options})


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    return write(tmp_path / "cell.mcap", messages(), chunk_bytes=4096)


STATED = {
    "windows.trigger": f"register=1@{PHASE}",
    "label.topic": CHECK,
    "traces.samples": SAMPLES,
}


def read(path: Path, **stated: object) -> Dataset:
    """Read a bag by its proposal and three stated keys: its trigger, its labels and its lengths."""
    return load_dataset(path, describe(path, {**STATED, **stated}))


def check_whole(data: Dataset) -> None:
    np.testing.assert_array_equal(data.X, FZ)
    assert data.y.tolist() == GOOD


def listing(path: Path, first: int = 0) -> None:
    """Write from when to when each part ran, in ISO times; parts have the numbers from first on."""
    rows = ["part,start,end,result"]
    for i, (start, good) in enumerate(zip(STARTS, GOOD, strict=True), first):
        times = STAMPS[start] + STEP * np.array([0, SAMPLES])
        iso = ",".join(f"{time}Z" for time in times.astype("datetime64[ns]"))
        rows.append(f"{i},{iso},{'OK' if good else 'NOK'}")
    path.write_text("\n".join(rows) + "\n")


@pytest.mark.parametrize("stamped", [True, False])
def test_a_bag_is_cut_by_its_trigger_and_labelled_by_a_topic(tmp_path: Path, stamped: bool) -> None:
    path = write(tmp_path / "cell.mcap", messages(stamped), stamped=stamped)
    proposal = describe(path)
    assert sorted(proposal.open_keys) == sorted(STATED)
    for key in ("windows.trigger", "label.topic"):
        assert "/phase (1: 480, 0: 360)" in proposal.notes[key]
        assert f"{CHECK} (" in proposal.notes[key]
    data = read(path)
    check_whole(data)
    assert (data.rate_hz, data.unit) == (500.0, "N")
    column = f"{FORCE}.wrench.force." if stamped else f"{FORCE}.force."
    both = read(path, channels={column + "x": "N", column + "z": "N"})
    np.testing.assert_array_equal(both.X, np.stack([FX, FZ], axis=1))


def test_a_listing_of_starts_and_ends_cuts_a_bag(bag: Path) -> None:
    listing(bag.with_name("cycles.csv"))
    windows = '{listing="cycles.csv", key="part", start="start", end="end", format="iso"}'
    label = '{listing="cycles.csv", key="part", column="result", good="OK", bad="NOK"}'
    stated = parse_stated([f"windows={windows}", f"label={label}", f"traces.samples={SAMPLES}"])
    data = load_dataset(bag.parent, describe(bag.parent, stated))
    check_whole(data)
    assert data.part.tolist() == [*"01234567"]


def test_a_folder_of_several_files_is_one_recording(tmp_path: Path) -> None:
    written = messages()
    write(tmp_path / "bag_0.mcap", written[:931])
    write(tmp_path / "bag_1.mcap", written[931:])
    (tmp_path / "metadata.yaml").write_text("rosbag2_bagfile_information:\n")
    check_whole(read(tmp_path))


def test_a_lost_message_and_a_missing_label_are_faults_and_nothing_is_filled_in(
    tmp_path: Path,
) -> None:
    times = STAMPS + 500_000
    lost = {(times[STARTS[2] + 10], FORCE), (times[STARTS[5] + SAMPLES + 10], CHECK)}
    data = read(write(tmp_path / "cell.mcap", [m for m in messages() if m[:2] not in lost]))
    np.testing.assert_array_equal(data.X, np.delete(FZ, [2, 5], axis=0))
    first, second = sorted(map(str, data.faults))
    assert first.startswith("cell.mcap, 3")
    assert "got 0.004 s before row 11" in first
    assert second.startswith("cell.mcap, 6")


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


def test_a_long_table_is_cut_like_a_bag(tmp_path: Path) -> None:
    rows = zip(STAMPS.astype("datetime64[ns]"), WRENCH[:, 2], IN_PART * 1, strict=True)
    text = "".join(f"{time}Z,{z:.17g},{phase}\n" for time, z, phase in rows)
    (tmp_path / "shift.csv").write_text(f"time,FZ,phase\n{text}")
    listing(tmp_path / "cycles.csv", first=1)  # a trigger's parts have the numbers from 1 on
    description = """
        files = "shift.csv"
        channels = {FZ = "N"}
        time = {column = "time", format = "iso", rate_hz = 500.0}
        windows = {trigger = "register=1@phase"}
        label = {listing = "cycles.csv", key = "part", column = "result", good = "OK", bad = "NOK"}
        traces = {samples = 60}
    """
    check_whole(load_dataset(tmp_path, Description.from_toml(description)))
