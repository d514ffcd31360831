"""Going on with a store, bit for bit: what a version learned since it was stored is done again in the same order."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..model.base import EngineModel
from ..store.records import Correction, ModelVersion, OutcomeRecord
from .settings import EvidenceWindow
from .trainer import TrainedOn, Window

if TYPE_CHECKING:
    from ..store.outbox import Outbox
    from ..store.sql import SqlStore


def restored(outbox: Outbox, template: EngineModel, state: Mapping[str, NDArray[Any]]) -> EngineModel | None:
    """The model of a version; None where it is refitted, and a trace that it was fitted on is damaged."""
    model = template.successor()
    # On the very traces that it was fitted on, with the labels that these had.
    if model.needs_refit(state) and not refit(model, outbox, TrainedOn.from_state(state)):
        return None
    return model.set_state(state)


def refit(model: EngineModel, outbox: Outbox, trained_on: TrainedOn) -> bool:
    """Train a model on what another was trained on, with the labels of then; False where a trace of these is damaged."""
    store, first, last = outbox.store, int(trained_on.seq[0]), int(trained_on.seq[-1])
    outbox.check_integrity(first - 1)  # older than what is read of the newest
    data = store.labelled(first=first, last=last, corrected_to=trained_on.corrected_to)
    kept = np.isin(data.seq, trained_on.seq)
    said = {each.seq: each.success for each in store.corrections() if each.number <= trained_on.corrected_to}
    forgotten = sum(said.get(seq, True) is None for seq in trained_on.seq.tolist())  # not among them, and not damaged
    if kept.sum() + forgotten < len(trained_on.seq):
        return False
    model.train(data.traces[kept], data.labels[kept], data.hashes[kept], numbers=data.seq[kept])
    return True


def known_to(version: ModelVersion) -> int:
    """The newest label that a version's references held when it was stored."""
    # A stored state holds what came in during its retrain; a baseline, which has none, was refitted without that.
    return version.last_seq if "points" in version.state else int(version.state["trained_on"][-1])


def corrected_at(version: ModelVersion) -> int:
    """The newest correction that a version's references had when it was stored."""
    return int(version.state.get("corrected_to", 0))


def join_since(model: EngineModel, store: SqlStore, version: ModelVersion, window: Window) -> int:
    """Let a version's model learn what came since it was stored, in order; returns the newest correction's number."""
    corrected_to = corrected_at(version)
    as_of = corrected_to if model.keeps_references else None  # a baseline cannot be corrected afterwards
    # Up to the newest in the window: what peers stored since comes as their news.
    since = store.labelled(window.capacity, first=known_to(version) + 1, last=window.newest_seq, corrected_to=as_of)
    corrections = deque(store.corrections(corrected_to))
    newest = corrections[-1].number if corrections else corrected_to
    added = store.past_labels(version.last_seq)
    points = {each.seq: each.point for each in added if each.model_version == version.version}
    for seq, trace, label, hash_ in zip(since.seq.tolist(), since.traces, since.labels, since.hashes.tolist(), strict=True):
        while corrections and corrections[0].newest_seq < seq:
            change(model, store, corrections.popleft())
        point = points.get(seq)  # unknown: its decision was answered by an earlier version
        point = model.place_safely(trace, hash_) if point is None else point
        model.add_safely(point, int(label), hash_, seq)
    for each in corrections:
        change(model, store, each)
    return newest


def change(model: EngineModel, store: SqlStore, correction: Correction) -> bool:
    """Give a reference its corrected label, take it out, or let it join again; False where it is not what it should be."""
    if not model.keeps_references:
        return True
    # As reported, of whichever cell; nothing where the part was quarantined, or the trace is damaged.
    data = store.labelled(first=correction.seq, last=correction.seq, corrected_to=0)
    known = None if len(data.seq) else store.get_decision(correction.decision_id, trace=False)
    if not len(data.seq) and (known is None or known.quarantined):
        return True
    hash_ = int(data.hashes[0]) if known is None else known.content_hash
    label = None if correction.success is None else int(correction.success)
    if correction.was is not None or label is None:
        return model.change_reference(correction.seq, hash_, label)
    point = model.place_safely(data.traces[0], hash_) if len(data.seq) else None
    model.add_safely(point, label, hash_, correction.seq)
    return True


def tell_all(model: EngineModel, known: Callable[[], list[OutcomeRecord]], evidence: EvidenceWindow) -> None:
    """Reset a model's rule and replay its evidence."""
    model.forget()
    model.begin_safely_in(evidence.began_in)
    tell(model, known)


def tell(model: EngineModel, asked: Callable[[], list[OutcomeRecord]]) -> None:
    """Tell a model's rule what became of parts, in the order of their labels; one that learns nothing asks for nothing."""
    if not model.remembers:
        return
    for each in asked():
        bounds = each.lower, each.upper
        model.tell_safely(*bounds, each.success, each.novel, each.silent, each.predicted, each.inclusion_probability)
