"""From three prices to a policy: what a part costs under each that may pay, in replays of the
user's own recordings. The subcommand `dengine costs` prints it.

    curve = cost_curve("insertion", check=5, escape=600, false_reject=30, recipe="pca", n_jobs=2)
    print(curve.sentence)
    curve.policy, curve.to_frame()

A part's mean cost is check x verified + escape x (accepted and bad) + false_reject x (rejected and
good), in one unit of the user's, over all parts of a replay, its beginning included. Verifying
everything costs `check` per part. A part that an operator's limits reject costs `check`, too, so
that no policy pays by the limits, which are the same under each.

The candidates are values of LB around break-even, 1 - check / escape, and the guarantees "pooled"
and "cost". `cost_curve` halves them: all play two shuffles, the cheaper half plays two more, and so
on; "cost", which limits what errors cost, is never left behind. The last two play fresh shuffles,
which are all that is reported, so that no figure was picked for being small. The early rounds
replay one engine that checks every part, and play each candidate's rule on its scores
(`replay_policy`): in replays of their own, which the last two have, they would learn fewer labels.

The interval has the luck of the recordings and of the order: the shares of wrong decisions at the
ends of their intervals, whose unit is the part, and the spread over the shuffles.
"""

import math
from bisect import bisect_left
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, astuple, dataclass, fields, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.stats import sem
from scipy.stats import t as student

from ..datasets import Dataset, load_dataset
from ..decision.intervals import normal_quantile, wilson_interval
from ..decision.policy import AUDIT_RATE, RULES, Policy, Settings
from ..errors import SettingError, amount, capitalized, expect, percent
from ..files import FilePath
from ..records import Floats
from .grid import Task, play_tasks
from .metrics import Costs, ErrorRate, pooled_error
from .replay import Contender, Replay, replay_policy

if TYPE_CHECKING:
    import pandas as pd

FACTORS = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0)  # tolerances to try, in units of check / escape
POOLED_FACTORS = (1.0, 2.0, 4.0)
LARGEST_TOLERANCE = 0.2
ALPHA = 0.1  # of the guarantee "local": LB alone moves how many neighbours are asked for
N_SCREENING = 2  # shuffles of each round of the halving
N_LAST = 2  # policies that play the fresh shuffles
REPEATS = 4  # fresh shuffles
ERROR_LEVEL = 0.05  # of the intervals
ALPHA_EACH = ERROR_LEVEL / 2  # of the shares of wrong accepts and of wrong rejects
Z = normal_quantile(ALPHA_EACH)
MOST_NEIGHBOURS = 10**7
MOST_MORE = 10_000  # times the recordings: what needs more is never shown
Groups = Mapping[Policy, Sequence[Replay]]
Play = Callable[[Sequence[Task]], Sequence[Replay]]


@dataclass(frozen=True, slots=True)
class PolicyCost:
    """What a part costs under one policy, over some shuffles.

    Attributes
    ----------
    policy : Policy
    expected_cost : float
        Per part, with half an error added to each share of wrong decisions, counted in different
        parts: no error among 25 accepted parts does not mean that there is never one.
    cost : float
        Mean per part.
    lower, upper : float
        Interval of the cost: both shares of wrong decisions at the ends of their intervals, which
        hold together at 95 %, and `luck`, added in squares.
    late : float
        Mean cost per part over the last third of each shuffle, when something has been learned.
    verified, accepted, rejected : float
        Shares of the parts that were checked, and that the model accepted or rejected. The rest are
        those that an operator's limits rejected.
    bad, good : ErrorRate
        Bad parts among the accepted ones, good parts among the rejected ones.
    luck : float
        Of the order: half the width of the 95 % interval of the mean over the shuffles.
    """

    policy: Policy
    expected_cost: float
    cost: float
    lower: float
    upper: float
    late: float
    verified: float
    accepted: float
    rejected: float
    bad: ErrorRate
    good: ErrorRate
    luck: float

    @property
    def escaped(self) -> float:
        """Share of all parts that were accepted and bad, from 0 to 1; 0 if none was accepted."""
        return self.accepted * self.bad.rate if self.bad.decided else 0.0

    @property
    def limits_loss(self) -> bool:
        """Whether the policy has the guarantee "cost".

        Wrong decisions then cost at most two false accepts more than the checks that were saved,
        for any recordings; with audits by an estimate without bias.
        """
        return self.policy.guarantee == "cost"

    @property
    def screening_key(self) -> tuple[bool, bool, float]:
        """Key by which policies are sorted before the dearer half is dropped; smaller is better.

        Policies with the guarantee "cost" come before all others. Within both groups those that
        accepted and rejected no part come last; the rest is sorted by expected cost.
        """
        return not self.limits_loss, self.accepted + self.rejected == 0.0, self.expected_cost


