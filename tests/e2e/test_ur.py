"""A Universal Robots controller: its protocol, its force recorded sample for sample, a cell of
orders; over real TCP.
"""

import socket
import struct
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from itertools import chain

import numpy as np
import pytest

from dengine import DataEngine, Dataset, Policy, ReplayCell, TraceSpec
from dengine.cells import Cell, RtdeRecorder, UrCell
from dengine.cells.ur.cell import (
    ANSWER,
    ORDER,
    PHASE,
    RUNTIME,
    ResultCode,
    Runtime,
    Verb,
    encode_message,
)
from dengine.cells.ur.protocol import (
    Package,
    PackageReader,
    PackageType,
    RtdeRecipe,
)
from dengine.cells.ur.stream import RtdeClient
from dengine.datasets.triggers import Trigger
from dengine.errors import CellError, DengineError
from tests.support.command_line import document, refused
from tests.support.robots import FORCE, FakeController, RobotProgram, Signals, Trouble
from tests.support.tables import rows

SAMPLES = 80
WAIT = 60.0  # seconds, for what takes milliseconds here: a machine may be busy
# Relative to real time. Without a limit the controller fills the recorder's buffer of 60 s of
# packages while a model is retrained, and the oldest packages are lost, as they should be.
SPEED = 5.0


@pytest.fixture(scope="module")
def parts(make_data):
    return make_data(60, samples=SAMPLES)


def cell_of(fake: FakeController, **how) -> UrCell:
    return UrCell(
        fake.host, port=fake.port, samples=SAMPLES, order_timeout=WAIT, start_timeout=WAIT, **how
    )


def test_packages_come_whole_from_pieces_of_any_size():
    sent = [Package(PackageType.DATA, bytes(range(n))) for n in (0, 1, 40)]
    stream = b"".join(item.to_bytes() for item in sent)
    for size in (1, 2, 7, 100):
        pieces = [stream[i : i + size] for i in range(0, len(stream), size)]
        assert [*chain.from_iterable(map(PackageReader().feed, pieces))] == sent


def test_a_data_package_is_bytes_as_the_guide_says():
    # Header: size uint16 and kind uint8; then the recipe's number; big-endian.
    recipe = RtdeRecipe(1, ("timestamp", "output_int_register_24"), ("DOUBLE", "INT32"))
    assert recipe.pack({"output_int_register_24": -1, "timestamp": 2.0}) == struct.pack(
        ">HBBdi", 16, ord("U"), 1, 2.0, -1
    )


@pytest.mark.parametrize(
    ("refused", "column", "text"),
    [
        (PackageType.VERSION, FORCE, "protocol version 2"),
        (PackageType.START, FORCE, "refuses"),
        ("actual_TCP_force", FORCE, "does not know actual_TCP_force"),
        (ORDER, FORCE, f"Expected to write {ORDER}, another client"),
        ("", "actual_q[9]", r"Expected a channel among FX_Base, .* got actual_q\[9\]"),
    ],
)
def test_what_a_controller_refuses_or_does_not_have_is_said_at_once(refused, column, text):
    with FakeController(refuses=[refused]) as fake, pytest.raises(DengineError, match=text):
        RtdeClient(fake.host, fake.port, (column,), (ORDER,))


def test_what_does_not_answer_is_said():
    with (
        socket.create_server(("127.0.0.1", 0)) as server,
        pytest.raises(CellError, match=r"silent for 0\.1 s"),
    ):
        RtdeClient("127.0.0.1", server.getsockname()[1], timeout=0.1)


# Insertions, cut out and accounted for.

TROUBLES = """
3  50 drop    7
4  20 hold    30
5  40 close   1
6  0  drop    4
7  79 half    1
8  60 garbage 1
9  3  repeat  1
10 70 drop    40
11 0  close   1
12 30 reset   1
"""  # a part, a sample of it, what happens there, and for how many control cycles


def test_traces_are_what_was_sent_and_every_gap_is_reported_and_none_invented(parts):
    troubles = [
        Trouble(int(part), int(sample), kind, int(cycles))
        for part, sample, kind, cycles in rows(TROUBLES)
    ]
    with (
        FakeController(RobotProgram(parts), troubles, speed=SPEED) as fake,
        cell_of(fake) as cell,
    ):
        for part in range(16):
            trace = cell.insert()
            lost = {sample for number, sample in fake.lost if number == part}
            if 0 in lost:  # its start was not seen: no sample's place is known
                lost = {*range(SAMPLES)}
            if part == 12:  # the controller's clock began anew, which ends the trace that it was in
                lost = {*range(30, SAMPLES)}
            there = ~np.isnan(trace)
            assert {*np.flatnonzero(~there).tolist()} == lost
            np.testing.assert_array_equal(trace[there], parts.X[part][there])
            assert cell.last.missing == len(lost)
            assert cell.last.reconnects == (part in (5, 7, 8, 11))
            cell.reject()
        report = cell.recorder.report()
    hit = {part for part, _ in fake.lost}
    assert {3, 5, 6, 7, 8, 10, 11} == hit
    assert cell.incomplete == len(hit | {12})
    assert (report.reconnects, report.repeated, report.restarts) == (4, 1, 1)
    assert report.missing >= len(fake.lost)


