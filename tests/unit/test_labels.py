"""What a report may say: a label that is one, an id that is one; anything else is refused before it
is stored.
"""

import re
from fractions import Fraction

import numpy as np
import pytest
import torch

from dengine import Action, DataEngine, Reason, ReplayCell
from dengine.errors import ReportError, TraceError, shortened
from dengine.records import LONGEST, as_success

NONE = [
    100,
    -1,
    2**70,
    "x" * 2**20,
    list(range(10**5)),
    0.5,
    np.nan,
    np.inf,
    None,
    "1",
    "",
    b"1",
]
NONE += [np.array("1"), np.float16("nan"), [True], (), {}, torch.tensor(1)]


def test_a_bool_and_exactly_one_or_zero_are_labels():
    for plain in (0, 1):
        for kind in (
            bool,
            np.bool_,
            int,
            float,
            np.int8,
            np.uint64,
            np.float32,
            np.array,
            Fraction,
        ):
            assert as_success(kind(plain)) is bool(plain)


@pytest.mark.parametrize("value", NONE, ids=lambda value: shortened(value)[:20])
def test_anything_else_is_no_label_and_the_error_says_what_to_do(value):
    with pytest.raises(ReportError, match=r"Expected a label.*turn it into one of these") as caught:
        as_success(value)
    assert len(str(caught.value)) < 400


BAD_TEXTS = ["", "a\0b", "\ud800", "line\nbreak", "x" * (LONGEST + 1), ["a"]]
NO_IDS = [*BAD_TEXTS, None, np.nan, 7, b"a", {}, "x" * 2**20]


NO_PARTS = ["", "x" * (LONGEST + 1), "SN\0", "\ud800", "a\nb", 10**4200, 1.5, True, ["a"]]


def test_a_report_without_id_part_or_label_queues_nothing_and_the_store_goes_on(
    tmp_path, make_data
):
    x = make_data(2).X
    with DataEngine("pca", store=tmp_path / "engine.db") as engine:
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
        sources = engine.store.decisions.counts()["sources"]
        assert (sources["verification"], sum(sources.values())) == (1, 1)


class Baseline:
    """Answers with what it is told to."""

    def __init__(self, **answers):
        self.answers = {"n_success": 3, "n_failure": 0, "lower": 0.4, "upper": 1.0} | answers

    def fit(self, X, y):
        """Learn nothing."""

    add = fit

    def count(self, X):
        return [self.answers["n_success"]], [self.answers["n_failure"]]

    def predict_interval(self, X):
        return [self.answers["lower"]], [self.answers["upper"]]

    def decide(self, X):
        return [self.answers.get("action", "verify")]


@pytest.mark.parametrize("answer", ["NG", None])
def test_a_check_that_answers_no_label_ends_the_run_and_its_decision_is_kept(answer, make_data):
    engine, cell = DataEngine("pca"), ReplayCell(make_data(5))
    cell.verify = lambda: answer
    with pytest.raises(ReportError, match=r"of decision \S+, by verify\(\)") as caught:
        list(engine.run(cell, 5))
    id_ = re.search(r"of decision (\S+),", str(caught.value))[1]
    assert engine.store.decisions.counts()["decisions"] == 1
    engine.report(id_, True)  # what it really was, once somebody has looked
    assert engine.store.decisions.counts()["labels"] == 1


@pytest.mark.parametrize("answer", ["STOP", None, True])
def test_a_cell_that_goes_on_with_no_outcome_is_told_so_and_the_stop_is_not_taken_for_silence(
    answer, make_data
):
    baseline, cell = (
        Baseline(n_success=9, lower=1.0, action=Action.ACCEPT),
        ReplayCell(make_data(9)),
    )
    cell.proceed = lambda: answer
    with pytest.raises(ReportError, match=r"Expected an Outcome"):
        list(DataEngine(model=baseline, retrain_every=3).run(cell, 9))


WRONG = [
    *(("n_success", value) for value in (2**70, -1, 2.5, None)),
    *(("lower", value) for value in (np.nan, -0.1, 4.43)),
    ("n_failure", np.inf),
    ("upper", 0.1),
    ("action", "go"),
]


@pytest.mark.parametrize(("name", "value"), WRONG)
def test_a_baseline_that_counts_nonsense_is_a_model_error_and_the_store_goes_on(
    name, value, make_data
):
    data, engine = make_data(6), DataEngine(model=Baseline(**{name: value}), retrain_every=3)
    for x, y in zip(data.X, data.y, strict=True):
        decision = engine.decide(x)
        engine.report(decision.id, y)
    assert (decision.action, decision.reason) == (Action.VERIFY, Reason.MODEL_ERROR)
    assert engine.store.decisions.counts()["labels"] == 6
    assert engine.state.store_fault == ""
