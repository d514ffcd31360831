"""`Recipe`, every setting of an engine, read from and written to TOML, and the named `RECIPES`.
Engines, replays and the command line take one, and a store keeps it as TOML.

    >>> Recipe.load("conv")  # a name in `RECIPES`, a TOML file, or a Recipe
    >>> Recipe.load("my_cell.toml").to_toml()

The decisions of a run follow from its recipe, its data and its seed; nothing else changes them.
"""

from __future__ import annotations

import os
import re
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import partial
from inspect import signature
from pathlib import Path
from types import NoneType
from typing import Any

import numpy as np

from .decision.policy import OLD_NAME, Policy, check_radius
from .errors import SettingError, StoreError, expect, instead, listed
from .files import toml_value
from .records import StoredSettings, is_number, is_whole
from .reducers import REDUCERS, class_default, make_reducer, reducer_class

Params = Mapping[str, bool | int | float | str]
Table = Mapping[str, Any]  # of a TOML file
CLASS_PATH = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")  # module:Class
BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")  # a key that TOML takes without quotes
PLAIN = (bool, int, float, str, np.bool_, np.integer, np.floating, NoneType)
NOVELTY = 1.5
LARGEST = 2**20  # bytes of a recipe's file
# Least and greatest value of the integer settings. No machine can use more, and an error now is
# better than one at each retrain.
INTEGER_RANGES = {
    "folds": (2, 1000),
    "retrain_every": (1, 10**9),
    "max_steps": (0, 10**9),
    "window": (10, 10**8),
}
OBJECT_PREFIX = "object "  # before the class name of a reducer that TOML cannot describe


class ReducerDefault:
    """Descriptor of a field of `Recipe` whose default is an attribute of the reducer's class.

    If the field `radius` is None, reading it gives the `default_radius` of the class, see
    `Reducer`. The class is imported only then, so that naming a reducer imports nothing;
    SettingError if it cannot be imported. The field itself stays None.

    Parameters
    ----------
    check : callable
        Raises SettingError for a value out of range. It is called with each value but None that the
        field is set to, and with each default that is read.
    """

    def __init__(self, check: Callable[[Any], None]) -> None:
        self.check = check

    def __set_name__(self, owner: type, field_name: str) -> None:
        self.field_name = field_name

    def __get__(self, recipe: Recipe | None, owner: type) -> Any:
        """Return the field's value, or the reducer's checked default if that is None.

        Read from the class itself it is None. Raises SettingError if the reducer's class cannot be
        imported, or its default is refused.
        """
        if recipe is None:
            return None  # the default, as `dataclass` reads it
        value = vars(recipe)[self.field_name]
        if value is None:
            value = class_default(recipe.reducer, f"default_{self.field_name}")
            self.check(value)
        return value

    def __set__(self, recipe: Recipe, value: Any) -> None:
        """Set the field, after the check; None is set without a check."""
        if value is not None:
            self.check(value)  # or every retrain would fail, one by one
        vars(recipe)[self.field_name] = value


def _check_integer(name: str, value: Any) -> None:
    """Raise SettingError for a value that the integer setting `name` of a recipe cannot have.

    A recipe is all settings of an engine. The value must be an integer, not a boolean, in the range
    that `INTEGER_RANGES` has for the name, both ends included.
    """
    least, most = INTEGER_RANGES[name]
    expect(
        is_whole(value, least, most),
        f"{name} to be an integer of at least {least}",
        value,
        f"at most {most:,}",
    )


