"""What several tests do with an engine: a model that only counts, and a run over a stretch of a
dataset's parts.
"""

from collections.abc import Iterable

import numpy as np

from dengine import Action, DataEngine, Dataset, Decision, Policy, Recipe, ReplayCell

RECIPE = Recipe("pca", radius=0.5, policy=Policy(alpha=0.1, lower_bound=0.9), retrain_every=40)


class Counting:
    """A model that verifies every part, and counts what it was trained on as successes, what joined
    since as failures.
    """

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


def make(recipe: Recipe = RECIPE, **options) -> DataEngine:
    return DataEngine(recipe=recipe, replaying=True, **options)


def drive(
    engine: DataEngine, data: Dataset, first: int = 0, last: int | None = None, **options
) -> list:
    """The cycles of the parts first..last."""
    order = np.arange(len(data))[first:last]
    return list(engine.run(ReplayCell(data, order, **options), len(order)))


def evidence(d: Decision) -> tuple:
    """All of a decision but its id, which is new in every run."""
    return (
        d.action,
        d.predicted,
        d.lower,
        d.upper,
        d.n_success,
        d.n_failure,
        d.embedding,
        d.model_version,
        d.reason,
    )


def rule_state(engine: DataEngine) -> dict[str, list]:
    """What the decision rule has learned."""
    return {name: value.tolist() for name, value in engine.model.rule.state_dict().items()}


def learn(engine: DataEngine, data: Dataset, rows: Iterable[int]) -> None:
    """Decide on parts, and report all that may be reported."""
    for i in rows:
        decision = engine.decide(data.X[i])
        if decision.action is not Action.REJECT:
            engine.report(decision.id, bool(data.y[i]))


def easy_parts(n: int, seed: int, wave: slice = slice(0)) -> Dataset:
    """Traces of 40 samples in two easy shapes, each of a part of its own. wave : where the sensor
    was hit by one.
    """
    rng = np.random.default_rng(seed)
    y = rng.random(n) < 0.6
    X = np.where(y[:, None], np.linspace(0, 5, 40), np.linspace(5, 0, 40)) + rng.normal(
        0, 0.3, (n, 40)
    )
    X[wave] = 2 * X[wave] + 8 * np.sin(2 * np.arange(40))
    part = np.array([f"part-number-{i:05d}" for i in range(n)])
    return Dataset(X.astype(np.float32), y.astype(np.int8), name="easy", part=part)
