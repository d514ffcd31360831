"""A Universal Robots controller: its protocol, its force recorded sample for sample, a cell of orders; over real TCP."""

import socket
import struct
import threading
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from dengine import DataEngine, Dataset, Policy, ReplayCell
from dengine.cells import Cell, FakeController, RtdeRecorder, UrCell
from dengine.cells.ur import RobotProgram, Trouble
from dengine.cells.ur.cell import ANSWER, ORDER, PHASE, RUNTIME, Answer, Runtime, Verb, after, word
from dengine.cells.ur.protocol import TYPES, Kind, Package, Packages, Recipe, column_of
from dengine.cells.ur.stream import Lateness, RtdeClient, RtdeStream
from dengine.datasets.triggers import Trigger
from dengine.errors import CellError
from tests.support.command_line import dengine, document, said, succeed

SAMPLES = 80
WAIT = 60.0  # seconds, for what takes milliseconds here: a machine may be busy


@pytest.fixture(scope="module")
def parts(make_data) -> Dataset:
    return make_data(60, samples=SAMPLES)


def cell_of(fake: FakeController, **how) -> UrCell:
    return UrCell(fake.host, port=fake.port, samples=SAMPLES, order_timeout=WAIT, start_timeout=WAIT, **how)


def nan_places(part: int, trace: np.ndarray) -> set[tuple[int, int]]:
    return {(part, int(sample)) for sample in np.flatnonzero(np.isnan(trace))}


# The wire.


def test_packages_come_whole_from_pieces_of_any_size() -> None:
    sent = [Package(Kind.DATA, bytes(range(n))) for n in (0, 1, 40)]
    for size in (1, 2, 7, 100):
        stream, packages = b"".join(each.packed() for each in sent), Packages()
        pieces = [stream[i : i + size] for i in range(0, len(stream), size)]
        assert [found for piece in pieces for found in packages.feed(piece)] == sent


@pytest.mark.parametrize("kind", TYPES)
def test_every_type_of_the_guide_is_packed_and_unpacked(kind: str) -> None:
    recipe = Recipe(3, ("a", "b"), ("DOUBLE", kind))
    n = TYPES[kind][1]
    values = (0.5, *([True] if kind == "BOOL" else range(1, n + 1)))
    assert recipe.unpack(recipe.pack(values)[3:]) == values
    assert len(recipe.columns) == 1 + n
    with pytest.raises(CellError, match="Expected a data package"):
        recipe.unpack(recipe.pack(values)[3:-1])


def test_a_data_package_is_bytes_as_the_guide_says() -> None:
    # Header: size uint16 and kind uint8; then the recipe's number; big-endian.
    recipe = Recipe(1, ("timestamp", "output_int_register_24"), ("DOUBLE", "INT32"))
    assert recipe.pack((2.0, -1)) == struct.pack(">HBBdi", 16, ord("U"), 1, 2.0, -1)


# One connection.


@pytest.mark.parametrize(
    ("how", "said"),
    [
        ({"refuses": [Kind.VERSION]}, "protocol version 2"),
        ({"refuses": [Kind.START]}, "refuses"),
        ({"refuses": ["actual_TCP_force"]}, "does not know actual_TCP_force"),
        ({"refuses": [ORDER]}, f"Expected to write {ORDER}, another client"),
    ],
    ids=["version", "start", "unknown", "held"],
)
def test_what_a_controller_refuses_is_said_at_once(how: dict, said: str) -> None:
    with FakeController(speed=None, **how) as fake, pytest.raises(CellError, match=said):
        RtdeClient(fake.host, fake.port, ("timestamp", "actual_TCP_force"), (ORDER,))


def test_what_does_not_answer_is_said_with_what_to_look_at() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        with pytest.raises(CellError, match=r"silent for 0\.1 s"):
            RtdeClient("127.0.0.1", port, timeout=0.1)
    with pytest.raises(CellError, match="cannot be reached"):
        RtdeClient("127.0.0.1", port, timeout=0.1)


def test_a_package_is_late_by_its_way_and_a_slow_drift_of_clocks_is_none() -> None:
    late = Lateness()
    drifting = [late.is_late(t, 1.0005 * t + 5.0) for t in np.arange(0.0, 60.0, 0.002)]
    assert not any(drifting)
    held = [late.is_late(60.0 + 0.002 * i, 1.0005 * 60.1 + 5.0) for i in range(50)]  # all at once, up to 0.1 s late
    assert sum(held) == 40
    assert not late.is_late(0.0, 70.0)  # the controller was switched off and on


