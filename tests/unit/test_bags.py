"""One long recording of a wrench, as ROS 2 writes it: cut into insertions, its gaps said; in files
that mcap writes.
"""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from dengine import load_dataset
from dengine.datasets.triggers import Trigger
from dengine.errors import DataError
from training.make_recordings import write_messages

pytest.importorskip("mcap_ros2.writer", reason='mcap is not installed: pip install "dengine[mcap]"')

STEP = 2_000_000  # nanoseconds
BEGIN = 1_700_000_000_000_000_000
# of an insertion, and between two
SAMPLES = 60
REST = 40
FORCE = "/ft/wrench"
PHASE = "/phase"
CHECK = "/height_check/ok"
PART = "/part_id"


def vector(values: np.ndarray) -> dict[str, float]:
    return dict(zip("xyz", values.tolist(), strict=True))


class Bag:
    """Writes a recording of n insertions; what a test changes of it are the times, and which
    messages are left out.
    """

    def __init__(self, n: int = 8, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        self.good = rng.random(n) < 0.6
        self.traces = rng.normal(0.0, 1.0, (n, 6, SAMPLES)) + 10.0
        length = n * (SAMPLES + REST) + REST
        self.wrench = np.zeros((length, 6))
        self.phase = np.zeros(length, dtype=int)
        self.starts = [REST + i * (SAMPLES + REST) for i in range(n)]
        for start, trace in zip(self.starts, self.traces, strict=True):
            self.wrench[start : start + SAMPLES] = trace.T
            self.phase[start : start + SAMPLES] = 1
        self.stamps = BEGIN + STEP * np.arange(length)
        self.logged = self.stamps + 500_000
        self.lost: set[int] = set()
        self.stamped = True
        self.told = {i: bool(good) for i, good in enumerate(self.good)}
        self.parts: list[str] = []

    def write(self, path: Path, parts: slice = slice(None), chunk_bytes: int = 2**20) -> Path:
        return write_messages(path, self.messages(parts), self.stamped, FORCE, chunk_bytes)

    def messages(self, parts: slice) -> Iterator[tuple[int, str, dict]]:
        ends = {start + SAMPLES + 10: i for i, start in enumerate(self.starts)}
        starts = dict(zip(self.starts, self.parts, strict=False))
        for i in range(len(self.wrench))[parts]:
            time = int(self.logged[i])
            if i in starts:
                yield time, PART, {"data": starts[i]}
            yield time, PHASE, {"data": int(self.phase[i])}
            if i not in self.lost:
                yield time, FORCE, self.message(i)
            if i in ends and ends[i] in self.told:
                yield time, CHECK, {"data": self.told[ends[i]]}

    def message(self, i: int) -> dict:
        wrench = {"force": vector(self.wrench[i, :3]), "torque": vector(self.wrench[i, 3:])}
        sec, nanosec = divmod(int(self.stamps[i]), 10**9)
        header = {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": "tool0"}
        return {"header": header, "wrench": wrench} if self.stamped else wrench


ASKED = {"trigger": "register@/phase", "label": CHECK, "samples": SAMPLES}


@pytest.fixture
def bag() -> Bag:
    return Bag()


def test_a_recording_is_cut_into_its_insertions_with_their_labels(bag: Bag, tmp_path: Path) -> None:
    data = load_dataset(bag.write(tmp_path / "cell.mcap"), **ASKED)
    np.testing.assert_array_equal(data.X, bag.traces[:, 2].astype(np.float32))
    np.testing.assert_array_equal(data.y, bag.good)
    assert (data.name, data.channels, data.rate_hz, data.faults) == ("cell", ("FZ",), 500.0, ())
    assert data.source.tolist() == [f"cell/{i}" for i in range(1, 9)]


@pytest.mark.parametrize("signal", ["FZ", "FX_Base"])
def test_it_is_cut_by_the_same_triggers_as_a_live_one(
    bag: Bag, tmp_path: Path, signal: str
) -> None:
    options = {**ASKED, "trigger": Trigger("contact", 5.0, signal, quiet_s=0.05)}
    np.testing.assert_array_equal(
        load_dataset(bag.write(tmp_path / "a.mcap"), **options).X, bag.traces[:, 2].astype("f4")
    )
    with pytest.raises(
        DataError, match="it never does"
    ):  # 0.08 s of rest are less than the 0.2 s of its text
        load_dataset(tmp_path / "a.mcap", **{**ASKED, "trigger": f"contact=5@{signal}"})


def test_a_bag_of_several_files_is_one_recording(bag: Bag, tmp_path: Path) -> None:
    folder = tmp_path / "cell"
    folder.mkdir()
    (folder / "metadata.yaml").write_text("rosbag2_bagfile_information:\n", encoding="utf-8")
    middle = bag.starts[3] + 20  # in an insertion
    bag.write(folder / "cell_2.mcap", slice(0, middle))
    bag.write(folder / "cell_10.mcap", slice(middle, None))
    data = load_dataset(folder, **ASKED)
    np.testing.assert_array_equal(data.X, bag.traces[:, 2].astype(np.float32))
    assert not data.faults


def test_a_message_that_was_lost_is_a_fault_and_says_where(bag: Bag, tmp_path: Path) -> None:
    begin = bag.starts
    bag.lost = {
        begin[1] + 30,
        *range(begin[4] + 10, begin[4] + 15),
        begin[5],
        begin[6] + SAMPLES - 1,
    }
    data = load_dataset(bag.write(tmp_path / "cell.mcap"), **ASKED)
    np.testing.assert_array_equal(data.X, bag.traces[[0, 2, 3, 7], 2].astype(np.float32))
    assert [str(fault) for fault in data.faults] == [
        f"cell/2: Expected a message each 0.002 s, 1 of {SAMPLES} are missing, the first at sample 30",
        f"cell/5: Expected a message each 0.002 s, 5 of {SAMPLES} are missing, the first at sample 10",
        "cell/6: Expected the message that it begins with, that one fell into a gap",
        f"cell/7: Expected a message each 0.002 s, 1 of {SAMPLES} are missing, the first at sample {SAMPLES - 1}",
    ]


def test_a_message_that_came_late_is_not_lost(bag: Bag, tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    bag.stamps = bag.stamps + rng.integers(0, STEP // 3, len(bag.stamps))
    start = bag.starts[2]
    bag.stamps[start + 5 : start + 35] = bag.stamps[start + 34] + np.arange(
        30
    )  # all stamped in one burst
    data = load_dataset(bag.write(tmp_path / "cell.mcap"), **ASKED)
    np.testing.assert_array_equal(data.X, bag.traces[:, 2].astype(np.float32))
    assert not data.faults


def test_times_that_turn_back_are_a_fault_unless_a_rate_is_stated(bag: Bag, tmp_path: Path) -> None:
    bag.stamps[bag.starts[1] + 7] = bag.stamps[bag.starts[1] + 6]
    path = bag.write(tmp_path / "cell.mcap")
    data = load_dataset(path, **ASKED)
    (fault,) = data.faults
    assert (
        str(fault) == "cell/2: Expected later times from message to message, sample 7 is not later"
    )
    assert len(load_dataset(path, rate_hz=500.0, **ASKED)) == 8


def test_labels_are_listed_by_number_too_with_the_parts(bag: Bag, tmp_path: Path) -> None:
    path = bag.write(tmp_path / "cell.mcap")
    table = tmp_path / "labels.csv"
    rows = [f"{i},{'OK' if good else 'NOK'},P{i // 2}" for i, good in enumerate(bag.good, start=1)]
    table.write_text("\n".join(["insertion,label,part", *rows[:-1], "77,OK,P9"]), encoding="utf-8")
    options = {name: ASKED[name] for name in ("trigger", "samples")}
    data = load_dataset(path, labels=table, **options)
    np.testing.assert_array_equal(data.y, bag.good[:-1])
    assert data.part.tolist() == [f"P{i // 2}" for i in range(1, 8)]
    assert [fault.source for fault in data.faults] == ["labels.csv", "cell/8"]


def test_a_topic_names_the_parts_that_a_file_labels(bag: Bag, tmp_path: Path) -> None:
    bag.parts = [f"PCB-{i}" for i in range(8)]
    path = bag.write(tmp_path / "cell.mcap")
    table = tmp_path / "labels.csv"
    words = ["success" if good else "failure" for good in bag.good]
    rows = [f"{part},{word}" for part, word in zip(bag.parts, words, strict=True)]
    table.write_text("\n".join(["part_id,insertion", *reversed(rows)]), encoding="utf-8")
    options = {**ASKED, "labels": table, "label": None, "part": PART}
    data = load_dataset(path, **options)
    np.testing.assert_array_equal(data.y, bag.good)
    assert data.source.tolist() == bag.parts
    assert not data.notes
    bag.parts[1] = "PCB-0"
    with pytest.raises(DataError, match="Expected another part on /part_id for each insertion"):
        load_dataset(bag.write(tmp_path / "twice.mcap"), **options)
    with pytest.raises(DataError, match="Expected numbers on topic /part_id, got 'PCB-0'"):
        load_dataset(path, **{**ASKED, "trigger": "register@/part_id"})


def test_insertions_that_last_longer_than_two_seconds_are_noted(tmp_path: Path) -> None:
    bag = Bag()
    bag.stamps = BEGIN + 40 * STEP * np.arange(len(bag.stamps))  # at 12.5 Hz
    bag.logged = bag.stamps + 500_000
    options = {key: ASKED[key] for key in ("trigger", "label")}
    data = load_dataset(bag.write(tmp_path / "cell.mcap"), **options)
    assert data.X.shape == (8, 25)
    note = (
        "The trigger goes on for 60 to 60 samples: the first 25, two seconds, are used (samples)."
    )
    assert note in data.notes


def test_an_insertion_that_nobody_labelled_is_a_fault_and_most_of_them_an_error(
    bag: Bag, tmp_path: Path
) -> None:
    del bag.told[2]
    data = load_dataset(bag.write(tmp_path / "cell.mcap"), **ASKED)
    np.testing.assert_array_equal(data.y, np.delete(bag.good, 2))
    assert str(data.faults[0]).startswith(
        f"cell/3: Expected a message of {CHECK} before the next insertion"
    )
    bag.told = {0: True}
    with pytest.raises(DataError, match="7 of 8 have none"):
        load_dataset(bag.write(tmp_path / "few.mcap"), **ASKED)


def test_what_cannot_be_cut_is_said_with_what_to_give(bag: Bag, tmp_path: Path) -> None:
    path = bag.write(tmp_path / "cell.mcap")
    for change, message in (
        (
            {"trigger": None},
            "Expected what cuts .* as trigger='register@/phase' and label='/height_check/ok'",
        ),
        (
            {"label": None},
            "Expected the labels of the insertions in .*, as label='/height_check/ok'",
        ),
        ({"trigger": "register@/nothing"}, "Expected the topic /nothing"),
        ({"label": "/nothing"}, "Expected the topic /nothing"),
        ({"topic": PHASE}, "Expected a topic of a wrench"),
        ({"channel": "actual_q[5]"}, "Expected a channel among FX"),
        ({"trigger": f"register@{FORCE}"}, "Expected messages with a field data"),
        ({"trigger": "contact=500"}, "it never does"),
    ):
        with pytest.raises(DataError, match=message):
            load_dataset(path, **(ASKED | change))
    for source in ("insertion", (np.zeros((2, 5)), [0, 1])):
        with pytest.raises(DataError, match="Expected no trigger for"):
            load_dataset(source, trigger="contact=5")


@pytest.mark.parametrize("seed", range(6))
def test_a_damaged_file_is_refused_or_read_and_never_raises_anything_else(
    bag: Bag, tmp_path: Path, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    raw = bytearray(bag.write(tmp_path / "cell.mcap").read_bytes())
    for place in rng.integers(0, len(raw), 6):
        raw[place] = rng.integers(256)
    raw = raw[: rng.integers(1, len(raw))] if seed % 3 == 0 else raw
    (tmp_path / "cell.mcap").write_bytes(raw)
    try:
        data = load_dataset(tmp_path / "cell.mcap", **ASKED)
    except DataError:
        return
    np.testing.assert_array_equal(data.X, bag.traces[:, 2].astype(np.float32)[: len(data)])


def cut(path: Path, share: float = 0.55, tail: bytes = b"") -> Path:
    """Cut a file at a share of its size, as of a recorder that lost its power."""
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))] + tail)
    return path


@pytest.mark.parametrize("tail", [b"", bytes(5000)], ids=["", "zeros behind"])
@pytest.mark.parametrize("way", ["trigger", "windows"])
def test_a_file_that_was_not_closed_is_read_up_to_its_last_whole_chunk(
    bag: Bag, tmp_path: Path, way: str, tail: bytes
) -> None:
    path = cut(bag.write(tmp_path / "cell.mcap", chunk_bytes=4096), tail=tail)
    listing = write_windows(tmp_path / "cycles.csv", bag)
    data = load_dataset(path, **(ASKED if way == "trigger" else {"labels": listing}))
    n = len(data)
    assert 2 < n < 6
    np.testing.assert_array_equal(data.X, bag.traces[:n, 2].astype(np.float32))
    np.testing.assert_array_equal(data.y, bag.good[:n])
    (note,) = [note for note in data.notes if "was not closed" in note]
    assert "cell.mcap ends early" in note or (tail and "cell.mcap is damaged" in note)
    assert f"of {path.stat().st_size} bytes, are read, up to 2023-11-14T22:13:2" in note
    if way == "windows":
        assert [fault.source for fault in data.faults] == [f"P{i}" for i in range(n, 8)]
        assert "Expected a window in the recording" in data.faults[0].message


def test_a_file_that_lost_only_its_index_is_read_whole(bag: Bag, tmp_path: Path) -> None:
    path = bag.write(tmp_path / "cell.mcap", chunk_bytes=4096)
    path.write_bytes(path.read_bytes()[:-20])
    data = load_dataset(path, **ASKED)
    assert (len(data), data.faults) == (8, ())
    assert any("was not closed" in note for note in data.notes)


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (lambda content: content[:3000], "it ends before its first chunk of messages does"),
        (lambda content: content[:5], "it does not begin as one"),
        (lambda content: b"\0" * 300 + content[300:3000], "it does not begin as one"),
        (lambda content: b"a,b\n1,2\n" * 100, "it does not begin as one"),
        (lambda content: b"", "it is empty"),
    ],
)
def test_a_file_without_a_whole_message_is_refused_with_what_may_mend_it(
    bag: Bag, tmp_path: Path, content: Callable[[bytes], bytes], why: str
) -> None:
    path = bag.write(tmp_path / "cell.mcap")
    path.write_bytes(content(path.read_bytes()))
    with pytest.raises(DataError, match=f"{why}.*; mcap recover or ros2 bag reindex may save"):
        load_dataset(path, **ASKED)


