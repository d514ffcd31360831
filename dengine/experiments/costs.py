"""Which alpha and LB pay: what a part costs under each, in replays of the user's own recordings.
The verb `costs` prints it.

    curve = cost_curve("insertion", check=5, escape=600, false_reject=30, recipe="pca", n_jobs=2)
    print(curve.sentence)
    curve.policy, curve.to_frame()

A part's mean cost is check x verified + escape x (accepted and bad) + false_reject x (rejected and
good), in one unit of the user's, over all parts of a replay, its beginning included. Verifying
everything costs `check` per part. A part that an operator's limits reject costs `check`, too, so
that no policy pays by the limits, which are the same under each.

The cheapest of many candidates is partly the luckiest. So the policy is chosen on one half of the
shuffles, with half an error added to each count of errors, and reported on the other half. That
takes the luck of the order out, not that of the recordings: every shuffle plays the same parts. The
interval is a little too narrow for a policy picked among many; only parts recorded later are a
clean test.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, astuple, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ..decision.policy import Policy
from ..errors import SettingError, expect, percent
from ..files import FilePath
from .grid import Task, grid_tasks, play_tasks
from .metrics import Costs, ErrorRate, pooled_error
from .replay import Contender, Replay

if TYPE_CHECKING:
    import pandas as pd


ALPHAS = (0.2, 0.1, 0.05)
LOWER_BOUNDS = (0.8, 0.9, 0.95, 0.98, 0.99)
REPEATS = 10  # shuffles, half of them to choose by
ERROR_LEVEL = 0.05  # of the intervals


@dataclass(frozen=True, slots=True)
class PolicyCost:
    """What a part costs under one policy, over the shuffles that report.

    Attributes
    ----------
    policy : Policy
    expected_cost : float
        Per part over the shuffles that choose, with half an error added to each share of wrong
        decisions. The cheapest policy is chosen by it.
    cost : float
        Mean per part.
    lower, upper : float
        The cost with both shares of wrong decisions at the ends of their intervals, which hold
        together at 95 %.
    late : float
        Mean cost per part over the last third of each shuffle, when something has been learned.
    verified, certain : float
        Shares of the parts that were checked, and that the model accepted or rejected. The rest are
        those that an operator's limits rejected.
    bad, good : ErrorRate
        Bad parts among the accepted ones, good parts among the rejected ones.
    """

    policy: Policy
    expected_cost: float
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
    """What a part costs under each policy that was tried.

    Attributes
    ----------
    costs : Costs
    rows : tuple of PolicyCost
        By alpha, from the largest, then by LB; last the guarantee of costs, if it was tried.
    dataset, recipe : str
        Their names.
    cycles : int
        Parts of each shuffle.
    choosing, reporting : int
        Number of shuffles that chose, and that report.
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
        """The policy with the lowest expected cost among those that decided anything.

        Of equal ones that with the highest LB, then the lowest alpha. If none decided anything, all
        are compared.
        """
        deciding = [row for row in self.rows if row.certain] or self.rows

        def key(row: PolicyCost) -> tuple[float, float, float]:
            return row.expected_cost, -row.policy.lower_bound, row.policy.alpha

        return min(deciding, key=key)

    @property
    def verdict(self) -> str:
        """Whether the cheapest policy costs less than verifying everything: one of three texts.

        "does not pay" if its expected cost or its mean cost is not below that, "pays" if its whole
        interval is, else "may pay".
        """
        row = self.cheapest
        if max(row.expected_cost, row.cost) >= self.costs.check:
            return "does not pay"
        return "pays" if row.upper < self.costs.check else "may pay"

    @property
    def policy(self) -> Policy | None:
        """The policy that pays, or may pay; None if none does.

        Try it in shadow mode first.
        """
        return None if self.verdict == "does not pay" else self.cheapest.policy

    @property
    def sentence(self) -> str:
        """The verdict for people, in one to three sentences.

        It names the cheapest policy, its cost per part with the interval, and what verifying
        everything costs; if it only may pay, also which share of bad parts among the accepted would
        still pay. If no policy decided anything, it says only that and what verifying costs.
        """
        row = self.cheapest
        verify_all = f"verifying everything costs {self.costs.check:g} a part"
        if not any(item.certain for item in self.rows):
            return (
                f"Nothing pays yet: {verify_all}, and under each policy that was tried everything "
                f"was verified. Record more."
            )
        name = f"alpha {row.policy.alpha:g}, LB {100 * row.policy.lower_bound:g} %"
        if row.policy.guarantee == "cost":
            name = "the cost guarantee"
        ends = f"{row.lower:.3g} to {row.upper:.3g}"
        interval = f"with the errors at the ends of their 95 % intervals {ends}"
        if self.policy is None:
            return (
                f"Nothing pays: {verify_all}; the cheapest policy, {name}, is expected to cost "
                f"{row.expected_cost:.3g} and cost {row.cost:.3g} in other shuffles, {interval}. "
                "Go on verifying, or record more."
            )
        result = f"{name} {self.verdict}: {row.cost:.3g} a part, {interval}; {verify_all}."
        if self.verdict == "pays":
            return result
        bad = percent(row.bad.upper, ".3g")
        worst = percent(self.costs.worst_accept, ".3g")
        return (
            f"{result} Not certainly: of the accepted parts up to {bad} may be bad, and accepting "
            f"pays up to {worst}. More recordings narrow that; in production audits and stops do."
        )

    def to_frame(self) -> "pd.DataFrame":
        """Return a DataFrame with a row for each policy, its costs, shares and error rates.

        The column `chosen` is True in the row of the policy that pays or may pay, False in all rows
        if none does. Shares are from 0 to 1, costs in the user's unit.
        """
        import pandas as pd

        # Its columns are policy_alpha, bad_rate and so on.
        frame = pd.json_normalize([asdict(row) for row in self.rows], sep="_")
        names = {f"policy_{name}": name for name in ("guarantee", "alpha", "lower_bound")}
        others = [name for name in frame if not name.startswith("policy_")]
        frame = frame[[*names, *others]].rename(columns=names)
        return frame.assign(chosen=[row.policy == self.policy for row in self.rows])


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
    keep: FilePath | None = None,
) -> CostCurve:
    """Compute what a part costs under every alpha and LB, and under ``guarantee="cost"``.

    The data set is replayed `repeats` times under each of these policies. ``guarantee="cost"`` is
    left out for a baseline, and where `Policy` refuses it with these costs, `stops` and
    `audit_rate`.

    Parameters
    ----------
    dataset : object
        Anything `load_dataset` takes, such as a folder of recordings.
    check, escape, false_reject : float
        What a check, a bad part that is accepted and a good part that is rejected cost, in one
        unit.
    recipe : object, default "conv"
        Anything `Contender.load` takes. Its policy's alpha and lower_bound are replaced.
    alphas, lower_bounds : sequence of float
        To try.
    repeats : int, default 10
        Shuffles of each policy, 2 or more: the first half chooses, the other half reports.
    seed : int, default 0
        Of the first shuffle.
    cycles : int or None, default None
        Parts of each shuffle; None plays all.
    n_jobs : int, default 1
        Replays at a time, as joblib counts them.
    keep : path or None, default None
        Folder of finished replays: those in it are not played again, others are added.

    Returns
    -------
    curve : CostCurve

    Raises
    ------
    SettingError
        A cost, a policy, a number of repeats or a number of cycles out of range.
    """
    costs = Costs(check, escape, false_reject)
    expect(repeats >= 2, "2 or more repeats", repeats, "one half chooses, the other one reports")
    seeds = range(seed, seed + repeats)
    tasks = priced_tasks(recipe, costs, alphas, lower_bounds, seeds, cycles)
    return curve_of(play_tasks(dataset, tasks, n_jobs=n_jobs, keep=keep), costs)


