"""The engine's use of its rules: in random histories everything is counted as a recount from the
store counts it, and planted faults are found by the same recount.

`python -m tests.slow.proof.engine` plays a thousand histories.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from dengine import folds
from dengine.decision.references import RadiusIndex
from dengine.engine import learner
from dengine.engine.live_model import LiveModel
from dengine.model import neighbours
from dengine.testing import check_reducer
from tests.slow.proof.engine import hashing
from tests.slow.proof.engine.checking import check_history
from tests.slow.proof.engine.directions import Directions
from tests.slow.proof.engine.histories import CASES, draw_steps

Mutation = Callable[[pytest.MonkeyPatch], None]
QUICK = ("local, all stops", "pooled, audits")  # the other cases are for each merge


@pytest.mark.parametrize(
    "name",
    [name if name in QUICK else pytest.param(name, marks=pytest.mark.merge) for name in CASES],
)
def test_in_random_histories_every_count_is_the_recount_from_the_store(name: str) -> None:
    row = check_history(name, 11)  # it is opened again while checks are overdue
    assert (row["faults"], row["fault"]) == (0, "")
    assert row["comparisons"] > 800
    assert row["versions"] > 1
    assert row["restarts"] > 0


def test_a_seed_always_gives_the_same_steps_and_another_one_others() -> None:
    case = CASES["pooled"]

    def words(seed: int) -> list[Any]:
        return [(step.kind, step.u, step.trace.tolist()) for step in draw_steps(case, seed)]

    assert words(0) == words(0) != words(1)


def test_the_recount_hashes_as_the_documents_say_and_the_package_does() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        part = str(rng.integers(10**6))
        trace = rng.normal(10.0, 30.0, (1, 2, 37)).astype(np.float32)
        content = int(folds.content_hash(trace)[0])
        assert hashing.hash_of_part(part) == folds.part_hash(part)
        assert hashing.hash_of_trace(trace) == content
        assert hashing.fold(content, 5) == folds.fold_of(np.array([content]), 5)[0]
        coin = int(folds.toss(np.array([content]), folds.audit_salt(3))[0])
        assert hashing.is_audited(content, 3, 0.4) == (coin < int(0.4 * 2**30))


def test_the_reducer_of_the_histories_keeps_the_contract() -> None:
    check_reducer(Directions(2))


def counted_twice(patch: pytest.MonkeyPatch) -> None:
    """A label becomes two references, of two parts."""
    add_one = RadiusIndex.add_one

    def add_two(self: Any, point: Any, label: float, space: int, part: int = 0, number: int = 0):
        add_one(self, point, label, space, part, number)
        if number % 7 == 3:
            add_one(self, point, label, space, part + 1, number)

    patch.setattr(RadiusIndex, "add_one", add_two)


def counted_where_it_was_learned(patch: pytest.MonkeyPatch) -> None:
    """One label in ten is in another fold in every retrain but the first."""
    fold_of = neighbours.fold_of
    train = neighbours.ModelPrediction.train
    n_trainings = [0]

    def counting(self: Any, *args: Any, **options: Any) -> Any:
        n_trainings[0] += 1
        return train(self, *args, **options)

    def moving(hashes: Any, n_folds: int) -> Any:
        moves = (hashes % 10 == 0) & (n_trainings[0] > 1)
        return (fold_of(hashes, n_folds) + moves) % n_folds

    patch.setattr(neighbours.ModelPrediction, "train", counting)
    patch.setattr(neighbours, "fold_of", moving)


def trained_on_its_own_fold(patch: pytest.MonkeyPatch) -> None:
    """Space 0 is trained on its own fold's labels as well."""
    train = Directions.train

    def peek(self: Any, X: Any, y: Any, folds_: Any, *rest: Any, **options: Any) -> Any:
        train(self, X, y, np.where(folds_ == 0, 1, folds_), *rest, **options)
        return self.embed_references(X, folds_)

    patch.setattr(Directions, "train", peek)


