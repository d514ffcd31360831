"""What an engine is, apart from what it has learned: the settings that it was made with, and that its store keeps."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, Self

from . import __version__
from .decision.policy import Policy
from .errors import SettingError, StoreError
from .model.base import EngineModel
from .recipe import OBJECT, Recipe
from .records import TraceSpec


@dataclass(frozen=True, slots=True)
class EngineSettings:
    """An engine's settings.

    recipe : as it is in force.  seed : of the reducer and of the audits' coin.
    model : what a model that was handed in is called; None: the recipe describes the model.
    trace : the traces' contract; None until the first trace.
    """

    recipe: Recipe
    seed: int = 0
    model: str | None = None
    trace: TraceSpec | None = None

    def to_store(self) -> dict[str, str]:
        """As `Store.save_settings` takes them."""
        known = {"recipe": self.recipe.to_toml(), "seed": str(self.seed), "dengine": __version__}
        if self.model is not None:
            known["model"] = self.model
        if self.trace is not None:
            known["trace"] = json.dumps(asdict(self.trace))
        return known

    @classmethod
    def from_store(cls, known: Mapping[str, str], name: str, reducer: Any = None, model: Any = None) -> Self:
        """What `to_store` gave. name : of the store, for errors.

        reducer, model : objects that the store cannot bring back, handed in again. Raises StoreError for a store that no
        engine has used, SettingError where an object is missing.
        """
        if "recipe" not in known:
            raise StoreError(f"Expected a store that an engine has used, {name} is empty; make a DataEngine with it.")
        if "model" in known and model is None:
            raise SettingError(f"The engine of {name} drove a {known['model']}; hand it in again: open(url, model=...).")
        recipe = Recipe.from_toml(known["recipe"], f"the recipe in {name}")
        if reducer is not None and not isinstance(reducer, str):
            recipe = replace(recipe, reducer=reducer, params={})
        elif str(recipe.reducer).startswith(OBJECT):
            raise SettingError(
                f"The reducer of {name}, {recipe.reducer}, has no name in TOML: hand it in again, open(url, reducer=...)."
            )
        trace = TraceSpec(**json.loads(known["trace"])) if "trace" in known else None
        return cls(recipe, int(known["seed"]), known.get("model"), trace)

    def with_model(self, model: EngineModel) -> Self:
        """The same for a model that was handed in: of our own kind its numbers count, a rival's are its own affair."""
        own = model.policy
        changes = {} if own is None else {"alpha": own.alpha, "lower_bound": own.lower_bound, "interval": own.interval}
        return replace(self, recipe=self.recipe.with_policy(**changes), model=model.name)

    def must_agree_with(
        self,
        seed: int | None = None,
        trace: TraceSpec | None = None,
        reducer: Any = None,
        recipe: Any = None,
        **beside: Any,
    ) -> None:
        """SettingError where what is asked for is not what is set; None asks for nothing, an unset contract for none."""
        base = self.recipe if reducer is None and recipe is None else recipe
        asked = _flat(chosen_recipe(reducer, base, beside)) | {"seed": seed, "trace": trace if self.trace else None}
        have = _flat(self.recipe) | {"seed": self.seed, "trace": self.trace}
        given = {name for name in asked if name not in ("seed", "trace") or asked[name] is not None}
        other = sorted(name for name in given if asked[name] != have[name])
        if other:
            stored, wished = (", ".join(f"{name} {values[name]}" for name in other) for values in (have, asked))
            raise SettingError(
                f"Expected the store's own settings ({stored}), got {wished}; leave them out or name a new store."
            )


def chosen_recipe(reducer: Any, recipe: Any, beside: Mapping[str, Any]) -> Recipe:
    """The recipe that was asked for, or the reducer's own, with the settings that were given beside it.

    SettingError where both are given and contradict each other: a recipe's radius and parameters belong to its reducer.
    """
    base = Recipe.load(recipe if recipe is not None else "conv" if reducer is None else reducer)
    if recipe is not None and reducer is not None and reducer != base.reducer:
        raise SettingError(f"The recipe names its reducer, {base.name}; got reducer {reducer!r} beside it: leave one out.")
    return base.with_settings(**beside)


def refuse_idle(reducer: Any, beside: Mapping[str, Any]) -> None:
    """SettingError for settings beside a model that was handed in and decides by its own: they would have no effect."""
    idle = [name for name in ("radius", "folds") if beside.get(name) is not None]
    idle += [] if reducer is None else ["reducer"]
    policy = beside.get("policy")
    idle += [] if policy is None or replace(policy, audit_rate=0.0) == Policy() else ["policy"]
    if idle:
        raise SettingError(
            f"A model that is handed in decides by its own rule, so {', '.join(idle)} would have no effect; "
            "set it on the model, or leave it out (of a policy the audit rate alone counts)."
        )


def _flat(recipe: Recipe) -> dict[str, Any]:
    plain = {f.name: getattr(recipe, f.name) for f in fields(recipe)}
    policy: Policy = plain.pop("policy")
    return plain | asdict(policy)
