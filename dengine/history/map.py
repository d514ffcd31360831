"""The map of the parts for the web page: where known and newest parts lie in the embedding.
`part_map` reads it from the store as a `PartMap` with its `Mark`s: the newest references of the
model with their labels, and the newest decisions.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..recipe import Recipe
from ..records import Action
from ..reducers import has_own_unit
from ..store.views import HistoryFilter
from .past_versions import load_past_version

if TYPE_CHECKING:
    from ..store.sql import SqlStore

N_KNOWN = 250  # newest labelled parts on the map
N_NEWEST = 10  # newest parts on the map, labelled or not
N_NAMED = 1000  # newest decisions whose parts' numbers are read


@dataclass(frozen=True, slots=True)
class Mark:
    """A part on the map.

    Attributes
    ----------
    id : str
        Of its decision.
    part : str or None
        Number of the part. None if it has none, or if its decision is not among the newest 1,000.
    x, y : float
        The first two dimensions of its embedding; of a newest part the mean over the spaces.
    success : bool or None
        Its label; None without one.
    action : Action or None
        The decision on a newest part; None for a known one.
    """

    id: str
    part: str | None
    x: float
    y: float
    success: bool | None
    action: Action | None


@dataclass(frozen=True, slots=True)
class PartMap:
    """The known and the newest parts.

    Attributes
    ----------
    version : int
        Of the model.
    marks : tuple of Mark
        Oldest first, the known parts before the newest; empty before the first model, and for a
        model that keeps no references.
    radius : float or None
        Radius within which labels count, to be drawn around each newest part; None if the map has
        no newest part.
    probability : bool
        Whether x is a probability.
    """

    version: int
    marks: tuple[Mark, ...]
    radius: float | None
    probability: bool


def part_map(store: "SqlStore", recipe: Recipe, version: int) -> PartMap:
    """Read the map of the parts, the points of the web page's picture, for a model version.

    Known parts are references of the version, the labelled traces with which it compares a new one;
    newest parts are decisions. Each is drawn at the first two coordinates of its embedding. A label
    that is damaged (not as it was stored) is left out, and an event is written to the store's log.

    Parameters
    ----------
    store : SqlStore
    recipe : Recipe
        With the radius within which labels count, and the reducer, which maps traces to points; the
        class of the reducer is imported if it is a `module:Class`.
    version : int
        The model version. 0 stands for the time before the first version: the map is empty.

    Returns
    -------
    PartMap
        The known parts are the newest 250 references whose label this robot cell recorded. Their
        labels are as the version had them, or as they were reported later; a later correction does
        not show. There are none if no such version was put in force, if its stored arrays are
        damaged or no longer kept, or if it has no references (a model that the user handed in). The
        newest parts come from the cell's newest 10 decisions, of any version: those that this
        version made and whose trace it embedded, with corrected labels. A part that is both appears
        once, as a newest part.

    Raises
    ------
    SettingError
        For an unknown reducer, and if an object of the user's class of decision rule cannot be
        made. An error of the rule's constructor other than TypeError, and what its `observe` and
        `update` raise, is raised as it is.
    StoreError
        If the store cannot be read.
    """
    recent = store.decisions.select(HistoryFilter(), N_NAMED)
    newest: dict[str, Mark] = {}
    for item in recent[-N_NEWEST:]:
        decision = item.decision
        if decision.model_version == version and decision.embedding is not None:
            newest[decision.id] = Mark(
                decision.id,
                decision.part,
                *_first_two(np.mean(decision.embedding, axis=0)),
                item.success,
                decision.action,
            )
    references: list[Mark] = []
    if (past := load_past_version(store, version, recipe, None)) is not None:
        parts = {item.decision.id: item.decision.part for item in recent}
        points = past.index.column("points")
        labels = past.index.column("labels")
        slots = sorted(
            (label.seq, slot, label.decision_id) for slot, label in enumerate(past.labels) if label
        )
        references = [
            Mark(id_, parts.get(id_), *_first_two(points[slot]), bool(labels[slot]), None)
            for _, slot, id_ in slots[-N_KNOWN:]
            if id_ not in newest
        ]
    return PartMap(
        version=version,
        marks=(*references, *newest.values()),
        radius=recipe.radius if newest else None,
        probability=has_own_unit(recipe.reducer),
    )


def _first_two(point: np.ndarray) -> tuple[float, float]:
    """Return the first two dimensions of a point, shape (d,); the second is 0.0 if d is 1."""
    return float(point[0]), float(point[1]) if len(point) > 1 else 0.0
