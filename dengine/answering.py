"""The version that answered a decision, as it stood then: references, novelty gate and rule, out of arrays alone.

A store keeps the references of each version with their places, each trace's place with its decision, and each label
with its time. So what was near a trace is found again without its reducer, whatever that was.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from .decision.neighbors import RadiusIndex, math_ceil
from .decision.novelty import NoveltyGate
from .decision.policy import Policy
from .decision.rule import DecisionRule
from .folds import fold_of
from .recipe import Recipe
from .records import Source
from .store.base import Store
from .store.records import ModelVersion
from .store.views import PastDecision, PastLabel

Embedding = tuple[tuple[float, ...], ...]
STRIDE = 100_000  # labels after a version at most that are read: a cell that never retrains again


@dataclass(frozen=True)
class Answering:
    """A version as it stood at a moment.

    version : its number.  index : its references.  known : the labels behind them, oldest first.
    gate : of novelty, None where it was off.  rule : what it had been told by then, None where that is not kept.
    last_seq : the newest label that it could know.
    """

    version: int
    index: RadiusIndex
    known: list[PastLabel]
    gate: NoveltyGate | None
    rule: DecisionRule | None
    last_seq: int

    def labels_of_references(self) -> list[PastLabel | None]:
        """The label behind each reference, in the order of `index.points`; None where it is not known any more.

        References and labels of one part are met from the newest backwards: the oldest references may have left.
        """
        by_part: dict[int, list[PastLabel]] = defaultdict(list)
        for label in self.known:
            by_part[label.content_hash].append(label)
        total, n = int(self.index.ring.total), len(self.index)
        newest_first = [(total - 1 - age) % n for age in range(n)] if total > n else range(n - 1, -1, -1)
        found: list[PastLabel | None] = [None] * n
        parts = self.index.parts
        for slot in newest_first:
            waiting = by_part.get(int(parts[slot]), [])
            if waiting:
                found[slot] = waiting[-1] if len(waiting) == 1 else waiting.pop()
        return found


def as_it_stood(store: Store, version: int, recipe: Recipe, then: PastDecision | None) -> Answering | None:
    """A version as it stood when a decision was made, or as it stands now; None where the store does not keep it."""
    stored = store.kept_version(version)
    if stored is None or "points" not in stored.state:  # a rival keeps nothing
        return None
    retrains = [each.last_seq for each in store.past_retrains() if each.report.accepted and each.report.version > version]
    upto = min(retrains[0] if retrains else stored.last_seq + STRIDE, stored.last_seq + STRIDE)
    stops_all = recipe.policy.stops == "all"
    later = [
        label
        for label in store.past_labels(stored.last_seq, upto, points=True)
        if then is None or _known_at(label, then, stops_all)
    ]
    first = int(stored.state["trained_on"][0])
    before = store.past_labels(first - 1, stored.last_seq)
    known = [label for label in (*before, *later) if not label.quarantined]
    last = max((label.seq for label in known), default=stored.last_seq)
    index = _index(stored, [label for label in later if label.model_version == version], recipe)
    return Answering(version, index, known, _gate(stored), _rule(stored, later, recipe.policy), last)


def _known_at(label: PastLabel, then: PastDecision, stops_all: bool) -> bool:
    """Whether an engine knew of a label when it made a decision: silence confirms a part before it is stored."""
    by_silence = stops_all and label.source is Source.CONFIRMED
    return label.decided < then.time if by_silence else label.time <= then.time and label.decision_id != then.id


def _index(stored: ModelVersion, added: list[PastLabel], recipe: Recipe) -> RadiusIndex:
    n, total, spaces = stored.state["points"].shape[1], int(stored.state["total"]), len(stored.state["scale"])
    index = RadiusIndex.from_state(stored.state, n if total > n else max(n, recipe.window))
    for label in added:
        if label.point is not None:
            fold = int(fold_of(np.array([label.content_hash], dtype=np.int64), spaces)[0])
            index.ring.put(torch.from_numpy(label.point), float(label.success), fold, label.content_hash)
    return index


def _gate(stored: ModelVersion) -> NoveltyGate | None:
    kept = _buffers(stored, "novelty.")
    if not kept:
        return None
    gate = NoveltyGate(*(int(n) for n in stored.state["trace_shape"]))
    gate.asleep = False
    gate.load_state_dict(kept)
    return gate


def _rule(stored: ModelVersion, told: list[PastLabel], policy: Policy) -> DecisionRule | None:
    rule, kept = policy.rule(), _buffers(stored, "rule.")
    if {name: value.shape for name, value in rule.state_dict().items()} != {name: v.shape for name, v in kept.items()}:
        return None  # the rule was another one, handed in with its model, or had missed something
    rule.load_state_dict(kept)
    for label in told:
        if not label.quarantined:
            rule.note(label.silent, label.novel)
            rule.tell(label.lower, label.upper, label.success)
    return rule


def rule_now(store: Store, policy: Policy) -> DecisionRule | None:
    """The rule as it stands now; None before the first version, and where it is not kept."""
    stored = store.last_version()
    if stored is None:
        return None
    untold = "untold" in stored.state  # it missed something: an engine that is opened tells it all anew
    return None if untold else _rule(stored, store.past_labels(stored.last_seq), policy)


def _buffers(stored: ModelVersion, prefix: str) -> dict[str, torch.Tensor]:
    found = {name: value for name, value in stored.state.items() if name.startswith(prefix)}
    return {name.removeprefix(prefix): torch.from_numpy(np.array(value)) for name, value in found.items()}


@dataclass(frozen=True)
class Ball:
    """What lies around a trace.

    distances : (n,) to each reference, in the order of `index.points`; infinite to those of its own part.
    radius : of the ball.  n_success, n_failure : its votes.
    """

    distances: NDArray[np.float64]
    radius: float
    n_success: int
    n_failure: int


def ball_around(index: RadiusIndex, z: Embedding, part: int, radius: float, fraction: float) -> Ball:
    """What lies around a trace (K, d) of a part with this hash; radius, fraction : as the rule is asked, 0 for None."""
    ring = index.ring
    squared = ring.squared_distances(torch.tensor(z, dtype=torch.float32), part)
    n_success, n_failure = ring.count_near(squared, radius, fraction)
    distances = np.sqrt(squared.double().numpy())
    if fraction > 0.0 and len(distances):
        radius = float(np.sort(distances)[min(len(distances), math_ceil(fraction * len(distances))) - 1])
    return Ball(distances, radius, n_success, n_failure)