# Insertions, cut out and accounted for.

TROUBLES = [
    Trouble(3, 50, "drop", 7),
    Trouble(4, 20, "hold", 30),
    Trouble(5, 40, "close"),
    Trouble(6, 0, "drop", 4),
    Trouble(7, SAMPLES - 1, "half"),
    Trouble(8, 60, "garbage"),
    Trouble(9, 3, "repeat"),
    Trouble(10, 70, "drop", 40),
    Trouble(11, 0, "close"),
]


def test_traces_are_what_was_sent_and_every_gap_is_reported_and_none_invented(parts: Dataset) -> None:
    with FakeController(RobotProgram(parts), speed=None, troubles=TROUBLES) as fake, cell_of(fake) as cell:
        for part in range(16):
            trace = cell.insert()
            lost = {place for place in fake.lost if place[0] == part}
            if (part, 0) in lost:  # its start was not seen: no sample's place is known
                lost = {(part, sample) for sample in range(SAMPLES)}
            assert nan_places(part, trace) == lost
            there = ~np.isnan(trace)
            np.testing.assert_array_equal(trace[there], parts.X[part][there])
            assert (cell.last.missing, cell.last.repeated) == (len(lost), part == 9)
            assert cell.last.reconnects == (part in (5, 7, 8, 11))
            cell.reject()
        report = cell.recorder.report()
    hit = {part for part, _ in fake.lost}
    assert {3, 5, 6, 7, 8, 10, 11} == hit
    assert cell.incomplete == len(hit)
    assert (report.reconnects, report.repeated, report.restarts) == (4, 1, 0)
    assert report.missing >= len(fake.lost)


def test_a_controller_whose_clock_begins_anew_ends_the_trace_it_was_in(parts: Dataset) -> None:
    with FakeController(RobotProgram(parts), speed=None, troubles=[Trouble(1, 30, "reset")]) as fake, cell_of(fake) as cell:
        traces = []
        for _ in range(3):
            traces.append(cell.insert())
            cell.reject()
        assert cell.recorder.report().restarts == 1
    np.testing.assert_array_equal(traces[0], parts.X[0])
    np.testing.assert_array_equal(traces[1][:30], parts.X[1][:30])
    assert np.isnan(traces[1][30:]).all()
    np.testing.assert_array_equal(traces[2], parts.X[2])


class Signals:
    """Plays columns of numbers, again and again, with a rest between."""

    place = None

    def __init__(self, **columns: np.ndarray) -> None:
        names = {name: column_of(name) for name in columns}
        length = len(next(iter(columns.values())))
        self._rows = [{names[n]: float(c[i]) for n, c in columns.items()} for i in range(length)]
        self._cycle = 0

    def step(self, inputs: dict) -> dict:
        self._cycle += 1
        return self._rows[self._cycle % len(self._rows)]


def contact() -> np.ndarray:
    """(400,) 200 at rest, a push of 100, 100 at rest."""
    force = np.zeros(400)
    force[200:300] = np.linspace(6.0, 40.0, 100)
    return force


@pytest.mark.parametrize(
    ("trigger", "columns"),
    [
        (Trigger("contact", 5.0, "FZ_Base", quiet_s=0.1), {}),
        ("bit=3", {"actual_digital_output_bits": 8 * (contact() > 0)}),
        ("register=2@output_int_register_30", {"output_int_register_30": 2 * (contact() > 0)}),
        ("register@output_bit_register_64", {"output_bit_register_64": contact() > 0}),
        ("motion=0.01", {"actual_TCP_speed[2]": -0.02 * (contact() > 0)}),
    ],
    ids=["contact", "digital output", "register", "bit register", "motion"],
)
def test_a_recorder_cuts_by_any_trigger_with_samples_from_before_it(trigger, columns: dict) -> None:
    program = Signals(FZ_Base=contact(), **columns)
    how = {"samples": 60, "before": 20}
    with FakeController(program, speed=None) as fake, RtdeRecorder(fake.host, trigger, port=fake.port, **how) as recorder:
        for _ in range(3):
            np.testing.assert_array_equal(recorder.record(WAIT).trace, contact()[180:240].astype(np.float32))


