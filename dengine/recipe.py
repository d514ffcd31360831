"""A recipe: every setting of an engine, from and to TOML.

    >>> Recipe.load("conv")               # by name, from a file, or as it is
    >>> Recipe.load("my_cell.toml").to_toml()

A run is its recipe, its data and its seed; nothing else changes what it decides.
"""

from __future__ import annotations

import json
import os
import re
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from inspect import signature
from pathlib import Path
from typing import Any

import numpy as np

from .decision.policy import Policy, check_radius
from .errors import SettingError, StoreError, expect, instead, listed
from .records import is_number, is_whole
from .reducers import make_reducer, own_default, reducer_class

Params = Mapping[str, bool | int | float | str]
OWN = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")  # module:Class
BARE = re.compile(r"[A-Za-z0-9_-]+")  # a name that TOML takes without quotes
PLAIN = (bool, int, float, str, np.bool_, np.integer, np.floating)
NOVELTY = 1.5
LARGEST = 2**20  # bytes of a recipe's file
WHOLE = {  # the least and the most; beyond the latter no machine goes, and an error now is better than one at each retrain
    "folds": (2, 1000),
    "max_steps": (0, 10**9),
    "window": (10, 10**8),
}
OBJECT = "object "  # before the class of a reducer that TOML cannot say


class OwnDefault:
    """A field of `Recipe` whose default belongs to the reducer: None reads as what the reducer's class says.

    It is looked up when it is read, so that naming a reducer imports nothing.

    Parameters
    ----------
    name : str
        Attribute of the reducer's class, `default_radius` say; see `Reducer`.
    check : callable
        Raises SettingError for a value out of range.
    """

    def __init__(self, name: str, check: Callable[[Any], None]) -> None:
        self.name = name
        self.check = check

    def __set_name__(self, owner: type, field_name: str) -> None:
        self.field_name = field_name

    def __get__(self, recipe: Recipe | None, owner: type) -> Any:
        if recipe is None:
            return None  # the default, as `dataclass` reads it
        value = vars(recipe)[self.field_name]
        if value is None:
            value = own_default(recipe.reducer, self.name)
            self.check(value)
        return value

    def __set__(self, recipe: Recipe, value: Any) -> None:
        if value is not None:
            self.check(value)  # or every retrain would fail, one by one
        vars(recipe)[self.field_name] = value


def _check_retrain_every(value: Any) -> None:
    at_least = "retrain_every to be an integer of at least 1"
    expect(is_whole(value, 1, 10**9), at_least, value, "at most 1,000,000,000")


