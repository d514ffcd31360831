"""A recipe: every setting of an engine, from and to TOML.

    >>> Recipe.load("conv")               # by name, from a file, or as it is
    >>> Recipe.load("my_cell.toml").to_toml()

A run is its recipe, its data and its seed; nothing else changes what it decides.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from .errors import SettingError
from .policy import Neighbourhood, Policy

Params = Mapping[str, bool | int | float | str]


@dataclass(frozen=True)
class Recipe:
    """Every setting of an engine; the reducer checks its own part.

    reducer : a name in `REDUCERS`.  params : the reducer's own settings.
    policy : the user's two numbers, the interval, the audit rate.
    radius, fraction, reject_fraction : the neighbourhood, as in `Neighbourhood`.
    folds : K of honest counting, for a reducer that uses labels.
    retrain_every : new labels between two retrains.
    budget : seconds of wall time that a retrain may take in a live engine.
    max_steps : optimiser steps a retrain at most. A replay stops on them alone, so that a seed repeats exactly.
    window : labelled traces that train and are counted, the newest ones; chosen blind to labels.
    """

    reducer: str = "conv"
    params: Params = field(default_factory=dict)
    policy: Policy = field(default_factory=Policy)
    radius: float = 0.3
    fraction: float | None = None
    reject_fraction: float | None = None
    folds: int = 5
    retrain_every: int = 50
    budget: float = 0.45
    max_steps: int = 60
    window: int = 10_000

    def __post_init__(self) -> None:
        for name, least in (("folds", 2), ("retrain_every", 1), ("max_steps", 0), ("window", 10)):
            value = getattr(self, name)
            if not isinstance(value, int) or isinstance(value, bool) or value < least:
                raise SettingError(f"Expected {name} to be an integer of at least {least}, got {value!r}.")
        if not self.budget > 0.0:
            raise SettingError(f"Expected budget > 0 seconds, got {self.budget!r}.")
        if not isinstance(self.params, Mapping):
            raise SettingError(f"Expected params to be a table of the reducer's settings, got {self.params!r}.")
        Neighbourhood(self.radius, self.fraction, self.reject_fraction)  # or every retrain would fail, one by one

    @classmethod
    def load(cls, recipe: Recipe | str | Path) -> Recipe:
        """A recipe by its name in `RECIPES`, from a TOML file's path, or as it is."""
        if isinstance(recipe, Recipe):
            return recipe
        if str(recipe) in RECIPES:
            return RECIPES[str(recipe)]
        path = Path(recipe)
        if not path.is_file():
            raise SettingError(f"Expected a recipe among {', '.join(RECIPES)}, or a TOML file; {recipe} is neither.")
        return cls.from_toml(path.read_text(encoding="utf-8"), where=str(path))

    @classmethod
    def from_toml(cls, text: str, where: str = "recipe") -> Recipe:
        """Parse `to_toml`'s form; SettingError names an unknown key or a value out of range."""
        try:
            table = tomllib.loads(text)
        except tomllib.TOMLDecodeError as error:
            raise SettingError(f"{where} is not TOML: {error}.") from error
        known = {f.name for f in fields(cls)}
        unknown = sorted(set(table) - known)
        if unknown:
            raise SettingError(f"{where} has an unknown key {', '.join(unknown)}; known are {', '.join(sorted(known))}.")
        base = RECIPES.get(str(table.get("reducer", "conv")), cls())
        policy = table.pop("policy", {})
        try:
            return replace(base, **_without_none(table), policy=replace(base.policy, **policy))
        except TypeError as error:
            raise SettingError(f"{where}: {error}.") from error

    def to_toml(self) -> str:
        """The recipe as TOML; a fixed radius is written as fraction = "none"."""
        plain = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in ("params", "policy")}
        policy = {f.name: getattr(self.policy, f.name) for f in fields(self.policy)}
        tables = {"": plain, "policy": policy, "params": dict(self.params)}
        # An empty [params] is written too: left out, it would mean those of the reducer's own recipe.
        return "\n".join(_table(name, values) for name, values in tables.items())

    def with_policy(self, **changes: Any) -> Recipe:
        """The same with another alpha, lower_bound, interval or audit_rate."""
        return replace(self, policy=replace(self.policy, **changes))


def _without_none(table: Mapping[str, Any]) -> dict[str, Any]:
    return {key: None if value == "none" else value for key, value in table.items()}


def _table(name: str, values: Mapping[str, Any]) -> str:
    head = [f"[{name}]"] if name else []
    return "\n".join(head + [f"{key} = {_value(value)}" for key, value in values.items()]) + "\n"


def _value(value: Any) -> str:
    if value is None:
        return '"none"'
    if isinstance(value, bool | np.bool_):
        return str(bool(value)).lower()
    if isinstance(value, str):
        return '"' + "".join(_escaped(c) for c in value) + '"'
    # A NumPy number's repr names its type, which is not TOML.
    return repr(int(value)) if isinstance(value, int | np.integer) else repr(float(value))


def _escaped(character: str) -> str:
    if character in '\\"' or character < " " or character == "\x7f":
        return f"\\u{ord(character):04X}"
    return character


RECIPES: dict[str, Recipe] = {
    "conv": Recipe("conv", radius=0.05),  # of a probability: the encoder's own unit
    "umap": Recipe("umap"),
    "pca": Recipe("pca", radius=0.2),
    "rocket": Recipe("rocket", radius=0.05),
    # The paper: UMAP, a fixed radius, Wilson, verified and stopped samples stored.
    "paper": Recipe("umap", policy=Policy(alpha=0.1, lower_bound=0.9)),
}
