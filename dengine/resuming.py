"""Going on with a store: the same version, the same decisions, bit for bit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .model.base import EngineModel, Told
from .retraining import Window
from .store.base import Store
from .store.records import Labelled, ModelVersion
from .store.shared import is_shared

MANY = 500  # labels and no retrain yet: they were imported


@dataclass(frozen=True)
class Resumed:
    """Where an engine stood: the model that answered (None: no retrain yet), its version, labels since the last retrain."""

    model: EngineModel | None
    version: int
    new_labels: int


def resume(store: Store, template: EngineModel, window: Window) -> Resumed:
    """Fill the window and rebuild the answering model. Reference embeddings are read, not recomputed."""
    labelled = store.labelled(window.capacity)
    window.extend(labelled)
    version = store.last_version()
    if version is None:
        if len(labelled.seq) >= MANY:
            template.look_ahead_safely(labelled.traces)
        _tell(template, store, 0)
        return Resumed(None, 0, len(labelled.seq))
    model = restored(store, template, version.state, window.newest_seq)
    model.prepare_safely(template)
    model.look_ahead_safely(labelled.traces)
    trained_to = int(version.state["trained_on"][-1])
    # A stored state holds what came in during its retrain; a rival, which has none, was refitted without that.
    known_to = version.last_seq if "points" in version.state else trained_to
    _add_since(model, store, version, labelled, known_to)
    _tell(model, store, _told_to(version))
    return Resumed(model, version.version, int((labelled.seq > trained_to).sum()))


def _told_to(version: ModelVersion) -> int:
    """The newest label that the rule in a stored version was told of."""
    # A rule that missed something is told all anew; where cells share versions, it knows of this cell's own parts alone.
    return 0 if "untold" in version.state else int(version.state.get("told_to", version.last_seq))


def restored(store: Store, template: EngineModel, state: Mapping[str, NDArray[Any]], newest: int) -> EngineModel:
    """The model of a stored version; newest : label in the store."""
    model = template.successor()
    if model.needs_refit(state):  # on the very traces that it was fitted on
        trained_on = state["trained_on"]
        first, n = int(trained_on[0]), newest - int(trained_on[0]) + 1
        # Of a product's labels the newest may have come a moment ago: counted from the first one none is missed.
        data = store.news_since(first - 1, n).labelled if is_shared(store) else store.labelled(n)
        kept = np.isin(data.seq, trained_on)
        model.train(data.traces[kept], data.labels[kept], hashes=data.hashes[kept])
    return model.set_state(state)


def _add_since(model: EngineModel, store: Store, version: ModelVersion, labelled: Labelled, last_seq: int) -> None:
    added = store.points_since(version.last_seq, version.version)
    points = dict(zip(added.seq.tolist(), added.points, strict=True))
    for i in np.flatnonzero(labelled.seq > last_seq):
        hash_ = int(labelled.hashes[i])
        point = points.get(int(labelled.seq[i]))  # unknown: its decision was answered by an earlier version
        point = model.place_safely(labelled.traces[i], hash_) if point is None else point
        model.add_safely(point, int(labelled.labels[i]), hash_)


def tell_all(model: EngineModel, store: Store) -> None:
    """Let a model's rule forget, and tell it all that the store knows."""
    model.forget()
    _tell(model, store, 0)


def _tell(model: EngineModel, store: Store, last_seq: int) -> None:
    known = store.evidence_since(last_seq)
    for row in zip(known.lower, known.upper, known.success, known.novel, known.silent, strict=True):
        model.tell_safely(Told(float(row[0]), float(row[1]), bool(row[2]), bool(row[3]), int(row[4])))
