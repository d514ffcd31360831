"""What an engine is, apart from what it has learned: the settings that it was made with, and that its store keeps."""

import json
import logging
from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import TYPE_CHECKING, Any, Self

from .. import __version__
from ..decision.decider import DecisionConditions
from ..decision.policy import NO_WINDOWS, Policy
from ..errors import ImportRefusedError, SettingError, StoreError, expect, shortened
from ..model.base import EngineModel, Model, as_engine_model
from ..model.neighbours import ModelPrediction
from ..recipe import OBJECT_PREFIX, Recipe, describe_estimator
from ..records import TraceSpec, is_whole, stored_trace_spec
from ..store.outbox import Outbox
from ..traces import ForceLimitsGate

if TYPE_CHECKING:
    from ..store.sql import SqlStore

log = logging.getLogger("dengine")

SEEDS = 2**32 - 1  # the largest one that NumPy's and scikit-learn's generators take
# What counts for any model.
LOOP = (
    "seed",
    "trace",
    "retrain_every",
    "budget",
    "max_steps",
    "window",
    "audit_rate",
    "stops",
    "windows",
)
MARKS = (
    "policy_since",
    "evidence_since",
    "began_in",
)  # of what a change of policy set, as the store has them


@dataclass(frozen=True, slots=True)
class EvidenceWindow:
    """What the rule in force is told: what was decided from version `since` on; it began at `began_in` of `SAFE_MODES`."""

    since: int = 0
    began_in: int = 0


