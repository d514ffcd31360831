"""Reducers by name. A reducer embeds traces, and each is a scikit-learn transformer. `REDUCERS`
maps a name (conv, umap, umap-learn, pca, rocket) to a function that makes the reducer;
`make_reducer` also takes the `module:Class` of a user's own and checks the parameters. The model,
the recipe and the command line make their reducers here.

A new reducer is a module of this folder and a line in `_NAMED`, which also gives it a recipe; its
defaults are attributes of its class, see `base.Reducer`.
"""

from collections.abc import Callable
from functools import partial
from inspect import signature
from typing import TYPE_CHECKING, Any

import lazy_loader

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

# Class of each reducer by its name, which is also that of its module, with `_` in place of `-`. The
# module is imported when the class is needed.
_NAMED = {
    "conv": "ConvReducer",
    "umap": "UmapReducer",
    "umap-learn": "UmapLearnReducer",
    "pca": "PcaReducer",
    "rocket": "RocketReducer",
}
_LAZY = {"base": ["Reducer", "CrossFitted"], "torch_reducer": ["TorchReducer"]}
_LAZY |= {name.replace("-", "_"): [class_name] for name, class_name in _NAMED.items()}

MAX_INTEGER = 2**31 - 1  # of a parameter
TRANSFORMER_METHODS = ("fit", "transform", "get_params")


def reducer_class(name: str) -> type:
    """Import and return the class of a reducer; importing a user's module runs its code.

    Parameters
    ----------
    name : str
        A name in `REDUCERS`, or `module:Class`.

    Returns
    -------
    type
        A `Reducer` (its objects map traces to points), or for `module:Class` any class with `fit`,
        `transform` and `get_params`.

    Raises
    ------
    SettingError
        If there is no such class, its module cannot be imported, or it is no scikit-learn
        transformer.
    """
    expect(
        name in _NAMED or ":" in name,
        f"a reducer among {', '.join(_NAMED)}, or module:Class of your own",
        name,
    )
    cls: type = __getattr__(_NAMED[name]) if name in _NAMED else import_class(name)
    missing = [method for method in TRANSFORMER_METHODS if not callable(getattr(cls, method, None))]
    if missing:
        raise SettingError(
            "Expected a scikit-learn transformer as reducer, for a network a TorchReducer, "
            f"{name} has no {' and no '.join(missing)}."
        )
    return cls


def make_reducer(name: str, **params: Any) -> Any:
    """Make a reducer, which is not fitted yet; importing a user's module runs its code.

    Parameters
    ----------
    name : str
        A name in `REDUCERS`, or `module:Class`.
    **params
        Parameters of its class. For a name in `REDUCERS` the type of each value must fit the
        parameter's default, so `random_state` must be an integer; integers must fit into 32 bits
        (`folds`: from 2 to 1000), and a number must not be NaN. A parameter whose default is None,
        and those of `module:Class`, are not checked. `fit` checks narrower ranges.

    Returns
    -------
    Reducer, or another scikit-learn transformer

    Raises
    ------
    SettingError
        If there is no such name, module or class, the module cannot be imported, or it is no
        scikit-learn transformer; if a parameter is unknown, or a value does not pass the check.
        What the constructor of `module:Class` raises is raised as it is.
    """
    cls = reducer_class(name)
    allowed = signature(cls).parameters
    unknown = sorted(params.keys() - allowed)
    if unknown:
        raise SettingError(
            f"{cls.__name__} has no parameter {', '.join(unknown)}; it has {', '.join(allowed)}."
        )
    if name in _NAMED:
        for key, value in params.items():
            _check_parameter(allowed[key].default, key, value)
    return cls(**params)


def _check_parameter(default: Any, key: str, value: Any) -> None:
    """Raise SettingError unless a reducer's parameter `key` may have this value.

    The value must have the type of `default`; if that is a float, any number but NaN will do.
    `folds` must lie between 2 and 1000, any other integer within 32 bits. If the default is of
    any other type than str, int and float, for example None or a boolean, the value is not checked.
    Without the check, a wrong value would make every retrain fail.
    """
    integers = (2, 1000) if key == "folds" else (-MAX_INTEGER, MAX_INTEGER)
    checks = {
        str: ("a text", isinstance(value, str)),
        int: ("an integer", is_whole(value, *integers)),
        float: ("a number", is_number(value) and value == value),  # no NaN
    }
    expected, fits = checks.get(type(default), ("", True))
    expect(fits, f"{expected} as the reducer's {key}, as {default!r}", value)


def class_default(reducer: Any, name: str) -> Any:
    """Return an attribute of a reducer's class, such as `default_radius`; see `Reducer`.

    The class of a reducer given by name is imported.

    Parameters
    ----------
    reducer : str, type or estimator
        A name in `REDUCERS` or `module:Class`, a class, or an object.
    name : str
        The attribute, which `Reducer` must have.

    Returns
    -------
    object
        Of an object its own attribute. The value of `Reducer` if the class has no such attribute,
        because it is another scikit-learn transformer.

    Raises
    ------
    SettingError
        For a name, as `reducer_class` does.
    """
    cls = reducer_class(reducer) if isinstance(reducer, str) else reducer
    return getattr(cls, name, getattr(__getattr__("Reducer"), name))


def has_own_unit(reducer: Any) -> bool:
    """Return whether the embedding of a reducer is never scaled, see `Reducer.own_unit`.

    Of the reducers of dengine, the first axis is then a predicted probability. `reducer` is a name
    or `module:Class`, whose class is imported, a class or an object. False for a transformer that
    is no `Reducer`. Raises SettingError like `reducer_class`.
    """
    return bool(class_default(reducer, "own_unit"))


REDUCERS: dict[str, Callable[..., Any]] = {name: partial(make_reducer, name) for name in _NAMED}

__getattr__, __dir__, _ = lazy_loader.attach(__name__, submod_attrs=_LAZY)
