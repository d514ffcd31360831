"""What a report may say: a label that is one, an id that is one; anything else is refused before it
is stored.
"""

import re
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import torch

from dengine import Action, DataEngine, Reason, ReplayCell
from dengine.errors import ReportError, TraceError, shortened
from dengine.records import LONGEST, as_success

GOOD = [
    True,
    np.True_,
    1,
    1.0,
    np.int8(1),
    np.uint64(1),
    np.float32(1),
    np.array(1),
    np.array(True),
    Fraction(1),
]
BAD = [False, np.False_, 0, 0.0, -0.0, np.int8(0), np.float64(0), np.array(0.0), Fraction(0)]
HUGE = ["x" * 2**20, list(range(10**5))]
NONE = [
    100,
    -1,
    2**70,
    *HUGE,
    0.5,
    1.0000001,
    float("nan"),
    float("inf"),
    1j,
    None,
    "1",
    "NG",
    "True",
    b"\x01",
    "",
]
NONE += [
    np.array([1]),
    np.array([]),
    np.array("1"),
    np.nan,
    np.float16("nan"),
    [True],
    (),
    {},
    {1},
    torch.tensor(1),
]


def test_a_bool_and_exactly_one_or_zero_are_labels() -> None:
    assert [as_success(value) for value in GOOD] == [True] * len(GOOD)
    assert [as_success(value) for value in BAD] == [False] * len(BAD)


@pytest.mark.parametrize("value", NONE, ids=lambda value: shortened(value)[:20])
def test_anything_else_is_no_label_and_the_error_says_what_to_do(value) -> None:
    with pytest.raises(ReportError, match=r"Expected a label.*turn it into one of these") as caught:
        as_success(value)
    assert len(str(caught.value)) < 400


@pytest.fixture
def engine(tmp_path: Path):
    with DataEngine("pca", store=tmp_path / "engine.db") as engine:
        yield engine


NO_IDS = [
    None,
    float("nan"),
    7,
    b"a",
    "",
    "a\0b",
    "\ud800",
    "x" * (LONGEST + 1),
    "x" * 2**20,
    "line\nbreak",
    ["a"],
    {},
]


NO_PARTS = ["", "x" * (LONGEST + 1), "SN\0", "\ud800", "a\nb", 10**4200, 1.5, True, ["a"]]


def test_a_report_without_id_part_or_label_queues_nothing_and_the_store_goes_on(
    engine: DataEngine, make_data
) -> None:
    x = make_data(2).X
    for id_ in NO_IDS:
        with pytest.raises(ReportError, match="Expected the id of a decision"):
            engine.report(id_, False)
    for part in NO_PARTS:
        with pytest.raises(TraceError, match="part's number"):
            engine.decide(x[0], part=part)
    engine.flush()
    assert engine.store.decisions.counts()["decisions"] == 0
    decision = engine.decide(x[1])
    for value in NONE:
        with pytest.raises(ReportError):
            engine.report(decision.id, value)
    engine.report(decision.id, 1)
    assert engine.store.decisions.counts()["sources"] == {
        "verification": 1,
        "audit": 0,
        "stop": 0,
        "confirmed": 0,
        "inspection": 0,
    }


class Baseline:
    """Answers with what it is told to."""

    def __init__(self, n_success=3, n_failure=0, lower=0.4, upper=1.0, action="verify") -> None:
        self.answers = n_success, n_failure, lower, upper, action

    fit = add = lambda self, *args: self
    count = lambda self, X: ([self.answers[0]], [self.answers[1]])  # noqa: E731
    predict_interval = lambda self, X: ([self.answers[2]], [self.answers[3]])  # noqa: E731
    decide = lambda self, X: [self.answers[4]]  # noqa: E731


@pytest.mark.parametrize("answer", ["NG", None, 100, float("nan")])
def test_a_check_that_answers_no_label_ends_the_run_and_its_decision_is_kept(
    answer, make_data
) -> None:
    engine, cell = DataEngine("pca"), ReplayCell(make_data(5))
    cell.verify = lambda: answer
    with pytest.raises(ReportError, match=r"of decision \S+, by verify\(\)") as caught:
        list(engine.run(cell, 5))
    id_ = re.search(r"of decision (\S+),", str(caught.value))[1]
    assert engine.store.decisions.counts()["decisions"] == 1
    engine.report(id_, True)  # what it really was, once somebody has looked
    assert engine.store.decisions.counts()["labels"] == 1


@pytest.mark.parametrize("answer", ["STOP", None, True, 0])
def test_a_cell_that_goes_on_with_no_outcome_is_told_so_and_the_stop_is_not_taken_for_silence(
    answer, make_data
) -> None:
    engine, cell = (
        DataEngine(model=Baseline(9, 0, 1.0, 1.0, Action.ACCEPT), retrain_every=3),
        ReplayCell(make_data(9)),
    )
    cell.proceed = lambda: answer
    with pytest.raises(ReportError, match=r"Expected an Outcome"):
        list(engine.run(cell, 9))


WRONG = [
    *({"n_success": value} for value in (2**70, -1, 2.5, float("nan"), "x", None)),
    *({"n_failure": value} for value in (2**63, -(2**70), float("inf"))),
    *({"lower": value} for value in (float("nan"), -0.1, 1.1, 4.43, float("inf"), None)),
    *({"upper": value} for value in (float("nan"), 0.1, 1.0001, -1)),
    *({"action": value} for value in ("go", None, 1)),
]


@pytest.mark.parametrize("wrong", WRONG, ids=repr)
def test_a_baseline_that_counts_nonsense_is_a_model_error_and_the_store_goes_on(
    wrong, make_data, tmp_path: Path
) -> None:
    data = make_data(6)
    with DataEngine(
        model=Baseline(**wrong), retrain_every=3, store=tmp_path / "engine.db"
    ) as engine:
        for x, y in zip(data.X, data.y, strict=True):
            decision = engine.decide(x)
            engine.report(decision.id, y)
        assert (decision.action, decision.reason) == (Action.VERIFY, Reason.MODEL_ERROR)
        assert engine.store.decisions.counts()["labels"] == 6
        assert engine.state.store_fault == ""