@dataclass(frozen=True, slots=True)
class Missing:
    """What would turn "may pay" into "pays", with the shares of wrong decisions that were seen.

    Attributes
    ----------
    accepted : int
        Number of different accepted parts that would show it.
    recordings, production : int
        Further recordings, or parts of production, that bring them.
    audit_rate : float
        At which audit rate of production; 1 where every bad accepted part stops the line.
    """

    accepted: int
    recordings: int
    production: int
    audit_rate: float


@dataclass(frozen=True, slots=True)
class CostCurve:
    """What a part costs under the policies that played last, and which one is chosen.

    Attributes
    ----------
    costs : Costs
    rows : tuple of PolicyCost
        The policies that played the shuffles that are reported, the cheapest first.
    marked : PolicyCost
        The best of `rows`: the cheapest, or one that let fewer bad parts through and is not
        significantly dearer; but the guarantee "cost" is never left for such a row.
    verdict : str
        "pays" if the whole interval of the marked policy is below the cost of verifying
        everything, "does not pay" if its expected cost is not (of the guarantee "cost": its mean),
        else "may pay".
    price_changes : tuple of str
        What would be chosen of `rows` if one price were half or twice as large, where that is
        something else. Under the guarantee "cost", too, the decisions are those that were played.
    left_behind : tuple of PolicyCost
        Those that were dearer in earlier shuffles. Their costs are of those shuffles, and not
        comparable with those of `rows`.
    out_of_reach : tuple of str
        Policies that were not played, each with the reason.
    dataset, recipe : str
        Their names.
    cycles, shuffles : int
        Parts of each shuffle, and number of shuffles that are reported.
    fresh : bool
        Whether the reported shuffles are fresh: no policy was chosen by them. False if the search
        was interrupted before it could play fresh ones.
    """

    costs: Costs
    rows: tuple[PolicyCost, ...]
    marked: PolicyCost
    verdict: str
    price_changes: tuple[str, ...]
    left_behind: tuple[PolicyCost, ...]
    out_of_reach: tuple[str, ...]
    dataset: str
    recipe: str
    cycles: int
    shuffles: int
    fresh: bool

    @property
    def policy(self) -> Policy | None:
        """The policy that pays or may pay; None if none does.

        Try it in shadow mode first, in which every part is verified.
        """
        return None if self.verdict == "does not pay" else self.marked.policy

    @property
    def missing(self) -> Missing | None:
        """What evidence would turn the verdict "may pay" into "pays", as a `Missing`.

        The verdict is "may pay" if the policy is cheaper than checking every part, but the interval
        of its cost does not show this yet. Beside `audit_rate` the result has three numbers, each
        of which alone would show it: different accepted parts in all (those seen included),
        recordings beside the present ones, and parts of production without any recordings, if as
        large a share of them is accepted as in one shuffle (a replay in random order). In
        production only parts whose outcome is asked for count: each part if the policy has stops
        "all" (every bad accepted part stops the line and is reported), otherwise the audited share
        (parts that are checked at random although the model is certain), which is taken as 5 %
        (`AUDIT_RATE`) if the policy has no audits. It is assumed that the shares of wrong decisions
        stay as they were seen. None if the verdict is another, or if 10,000 times the parts of a
        shuffle are too few.
        """
        row = self.marked
        if self.verdict != "may pay":
            return None
        errors = (row.bad, row.good)
        rates = [error.wrong / max(1, error.decided) for error in errors]
        # Wilson's upper end u of a share r of n parts: n = z^2 u (1 - u) / (u - r)^2. For r = 1 it
        # is 1 for any n: then each part counts. More shuffles narrow it, but bring no other parts.
        sizes = [
            min(error.traces, Z**2 * error.upper * (1.0 - error.upper) / (error.upper - rate) ** 2)
            if rate < 1.0
            else error.traces
            for error, rate in zip(errors, rates, strict=True)
        ]

        def surplus(n_recordings: int) -> float:
            """Return how far so many recordings like these bring the interval below the check;
            negative if it stays above.
            """
            more = n_recordings / self.cycles
            bad, good = (
                wilson_interval(more * size * rate, more * size * (1.0 - rate), ALPHA_EACH)[1]
                for size, rate in zip(sizes, rates, strict=True)
            )
            worst = self.costs.of_part(row.accepted, row.rejected, bad, good)
            upper = row.cost + math.hypot(worst - row.cost, row.luck / math.sqrt(more))
            return self.costs.check - upper

        most = MOST_MORE * self.cycles
        n = bisect_left(range(most), 0.0, lo=self.cycles, key=surplus)
        audit_rate = 1.0 if row.policy.stops == "all" else row.policy.audited_share or AUDIT_RATE
        if n == most:
            return None
        # Several shuffles accept more different parts than one does.
        weight = sizes[0] / row.accepted / self.cycles if row.accepted else 1.0
        return Missing(
            accepted=math.ceil(sizes[0] * n / self.cycles),
            recordings=n - self.cycles,
            production=math.ceil(n * weight / audit_rate),
            audit_rate=audit_rate,
        )

    @property
    def sentence(self) -> str:
        """The verdict as sentences: the chosen policy, its cost per part, and evidence it lacks.

        They give the cost with its 95 % interval, and what verifying everything costs. If the
        policy may pay, they say how many more parts would show that it pays, unless these are too
        many (`missing`). If no policy pays or may pay, they begin with "Nothing pays" and give the
        cost of the cheapest policy, or ask for more recordings if every part was verified. They
        also say if another policy is cheaper than the chosen one, but not significantly, and if the
        search was interrupted.
        """
        row = self.marked
        cheapest = self.rows[0]
        missing = self.missing
        verify_all = f"verifying everything costs {self.costs.check:g} a part"
        cost = (
            f"{amount(row.cost)} a part, with a 95 % interval of {amount(row.lower)} to "
            f"{amount(row.upper)}"
        )
        text = f"{policy_name(row.policy)} {self.verdict}: {cost}; {verify_all}."
        if row.verified == 1.0:
            text = f"Nothing pays: {verify_all}, and everything was verified. Record more."
        elif self.policy is None:
            yet = " yet" if row.lower < self.costs.check else ""
            text = (
                f"Nothing pays{yet}: {verify_all}; the cheapest policy, {policy_name(row.policy)}, "
                f"costs {cost}, or {amount(row.expected_cost)} with half an error more."
            )
        elif cheapest != row:
            text += (
                f" {capitalized(policy_name(cheapest.policy))} costs {amount(cheapest.cost)}, "
                "which is not cheaper beyond chance. Of 1,000 parts it lets "
                f"{1000 * cheapest.escaped:.2g} bad ones through, not {1000 * row.escaped:.2g}."
            )
        if missing is not None:
            how = "where every bad accepted part stops the line"
            if missing.audit_rate < 1.0:
                how = f"at an audit rate of {percent(missing.audit_rate, 'g')}"
            kind = "this share of bad ones" if row.bad.wrong else "no bad one"
            worst = percent(self.costs.worst_accept, ".3g")
            text += (
                f" Not certainly: of the accepted parts up to {percent(row.bad.upper, '.3g')} may "
                f"be bad, and accepting pays up to {worst}. To show that it pays takes about "
                f"{missing.accepted:,} different accepted parts with {kind}: "
                f"{missing.recordings:,} more recordings, or {missing.production:,} parts of "
                f"production {how}."
            )
        if not self.fresh:
            text += " The search was not finished: these shuffles also chose the policy."
        return capitalized(text)

    @property
    def price_sentence(self) -> str:
        """A sentence: would the choice be another one if one price were half or twice as large?

        It lists `price_changes`, or says that the choice stays if there are none.
        """
        if not self.price_changes:
            return "If one price is half or twice as large, the choice between these rows stays."
        return f"The choice between these rows depends on: {'; '.join(self.price_changes)}."

    def to_frame(self) -> "pd.DataFrame":
        """Return a DataFrame with a row for each policy that was played.

        Its columns are the guarantee (the rule that decides), alpha and lower_bound of the policy
        and the fields of `PolicyCost`: costs in the user's unit, and shares and error rates from 0
        to 1. Each field of `bad` (bad parts among the accepted ones) and `good` (good parts among
        the rejected ones) is a column, like `bad_rate`. `chosen` is True for the policy that pays
        or may pay, if there is one. `reported` is False for the policies that the search left
        behind, because they were dearer in earlier shuffles (replays in random order). Their costs
        come from these shuffles and are not comparable with those of other rows.
        """
        import pandas as pd

        # Its columns are policy_alpha, bad_rate and so on.
        rows = [*self.rows, *self.left_behind]
        frame = pd.json_normalize([asdict(row) for row in rows], sep="_")
        names = {f"policy_{name}": name for name in ("guarantee", "alpha", "lower_bound")}
        others = [name for name in frame if not name.startswith("policy_")]
        frame = frame[[*names, *others]].rename(columns=names)
        return frame.assign(
            chosen=[row.policy == self.policy for row in rows],
            reported=[row in self.rows for row in rows],
        )


