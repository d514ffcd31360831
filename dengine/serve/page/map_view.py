"""What the map is drawn from: the references of the version that answers, and where the newest parts fell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...answering import as_it_stood
from ...experiments.maps import is_probability
from ...store.views import HistoryFilter, PastDecision
from .looking import Looking
from .map_chart import Mark, PartMap
from .part_view import part_name

KNOWN = 250  # newest known parts that are drawn
NEWEST = 10  # newest parts that are drawn beside them
NAMED = 1000  # newest decisions whose parts' numbers are looked up


def map_view(looking: Looking) -> PartMap | None:
    """Read the map; None before the first model, and for one that keeps no references."""
    engine = looking.service.engine
    version, recipe = engine.version, looking.recipe
    if version == 0:
        return None
    recent = looking.store.decisions(HistoryFilter(), NAMED)
    names = {past.id: part_name(past) for past in recent}
    known = looking.kept(
        "known parts", (version, engine.new_labels, len(looking.store.corrections())), lambda: _known(looking, version)
    )
    if known is None:
        return None
    newest = _newest(looking, recent[-NEWEST:], version)
    shown = {mark.id for mark in newest}
    marks = [*(replace(mark, name=names.get(mark.id, mark.name)) for mark in known if mark.id not in shown), *newest]
    radius = recipe.radius if recipe.fraction is None and newest else None
    return PartMap(version, tuple(marks), radius, is_probability(recipe)) if marks else None


def _known(looking: Looking, version: int) -> tuple[Mark, ...] | None:
    answering = as_it_stood(looking.store, version, looking.recipe, None)
    if answering is None:
        return None
    points, labels = np.asarray(answering.index.points), np.asarray(answering.index.labels)
    found = []
    for slot, behind in enumerate(answering.labels_of_references()):
        if behind is not None:
            x, y = _plane(points[slot])
            name = behind.decision_id
            found.append((behind.seq, Mark(name, name[:12], x, y, "good" if labels[slot] else "bad")))
    return tuple(mark for _, mark in sorted(found, key=lambda each: each[0])[-KNOWN:])


def _newest(looking: Looking, recent: list[PastDecision], version: int) -> list[Mark]:
    found = []
    for past in recent:
        stored = looking.store.get_decision(past.id) if past.model_version == version else None
        if stored is None or stored.embedding is None:
            continue
        x, y = _plane(np.asarray(stored.embedding).mean(axis=0))
        last = past is recent[-1]
        found.append(Mark(past.id, part_name(past), x, y, past.label, past.action.value, last))
    return found


def _plane(point: np.ndarray) -> tuple[float, float]:
    """The first two dimensions, (d,) -> x, y; 0 where a reducer has but one."""
    return float(point[0]), float(point[1]) if len(point) > 1 else 0.0
