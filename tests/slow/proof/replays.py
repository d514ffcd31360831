"""Replays of planted truths, judged by true probabilities: how often is what was accepted worse than the tolerance?

>>> row = judge(Case("conv, soft", truth="soft", guarantee="pooled", stops="all"), seed=0)
>>> row["accepted"], row["accepted_failure"]         # how many, and their mean true probability of failure
"""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dengine import Recipe, replay
from dengine.experiments.replay import Replay
from dengine.recipe import RECIPES

from .truths import Stream, planted

Row = dict[str, Any]
MOVING = ("drifting", "jumping")


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
        """Rejected parts tell nothing of themselves: only audits do."""
        return self.claims_accepts and self.audit_rate > 0.0

    def recipe(self) -> Recipe:
        """The engine's."""
        return RECIPES[self.reducer].with_policy(
            alpha=self.alpha,
            lower_bound=self.lower_bound,
            interval=self.interval,
            guarantee=self.guarantee,
            stops=self.stops,
            audit_rate=self.audit_rate,
        )

    def stream(self, seed: int) -> Stream:
        """What is played."""
        stream = planted(self.truth, self.cycles, self.lower_bound, seed, self.rate)
        return stream.mirrored() if self.mirrored else stream

    def plain(self) -> Row:
        """Its settings."""
        return asdict(self)


def played(case: Case, seed: int) -> tuple[Replay, Stream]:
    """The case's stream of that seed, through its engine."""
    stream = case.stream(seed)
    return replay(stream.data, case.recipe(), seed=seed, shuffle=False), stream


def judge(case: Case, seed: int) -> Row:
    """Counts, and the mean true probability of a wrong decision, NaN where nothing was decided, among each side."""
    log, stream = played(case, seed)
    accepted, rejected = log.accepted, log.rejected
    return {
        "seed": seed,
        "accepted": int(accepted.sum()),
        "accepted_failure": _mean(1.0 - stream.p[accepted]),
        "rejected": int(rejected.sum()),
        "rejected_success": _mean(stream.p[rejected]),
    }


def broken(rows: list[Row], side: str, tolerance: float) -> int:
    """In how many replays the truth of the accepted ("accepted_failure") or the rejected exceeds the tolerance."""
    return sum(row[side] > tolerance + 1e-9 for row in rows)


def _mean(values: NDArray[np.float64]) -> float:
    return float(values.mean()) if len(values) else float("nan")


LEVELS = {"10 %": (0.1, 0.9), "5 %": (0.05, 0.95), "20 %": (0.2, 0.8)}  # alpha and LB
FEW, HALF = 0.15, 0.5  # of the repeats: for comparison, and beside a main row
PAPER: Row = {"guarantee": "local", "stops": "some"}


def noise_cases() -> list[Case]:
    """Labels independent of the trace: at chance, at the paper's rate, and just beyond the tolerance."""
    cases = []
    for reducer, cycles, share in (("conv", 500, 0.4), ("pca", 500, 0.2), ("rocket", 300, 0.05), ("umap", 250, 0.02)):
        for rate in (0.5, 0.8, 0.88):
            about: Row = {"truth": "noise", "rate": rate, "reducer": reducer, "cycles": cycles}
            cases.append(Case(f"noise {rate:g}, {reducer}", share=share, **about))
            cases.append(Case(f"noise {rate:g}, {reducer}, local", share=share / 2, **about, **PAPER))
    return [*cases, Case("noise 0.8, conv, local, 1503", "noise", 0.8, cycles=1503, share=0.05, **PAPER)]


def planted_cases() -> list[Case]:
    """Truths under the pooled guarantee, and under the paper's local rule for comparison."""
    cases: list[Case] = []
    for level, (alpha, lb) in LEVELS.items():
        at: Row = {"alpha": alpha, "lower_bound": lb}
        for truth in ("soft", "step", "just beyond"):
            cases.append(Case(f"{truth}, {level}", truth, share=1.0 if level == "10 %" else HALF, **at))
            cases.append(Case(f"{truth}, {level}, local", truth, share=FEW, **at, **PAPER))
    for truth in ("moderate", "drifting", "jumping", "bad few"):
        cases.append(Case(truth, truth, share=HALF))
        cases.append(Case(f"{truth}, local", truth, share=FEW, **PAPER))
    cases += [
        Case("soft, local, all stops", guarantee="local", share=FEW),
        Case("soft, some stops", stops="some", share=HALF),
        Case("soft, some stops, audits", stops="some", audit_rate=0.1, share=HALF),
        Case("soft, audits", audit_rate=0.1, share=HALF),
        Case("jumping, some stops, audits", "jumping", stops="some", audit_rate=0.1, share=HALF),
        Case("soft, mirrored", mirrored=True, share=FEW),
        Case("soft, mirrored, local", mirrored=True, share=FEW, **PAPER),
    ]
    cases += [
        Case(f"{t}, mirrored, audits", t, mirrored=True, audit_rate=0.1, share=HALF)
        for t in ("soft", "step", "just beyond")
    ]
    for interval in ("binomial", "clopper_pearson", "jeffreys"):
        cases.append(Case(f"soft, {interval}", interval=interval, share=HALF))
        cases.append(Case(f"soft, {interval}, local", interval=interval, share=FEW, **PAPER))
    for rate in (0.5, 0.8, 0.88):
        cases.append(Case(f"parts {rate:g}", "parts", rate, share=HALF if rate == 0.88 else FEW))
        cases.append(Case(f"parts {rate:g}, local", "parts", rate, share=FEW, **PAPER))
    for truth in ("soft", "step"):
        cases.append(Case(f"{truth}, pca", truth, reducer="pca", share=HALF))
        cases.append(Case(f"{truth}, pca, local", truth, reducer="pca", share=FEW, **PAPER))
    return cases