def test_a_bag_of_several_files_is_cut_at_a_damaged_one_by_a_listing_alone(
    bag: Bag, tmp_path: Path
) -> None:
    ends = [0, bag.starts[2] - 10, bag.starts[5] - 10, len(bag.wrench)]
    for i, part in enumerate(map(slice, ends[:-1], ends[1:])):
        bag.write(tmp_path / f"cell_{i}.mcap", part, chunk_bytes=4096)
    listing = write_windows(tmp_path / "cycles.csv", bag)
    cut(tmp_path / "cell_1.mcap", 0.01)
    data = load_dataset(tmp_path, labels=listing)
    assert data.source.tolist() == ["P0", "P1", "P5", "P6", "P7"]
    np.testing.assert_array_equal(data.X[2:], bag.traces[5:, 2].astype(np.float32))
    assert [fault.source for fault in data.faults] == ["cell_1.mcap", "P2", "P3", "P4"]
    with pytest.raises(DataError, match=r"whole files before the last .* cell_1\.mcap is none"):
        load_dataset(tmp_path, **ASKED)  # the labels behind it would be those of others
    cut(tmp_path / "cell_0.mcap", 0.01)
    with pytest.raises(DataError, match=r"Cannot read .*cell_0\.mcap as an MCAP file"):
        load_dataset(tmp_path, labels=listing)


