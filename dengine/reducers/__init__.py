"""Reducers by name: trace -> embedding, each a scikit-learn transformer, interchangeable everywhere."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from inspect import signature
from typing import TYPE_CHECKING, Any

from .._lazy import find_class, lazy_names
from ..errors import SettingError
from ..recipe import Recipe

if TYPE_CHECKING:
    from .base import Reducer
    from .conv import ConvReducer
    from .cross_fitting import CrossFitted
    from .pca import PcaReducer
    from .plane import PlaneReducer
    from .rocket import RocketReducer
    from .umap import UmapReducer

_WHERE = {
    "base": ("Reducer",),
    "conv": ("ConvReducer",),
    "cross_fitting": ("CrossFitted",),
    "pca": ("PcaReducer",),
    "plane": ("PlaneReducer",),
    "rocket": ("RocketReducer",),
    "umap": ("UmapReducer",),
}
_CLASSES = {
    "conv": "dengine.reducers.conv:ConvReducer",
    "umap": "dengine.reducers.umap:UmapReducer",
    "pca": "dengine.reducers.pca:PcaReducer",
    "rocket": "dengine.reducers.rocket:RocketReducer",
    "plane": "dengine.reducers.plane:PlaneReducer",
}

__all__ = [
    "REDUCERS",
    "ConvReducer",
    "CrossFitted",
    "PcaReducer",
    "PlaneReducer",
    "Reducer",
    "RocketReducer",
    "UmapReducer",
    "make_reducer",
    "reducer_class",
]


def reducer_class(name: str) -> type:
    """The class behind a name in `REDUCERS` or `module:Class`, imported when it is asked for: UMAP alone takes seconds."""
    if name not in _CLASSES and ":" not in name:
        raise SettingError(f"Expected a reducer among {', '.join(_CLASSES)}, or module:Class of your own, got {name!r}.")
    found = find_class(_CLASSES.get(name, name))
    if not (callable(getattr(found, "fit", None)) and callable(getattr(found, "transform", None))):
        raise SettingError(f"Expected a scikit-learn transformer as reducer, {name} has not both fit and transform.")
    return found


def make_reducer(name: str, **params: Any) -> Any:
    """A reducer by its name in `REDUCERS` or `module:Class`; SettingError for an unknown name or parameter."""
    found = reducer_class(name)
    allowed = signature(found).parameters
    unknown = sorted(set(params) - set(allowed))
    if unknown:
        raise SettingError(f"{found.__name__} has no parameter {', '.join(unknown)}; it has {', '.join(allowed)}.")
    return found(**params)


def reducer_of(recipe: Recipe, seed: int) -> Any:
    """A recipe's reducer: an object as it is, or one made by name with the seed and the folds, where it knows them."""
    if not isinstance(recipe.reducer, str):
        return recipe.reducer
    known = signature(reducer_class(recipe.reducer)).parameters
    # A reducer that cross-fits by itself takes the folds; any other is cross-fitted from outside.
    own = {name: value for name, value in (("random_state", seed), ("folds", recipe.folds)) if name in known}
    return make_reducer(recipe.reducer, **own | dict(recipe.params))


REDUCERS: dict[str, Callable[..., Any]] = {name: partial(make_reducer, name) for name in _CLASSES}

__getattr__, __dir__ = lazy_names(__name__, _WHERE)
