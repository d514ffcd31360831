"""Streams of parts with known failure probabilities, and scores that are fixed before the labels.

Each stream plays many replays at once. `next` returns the failure probabilities and the scores of
one part in each replay; it may look at the rules and at all past outcomes. `learn` gives it the
outcomes. The probabilities are in units of the tolerance, so that one stream suits every rule.
"""

from collections.abc import Callable

import numpy as np

from .implementation import Bools, Floats, Rules

PartDraw = tuple[Floats, Floats]  # failure probabilities and scores, each of shape (R,)
N_SNOOPED = 20  # scores that a snooper chooses from
RETRAIN_EVERY = 50
EDGE = 1.03  # tolerances: just beyond what is allowed


class Stream:
    """Parts with a probability and a score that do not depend on the past.

    Parameters
    ----------
    tolerance : float
    n_replays, n_parts : int
    rng : Generator
    """

    def __init__(
        self, tolerance: float, n_replays: int, n_parts: int, rng: np.random.Generator
    ) -> None:
        self.tolerance = tolerance
        self.n_replays = n_replays
        self.n_parts = n_parts
        self.rng = rng

    def next(self, t: int, rules: Rules) -> PartDraw:
        """Return failure probabilities and scores of part t, each of shape (R,)."""
        raise NotImplementedError

    def learn(self, good: Bools) -> None:
        """Take the outcomes of the part, whether or not the rule hears of them."""

    def final_score(self, score: Floats, good: Bools) -> Floats:
        """Return the score that the rule gets. Only a planted fault changes it after the label."""
        return score

    def uniform(self, low: float, high: float) -> Floats:
        """Return a number for each replay."""
        return self.rng.uniform(low, high, self.n_replays)

    def constant(self, value: float) -> Floats:
        """Return the same number for each replay."""
        return np.full(self.n_replays, value)

    def mixed(self) -> Floats:
        """Return probabilities of a usual cell: most parts are good, some are bad."""
        kind = self.rng.random(self.n_replays)
        p = self.tolerance * self.uniform(0.0, 0.4)
        p = np.where(kind > 0.6, self.uniform(0.0, 0.6), p)
        return np.where(kind > 0.8, self.uniform(0.85, 1.0), p)


class Informative(Stream):
    """The score is the true probability of success."""

    def next(self, t: int, rules: Rules) -> PartDraw:
        p = self.mixed()
        return p, 1.0 - p


class Useless(Stream):
    """The score says nothing, and the parts fail slightly more often than is allowed."""

    def next(self, t: int, rules: Rules) -> PartDraw:
        is_bad_kind = self.rng.random(self.n_replays) < 0.5
        p = np.where(is_bad_kind, 2.0 * EDGE * self.tolerance, 0.0)
        return p, self.uniform(0.3, 1.0)


class Overconfident(Stream):
    """All parts are scored far better than they are, the worse ones lower."""

    def next(self, t: int, rules: Rules) -> PartDraw:
        p = self.tolerance * self.uniform(0.6, 2.0 * EDGE - 0.6)
        return p, 1.0 - 0.1 * p


class Drifting(Stream):
    """The score stays, while the probability rises from 0.3 to 3 tolerances."""

    def next(self, t: int, rules: Rules) -> PartDraw:
        p = self.constant(self.tolerance * (0.3 + 2.7 * t / self.n_parts))
        return p, 1.0 - 0.5 * self.tolerance * self.rng.random(self.n_replays)


class Alternating(Stream):
    """An informative model and a useless, confident one take turns at retrains."""

    def next(self, t: int, rules: Rules) -> PartDraw:
        p = self.mixed()
        is_useless = t // RETRAIN_EVERY % 2 == 1
        return p, 1.0 - (self.rng.permutation(p) if is_useless else p)


class Snooped(Stream):
    """Of many useless scores the one is taken whose best parts failed least so far."""

    def __init__(
        self, tolerance: float, n_replays: int, n_parts: int, rng: np.random.Generator
    ) -> None:
        super().__init__(tolerance, n_replays, n_parts, rng)
        self.n_best = np.zeros((n_replays, N_SNOOPED))
        self.n_best_wrong = np.zeros((n_replays, N_SNOOPED))
        self.is_best = np.zeros((n_replays, N_SNOOPED), dtype=bool)

    def next(self, t: int, rules: Rules) -> PartDraw:
        scores = self.rng.random((self.n_replays, N_SNOOPED))
        self.is_best = scores > 0.5
        share = (self.n_best_wrong + 1.0) / (self.n_best + 2.0)
        chosen = share.argmin(axis=1)
        score = scores[np.arange(self.n_replays), chosen]
        score = 1.0 - 2.0 * self.tolerance * (1.0 - score)  # the better half reaches the tolerance
        return self.constant(EDGE * self.tolerance), score

    def learn(self, good: Bools) -> None:
        self.n_best += self.is_best
        self.n_best_wrong += self.is_best & ~good[:, None]


