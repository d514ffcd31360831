"""Explains why a decision came out as it did, from what its store keeps.

    for sentence in explain(store, "0123456789ab-412").sentences: ...

An `Explanation` has sentences, the bounds with their thresholds, the nearest references, the
novelty scores, and the envelope of the successes. `DataEngine.explain`, `dengine explain` and the
web page use it.

Counts, bounds, action and reason are shown as they were recorded. The neighbours, the novelty
scores and the thresholds of a guarantee were not recorded: they are computed again from the version
that decided, if the store keeps its state. That needs no reducer, since the store has each
version's references, the embedding of each trace, and the time of each label.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from ..decision.policy import Policy
from ..errors import ReportConflictError, StoreError, UnknownDecisionError, shortened
from ..recipe import Recipe
from ..records import Action, Reason, Source, TraceArray, TraceSpec, stored_trace_spec
from ..store.records import POLICY_KINDS, SAFE_MODE_BEGAN, StoredDecision, unknown_decision
from ..store.views import HistoryFilter
from .envelope import Envelope, envelope_of
from .past_versions import Novelty, PastVersion, load_past_version
from .sentences import Bound, Circumstances, bound_of, explain_in_words

if TYPE_CHECKING:
    from ..store.sql import SqlStore

MAX_ENVELOPE_LABELS = 1000  # newest labels, whose successes make the band


@dataclass(frozen=True, slots=True)
class Neighbour:
    """A reference near the trace.

    Attributes
    ----------
    decision_id, part : str or None
        Of the decision behind it; None if unknown.
    success : bool
        Its label.
    source : Source or None
        Where the label came from; None if unknown.
    distance : float
        In units of the scaled embedding.
    space : int
        Number k of the embedding space in which it lies: its fold.
    inside : bool
        Whether it lies within the radius.
    trace : array of float32, shape (C, T), or None
        None if unknown.
    """

    decision_id: str | None
    part: str | None
    success: bool
    source: Source | None
    distance: float
    space: int
    inside: bool
    trace: TraceArray | None = field(metadata={"apart": True})


@dataclass(frozen=True, slots=True)
class Explanation:
    """A decision and its evidence.

    Attributes
    ----------
    decision : StoredDecision
        As recorded, with its label.
    trace : array of float32, shape (C, T)
    spec : TraceSpec
    sentences : tuple of str
        Why the decision came out as it did.
    notes : tuple of str
        A sentence that says which version's references the neighbours are, or why none are shown.
    bound : Bound or None
        The bounds and thresholds; None if no bound was computed.
    novelty : Novelty or None
        How novel a novel trace is. None if the trace is not novel, or if the version that decided
        is not kept.
    neighbours : tuple of Neighbour
        The nearest references of the version that decided, nearest first; empty if it is not kept.
    radius : float or None
        Radius of the neighbourhood; None if no distances could be computed.
    envelope : Envelope or None
        The band of the known successes; None while there are too few.
    policy : Policy
        The policy that was in force when the decision was made.
    """

    decision: StoredDecision
    trace: TraceArray = field(metadata={"apart": True})
    spec: TraceSpec
    sentences: tuple[str, ...]
    notes: tuple[str, ...]
    bound: Bound | None
    novelty: Novelty | None
    neighbours: tuple[Neighbour, ...]
    radius: float | None
    envelope: Envelope | None
    policy: Policy


def find_decision_id(store: SqlStore, part: str) -> str:
    """Return the id of the only decision on a part; a REJECT counts only if there is no other.

    A part that was rejected (REJECT, without a check) may come again, so its rejects are passed
    over if it also has a decision that is no REJECT. Only the newest 20 decisions of this robot
    cell on the part are looked at.

    Parameters
    ----------
    store : SqlStore
    part : str
        The number by which the user named the part in `decide`; or a decision's id, which is
        returned if no decision is on a part of this number.

    Returns
    -------
    str

    Raises
    ------
    UnknownDecisionError
        If `part` is neither the number of a decided part nor the id of a decision.
    ReportConflictError
        If several decisions count, that is, several that are no REJECT, or several REJECTs alone;
        the message has their ids.
    """
    decisions = store.decisions.select(HistoryFilter(part=part), 20)
    matches = [item for item in decisions if item.decision.action is not Action.REJECT] or decisions
    if not matches and (item := store.decisions.get(part, trace=False)) is not None:
        matches = [item]
    if not matches:
        raise UnknownDecisionError(
            "Expected the number of a part that was decided on, or a decision's id, got "
            f"{shortened(part)}, which is unknown; `dengine history STORE` lists them."
        )
    if len(matches) > 1:
        ids = ", ".join(item.decision.id for item in reversed(matches))
        raise ReportConflictError(
            f"Expected one decision of that part, there are {len(matches)}; name its id: {ids}."
        )
    return matches[0].decision.id


def explain(store: SqlStore, decision_id: str, neighbours: int = 10) -> Explanation:
    """Explain one decision from what its store keeps; nothing is trained or embedded.

    The policy (the settings of a decision, such as error level and limits) is the one that was in
    force at the decision. If a label, or a trace of those that make the envelope (the band that
    contains most traces of good parts), is damaged (not as it was stored), it is left out, and an
    event is written to the store's log. Nothing else is written.

    Parameters
    ----------
    store : SqlStore
    decision_id : str
        Id of the decision; or the number of its part, if this robot cell has no decision of this id
        (see `find_decision_id`).
    neighbours : int, default 10
        Number of nearest references (labelled points) at most. Those of the decision's own part are
        left out.

    Returns
    -------
    Explanation
        Sentences, bounds with their thresholds, the nearest references of the model version that
        decided, and the envelope of good parts; see its attributes.

    Raises
    ------
    ReportError
        For a decision that the store does not hold (UnknownDecisionError), and for a part with
        several decisions that count (ReportConflictError).
    StoreError
        For a store that no engine has used, for a stored recipe (the settings of an engine) that
        lacks some, for a damaged `TraceSpec`, and for a damaged trace of the decision or of a
        neighbour.
    SettingError
        For a stored recipe or policy that cannot be read, if an object of the user's class of
        decision rule cannot be made, and for a part outside the force limits (an operator's limits
        of the signal) if one of them does not fit its trace. An error of the rule's constructor
        other than TypeError, and what its `observe` and `update` raise, is raised as it is.
    """
    settings = store.settings.read()
    if "recipe" not in settings:
        raise StoreError(
            "Expected a store that an engine has used, this one is empty; make a DataEngine "
            "with it."
        )
    item = store.decisions.get(decision_id) or store.decisions.get(
        find_decision_id(store, decision_id)
    )
    if item is None:
        raise unknown_decision(decision_id)
    decision = item.decision
    recipe = Recipe.from_store(settings)
    recipe = replace(recipe, policy=_find_policy(store, item.time, recipe.policy))
    channels, samples = item.trace.shape
    version = load_past_version(store, decision.model_version, recipe, item)
    circumstances = Circumstances(
        recipe=recipe,
        spec=stored_trace_spec(settings) or TraceSpec(samples=samples, channels=channels),
        model=settings.get("model"),
        thresholds=None if version is None else version.thresholds,
        novelty=None if version is None else version.novelty,
        safe_mode=_find_safe_mode(store, item),
    )
    bound = bound_of(decision, circumstances)
    return Explanation(
        decision=item,
        trace=item.trace,
        spec=circumstances.spec,
        sentences=tuple(explain_in_words(item, bound, circumstances)),
        notes=(_note_of(item, version is not None),),
        bound=bound,
        novelty=circumstances.novelty,
        neighbours=tuple(_find_neighbours(store, version, item, recipe.radius, neighbours)),
        radius=None if version is None or decision.embedding is None else recipe.radius,
        envelope=_find_envelope(store, item, version),
        policy=recipe.policy,
    )


def _find_policy(store: SqlStore, time: float, present: Policy) -> Policy:
    """Return the policy, the settings of decisions, in force at a time, in seconds since 1970.

    It is the policy that the first change of policy after this time replaced, as the store's log of
    events says; an event without data, which cannot name it, is passed over. If there was no change
    since, it is `present`, the policy in force now. Raises SettingError if the policy of the event
    is not valid.
    """
    for event in store.events.newest():
        if event.kind in POLICY_KINDS and event.time > time and event.data is not None:
            return Policy.from_values(event.data["old"])
    return present


def _find_safe_mode(store: SqlStore, item: StoredDecision) -> str:
    """Return why the safe mode in which a decision was made had begun.

    In a safe mode, after an alarm about wrong decisions or novel traces, parts are checked until
    outcomes allow decisions again. The result is the text of the last event in the store's log that
    began a safe mode, at the time of the decision or before. "" if the reason of the decision is
    not `Reason.SAFE_MODE`, or if there is no such event.
    """
    if item.decision.reason is not Reason.SAFE_MODE:
        return ""
    for event in reversed(store.events.newest()):
        if event.kind == SAFE_MODE_BEGAN and event.time <= item.time:
            return event.text
    return ""


def _find_neighbours(
    store: SqlStore, version: PastVersion | None, item: StoredDecision, radius: float, n: int
) -> Iterator[Neighbour]:
    """Yield the nearest references of other parts, at most `n`, with their traces, nearest first.

    A reference is a labelled point of the model as it was at the decision (`version`); it lies in
    one of several embedding spaces, and its distance from the decision's trace is measured there.
    References of the decision's own part (if the part has no number, of traces equal to its trace)
    are left out. Nothing is yielded if `version` is None, or if the trace of the decision was not
    embedded. A neighbour may lie outside of the radius; its field `inside` says so. If the decision
    behind a reference is unknown (another robot cell made it, or its label is damaged), its id,
    part, source and trace are None. `success` is the label that the version had, without later
    corrections; `source` says where it came from when it was first reported. Raises StoreError for
    a trace that is damaged (not as it was stored).
    """
    embedding = item.decision.embedding  # (K, d)
    if version is None or embedding is None:
        return
    index = version.index
    query = torch.tensor(embedding, dtype=torch.float32)
    # Infinite to references of the decision's own part.
    distances = np.sqrt(index.squared_distances(query, item.content_hash).double().numpy())
    for slot in np.argsort(distances, kind="stable")[:n]:
        if not np.isfinite(distances[slot]):
            return
        label = version.labels[slot]
        stored = None if label is None else store.decisions.get(label.decision_id)
        yield Neighbour(
            decision_id=None if label is None else label.decision_id,
            part=None if stored is None else stored.decision.part,
            success=bool(index.column("labels")[slot]),
            source=None if label is None else label.source,
            distance=float(distances[slot]),
            space=int(index.column("spaces")[slot]),
            inside=bool(distances[slot] <= radius),
            trace=None if stored is None else stored.trace,
        )


def _find_envelope(
    store: SqlStore, item: StoredDecision, version: PastVersion | None
) -> Envelope | None:
    """Return the envelope of the good parts other than the decision's part; None if too few.

    The envelope is the band that contains the middle 95 % of these parts' traces at each sample.
    They are taken from the newest MAX_ENVELOPE_LABELS labels (1,000) up to `version.last_seq`, the
    newest label that the model version knew at the decision. If these give no envelope (they have
    fewer than 20 good parts, or traces of another shape), or without a version, they are taken from
    the newest labels of today. Labels count as corrected by now. Traces of the decision's own part
    (if it has no number, traces equal to its trace) are left out. So is a trace that is damaged
    (not as it was stored), and an event is written to the store's log.
    """
    for last in (None if version is None else version.last_seq, None):
        labelled = store.labels.with_traces(MAX_ENVELOPE_LABELS, last=last)
        is_other_success = (labelled.labels == 1) & (labelled.hashes != item.content_hash)
        envelope = envelope_of(labelled.traces[is_other_success], item.trace)
        if envelope is not None:
            return envelope
    return None


def _note_of(item: StoredDecision, is_kept: bool) -> str:
    """Return a sentence that says of which model version the neighbours of a trace are references.

    References are the labelled points of a model version. If there are no neighbours, it says why
    instead, by the first of these that applies: the trace is quarantined (stored, but never used in
    training), it was not embedded, or the store does not keep the version that decided (`is_kept`
    is False).
    """
    decision = item.decision
    version = f"version {decision.model_version}, which answered,"
    if item.quarantined:
        return (
            "The trace is quarantined: it was not embedded, is never trained on, and has no "
            "neighbours."
        )
    if decision.embedding is None:
        return "No neighbours are shown: the trace was not embedded."
    if not is_kept:
        return f"No neighbours are shown: {version} is not kept any more."
    return f"Neighbours: the references of {version} as they stood then."