FORCE_OF_CONTACT = np.zeros(400)  # 200 at rest, a push of 100, 100 at rest
FORCE_OF_CONTACT[200:300] = np.linspace(6.0, 40.0, 100)


CUTS = """
bit=3                            actual_digital_output_bits 8
register@output_bit_register_64  output_bit_register_64     1
motion=0.01                      actual_TCP_speed[2]        -0.02
contact                          actual_TCP_speed[2]        0
"""  # a trigger, a column that it needs, and its value in contact


@pytest.mark.parametrize(("trigger", "column", "value"), rows(CUTS))
def test_a_recorder_cuts_several_channels_by_any_trigger_with_samples_from_before_it(
    trigger, column, value
):
    if trigger == "contact":
        trigger = Trigger("contact", 5.0, "FZ_Base", quiet_s=0.1)
    force = FORCE_OF_CONTACT
    channels = {"FX_Base": force / 2, "FZ_Base": force, "actual_q[5]": force / 4}
    expected = np.stack(list(channels.values()))[:, 180:240].astype(np.float32)
    signals = Signals(**channels, **{column: float(value) * (force > 0)})
    how = {"samples": 60, "before": 20, "channels": tuple(channels)}
    with (
        FakeController(signals, speed=SPEED) as fake,
        RtdeRecorder(fake.host, trigger, port=fake.port, **how) as recorder,
    ):
        for _ in range(3):
            np.testing.assert_array_equal(recorder.record(WAIT).trace, expected)
    assert recorder.spec == TraceSpec(60, 500.0, 3, ("N", "N", ""), columns=tuple(channels))


def test_who_waits_for_an_insertion_is_woken_when_the_recorder_is_closed():
    with FakeController() as fake, RtdeRecorder(fake.host, port=fake.port) as recorder:
        threading.Timer(0.2, recorder.close).start()
        begin = time.monotonic()
        with pytest.raises(CellError, match="Expected an insertion"):
            recorder.record(timeout=WAIT)
        assert time.monotonic() - begin < WAIT / 2


def decisions(cell: Cell, n: int) -> list[dict]:
    with DataEngine("pca", retrain_every=10, policy=Policy(0.3, 0.6), seed=0) as engine:
        cycles = list(engine.run(cell, n))
        assert engine.trace == cell.spec
    return [
        asdict(cycle.decision) | {"id": "", "outcome": cycle.outcome, "success": cycle.success}
        for cycle in cycles
    ]


@pytest.mark.parametrize("confirm", [False, True])
def test_a_run_on_a_robot_equals_a_replay_of_its_traces_decision_for_decision(make_data, confirm):
    data = make_data(60, samples=SAMPLES, failures=0.4)
    with (
        FakeController(RobotProgram(data, confirm=confirm), speed=SPEED) as fake,
        cell_of(fake, timeout=WAIT) as cell,  # a busy machine may be silent for seconds
    ):
        assert isinstance(cell, Cell)
        live = decisions(cell, 60)
    assert live == decisions(ReplayCell(data, confirm=confirm), 60)
    assert {answer["action"] for answer in live} == {"verify", "accept", "reject"}


def reconnected(fake: FakeController, cell: UrCell, anew: bool = False) -> float | None:
    """What the order's register holds once the connection was lost and made again."""
    before = cell.report().reconnects
    fake.inputs.clear()  # as if it had been lost on the way
    fake.hang_up(anew)
    while cell.report().reconnects == before:
        time.sleep(0.01)
    begun = cell.report().packages
    while cell.report().packages < begun + 50:
        time.sleep(0.01)
    return fake.inputs.get(ORDER)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ("is deaf", r"to answer order 1 \(insert\) in time, it did not"),
        ("has stopped", "its program has stopped"),
        ("is started anew", "started anew"),
    ],
)
def test_an_order_that_is_not_carried_out_is_an_error_that_says_which_and_why(parts, value, text):
    program = RobotProgram(parts)

    def start_anew():
        program.restart()
        del program.step

    with FakeController(program, speed=20.0) as fake, cell_of(fake) as cell:
        program.step = lambda inputs: program.outputs  # it answers nothing
        if value == "is deaf":
            cell.order_timeout = 0.3
        elif value == "has stopped":
            program.outputs[RUNTIME] = Runtime.STOPPED
        else:
            threading.Timer(0.2, start_anew).start()
        with pytest.raises(CellError, match=text):
            cell.insert()
        while ORDER not in fake.inputs:  # it may still be on its way
            time.sleep(0.01)
        assert reconnected(fake, cell) is None, "it is written again"


