"""What several tests do with an engine: a model that only counts, and a run over a stretch of a dataset's parts."""

from collections.abc import Iterable

import numpy as np

from dengine import Action, DataEngine, Dataset, Decision, ReplayCell


class Counting:
    """A model that verifies every part, and counts what it was trained on as successes, what joined since as failures."""

    def __init__(self) -> None:
        self.fitted, self.added = 0, 0

    def __deepcopy__(self, memo):
        return type(self)()

    def fit(self, X, y):
        self.fitted = len(y)

    def add(self, x, y):
        self.added += 1

    def count(self, X):
        return np.full(len(X), self.fitted), np.full(len(X), self.added)

    def predict_interval(self, X):
        return np.zeros(len(X)), np.ones(len(X))

    def decide(self, X):
        return np.full(len(X), Action.VERIFY, dtype=object)


def drive(engine: DataEngine, data: Dataset, first: int = 0, last: int | None = None, **options) -> list:
    """The cycles of the parts first..last."""
    order = np.arange(len(data))[first:last]
    return list(engine.run(ReplayCell(data, order, **options), len(order)))


def evidence(d: Decision) -> tuple:
    """All of a decision but its id, which is new in every run."""
    return (d.action, d.predicted, d.lower, d.upper, d.n_success, d.n_failure, d.embedding, d.model_version, d.reason)


def learn(engine: DataEngine, data: Dataset, rows: Iterable[int]) -> None:
    """Decide on parts, and report all that may be reported."""
    for i in rows:
        decision = engine.decide(data.X[i])
        if decision.action is not Action.REJECT:
            engine.report(decision.id, bool(data.y[i]))
