"""Why a decision came out as it did: its evidence as it was recorded, and what can be found again around it.

    for sentence in explain("0123456789ab-412", Records(store)).said: ...

What was recorded (counts, bound, action, reason) is shown as it is. Neighbours, the novelty score and the levels of a
guarantee are found again, without a reducer, by the version that answered where the store keeps it: `Explanation.notes`
says by which. A store keeps each version's references, each trace's place, and the time of each label.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..decision.novelty import NoveltyGate
from ..decision.policy import Policy
from ..decision.references import RadiusIndex, math_ceil
from ..decision.rule import DecisionRule
from ..errors import ReportError, StoreError
from ..folds import COIN_BITS, audit_salt, content_hash, fold_of, toss
from ..model.base import EngineModel
from ..recipe import Recipe
from ..records import Action, Reason, Source, TraceSpec, plain, trace_in
from ..store.base import Store
from ..store.records import SAFE_MODE_BEGAN, ModelVersion, StoredDecision, VersionError
from ..store.views import PastLabel
from .envelope import Envelope, envelope_of
from .sentences import Bound, Circumstances, Novelty, bound_of, verdict
from .status import safe_mode_event

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
        """The label behind each reference, in the order of `index.points`; None where it is not known any more."""
        by_number = {label.seq: label for label in self.known}
        return [by_number.get(number) for number in self.index.numbers.tolist()]


def as_it_stood(store: Store, version: int, recipe: Recipe, then: StoredDecision | None) -> Answering | None:
    """A version as it stood when a decision was made, or as it stands now; None where the store does not keep it."""
    try:
        stored = store.load_version(version)
    except VersionError:
        return None
    if "points" not in stored.state:  # a rival keeps nothing
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


def _known_at(label: PastLabel, then: StoredDecision, stops_all: bool) -> bool:
    """Whether an engine knew of a label when it made a decision: silence confirms a part before it is stored."""
    by_silence = stops_all and label.source is Source.CONFIRMED
    return label.decided < then.time if by_silence else label.time <= then.time and label.decision_id != then.decision.id


def _index(stored: ModelVersion, added: list[PastLabel], recipe: Recipe) -> RadiusIndex:
    n, total, spaces = stored.state["points"].shape[1], int(stored.state["total"]), len(stored.state["scale"])
    index = RadiusIndex.from_state(stored.state, n if total > n else max(n, recipe.window))
    for label in added:
        if label.point is not None:
            fold = int(fold_of(np.array([label.content_hash], dtype=np.int64), spaces)[0])
            index.put(torch.from_numpy(label.point), float(label.success), fold, label.content_hash, label.seq)
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
            rule.observe(label.silent, label.novel)
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
    """What lies around a trace, in the space of a version: `own` if that is the one that answered.

    distances : (n,) to each reference, in the order of `index.points`; infinite to those of its own part.
    radius : of the ball.  n_success, n_failure : its votes.
    """

    answering: Answering
    own: bool
    distances: NDArray[np.float64]
    radius: float
    n_success: int
    n_failure: int


NEIGHBOURS = 10  # nearest references that are shown
SUCCESSES = 1000  # newest labelled traces that the envelope is made of


@dataclass(frozen=True, slots=True)
class Neighbour:
    """A reference near the trace.

    decision_id, part : of the trace behind it, None where that is not known any more.  success : its label.
    source : of that label.  distance : in the unit of the scaled embedding.  space : the fold that it lives in.
    inside : whether it lies in the ball.  trace : (C, T), None where it is not known any more.
    """

    decision_id: str | None
    part: str | None
    success: bool
    source: Source | None
    distance: float
    space: int
    inside: bool
    trace: NDArray[np.float32] | None = field(metadata={"apart": True})


@dataclass(frozen=True, slots=True)
class Explanation:
    """A decision and its evidence.

    decision : as it was recorded.  trace : (C, T), as `spec` says.  label : what became of it is in `decision`.
    said : why, in sentences.  notes : what was found again, and by which version.
    bound : how the bound came out, and what others it would have needed; None where no bound was asked for.
    novelty : how unlike all references the trace is; None where novelty was off, or is not known any more.
    neighbours : the nearest references, nearest first; radius : of the ball, None where none was drawn.
    neighbours_version : the version that these are references of; None without neighbours.
    envelope : the band of the known successes; None while there are too few.
    """

    decision: StoredDecision
    trace: NDArray[np.float32] = field(metadata={"apart": True})
    spec: TraceSpec
    said: tuple[str, ...]
    notes: tuple[str, ...]
    bound: Bound | None
    novelty: Novelty | None
    neighbours: tuple[Neighbour, ...]
    neighbours_version: int | None
    radius: float | None
    envelope: Envelope | None

    def record(self) -> dict[str, Any]:
        """All but the arrays, as plain values for a machine."""
        said: dict[str, Any] = plain(self)
        if self.envelope is not None:
            said["envelope"]["largest"] = plain(self.envelope.largest)
        return said


@dataclass(frozen=True)
class Records:
    """Where an explanation is read from.

    store : the engine's.  present : gives the model that answers now, or None; asked where the version that answered is
        not kept.  version : its number.
    """

    store: Store
    present: Callable[[], EngineModel | None] = lambda: None
    version: int = 0


def explain(decision_id: str, records: Records, neighbours: int = NEIGHBOURS) -> Explanation:
    """Explain one decision; neighbours : how many of the nearest references to show.

    Raises ReportError for an id that the store does not hold, StoreError for a store that no engine has used.
    """
    store, known = records.store, records.store.settings()
    if "recipe" not in known:
        raise StoreError("Expected a store that an engine has used, this one is empty; make a DataEngine with it.")
    past = store.get_decision(decision_id)
    if past is None:
        raise ReportError(
            f"Expected the id of a decision of cell {store.cell_id!r}, got {decision_id!r}, which its store does not hold; "
            "`dengine history STORE` lists the ids, newest last."
        )
    made, trace, recipe = past.decision, past.trace, Recipe.from_toml(known["recipe"])
    spec = trace_in(known) or TraceSpec(samples=trace.shape[1], channels=trace.shape[0])
    answering = as_it_stood(store, made.model_version, recipe, past) if made.model_version else None
    around = _around(past, answering, records, recipe)
    mode = safe_mode_event(store, past.time)
    (coin,) = toss(content_hash(trace[None]), audit_salt(int(known.get("seed", "0")))).tolist()
    novelty = None
    if answering is not None and answering.gate is not None and not past.quarantined:
        with torch.inference_mode():
            novelty = Novelty(*answering.gate.scores(torch.from_numpy(trace)).tolist())
    found = Circumstances(
        recipe=recipe,
        spec=spec,
        model=known.get("model"),
        rule=None if answering is None else answering.rule,
        novelty=novelty,
        coin=coin / 2**COIN_BITS,
        safe_mode=mode.text if mode is not None and mode.kind == SAFE_MODE_BEGAN else "",
    )
    bound = bound_of(made, found)
    return Explanation(
        decision=past,
        trace=trace,
        spec=spec,
        said=tuple(verdict(past, bound, found)),
        notes=tuple(_notes(past, answering, around, bound)),
        bound=bound,
        novelty=novelty,
        neighbours=() if around is None else tuple(_nearest(store, around, neighbours)),
        neighbours_version=None if around is None else around.answering.version,
        radius=None if around is None else around.radius,
        envelope=_envelope(store, past, answering, spec),
    )


def _around(past: StoredDecision, answering: Answering | None, records: Records, recipe: Recipe) -> Ball | None:
    """The ball that decided, or the one of the version that answers now; None where nothing embeds the trace."""
    z, own = past.decision.embedding, True
    if past.quarantined or past.decision.reason is Reason.MODEL_ERROR:
        return None
    if answering is None or z is None:
        model, own = records.present(), False
        answering = None if model is None else as_it_stood(records.store, records.version, recipe, None)
        if model is None or model.untold or answering is None:
            return None
        z = model.predict_one(past.trace, past.content_hash).embedding
        if z is None:
            return None
    made, fractions = past.decision, [recipe.fraction or 0.0]
    if made.predicted is Action.REJECT and recipe.reject_fraction:
        fractions.insert(0, recipe.reject_fraction)  # rejections may be judged by a narrow ball
    balls = [_ball(answering, own, z, past.content_hash, recipe.radius, fraction) for fraction in fractions]
    recorded = (made.n_success, made.n_failure)
    return next((ball for ball in balls if (ball.n_success, ball.n_failure) == recorded), balls[-1])


def _ball(answering: Answering, own: bool, z: Embedding, part: int, radius: float, fraction: float) -> Ball:
    """What lies around a trace (K, d) of a part with this hash; radius, fraction : as the rule is asked, 0 for None."""
    ring = answering.index.ring
    squared = ring.squared_distances(torch.tensor(z, dtype=torch.float32), part)
    n_success, n_failure = ring.count_near(squared, radius, fraction)
    distances = np.sqrt(squared.double().numpy())
    if fraction > 0.0 and len(distances):
        radius = float(np.sort(distances)[min(len(distances), math_ceil(fraction * len(distances))) - 1])
    return Ball(answering, own, distances, radius, n_success, n_failure)


def _nearest(store: Store, ball: Ball, most: int) -> list[Neighbour]:
    index, behind, found = ball.answering.index, ball.answering.labels_of_references(), []
    for slot in np.argsort(ball.distances, kind="stable")[:most]:
        if not np.isfinite(ball.distances[slot]):
            break
        label = behind[slot]
        stored = None if label is None else store.get_decision(label.decision_id)
        one = Neighbour(
            decision_id=None if label is None else label.decision_id,
            part=None if stored is None else stored.decision.part,
            success=bool(index.labels[slot]),
            source=None if label is None else label.source,
            distance=float(ball.distances[slot]),
            space=int(index.spaces[slot]),
            inside=bool(ball.distances[slot] <= ball.radius),
            trace=None if stored is None else stored.trace,
        )
        found.append(one)
    return found


def _envelope(store: Store, past: StoredDecision, answering: Answering | None, spec: TraceSpec) -> Envelope | None:
    """The band of the successes that were known then; where those were too few, of those known now."""
    for upto in (None if answering is None else answering.last_seq, None):
        labelled = store.labelled(SUCCESSES, last=upto)
        others = (labelled.labels == 1) & (labelled.hashes != past.content_hash)
        if (band := envelope_of(labelled.traces[others], past.trace, spec.rate_hz)) is not None:
            return band
    return None


def _notes(past: StoredDecision, answering: Answering | None, around: Ball | None, bound: Bound | None) -> list[str]:
    version, found = past.decision.model_version, []
    if past.quarantined:
        found.append("The trace is quarantined: it was not embedded, is never trained on, and has no neighbours.")
    elif around is None:
        found.append("Nothing that embeds this trace is kept, so no neighbours are shown.")
    elif around.own:
        recorded, again = (past.decision.n_success, past.decision.n_failure), (around.n_success, around.n_failure)
        found.append(f"Neighbours: the references of version {version}, which answered, as they stood then.")
        if past.decision.reason is not Reason.NOVEL and again != recorded:
            found.append(
                f"Counted again, the ball holds {again[0]} successes and {again[1]} failures; recorded were {recorded[0]} "
                f"and {recorded[1]}: a label was corrected since, or came while this part was being decided on."
            )
    else:
        why = "no version answered then" if version == 0 else f"version {version}, which answered, is not kept any more"
        found.append(f"Neighbours: by version {around.answering.version}, the present one; {why}.")
    if answering is not None and answering.rule is None and bound is not None:
        found.append(f"What the rule of version {version} had learned is not kept; its thresholds are not shown.")
    if bound is not None and not bound.repeats:
        found.append("By the store's present settings these counts give another bound; the recorded one is shown.")
    return found
