"""Going on with a store: the same version, the same decisions, bit for bit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .prediction import ModelPrediction
from .store import Labelled, ModelVersion, Store
from .window import AnyModel, Window, hold, place, prepare


@dataclass(frozen=True)
class Resumed:
    """Where an engine stood: the model that answered (None: no retrain yet), its version, labels since the last retrain."""

    model: AnyModel | None
    version: int
    new_labels: int


def resume(store: Store, template: AnyModel, window: Window) -> Resumed:
    """Fill the window and rebuild the answering model. Reference embeddings are read, not recomputed."""
    labelled = store.labelled(window.capacity)
    window.extend(labelled)
    version = store.last_version()
    if version is None:
        return Resumed(None, 0, len(labelled.seq))
    model = _restored(store, template, version.state, window.newest_seq)
    prepare(model, None)
    trained_to = int(version.state["trained_on"][-1])
    # A stored state holds what came in during its retrain; a foreign model was refitted without that.
    _hold_since(model, store, version, labelled, version.last_seq if isinstance(model, ModelPrediction) else trained_to)
    return Resumed(model, version.version, int((labelled.seq > trained_to).sum()))


def _restored(store: Store, template: AnyModel, state: Mapping[str, NDArray[Any]], newest: int) -> AnyModel:
    model = template.successor()
    if isinstance(model, ModelPrediction) and any(name.startswith("reducer.") for name in state):
        return model.set_state(state)
    # A reducer without a state of its own is refitted on the very traces it was fitted on.
    trained_on = state["trained_on"]
    data = store.labelled(newest - int(trained_on[0]) + 1)
    kept = np.isin(data.seq, trained_on)
    model.fit(data.traces[kept], data.labels[kept], hashes=data.hashes[kept])
    return model.set_state(state) if isinstance(model, ModelPrediction) else model


def _hold_since(model: AnyModel, store: Store, version: ModelVersion, labelled: Labelled, last_seq: int) -> None:
    added = store.points_since(version.last_seq, version.version)
    points = dict(zip(added.seq.tolist(), added.points, strict=True))
    for i in np.flatnonzero(labelled.seq > last_seq):
        hash_ = int(labelled.hashes[i])
        point = points.get(int(labelled.seq[i]))  # unknown: its decision was answered by an earlier version
        point = place(model, labelled.traces[i], hash_) if point is None else point
        if point is not None:
            hold(model, point, int(labelled.labels[i]), hash_)