@pytest.mark.parametrize(
    ("age", "anew", "expected"), [(10.0, False, 11), (0.0, False, None), (10.0, True, None)]
)
def test_an_order_is_told_again_unless_it_is_old_or_the_controller_was_switched_off(
    parts, monkeypatch, age, anew, expected
):
    monkeypatch.setattr("dengine.cells.ur.cell.REPEAT_S", age)
    program = RobotProgram(parts)
    with FakeController(program, speed=20.0) as fake, cell_of(fake) as cell:
        program.step = lambda inputs: program.outputs  # it answers nothing
        with ThreadPoolExecutor(1) as robot:
            order = robot.submit(cell.insert)
            while ORDER not in fake.inputs:
                time.sleep(0.01)
            assert reconnected(fake, cell, anew) == expected
            cell.close()
        assert isinstance(order.exception(), CellError)


def test_a_new_owner_waits_for_an_old_order_and_hands_the_register_over_with_its_number(parts):
    """The first owner goes while its order is carried out; what the next one orders has the next
    number.
    """
    program, done = RobotProgram(parts, approach=4000), encode_message(1, ResultCode.DONE)
    with FakeController(program, speed=20.0) as fake:
        with cell_of(fake) as first:
            first.order_timeout = 0.05
            with pytest.raises(CellError, match="order 1"):
                first.insert()
        with cell_of(fake) as second:
            assert program.outputs[ANSWER] == done  # `open` waited for it
            second.reject()
            assert fake.inputs[ORDER] == encode_message(2, Verb.REJECT)
        program.step = lambda inputs: {**program.outputs, ANSWER: done}
        with pytest.raises(CellError, match="it owes an answer to order 2"):
            UrCell(fake.host, port=fake.port, start_timeout=0.5)


def test_a_robot_that_fails_ends_the_run_after_what_was_done_is_shown_and_it_goes_on_there(
    parts, tmp_path
):
    store, gap = tmp_path / "cell.db", Trouble(3, 9, "drop", 2)
    program = RobotProgram(Dataset(parts.X[:10], parts.y[:10]))  # then its bin is empty
    with FakeController(program, [gap], speed=SPEED) as fake:
        run = f"run --cell ur --host {fake.host}:{fake.port} --samples {SAMPLES} --store {store}"
        shown = refused(*run.split(), "--reducer", "pca", "--cycles", 14)
        assert "order 21 (insert), it reported a failure" in shown
        assert f"Everything up to cycle 10 is in {store}; the same command with --cycles 4" in shown
        program.played = 0  # somebody has filled it
        result = document(*run.split(), "--cycles", 4)
    assert (result["total"]["verified"], result["cell"]["incomplete"]) == (4, 0)
    with DataEngine.open(store) as engine:
        kept = engine.store.labels.with_traces().traces
        assert engine.store.decisions.counts()["decisions"] == 14
    # Of a trace with a gap the label is counted, not the trace; it was filled with the same parts.
    expected = {x.tobytes() for x in np.delete(parts.X[:10], 3, axis=0)}
    assert {trace.tobytes() for trace in kept} == expected | {parts.X[3].tobytes()}


WRONG_ROBOTS = """
--cell ur; Expected the robot's address for --cell ur
--cell ur --host 127.0.0.1:x; Expected a host, or host:port
--cell ur --host 127.0.0.1:1; it cannot be reached
--cell ur --host 127.0.0.1:1 --trigger bits; Expected a trigger, as bit=0
"""


def test_what_is_wrong_with_a_robot_is_said():
    for words, expected in rows(WRONG_ROBOTS, at="; "):
        assert expected in refused("run", *words.split())


def test_the_robots_program_of_the_repository_keeps_to_the_same_handshake(repo):
    assert encode_message(12, Verb.PROCEED) == 120 + Verb.PROCEED
    text = (repo / "dengine" / "cells" / "ur" / "ur_cell.script").read_text(encoding="utf-8")
    for verb, name in (("read_input", ORDER), ("write_output", ANSWER), ("write_output", PHASE)):
        assert f"{verb}_integer_register({name.rpartition('_')[2]}" in text
    for code in (*Verb, *ResultCode):
        kind = "VERB" if isinstance(code, Verb) else "RESULT"
        assert f"{kind}_{code.name} = {code.value}\n" in text