@pytest.mark.parametrize("name", ["wrench.force.z", "force.z", "wrench/force/z", "fz"])
def test_a_channel_may_be_named_as_the_field_of_the_message(
    bag: Bag, tmp_path: Path, name: str
) -> None:
    data = load_dataset(bag.write(tmp_path / "cell.mcap"), channel=name, **ASKED)
    np.testing.assert_array_equal(data.X, bag.traces[:, 2].astype(np.float32))
    assert data.unit == "N"


def date(nanoseconds: int) -> str:
    return f"{np.datetime64(nanoseconds // 10**6, 'ms')}"


def since_begin(nanoseconds: int) -> str:
    return f"{(nanoseconds - BEGIN - 500_000) / 1e9:.4f}"


def day_first(nanoseconds: int) -> str:
    day, _, time = date(nanoseconds).partition("T")
    return f"{'.'.join(reversed(day.split('-')))} {time.replace('.', ',')}"


WINDOWS = {
    "dates with a zone": ("start,end", lambda a, b: f"{date(a)}Z,{date(b)}Z"),
    "dates of another zone": (
        "t_start,t_end",
        lambda a, b: f"{date(a + 3600 * 10**9)}+01:00,{date(b)}Z",
    ),
    "dates in UTC": ("start_time,end_time", lambda a, b: f"{date(a)},{date(b)}"),
    "seconds since 1970": ("Start;Stop", lambda a, b: f"{a / 1e9:.3f};{b / 1e9:.3f}"),
    "milliseconds": ("cycle_start;cycle_end", lambda a, b: f"{a // 10**6};{b // 10**6}"),
    "microseconds": ("begin_us,end_us", lambda a, b: f"{a // 1000},{b // 1000}"),
    "nanoseconds": ("from,to", lambda a, b: f"{a},{b}"),
    "since the start": ("start,end", lambda a, b: f"{since_begin(a)},{since_begin(b)}"),
    "decimal commas": (
        "Start [s];Ende [s]",
        lambda a, b: f"{since_begin(a)};{since_begin(b)}".replace(".", ","),
    ),
    "milliseconds since the start": (
        "start [ms],end [ms]",
        lambda a, b: f"{1e3 * float(since_begin(a))},{1e3 * float(since_begin(b))}",
    ),
    "German dates": ("Beginn;Ende", lambda a, b: f"{day_first(a)};{day_first(b)}"),
    "von and bis": ("von;bis", lambda a, b: f"{date(a)};{date(b)}"),
    "French": ("début,fin", lambda a, b: f"{date(a)},{date(b)}"),
    "Japanese": ("開始時刻,終了時刻", lambda a, b: f"{date(a)},{date(b)}"),
    "a duration": ("start,duration", lambda a, b: f"{date(a)},{(b - a) / 1e9}"),
    "one in milliseconds": ("Start;Dauer [ms]", lambda a, b: f"{date(a)};{(b - a) / 1e6:g}"),
    "a date and times of day": (
        "date,start,end",
        lambda a, b: ",".join([*date(a).split("T"), date(b).partition("T")[2]]),
    ),
}