@dataclass(frozen=True)
class Recipe:
    """Every setting of an engine.

    Parameters
    ----------
    reducer : str or estimator, default "conv"
        A name in `REDUCERS`, `module:Class` of your own, or a scikit-learn transformer.
    params : mapping, default {}
        Parameters of the reducer, if it is given by name. The names consist of letters, digits,
        `_` and `-`; the values are booleans, numbers, texts but "none", or None. The reducer checks
        them when it is made.
    policy : Policy
        Error level, lower bound, interval, decision rule, audit rate.
    radius : float, optional
        Radius of the neighbourhood whose labels count, in units of the scaled embedding. None:
        the reducer's `default_radius`.
    folds : int, default 5
        Number of folds, and of spaces, of a reducer that trains with labels; 2 to 1000.
    retrain_every : int, optional
        New labels between two retrains. None: the reducer's `default_retrain_every`.
    budget : float, default 0.45
        Seconds of wall time that a retrain may take in a live engine.
    max_steps : int, optional
        Optimiser steps of a retrain at most. None: the reducer's own limit. A replay stops on
        steps alone, so that it repeats exactly.
    window : int, default 10_000
        Number of the newest labelled traces, good or bad, that are used in training and counted; at
        least 10.
    novelty : float, default 1.5
        Factor of the limits of novelty. A trace is novel if its squared distance to the nearest
        learned trace is above a limit, by any of four measures. The limit is this factor times the
        99.5 % quantile of the squared distances from the learned traces to the nearest other ones.
        0: no trace is novel.

    Raises
    ------
    SettingError
        For a value out of its range or of another type. Whether a named reducer exists is only
        found out when its class is imported.
    """

    reducer: Any = "conv"
    params: Params = field(default_factory=dict)
    policy: Policy = field(default_factory=Policy)
    # The descriptor gives a value of this type when it is read.
    radius: float = ReducerDefault(check_radius)  # type: ignore[assignment]
    folds: int = 5
    retrain_every: int = ReducerDefault(  # type: ignore[assignment]
        partial(_check_integer, "retrain_every")
    )
    budget: float = 0.45
    max_steps: int | None = None
    window: int = 10_000
    novelty: float = NOVELTY

    def __post_init__(self) -> None:
        _check_integer("folds", self.folds)
        _check_integer("window", self.window)
        if self.max_steps is not None:
            _check_integer("max_steps", self.max_steps)
        expect(is_number(self.budget) and self.budget > 0.0, "budget > 0 seconds", self.budget)
        expect(
            is_number(self.novelty) and 0.0 <= self.novelty < float("inf"),
            "a finite novelty of 0 or more",
            self.novelty,
            "0 turns it off",
        )
        expect(
            isinstance(self.params, Mapping),
            "params to be a table of the reducer's settings",
            self.params,
        )
        for name, value in self.params.items():
            expect(
                isinstance(value, PLAIN)
                and value != "none"
                and BARE_KEY.fullmatch(str(name)) is not None,
                "params of plain names and values",
                {name: value},
                "hand an object in",
            )
        expect(
            isinstance(self.reducer, str)
            or (hasattr(self.reducer, "fit") and hasattr(self.reducer, "get_params")),
            "a reducer's name, or a scikit-learn transformer with fit and get_params",
            self.reducer,
        )
        expect(isinstance(self.policy, Policy), "policy to be a Policy", self.policy)

    @property
    def name(self) -> str:
        """Name of the recipe in tables: the text that names its reducer, like "conv" or
        `module:Class`, or the class name of an object.
        """
        return self.reducer if isinstance(self.reducer, str) else type(self.reducer).__name__

    @property
    def user_classes(self) -> list[str]:
        """The user's own classes as `module:Class`: the reducer's, then the decision rule's.

        The decision rule is `policy.guarantee`. Classes below `dengine.reducers` and names like
        "conv" or "local" are left out, so the list may be empty; a class elsewhere in dengine
        counts as the user's. A reducer that is an object is named if `to_toml` writes it as
        `module:Class`.
        """
        return [
            name
            for name in (_name_and_params(self.reducer, self.params)[0], self.policy.guarantee)
            if ":" in name and not name.startswith("dengine.reducers.")
        ]

    @classmethod
    def load(cls, recipe: Any) -> Recipe:
        """Return a recipe, which holds every setting of an engine.

        Parameters
        ----------
        recipe : str, path, Recipe or estimator
            A name in `RECIPES`, the recipes of dengine; the path of a TOML file; a Recipe, which is
            returned unchanged; or a reducer (a transformer from traces to points) of your own,
            which gets the default settings: `module:Class`, which is not imported here, or a
            scikit-learn transformer. A text or path is first taken as a name, then as a path, then
            as `module:Class`.

        Raises
        ------
        SettingError
            For anything else, and for a file that cannot be read, has more than 1 MB, is not UTF-8
            or is no recipe.
        """
        if isinstance(recipe, Recipe):
            return recipe
        if not isinstance(recipe, str | os.PathLike):
            expect(
                callable(getattr(recipe, "fit", None)) and not isinstance(recipe, type),
                "a recipe, its name, or a scikit-learn transformer",
                recipe,
            )
            return cls(recipe)
        name = str(recipe)
        if name in RECIPES:
            return RECIPES[name]
        text = _read_text(Path(recipe))
        if text is not None:
            return cls.from_toml(text, where=name)
        if CLASS_PATH.fullmatch(name):
            return cls(name)
        raise SettingError(
            f"Expected a recipe among {', '.join(RECIPES)}, a TOML file, or module:Class of a "
            f"reducer; {name[:200]} is none, and no file."
        )

    @classmethod
    def from_toml(cls, text: str, where: str = "recipe") -> Recipe:
        """Parse the text that `to_toml` writes, and return the recipe.

        Settings that are missing get their defaults, and "none" is read as None, but not in
        [policy], which has no None. The policy's "windows", the name in earlier versions, is read
        as "force_limits". No class is imported, so an unknown reducer or `module:Class` is not
        noticed here. Raises SettingError for text that is not TOML, an unknown key or a value out
        of range. `where` is the recipe's name in errors.
        """
        # tomllib raises ValueError for huge integers, too.
        with instead(SettingError, f"{where} is not TOML", ValueError, RecursionError):
            table = tomllib.loads(text)
        _check_keys(table, cls, where)
        policy = table.pop("policy", {})
        expect(isinstance(policy, Mapping), f"in {where} policy to be a table, [policy]", policy)
        policy = {"force_limits" if name == OLD_NAME else name: policy[name] for name in policy}
        _check_keys(policy, Policy, f"{where}, policy,")
        if isinstance(table.get("params"), Mapping):
            table["params"] = _with_none(table["params"])
        try:
            return cls(**_with_none(table), policy=Policy(**policy))
        except (TypeError, SettingError) as error:
            raise SettingError(f"{where}: {str(error).rstrip('.')}.") from error

    @classmethod
    def from_store(cls, settings: StoredSettings, where: str = "the recipe in the store") -> Recipe:
        """Parse the recipe in the settings of a store, ``settings["recipe"]``, and return it.

        A recipe holds every setting of an engine. `settings` has texts by name. No class of a
        reducer (a transformer from traces to points) is imported. The defaults of the settings
        `radius` and `retrain_every` are attributes of the reducer's class, so the stored recipe
        must have both, unless the reducer is a name in `RECIPES`, the recipes of dengine itself:
        else StoreError is raised, because the store is damaged. Raises SettingError for a text that
        is no recipe, and KeyError if the settings have no recipe. `where` is the recipe's name in
        errors.
        """
        recipe = cls.from_toml(settings["recipe"], where)
        missing = [name for name in ("radius", "retrain_every") if vars(recipe)[name] is None]
        if missing and str(recipe.reducer) not in RECIPES:
            raise StoreError(
                f"Expected {where} to hold every setting, got a recipe of {recipe.name} without "
                f"{listed(missing)}; restore the store from a copy."
            )
        return recipe

    def to_toml(self) -> str:
        """Return the recipe, every setting of an engine, as TOML; None is written as "none".

        If `radius` or `retrain_every` is None, the class of the reducer (it maps traces to points)
        is imported, and its default is written. For a reducer given by name the recipe's `params`
        are written, and no defaults. A reducer object is written as `module:Class` with its
        parameters that are not None. If a parameter is no text, number or boolean, like the steps
        of a pipeline, if it is the text "none", or if it is None although its default is not, or if
        the class is local or stands in `__main__`, the object is written as "object Class", and the
        user must hand it in again. Raises SettingError if the class of a named reducer must be
        imported, and cannot be, or if its default is out of range.
        """
        plain = {f.name: getattr(self, f.name) for f in fields(self)}
        plain["reducer"], params = _name_and_params(self.reducer, self.params)
        del plain["params"], plain["policy"]
        tables = {
            "": plain,
            "policy": {f.name: getattr(self.policy, f.name) for f in fields(self.policy)},
            "params": params,
        }
        # An empty [params] is written too: left out, it would mean those of the reducer's recipe.
        return "\n".join(_table_text(name, values) for name, values in tables.items())

    def with_settings(self, **settings: Any) -> Recipe:
        """Return a copy with these settings; arguments that are None change nothing.

        A `radius` or `retrain_every` that is None in this recipe becomes the default of the
        reducer that it has now, also if `settings` have another reducer. Raises SettingError for a
        value out of range, and if the class of this reducer must be imported for that, and cannot
        be; TypeError for an unknown setting.
        """
        return replace(self, **without_none(settings))

    def with_policy(self, **changes: Any) -> Recipe:
        """Return a copy whose policy has these settings changed, as `Policy.changed` does.

        A `radius` or `retrain_every` that is None in this recipe becomes the reducer's default.
        Raises SettingError for a policy's value out of range, and if the class of the reducer must
        be imported for its defaults, and cannot be; TypeError for an unknown setting.
        """
        return replace(self, policy=self.policy.changed(**changes))

    def make_reducer(self, seed: int) -> Any:
        """Return the reducer: the object itself if one was given, or a new one, made by name.

        The class of a named reducer is imported. If it has a parameter `random_state` or `folds`,
        that gets the seed or the recipe's `folds` (the number of groups for cross-fitting); the
        recipe's `params` take precedence. Raises SettingError if the class cannot be imported,
        whatever `Exception` its module raises, or is no scikit-learn transformer, if it lacks one
        of these `params`, or if the value of one, or the seed, does not fit a reducer of dengine;
        what the constructor of a user's class raises passes unchanged.
        """
        if not isinstance(self.reducer, str):
            return self.reducer
        # A reducer that cross-fits itself takes the folds; any other is cross-fitted from outside.
        defaults = {"random_state": seed, "folds": self.folds}
        accepted = signature(reducer_class(self.reducer)).parameters
        params = {name: value for name, value in defaults.items() if name in accepted}
        return make_reducer(self.reducer, **{**params, **self.params})


