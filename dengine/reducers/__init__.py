"""Reducers by name: trace -> embedding, each a scikit-learn transformer, interchangeable everywhere."""

from collections.abc import Callable
from functools import partial
from inspect import signature
from typing import TYPE_CHECKING, Any

import lazy_loader
import numpy as np

from ..errors import SettingError, expect
from ..imports import import_class
from ..records import is_number, is_whole

if TYPE_CHECKING:
    from .base import CrossFitted as CrossFitted
    from .base import Reducer as Reducer
    from .conv import ConvReducer as ConvReducer
    from .pca import PcaReducer as PcaReducer
    from .rocket import RocketReducer as RocketReducer
    from .torch_reducer import TorchReducer as TorchReducer
    from .umap import UmapReducer as UmapReducer
    from .umap_learn import UmapLearnReducer as UmapLearnReducer

_NAMED = {  # by a reducer's name: its module, which is imported when it is asked for, and its class
    "conv": ("conv", "ConvReducer"),
    "umap": ("umap", "UmapReducer"),
    "umap-learn": ("umap_learn", "UmapLearnReducer"),
    "pca": ("pca", "PcaReducer"),
    "rocket": ("rocket", "RocketReducer"),
}
_LAZY = {"base": ["Reducer", "CrossFitted"], "torch_reducer": ["TorchReducer"]}
_LAZY |= {module: [class_name] for module, class_name in _NAMED.values()}

MOST = 2**31 - 1  # of a parameter that is an integer


def reducer_class(name: str) -> type:
    """The class behind a name in `REDUCERS` or `module:Class`, imported when it is asked for."""
    expect(name in _NAMED or ":" in name, f"a reducer among {', '.join(_NAMED)}, or module:Class of your own", name)
    found: type = __getattr__(_NAMED[name][1]) if name in _NAMED else import_class(name)
    if missing := [each for each in ("fit", "transform", "get_params") if not callable(getattr(found, each, None))]:
        raise SettingError(f"Expected a scikit-learn transformer as reducer, {name} has no {' and no '.join(missing)}.")
    return found


def make_reducer(name: str, **params: Any) -> Any:
    """A reducer by its name in `REDUCERS` or `module:Class`; SettingError for an unknown name or parameter."""
    found = reducer_class(name)
    allowed = signature(found).parameters
    unknown = sorted(set(params) - set(allowed))
    if unknown:
        raise SettingError(f"{found.__name__} has no parameter {', '.join(unknown)}; it has {', '.join(allowed)}.")
    if name in _NAMED:
        for key, value in params.items():
            _must_be_like(allowed[key].default, key, value)
    return found(**params)


def _must_be_like(default: Any, key: str, value: Any) -> None:
    """SettingError for a parameter of another type than its default: or every retrain would fail by it, one by one."""
    what = {bool: "true or false", str: "a text", int: "an integer", float: "a number"}.get(type(default))
    fits = {
        bool: isinstance(value, bool | np.bool_),
        str: isinstance(value, str),
        int: is_whole(value, 2 if key == "folds" else -MOST, 1000 if key == "folds" else MOST),
        float: is_number(value) and value == value,  # no NaN
    }
    expect(what is None or fits[type(default)], f"{what} as the reducer's {key}, as {default!r}", value)


def own_default(reducer: Any, name: str) -> Any:
    """Return what a reducer's class says of itself, `default_radius` say; `reducer` is a name, a class or an object.

    scikit-learn's transformers say nothing of it, so they have the default of `Reducer`.
    """
    kind = reducer_class(reducer) if isinstance(reducer, str) else reducer
    return getattr(kind, name, getattr(__getattr__("Reducer"), name))


def has_own_unit(reducer: Any) -> bool:
    """Whether a reducer's embedding is never scaled, its first axis a predicted probability; see `Reducer.own_unit`."""
    return bool(own_default(reducer, "own_unit"))


REDUCERS: dict[str, Callable[..., Any]] = {name: partial(make_reducer, name) for name in _NAMED}

__getattr__, __dir__, _ = lazy_loader.attach(__name__, submod_attrs=_LAZY)
