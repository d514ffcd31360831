"""Which alpha and LB pay: what a part costs under each, in replays of the user's own recordings.

    curve = cost_curve("insertion", check=5, escape=600, false_reject=30, recipe="pca", n_jobs=2)
    print(curve.sentence)
    curve.policy, curve.to_frame()

A part's mean cost, in one unit of the user's, is check x verified + escape x accepted and bad + false_reject x rejected and
good, over all parts of a replay, its beginning included. Verifying everything costs `check` a part.

The cheapest of many candidates is partly the luckiest: it is chosen on one half of the shuffles, with half an error added
to each count of them, and reported on the other. That takes the luck of the order out, not that of the recordings: every
shuffle plays the same parts. The interval is a little too narrow for a policy picked among many; only parts recorded later
are a clean test.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, astuple, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ..decision.policy import Policy
from ..errors import SettingError, expect, percent
from .grid import Folder, Task, grid_tasks, play_tasks
from .metrics import Costs, ErrorRate, pooled_error
from .replay import Contender, Replay

if TYPE_CHECKING:
    import pandas as pd


ALPHAS = (0.2, 0.1, 0.05)
LOWER_BOUNDS = (0.8, 0.9, 0.95, 0.98, 0.99)
REPEATS = 10  # shuffles, half of them to choose by
LEVEL = 0.05  # of the intervals


@dataclass(frozen=True, slots=True)
class PolicyCost:
    """What a part costs under one policy; all but `chosen_by` over the shuffles that report.

    chosen_by : expected cost a part over the shuffles that choose: every share of wrong decisions with half an error added.
    cost : mean cost a part.
    lower, upper : the cost with both shares of wrong decisions at the ends of their intervals, together 95 %.
    late : mean cost a part over the last third of each shuffle, once something was learned.
    verified, certain : shares of all parts, checked or not.
    bad : bad parts among the accepted.  good : good ones among the rejected.
    """

    policy: Policy
    chosen_by: float
    cost: float
    lower: float
    upper: float
    late: float
    verified: float
    certain: float
    bad: ErrorRate
    good: ErrorRate


@dataclass(frozen=True, slots=True)
class CostCurve:
    """What a part costs under each policy that was tried, in recordings of `dataset`.

    rows : by alpha, from the largest, then LB; last the guarantee of costs, where it was tried.
    recipe : its name.  cycles : of each shuffle.
    choosing, reporting : how many shuffles did what.
    """

    costs: Costs
    rows: tuple[PolicyCost, ...]
    dataset: str
    recipe: str
    cycles: int
    choosing: int
    reporting: int

    @property
    def cheapest(self) -> PolicyCost:
        """Cheapest in the shuffles that choose, of those that decided anything; of equal ones the strictest."""
        decided = [row for row in self.rows if row.certain] or self.rows
        return min(decided, key=lambda row: (row.chosen_by, -row.policy.lower_bound, row.policy.alpha))

    @property
    def verdict(self) -> str:
        """Of the cheapest policy: "pays" (its whole interval is below verifying everything), "may pay" (its mean is), or
        "does not pay".
        """
        row = self.cheapest
        if max(row.chosen_by, row.cost) >= self.costs.check:
            return "does not pay"
        return "pays" if row.upper < self.costs.check else "may pay"

    @property
    def policy(self) -> Policy | None:
        """The policy that pays, or may: try it in the shadow mode first. None where none does: verify everything."""
        return None if self.verdict == "does not pay" else self.cheapest.policy

    @property
    def sentence(self) -> str:
        """The result, for people."""
        row, every = self.cheapest, f"verifying everything costs {self.costs.check:g} a part"
        who = f"alpha {row.policy.alpha:g}, LB {100 * row.policy.lower_bound:g} %"
        who = "the cost guarantee" if row.policy.guarantee == "cost" else who
        between = f"with the errors at the ends of their 95 % intervals {row.lower:.3g} to {row.upper:.3g}"
        if not any(each.certain for each in self.rows):
            return f"Nothing pays yet: {every}, and under each policy that was tried everything was verified. Record more."
        if self.policy is None:
            seen = f"is expected to cost {row.chosen_by:.3g} and cost {row.cost:.3g} in other shuffles, {between}"
            return f"Nothing pays: {every}; the cheapest policy, {who}, {seen}. Go on verifying, or record more."
        said = f"{who} {self.verdict}: {row.cost:.3g} a part, {between}; {every}."
        if self.verdict == "pays":
            return said
        bad, worst = (percent(share, ".3g") for share in (row.bad.upper, self.costs.worst_accept))
        but = f"of the accepted parts up to {bad} may be bad, and accepting pays up to {worst}"
        return f"{said} Not certainly: {but}. More recordings narrow that; in production audits and stops do."

    def to_frame(self) -> "pd.DataFrame":
        """A row a policy; shares from 0 to 1, costs in the user's unit."""
        import pandas as pd

        frame = pd.json_normalize([asdict(row) for row in self.rows], sep="_")  # policy_alpha, bad_rate …
        own = [name for name in frame if not name.startswith("policy_")]
        two = {f"policy_{name}": name for name in ("guarantee", "alpha", "lower_bound")}
        return frame[[*two, *own]].rename(columns=two).assign(chosen=[row.policy == self.policy for row in self.rows])


