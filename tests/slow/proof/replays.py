"""Replays of planted truths, judged by true probabilities: how often is more of what passed bad than was promised?

    >>> row = judge(seed=0, case=Case("soft", truth="soft"))
    >>> row["members, ever"], row["passed, end"]   # mean true probabilities of failure, the worst and the last

What is claimed is of *members*: the parts that reached the level in force when the rule was told of them. The engine is
driven by hand, so that after each thing that it is told the rule's own count of members says whether that part was one.
"""

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from dengine import Action, DataEngine, Decision, Recipe
from dengine.recipe import RECIPES

from .truths import planted

Row = dict[str, Any]
POLICY = ("alpha", "lower_bound", "interval", "guarantee", "stops", "audit_rate", "label_within")
LOOKS = 25  # parts between two certificates
FEW = 30  # accepted parts: a mean over fewer is not looked at
SIDES = {"accepted": Action.ACCEPT, "rejected": Action.REJECT}
WHEN = ("ever", "end")


@dataclass(frozen=True)
class Case:
    """One configuration. Every field but the first three is one factor, at its base.

    share : of the repeats that are asked for.  rate : of the labels where the truth has one rate.
    order : "drawn", "best first", "worst first".  missing : share of the checks of bad parts that are never reported.
    late : decisions by which a stop comes late, at most.  confirms : of what was accepted, whether under stops="some" the
    good parts are told of, and not the bad ones.  mirrored : successes for failures, so rejects are looked at.
    """

    name: str
    truth: str = "soft"
    share: float = 1.0
    rate: float = 0.5
    reducer: str = "conv"
    alpha: float = 0.1
    lower_bound: float = 0.9
    interval: str = "wilson"
    guarantee: str = "pooled"
    stops: str = "all"
    audit_rate: float = 0.0
    label_within: int = 1000
    order: str = "drawn"
    missing: float = 0.0
    late: int = 0
    confirms: bool = False
    mirrored: bool = False
    cycles: int = 1503

    @property
    def side(self) -> str:
        """What is looked at."""
        return "rejected" if self.mirrored else "accepted"

    @property
    def tolerance(self) -> float:
        """The mean failure probability that is allowed."""
        return 1.0 - self.lower_bound

    @property
    def claims(self) -> bool:
        """Whether the row's members are called a guarantee: of rejected parts only where audits are the evidence."""
        return self.guarantee == "pooled" and (not self.mirrored or self.stops == "some")

    @property
    def recipe(self) -> Recipe:
        """The engine's."""
        return RECIPES[self.reducer].with_policy(**{name: getattr(self, name) for name in POLICY})


class Mean:
    """A running mean of true failure probabilities: as last looked at, and the largest, from `least` parts on."""

    def __init__(self, least: int = 1) -> None:
        self.n, self.sum, self.least = 0, 0.0, least
        self.end = self.ever = float("nan")

    def add(self, p: float, counts: bool) -> None:
        """A part, where it counts."""
        self.n, self.sum = self.n + counts, self.sum + counts * p

    def look(self, now: bool = True) -> None:
        """At this moment, where something is said of it."""
        if now and self.n >= self.least:
            self.end = self.sum / self.n
            self.ever = float(np.fmax(self.ever, self.end))


def judge(seed: int, case: Case) -> Row:
    """How much passed, and the mean true failure probability of members and of what passed: the largest ever, the last.

    Members are looked at whenever a part would pass, for then it is claimed of them; NaN where none did.
    """
    stream = planted(case.truth, case.cycles, case.lower_bound, seed, case.rate, case.order)
    stream = stream.mirrored() if case.mirrored else stream
    wrong = stream.p if case.mirrored else 1.0 - stream.p
    rng, side, action = np.random.default_rng([seed, 13]), int(case.mirrored), SIDES[case.side]
    members, passed, certain = Mean(), Mean(FEW), 0
    owed: deque[tuple[int, float]] = (
        deque()
    )  # checks that are never reported, and when they count as bad
    stops: deque[tuple[int, Decision]] = deque()  # that come late
    numbers = [None] * case.cycles if stream.data.part is None else stream.data.part
    with DataEngine(recipe=case.recipe, seed=seed, replaying=True) as engine:
        for i, (x, number, p) in enumerate(zip(stream.data.X, numbers, wrong, strict=True)):
            while stops and stops[0][0] <= i:
                engine.report(stops.popleft()[1].id, False)
            before = _members(engine, side)
            decision = engine.decide(x, part=number)
            if owed and owed[0][0] <= i:
                members.add(owed.popleft()[1], _members(engine, side) > before)
            certain += decision.predicted in SIDES.values()
            members.look(decision.predicted is action)
            passed.add(p, decision.action is action)
            passed.look()
            good, before = bool(stream.data.y[i]), _members(engine, side)
            checked, accepted = decision.action is Action.VERIFY, decision.action is Action.ACCEPT
            if accepted and case.late and not good:
                stops.append((i + 1 + int(rng.integers(case.late)), decision))
            elif checked and not good and rng.random() < case.missing:
                owed.append((i + 1 + case.label_within, p))
            elif checked or (accepted and (case.stops == "all" or good == case.confirms)):
                engine.report(decision.id, good)
            members.add(p, _members(engine, side) > before)
    means = {"members": members, "passed": passed}
    return {"certain": certain, "passed": passed.n} | {
        f"{name}, {when}": getattr(mean, when) for name, mean in means.items() for when in WHEN
    }


