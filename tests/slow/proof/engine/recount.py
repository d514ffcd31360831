"""Everything that an engine counts, computed again from its store: `Recount`.

    >>> recount = Recount(case, seed, Ledger(path, case.policy, diary.restarts), diary)
    >>> recount.check_decisions()
    >>> recount.faults
    []

The models are trained again by `directions.mean_difference`, labels are counted in numpy, the rules
are those of `rules.implementation`, which shares no line with `dengine`. Each `check_` method
compares, counts its comparisons in `compared`, and adds what differs to `faults`.
"""

import io
import itertools
import json
import math
from collections import Counter
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dengine import DataEngine

from ..rules.implementation import Rules, log_certificate
from .directions import MEMORY, mean_difference
from .hashing import fold, hash_of_part, hash_of_trace, is_audited
from .histories import Case, Diary
from .ledger import NEVER, TOLD, Ledger, Moment, Part

CODES = {"verify": 0, "accept": 1, "reject": 2}
RADIUS = 0.4
CLOSE = 1e-4  # float32 against float64
Z = {0.3: 1.0364333894937898, 0.5: 0.6744897501960817}  # normal quantiles at 1 - alpha / 2
Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Space:
    """A version, trained again.

    Attributes
    ----------
    weights : array, shape (K, T)
    scale : array, shape (K,)
    seen : frozenset of str
        Decisions whose labels the weights may have learned from.
    """

    weights: Floats
    scale: Floats
    seen: frozenset[str]


@dataclass(frozen=True)
class Known:
    """An outcome that a rule is updated with."""

    moment: Moment
    id: str
    lower: float
    upper: float
    good: bool
    silent: int
    predicted: int
    inclusion: float


def wilson(n_success: int, n_failure: int, z: float) -> tuple[float, float]:
    """Return the Wilson interval; (0, 1) without labels."""
    n = n_success + n_failure
    if n == 0:
        return 0.0, 1.0
    middle = (n_success + z**2 / 2) / (n + z**2)
    half = z / (n + z**2) * math.sqrt(n_success * n_failure / n + z**2 / 4)
    return max(0.0, middle - half), min(1.0, middle + half)


def radius_of(points: Floats, outlier: float = 50.0) -> float:
    """Return the root mean square radius of points without outliers; 1 if it is none but rounding.

    An outlier is so many times as far from the median point as the median of them.
    """
    if not len(points):
        return 1.0
    far = np.abs(points - np.median(points, axis=0)).max(axis=1)
    is_far = far > outlier * np.median(far)
    if is_far.sum() <= max(1.0, 0.05 * len(points)):
        points = points[~is_far]
    if not len(points):
        return 1.0
    radius = math.sqrt(((points - points.mean(axis=0)) ** 2).sum(axis=1).mean())
    return radius if radius > 1e-12 + 1e-6 * np.abs(points).max() else 1.0


def certified(n: int, n_bad: int, alpha: float, propensity: float) -> float:
    """Return the largest mean failure probability that is not refuted."""
    enough = math.log(1.0 / alpha)

    def is_refuted(mean: float) -> bool:
        one = np.ones(1)
        return bool(log_certificate(n * one, n_bad * one, mean * one, propensity)[0] >= enough)

    if not is_refuted(1.0):
        return 1.0
    low, high = 0.0, 1.0
    for _ in range(45):
        middle = (low + high) / 2.0
        low, high = (low, middle) if is_refuted(middle) else (middle, high)
    return high


