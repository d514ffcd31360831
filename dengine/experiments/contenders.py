"""Who is played in a replay: dengine by a recipe, or a rival method in the same loop.

>>> Contender.load("conv")                        # a recipe's name, a TOML file, module:Class, a transformer, a Recipe
>>> Contender.load("knn")                         # a name in `rivals.RIVALS`
>>> contenders(["conv", Recipe("conv", radius=0.07)])     # two recipes of one reducer, each with a name of its own
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from inspect import isfunction
from pathlib import Path
from pickle import PicklingError
from typing import Any

from ..engine.engine import DataEngine
from ..engine.settings import flat
from ..errors import SettingError
from ..recipe import PLAIN, RECIPES, Recipe, described
from .rivals import RIVALS, make_rival

TOLD_APART = ("interval", "alpha", "lower_bound", "guarantee", "stops")  # of a policy: columns of their own in every table


@dataclass(frozen=True)
class Contender:
    """What plays a stream.

    name : in tables, pictures and file names.
    recipe : every setting of the engine; of a rival's, those of the loop and the policy that the rival is made with.
    rival : a name in `RIVALS` that decides in place of reducer and neighbours, with the settings that were chosen for it
        where it is loaded by name; None: the recipe's reducer does.
    params : the rival's own settings.
    """

    name: str
    recipe: Recipe
    rival: str | None = None
    params: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def load(cls, asked: Any) -> Contender:
        """From a contender, the name of a rival, or anything that `Recipe.load` takes. SettingError for all else."""
        if isinstance(asked, Contender):
            return asked
        if isinstance(asked, str) and asked in RIVALS:
            rival = RIVALS[asked]
            return cls(asked, Recipe(), asked, rival.tries[rival.chosen])
        recipe = Recipe.load(asked)
        by_name = isinstance(asked, str | os.PathLike) and (str(asked) in RECIPES or Path(asked).is_file())
        return cls(Path(asked).stem if by_name else recipe.name, recipe)

    def with_policy(self, **changes: Any) -> Contender:
        """The same with another alpha, lower_bound, interval, guarantee or stops."""
        return replace(self, recipe=self.recipe.with_policy(**changes))

    def engine(self, seed: int) -> DataEngine:
        """A fresh engine in memory that repeats exactly under a seed."""
        rival = None if self.rival is None else make_rival(self.rival, self.recipe.policy, seed, **self.params)
        return DataEngine(recipe=self.recipe, model=rival, seed=seed, replaying=True)

    @property
    def description(self) -> str:
        """All that its decisions depend on, beside data and seed, as text that is the same at every start."""
        own = self.recipe.reducer
        handed_in = "" if isinstance(own, str) else f"\n{described(own)}\n{_digest_of(own)}"
        return f"{self.recipe.to_toml()}{handed_in}\n{self.rival} {sorted(self.params.items())}"


def contenders(asked: Sequence[Any]) -> list[Contender]:
    """Each as it was asked for, under a name of its own: equal names are followed by the settings in which they differ.

    Recipes that differ in `TOLD_APART` alone keep one name. Transformers whose settings read alike, as two functions of one
    name, are numbered. SettingError where two do not differ at all.
    """
    loaded = [Contender.load(one) for one in ([asked] if isinstance(asked, str) else asked)]
    names = [one.name for one in loaded]
    return _numbered([one if names.count(one.name) == 1 else _apart(one, loaded) for one in loaded])


def parts_of(reducer: Any) -> list[Any]:
    """The classes of a transformer and of the estimators that it is made of, and its functions."""
    held = reducer.get_params(deep=True).values()
    kinds = [type(part) for part in [reducer, *(each for each in held if hasattr(each, "fit"))]]
    return list(dict.fromkeys([*kinds, *(each for each in held if isfunction(each))]))


def _digest_of(reducer: Any) -> str:
    """Of all that a transformer holds: arrays and functions too, which its description only names."""
    from joblib import hash as digest

    try:
        return str(digest(reducer))
    except (PicklingError, TypeError, AttributeError) as error:
        raise SettingError(
            f"Expected a reducer that can be told apart from others, to keep its replays; {described(reducer)} holds what "
            f"has no name in a module, as a lambda ({error}); define it in a module, or leave keep out."
        ) from error


def _numbered(named: list[Contender]) -> list[Contender]:
    """The same, with a number behind each name that several transformers would share."""
    held: dict[str, dict[int, int]] = {}
    for one in named:
        if not isinstance(one.recipe.reducer, str):
            known = held.setdefault(one.name, {})
            known.setdefault(id(one.recipe.reducer), 1 + len(known))
    shared = {name for name, known in held.items() if len(known) > 1}
    return [
        replace(one, name=f"{one.name} {held[one.name][id(one.recipe.reducer)]}") if one.name in shared else one
        for one in named
    ]


def _apart(one: Contender, among: Sequence[Contender]) -> Contender:
    rivals = [other for other in among if other.name == one.name and other is not one]
    if any(one == other for other in rivals):
        raise SettingError(f"Expected each to be asked for once, got {one.name} twice with the same settings.")
    own, others = _flat(one), [_flat(other) for other in rivals]
    differing = [key for key in own if any(other.get(key) != own[key] for other in others)]
    return replace(one, name=" ".join([one.name, *(f"{key}={own[key]}" for key in differing)]))


def _flat(one: Contender) -> dict[str, Any]:
    """Every setting by its name, without those that have columns of their own."""
    plain = {key: value for key, value in flat(one.recipe).items() if key not in (*TOLD_APART, "params")}
    own = plain["reducer"]
    if not isinstance(own, str):
        plain |= {"reducer": type(own).__name__} | {key: _short(value) for key, value in own.get_params().items()}
    return {**plain, **one.recipe.params, **one.params}


def _short(value: Any) -> Any:
    """A transformer's setting as a name can show it: a part of its own, or a function, by what it is called."""
    return value if isinstance(value, PLAIN) or value is None else getattr(value, "__name__", type(value).__name__)