class Adversary(Stream):
    """It knows the probabilities, the rule and all past outcomes, and picks the score to cheat.

    It lets parts in so that the members fail slightly more often than is allowed on average. While
    the rule is closed it tries other levels with the parts that it keeps out, until by luck the
    rule aims at one of them.
    """

    def __init__(
        self, tolerance: float, n_replays: int, n_parts: int, rng: np.random.Generator
    ) -> None:
        super().__init__(tolerance, n_replays, n_parts, rng)
        self.n_members = np.zeros(n_replays)
        self.sum = np.zeros(n_replays)

    def next(self, t: int, rules: Rules) -> PartDraw:
        side = rules.sides[0]
        p = self.tolerance * self.uniform(0.0, 3.0)
        mean = (self.sum + p) / (self.n_members + 1.0)
        lets_in = (mean >= self.tolerance * 1.001) & (mean <= 1.2 * self.tolerance)
        aimed = side.levels[side.target]
        lower = side.levels[np.minimum(side.target + 1, len(side.levels) - 1)]
        is_luckier = self.rng.random(self.n_replays) < 0.5
        below = np.where(is_luckier & (lower < aimed), lower, 0.2)
        self.n_members += lets_in
        self.sum += np.where(lets_in, p, 0.0)
        return p, np.where(lets_in, aimed, below)


class Tied(Stream):
    """Three scores, two of them exactly on a level."""

    def next(self, t: int, rules: Rules) -> PartDraw:
        kind = self.rng.integers(0, 3, self.n_replays)
        levels = rules.sides[0].levels
        p = self.tolerance * np.choose(kind, [0.4, 2.0 * EDGE - 0.4, 5.0])
        return p, np.choose(kind, [levels[0], levels[-1], 0.2])


class Constant(Stream):
    """One score for all parts, which fail slightly more often than is allowed."""

    share = EDGE

    def next(self, t: int, rules: Rules) -> PartDraw:
        return self.constant(self.share * self.tolerance), self.constant(
            1.0 - 0.25 * self.tolerance
        )


class ConstantGood(Constant):
    """One score for all parts, which fail with 0.4 of what is allowed."""

    share = 0.4


class AtTolerance(Constant):
    """One score for all parts, which fail exactly as often as is allowed."""

    share = 1.0


class Peeking(Constant):
    """A planted fault: the score is changed after its label. The parts fail too often by half."""

    share = 1.5

    def final_score(self, score: Floats, good: Bools) -> Floats:
        caught = ~good & (self.rng.random(self.n_replays) < 0.5)
        return np.where(caught, 0.2, score)


class Doubling(Stream):
    """One score for all parts. They fail with 0.4 tolerances, and after 200 of them with two."""

    def next(self, t: int, rules: Rules) -> PartDraw:
        p = self.constant((0.4 if t < 200 else 2.0) * self.tolerance)
        return p, self.constant(1.0 - 0.25 * self.tolerance)


class Sly(Stream):
    """All parts are good while they are checked; while they pass, 3 tolerances of them are bad."""

    def next(self, t: int, rules: Rules) -> PartDraw:
        score = self.constant(1.0 - 0.25 * self.tolerance)
        passes = rules.sides[0].threshold <= score
        return np.where(passes, 3.0 * self.tolerance, 0.0), score


STREAMS: dict[str, Callable[..., Stream]] = {
    "informative": Informative,
    "useless": Useless,
    "overconfident": Overconfident,
    "drifting": Drifting,
    "alternating": Alternating,
    "snooped": Snooped,
    "adversary": Adversary,
    "tied": Tied,
    "constant": Constant,
    "constant, good": ConstantGood,
    "at the tolerance": AtTolerance,
    "doubling": Doubling,
    "peeking": Peeking,
    "sly": Sly,
}