def write_windows(path: Path, bag: Bag, form: str = "dates with a zone") -> Path:
    header, row_of = WINDOWS[form]
    mark = ";" if ";" in header else ","
    rows = [f"part{mark}{header}{mark}result"]
    for i, start in enumerate(bag.starts):
        window = row_of(BEGIN + STEP * start, BEGIN + STEP * (start + SAMPLES))
        rows.append(f"P{i}{mark}{window}{mark}{'success' if bag.good[i] else 'failure'}")
    path.write_text("\n".join(rows), encoding="utf-8")
    return path


@pytest.mark.parametrize("form", WINDOWS)
def test_a_listing_of_starts_and_ends_cuts_it(bag: Bag, tmp_path: Path, form: str) -> None:
    path = bag.write(tmp_path / "cell.mcap")
    listing = write_windows(tmp_path / "cycles.csv", bag, form)
    data = load_dataset(path, labels=listing)
    np.testing.assert_array_equal(data.X, bag.traces[:, 2].astype(np.float32))
    np.testing.assert_array_equal(data.y, bag.good)
    assert data.source.tolist() == [f"P{i}" for i in range(8)]
    assert (data.rate_hz, data.faults) == (500.0, ())
    is_relative = "since the start" in form or form == "decimal commas"
    clock = "times of the log" if is_relative else "stamps of the headers"
    assert any(note.endswith(f"compared with the {clock}.") for note in data.notes)
    named = load_dataset(path, labels=listing, label="result", part="part", channel="FZ")
    np.testing.assert_array_equal(named.X, data.X)
    assert named.part.tolist() == data.source.tolist()


