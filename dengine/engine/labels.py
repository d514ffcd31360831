"""`CellLabels` and `ProductLabels`: each adds labels to the training window, and counts those since
the last retrain began. `feedback.Feedback` adds labels; `learner.Learner` asks whether a retrain is
due.

`CellLabels` is for a cell that learns alone. `ProductLabels` is for a cell that shares a product
with others, whose labels have one sequence in the store.
"""

from __future__ import annotations

import numpy as np

from ..model.base import EngineModel
from ..records import State, TraceArray
from ..store.records import NewLabel, StoredDecision
from .guard import NO_REFERENCE, guarded
from .live_model import LiveModel
from .trainer import TrainingWindow


class CellLabels:
    """Labels of a cell that learns alone; each one counts as soon as it is learned.

    Parameters
    ----------
    window : TrainingWindow
        Takes each label that is recorded.

    Attributes
    ----------
    new_labels : int
        Labels since the last retrain began.
    """

    def __init__(self, window: TrainingWindow) -> None:
        self._window = window
        self.new_labels = 0

    def resume(self, counts_from: int) -> None:
        """Count the labels of the training window with a number above `counts_from` as new."""
        self.new_labels = len(self._window.newer(counts_from))

    def recount(self, counts_from: int) -> None:
        """Count again, after the training window was filled anew because labels were corrected."""
        self.resume(counts_from)

    def add(self, stored: StoredDecision, label: NewLabel) -> None:
        """Add a learned label, which is recorded, to the window, and count it."""
        self.new_labels += 1
        self._window.add(stored.trace, int(label.success), stored.content_hash, label.seq)

    def is_due(self, retrain_every: int) -> bool:
        """Return whether there are enough new labels for a retrain."""
        return self.new_labels >= retrain_every

    def begin_retrain(self) -> None:
        """Count from zero, because a retrain begins."""
        self.new_labels = 0

    def give_back(self, n_labels: int) -> None:
        """Count the labels of a retrain that was dropped as new again, so that the next one comes
        soon.
        """
        self.new_labels += n_labels


