"""Reducers by name: trace -> embedding, each a scikit-learn transformer, interchangeable everywhere."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from importlib import import_module
from inspect import signature
from typing import Any

from ..errors import SettingError

_WHERE = {
    "conv": ("conv", "ConvReducer"),
    "umap": ("umap", "UMAPReducer"),
    "pca": ("linear", "PCAReducer"),
    "rocket": ("rocket", "RocketReducer"),
}


def reducer_class(name: str) -> type:
    """The class behind a name in `REDUCERS`, imported when it is asked for: UMAP alone takes seconds."""
    if name not in _WHERE:
        raise SettingError(f"Expected a reducer among {', '.join(_WHERE)}, got {name!r}.")
    module, class_name = _WHERE[name]
    found: type = getattr(import_module(f"{__name__}.{module}"), class_name)
    return found


def make_reducer(name: str, **params: Any) -> Any:
    """A reducer by its name in `REDUCERS`; SettingError for an unknown name or parameter."""
    found = reducer_class(name)
    allowed = signature(found).parameters
    unknown = sorted(set(params) - set(allowed))
    if unknown:
        raise SettingError(f"{found.__name__} has no parameter {', '.join(unknown)}; it has {', '.join(allowed)}.")
    return found(**params)


REDUCERS: dict[str, Callable[..., Any]] = {name: partial(make_reducer, name) for name in _WHERE}
