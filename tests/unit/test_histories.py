"""The engine's use of its rules: in random histories everything is counted as a recount from the
store counts it, and planted faults are found by the same recount.

`python -m tests.slow.proof.engine` plays a thousand histories.
"""

import re
from dataclasses import replace

import numpy as np
import pytest

from dengine import folds
from dengine.decision.references import RadiusIndex
from dengine.engine import learner
from dengine.engine.live_model import LiveModel
from dengine.model import neighbours
from tests.slow.proof.engine import hashing
from tests.slow.proof.engine.checking import check_history
from tests.slow.proof.engine.directions import Directions
from tests.slow.proof.engine.histories import CASES

QUICK = ("local, all stops", "pooled, audits", "two cells, pooled")  # the others are for each merge


@pytest.mark.parametrize(
    "name",
    [name if name in QUICK else pytest.param(name, marks=pytest.mark.merge) for name in CASES],
)
def test_in_random_histories_every_count_is_the_recount_from_the_store(name):
    row = check_history(name, 11)  # it is opened again while checks are overdue
    assert (row["faults"], row["fault"]) == (0, "")
    assert row["comparisons"] > 800
    assert row["versions"] > 1
    assert row["restarts"] > 0


def test_the_recount_hashes_as_the_documents_say_and_the_package_does():
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


def counted_twice(patch):
    """A label becomes two references, of two parts."""
    add_one = RadiusIndex.add_one

    def add_two(self, point, label, space, part=0, number=0):
        add_one(self, point, label, space, part, number)
        if number % 7 == 3:
            add_one(self, point, label, space, part + 1, number)

    patch.setattr(RadiusIndex, "add_one", add_two)


def counted_where_it_was_learned(patch):
    """One label in ten is in another fold in every retrain but the first."""
    fold_of = neighbours.fold_of
    train = neighbours.ModelPrediction.train
    n_trainings = [0]

    def counting(self, *args, **options):
        n_trainings[0] += 1
        return train(self, *args, **options)

    def moving(hashes, n_folds):
        moves = (hashes % 10 == 0) & (n_trainings[0] > 1)
        return (fold_of(hashes, n_folds) + moves) % n_folds

    patch.setattr(neighbours.ModelPrediction, "train", counting)
    patch.setattr(neighbours, "fold_of", moving)


def trained_on_its_own_fold(patch):
    """Space 0 is trained on its own fold's labels as well."""
    train = Directions.train

    def peek(self, X, y, folds_, *rest, **options):
        train(self, X, y, np.where(folds_ == 0, 1, folds_), *rest, **options)
        return self.embed_references(X, folds_)

    patch.setattr(Directions, "train", peek)


def score_changed_after_its_label(patch):
    """The rule is updated with the bound that the part has once its own label counts."""
    learn = LiveModel.learn

    def late(self, stored, success, number, n_unreported):
        decision = stored.decision
        if self.answering is not None and decision.n_success + decision.n_failure:
            lower = float(np.clip(decision.lower + (0.2 if success else -0.2), 0.0, decision.upper))
            stored = replace(stored, decision=replace(decision, lower=lower))
        return learn(self, stored, success, number, n_unreported)

    patch.setattr(LiveModel, "learn", late)


def corrected_label_counts_as_before(patch):
    """References do not hear of corrections."""
    patch.setattr(LiveModel, "apply_corrections", lambda self, corrections: True)


def corrected_outcome_counts_as_before(patch):
    """The rule does not hear of corrections."""
    patch.setattr(LiveModel, "rebuild_rule", lambda self: None)


def late_label_ignored(patch):
    """A label that comes after the next decision is stored, and nothing learns it."""
    learn = LiveModel.learn

    def deaf(self, stored, success, number, n_unreported):
        is_late = stored.number < self.outbox.n_decisions
        if is_late and stored.decision.action == "verify":
            return None
        return learn(self, stored, success, number, n_unreported)

    patch.setattr(LiveModel, "learn", deaf)


def overdue_check_ignored(patch):
    """A missing result of a check counts as nothing."""
    patch.setattr(LiveModel, "count_overdue", lambda self, decision: None)


def forgotten_label_in_the_weights(patch):
    """A retrain goes on from weights that learned a forgotten label."""
    patch.setattr(
        learner, "find_clean_start", lambda store, template, newest, trained: (newest, "")
    )


def label_lost_in_a_restart(patch):
    """A restart forgets the labels since the newest version."""
    patch.setattr(
        "dengine.engine.live_model.add_labels_since", lambda model, store, version, capacity: 0
    )


def pinned_version_replaced(patch):
    """A retrain that is due replaces a version that somebody went back to."""
    patch.setattr(LiveModel, "pinned", property(lambda self: 0))


# Each with a history that shows it, and how the first difference begins. A restart that changes what
# an engine has learned is a difference, too.
FAULTS = """
counted_twice                        cost          counts
counted_where_it_was_learned         cost          versions
trained_on_its_own_fold              local         versions
score_changed_after_its_label        cost          a restart changed
corrected_label_counts_as_before     cost          counts
corrected_outcome_counts_as_before   cost          account
late_label_ignored                   cost          counts
overdue_check_ignored                cost, audits  account
forgotten_label_in_the_weights       cost          versions
label_lost_in_a_restart              cost          a restart changed
pinned_version_replaced              cost          pins
"""


@pytest.mark.merge
@pytest.mark.parametrize("line", FAULTS.strip().splitlines(), ids=lambda line: line.split()[0])
def test_a_planted_fault_is_found(line, monkeypatch):
    mutation, name, kind = re.split("  +", line)
    globals()[mutation](monkeypatch)
    row = check_history(name, 3 if mutation == "late_label_ignored" else 1)
    assert row["faults"] > 0
    assert kind in row["fault"]
