"""The two ends of the scale: verify every part, and verify none."""

from __future__ import annotations

from typing import Self

from numpy.typing import ArrayLike

from ...records import Action
from .base import Judgement, Labels, Rival, Traces


class AlwaysVerify(Rival):
    """Every part is verified: no error, and nothing saved."""

    def _learn(self, X: Traces, good: Labels) -> bool:
        return True

    def _judge(self, X: Traces) -> Judgement:
        return Judgement.same(len(X), Action.VERIFY)


class NeverVerify(Rival):
    """Every part is accepted, whatever it looks like: all is saved, and every bad part stops the system.

    An engine has no model before its first retrain, so the first `retrain_every` parts are verified all the same.
    """

    def fit(self, X: ArrayLike, y: ArrayLike) -> Self:
        """Nothing to learn: labels of one class are as good as any."""
        self._last, self.ready = None, True
        return self

    def _learn(self, X: Traces, good: Labels) -> bool:
        return True

    def _judge(self, X: Traces) -> Judgement:
        return Judgement.same(len(X), Action.ACCEPT)