@dataclass(frozen=True, slots=True)
class EngineSettings:
    """An engine's settings.

    recipe : as it is in force.  seed : of the reducer and of the audits' coin, 0 or more.
    model : what a model that was handed in is called; None: the recipe describes the model.
    described : the object that was handed in, a model or a reducer without a name, with its settings; None: there is none.
    trace : the traces' contract; None until the first sound trace.  inferred : whether it was set by that, and not given.
    policy_since : the first model version under the policy in force; 0: every one.
    evidence : what the rule in force is told.
    """

    recipe: Recipe
    seed: int = 0
    model: str | None = None
    described: str | None = None
    trace: TraceSpec | None = None
    inferred: bool = False
    policy_since: int = 0
    evidence: EvidenceWindow = EvidenceWindow()

    def __post_init__(self) -> None:
        expect(
            is_whole(self.seed, 0, SEEDS),
            f"a seed of 0 or more, an integer of at most {SEEDS}",
            self.seed,
        )
        known = self.trace is None or isinstance(self.trace, TraceSpec)
        expect(known, "a TraceSpec as trace", self.trace, "TraceSpec(samples=1000) for one")
        if self.trace is not None:
            ForceLimitsGate(self.recipe.policy.windows, self.trace)  # refused before it is in force

    def to_store(self) -> dict[str, str]:
        """As `SqlStore.save_settings` takes them."""
        known = {"recipe": self.recipe.to_toml(), "seed": str(self.seed), "dengine": __version__}
        known |= {
            name: text
            for name in ("model", "described")
            if (text := getattr(self, name)) is not None
        }
        if self.trace is not None:
            known["trace"] = json.dumps(asdict(self.trace))
        if self.inferred:
            known["inferred"] = "true"
        marks = (self.policy_since, self.evidence.since, self.evidence.began_in)
        return known | {name: str(value) for name, value in zip(MARKS, marks, strict=True) if value}

    @classmethod
    def from_store(
        cls,
        known: Mapping[str, str],
        name: str,
        reducer: Any = None,
        model: Model | None = None,
        allow_import: bool | Collection[str] = False,
    ) -> Self:
        """What `to_store` gave. name : of the store, for errors.  reducer, model : objects that it cannot bring back.

        allow_import : as for `must_allow`, beside what the reducer names.
        Raises StoreError for an unused store, SettingError for a missing object, or another than it was made with.
        """
        if "recipe" not in known:
            raise StoreError(
                f"Expected a store that an engine has used, {name} is empty; make a DataEngine with it."
            )
        recipe = Recipe.from_store(known, f"the recipe in {name}")
        made_with = known.get("described")
        if "model" in known and model is None:
            raise SettingError(
                f"The engine of {name} drove a {known['model']}; hand it in again: open(url, model=...)."
            )
        if "model" not in known and model is not None:
            raise SettingError(
                f"The engine of {name} has its own model, {recipe.name}; leave model=... out."
            )
        if model is not None or recipe.name.startswith(OBJECT_PREFIX):
            if model is None and (reducer is None or isinstance(reducer, str)):
                unnamed = f"{recipe.reducer}, has no name in TOML"
                raise SettingError(
                    f"The reducer of {name}, {unnamed}: hand it in again, reducer=..."
                )
            given = describe_estimator(reducer) if model is None else as_engine_model(model).description
            if made_with is not None and given != made_with:
                raise SettingError(
                    f"{name} was made with {made_with}, got {given}: its labels were counted by that one."
                )
            recipe = recipe if model is not None else replace(recipe, reducer=reducer, params={})
        elif reducer is not None and not isinstance(reducer, str):
            again = Recipe.from_toml(Recipe(reducer).to_toml())
            if (again.reducer, again.params) != (recipe.reducer, recipe.params):
                raise SettingError(
                    f"Expected reducer {recipe.name} of {name}, got {describe_estimator(reducer)}; leave it out."
                )
        must_allow(
            recipe, name, allow_import is True or {*(allow_import or ()), *classes_of(reducer)}
        )
        inferred = "inferred" in known
        seed = known.get("seed", "0")
        sound = seed.isdecimal() and seed.isascii() and len(seed) < 100
        expect(
            sound,
            "a seed in the store's settings",
            seed,
            "restore the store from a copy",
            StoreError,
        )
        policy_since, *evidence = (int(known.get(name, "0")) for name in MARKS)
        own, trace = known.get("model"), stored_trace_spec(known)
        return cls(
            recipe,
            int(seed),
            own,
            made_with,
            trace,
            inferred,
            policy_since,
            EvidenceWindow(*evidence),
        )

    def with_template(self, model: Model | None) -> tuple[Self, EngineModel]:
        """The settings in force, and the untrained model: the recipe's, or the one that was handed in."""
        if model is None:
            own = self.recipe.reducer
            described_ = None if isinstance(own, str) else describe_estimator(own)
            return replace(self, described=described_), ModelPrediction.from_recipe(
                self.recipe, self.seed
            )
        template = as_engine_model(model)
        in_force = template.effective_recipe(
            self.recipe
        )  # of our own kind its numbers count, a baseline's are its own affair
        return replace(
            self, recipe=in_force, model=template.name, described=template.description
        ), template

    def must_agree_with(self, asked: Mapping[str, Any]) -> None:
        """SettingError where what is asked for, as `DataEngine` takes it, is not what is set; None asks for nothing."""
        given = {name: value for name, value in asked.items() if value is not None}
        reducer, recipe, policy = (
            given.pop(name, None) for name in ("reducer", "recipe", "policy")
        )
        have = flat(self.recipe) | {"seed": self.seed, "trace": self.trace or given.get("trace")}
        unknown = sorted(set(given) - set(have))
        if unknown:
            raise SettingError(
                f"Expected settings of a DataEngine, got {', '.join(unknown)}, which it has not."
            )
        wished = {} if recipe is None else flat(chosen_recipe(reducer, recipe, {}))
        wished |= given | ({} if policy is None else policy.to_values())
        wished |= {} if reducer is None else {"reducer": reducer}
        if not isinstance(
            wished.get("reducer"), str
        ):  # an object was compared when the store was opened
            wished = {
                name: value for name, value in wished.items() if name not in ("reducer", "params")
            }
        # A program's settings are the same in the shadow mode, which a person begins and ends.
        counts = LOOP if self.model is not None else [name for name in have if name != "shadow"]
        if wished.get("windows") == NO_WINDOWS:  # these are an operator's, too
            wished.pop("windows", None)
        other = sorted(name for name in wished if name in counts and wished[name] != have[name])
        if other:
            stored, got = (
                ", ".join(f"{name} {values[name]}" for name in other) for values in (have, wished)
            )
            raise SettingError(
                f"Expected the store's own settings ({stored}), got {got}; leave them out, or name another store."
            )


def chosen_recipe(reducer: Any, recipe: Any, beside: Mapping[str, Any]) -> Recipe:
    """The recipe that was asked for, or the reducer's own, with settings beside it; SettingError where the two differ."""
    base = Recipe.load(recipe if recipe is not None else "conv" if reducer is None else reducer)
    if recipe is not None and reducer is not None and reducer != base.reducer:
        raise SettingError(
            f"The recipe names its reducer, {base.name}; got reducer {reducer!r} beside it: leave one out."
        )
    return base.with_settings(**beside)