@dataclass(frozen=True)
class Recipe:
    """Every setting of an engine; the reducer checks its own part.

    reducer : a name in `REDUCERS`, `module:Class` of your own, or a scikit-learn transformer as it is.
    params : the reducer's own settings, where it is a name.
    policy : the user's two numbers, the interval, the rule, the audit rate.
    radius : of the ball whose labels count, in units of the scaled embedding; None: the reducer's
        own, `default_radius`.
    folds : K of honest counting, for a reducer that uses labels.
    retrain_every : new labels between two retrains; None: the reducer's own, `default_retrain_every`.
    budget : seconds of wall time that a retrain may take in a live engine.
    max_steps : optimiser steps of a retrain at most; None: the reducer's own. A replay stops on steps alone.
    window : labelled traces that train and are counted, the newest ones; chosen blind to labels.
    novelty : a trace is novel where its squared distance to the nearest learned one, by any of four measures, is
        more than so many times that which 99.5 % of these have from one another; 0: nothing is novel.
    """

    reducer: Any = "conv"
    params: Params = field(default_factory=dict)
    policy: Policy = field(default_factory=Policy)
    radius: float = OwnDefault("default_radius", check_radius)  # type: ignore[assignment]
    folds: int = 5
    retrain_every: int = OwnDefault("default_retrain_every", _check_retrain_every)  # type: ignore[assignment]
    budget: float = 0.45
    max_steps: int | None = None
    window: int = 10_000
    novelty: float = NOVELTY

    def __post_init__(self) -> None:
        for name, (least, most) in WHOLE.items():
            value = getattr(self, name)
            held = is_whole(value, least, most) or (name == "max_steps" and value is None)
            expect(held, f"{name} to be an integer of at least {least}", value, f"at most {most:,}")
        expect(is_number(self.budget) and self.budget > 0.0, "budget > 0 seconds", self.budget)
        novelty = is_number(self.novelty) and 0.0 <= self.novelty < float("inf")
        expect(novelty, "a finite novelty of 0 or more", self.novelty, "0 turns it off")
        expect(isinstance(self.params, Mapping), "params to be a table of the reducer's settings", self.params)
        for name, value in self.params.items():
            held = (value is None or isinstance(value, PLAIN)) and BARE.fullmatch(str(name)) is not None
            expect(held, "params of plain names and values", {name: value}, "hand an object in")
        named = isinstance(self.reducer, str) or all(hasattr(self.reducer, each) for each in ("fit", "get_params"))
        expect(named, "a reducer's name, or a scikit-learn transformer with fit and get_params", self.reducer)
        expect(isinstance(self.policy, Policy), "policy to be a Policy", self.policy)

    @property
    def name(self) -> str:
        """What to call it in a table: its reducer."""
        return self.reducer if isinstance(self.reducer, str) else type(self.reducer).__name__

    @property
    def own_classes(self) -> list[str]:
        """Each `module:Class` that it names, of its reducer and its rule, and that is not of the package."""
        names = (_named(self.reducer, self.params)[0], self.policy.guarantee)
        return [name for name in names if ":" in name and not name.startswith("dengine.reducers.")]

    @classmethod
    def load(cls, recipe: Any) -> Recipe:
        """A recipe by its name in `RECIPES`, from a TOML file's path, for a reducer of your own, or as it is.

        A reducer of your own is `module:Class`, or a scikit-learn transformer.
        """
        if isinstance(recipe, Recipe):
            return recipe
        if not isinstance(recipe, str | os.PathLike):
            fits = callable(getattr(recipe, "fit", None)) and not isinstance(recipe, type)
            expect(fits, "a recipe, its name, or a scikit-learn transformer", recipe)
            return cls(recipe)
        if str(recipe) in RECIPES:
            return RECIPES[str(recipe)]
        text = _text_of(Path(recipe))
        if text is not None:
            return cls.from_toml(text, where=str(recipe))
        if OWN.fullmatch(str(recipe)):
            return cls(str(recipe))
        wanted = f"a recipe among {', '.join(RECIPES)}, a TOML file, or module:Class of a reducer"
        raise SettingError(f"Expected {wanted}; {str(recipe)[:200]} is none.")

    @classmethod
    def from_toml(cls, text: str, where: str = "recipe") -> Recipe:
        """Parse `to_toml`'s form; SettingError names an unknown key or a value out of range."""
        with instead(SettingError, f"{where} is not TOML", ValueError, RecursionError):  # the former of huge integers, too
            table = tomllib.loads(text)
        _must_be_known(table, cls, where)
        reducer, policy = table.get("reducer", "conv"), table.pop("policy", {})
        expect(isinstance(reducer, str), f"in {where} reducer to be a name, or module:Class", reducer)
        expect(isinstance(policy, Mapping), f"in {where} policy to be a table, [policy]", policy)
        _must_be_known(policy, Policy, f"{where}, policy,")
        if isinstance(table.get("params"), Mapping):
            table["params"] = _without_none(table["params"])
        try:
            return cls(**_without_none(table), policy=Policy(**policy))
        except (TypeError, SettingError) as error:
            raise SettingError(f"{where}: {str(error).rstrip('.')}.") from error

    @classmethod
    def from_store(cls, settings: Mapping[str, str], where: str = "the recipe in the store") -> Recipe:
        """Parse the recipe that a store keeps, without importing a class that it names.

        Raises StoreError where such a class would have to be asked for its radius: the store is damaged.
        """
        recipe = cls.from_toml(settings["recipe"], where)
        missing = [name for name in ("radius", "retrain_every") if vars(recipe)[name] is None]
        if missing and str(recipe.reducer) not in RECIPES:
            got = f"a recipe of {recipe.name} without {listed(missing)}"
            raise StoreError(f"Expected {where} to hold every setting, got {got}; restore the store from a copy.")
        return recipe

    def to_toml(self) -> str:
        """The recipe as TOML; None is written as "none".

        A reducer object is written as `module:Class` and its parameters; where those are no plain values, as in a pipeline,
        as "object Class": it must be handed in again.
        """
        plain = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in ("params", "policy")}
        plain["reducer"], params = _named(self.reducer, self.params)
        policy = {f.name: getattr(self.policy, f.name) for f in fields(self.policy)}
        tables = {"": plain, "policy": policy, "params": dict(params)}
        # An empty [params] is written too: left out, it would mean those of the reducer's own recipe.
        return "\n".join(_table(name, values) for name, values in tables.items())

    def with_settings(self, **asked: Any) -> Recipe:
        """The same with what was asked for; None asks for nothing."""
        return replace(self, **{name: value for name, value in asked.items() if value is not None})

    def with_policy(self, **changes: Any) -> Recipe:
        """The same with another alpha, lower_bound, interval or audit_rate."""
        return replace(self, policy=replace(self.policy, **changes))

    def make_reducer(self, seed: int) -> Any:
        """Return the reducer: an object as it is, or one made by its name.

        One that is made gets the seed and the folds, where it takes them.
        """
        if not isinstance(self.reducer, str):
            return self.reducer
        known = signature(reducer_class(self.reducer)).parameters
        # A reducer that cross-fits by itself takes the folds; any other is cross-fitted from outside.
        own = {name: value for name, value in (("random_state", seed), ("folds", self.folds)) if name in known}
        return make_reducer(self.reducer, **own | dict(self.params))