@pytest.mark.parametrize("stamps", ["none", "zeros", "since the controller began"])
def test_windows_are_compared_with_the_log_if_no_stamp_is_of_their_time(
    bag: Bag, tmp_path: Path, stamps: str
) -> None:
    bag.stamped = stamps != "none"
    bag.stamps = (bag.stamps - BEGIN + 10**10) * (stamps != "zeros")
    listing = write_windows(tmp_path / "cycles.csv", bag)
    data = load_dataset(bag.write(tmp_path / "cell.mcap"), labels=listing)
    np.testing.assert_array_equal(data.X, bag.traces[:, 2].astype(np.float32))
    note = "cycles.csv is read as dates, UTC without a zone, and compared with the times of the log: no stamps"
    assert any(text.startswith(note) for text in data.notes)


def test_stamps_that_are_far_from_the_log_are_noted(bag: Bag, tmp_path: Path) -> None:
    bag.logged = bag.stamps + 10**8 * 3
    listing = write_windows(tmp_path / "cycles.csv", bag)
    data = load_dataset(bag.write(tmp_path / "cell.mcap"), labels=listing)
    np.testing.assert_array_equal(data.X, bag.traces[:, 2].astype(np.float32))
    assert any(
        text.endswith("headers; the times of the log are 0.3 s later.") for text in data.notes
    )


