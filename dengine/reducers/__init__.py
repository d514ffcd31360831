"""Reducers by name: trace -> embedding, each a scikit-learn transformer, interchangeable everywhere."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from inspect import signature
from typing import Any

from ..errors import SettingError

_WHERE = {
    "conv": ("conv", "ConvReducer"),
    "umap": ("umap", "UMAPReducer"),
    "pca": ("linear", "PCAReducer"),
}


def _maker(module: str, name: str) -> Callable[..., Any]:
    def make(**params: Any) -> Any:
        # Imported when used: UMAP alone takes seconds.
        reducer_class = getattr(import_module(f"{__name__}.{module}"), name)
        allowed = signature(reducer_class).parameters
        unknown = sorted(set(params) - set(allowed))
        if unknown:
            raise SettingError(f"{name} has no parameter {', '.join(unknown)}; it has {', '.join(allowed)}.")
        return reducer_class(**params)

    make.__name__ = name
    return make


REDUCERS: dict[str, Callable[..., Any]] = {key: _maker(*where) for key, where in _WHERE.items()}


def make_reducer(name: str, **params: Any) -> Any:
    """A reducer by its name in `REDUCERS`; SettingError for an unknown name or parameter."""
    if name not in REDUCERS:
        raise SettingError(f"Expected a reducer among {', '.join(REDUCERS)}, got {name!r}.")
    return REDUCERS[name](**params)