def _must_be_known(table: Mapping[str, Any], of: Any, where: str) -> None:
    """SettingError for a key that is no field of this record."""
    known = {f.name for f in fields(of)}
    unknown = sorted(set(table) - known)
    if unknown:
        raise SettingError(f"{where} has an unknown key {listed(unknown)}; known are {', '.join(sorted(known))}.")


def _text_of(path: Path) -> str | None:
    """The text of a recipe's file; None where there is none. SettingError for what is no text, or cannot be read."""
    try:
        if not path.is_file():
            return None
        if path.stat().st_size > LARGEST:
            raise SettingError(f"Expected a recipe of at most {LARGEST // 2**20} MB, {path} is larger.")
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise SettingError(f"{path} is not UTF-8 text: {error.reason} at byte {error.start}; save it as UTF-8.") from error
    except OSError as error:  # a name that is too long among them
        raise SettingError(f"Cannot read the recipe {str(path)[:200]}: {error.strerror}.") from error


def _named(reducer: Any, params: Params) -> tuple[str, Params]:
    """A reducer as TOML can say it: a name and plain parameters."""
    if isinstance(reducer, str):
        return reducer, params
    kind = type(reducer)
    own: dict[str, Any] = reducer.get_params(deep=False)
    defaults = {name: each.default for name, each in signature(kind).parameters.items()}
    plain = all(isinstance(v, PLAIN) or (v is None and defaults.get(k) is None) for k, v in own.items())
    if not plain or "<locals>" in kind.__qualname__ or kind.__module__ == "__main__":
        return f"{OBJECT}{kind.__name__}", {}
    return f"{kind.__module__}:{kind.__qualname__}", {name: value for name, value in own.items() if value is not None}


def described(thing: Any) -> str:
    """An estimator's class and settings, nested ones included, as text that is the same at every start."""
    settings = thing.get_params(deep=True)
    values = (
        f"{name}={value!r}" if isinstance(value, PLAIN) or value is None else f"{name}: {type(value).__qualname__}"
        for name, value in sorted(settings.items())
    )
    return f"{type(thing).__qualname__}({', '.join(values)})"


def _without_none(table: Mapping[str, Any]) -> dict[str, Any]:
    return {key: None if value == "none" else value for key, value in table.items()}


def _table(name: str, values: Mapping[str, Any]) -> str:
    return "".join([f"[{name}]\n" * bool(name), *(f"{key} = {_value(value)}\n" for key, value in values.items())])


def _value(value: Any) -> str:
    if value is None or isinstance(value, str):  # a string is written as in JSON, but for one character
        return json.dumps("none" if value is None else value, ensure_ascii=False).replace("\x7f", "\\u007F")
    if isinstance(value, tuple):  # of windows, or prices
        return f"[{', '.join(_value(each if isinstance(each, PLAIN) else str(each)) for each in value)}]"
    plain = value.item() if isinstance(value, np.generic) else value  # NumPy's repr names its type, which is not TOML
    return str(plain).lower() if isinstance(plain, bool) else repr(plain)


RECIPES: dict[str, Recipe] = {
    **{name: Recipe(name) for name in ("conv", "umap", "umap-learn", "pca", "rocket")},
    # The paper: UMAP, a fixed radius, Wilson, verified and stopped samples stored; it asks nothing else of a trace.
    "paper": Recipe("umap", policy=Policy(alpha=0.1, lower_bound=0.9), novelty=0.0),
}
