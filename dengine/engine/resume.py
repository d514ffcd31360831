"""Going on with a store: the same version, the same decisions, bit for bit.

What the references of a version learned since it was stored, labels and corrections, is done again in the order in which it
happened.

Which labels the references of a model came from, oldest first, so that a correction finds its reference.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..model.base import EngineModel, Told
from ..store.base import Store
from ..store.peers import without_rule
from ..store.records import Correction, Evidence, ModelVersion
from .trainer import Window


class References:
    """The labels behind a model's references, in the order in which they joined: the newest of them are what it holds.

    A label is known by its sequence number, or by its decision's id while it waits for the store.
    """

    def __init__(self, seqs: Iterable[int] = ()) -> None:
        self._labels: list[int | str] = [int(seq) for seq in seqs]

    def add(self, label: int | str) -> None:
        """One more reference, the newest."""
        self._labels.append(label)

    def number(self, decision_id: str, seq: int) -> None:
        """The newest one of this decision has its number now."""
        age = self.age(decision_id)
        if age is not None:
            self._labels[-age] = seq

    def age(self, label: int | str) -> int | None:
        """The place of a label's reference counted from the newest, which is 1; None where there is none."""
        return next((age for age, held in enumerate(reversed(self._labels), 1) if held == label), None)

    def remove(self, age: int) -> None:
        """The reference of this age is gone."""
        del self._labels[-age]

    def seqs(self) -> NDArray[np.int64]:
        """(n,) sequence numbers, once none waits for the store."""
        return np.array([held for held in self._labels if not isinstance(held, str)], dtype=np.int64)


MANY = 500  # labels and no retrain yet: they were imported


@dataclass(frozen=True)
class Telling:
    """What the rule in force is told: what was decided from version `since` on; it began in the safe mode `began_in`."""

    since: int = 0
    began_in: int = 0


@dataclass(frozen=True)
class Origin:
    """What a version was trained on.

    seq : (n,) its labels.  corrected_to : newest correction that these had.  counts_from : newest label that the next
        retrain does not wait for.
    """

    seq: NDArray[np.int64]
    corrected_to: int
    counts_from: int

    def to_state(self) -> dict[str, NDArray[Any]]:
        """Plain arrays for the store."""
        numbers = {"trained_as": np.array(self.corrected_to), "counts_from": np.array(self.counts_from)}
        return {"trained_on": self.seq} | numbers

    @classmethod
    def from_state(cls, state: Mapping[str, NDArray[Any]]) -> Origin:
        """What `to_state` gave; before schema 3 it was less."""
        seq = state["trained_on"]
        return cls(seq, int(state.get("trained_as", 0)), int(state.get("counts_from", seq[-1])))


@dataclass(frozen=True)
class Resumed:
    """Where an engine stood: the model that answered (None: no retrain yet), its version, labels since the last retrain.

    references : the labels behind its references.  origin : what it was trained on.  corrected_to : newest correction.
    """

    model: EngineModel | None
    version: int
    new_labels: int
    references: References = field(default_factory=References)
    origin: Origin | None = None
    corrected_to: int = 0


def resume(store: Store, template: EngineModel, window: Window, telling: Telling) -> Resumed:
    """Fill the window and rebuild the answering model. Reference embeddings are read, not recomputed."""
    version = store.last_version()  # before the labels: a sister may store both meanwhile
    labelled = store.labelled(window.capacity)
    window.extend(labelled)
    state = {} if version is None else _own_rule(version, telling)
    model = None if version is None else restored(store, template, state)
    if version is None or model is None:
        if len(labelled.seq) >= MANY:
            template.look_ahead_safely(labelled.traces)
        template.begin_safely_in(telling.began_in)
        _tell(template, store.evidence_since(0, telling.since))
        corrections = store.corrections()
        return Resumed(None, 0, len(labelled.seq), corrected_to=corrections[-1].number if corrections else 0)
    origin = Origin.from_state(version.state)
    model.prepare_safely(template)
    model.look_ahead_safely(labelled.traces)
    references, corrected_to = join_since(model, store, version, window)
    told_to = int(version.state.get("told_to", version.last_seq))  # 0: a sister's, whose rule knows nothing of this cell
    anew = not told_to or "untold" in version.state or version.version < telling.since
    if anew or corrected_to > corrected_at(version):
        tell_all(model, store.evidence_since(0, telling.since), telling)
    else:
        _tell(model, store.evidence_since(told_to, telling.since))
    new_labels = int((labelled.seq > origin.counts_from).sum())
    return Resumed(model, version.version, new_labels, references, origin, corrected_to)


def _own_rule(version: ModelVersion, telling: Telling) -> Mapping[str, NDArray[Any]]:
    """A version's state, without what its rule knew where that is of an earlier policy: the later versions are damaged."""
    return version.state if version.version >= telling.since else without_rule(version.state)