def priced_tasks(
    recipe: Any,
    costs: Costs,
    alphas: Sequence[float],
    lower_bounds: Sequence[float],
    seeds: Sequence[int],
    cycles: int | None = None,
) -> list[Task]:
    """Return the replays of a cost curve as tasks.

    There is one for every alpha, lower bound and seed, and one for every seed under
    ``guarantee="cost"``, unless the contender is a baseline, or `Policy` refuses that with these
    costs, `stops` and `audit_rate`. Raises SettingError for an alpha or a lower bound out of range.
    """
    contender = Contender.load(recipe)
    tasks = grid_tasks([contender], alphas, lower_bounds, seeds=seeds, cycles=cycles)
    if contender.baseline is None:
        with suppress(SettingError):
            priced = contender.with_policy(guarantee="cost", prices=astuple(costs))
            tasks += grid_tasks([priced], seeds=seeds, cycles=cycles)
    return tasks


def curve_of(replays: Sequence[Replay], costs: Costs) -> CostCurve:
    """Return the cost curve of finished replays of one recipe.

    Shuffles that not every policy has played are left out. Of the others, by their seeds, the first
    half chooses and the second half reports.

    Raises
    ------
    SettingError
        Fewer than two shuffles are complete.
    """
    policies = list(dict.fromkeys(replay.recipe.policy for replay in replays))
    policies.sort(
        key=lambda policy: (policy.guarantee == "cost", -policy.alpha, policy.lower_bound)
    )
    by_key = {(replay.recipe.policy, replay.seed): replay for replay in replays}
    seeds = [
        seed
        for seed in sorted({replay.seed for replay in replays})
        if all((policy, seed) in by_key for policy in policies)
    ]
    expect(len(seeds) >= 2, "2 or more shuffles that every policy has played", len(seeds))
    half = len(seeds) // 2
    rows = []
    for policy in policies:
        complete = [by_key[policy, seed] for seed in seeds]
        rows.append(_policy_cost(policy, complete[:half], complete[half:], costs))
    first = replays[0]
    return CostCurve(
        costs=costs,
        rows=tuple(rows),
        dataset=first.dataset,
        recipe=first.name,
        cycles=len(first),
        choosing=half,
        reporting=len(seeds) - half,
    )


