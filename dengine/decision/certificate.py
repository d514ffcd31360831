"""What became of the parts that went on without a check: an upper bound on how many were bad, however often one looks.

    >>> failure_bound(1203, 24, alpha=0.05)     # 1,203 parts, 24 of them bad: 2 % were seen, 3.5 % is the bound
    0.0349...

With probability 1 - alpha the bound is, at all moments together, at or above the mean of the failure probabilities that
the parts so far really had. These may differ from part to part and drift; the model may be retrained, and its rule may
learn from every outcome. What is assumed: an audit's coin falls with the stated probability whatever the part is, and every
audit's outcome is reported (one that was lost must count as bad). It speaks of parts past, not of those to come.
Source: see `betting`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol

from ..errors import SettingError
from .rule import log_evidence

if TYPE_CHECKING:
    from .policy import Policy, Stops

CONFIRMED_SHARE = 0.1  # of alpha, where audits and confirmations both speak: the former see less and need more
RARE = 0.02  # the audit rate that is assumed where none is set
ENDLESS = 10**8  # more audits than that are none


class Outcomes(Protocol):
    """How many parts the model was certain of, and what became of them: whole numbers.

    accepted, rejected : let go without a check, since the policy's settings were last changed.
    stops, confirmed : of the accepted, those known to be bad, and known to be good.
    audited_accepts, audited_accepts_bad : checked though the model would have accepted, and those of them that were bad.
    audited_rejects, audited_rejects_good : checked though the model would have rejected, and those of them that were good.
    """

    @property
    def accepted(self) -> int: ...
    @property
    def stops(self) -> int: ...
    @property
    def confirmed(self) -> int: ...
    @property
    def audited_accepts(self) -> int: ...
    @property
    def audited_accepts_bad(self) -> int: ...
    @property
    def rejected(self) -> int: ...
    @property
    def audited_rejects(self) -> int: ...
    @property
    def audited_rejects_good(self) -> int: ...


@dataclass(frozen=True, slots=True)
class Bounded:
    """A group of parts and the bound on how many of them were decided wrongly, on average.

    n : parts the claim is about.  n_looked_at : those whose outcome is known.  n_bad : those known to be decided wrongly.
    propensity : probability with which each was looked at; 0 where nobody looked, so that nothing is known.
    alpha : what this bound may spend, the certificate's or a share of it.  upper : the bound, 1 where nothing is known.
    shadowed : none of them was decided without a check, each was audited: the shadow mode.
    """

    n: int
    n_looked_at: int
    n_bad: int
    propensity: float
    alpha: float
    upper: float
    shadowed: bool = False

    @property
    def bad_rate(self) -> float:
        """Share of those looked at that were decided wrongly; 0 where none was looked at."""
        return self.n_bad / max(1, self.n_looked_at)

    def audits_needed(self, target: float, bad_rate: float = 0.0) -> int | None:
        """About how many more outcomes, of which `bad_rate` are bad, would bring the bound to `target`; None: no number.

        At a propensity below 1 each of them stands for 1 / propensity parts. Where nobody looks it counts from now on, as
        if one part in fifty were audited.
        """
        if not 0.0 < target < 1.0:
            raise SettingError(f"Expected 0 < target < 1, got {target!r}; 0.05 asks for at most 5 % bad.")
        n, propensity = (self.n, self.propensity) if self.propensity > 0.0 else (0, RARE)

        def reached(more: int) -> bool:
            n_bad = self.n_bad + math.ceil(bad_rate * more - 1e-9)
            return log_evidence(n + int(more / propensity), n_bad, target, propensity) >= math.log(1.0 / self.alpha)

        if reached(0):
            return 0
        high = 1
        while not reached(high):
            high *= 2
            if high > ENDLESS:
                return None
        low = high // 2
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (low, middle) if reached(middle) else (middle, high)
        return high


@dataclass(frozen=True, slots=True)
class Certificate:
    """What can be said, at level 1 - alpha and at any moment, of the parts that the model decided alone.

    accepted : the bound on the mean probability that an accepted part was bad.  rejected : that a rejected one was good.
    tolerance : what the user allows of either, 1 - lower_bound. Each bound holds at 1 - alpha by itself.
    """

    alpha: float
    tolerance: float
    accepted: Bounded
    rejected: Bounded

    @property
    def kept(self) -> bool:
        """Whether the bound on the accepted parts lies within the tolerance."""
        return self.accepted.upper <= self.tolerance

    @property
    def sentence(self) -> str:
        """What a plant manager may rely on about accepted parts, in one sentence."""
        unknown = "silence is no success: set audit_rate, or stops='all' where every bad part stops the system"
        return self._sentence(self.accepted, "that went on without a check", "accept", "bad", unknown)

    @property
    def sentence_on_rejects(self) -> str:
        """The same about rejected parts."""
        unknown = "nobody looks at what is rejected: set audit_rate"
        return self._sentence(self.rejected, "rejected without a check", "reject", "good", unknown)

    @property
    def advice(self) -> str:
        """How many more audits the tolerance takes, or where it is kept, half of it; the parts being accepted ones."""
        what = "parts" if self.accepted.propensity == 1.0 else "audits"
        target = self.tolerance / 2.0 if self.kept else self.tolerance
        good, same = self.audits_needed(target), self.audits_needed(target, self.accepted.bad_rate)
        if self.accepted.upper <= target:
            return f"Even {_percent(target)} is shown."
        if good is None:
            return f"No number of {what} would show {_percent(target)}."
        asked = f"To show {_percent(target)} takes about {good:,} more {what} if all are good"
        if self.accepted.n_bad == 0:
            return f"{asked}."
        return f"{asked}; at the present rate {'no number would do' if same is None else f'about {same:,}'}."

    def audits_needed(self, target: float | None = None, bad_rate: float = 0.0) -> int | None:
        """`Bounded.audits_needed` of the accepted parts; `target` is by default the tolerance."""
        return self.accepted.audits_needed(self.tolerance if target is None else target, bad_rate)

    def _sentence(self, part: Bounded, which: str, verb: str, wrong: str, unknown: str) -> str:
        parts = f"{part.n:,} part{'s' if part.n != 1 else ''}"
        if part.n == 0:
            return f"Nothing can be said yet: no part was one {which}."
        if part.propensity == 0.0:
            return f"Of {parts} {which} nothing can be said, for {unknown}."
        if part.propensity < 1.0:
            which = f"that the model would {verb}, of which {part.n_looked_at:,} were audited"
        if part.shadowed:
            which = f"that the model would {verb}, each of which was checked"
        if part.upper >= 1.0:
            return f"Of {parts} {which}, nothing can be said yet: too few were looked at."
        sure, tolerance = _percent(1.0 - self.alpha), _percent(self.tolerance)
        return (
            f"Of {parts} {which}, at most {_rounded_up(part.upper)} were {wrong} on average, "
            f"with {sure} confidence, however often one looks; the tolerance is {tolerance}."
        )


def failure_bound(n: int, n_bad: int, alpha: float, propensity: float = 1.0) -> float:
    """Upper bound on the mean failure probability of n parts, valid at all moments together with probability 1 - alpha.

    n : parts the claim is about.  n_bad : those of them that were looked at and were bad.
    propensity : probability with which each was looked at: 1 where every outcome is known, the audit rate where only audits
        are, 0 where nobody looks. Where it changed, the smallest.
    Returns the largest theta that the evidence does not refute, sup{theta: log_evidence < log(1 / alpha)}, by bisection, as
    the evidence grows with theta; never less than n_bad / (n propensity). 1 where nothing is known.
    """
    if not 0.0 < alpha < 1.0:
        raise SettingError(f"Expected 0 < alpha < 1, got {alpha!r}; 0.05 asks for 95 % confidence.")
    if not 0.0 <= propensity <= 1.0:
        raise SettingError(f"Expected 0 <= propensity <= 1, got {propensity!r}; 0.02 looks at one part in fifty.")
    if not 0 <= n_bad <= n:
        raise ValueError(f"Expected 0 <= n_bad <= n, got n_bad = {n_bad} of n = {n}; count each part once.")
    enough = math.log(1.0 / alpha)
    if propensity == 0.0 or log_evidence(n, n_bad, 1.0, propensity) < enough:
        return 1.0
    low, high = 0.0, 1.0
    for _ in range(50):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if log_evidence(n, n_bad, middle, propensity) >= enough else (middle, high)
    return high  # the refuted end: rounding widens


def certify(outcomes: Outcomes, alpha: float, tolerance: float, stops: Stops, audit_rate: float) -> Certificate:
    """The certificate of what became of all certain decisions so far.

    stops : "all" where every bad accepted part stops the system and is reported: then the outcome of each accepted part is
        known (whether the newest is still open is the caller's matter: leave it out). "some" where silence is no success.
    audit_rate : probability with which a certain decision is verified all the same, in [0, 1]. Where it changed since the
        first of these parts, the smallest.

    Under "some" the bound comes from audits, and it is about all parts the model would have accepted, let go or audited:
    the coin does not know the outcome, so the audited stand for all. It never lies below the share known to be bad. A cell
    that confirmed or stopped every accepted part so far knows as much as under "all", and then the claim is about
    these. Where both are possible they share alpha, so that whoever sees now the one and now the other is still wrong with
    probability alpha at most. Rejected parts are known by audits alone.
    """
    if stops not in _ACCEPTED:
        raise SettingError(f"Expected stops among {', '.join(_ACCEPTED)}, got {stops!r}.")
    if not 0.0 < tolerance < 1.0:
        raise SettingError(f"Expected 0 < tolerance < 1, got {tolerance!r}; 0.05 tolerates 5 % of errors.")
    n = outcomes.rejected + outcomes.audited_rejects
    rejected = _bounded(n, outcomes.audited_rejects, outcomes.audited_rejects_good, audit_rate, alpha)
    return Certificate(
        alpha=alpha,
        tolerance=tolerance,
        accepted=_ACCEPTED[stops](outcomes, alpha, audit_rate),
        rejected=replace(rejected, shadowed=audit_rate == 1.0 and outcomes.rejected == 0),
    )


def certificate_of(outcomes: Any, policy: Policy) -> Certificate:
    """What a store's `Outcomes` certify by a policy. Where all stops are known, a part counts once its silence is over.

    A label that was forgotten counts as a wrong decision, like an audit whose outcome was lost: forgetting earns nothing.
    """
    outcomes = replace(
        outcomes,
        stops=outcomes.stops + outcomes.forgotten_accepts,
        audited_accepts=outcomes.audited_accepts + outcomes.forgotten_audited_accepts,
        audited_accepts_bad=outcomes.audited_accepts_bad + outcomes.forgotten_audited_accepts,
        audited_rejects=outcomes.audited_rejects + outcomes.forgotten_audited_rejects,
        audited_rejects_good=outcomes.audited_rejects_good + outcomes.forgotten_audited_rejects,
    )
    if policy.stops == "all":
        outcomes = replace(outcomes, accepted=outcomes.stops + outcomes.confirmed)
    return certify(outcomes, policy.alpha, 1.0 - policy.lower_bound, policy.stops, policy.audit_rate)


def _where_all_stop(outcomes: Outcomes, alpha: float, _audit_rate: float) -> Bounded:
    return _bounded(outcomes.accepted, outcomes.accepted, outcomes.stops, 1.0, alpha)


def _where_some_stop(outcomes: Outcomes, alpha: float, audit_rate: float) -> Bounded:
    share = CONFIRMED_SHARE if audit_rate > 0.0 else 1.0
    if 0 < outcomes.accepted == outcomes.stops + outcomes.confirmed:
        return _bounded(outcomes.accepted, outcomes.accepted, outcomes.stops, 1.0, share * alpha)
    if audit_rate == 0.0:
        return _bounded(outcomes.accepted, 0, 0, 0.0, alpha)
    n, n_bad = outcomes.accepted + outcomes.audited_accepts, outcomes.audited_accepts_bad
    bounded = _bounded(n, outcomes.audited_accepts, n_bad, audit_rate, (1.0 - share) * alpha)
    shadowed = audit_rate == 1.0 and outcomes.accepted == 0
    return replace(bounded, upper=max(bounded.upper, (n_bad + outcomes.stops) / max(1, n)), shadowed=shadowed)


_ACCEPTED: dict[str, Callable[[Outcomes, float, float], Bounded]] = {"all": _where_all_stop, "some": _where_some_stop}


def _bounded(n: int, n_looked_at: int, n_bad: int, propensity: float, alpha: float) -> Bounded:
    return Bounded(n, n_looked_at, n_bad, propensity, alpha, failure_bound(n, n_bad, alpha, propensity))


def _percent(share: float) -> str:
    return f"{100.0 * share:.6g} %"


def _rounded_up(share: float) -> str:
    # A sentence must not promise more than the bound.
    digits = 1 if share >= 0.01 else 2 if share >= 0.001 else 4
    return f"{math.ceil(share * 10.0 ** (digits + 2)) / 10.0**digits:g} %"