def policy_name(policy: Policy) -> str:
    """Return a policy's name for people, like "alpha 0.1, LB 95 %" or "pooled, LB 95 %".

    LB is `lower_bound`, the success probability that accepted parts must have. Under the guarantee
    (the rule that decides) "cost" the name is only "the cost guarantee"; for a user's own rule it
    is "module:Class, LB 95 %". Only under "local" is alpha in it, so two policies of another
    guarantee that differ in alpha have the same name.
    """
    if policy.guarantee == "cost":
        return "the cost guarantee"
    kind = f"alpha {policy.alpha:g}" if policy.guarantee == "local" else policy.guarantee
    return f"{kind}, LB {percent(policy.lower_bound, 'g')}"


def settings_of(policy: Policy) -> Settings:
    """Return the settings in which policies of `dengine costs` differ, as arguments of `Policy`.

    They are alpha, lower_bound and guarantee (the rule that decides). For the guarantee "cost" they
    are only `prices`, from which `Policy` infers this guarantee; lower_bound has no effect then.
    stops is added if it is "all" (every bad accepted part stops the line and is reported), and
    alpha under "cost" and audit_rate if they are not those that `Policy` gives by itself. The
    interval, the force limits and all other settings are left out.
    """
    names = ["prices"] if policy.guarantee == "cost" else ["alpha", "lower_bound", "guarantee"]
    settings = {name: getattr(policy, name) for name in names}
    plain = Policy(**settings, stops="all")
    for name in ("alpha", "audit_rate"):
        value = getattr(policy, name)
        if value != getattr(plain, name):
            settings[name] = value
    return settings | ({"stops": "all"} if policy.stops == "all" else {})