def test_windows_that_cannot_be_used_are_named_and_the_rest_is_read(
    bag: Bag, tmp_path: Path
) -> None:
    start = bag.starts
    bag.lost = {start[1] + 30, *range(start[2] - 2, start[2] + 8), *range(start[7], start[7] + 62)}
    listing = write_windows(tmp_path / "cycles.csv", bag)
    *lines, last = listing.read_text("utf-8").splitlines()
    lines[5] = lines[5].replace(date(BEGIN + STEP * (start[4] + SAMPLES)), date(BEGIN + 11 * 10**8))
    lines[4] = lines[4].replace("P3,", "P3,?")
    lines.append("P9,2023-11-14T22:13:21.620Z,2023-11-14T22:13:23.000Z,success")
    listing.write_text("\n".join([*lines, last]), encoding="utf-8")
    data = load_dataset(bag.write(tmp_path / "cell.mcap"), labels=listing)
    assert data.source.tolist() == ["P0", "P6"]
    np.testing.assert_array_equal(data.X, bag.traces[[0, 6], 2].astype(np.float32))
    faults = {fault.source: fault.message for fault in data.faults}
    assert f"1 of {SAMPLES} are missing, the first at sample 30" in faults["P1"]
    assert "the message that it begins with, that one fell into a gap" in faults["P2"]
    assert "Expected times of its start and, later, of its end, got none to" in faults["P3"]
    assert "overlaps that of P5" in faults["P4"]
    assert "overlaps that of P4" in faults["P5"]
    assert "found none" in faults["P7"]
    assert "Expected a window in the recording, from 2023-11-14T22:13:20.000Z to" in faults["P9"]