def spend(seed: int, case: Case) -> Row:
    """Under prices: the members' account in escapes, the most at which a part passed, and what the certificate said.

    saved : at the end what not checking the accepted saved less what they cost, by their true probabilities of failure.
    bound : what the certificate said of it then.  untrue : whether it ever said more.
    """
    stream, policy = (
        planted(case.truth, case.cycles, case.lower_bound, seed, case.rate, case.order),
        case.recipe.policy,
    )
    (check, escape, _), accepted = policy.prices, Mean()
    account, most, bound, untrue = 0.0, float("nan"), 0.0, False
    with DataEngine(recipe=case.recipe, seed=seed, replaying=True) as engine:
        for i, (x, y, p) in enumerate(zip(stream.data.X, stream.data.y, stream.p, strict=True)):
            decision, before = engine.decide(x), _members(engine, 0)
            if decision.action is Action.ACCEPT:
                most = float(np.fmax(most, account))
            accepted.add(1.0 - p, decision.action is Action.ACCEPT)
            if decision.action is not Action.REJECT:
                engine.report(decision.id, bool(y))
            account += (_members(engine, 0) > before) * (1.0 - y - policy.tolerances[0])
            if i % LOOKS == LOOKS - 1:
                bound = engine.certificate().saved or 0.0
                untrue |= bound > check * accepted.n - escape * accepted.sum
    saved = check * accepted.n - escape * accepted.sum
    return {
        "accepted": accepted.n,
        "account": most,
        "saved": saved,
        "bound": bound,
        "untrue": untrue,
    }


def broken(rows: Iterable[Row], what: str, tolerance: float) -> int:
    """In how many replays a mean of `judge` exceeds the tolerance."""
    return sum(row[what] > tolerance + 1e-9 for row in rows)


HELD, MOVING = ("sharp", "soft", "step", "mesa", "edge", "trap", "staircase", "just beyond", "bad few"), (
    "drifting", "jumping", "seasons")  # fmt: skip
FACTORS: dict[
    str, Row
] = {  # one at a time, beside the base: all stops known, as drawn, 1,503 parts at (0.1, 90 %)
    "best first": {"order": "best first"},
    "worst first": {"order": "worst first"},
    "10 % audits, some stops": {"stops": "some", "audit_rate": 0.1},
    "2 % audits, some stops": {"stops": "some", "audit_rate": 0.02},
    "30 % of bad checks never told": {"missing": 0.3, "label_within": 100},
    "stops up to 5 late": {"late": 5},
    "(0.05, 95 %)": {"alpha": 0.05, "lower_bound": 0.95},
    "rejects, 10 % audits": {"mirrored": True, "stops": "some", "audit_rate": 0.1},
    "rejects, all stops": {"mirrored": True},
    "pca": {"reducer": "pca"},
    "local": {"guarantee": "local", "share": 0.3},
    "5,000 parts": {"cycles": 5000, "share": 0.3},
}


def planted_cases() -> list[Case]:
    """Every truth at the base, and every factor by itself at two of them."""
    return [Case(truth, truth) for truth in (*HELD, *MOVING)] + [
        Case(f"{truth}, {name}", truth, **factor)
        for name, factor in FACTORS.items()
        for truth in ("soft", "trap")
    ]


def priced_cases() -> list[Case]:
    """Truths under the guarantee of costs."""
    truths = ("soft", "trap", "edge", "mesa", "drifting", "jumping")
    return [Case(truth, truth, share=0.2, guarantee="cost") for truth in truths]


def noise_cases() -> list[Case]:
    """Labels independent of the trace, or drawn once a part where parts repeat."""
    about: Row = {"share": 0.2, "cycles": 600}
    return [
        Case(f"{truth} {rate:g}", truth, rate=rate, **about)
        for truth in ("noise", "parts")
        for rate in (0.5, 0.8, 0.88)
    ]


def _members(engine: DataEngine, side: int) -> int:
    """How many members the rule has counted, of the parts that it accepts (0) or rejects (1)."""
    evidence = None if engine.model is None else getattr(engine.model.rule, "evidence", None)
    return 0 if evidence is None else int(evidence.member_counts[side, :, 0].sum())