def candidates(
    contender: Contender, costs: Costs, alphas: Sequence[float], lower_bounds: Sequence[float]
) -> Iterator[Settings]:
    """Yield the settings of each policy that is to be tried, as keyword arguments of `Policy`.

    The contender plays the replays: it is dengine with a recipe (all settings), or a baseline (a
    method to compare with). First come all pairs of an alpha (error level) and a lower bound LB
    (the success probability that accepted parts must have) for the guarantee "local" (a guarantee
    is the rule that decides), or for the user's own rule if the contender has one. Then come
    "pooled" at each LB, and "cost" once with the prices `costs`, both with the contender's own
    alpha, but not for a user's own rule or a baseline. If the contender's policy has stops="some"
    (not every bad accepted part is reported) and no audits (checks of parts that the model is
    certain of), these two get an audit rate of 5 %, because they need outcomes of accepted parts.

    LBs come the lowest first. If `lower_bounds` is empty, they are taken around break-even, at
    which 1 - LB is the price of a check divided by that of a bad accepted part: 1 - LB is that
    ratio times 0.5, 1, 2, 4, 8 and 16 for "local" (or the user's own rule), times 1, 2 and 4 for
    "pooled", each product rounded to two significant digits. LBs below 80 % are left out; if all
    are below it, 80 % is the only LB.
    """
    policy = contender.recipe.policy

    def levels(factors: Sequence[float]) -> Sequence[float]:
        """Return the user's levels of LB, or those of these factors, the laxest first.

        A factor gives the tolerance 1 - LB, in units of check / escape, rounded to two digits.
        Tolerances above 20 % are left out; if all are, 20 % is the only one.
        """
        tolerances = [factor * costs.worst_accept for factor in factors]
        allowed = [share for share in tolerances if share <= LARGEST_TOLERANCE]
        shares = allowed or [LARGEST_TOLERANCE]
        # Two digits of the tolerance are enough, and make a level that can be typed.
        return sorted(lower_bounds or [round(1.0 - float(f"{share:.2g}"), 9) for share in shares])

    is_own = policy.guarantee not in RULES
    first = policy.guarantee if is_own else "local"
    for alpha in alphas:
        for bound in levels(FACTORS):
            yield {"guarantee": first, "alpha": alpha, "lower_bound": bound}
    if is_own or contender.baseline is not None:
        return
    audit_rate = policy.audit_rate
    if policy.stops == "some":
        audit_rate = audit_rate or AUDIT_RATE  # both need to hear of accepted parts
    for bound in levels(POOLED_FACTORS):
        yield {"guarantee": "pooled", "lower_bound": bound, "audit_rate": audit_rate}
    yield {"guarantee": "cost", "prices": astuple(costs), "audit_rate": audit_rate}


def needed_parts(policy: Policy) -> int:
    """Return the least number of good parts that a policy needs before it can accept a part.

    A policy is the settings of decisions; its guarantee is the rule that decides. For "local" this
    is the number of good labels within the radius around the part, without a bad one, that puts the
    lower end of the policy's interval at LB (`Policy.lower_bound`): z^2 LB / (1 - LB), rounded up,
    with Wilson's interval; it is 10,000,000 if more are needed. For "pooled" it is the number of
    checked parts, all good, that give enough evidence at error level alpha, if the score of each
    (how surely it is good) reaches the threshold that the rule tests. For other guarantees it is 0.
    """
    if policy.guarantee == "local":
        return 1 + bisect_left(
            range(1, MOST_NEIGHBOURS), policy.lower_bound, key=lambda n: policy.bound(n, 0)[0]
        )
    if policy.guarantee == "pooled":
        evidence: Any = policy.rule().evidence
        steps: list[float] = evidence.level_steps[0]
        return math.ceil(float(evidence.level_minimum[0]) / steps[0])
    return 0