def cost_curve(
    dataset: Any,
    *,
    check: float,
    escape: float,
    false_reject: float,
    recipe: Any = "conv",
    alphas: Sequence[float] = ALPHAS,
    lower_bounds: Sequence[float] = LOWER_BOUNDS,
    repeats: int = REPEATS,
    seed: int = 0,
    cycles: int | None = None,
    n_jobs: int = 1,
    keep: Folder | None = None,
) -> CostCurve:
    """Replay recordings under every alpha and lower bound, and by the costs themselves, and say what a part cost.

    dataset : anything `load_dataset` takes, such as a folder of recordings.
    check, escape, false_reject : as in `Costs`, in one unit.
    recipe : anything `Recipe.load` takes; of its policy alpha and lower_bound are replaced, the rest is kept.
    repeats : shuffles of each policy, 2 or more: the first half of them chooses, the other reports.  seed : of the first.
    cycles : parts of each shuffle; None: all.  n_jobs, keep : as in `run_grid`.
    SettingError for a cost, a policy or a number of repeats that is none.
    """
    costs = Costs(check, escape, false_reject)
    expect(repeats >= 2, "2 or more repeats", repeats, "one half chooses, the other one reports")
    tasks = priced_tasks(recipe, costs, alphas, lower_bounds, range(seed, seed + repeats), cycles)
    return curve_of(play_tasks(dataset, tasks, n_jobs=n_jobs, keep=keep), costs)


def priced_tasks(
    who: Any,
    costs: Costs,
    alphas: Sequence[float],
    lower_bounds: Sequence[float],
    seeds: Sequence[int],
    cycles: int | None = None,
) -> list[Task]:
    """Every alpha and lower bound; then dengine's guarantee of costs, where it takes them and outcomes are heard of."""
    one, tasks = Contender.load(who), grid_tasks([who], alphas, lower_bounds, seeds=seeds, cycles=cycles)
    if one.baseline is None:
        with suppress(SettingError):  # of costs that are no prices, or of outcomes that nobody hears of
            tasks += grid_tasks([one.with_policy(guarantee="cost", prices=astuple(costs))], seeds=seeds, cycles=cycles)
    return tasks


def curve_of(replays: Sequence[Replay], costs: Costs) -> CostCurve:
    """The curve of finished replays, of one recipe; those of shuffles that not every policy has played are left out.

    SettingError where fewer than two shuffles are complete.
    """
    policies = list(dict.fromkeys(each.recipe.policy for each in replays))
    of = {(each.recipe.policy, each.seed): each for each in replays}
    seeds = [seed for seed in sorted({each.seed for each in replays}) if all((one, seed) in of for one in policies)]
    expect(len(seeds) >= 2, "2 or more shuffles that every policy has played", len(seeds))
    half = len(seeds) // 2
    rows = [
        _row(policy, [of[policy, seed] for seed in seeds[:half]], [of[policy, seed] for seed in seeds[half:]], costs)
        for policy in sorted(policies, key=lambda each: (each.guarantee == "cost", -each.alpha, each.lower_bound))
    ]
    one = replays[0]
    return CostCurve(costs, tuple(rows), one.dataset, one.name, len(one), half, len(seeds) - half)


def _row(policy: Policy, choosing: Sequence[Replay], reporting: Sequence[Replay], costs: Costs) -> PolicyCost:
    accepted, rejected = (float(np.mean([getattr(r, side) for r in reporting])) for side in ("accepted", "rejected"))
    # Each at half the level: together they hold at LEVEL.
    bad, good = (pooled_error(reporting, side, LEVEL / 2) for side in ("accepted", "rejected"))
    ends = ((bad.lower, good.lower), (bad.upper, good.upper))
    lower, upper = (costs.check - costs.saved(accepted + rejected, accepted * fp, rejected * fn) for fp, fn in ends)
    return PolicyCost(
        policy=policy,
        chosen_by=_expected_cost(choosing, costs),
        cost=float(np.mean([cost_a_part(each, costs) for each in reporting])),
        lower=lower,
        upper=upper,
        late=float(np.mean([cost_a_part(each, costs, slice(2 * len(each) // 3, None)) for each in reporting])),
        verified=1.0 - accepted - rejected,
        certain=accepted + rejected,
        bad=bad,
        good=good,
    )


def _expected_cost(replays: Sequence[Replay], costs: Costs) -> float:
    """Cost a part with each share of wrong decisions at its Jeffreys mean, (wrong + 1/2) / (decided + 1) in one shuffle.

    No error among 25 accepted parts is not no error ever: by the plain mean the few would look free, whatever one costs.
    """
    counts, names = [each.stretch() for each in replays], ("accepted", "false_positive", "rejected", "false_negative")
    accepted, bad, rejected, good = (float(np.mean([each[name] for each in counts])) for name in names)
    wrong = (accepted * (bad + 0.5) / (accepted + 1.0), rejected * (good + 0.5) / (rejected + 1.0))
    return costs.check - costs.saved(accepted + rejected, *wrong) / len(replays[0])


def cost_a_part(replay: Replay, costs: Costs, part: slice = slice(None)) -> float:
    """Mean cost a part over some cycles of a replay."""
    counts = replay.stretch(part)
    saved = costs.saved(counts["accepted"] + counts["rejected"], counts["false_positive"], counts["false_negative"])
    return float(costs.check - saved / (counts["last_cycle"] - counts["first_cycle"] + 1))