def _check_keys(table: Table, record_type: Any, where: str) -> None:
    """Raise SettingError if a table of TOML has a key that is no field of a dataclass.

    `record_type` is the dataclass. The message begins with `where` and lists the fields.
    """
    names = sorted(f.name for f in fields(record_type))
    unknown = sorted(table.keys() - names)
    if unknown:
        raise SettingError(
            f"{where} has an unknown key {listed(unknown)}; known are {', '.join(names)}."
        )


def _read_text(path: Path) -> str | None:
    """Return the text of a recipe's file; None if there is no regular file at `path`.

    A recipe holds all settings of an engine. Raises SettingError if the file is larger than 1 MB,
    is not UTF-8 or cannot be read.
    """
    with (  # an OSError among them is a name that is too long
        instead(SettingError, f"Cannot read the recipe {str(path)[:200]}", OSError),
        instead(
            SettingError, f"{path} is not UTF-8 text", UnicodeDecodeError, do="save it as UTF-8"
        ),
    ):
        if not path.is_file():
            return None
        if path.stat().st_size > LARGEST:
            raise SettingError(
                f"Expected a recipe of at most {LARGEST // 2**20} MB, {path} is larger."
            )
        return path.read_text(encoding="utf-8")


def _name_and_params(reducer: Any, params: Params) -> tuple[str, Params]:
    """Return a reducer in a form for TOML: a name, and parameters that are plain values.

    Plain values are booleans, numbers and texts. A name is returned unchanged, with `params`. For
    an estimator the result is the `module:Class` of its class and its `get_params(deep=False)`,
    without those that are None. It is "object Class" and no parameters if a parameter is no plain
    value or is the text "none", or is None though its default is not, or if the class is local or
    stands in `__main__`.
    """
    if isinstance(reducer, str):
        return reducer, params
    cls = type(reducer)
    values: Table = reducer.get_params(deep=False)
    defaults = {name: parameter.default for name, parameter in signature(cls).parameters.items()}
    is_plain = all(
        isinstance(value, PLAIN)
        and value != "none"
        and (value is not None or defaults.get(name) is None)
        for name, value in values.items()
    )
    if not is_plain or "<locals>" in cls.__qualname__ or cls.__module__ == "__main__":
        return f"{OBJECT_PREFIX}{cls.__name__}", {}
    return f"{cls.__module__}:{cls.__qualname__}", without_none(values)