def score_changed_after_its_label(patch: pytest.MonkeyPatch) -> None:
    """The rule is updated with the bound that the part has once its own label counts."""
    learn = LiveModel.learn

    def late(self: Any, stored: Any, success: bool, number: int, n_unreported: Any) -> Any:
        decision = stored.decision
        if self.answering is not None and decision.n_success + decision.n_failure:
            better = 0.2 if success else -0.2
            lower = float(np.clip(decision.lower + better, 0.0, decision.upper))
            stored = replace(stored, decision=replace(decision, lower=lower))
        return learn(self, stored, success, number, n_unreported)

    patch.setattr(LiveModel, "learn", late)


def corrected_label_counts_as_before(patch: pytest.MonkeyPatch) -> None:
    """References do not hear of corrections."""
    patch.setattr(LiveModel, "apply_corrections", lambda self, corrections: True)


def corrected_outcome_counts_as_before(patch: pytest.MonkeyPatch) -> None:
    """The rule does not hear of corrections."""
    patch.setattr(LiveModel, "rebuild_rule", lambda self: None)


def late_label_ignored(patch: pytest.MonkeyPatch) -> None:
    """A label that comes after the next decision is stored, and nothing learns it."""
    learn = LiveModel.learn

    def deaf(self: Any, stored: Any, success: bool, number: int, n_unreported: Any) -> Any:
        is_late = stored.number < self.outbox.n_decisions
        if is_late and stored.decision.action == "verify":
            return None
        return learn(self, stored, success, number, n_unreported)

    patch.setattr(LiveModel, "learn", deaf)


def overdue_check_ignored(patch: pytest.MonkeyPatch) -> None:
    """A missing result of a check counts as nothing."""
    patch.setattr(LiveModel, "count_overdue", lambda self, decision: None)


def forgotten_label_in_the_weights(patch: pytest.MonkeyPatch) -> None:
    """A retrain goes on from weights that learned a forgotten label."""
    patch.setattr(
        learner, "find_clean_start", lambda store, template, newest, trained: (newest, "")
    )


def label_lost_in_a_restart(patch: pytest.MonkeyPatch) -> None:
    """A restart forgets the labels since the newest version."""
    patch.setattr(
        "dengine.engine.live_model.add_labels_since", lambda model, store, version, capacity: 0
    )


def pinned_version_replaced(patch: pytest.MonkeyPatch) -> None:
    """A retrain that is due replaces a version that somebody went back to."""
    patch.setattr(LiveModel, "pinned", property(lambda self: 0))


# With a history that shows it, and how the first difference begins. A restart that changes what an
# engine has learned is a difference, too.
FAULTS: dict[str, tuple[Mutation, str, int, str]] = {
    "counted twice": (counted_twice, "cost", 1, "counts"),
    "counted where it was learned": (counted_where_it_was_learned, "cost", 1, "versions"),
    "trained on its own fold": (trained_on_its_own_fold, "local", 1, "versions"),
    "score changed after its label": (
        score_changed_after_its_label,
        "cost",
        1,
        "a restart changed",
    ),
    "corrected label as before": (corrected_label_counts_as_before, "cost", 1, "counts"),
    "corrected outcome as before": (corrected_outcome_counts_as_before, "cost", 1, "account"),
    "late label ignored": (late_label_ignored, "cost", 3, "counts"),
    "overdue check ignored": (overdue_check_ignored, "cost, audits", 1, "account"),
    "forgotten label in the weights": (forgotten_label_in_the_weights, "cost", 1, "versions"),
    "label lost in a restart": (label_lost_in_a_restart, "cost", 1, "a restart changed"),
    "pinned version replaced": (pinned_version_replaced, "cost", 1, "pins"),
}


@pytest.mark.merge
@pytest.mark.parametrize(("mutation", "name", "seed", "kind"), FAULTS.values(), ids=FAULTS)
def test_a_planted_fault_is_found(
    mutation: Mutation, name: str, seed: int, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    mutation(monkeypatch)
    row = check_history(name, seed)
    assert row["faults"] > 0
    assert kind in row["fault"]