class Recount:
    """What a store says must have been counted.

    Parameters
    ----------
    case : Case
    seed : int
        Of the engine.
    ledger : Ledger
    diary : Diary

    Attributes
    ----------
    faults : list of str
        Where the engine counted otherwise.
    compared : Counter of str
        Number of comparisons by kind.
    """

    def __init__(self, case: Case, seed: int, ledger: Ledger, diary: Diary) -> None:
        self.case = case
        self.seed = seed
        self.ledger = ledger
        self.diary = diary
        self.faults: list[str] = []
        self.compared: Counter[str] = Counter()
        policy = case.policy
        self.sorts = policy.guarantee in ("pooled", "cost")
        self.z = Z[0.5] if self.sorts else Z[policy.alpha]
        self.hashes = {
            part.row["id"]: hash_of_trace(part.trace.astype(np.float32))
            if part.row["part"] is None
            else hash_of_part(part.row["part"])
            for part in ledger.parts
        }
        self.folds = {id_: fold(hash_, case.folds) for id_, hash_ in self.hashes.items()}
        self.silent = {
            id_: n for cell in range(case.n_cells) for id_, n in ledger.silent_before(cell).items()
        }
        self.spaces: dict[int, Space] = {0: self._untrained()}
        self.shared: dict[int, frozenset[str]] = {0: frozenset()}  # references of each version

    def expect(self, kind: str, what: str, actual: Any, expected: Any) -> None:
        """Compare a value of the engine with the recount's."""
        self.compared[kind] += 1
        is_same = actual == expected
        if isinstance(expected, float):
            is_same = abs(actual - expected) <= 1e-9
        if not is_same:
            self.faults.append(f"{kind}: {what}: {actual!r}, not {expected!r}")

    def check_all(self) -> None:
        """Compare everything that the store shows."""
        self.check_labels()
        self.check_versions()
        self.check_decisions()

    # Labels

    def check_labels(self) -> None:
        """Each report is one label, as it was reported, and there is no other label."""
        self.expect("labels", "without a decision", self.ledger.labels_without_decision, 0)
        reports = dict(self.diary.reports)
        corrections = sorted(
            (time, id_, success) for time, _, id_, success in self.diary.corrections
        )
        stored = []
        for part in self.ledger.parts:
            id_ = part.row["id"]
            time, good = reports.pop((part.cell, id_), (math.inf, None))
            stored += [(moment[0], id_, value) for moment, value in part.corrections]
            self.expect("folds", id_, part.row["content_hash"], self.hashes[id_])
            label = part.label
            is_late_stop = label is not None and label["source"] == "confirmed" and good is False
            if is_late_stop:  # it is stored as a correction of the confirmation
                corrections.append((time, id_, False))
                good = True
            if label is None:
                self.expect("labels", f"{id_} without a label", good, None)
                continue
            is_silence = part.is_confirmed_by_silence and part.next_decided < (label["time"], TOLD)
            expected = True if good is None and is_silence else good
            self.expect("labels", id_, bool(label["success"]), expected)
            source = self._source(part, bool(label["success"]))
            self.expect("labels", f"source of {id_}", label["source"], source)
            if id_ in self.silent:
                self.expect("silent parts", id_, label["silent"], self.silent[id_])
        self.expect("labels", "reports without a decision", list(reports), [])
        self.expect("corrections", "all", sorted(stored, key=str), sorted(corrections, key=str))
        for cell in range(self.case.n_cells):
            parts = [part for part in self.ledger.of_cell(cell) if part.label is not None]
            parts.sort(key=lambda part: part.learned(self.ledger.end))
            numbers = [part.label["seq"] for part in parts if part.label is not None]
            self.expect("labels", "order", numbers, sorted(set(numbers)))

    @staticmethod
    def _source(part: Part, good: bool) -> str:
        if part.row["action"] == "reject":
            return "inspection"
        if part.row["action"] == "verify":
            return "audit" if part.row["audit"] else "verification"
        return "confirmed" if good else "stop"

    # Versions

    def _untrained(self) -> Space:
        n_samples = len(self.ledger.parts[0].trace) if self.ledger.parts else 1
        weights = np.zeros((self.case.folds, n_samples))
        return Space(weights, np.ones(self.case.folds), frozenset())

    def check_versions(self) -> None:
        """Train every version again, on the labels that were stored then, each as it counted then.

        Space k has no label of fold k. A retrain starts from weights that never saw a label which is
        forgotten, and does not replace a pinned version.
        """
        pinned = False
        for row in self.ledger.versions:
            version = row["version"]
            with np.load(io.BytesIO(row["state"])) as arrays:
                state = {name: arrays[name] for name in arrays.files}
            rollback = self.ledger.events.get(("rollback", version))
            release = self.ledger.events.get(("release", version))
            if rollback is not None or release is not None:
                source = rollback["to"] if rollback is not None else version - 1
                self.spaces[version] = self.spaces[source]
                pinned = rollback is not None
                if release is not None:  # the same model goes on
                    at = (row["time"], TOLD)
                    maker = int(row["cell_id"].split()[1])
                    self.shared[version] = frozenset(self._references(maker, version - 1, at))
            else:
                self.expect("pins", f"version {version} replaces a pinned one", pinned, False)
                self.spaces[version] = self._train(row, state)
            if release is None:
                self.shared[version] = frozenset(
                    part.row["id"]
                    for part in self.ledger.parts
                    if part.label is not None and part.label["seq"] <= row["last_seq"]
                )
            space = self.spaces[version]
            weights = state["reducer.weights"]
            is_same = np.allclose(weights, space.weights, rtol=1e-6, atol=1e-9)
            self.expect("versions", f"weights of version {version}", is_same, True)
            is_same = np.array_equal(state["scale"], space.scale)
            self.expect("versions", f"scales of version {version}", is_same, True)

    def _references(self, cell: int, version: int, at: Moment) -> set[str]:
        """Return the decisions whose labels a cell counts at a moment, corrected or forgotten.

        They are those that the version had when it was stored, and those of the cell. A label of
        another cell that was brought back since then counts at once, too.
        """
        row = next((row for row in self.ledger.versions if row["version"] == version), None)
        stored = (0.0 if row is None else row["time"], TOLD)
        brought_back = {
            part.row["id"]
            for part in self.ledger.parts
            for (_, before), (moment, now) in itertools.pairwise(part.corrections)
            if before is None and now is not None and stored < moment < at
        }
        own = {p.row["id"] for p in self.ledger.of_cell(cell) if p.learned(at) != NEVER}
        return own | self.shared[version] | brought_back

    def _train(self, row: dict[str, Any], state: dict[str, Any]) -> Space:
        """Return a trained version's spaces."""
        version = row["version"]
        at = (row["time"], TOLD + 1)
        parts = [
            part
            for part in self.ledger.parts
            if part.teaches and part.reported < at and part.value_at(at) is not None
        ]
        parts.sort(key=lambda part: part.label["seq"] if part.label else 0)
        numbers = [part.label["seq"] for part in parts if part.label is not None]
        trained_on = state["trained_on"].tolist()
        self.expect("versions", f"labels of version {version}", trained_on, numbers)
        X = np.array([part.trace for part in parts])
        y = np.array([part.value_at(at) for part in parts], dtype=int)
        folds = np.array([self.folds[part.row["id"]] for part in parts])
        start = self._start(version, at)
        K = self.case.folds
        weights = np.stack(
            [
                mean_difference(X[folds != k], y[folds != k]) + MEMORY * start.weights[k]
                for k in range(K)
            ]
        )
        means = X.mean(axis=1)
        along = ((X - means[:, None]) * weights[folds]).sum(axis=1)
        points = np.stack([along, means], axis=1)
        scale = np.array(
            [self._scale(points[folds == k], float(state["scale"][k])) for k in range(K)]
        )
        return Space(weights, scale, start.seen | {part.row["id"] for part in parts})

    @staticmethod
    def _scale(points: Floats, stored: float) -> float:
        """Return the stored scale if it is the radius of these points, in float32; else the radius.

        A point at the very limit may be an outlier or not.
        """
        rounding = 1e-6 * np.abs(points).max(initial=0.0)
        radii = [radius_of(points, limit) for limit in (50.0 - 1e-3, 50.0, 50.0 + 1e-3)]
        is_same = any(abs(radius - stored) <= CLOSE * radius + rounding for radius in radii)
        return stored if is_same else radii[1]

    def _start(self, version: int, at: Moment) -> Space:
        """Return the newest version that never saw a label which is forgotten."""
        forgotten = {part.row["id"] for part in self.ledger.parts if part.is_forgotten(at)}
        earlier = sorted((number for number in self.spaces if number < version), reverse=True)
        return next(
            self.spaces[number] for number in earlier if not self.spaces[number].seen & forgotten
        )

    # Decisions

    def check_decisions(self) -> None:
        """Count the labels around each part as they were before its own label was known."""
        for cell in range(self.case.n_cells):
            rule = RuleReplay(self, cell)
            for part in self.ledger.of_cell(cell):
                self._check_decision(part, rule)

    def _check_decision(self, part: Part, rule: "RuleReplay") -> None:
        row = part.row
        id_ = row["id"]
        in_force = [v["version"] for v in self.ledger.versions if v["time"] < row["time"]]
        if self.case.n_cells > 1:  # cells of a product hear of one another in the same call
            in_force = [v["version"] for v in self.ledger.versions if v["time"] <= row["time"]]
        version = max(in_force, default=0)
        self.expect("versions in force", id_, row["model_version"], version)
        is_constant = float(np.ptp(part.trace)) == 0.0
        self.expect("faulty traces", id_, bool(row["quarantined"]), is_constant)
        counts = (row["n_success"], row["n_failure"])
        if is_constant or version == 0:
            reason = "constant" if is_constant else "no_model"
            self.expect("reasons", id_, (row["reason"], counts), (reason, (0, 0)))
            return
        self._check_counts(part)
        lower, upper = wilson(*counts, self.z)
        self.expect("bounds", f"lower of {id_}", row["lower"], lower)
        self.expect("bounds", f"upper of {id_}", row["upper"], upper)
        predicted, safe_mode = rule.action(part)
        self.expect("rule", f"action on {id_}", CODES[row["predicted"]], predicted)
        rate = self.case.policy.audit_rate
        content = hash_of_trace(part.trace.astype(np.float32))
        audited = bool(predicted and rate and is_audited(content, self.seed, rate))
        action = 0 if audited else CODES[row["predicted"]]
        self.expect("audits", id_, (CODES[row["action"]], bool(row["audit"])), (action, audited))
        self.expect("audits", f"propensity of {id_}", row["propensity"], rate if predicted else 1.0)
        reason = "audit" if audited else "certain" if predicted else "uncertain"
        if reason == "uncertain" and safe_mode:
            reason = "safe_mode"
        self.expect("reasons", id_, row["reason"], reason)

    def _check_counts(self, part: Part) -> None:
        """Compare embedding and counts of a decision; a label at the very radius may count or not."""
        row = part.row
        space = self.spaces[row["model_version"]]
        query = self._place(space, part)
        embedding = np.array(json.loads(row["embedding"]))
        is_same = np.allclose(embedding, query, rtol=CLOSE, atol=CLOSE)
        self.expect("embeddings", row["id"], is_same, True)
        inside: list[tuple[int, bool]] = []
        references = self._references(part.cell, row["model_version"], part.decided)
        for other in self.ledger.parts:
            if other.row["id"] not in references:
                continue
            if not other.teaches or self.hashes[other.row["id"]] == self.hashes[row["id"]]:
                continue
            value = other.value_at(part.decided)
            if value is None:
                continue
            k = self.folds[other.row["id"]]
            distance = float(np.linalg.norm(query[k] - self._place(space, other)[k]))
            if abs(distance - RADIUS) <= CLOSE:
                self.compared["counts at the radius, not compared"] += 1
                return
            if distance <= RADIUS:
                inside.append((self.hashes[other.row["id"]], value))
        n_times = Counter(hash_ for hash_, _ in inside)
        for column, wanted in (("n_success", True), ("n_failure", False)):
            # A part has one vote, which its labels share. Half a vote may be rounded either way.
            votes = sum(Fraction(1, n_times[hash_]) for hash_, value in inside if value is wanted)
            is_same = abs(row[column] - votes) <= Fraction(1, 2)
            self.expect("counts", f"{row['id']}, {column} {row[column]}", is_same, True)

    @staticmethod
    def _place(space: Space, part: Part) -> Floats:
        """Return a trace's place in every space, shape (K, 2)."""
        mean = part.trace.mean()
        along = space.weights @ (part.trace - mean)
        return np.stack([along, np.full(len(along), mean)], axis=1) / space.scale[:, None]

    # Looks

    def check_look(self, engine: DataEngine, cell: int, now: float) -> None:
        """Compare status, certificate and rule with the store as it is now."""
        at = (now, TOLD + 1)
        status = engine.status()
        parts = self.ledger.of_cell(cell)
        labelled = [part for part in parts if part.label is not None]
        values = {part.row["id"]: part.value_at(at) for part in labelled}
        actions = Counter(part.row["action"] for part in parts)
        sources: Counter[str] = Counter()
        for part in labelled:
            value = values[part.row["id"]]
            if value is not None and part.label is not None:
                is_stop = part.label["source"] == "confirmed" and not value
                sources["stop" if is_stop else part.label["source"]] += 1
        forgotten = sum(value is None for value in values.values())
        corrected = sum(bool(part.corrections) for part in parts)
        for name, actual, expected in (
            ("actions", +Counter(status.actions), actions),
            ("sources", +Counter(status.sources), sources),
            ("labels", status.labels, len(labelled) - forgotten),
            ("forgotten", status.forgotten, forgotten),
            ("corrected", status.corrected, corrected - forgotten),
        ):
            self.expect("status", name, actual, expected)
        versions = self.ledger.versions
        newest = versions[-1]["version"] if versions else 0
        self.expect("status", "version", (status.version, engine.version), (newest, newest))
        pinned = self.ledger.events.get(("rollback", newest), {"to": 0})["to"]
        self.expect("status", "pinned", status.pinned, pinned)
        self._check_certificate(engine, parts, at)
        if engine.model is None:
            return
        RuleReplay(self, cell).check(engine, at)

    def _check_certificate(self, engine: DataEngine, parts: list[Part], at: Moment) -> None:
        """Compare the certificate with the outcomes of accepted and of audited parts."""
        policy = self.case.policy
        certificate = engine.certificate()
        for verb, group, wrong in (
            ("accept", certificate.accepted, False),
            ("reject", certificate.rejected, True),
        ):
            own = [part for part in parts if part.row["action"] == verb]
            known = [part for part in own if part.label is not None]
            n_wrong = sum(part.value_at(at) is wrong for part in known)
            n_right = sum(part.value_at(at) is (not wrong) for part in known)
            n_lost = sum(part.is_forgotten(at) for part in known)
            audits = [part for part in parts if part.row["audit"] and part.row["predicted"] == verb]
            asked = [part for part in audits if part.label is not None]
            late = [part for part in audits if part.label is None and part.overdue < at]
            n_audited = len(asked) + len(late)
            n_bad = sum(part.value_at(at) in (wrong, None) for part in asked) + len(late)
            n_unchecked = len(own)
            if verb == "accept" and policy.stops == "all":
                n_unchecked = n_wrong + n_right + n_lost
                expected = (n_unchecked, n_wrong + n_lost, n_unchecked)
                upper = certified(n_unchecked, n_wrong + n_lost, policy.alpha, 1.0)
            elif verb == "accept" and 0 < n_unchecked == n_wrong + n_right + n_lost:
                share = 0.1 if policy.audit_rate else 1.0
                expected = (n_unchecked, n_wrong + n_lost, n_unchecked)
                upper = certified(n_unchecked, n_wrong + n_lost, share * policy.alpha, 1.0)
            elif verb == "accept" and not policy.audit_rate:
                expected = (n_unchecked, 0, n_unchecked)
                upper = 1.0
            else:
                n = n_unchecked + n_audited
                share = 0.9 if verb == "accept" and policy.stops == "some" else 1.0
                upper = certified(n, n_bad, share * policy.alpha, policy.audit_rate)
                if verb == "accept":
                    n_wrong += n_lost
                upper = max(upper, (n_bad + n_wrong) / max(1, n))
                expected = (n, n_bad, n_unchecked)
            actual = (group.n, group.n_bad, group.n_unchecked)
            self.expect("certificate", f"parts to {verb}", actual, expected)
            self.expect("certificate", f"bound to {verb}", round(group.upper, 8), round(upper, 8))


