"""When an insertion begins, and where its samples go: the same for a live stream and a file."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dengine.datasets.triggers import Start, StartFinder, Trigger, as_trigger, place
from dengine.errors import SettingError

STEP = 0.002
BITS = "actual_digital_output_bits"


@pytest.mark.parametrize(
    ("trigger", "signals", "on"),
    [
        ("bit=2", {BITS: [0, 4, 3, 7]}, [0, 1, 0, 1]),
        ("bit=17", {BITS: [0, 2**17, np.nan]}, [0, 1, 0]),
        ("register@r", {"r": [0, 3, -1, np.nan]}, [0, 1, 1, 0]),
        ("register=3@r", {"r": [0, 3, -1]}, [0, 1, 0]),
        ("register=0@r", {"r": [np.nan, 1, 0]}, [0, 0, 1]),
        ("contact=5", {"FZ_Base": [4.9, 5.0, -5.0, np.nan]}, [0, 1, 1, 0]),
        ("motion=0.1", {f"actual_TCP_speed[{i}]": [0.0, 0.06, 0.08] for i in range(3)}, [0, 1, 1]),
    ],
)
def test_a_trigger_is_on_where_its_signals_say_so(trigger: str, signals: dict, on: list) -> None:
    parsed = as_trigger(trigger)
    assert set(parsed.signals) == set(signals)
    seen = parsed.active({name: np.array(values, dtype=float) for name, values in signals.items()})
    assert seen.astype(int).tolist() == on


@pytest.mark.parametrize(
    ("text", "trigger"),
    [
        (
            "bit=3@output_bit_registers0_to_31",
            Trigger("bit", 3, "output_bit_registers0_to_31", 0.0),
        ),
        ("register", Trigger("register", None, "output_int_register_25", 0.0)),
        ("register@/phase", Trigger("register", None, "/phase", 0.0)),
        ("contact=7.5@FX_Base", Trigger("contact", 7.5, "FX_Base", 0.2)),
        ("motion", Trigger("motion", 0.002, "actual_TCP_speed", 0.1)),
    ],
)
def test_a_trigger_is_named_in_a_few_words(text: str, trigger: Trigger) -> None:
    assert as_trigger(text) == trigger
    assert as_trigger(trigger) is trigger


@pytest.mark.parametrize(
    "text",
    [
        "",
        "contact",
        "bit",
        "bit=-1",
        "bit=40",
        "contact=0",
        "contact=0.0",
        "nothing=3",
        "contact=x",
        "motion=0",
        5,
    ],
)
def test_what_is_no_trigger_is_refused_with_examples(text: object) -> None:
    with pytest.raises(SettingError, match="Expected a trigger, as bit=0"):
        as_trigger(text)


@pytest.mark.parametrize(
    ("active", "quiet", "starts"),
    [("..xx..xx", 0, [2, 6]), ("xxx..x", 0, [5]), ("..x.x....x", 4, [9]), ("....x.x", 4, [4])],
)
def test_an_insertion_begins_where_the_trigger_goes_on_after_it_was_quiet(
    active: str, quiet: int, starts: list
) -> None:
    finder = StartFinder(STEP, quiet * STEP)
    results = [finder.feed(i * STEP, mark == "x") for i, mark in enumerate(active)]
    begun = [start for start in results if start is not None]
    assert [(round(start.time / STEP, 6), start.seen) for start in begun] == [
        (i, True) for i in starts
    ]


def test_a_start_in_a_gap_is_known_to_be_unseen() -> None:
    finder = StartFinder(STEP)
    for time in (0.0, STEP):
        assert finder.feed(time, False) is None
    assert finder.feed(6 * STEP, True) == Start(2 * STEP, seen=False)
    assert finder.feed(7 * STEP, True) is None


@settings(max_examples=100, deadline=None)
@given(st.sets(st.integers(0, 39)), st.integers(0, 5), st.floats(-0.3, 0.3))
def test_every_sample_is_in_its_place_and_every_gap_is_said(
    lost: set[int], before: int, jitter: float
) -> None:
    have = [i for i in range(40) if i not in lost]
    values = np.array([[float(i), -float(i)] for i in have]).reshape(-1, 2)
    placed = place(
        [1000.0 + (i + jitter) * STEP for i in have], values, 1000.0 + before * STEP, 30, STEP
    )
    expected = [np.nan if i in lost else float(i) for i in range(before, before + 30)]
    np.testing.assert_array_equal(placed.trace[0], np.array(expected, dtype=np.float32))
    np.testing.assert_array_equal(placed.trace[1], -np.array(expected, dtype=np.float32))
    assert placed.missing.tolist() == np.flatnonzero(np.isnan(expected)).tolist()
    assert placed.repeated == 0


def test_of_a_sample_that_comes_twice_the_first_counts() -> None:
    placed = place(
        [0.0, STEP, STEP, 2 * STEP], np.array([[1.0], [2.0], [9.0], [3.0]]), 0.0, 3, STEP
    )
    assert placed.trace.tolist() == [[1.0, 2.0, 3.0]]
    assert (placed.repeated, len(placed.missing)) == (1, 0)