def test_a_part_that_is_listed_twice_was_tried_twice(bag: Bag, tmp_path: Path) -> None:
    listing = write_windows(tmp_path / "cycles.csv", bag)
    text = listing.read_text("utf-8").replace("P1,", "P0,").replace("part", "Serial No")
    listing.write_text(text, encoding="utf-8")
    data = load_dataset(bag.write(tmp_path / "cell.mcap"), labels=listing)
    np.testing.assert_array_equal(data.y, bag.good)
    assert data.source.tolist()[:3] == ["P0, line 2", "P0, line 3", "P2"]
    assert data.part.tolist()[:3] == ["P0", "P0", "P2"]


def test_windows_without_names_of_parts_are_numbered_and_of_any_length(
    bag: Bag, tmp_path: Path
) -> None:
    rows = [
        f"{date(BEGIN + STEP * start)},{date(BEGIN + STEP * (start + SAMPLES - i))},OK"
        for i, start in enumerate(bag.starts)
    ]
    listing = tmp_path / "cycles.csv"
    listing.write_text("\n".join(["start,end,verdict", *rows]), encoding="utf-8")
    data = load_dataset(bag.write(tmp_path / "cell.mcap"), labels=listing, samples=50)
    np.testing.assert_array_equal(data.X, bag.traces[:, 2, :50].astype(np.float32))
    assert data.source.tolist() == [f"cell/{i}" for i in range(1, 9)]


def test_windows_that_do_not_fit_are_refused_with_what_to_do(bag: Bag, tmp_path: Path) -> None:
    path = bag.write(tmp_path / "cell.mcap")
    listing = write_windows(tmp_path / "cycles.csv", bag)
    with pytest.raises(DataError, match="Expected a trigger or windows, got register@/phase, and"):
        load_dataset(path, labels=listing, trigger="register@/phase")
    text = listing.read_text("utf-8")
    for old, new, message in (
        ("T22:", "T23:", r"1 h earlier they would be.* as 2023-11-14T23:13:20.080\+01:00"),
        ("2023-11-14", "2023-10-14", "is it another recording"),
        ("2023-11-14T22:13:2", "", r"unit into the columns' names: start \[ms\]"),
        ("2023-11-14T", "", "Expected dates with the times of day in start and end"),
        ("2023-11-14T", "11/10/2023 ", "Expected dates in start that tell day and month"),
    ):
        changed = text.replace(old, new)
        if not new:
            changed = changed.replace("Z", "")
        if "unit" in message:
            changed = changed.replace("0.", "80").replace("1.", "81")
        listing.write_text(changed, encoding="utf-8")
        with pytest.raises(DataError, match=message):
            load_dataset(path, labels=listing)


@pytest.mark.parametrize(
    ("columns", "options", "message"),
    [
        ("part,start,end", {}, "Expected a column of labels in .*got part, start, end; add one"),
        ("part,when,result", {}, "or columns start and end, of dates, in "),
        ("part,start,end,result", {"part": "Serial"}, r"got part, start, end, result; .*\(part\)"),
        ("part,start,end,result", {"label": "ok"}, r"got part, start, end, result; .*\(label\)"),
    ],
)
def test_the_error_on_a_listing_names_its_columns(
    bag: Bag, tmp_path: Path, columns: str, options: dict[str, str], message: str
) -> None:
    row = {"part": "A", "start": date(BEGIN), "end": date(BEGIN + 10**9), "when": "7:10"}
    cells = [row.get(name, "OK") for name in columns.split(",")]
    listing = tmp_path / "cycles.csv"
    listing.write_text(f"{columns}\n{','.join(cells)}\n", encoding="utf-8")
    with pytest.raises(DataError, match=message):
        load_dataset(bag.write(tmp_path / "cell.mcap"), labels=listing, **options)