def test_several_channels_are_a_trace_of_several_rows_and_have_a_contract(parts: Dataset) -> None:
    columns = {"FX_Base": contact() / 2, "FZ_Base": contact(), "actual_q[5]": contact() / 4}
    how = {"trigger": "contact=5", "samples": 50, "channels": tuple(columns)}
    with FakeController(Signals(**columns), speed=None) as fake, RtdeRecorder(fake.host, port=fake.port, **how) as recorder:
        insertion = recorder.record(WAIT)
    np.testing.assert_array_equal(insertion.trace, np.stack(list(columns.values()))[:, 200:250].astype(np.float32))
    assert (recorder.spec.samples, recorder.spec.channels, recorder.spec.columns) == (50, 3, tuple(columns))


# The cell.


def decisions(cell: Cell, n: int) -> list[dict]:
    with DataEngine("pca", retrain_every=10, policy=Policy(0.3, 0.6), seed=0) as engine:
        cycles = list(engine.run(cell, n))
    return [asdict(each.decision) | {"id": "", "outcome": each.outcome, "success": each.success} for each in cycles]


@pytest.mark.parametrize("confirm", [False, True])
def test_a_run_on_a_robot_equals_a_replay_of_its_traces_decision_for_decision(make_data, confirm: bool) -> None:
    data = make_data(120, samples=SAMPLES, failures=0.4)
    with FakeController(RobotProgram(data, confirm=confirm), speed=None) as fake, cell_of(fake) as cell:
        assert isinstance(cell, Cell)
        live = decisions(cell, 120)
    assert live == decisions(ReplayCell(data, confirm=confirm), 120)
    assert {told["action"] for told in live} == {"verify", "accept", "reject"}


class Deaf(RobotProgram):
    """A robot whose program answers nothing."""

    def _carry_out(self, number: int, verb: int) -> Iterator[None]:
        while True:
            yield


@pytest.mark.parametrize(
    ("what", "said"),
    [
        ("is deaf", r"to answer order 1 \(insert\) in time, it did not"),
        ("has stopped", "its program has stopped"),
        ("is started anew", "started anew"),
    ],
)
def test_an_order_that_is_not_carried_out_is_an_error_that_says_which_and_why(parts: Dataset, what: str, said: str) -> None:
    program = Deaf(parts)
    restarting = threading.Timer(0.2, program.restart)
    with FakeController(program, speed=20.0) as fake, cell_of(fake) as cell:
        if what == "is deaf":
            cell.order_timeout = 0.3
        elif what == "has stopped":
            program.outputs[RUNTIME] = Runtime.STOPPED
        else:
            restarting.start()
        with pytest.raises(CellError, match=said):
            cell.insert()


def test_an_order_is_told_again_unless_it_is_old_or_the_controller_was_switched_off() -> None:
    now, order = [0.0], word(7, Verb.INSERT)
    fake = FakeController(speed=20.0)

    def until(true: Callable[[], bool]) -> None:
        while not true():
            assert stream.after(stream.position, WAIT)

    def reconnected(anew: bool = False) -> float | None:
        """What the order's register holds once the connection was lost and made again."""
        before = stream.report().reconnects
        fake.inputs.clear()  # as if it had been lost on the way
        fake.hang_up(anew)
        while stream.report().reconnects == before:
            stream.after(stream.position, 0.05)
        begun = stream.position
        until(lambda: stream.position >= begun + 50)
        return fake.inputs.get(ORDER)

    how = {"port": fake.port, "clock": lambda: now[0]}
    with fake, RtdeStream(fake.host, ("timestamp",), (ORDER,), **how) as stream:
        until(lambda: stream.position > 100)
        stream.write((order,))
        until(lambda: fake.inputs.get(ORDER) == order)
        assert reconnected() == order
        now[0] = 11.0
        assert reconnected() is None
        stream.write((order,))
        until(lambda: fake.inputs.get(ORDER) == order)
        assert reconnected(anew=True) is None