class ProductLabels:
    """Labels of all cells of a product, added to the window in the order of the store.

    A label of this cell is a reference at once. It enters the window when the store has given it a
    number and the other cells' labels before it have come.

    Parameters
    ----------
    window : TrainingWindow
    live : LiveModel
        Takes the peers' labels as references.
    """

    def __init__(self, window: TrainingWindow, live: LiveModel) -> None:
        self._window = window
        self._live = live
        # This cell's labels that the store has not numbered, by decision: the decision, and the
        # label with its provisional number.
        self._unnumbered: dict[str, tuple[StoredDecision, NewLabel]] = {}
        # This cell's labels whose predecessors are missing, by number: trace, label, hash.
        self._waiting: dict[int, tuple[TraceArray, int, int]] = {}
        # Labels since the newest retrain began: number, and whether the label is this cell's.
        self._since: list[tuple[int, bool]] = []
        self._trained_to = 0  # number of the newest label that the newest retrain had
        # Number of this cell's newest label; the rule was updated with all until there.
        self._updated_to = 0
        # The references of a version that was taken over hold every label up to this number; the
        # window may not yet.
        self._references_to = 0

    @property
    def new_labels(self) -> int:
        """Labels of all cells since the newest retrain began."""
        return len(self._since)

    @property
    def has_gaps(self) -> bool:
        """Whether labels of this cell wait for peers' labels before them."""
        return bool(self._waiting)

    def resume(self, counts_from: int) -> None:
        """Count the labels of the training window with a number above `counts_from` as new.

        This is done when a store is opened. They count as labels of other cells, so they alone
        never make it this cell's turn to retrain.
        """
        n_new = len(self._window.newer(counts_from))
        numbers = self._window.newer(0)
        self._since = [(number, False) for number in numbers[len(numbers) - n_new :]]
        self._trained_to = numbers[-n_new - 1] if len(numbers) > n_new else 0
        self._updated_to = self._window.newest_seq

    def recount(self, counts_from: int) -> None:
        """Count the new labels again, after forgotten labels were taken out of the window.

        New are those above the newest number that the newest retrain had; `counts_from` is not
        used.
        """
        own_numbers = {number for number, is_own in self._since if is_own}
        newer = self._window.newer(self._trained_to)
        self._since = [(number, number in own_numbers) for number in newer]

    @property
    def has_unnumbered(self) -> bool:
        """Whether labels of this cell wait for their numbers."""
        return bool(self._unnumbered)

    def add(self, stored: StoredDecision, label: NewLabel) -> None:
        """Keep a recorded label of this cell, which is a reference already, until it is numbered.

        Until then its reference has the label's provisional number, and the label is not in the
        training window.
        """
        self._unnumbered[label.decision_id] = stored, label

    def assign_number(self, decision_id: str, number: int) -> None:
        """Give a label of this cell, and its reference, the number that the store gave it.

        It enters the window at once if its number is the next one, else when the other cells'
        labels before it have come. Nothing happens if the label was never added; the label of a
        trace with a fault is not.
        """
        if decision_id not in self._unnumbered:
            return
        stored, label = self._unnumbered.pop(decision_id)
        if self._live.answering is not None:
            self._live.answering.renumber_reference(label.seq, number)
        row = (stored.trace, int(label.success), stored.content_hash)
        self._waiting[number] = row
        self._updated_to = max(number, self._updated_to)
        if number == self._window.newest_seq + 1:
            self.admit(*row, number)

    def admit(self, trace: TraceArray, label: int, hash_: int, seq: int) -> None:
        """Add the product's next label, of this cell or another, to the training window.

        Labels must come in the order of their numbers. A label counts as new unless the newest
        retrain was trained on it. A peer's label also becomes a reference of the model in force,
        unless that has it already; if the model cannot take it, that is logged.
        """
        is_own = self._waiting.pop(seq, None) is not None
        self._window.add(trace, label, hash_, seq)
        if seq > self._trained_to:
            self._since.append((seq, is_own))
        model = self._live.answering
        if not is_own and seq > self._references_to and model is not None:
            guarded(NO_REFERENCE, model.add_reference, trace, label, hash_, seq)

    def is_due(self, retrain_every: int) -> bool:
        """Return whether a retrain is due and this cell is the one to do it.

        It is this cell's turn if the new label number `retrain_every` is its own. If another cell
        missed its turn, it is also this cell's turn once one of its labels is the new label number
        2 * `retrain_every` or a later one.
        """
        due = self._since[retrain_every - 1 : retrain_every]
        missed = self._since[2 * retrain_every - 1 :]
        return any(is_own for _, is_own in (*due, *missed))

    def begin_retrain(self) -> None:
        """Count from zero, because a retrain on every label of the window begins."""
        self._trained_to = self._window.newest_seq
        self._since = []

    def add_missing_references(self, model: EngineModel) -> None:
        """Make this cell's waiting labels references of a version that it trained.

        They wait for labels of other cells that come before them in the store, so the training
        lacked them. A label that the model cannot take is logged and skipped.
        """
        self._references_to = 0
        self._add_waiting(model)

    def take_over(self, model: EngineModel, references_to: int, counts_from: int) -> None:
        """Add this cell's waiting labels to another cell's version, which is to be put in force.

        They become references of `model`, which has every label up to the number `references_to`
        already; later labels of peers are added when they come. Only labels with a number above
        `counts_from` still count as new.
        """
        self._references_to = references_to
        self._add_waiting(model)
        self._trained_to = counts_from
        self._since = [(number, is_own) for number, is_own in self._since if number > counts_from]

    def _add_waiting(self, model: EngineModel) -> None:
        """Add this cell's waiting labels to a version as references, unless it has them already."""
        for seq, (trace, label, hash_) in self._waiting.items():
            if seq > self._references_to:
                guarded(NO_REFERENCE, model.add_reference, trace, label, hash_, seq)

    def get_state(self) -> State:
        """Return the number of this cell's newest label, for a version's rule that learned it."""
        return {"rule_last_seq": np.array(self._updated_to)}
