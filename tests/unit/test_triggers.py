"""When an insertion begins, and where its samples go: the same for a live stream and a file."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dengine.datasets.triggers import Start, StartFinder, Trigger, as_trigger, place
from dengine.errors import SettingError

STEP = 0.002

SIGNALS = """
bit=2         actual_digital_output_bits  0 4 3 7      0 1 0 1
bit=17        actual_digital_output_bits  0 131072 nan 0 1 0
register@r    r                           0 3 -1 nan   0 1 1 0
register=3@r  r                           0 3 -1       0 1 0
register=0@r  r                           nan 1 0      0 0 1
contact=5     FZ_Base                     4.9 5 -5 nan 0 1 1 0
"""


@pytest.mark.parametrize("line", SIGNALS.strip().splitlines())
def test_a_trigger_is_on_where_its_signals_say_so(line):
    trigger, signal, *words = line.split()
    values, on = np.array(words, dtype=float).reshape(2, -1)
    assert as_trigger(trigger).active({signal: values}).tolist() == on.tolist()
    assert as_trigger(trigger).signals == (signal,)


def test_a_motion_is_seen_over_all_three_axes():
    speeds = {f"actual_TCP_speed[{i}]": np.array([0.0, 0.06, 0.08]) for i in range(3)}
    assert as_trigger("motion=0.1").active(speeds).tolist() == [False, True, True]


@pytest.mark.parametrize(
    ("text", "trigger"),
    [
        ("register", Trigger("register", None, "output_int_register_25", 0.0)),
        ("contact=7.5@FX_Base", Trigger("contact", 7.5, "FX_Base", 0.2)),
        ("motion", Trigger("motion", 0.002, "actual_TCP_speed", 0.1)),
    ],
)
def test_a_trigger_is_named_in_a_few_words(text, trigger):
    assert as_trigger(text) == trigger


NONE = ["", "contact", "bit", "bit=-1", "bit=40", "contact=0.0", "nothing=3", "contact=x", 5]


@pytest.mark.parametrize("text", NONE)
def test_what_is_no_trigger_is_refused_with_examples(text):
    with pytest.raises(SettingError, match="Expected a trigger, as bit=0"):
        as_trigger(text)


@pytest.mark.parametrize(
    ("active", "quiet", "starts"),
    [("..xx..xx", 0, [2, 6]), ("xxx..x", 0, [5]), ("..x.x....x", 4, [9]), ("....x.x", 4, [4])],
)
def test_an_insertion_begins_where_the_trigger_goes_on_after_it_was_quiet(active, quiet, starts):
    finder = StartFinder(STEP, quiet * STEP)
    for i, mark in enumerate(active):
        expected = Start(i * STEP, seen=True) if i in starts else None
        assert finder.feed(i * STEP, mark == "x") == expected


def test_a_start_in_a_gap_is_known_to_be_unseen():
    finder = StartFinder(STEP)
    for time in (0.0, STEP):
        assert finder.feed(time, False) is None
    assert finder.feed(6 * STEP, True) == Start(2 * STEP, seen=False)
    assert finder.feed(7 * STEP, True) is None


@settings(max_examples=100, deadline=None)
@given(st.sets(st.integers(0, 39)), st.integers(0, 5), st.floats(-0.3, 0.3))
def test_every_sample_is_in_its_place_and_every_gap_is_said(lost, before, jitter):
    have = np.array([i for i in range(40) if i not in lost], dtype=float)
    times, values = 1000.0 + (have + jitter) * STEP, np.stack([have, -have], axis=1)
    trace, n_missing = place(times.tolist(), values, 1000.0 + before * STEP, 30, STEP)
    expected = np.arange(before, before + 30, dtype=np.float32)
    expected[np.isin(expected, [*lost])] = np.nan
    np.testing.assert_array_equal(trace, [expected, -expected])
    assert n_missing == np.isnan(expected).sum()


def test_of_a_sample_that_comes_twice_the_first_counts():
    trace, n_missing = place(
        [0.0, STEP, STEP, 2 * STEP], np.array([[1.0], [2.0], [9.0], [3.0]]), 0.0, 3, STEP
    )
    assert trace.tolist() == [[1.0, 2.0, 3.0]]
    assert n_missing == 0