def cost_curve(
    dataset: Any,
    *,
    check: float,
    escape: float,
    false_reject: float,
    recipe: Any = "conv",
    alphas: Sequence[float] = (ALPHA,),
    lower_bounds: Sequence[float] = (),
    repeats: int = REPEATS,
    seed: int = 0,
    cycles: int | None = None,
    n_jobs: int = 1,
    keep: FilePath | None = None,
) -> CostCurve:
    """Find the policy that pays by three prices, and what a part costs under it.

    A policy is the settings of the rule that decides. The candidate policies are replayed on
    shuffles, random orders of the recordings. While there are more than two, they play two shuffles
    (on the recorded predictions of one engine that checks every part, unless a baseline plays), and
    the dearer half (of an odd number the larger half, but of three one) is left behind. The
    guarantee "cost" stays. Policies that verified every part count as the dearest; all others are
    compared by their expected cost over all shuffles so far. The last two, or the only one, play
    fresh shuffles, by which no policy was chosen. A policy with a setting that is refused, like a
    lower bound out of range, or that needs more good parts than a shuffle has, is not tried; the
    field `out_of_reach` of the result says so.

    Parameters
    ----------
    dataset : object
        Anything `load_dataset` takes, such as a folder of recordings.
    check, escape, false_reject : float
        What a check, a bad part that is accepted and a good part that is rejected cost, in one
        unit.
    recipe : object, default "conv"
        Anything `Contender.load` takes. The guarantee of its policy (the rule by which it decides,
        see `Policy`) is replaced, with alpha and lower_bound under "local", with lower_bound under
        "pooled", and with the prices under "cost". Its other settings stay, but shadow mode, in
        which every part is verified, is turned off. If its policy has no audits (checks of parts
        that the model is certain of) and stops="some" (not every bad accepted part is reported),
        the guarantees "pooled" and "cost" get an audit rate of 5 %, because they need outcomes of
        accepted parts. A rule of the user's own keeps its guarantee and gets alpha and lower_bound.
        A baseline, a method to compare with, plays "local" alone.
    alphas : sequence of float, default (0.1,)
        Error levels to try under the guarantee "local", or under a rule of the user's own.
    lower_bounds : sequence of float
        Success probabilities that accepted parts must have, to try; by default values around 1 -
        check / escape that the number of recordings allows.
    repeats : int, default 4
        Fresh shuffles that the last policies play, at least 2.
    seed : int, default 0
        Of the first shuffle.
    cycles : int or None, default None
        Parts of each shuffle; None plays all.
    n_jobs : int, default 1
        Replays at a time, as joblib counts them. 1 plays in this thread, which then has one torch
        thread.
    keep : path or None, default None
        Folder of finished replays, made if it is missing: those in it are not played again, unless
        their file is damaged, and others are added.

    Returns
    -------
    curve : CostCurve
        Its `rows` say what a part costs under each of the last policies. Its `policy` is the
        choice; None if even the best costs no less than checking every part.

    Raises
    ------
    SettingError
        A price, or a number of repeats or cycles, out of range; a recipe that cannot be read; no
        policy that can be tried (those that are refused are left out); a check that is not
        cheaper than an escape; a false reject that costs nothing; recordings of one label, or too
        few for any policy; force limits that no recording can keep, or in seconds if the rate of
        the recordings is unknown. With `keep` also for a reducer that cannot be hashed.
    DataError
        A data set that cannot be read.
    StoreError
        A store, given as the data set, that cannot be opened or read.
    OutputError
        With `keep`, a replay that cannot be written.
    OSError
        If the folder `keep` cannot be made.
    """
    data = load_dataset(dataset)
    curve = find_policy(
        data,
        Contender.load(recipe),
        Costs(check, escape, false_reject),
        partial(play_tasks, data, n_jobs=n_jobs, keep=keep),
        alphas=alphas,
        lower_bounds=lower_bounds,
        repeats=repeats,
        seed=seed,
        cycles=cycles,
    )
    assert curve is not None  # all was played
    return curve