def without_none(values: Table) -> dict[str, Any]:
    """Return the items of a mapping whose value is not None, as a new dict."""
    return {name: value for name, value in values.items() if value is not None}


def describe_estimator(estimator: Any) -> str:
    """Return an estimator as text: its class and all parameters, also nested ones, sorted by name.

    It looks like `MyReducer(kind='a', width=3)`. Of a value that is no boolean, number, text or
    None only the value's class is named, like `steps: list`, so that the text is the same in every
    process.
    """
    values = (
        f"{name}={value!r}" if isinstance(value, PLAIN) else f"{name}: {type(value).__qualname__}"
        for name, value in sorted(estimator.get_params(deep=True).items())
    )
    return f"{type(estimator).__qualname__}({', '.join(values)})"


def _with_none(table: Table) -> dict[str, Any]:
    """Return a table with None in the place of each "none"."""
    return {key: None if value == "none" else value for key, value in table.items()}


def _table_text(name: str, values: Table) -> str:
    """Return a table of TOML: its header, unless the name is "", and a line for each value.

    None becomes "none".
    """
    heading = f"[{name}]\n" if name else ""
    return heading + "".join(
        f"{key} = {toml_value('none' if value is None else value)}\n"
        for key, value in values.items()
    )


RECIPES: dict[str, Recipe] = {
    **{name: Recipe(name) for name in REDUCERS},
    # The paper: UMAP, a fixed radius, Wilson, verified and stopped samples stored, no novelty.
    "paper": Recipe("umap", policy=Policy(alpha=0.1, lower_bound=0.9), novelty=0.0),
}