def classes_of(
    reducer: Any = None, recipe: Any = None, policy: Policy | None = None, **others: Any
) -> list[str]:
    """Each `module:Class` that a caller names himself, in settings as `DataEngine` takes them."""
    said = [Recipe.load(each) for each in (reducer, recipe) if each is not None]
    return [
        name for each in (*said, Recipe(policy=policy or Policy())) for name in each.user_classes
    ]


def must_allow(recipe: Recipe, store: str, allow_import: bool | Collection[str]) -> None:
    """ImportRefusedError where a store's recipe names a class that may not be imported: who writes there would run code.

    allow_import : True: any may; else the names of those that may.
    """
    refused = (
        []
        if allow_import is True
        else [name for name in recipe.user_classes if name not in (allow_import or ())]
    )
    if refused:
        again = "name it again (reducer=, recipe=, policy=; --reducer, --guarantee)"
        allow = "allow it, where you trust the store (allow_import=True; --allow-import)"
        got = f"{shortened(refused[0])}, which {store} names"
        raise ImportRefusedError(f"Expected leave to import {got}: {again}, or {allow}.")


def peers_trace(store: "SqlStore") -> TraceSpec | None:
    """The contract of traces that a product's cells have agreed on; None where there is none, or no product."""
    return next(filter(None, map(stored_trace_spec, store.peers_settings().values())), None)


def as_peers(
    asked: Mapping[str, Any], store: "SqlStore", allow_import: bool | Collection[str]
) -> dict[str, Any]:
    """What a new engine is asked for; what was left open, as a peer has it if there is one, where `must_allow` lets it."""
    known = next(iter(store.peers_settings().values()), {})
    filled = dict(asked)
    if filled.get("seed") is None:
        filled["seed"] = int(known.get("seed", 0))
    chosen = any(filled.get(name) is not None for name in ("reducer", "recipe", "model"))
    if "recipe" in known and not chosen and "described" not in known:  # an object must be handed in
        filled["recipe"] = Recipe.from_toml(known["recipe"])
        must_allow(filled["recipe"], "a peer in the store", allow_import)
    return filled


def refuse_idle(reducer: Any, beside: Mapping[str, Any]) -> None:
    """SettingError for settings beside a model that was handed in and decides by its own: they would have no effect."""
    idle = [name for name in ("radius", "folds") if beside.get(name) is not None]
    idle += [] if reducer is None else ["reducer"]
    policy = beside.get("policy")
    counting = {"audit_rate": 0.0, "stops": "some", "shadow": False, "windows": ()}
    idle += [] if policy is None or replace(policy, **counting) == Policy() else ["policy"]
    if idle:
        do = "set it on the model, or leave it out (of a policy audit_rate, stops, shadow and windows alone count)"
        what = f"so {', '.join(idle)} would have no effect"
        raise SettingError(f"A model that is handed in decides by its own rule, {what}; {do}.")


def flat(recipe: Recipe) -> dict[str, Any]:
    """Every setting of a recipe by its name, the policy's among them."""
    return {
        f.name: getattr(recipe, f.name) for f in fields(recipe) if f.name != "policy"
    } | recipe.policy.to_values()


class SettingsInForce:
    """The settings in force, and the store's copy of them.

    now : they themselves.  audited_share : of certain decisions that are verified all the same.
    conditions : what decisions depend on; None before the first sound trace.
    waiting : whether the store lacks them, and `save` is to be called again.
    """

    def __init__(self, settings: EngineSettings, outbox: Outbox) -> None:
        self.change(settings)
        self.waiting = False
        self._outbox = outbox

    def change(self, settings: EngineSettings) -> None:
        """Go on under others."""
        policy, trace = settings.recipe.policy, settings.trace
        self.now, self.audited_share = settings, policy.audited_share
        self.conditions = None
        if trace is not None:
            share = policy.audited_share
            self.conditions = DecisionConditions(trace, policy.limits, share, settings.seed)

    def save(self) -> None:
        """Store them; where the store is away, they wait."""
        try:
            self._outbox.call_store(lambda: self._outbox.store.save_settings(self.now.to_store()))
            self.waiting = False
        except StoreError:
            self.waiting = True
            log.exception("the settings are stored later")
