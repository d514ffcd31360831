"""From settings to the objects that they describe."""

from __future__ import annotations

from dataclasses import replace
from inspect import signature
from typing import Any

from .classifier import WilsonRadiusClassifier
from .policy import Policy
from .prediction import ModelPrediction
from .recipe import Recipe
from .reducers import make_reducer, reducer_class


def recipe_of(
    reducer: str,
    policy: Policy | None = None,
    radius: float | None = None,
    folds: int | None = None,
    retrain_every: int | None = None,
    budget: float | None = None,
) -> Recipe:
    """The reducer's own recipe with what was asked for in its place; None asks for nothing."""
    base = Recipe.load(reducer)
    asked = {"radius": radius, "folds": folds, "retrain_every": retrain_every, "budget": budget}
    changes: dict[str, Any] = {name: value for name, value in asked.items() if value is not None}
    if radius is not None:
        changes |= {"fraction": None, "reject_fraction": None}  # a radius that was asked for is the one that counts
    return replace(base, policy=policy or base.policy, **changes)


def model_of(recipe: Recipe, seed: int) -> ModelPrediction:
    """The untrained model that a recipe describes."""
    classifier = WilsonRadiusClassifier(
        radius=recipe.radius,
        alpha=recipe.policy.alpha,
        lower_bound=recipe.policy.lower_bound,
        interval=recipe.policy.interval,
        fraction=recipe.fraction,
        reject_fraction=recipe.reject_fraction,
        capacity=recipe.window,
    )
    # A reducer that cross-fits by itself takes the folds; any other is cross-fitted from outside.
    own = {"folds": recipe.folds} if "folds" in signature(reducer_class(recipe.reducer)).parameters else {}
    return ModelPrediction(make_reducer(recipe.reducer, seed=seed, **own, **recipe.params), classifier, recipe.folds)