def restored(store: Store, template: EngineModel, state: Mapping[str, NDArray[Any]]) -> EngineModel | None:
    """The model of a version; None where it is refitted, and a trace that it was fitted on is damaged."""
    model = template.successor()
    # On the very traces that it was fitted on, with the labels that these had.
    if model.needs_refit(state) and not refit(model, store, Origin.from_state(state)):
        return None
    return model.set_state(state)


def refit(model: EngineModel, store: Store, origin: Origin) -> bool:
    """Train a model on what another was trained on, with the labels as they stood then.

    False where a trace of these is damaged: fitted on the others, its references would lie elsewhere.
    """
    data = store.labelled(first=int(origin.seq[0]), last=int(origin.seq[-1]), corrected_to=origin.corrected_to)
    kept = np.isin(data.seq, origin.seq)
    said = {each.seq: each.success for each in store.corrections() if each.number <= origin.corrected_to}
    forgotten = sum(said.get(seq, True) is None for seq in origin.seq.tolist())  # not among them, and not damaged
    if kept.sum() + forgotten < len(origin.seq):
        return False
    model.train(data.traces[kept], data.labels[kept], hashes=data.hashes[kept])
    return True


def known_to(version: ModelVersion) -> int:
    """The newest label that a version's references held when it was stored."""
    # A stored state holds what came in during its retrain; a rival, which has none, was refitted without that.
    return version.last_seq if "points" in version.state else int(version.state["trained_on"][-1])


def corrected_at(version: ModelVersion) -> int:
    """The newest correction that a version's references had when it was stored."""
    return int(version.state.get("corrected_to", 0))


def join_since(model: EngineModel, store: Store, version: ModelVersion, window: Window) -> tuple[References, int]:
    """Let a version's model learn what happened since it was stored, in that order: labels join, corrections change them.

    Returns the labels behind its references, and the newest correction.
    """
    corrected_to = corrected_at(version)
    as_of = corrected_to if model.keeps_references else None  # a rival cannot be corrected afterwards
    # Up to the newest in the window: what sisters stored since comes as their news.
    since = store.labelled(window.capacity, first=known_to(version) + 1, last=window.newest_seq, corrected_to=as_of)
    references, corrections = _references(store, version), deque(store.corrections(corrected_to))
    newest = corrections[-1].number if corrections else corrected_to
    added = store.points_since(version.last_seq, version.version)
    points = dict(zip(added.seq.tolist(), added.points, strict=True))
    for seq, trace, label, hash_ in zip(since.seq.tolist(), since.traces, since.labels, since.hashes.tolist(), strict=True):
        while corrections and corrections[0].newest_seq < seq:
            change(model, references, store, corrections.popleft())
        point = points.get(seq)  # unknown: its decision was answered by an earlier version
        point = model.place_safely(trace, hash_) if point is None else point
        if model.add_safely(point, int(label), hash_):
            references.add(seq)
    for each in corrections:
        change(model, references, store, each)
    return references, newest


def _references(store: Store, version: ModelVersion) -> References:
    state = version.state
    if "points" not in state or "references" in state:
        return References(state.get("references", ()))
    trained_on = state["trained_on"]  # before schema 3: what it was trained on, and what came in meanwhile
    meanwhile = store.labelled(first=int(trained_on[-1]) + 1, last=version.last_seq, corrected_to=0)
    return References([*trained_on, *meanwhile.seq])


def change(model: EngineModel, references: References, store: Store, correction: Correction) -> bool:
    """Do to a model's references what a correction says; False where the reference is not what it should be.

    A reference gets its new label, or leaves. What was forgotten and counts again joins as the newest.
    """
    if not model.keeps_references:
        return True
    # As reported, of whichever cell; nothing where the part was quarantined, or the trace is damaged.
    data = store.labelled(first=correction.seq, last=correction.seq, corrected_to=0)
    known = None if len(data.seq) else store.past_decision(correction.decision_id)
    if not len(data.seq) and (known is None or known.quarantined):
        return True
    hash_ = int(data.hashes[0]) if known is None else known.content_hash
    age, label = references.age(correction.seq), correction.success
    if age is not None:
        done = model.change_reference(age, hash_, None if label is None else int(label))
        if label is None:
            references.remove(age)
        return done
    if label is not None and correction.was is None:
        point = model.place_safely(data.traces[0], hash_) if len(data.seq) else None
        if model.add_safely(point, int(label), hash_):
            references.add(correction.seq)
    return True


def tell_all(model: EngineModel, known: Evidence, telling: Telling) -> None:
    """Let a model's rule forget, and tell it all that is known of what it is to be told."""
    model.forget()
    model.begin_safely_in(telling.began_in)
    _tell(model, known)


def _tell(model: EngineModel, known: Evidence) -> None:
    if not model.remembers:
        return
    for row in zip(known.lower, known.upper, known.success, known.novel, known.silent, strict=True):
        model.tell_safely(Told(float(row[0]), float(row[1]), bool(row[2]), bool(row[3]), int(row[4])))