def find_policy(
    data: Dataset,
    contender: Contender,
    costs: Costs,
    play: Play,
    *,
    alphas: Sequence[float] = (ALPHA,),
    lower_bounds: Sequence[float] = (),
    repeats: int = REPEATS,
    seed: int = 0,
    cycles: int | None = None,
) -> CostCurve | None:
    """Find the policy that pays by three prices, like `cost_curve`; the caller plays the replays.

    A policy is the settings of the rule that decides. Candidates play two shuffles (random orders
    of the recordings), the dearer half is left behind, and so on. The last two play `repeats` fresh
    shuffles, by which no policy was chosen. `play` gets a list of tasks (replays to be played) and
    returns their replays in this order. If it returns fewer, as after Ctrl-C, nothing more is
    played. The result is then computed from the fresh shuffles that each of the last policies has
    finished, if there are two or more. Otherwise it is computed from the earlier shuffles, with its
    field `fresh` False; without two of these it is None. `costs` holds the three prices, and
    `contender` is what `Contender.load` makes of the recipe: dengine with these settings, or a
    method to compare with; the other parameters are those of `cost_curve`, of which `alphas` and
    `lower_bounds` are values to try. Raises SettingError like `cost_curve`, and what `play` raises.
    """
    _check_search(data, costs, repeats)
    n_cycles = len(data) if cycles is None else cycles
    policies, out_of_reach = _within_reach(
        contender,
        candidates(contender, costs, alphas, lower_bounds),
        n_cycles * data.y.mean(),
    )
    expect(
        bool(policies),
        "recordings enough for one policy",
        len(data),
        f"this is what they lack: {'; '.join(out_of_reach)}",
    )
    screened: list[Replay] = []
    rows: dict[Policy, PolicyCost] = {}
    is_whole = True
    while is_whole and len(policies) > N_LAST:
        seeds = range(seed, seed + N_SCREENING)
        played = list(_screen(play, contender, policies, seeds, n_cycles))
        screened += played
        is_whole = len(played) == N_SCREENING * len(policies)
        if is_whole:
            rows = {
                policy: _policy_cost(policy, replays, costs)
                for policy, replays in _by_policy(screened).items()
            }
            policies.sort(key=lambda policy: rows[policy].screening_key)
            del policies[max(N_LAST, len(policies) // 2) :]
            seed += N_SCREENING
    seeds = range(seed, seed + repeats)
    fresh = play(_tasks(contender, policies, seeds, n_cycles)) if is_whole else []
    finished = _finished(fresh, policies)
    chosen = finished or _finished(screened, policies)
    if not chosen:
        return None
    return curve_of(
        chosen,
        costs,
        tuple(row for policy, row in rows.items() if policy not in policies),
        tuple(out_of_reach),
        fresh=bool(finished),
    )


def _finished(replays: Iterable[Replay], policies: Sequence[Policy]) -> Groups:
    """Return each policy's replays of the shuffles that all these policies have finished.

    A shuffle is a random order of the recordings, by the seed of the replay. Returns an empty dict
    if there are fewer than two such shuffles.
    """
    groups = _by_policy(replays)
    common = set.intersection(
        *({replay.seed for replay in groups.get(policy, ())} for policy in policies)
    )
    if len(common) < 2:
        return {}
    return {
        policy: [replay for replay in groups[policy] if replay.seed in common]
        for policy in policies
    }


def _check_search(data: Dataset, costs: Costs, repeats: int) -> None:
    """Raise SettingError if no policy, the settings of the rule that decides, can be chosen.

    That is so for fewer than two repeats (random orders of the recordings that the last policies
    play), a check that costs as much as an escape (a bad part that is accepted) or more, a false
    reject that costs nothing, and recordings of parts that are all good or all bad.
    """
    expect(repeats >= 2, "2 or more repeats", repeats, "one says nothing of luck")
    expect(
        costs.check < costs.escape,
        "a check below an escape",
        astuple(costs)[:2],
        "where a bad part costs no more than its check, accept every part unchecked",
    )
    expect(
        costs.false_reject > 0.0,
        "a false reject that costs something",
        0,
        "where a wrong decision costs nothing, there is nothing to check",
    )
    expect(
        0.0 < data.y.mean() < 1.0,
        "good and bad recordings",
        f"{int(data.y.sum()):,} good and {int((1 - data.y).sum()):,} bad ones",
        "record until both have come: one kind does not show what errors cost",
    )


def _within_reach(
    contender: Contender, changes: Iterable[Settings], n_good: float
) -> tuple[list[Policy], list[str]]:
    """Return the policies to be tried, without repeats, and notes on why others are not tried.

    The contender plays the replays: it is dengine with a recipe, or a baseline. Each policy is that
    of the contender without shadow mode, in which every part is verified, and with some settings,
    an item of `changes`, which must hold the `guarantee` (the rule that decides). It is not tried
    if `Policy` refuses its settings, or if it needs more good parts before it can accept one
    (`needed_parts`) than `n_good`, the mean number of good parts in a shuffle (a replay of the
    recordings in random order).
    """
    policies = []
    out_of_reach = []
    for settings in changes:
        try:
            policy = contender.with_policy(**settings, shadow=False).recipe.policy
        except SettingError as error:
            out_of_reach.append(f"guarantee {settings['guarantee']}: {error}".rstrip("."))
            continue
        n_needed = needed_parts(policy)
        if n_needed > n_good:
            parts = "checked parts without a bad one"
            if policy.guarantee == "local":
                parts = "good neighbours"
            out_of_reach.append(
                f"{policy_name(policy)} needs {n_needed:,} {parts}, {n_good:,.0f} good parts are "
                "played"
            )
        else:
            policies.append(policy)
    return list(dict.fromkeys(policies)), out_of_reach


def _by_policy(replays: Iterable[Replay]) -> Groups:
    """Return the replays of each policy, in their order.

    A replay is a recorded stream of parts, decided again; the policy is that of its recipe (the
    settings of its decisions). The policies come in the order in which their first replays come.
    """
    groups: dict[Policy, list[Replay]] = {}
    for replay in replays:
        groups.setdefault(replay.recipe.policy, []).append(replay)
    return groups


def _tasks(
    contender: Contender, policies: Sequence[Policy], seeds: range, cycles: int
) -> list[Task]:
    """Return a task, a replay to be played, for each seed and each policy.

    In each task the contender, who plays (dengine with a recipe, or a baseline), has the policy in
    its recipe. Policies vary fastest. Each replay shuffles the parts by its seed and plays `cycles`
    of them.
    """
    players = [
        replace(contender, recipe=replace(contender.recipe, policy=policy)) for policy in policies
    ]
    return [Task(player, seed, cycles) for seed in seeds for player in players]


def _screen(
    play: Play, contender: Contender, policies: Sequence[Policy], seeds: range, cycles: int
) -> Iterator[Replay]:
    """Yield a replay of each policy for each seed; its recipe has the policy.

    dengine is replayed once for each seed, in shadow mode (every part is verified, and the model's
    predictions are recorded) and with the force limits (an operator's limits of the force) of the
    contender's recipe. The rule of each policy decides on these predictions (`replay_policy`);
    force limits of `policies` are not applied. If the contender is a baseline (a method to compare
    with), there are no such predictions: each policy has a replay of its own. Policies vary
    fastest. A replay shuffles the parts by its seed and plays `cycles` of them. `play` plays tasks
    and returns their replays; if it returns fewer, fewer are yielded.
    """
    if contender.baseline is not None:
        yield from play(_tasks(contender, policies, seeds, cycles))
        return
    shadow = Policy(shadow=True, force_limits=contender.recipe.policy.force_limits)
    for scores in play(_tasks(contender, [shadow], seeds, cycles)):
        for policy in policies:
            yield replay_policy(scores, policy)


def curve_of(
    groups: Groups,
    costs: Costs,
    left_behind: tuple[PolicyCost, ...] = (),
    out_of_reach: tuple[str, ...] = (),
    fresh: bool = True,
) -> CostCurve:
    """Return what a part costs under some policies at these prices, and which policy to choose.

    `groups` has each policy (settings of the rule that decides) with its replays (runs over
    recorded parts), all of the same two or more shuffles (random orders of the recordings) in the
    same order. The choice is the cheapest policy, or a safer one that is not significantly dearer;
    but it is "check everything" if no such policy is cheaper than a check of every part (`_choose`
    has the exact rule). It is made again with each price halved and doubled; choices that differ
    are in the field `price_changes` of the result. Three arguments become fields of the result:
    `left_behind`, the policies that were dearer in earlier shuffles; `out_of_reach`, policies that
    were not played, each with the reason; and `fresh`, whether no policy was chosen by these
    shuffles.
    """
    rows, marked, verdict = _choose(groups, costs)
    chosen = _chosen_name(marked, verdict)
    changes = []
    for field in fields(costs):
        for factor in (0.5, 2.0):
            price = factor * getattr(costs, field.name)
            _, other, other_verdict = _choose(groups, replace(costs, **{field.name: price}))
            name = _chosen_name(other, other_verdict)
            if name != chosen:
                changes.append(f"with {field.name.replace('_', ' ')} at {price:g}, {name}")
    replays = groups[marked.policy]
    return CostCurve(
        costs=costs,
        rows=tuple(rows),
        marked=marked,
        verdict=verdict,
        price_changes=tuple(changes),
        left_behind=left_behind,
        out_of_reach=out_of_reach,
        dataset=replays[0].dataset,
        recipe=replays[0].name,
        cycles=len(replays[0]),
        shuffles=len(replays),
        fresh=fresh,
    )


def _choose(groups: Groups, costs: Costs) -> tuple[list[PolicyCost], PolicyCost, str]:
    """Return a row for each policy in `groups`, the cheapest first, the best row, and the verdict.

    `groups` has each policy (settings of the rule that decides) with its replays. The rows are
    sorted by mean cost; among equal costs the row with fewer bad accepted parts comes first, then
    the row whose policy has the higher lower bound (the success probability that accepted parts
    must have). A row is good if it is not significantly dearer than the first (one-sided, 5 %), and
    its expected cost (with half an error added to each share of errors) is below the price of a
    check. For a policy with the guarantee "cost", whose errors may cost little more than checks
    (`limits_loss`), the mean cost counts in place of the expected one. The best row is the cheapest
    good one if it has the guarantee "cost", else the good row with the fewest bad accepted parts,
    the cheapest of several. The verdict is "does not pay" if no row is good; the best row is the
    first one then. Otherwise it is "pays" if the whole interval of the best row's cost is below the
    price of a check, else "may pay".
    """
    rows = [_policy_cost(policy, replays, costs) for policy, replays in groups.items()]
    rows.sort(key=lambda row: (row.cost, row.escaped, -row.policy.lower_bound))
    cheapest = rows[0]
    good = []
    for row in rows:
        mean, error = _difference(groups[row.policy], groups[cheapest.policy], costs)
        is_close = mean <= error * normal_quantile(2 * ERROR_LEVEL)  # one-sided
        if is_close and (row.cost if row.limits_loss else row.expected_cost) < costs.check:
            good.append(row)
    if not good:
        return rows, cheapest, "does not pay"
    marked = good[0] if good[0].limits_loss else min(good, key=lambda row: row.escaped)
    return rows, marked, "pays" if marked.upper < costs.check else "may pay"


def _chosen_name(row: PolicyCost, verdict: str) -> str:
    """Return what is chosen, as text: the row's policy by name, or "check everything".

    It is the latter if the verdict is "does not pay".
    """
    return "check everything" if verdict == "does not pay" else policy_name(row.policy)


def _policy_cost(policy: Policy, replays: Sequence[Replay], costs: Costs) -> PolicyCost:
    """Return what a part costs under a policy, as a `PolicyCost` that is computed from its replays.

    It has the mean cost with an interval, the part of it that comes from the order (`luck`), the
    mean cost over the last third of each replay (`late`), the expected cost (with half an error
    added to each share of wrong decisions), the shares of parts that were checked, accepted and
    rejected, and the shares of wrong decisions (bad parts among the accepted ones, good parts among
    the rejected ones). All replays are equally long; the prices are `costs`.
    """
    verified, accepted, rejected = (
        float(np.mean([getattr(replay, name) for replay in replays]))
        for name in ("verified", "accepted", "rejected")
    )
    bad = pooled_error(replays, "accepted", ALPHA_EACH)
    good = pooled_error(replays, "rejected", ALPHA_EACH)
    cost_at = partial(costs.of_part, accepted, rejected)
    of_parts = np.array([part_costs(replay, costs) for replay in replays])  # (shuffles, cycles)
    cost = float(of_parts.mean())
    quantile = float(student.ppf(1.0 - ERROR_LEVEL / 2, len(replays) - 1))
    luck = quantile * float(sem(of_parts.mean(1)))
    return PolicyCost(
        policy=policy,
        expected_cost=cost_at(_expected_rate(bad), _expected_rate(good)),
        cost=cost,
        lower=max(0.0, cost - math.hypot(cost - cost_at(bad.lower, good.lower), luck)),
        upper=cost + math.hypot(cost - cost_at(bad.upper, good.upper), luck),
        late=float(of_parts[:, 2 * of_parts.shape[1] // 3 :].mean()),
        verified=verified,
        accepted=accepted,
        rejected=rejected,
        bad=bad,
        good=good,
        luck=luck,
    )


def _expected_rate(error: ErrorRate) -> float:
    """Return (n r + 1/2) / (n + 1), where r is the share of wrong decisions, and n counts different
    parts among those decided; 1/2 without any.

    It is the posterior mean of a share of errors with the Jeffreys prior.
    """
    n_wrong = error.traces * error.wrong / max(1, error.decided)
    return (n_wrong + 0.5) / (error.traces + 1)


def _difference(
    first: Sequence[Replay], other: Sequence[Replay], costs: Costs
) -> tuple[float, float]:
    """Return how much dearer a part is in `first` than in `other`, with the standard error.

    The result is (difference, standard error). The difference is a mean over all parts, in the unit
    of `costs`; it is negative if `first` is cheaper. The replays are those of two policies, which
    have played the same shuffles in the same order. The standard error adds the variance between
    parts, whose differences (less their mean) are summed over the shuffles first, and the variance
    between shuffles, which is 0 for a single shuffle.
    """
    differences = np.array(
        [
            part_costs(left, costs) - part_costs(right, costs)
            for left, right in zip(first, other, strict=True)
        ]
    )
    mean = float(differences.mean())
    parts = np.concatenate([replay.index for replay in first])
    sums = np.bincount(parts, (differences - mean).ravel())
    part_error = float(np.sqrt((sums**2).sum())) / differences.size
    return mean, math.hypot(part_error, sem(differences.mean(1)))


def part_costs(replay: Replay, costs: Costs) -> Floats:
    """Return what each of the n parts of a replay cost, (n,): its check, or its wrong decision.

    A right decision without a check costs 0. A part that left an operator's force limits costs as
    much as a checked one, whether it was verified or rejected. A wrong decision costs no check. The
    costs are float64, in the unit of `costs`; a decision whose truth is unknown costs 0.
    """
    checked = costs.check * ~(replay.accepted | replay.rejected)
    wrong = costs.escape * replay.false_positive + costs.false_reject * replay.false_negative
    return np.asarray(checked + wrong, dtype=np.float64)
