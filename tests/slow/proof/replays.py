"""Replays of planted truths, judged by true probabilities: how often is what was accepted worse than the tolerance?

>>> row = judge(seed=0, case=Case("conv, soft", truth="soft", guarantee="pooled", stops="all"))
>>> row["accepted"], row["accepted_failure"]         # how many, and their mean true probability of failure
"""

from dataclasses import dataclass
from typing import Any

from dengine import Recipe, replay
from dengine.recipe import RECIPES

from .truths import planted

Row = dict[str, Any]
MOVING = ("drifting", "jumping")
POLICY = ("alpha", "lower_bound", "interval", "guarantee", "stops", "audit_rate")


@dataclass(frozen=True)
class Case:
    """One configuration. share : of the repeats that are asked for; rate : of the labels where the truth has one rate."""

    name: str
    truth: str = "soft"
    rate: float = 0.5
    reducer: str = "conv"
    alpha: float = 0.1
    lower_bound: float = 0.9
    interval: str = "wilson"
    guarantee: str = "pooled"
    stops: str = "all"
    audit_rate: float = 0.0
    mirrored: bool = False
    cycles: int = 600
    share: float = 1.0

    @property
    def tolerance(self) -> float:
        """The mean failure probability that is allowed."""
        return 1.0 - self.lower_bound

    @property
    def claims_accepts(self) -> bool:
        """Whether the rows are called a guarantee: not where the truth moves, for a level's past then is not its future."""
        return self.guarantee == "pooled" and self.truth not in MOVING

    @property
    def claims_rejects(self) -> bool:
        """Rejected parts tell nothing of themselves: only audits do, where they are the evidence."""
        return self.claims_accepts and self.audit_rate > 0.0 and self.stops == "some"

    @property
    def recipe(self) -> Recipe:
        """The engine's."""
        return RECIPES[self.reducer].with_policy(**{name: getattr(self, name) for name in POLICY})


def judge(seed: int, case: Case) -> Row:
    """Counts, and the mean true probability of a wrong decision, NaN where nothing was decided, among each side."""
    stream = planted(case.truth, case.cycles, case.lower_bound, seed, case.rate)
    stream = stream.mirrored() if case.mirrored else stream
    log = replay(stream.data, case.recipe, seed=seed, shuffle=False)
    row: Row = {}
    for side, of, wrong in (
        ("accepted", log.accepted, ("accepted_failure", 1.0 - stream.p)),
        ("rejected", log.rejected, ("rejected_success", stream.p)),
    ):
        row |= {side: int(of.sum()), wrong[0]: float(wrong[1][of].mean()) if of.any() else float("nan")}
    return row


def broken(rows: list[Row], side: str, tolerance: float) -> int:
    """In how many replays the truth of the accepted ("accepted_failure") or the rejected exceeds the tolerance."""
    return sum(row[side] > tolerance + 1e-9 for row in rows)


LEVELS = {"10 %": (0.1, 0.9), "5 %": (0.05, 0.95), "20 %": (0.2, 0.8)}  # alpha and LB
FEW, HALF = 0.15, 0.5  # of the repeats: for comparison, and beside a main row
RATES = (0.5, 0.8, 0.88)  # at chance, at the paper's, and just beyond the tolerance
PAPER: Row = {"guarantee": "local", "stops": "some"}


def beside_the_paper(name: str, truth: str = "soft", share: float = HALF, few: float = FEW, **about: Any) -> list[Case]:
    """A case under the pooled guarantee, and for comparison under the paper's local rule."""
    return [Case(name, truth, share=share, **about), Case(f"{name}, local", truth, share=few, **about, **PAPER)]


def noise_cases() -> list[Case]:
    """Labels independent of the trace."""
    cases = [Case("noise 0.8, conv, local, 1503", "noise", 0.8, cycles=1503, share=0.05, **PAPER)]
    for reducer, cycles, share in (("conv", 500, 0.4), ("pca", 500, 0.2), ("rocket", 300, 0.05), ("umap", 250, 0.02)):
        for rate in RATES:
            about: Row = {"rate": rate, "reducer": reducer, "cycles": cycles}
            cases += beside_the_paper(f"noise {rate:g}, {reducer}", "noise", share, share / 2, **about)
    return cases


def planted_cases() -> list[Case]:
    """Truths, by level, interval, reducer, and what is known of accepted and rejected parts."""
    hard, audited = ("soft", "step", "just beyond"), {"audit_rate": 0.1, "share": HALF}
    cases = [
        Case("soft, local, all stops", guarantee="local", share=FEW),
        Case("soft, some stops, audits", stops="some", **audited),
        Case("soft, audits", **audited),
        Case("jumping, some stops, audits", "jumping", stops="some", **audited),
        *beside_the_paper("soft, mirrored", share=FEW, mirrored=True),
        *(Case(f"{truth}, mirrored, audits", truth, mirrored=True, **audited) for truth in hard),
    ]
    for level, (alpha, lb) in LEVELS.items():
        for truth in hard:
            share = 1.0 if level == "10 %" else HALF
            cases += beside_the_paper(f"{truth}, {level}", truth, share, alpha=alpha, lower_bound=lb)
    for truth in ("moderate", "drifting", "jumping", "bad few"):
        cases += beside_the_paper(truth, truth)
    for rate in RATES:
        cases += beside_the_paper(f"parts {rate:g}", "parts", HALF if rate == 0.88 else FEW, rate=rate)
    for truth in ("soft", "step"):
        cases += beside_the_paper(f"{truth}, pca", truth, reducer="pca")
    return cases
