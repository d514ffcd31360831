"""Where the known and the newest parts lie for the model that answers, for a picture."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..recipe import Recipe
from ..records import Action
from ..reducers import has_own_unit
from ..store.views import HistoryFilter
from .explain import as_it_stood

if TYPE_CHECKING:
    from ..store.sql import SqlStore

KNOWN, NEWEST = 250, 10  # parts of a map: the newest known ones, and the newest of all
NAMED = 1000  # newest decisions whose parts' numbers are looked up


@dataclass(frozen=True, slots=True)
class Mark:
    """A part on the map.

    id, part : of its decision.  x, y : its place, the first two dimensions of the embedding, the mean over the spaces.
    success : its label, None while there is none.  action : what was decided, of a newest part; None of a known one.
    """

    id: str
    part: str | None
    x: float
    y: float
    success: bool | None
    action: Action | None


@dataclass(frozen=True, slots=True)
class PartMap:
    """The known parts and the newest.

    version : of the model.  marks : oldest first, the known ones before the newest; none before the first model, and
        for a model that keeps no references.
    radius : of the ball around the newest, None where there is none.  probability : whether x is one.
    """

    version: int
    marks: tuple[Mark, ...]
    radius: float | None
    probability: bool


def part_map(store: "SqlStore", recipe: Recipe, version: int) -> PartMap:
    """Read the map of a version."""
    recent = [past.decision for past in store.decisions(HistoryFilter(), NAMED)]
    newest = list(_newest(store, [made.id for made in recent[-NEWEST:] if made.model_version == version]))
    shown, parts = {mark.id for mark in newest}, {made.id: made.part for made in recent}
    known = [mark for mark in _known(store, recipe, version, parts) if mark.id not in shown] if version else []
    return PartMap(version, (*known, *newest), recipe.radius if newest else None, has_own_unit(recipe.reducer))


def _newest(store: "SqlStore", ids: list[str]) -> Iterator[Mark]:
    for past in filter(None, map(store.get_decision, ids)):
        made = past.decision
        if made.embedding is not None:
            yield Mark(made.id, made.part, *_plane(np.mean(made.embedding, axis=0)), past.success, made.action)


def _known(store: "SqlStore", recipe: Recipe, version: int, parts: dict[str, str | None]) -> list[Mark]:
    """The newest parts behind a version's references, oldest first."""
    answering = as_it_stood(store, version, recipe, None)
    if answering is None:
        return []
    points, labels = answering.index.held("points"), answering.index.held("labels")
    behind = [(label.seq, slot, label.decision_id) for slot, label in enumerate(answering.behind) if label]
    newest = sorted(behind)[-KNOWN:]
    return [Mark(id_, parts.get(id_), *_plane(points[slot]), bool(labels[slot]), None) for _, slot, id_ in newest]


def _plane(point: np.ndarray) -> tuple[float, float]:
    """The first two dimensions, (d,) -> x, y; 0 where a reducer has but one."""
    return float(point[0]), float(point[1]) if len(point) > 1 else 0.0