def test_a_new_owner_waits_for_an_old_order_and_hands_the_register_over_with_its_number(parts: Dataset) -> None:
    """The first owner goes while its order is carried out; what the next one orders has the next number."""
    program = RobotProgram(parts, approach=4000)
    with FakeController(program, speed=20.0) as fake:
        with cell_of(fake) as first:
            first.order_timeout = 0.05
            with pytest.raises(CellError, match="order 1"):
                first.insert()
        with cell_of(fake) as second:
            assert program.outputs[ANSWER] == word(1, Answer.DONE)  # `open` waited for it
            second.reject()
            assert fake.inputs[ORDER] == word(2, Verb.REJECT)
        program.step = lambda inputs: {**program.outputs, ANSWER: word(1, Answer.DONE)}  # it owes an answer to order 2
        with pytest.raises(CellError, match="it owes an answer to order 2"):
            UrCell(fake.host, port=fake.port, start_timeout=0.5)


# From the shell.


def run_on(fake: FakeController, store: Path) -> tuple[object, ...]:
    return "run", "--cell", "ur", "--host", f"{fake.host}:{fake.port}", "--samples", SAMPLES, "--store", store


def test_a_robot_is_driven_from_the_shell_and_the_store_has_its_parts(parts: Dataset, tmp_path: Path) -> None:
    store = tmp_path / "cell.db"
    with FakeController(RobotProgram(parts), speed=None, troubles=[Trouble(3, 9, "drop", 2)]) as fake:
        told = document(*run_on(fake, store), "--reducer", "pca", "--cycles", 12)
        shown = said(*run_on(fake, store), "--cycles", 3)
    assert (told["total"]["verified"], told["recording"]["incomplete"]) == (12, 1)
    assert told["recording"]["missing"] >= 2
    assert "Traces with a gap, verified and never learned from: 0." in shown
    with DataEngine.open(store) as engine:
        kept = engine.store.labelled().traces[:, 0]  # of a trace with a gap the label is counted, not the trace
        assert engine.store.status()["decisions"] == 15
    assert {trace.tobytes() for trace in kept} == {x.tobytes() for i, x in enumerate(parts.X[:15]) if i != 3}


def test_a_robot_that_fails_ends_the_run_after_what_was_done_is_shown_and_it_goes_on_there(
    parts: Dataset, tmp_path: Path
) -> None:
    program, store = RobotProgram((parts.X[:10], parts.y[:10])), tmp_path / "cell.db"  # then its bin is empty
    with FakeController(program, speed=None) as fake:
        done = dengine(*run_on(fake, store), "--reducer", "pca", "--cycles", 14)
        shown = " ".join(done.output.split())
        assert done.exit_code == 1
        assert "1 to 10 100 %" in shown
        assert "order 21 (insert), it says that it failed; look at the part, then begin again. 10 of 14" in shown
        assert f"Everything up to cycle 10 is in {store}; the same command with --cycles 4 goes on there." in shown
        program.played.clear()  # somebody has filled it
        succeed(*run_on(fake, store), "--cycles", 4)
    with DataEngine.open(store) as engine:
        assert engine.store.status()["decisions"] == 14


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("", "Expected the robot's address for --cell ur"),
        ("--host 127.0.0.1:x", "Expected a host, or host:port"),
        ("--host 127.0.0.1:1", "it cannot be reached"),
        ("--host 127.0.0.1:1 --trigger bits", "Expected a trigger, as bit=0"),
        ("--host 127.0.0.1:1 --channel FZ", "Expected a channel among FX_Base"),
    ],
)
def test_what_is_wrong_with_a_robot_is_one_line(words: str, expected: str) -> None:
    done = dengine("run", "--cell", "ur", *words.split())
    assert done.exit_code == 1
    assert expected in " ".join(done.output.split())
    assert "Traceback" not in done.output


def test_orders_are_numbered_so_that_they_fit_a_register_for_ever() -> None:
    assert after(0) == 1
    assert after(2 * 10**8) == 1
    assert word(2 * 10**8, Answer.FAILED) < 2**31
    assert divmod(word(12, Verb.PROCEED), 10) == (12, Verb.PROCEED)


def test_the_robots_program_of_the_repository_keeps_to_the_same_handshake(repo: Path) -> None:
    text = (repo / "training" / "ur_cell.script").read_text(encoding="utf-8")
    for name in (ORDER, ANSWER, PHASE):
        way, _, number = name.partition("_int_register_")
        verb = "read_input" if way == "input" else "write_output"
        assert f"{verb}_integer_register({number}" in text
    for each in (*Verb, *Answer):
        assert f"{type(each).__name__.upper()}_{each.name} = {each.value}\n" in text
