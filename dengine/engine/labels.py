"""`CellLabels`: counts a cell's labels since the last retrain began, and adds them to the training
window. `feedback.Feedback` adds labels; `learner.Learner` asks whether a retrain is due.
"""

from __future__ import annotations

from ..store.records import NewLabel, StoredDecision
from .live_model import LiveModel
from .trainer import TrainingWindow


class CellLabels:
    """Labels of a cell; each one counts as soon as it is learned.

    Parameters
    ----------
    window : TrainingWindow
        Takes each label that is recorded; in a product, whose cells share labels, `fleet.Peers`
        reads them from the store instead.
    live : LiveModel
        Its references get the numbers of their labels.

    Attributes
    ----------
    new_labels : int
        Labels since the last retrain began. In a product these are the cell's own, and those of
        peers that came after the version in force was trained, and before this cell put it in force
        or opened the store.
    """

    def __init__(self, window: TrainingWindow, live: LiveModel) -> None:
        self._window = window
        self._live = live
        self.new_labels = 0
        # In a product: labels that the store has not numbered, by decision, with the provisional
        # numbers of their references.
        self._provisional: dict[str, int] = {}

    def count_from(self, number: int) -> None:
        """Count the labels of the training window with a number above this one as new."""
        self.new_labels = len(self._window.newer(number))

    def add(self, stored: StoredDecision, label: NewLabel) -> None:
        """Add a label, which was learned and recorded, to the training window, and count it as new.

        `stored` is its decision with the trace, which must have no fault. In a product the number
        of the label is provisional (below 0): then the label is counted, but not added, and the
        number is noted until the store gives the label another. A full window loses its oldest
        label.
        """
        self.new_labels += 1
        if label.seq > 0:
            self._window.add(stored.trace, int(label.success), stored.content_hash, label.seq)
        else:
            self._provisional[label.decision_id] = label.seq

    @property
    def has_provisional(self) -> bool:
        """Whether the store has not numbered some label yet."""
        return bool(self._provisional)

    def assign_number(self, decision_id: str, number: int) -> None:
        """Give the reference of a label the number that the store gave the label.

        Nothing happens for a label that was not added, like that of a trace with a fault.
        """
        provisional = self._provisional.pop(decision_id, None)
        if provisional is not None and self._live.answering is not None:
            self._live.answering.renumber_reference(provisional, number)

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
