"""Replays of planted truths: is more of what passed bad than was promised?

    >>> row = judge(seed=0, case=Case("soft", truth="soft"))
    >>> row["members, ever"], row["passed, end"]

Each replay is judged by the true failure probabilities of its parts: by their mean at the worst
moment ("ever") and at the end. The promise is about *members*, the parts whose score reached the
threshold that was in force when the rule learned of them. The replay drives the engine by hand and
looks at the rule's own count of members after each step, so it knows which parts are members.
"""

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from dengine import Action, DataEngine, Decision, Recipe
from dengine.recipe import RECIPES

from .truths import Stream, planted

Row = dict[str, Any]
# Fields of a case that are fields of its policy.
POLICY = ("alpha", "lower_bound", "interval", "guarantee", "stops", "audit_rate", "label_within")
PARTS_PER_CERTIFICATE = 25
FEWEST = 30  # accepted parts: a mean over fewer is not judged
SIDES = {"accepted": Action.ACCEPT, "rejected": Action.REJECT}
MOMENTS = ("ever", "end")


@dataclass(frozen=True)
class Case:
    """One configuration of replays. Each field but the first three changes one factor of the base.

    Parameters
    ----------
    name : str
        Of the configuration.
    truth : str
        As `planted` takes it.
    share : float
        Of the repeats that were asked for.
    rate : float
        Success rate of a truth that has only one.
    reducer : str
        A name in `RECIPES`.
    alpha, lower_bound, interval, guarantee, stops, audit_rate, label_within
        Of the policy.
    order : {"drawn", "best first", "worst first"}
    missing : float
        Share of the checks of bad parts that are never reported.
    late : int
        A line stop is reported up to this many decisions late.
    confirms : bool
        Of the accepted parts, under stops="some": report the good ones and not the bad ones.
    mirrored : bool
        Swap successes and failures, so that rejects are judged.
    cycles : int
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
        """Which parts are judged: "accepted" or "rejected"."""
        return "rejected" if self.mirrored else "accepted"

    @property
    def tolerance(self) -> float:
        """Mean failure probability that is allowed."""
        return 1.0 - self.lower_bound

    @property
    def is_promise(self) -> bool:
        """Whether a guarantee holds for the members.

        For rejected parts there is one only if audits are the evidence.
        """
        return self.guarantee == "pooled" and (not self.mirrored or self.stops == "some")

    @property
    def recipe(self) -> Recipe:
        """Recipe of the engine."""
        return RECIPES[self.reducer].with_policy(**{name: getattr(self, name) for name in POLICY})

    def stream(self, seed: int) -> Stream:
        """Return the parts of the replay with this seed."""
        stream = planted(self.truth, self.cycles, self.lower_bound, seed, self.rate, self.order)
        return stream.mirrored() if self.mirrored else stream

    def reports_accepted(self, good: bool) -> bool:
        """Return whether the outcome of an accepted part is reported."""
        return self.stops == "all" or good == self.confirms


class RunningMean:
    """A running mean of true failure probabilities.

    Parameters
    ----------
    fewest : int, default 1
        Parts from which on the mean is judged.

    Attributes
    ----------
    n : int
    sum : float
    end, ever : float
        The mean when it was last judged, and the largest that was judged; NaN before that.
    """

    def __init__(self, fewest: int = 1) -> None:
        self.n = 0
        self.sum = 0.0
        self.fewest = fewest
        self.end = float("nan")
        self.ever = float("nan")

    def add(self, probability: float) -> None:
        """Add a part."""
        self.n += 1
        self.sum += probability

    def judge(self) -> None:
        """Judge the mean at this moment, if it has enough parts."""
        if self.n >= self.fewest:
            self.end = self.sum / self.n
            self.ever = float(np.fmax(self.ever, self.end))


def count_members(engine: DataEngine, side: int) -> int:
    """Return how many members the rule has counted, of accepted parts (0) or rejected ones (1)."""
    evidence = None if engine.model is None else getattr(engine.model.rule, "evidence", None)
    return 0 if evidence is None else int(evidence.member_counts[side, :, 0].sum())


def judge(seed: int, case: Case) -> Row:
    """Play one replay; return the mean true failure probabilities of members and of what passed.

    Members are judged whenever a part would pass, because that is when the promise is made; what
    passed is judged after every part.

    Returns
    -------
    row : dict
        certain: decisions without a check; passed: accepted parts (rejected ones if mirrored);
        "members, ever", "members, end", "passed, ever" and "passed, end": means, NaN without parts.
    """
    return JudgedReplay(seed, case).play()


class JudgedReplay:
    """One replay of a planted truth, see `judge`.

    Attributes
    ----------
    members, passed : RunningMean
        Of the members, and of the parts that passed.
    n_certain : int
    missing_checks : deque of (int, float)
        Checks of bad parts that are never reported: the cycle from which on they count as bad, and
        the part's failure probability.
    late_stops : deque of (int, str)
        Line stops to be reported: at which cycle, and of which decision.
    """

    def __init__(self, seed: int, case: Case) -> None:
        self.case = case
        self.stream = case.stream(seed)
        self.p_wrong = self.stream.p if case.mirrored else 1.0 - self.stream.p
        self.action = SIDES[case.side]
        self.rng = np.random.default_rng([seed, 13])
        self.engine = DataEngine(recipe=case.recipe, seed=seed, replaying=True)
        self.members = RunningMean()
        self.passed = RunningMean(FEWEST)
        self.n_certain = 0
        self.missing_checks: deque[tuple[int, float]] = deque()
        self.late_stops: deque[tuple[int, str]] = deque()

    def play(self) -> Row:
        """Play all parts and return the row."""
        with self.engine:
            for i in range(len(self.stream.data)):
                self._report_late_stops(i)
                decision = self._decide(i)
                self._judge(i, decision)
                self._report(i, decision)
        row: Row = {"certain": self.n_certain, "passed": self.passed.n}
        for name, mean in {"members": self.members, "passed": self.passed}.items():
            row |= {f"{name}, {moment}": getattr(mean, moment) for moment in MOMENTS}
        return row

    def _report_late_stops(self, i: int) -> None:
        """Report the line stops that are due at cycle i."""
        while self.late_stops and self.late_stops[0][0] <= i:
            _, decision_id = self.late_stops.popleft()
            self.engine.report(decision_id, False)

    def _decide(self, i: int) -> Decision:
        """Decide on part i; a missing check that becomes overdue with it may be a member."""
        data = self.stream.data
        part = None if data.part is None else data.part[i]
        n_members = self._count_members()
        decision = self.engine.decide(data.X[i], part=part)
        if self.missing_checks and self.missing_checks[0][0] <= i:
            _, probability = self.missing_checks.popleft()
            if self._count_members() > n_members:
                self.members.add(probability)
        return decision

    def _judge(self, i: int, decision: Decision) -> None:
        """Count the decision on part i, and judge both means at this moment."""
        self.n_certain += decision.predicted in SIDES.values()
        if decision.predicted is self.action:
            self.members.judge()
        if decision.action is self.action:
            self.passed.add(self.p_wrong[i])
        self.passed.judge()

    def _report(self, i: int, decision: Decision) -> None:
        """Report the outcome of part i now, later or never, as the case says."""
        case = self.case
        good = bool(self.stream.data.y[i])
        n_members = self._count_members()
        is_checked = decision.action is Action.VERIFY
        is_accepted = decision.action is Action.ACCEPT
        if is_accepted and case.late and not good:
            cycle = i + 1 + int(self.rng.integers(case.late))
            self.late_stops.append((cycle, decision.id))
        elif is_checked and not good and self.rng.random() < case.missing:
            self.missing_checks.append((i + 1 + case.label_within, self.p_wrong[i]))
        elif is_checked or (is_accepted and case.reports_accepted(good)):
            self.engine.report(decision.id, good)
        if self._count_members() > n_members:
            self.members.add(self.p_wrong[i])

    def _count_members(self) -> int:
        """Return how many members the rule has counted on the judged side."""
        return count_members(self.engine, int(self.case.mirrored))


def spend(seed: int, case: Case) -> Row:
    """Play one replay under the guarantee of costs and return what the accepted parts cost.

    Returns
    -------
    row : dict
        accepted : number of accepted parts.
        account : the members' cost beyond their checks, in false accepts, at the worst moment at
        which a part passed; NaN if none did.
        saved : what the accepted parts saved at the end, by their true failure probabilities.
        bound : what the certificate said of it then.
        untrue : whether the certificate ever said more than was saved.
    """
    stream = case.stream(seed)
    policy = case.recipe.policy
    check_price, escape_price, _ = policy.prices
    accepted = RunningMean()
    account = 0.0
    largest_account = float("nan")
    bound = 0.0
    is_untrue = False

    def saved() -> float:
        return check_price * accepted.n - escape_price * accepted.sum

    with DataEngine(recipe=case.recipe, seed=seed, replaying=True) as engine:
        for i, trace in enumerate(stream.data.X):
            label = stream.data.y[i]
            decision = engine.decide(trace)
            n_members = count_members(engine, 0)
            if decision.action is Action.ACCEPT:
                largest_account = float(np.fmax(largest_account, account))
                accepted.add(1.0 - stream.p[i])
            if decision.action is not Action.REJECT:
                engine.report(decision.id, bool(label))
            if count_members(engine, 0) > n_members:
                account += 1.0 - label - policy.tolerances[0]
            if i % PARTS_PER_CERTIFICATE == PARTS_PER_CERTIFICATE - 1:
                bound = engine.certificate().saved or 0.0
                is_untrue |= bound > saved()
    return {
        "accepted": accepted.n,
        "account": largest_account,
        "saved": saved(),
        "bound": bound,
        "untrue": is_untrue,
    }


def count_broken(rows: Iterable[Row], mean: str, tolerance: float) -> int:
    """Return in how many replays a mean that `judge` returned exceeds the tolerance."""
    return sum(row[mean] > tolerance + 1e-9 for row in rows)


FIXED_TRUTHS = (
    "sharp",
    "soft",
    "step",
    "mesa",
    "edge",
    "trap",
    "staircase",
    "just beyond",
    "bad few",
)
MOVING_TRUTHS = ("drifting", "jumping", "seasons")
FACTOR_TRUTHS = ("soft", "trap")  # that each factor is tried with
# Name -> what it changes of the base: all stops known, drawn order, 1,503 parts at (0.1, 90 %).
FACTORS: dict[str, Row] = {
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
    """Return every truth at the base, and every factor at two of them."""
    cases = [Case(truth, truth) for truth in (*FIXED_TRUTHS, *MOVING_TRUTHS)]
    for name, changes in FACTORS.items():
        cases += [Case(f"{truth}, {name}", truth, **changes) for truth in FACTOR_TRUTHS]
    return cases


def priced_cases() -> list[Case]:
    """Return truths under the guarantee of costs."""
    truths = ("soft", "trap", "edge", "mesa", "drifting", "jumping")
    return [Case(truth, truth, share=0.2, guarantee="cost") for truth in truths]


def noise_cases() -> list[Case]:
    """Return cases whose labels are independent of the trace.

    In "parts", parts come several times, with the same label.
    """
    return [
        Case(f"{truth} {rate:g}", truth, rate=rate, share=0.2, cycles=600)
        for truth in ("noise", "parts")
        for rate in (0.5, 0.8, 0.88)
    ]