def _policy_cost(
    policy: Policy, choosing: Sequence[Replay], reporting: Sequence[Replay], costs: Costs
) -> PolicyCost:
    """Return one policy's costs, shares and errors over the reporting shuffles.

    Only its expected cost comes from the choosing ones.
    """
    accepted = float(np.mean([replay.accepted for replay in reporting]))
    rejected = float(np.mean([replay.rejected for replay in reporting]))
    certain = accepted + rejected
    # Each at half the error level: together they hold at ERROR_LEVEL.
    bad = pooled_error(reporting, "accepted", ERROR_LEVEL / 2)
    good = pooled_error(reporting, "rejected", ERROR_LEVEL / 2)
    late_costs = [
        cost_per_part(replay, costs, slice(2 * len(replay) // 3, None)) for replay in reporting
    ]
    return PolicyCost(
        policy=policy,
        expected_cost=_expected_cost(choosing, costs),
        cost=float(np.mean([cost_per_part(replay, costs) for replay in reporting])),
        lower=costs.check - costs.saved(certain, accepted * bad.lower, rejected * good.lower),
        upper=costs.check - costs.saved(certain, accepted * bad.upper, rejected * good.upper),
        late=float(np.mean(late_costs)),
        verified=float(np.mean([replay.verified for replay in reporting])),
        certain=certain,
        bad=bad,
        good=good,
    )


def _expected_cost(replays: Sequence[Replay], costs: Costs) -> float:
    """Return the mean cost per part, with each share of wrong decisions at its Jeffreys mean.

    That is (wrong + 1/2) / (decided + 1), with both counts the mean of one shuffle. No error among
    25 accepted parts does not mean that there is never one: by the plain mean a few decisions would
    look free at any price.
    """
    counts = [replay.stretch() for replay in replays]
    accepted = float(np.mean([count["accepted"] for count in counts]))
    bad = float(np.mean([count["false_positive"] for count in counts]))
    rejected = float(np.mean([count["rejected"] for count in counts]))
    good = float(np.mean([count["false_negative"] for count in counts]))
    expected_bad = accepted * (bad + 0.5) / (accepted + 1.0)
    expected_good = rejected * (good + 0.5) / (rejected + 1.0)
    saved = costs.saved(accepted + rejected, expected_bad, expected_good)
    return costs.check - saved / len(replays[0])


def cost_per_part(replay: Replay, costs: Costs, cycles: slice = slice(None)) -> float:
    """Return the mean cost per part over some cycles of a replay: checks and wrong decisions.

    A part that an operator's limits rejected costs as much as a checked one.

    Parameters
    ----------
    replay : Replay
    costs : Costs
    cycles : slice, default all
        The cycles by their position, from 0, without a step; at least one.

    Returns
    -------
    cost : float
        In the unit of `costs`.
    """
    counts = replay.stretch(cycles)
    n_certain = counts["accepted"] + counts["rejected"]
    saved = costs.saved(n_certain, counts["false_positive"], counts["false_negative"])
    n_cycles = counts["last_cycle"] - counts["first_cycle"] + 1
    return float(costs.check - saved / n_cycles)