def _padded(counts: Floats, length: int) -> list[int]:
    """Return the counts of the one replay; where all outcomes are known, no part was audited: 0."""
    values = counts[:, 0].astype(int).tolist()
    return [*values, *[0] * (length - len(values))]


class RuleReplay:
    """The rule of a cell, updated with the outcomes that were known at a moment.

    Parameters
    ----------
    recount : Recount
    cell : int
    """

    def __init__(self, recount: Recount, cell: int) -> None:
        self._recount = recount
        self._policy = recount.case.policy
        self._parts = recount.ledger.of_cell(cell)
        self._known: list[Known] = []
        self._rules = self._new_rules()

    def _new_rules(self) -> Rules | None:
        policy = self._policy
        if policy.guarantee == "local" and policy.stops == "some":
            return None  # the paper's rule learns nothing
        if policy.guarantee == "cost":
            check, escape, false_reject = policy.prices
            tolerances = (check / escape, check / false_reject)
        else:
            tolerances = (1.0 - policy.lower_bound, 1.0 - policy.lower_bound)
        q = 1.0 if policy.stops == "all" else policy.audit_rate
        return Rules(policy.guarantee, 1, policy.alpha, tolerances, q)

    def action(self, part: Part) -> tuple[int, int]:
        """Return the action of the rule on a part, and the reason of a safe mode, before its label."""
        row = part.row
        self._update(part.decided)
        if self._rules is None:
            accepts = row["lower"] >= self._policy.lower_bound
            rejects = row["upper"] <= 1.0 - self._policy.lower_bound
            return (1 if accepts else 2 if rejects else 0), 0
        action = self._rules.action(np.array([row["lower"]]), np.array([row["upper"]]))
        return int(action[0]), int(self._rules.safe_mode[0])

    def check(self, engine: DataEngine, at: Moment) -> None:
        """Compare the members and levels of both sides, and the safe mode, with the engine's rule."""
        self._update(at)
        recount = self._recount
        rules = self._rules
        if rules is None:
            return
        evidence = engine.model.rule.evidence
        recount.expect("account", "safe mode", evidence.safe_mode.item(), int(rules.safe_mode[0]))
        for i, side in enumerate(rules.sides):
            threshold = evidence.thresholds[i].item()
            recount.expect("account", "threshold", threshold, float(side.threshold[0]))
            since = evidence.member_counts_since_alarm[i].flatten().tolist()
            expected = _padded(side.members_since.n, len(since))
            recount.expect("account", "members since an alarm", since, expected)
            if rules.kind == "local":
                continue
            members = evidence.member_counts[i].flatten().tolist()
            expected = _padded(side.members.n, len(members))
            recount.expect("account", "members", members, expected)

    def _update(self, at: Moment) -> None:
        """Update the rule to a moment; anew if outcomes were taken back or corrected meanwhile."""
        known = self._outcomes(at)
        if known[: len(self._known)] != self._known:
            self._rules = self._new_rules()
            self._known = []
        if self._rules is not None:
            for outcome in known[len(self._known) :]:
                self._tell(self._rules, outcome)
        self._known = known

    @staticmethod
    def _tell(rules: Rules, outcome: Known) -> None:
        yes = np.ones(1, dtype=bool)
        rules.observe(yes, np.array([outcome.silent]), ~yes)
        rules.update(
            yes,
            np.array([outcome.lower]),
            np.array([outcome.upper]),
            np.array([outcome.good]),
            np.array([outcome.predicted]),
            np.array([outcome.inclusion]),
        )

    def _outcomes(self, at: Moment) -> list[Known]:
        """Return the outcomes that count at a moment, in the order in which they were learned."""
        known: list[Known] = []
        for part in self._parts:
            row = part.row
            if not part.decided < at or not part.teaches or row["action"] == "reject":
                continue
            predicted = CODES[row["predicted"]]
            inclusion = row["propensity"] if row["action"] == "verify" else 0.0
            learned = part.learned(at)
            value = part.value_at(at)
            bound = (row["lower"], row["upper"])
            if value is not None:
                silent = self._recount.silent.get(row["id"], 0)
                known.append(Known(learned, row["id"], *bound, value, silent, predicted, inclusion))
            elif row["action"] == "verify" and part.overdue < at and learned > at:
                known += self._overdue(part, predicted, inclusion)
        return sorted(known, key=lambda outcome: outcome.moment)

    @staticmethod
    def _overdue(part: Part, predicted: int, inclusion: float) -> list[Known]:
        """Return what an overdue check counts as: wrong on each side that it is evidence for."""
        row = part.row
        known = []
        if row["lower"] > 0.0:
            as_accept = 1 if predicted == 1 else 0
            known.append(
                Known(part.overdue, row["id"], row["lower"], 1.0, False, 0, as_accept, inclusion)
            )
        if row["upper"] < 1.0:
            as_reject = 2 if predicted == 2 else 0
            known.append(
                Known(part.overdue, row["id"], 0.0, row["upper"], True, 0, as_reject, inclusion)
            )
        return known
