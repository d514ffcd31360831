"""`EngineSettings`, what an engine was made with and its store keeps; `SettingsInForce`, the
present ones while it runs; and functions that check and complete the settings a program gives.
`DataEngine` makes or reads `EngineSettings` before it opens a cell. What the engine has learned is
not among them.
"""

import json
import sys
from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import TYPE_CHECKING, Any, Self

from .. import __version__
from ..decision.decider import DecisionConditions
from ..decision.policy import NO_LIMITS, Policy
from ..errors import ImportRefusedError, SettingError, StoreError, expect, listed, log, shortened
from ..model.base import BaselineAdapter, EngineModel, Model
from ..model.neighbours import ModelPrediction
from ..recipe import OBJECT_PREFIX, Recipe, describe_estimator, without_none
from ..records import StoredSettings, TraceSpec, is_whole, stored_trace_spec
from ..reducers import make_reducer, reducer_class
from ..store.outbox import Outbox
from ..traces import ForceLimitsGate

if TYPE_CHECKING:
    from ..store.sql import SqlStore


MAX_SEED = 2**32 - 1  # the largest one that NumPy's and scikit-learn's generators take
# Settings of a policy that have an effect on a baseline.
BASELINE_SETTINGS = ("audit_rate", "stops", "label_within", "force_limits", "shadow")
# Settings that have an effect on any model, a baseline included.
LOOP_SETTINGS = (
    "seed",
    "trace",
    "retrain_every",
    "budget",
    "max_steps",
    "window",
    *BASELINE_SETTINGS,
)
Settings = Mapping[str, Any]  # by name, as `DataEngine` takes them
# Whether the classes that a store names may be imported, or which of them.
AllowedImports = bool | Collection[str]


@dataclass(frozen=True, slots=True)
class EvidenceWindow:
    """Which decisions the rule in force is updated with.

    Attributes
    ----------
    since : int
        First model version whose decisions count.
    began_in : int
        Safe mode in which the rule started, a `SafeMode`.
    """

    since: int = 0
    began_in: int = 0


@dataclass(frozen=True, slots=True)
class EngineSettings:
    """The settings of an engine.

    Attributes
    ----------
    recipe : Recipe
        As it is in force.
    seed : int
        Of the reducer, and of the draw of audits; 0 or more.
    model : str or None
        Name of a baseline that was handed in; None: the recipe describes the model.
    described : str or None
        Description, with its settings, of an object that was handed in and has no name in TOML: a
        baseline or a reducer.
    trace : TraceSpec or None
        Shape, rate and unit of all traces; None until the first trace without a fault.
    policy_since : int
        First model version under the policy in force; 0: every one.
    evidence : EvidenceWindow

    Raises
    ------
    SettingError
        For an invalid seed, and for force limits that do not fit the traces.
    """

    recipe: Recipe
    seed: int = 0
    model: str | None = None
    described: str | None = None
    trace: TraceSpec | None = None
    policy_since: int = 0
    evidence: EvidenceWindow = EvidenceWindow()

    def __post_init__(self) -> None:
        expect(
            is_whole(self.seed, 0, MAX_SEED),
            f"a seed of 0 or more, an integer of at most {MAX_SEED}",
            self.seed,
        )
        expect(
            isinstance(self.trace, TraceSpec | None),
            "a TraceSpec as trace",
            self.trace,
            "TraceSpec(samples=1000) for one",
        )
        if self.trace is not None:
            # It raises before the policy is in force.
            ForceLimitsGate(self.recipe.policy.force_limits, self.trace)

    def to_store(self) -> dict[str, str]:
        """Return the settings as texts by name, as `SqlStore.settings.save` takes them.

        The recipe (the settings of model, policy and retrains) is written in full; the seed and
        dengine's own version are added. All other settings are left out if they have their
        defaults. Raises SettingError if a named reducer's class must be imported for a default of
        the recipe, and cannot be, or if that default is out of range.
        """
        texts = {"recipe": self.recipe.to_toml(), "seed": str(self.seed), "dengine": __version__}
        texts |= without_none({"model": self.model, "described": self.described})
        if self.trace is not None:
            texts["trace"] = json.dumps(asdict(self.trace))
        numbers = {
            "policy_since": self.policy_since,
            "evidence_since": self.evidence.since,
            "began_in": self.evidence.began_in,
        }
        return texts | {name: str(number) for name, number in numbers.items() if number}

    @classmethod
    def from_store(
        cls,
        texts: StoredSettings,
        name: str,
        reducer: Any = None,
        model: Model | None = None,
        allow_import: AllowedImports = False,
    ) -> Self:
        """Return the settings of an engine from the texts that its store keeps.

        Parameters
        ----------
        texts : mapping of str to str
            What `to_store` returned.
        name : str
            Of the store, for error messages.
        reducer, model : object, optional
            Objects that the engine was made with and the store cannot name. A reducer's name may be
            passed, too; it is not compared.
        allow_import : bool or collection of str
            Whether any class of the user that the recipe (the settings of model, policy and
            retrains) names may be imported, or the names of those that may, `module:Class`; a class
            that `reducer` names, or that it is an object of, is allowed.

        Returns
        -------
        EngineSettings

        Raises
        ------
        StoreError
            If the texts have no recipe, because no engine has used the store; for a number that is
            negative or no number, a damaged `TraceSpec` (shape, rate and units of the traces), and
            a recipe that lacks settings.
        SettingError
            If the stored text is no recipe, if an object is missing or differs from the object that
            the engine was made with, if a text `reducer` is neither a name in `RECIPES`, a TOML
            file of a recipe nor `module:Class`, or if `model` is no baseline (it lacks fit, add,
            count, predict_interval or decide), or is passed although the engine trains the model of
            its recipe. Also for a stored seed that is too large, and force limits (an operator's
            limits of the force) that do not fit the `TraceSpec`.
        ImportRefusedError
            If the recipe names a class that may not be imported.
        """
        if "recipe" not in texts:
            raise StoreError(
                f"Expected a store that an engine has used, {name} is empty; "
                "make a DataEngine with it."
            )
        recipe = Recipe.from_store(texts, f"the recipe in {name}")
        recipe = _with_objects(recipe, texts, name, reducer, model)
        # The name of an object's class may be another in the recipe than the class's own.
        named = reducer if isinstance(reducer, str | None) else recipe.reducer
        allowed = allow_import is True or {*(allow_import or ()), *named_classes(named)}
        check_imports(recipe, name, allowed)
        numbers: list[int] = []
        for setting in ("seed", "policy_since", "evidence_since", "began_in"):
            text = texts.get(setting, "0")
            expect(
                text.isdecimal() and text.isascii() and len(text) < 100,
                f"a {setting} in the store's settings",
                text,
                "restore the store from a copy",
                StoreError,
            )
            numbers.append(int(text))
        return cls(
            recipe,
            numbers[0],
            texts.get("model"),
            texts.get("described"),
            stored_trace_spec(texts),
            numbers[1],
            EvidenceWindow(*numbers[2:]),
        )

    def with_template(self, model: Model | None) -> tuple[Self, EngineModel]:
        """Return settings and an untrained model: that of the recipe, or `model` if it is given.

        If a user passed an object in place of a name, a reducer or `model`, the settings are a copy
        of these that describes it; otherwise they are these settings. A `model` is a baseline: it
        decides by its own rule, so not all of the recipe has an effect; the recipe stays in the
        settings. Without a `model` the recipe's reducer and the decision rule of its policy are
        made, and classes of the user that they need are imported. Raises SettingError if they
        cannot be made, and if `model` is no baseline: it lacks fit, add, count, predict_interval or
        decide. Other errors of the constructor of a user's class are raised as they are. These
        settings are not changed.
        """
        if model is None:
            untrained = ModelPrediction.from_recipe(self.recipe, self.seed)
            if isinstance(self.recipe.reducer, str):  # a store may describe an object of that name
                return self, untrained
            return replace(self, described=describe_estimator(self.recipe.reducer)), untrained
        template = BaselineAdapter(model)
        return replace(self, model=template.name, described=template.description), template

    def check_request(self, request: Settings) -> None:
        """Raise SettingError if settings that a program gives differ from these settings.

        `request` holds settings by name, as `DataEngine` takes them; None is a setting that was not
        given. All settings of a recipe or policy in it are compared, its defaults included. An
        unknown name is an error, too; so are `model` and the names of `RunOptions` (executor,
        replaying, clock, on_safe_mode), which the caller must take out before. If the user handed
        in a model, which decides by its own rule, only settings that have an effect on any model
        are compared (`LOOP_SETTINGS`): seed, trace, audit_rate, stops, label_within, force_limits
        and those of a retrain (retrain_every, budget, max_steps and window).

        Not compared are the shadow mode (every part is verified), and force limits (an operator's
        limits of the force) that the program leaves out, because an operator sets both while the
        robot cell runs. Nor is a reducer that is an object, with its parameters, nor `params`
        without the name of a reducer. A `trace` is compared only if these settings have a
        `TraceSpec` (shape, rate and units of the traces); a rate, units and columns that it leaves
        out are not compared. A recipe that cannot be read, or that names another reducer than the
        request's, is a SettingError, too.
        """
        given = without_none(request)
        reducer = given.pop("reducer", None)
        recipe = given.pop("recipe", None)
        policy = given.pop("policy", None)
        present = flat_settings(self.recipe)
        present |= {"seed": self.seed, "trace": self.trace or given.get("trace")}
        unknown = sorted(given.keys() - present)
        if unknown:
            raise SettingError(
                f"Expected settings of a DataEngine, got {', '.join(unknown)}, which it has not."
            )
        requested = {} if recipe is None else flat_settings(choose_recipe(reducer, recipe, {}))
        requested |= given
        if isinstance(given.get("trace"), TraceSpec):
            requested["trace"] = given["trace"].completed(self.trace)
        if policy is not None:
            requested |= policy.to_values()
        if reducer is not None:
            requested["reducer"] = reducer
        if not isinstance(requested.get("reducer"), str):
            # An object was compared when the store was opened.
            requested.pop("reducer", None)
            requested.pop("params", None)
        if requested.get("force_limits") == NO_LIMITS:
            requested.pop("force_limits")
        compared = {*(present if self.model is None else LOOP_SETTINGS)} - {"shadow"}
        different = sorted(
            name for name in compared & requested.keys() if requested[name] != present[name]
        )
        if different:
            stored, got = (
                ", ".join(f"{name} {settings[name]}" for name in different)
                for settings in (present, requested)
            )
            raise SettingError(
                f"Expected the store's own settings ({stored}), got {got}; leave them out, "
                "or name another store."
            )


def _with_objects(
    recipe: Recipe, texts: StoredSettings, name: str, reducer: Any, model: Model | None
) -> Recipe:
    """Return a stored recipe, with the reducer object put into it if the recipe cannot name it.

    A recipe has the settings of model, policy and retrains. It cannot name a reducer (a transformer
    from traces to points) that TOML does not describe, like a pipeline, nor a `model` of the user,
    which decides by its own rule: the user must hand in such an object each time. `texts` are the
    store's settings, and `name` is the name of the store for messages. If the store's engine has a
    `model` of the user, any `reducer` is accepted, and the recipe is returned as it is. So is a
    recipe that names its reducer. With such a recipe `reducer` may be None, a name, which is not
    compared here, or an object, if the recipe has its class (`module:Class`, by any loaded module
    that has the class) and its parameters, those that the recipe leaves out at the defaults of the
    class. An object is made of the class to compare them. If the recipe has a short name like
    "conv", no object is accepted.

    Raises SettingError for another object as `reducer`, or if its class refuses a parameter of the
    recipe; if an object that must be handed in is missing, or differs from the one that the store
    was made with (a reducer in its class and parameters, a model in its class alone; a store
    without a description of its object accepts any); if a `model` is passed to an engine that
    trains the recipe's own model; and if the model lacks fit, add, count, predict_interval or
    decide (`BaselineAdapter`). What the constructor of a user's class raises passes unchanged.
    """
    if "model" in texts and model is None:
        raise SettingError(
            f"The engine of {name} drove a {texts['model']}; hand it in again: open(url, "
            "model=...)."
        )
    if model is not None:
        if "model" not in texts:
            raise SettingError(
                f"The engine of {name} has its own model, {recipe.name}; leave model=... out."
            )
        _check_description(texts, name, BaselineAdapter(model).description)
        return recipe
    if recipe.name.startswith(OBJECT_PREFIX):
        if isinstance(reducer, str | None):
            raise SettingError(
                f"The reducer of {name}, {recipe.reducer}, has no name in TOML: "
                "hand it in again, reducer=..."
            )
        _check_description(texts, name, describe_estimator(reducer))
        return replace(recipe, reducer=reducer, params={})
    if isinstance(reducer, str | None):
        return recipe
    if (
        recipe.name.partition(":")[0] not in sys.modules  # nothing is imported
        or reducer_class(recipe.name) is not type(reducer)
        or Recipe(make_reducer(recipe.name, **recipe.params)).to_toml() != Recipe(reducer).to_toml()
    ):
        raise SettingError(
            f"Expected reducer {recipe.name} of {name}, got {describe_estimator(reducer)}; "
            "leave it out."
        )
    return recipe


def _check_description(texts: StoredSettings, name: str, description: str) -> None:
    """Raise SettingError if an object that the user hands in again differs from the one before.

    `description` is a text with the object's class and, if it is a reducer, its parameters. It is
    compared with the setting "described" of the store, among `texts`, if there is one; if there is
    none, nothing is compared. `name` is the name of the store, for the message.
    """
    made_with = texts.get("described", description)
    if description != made_with:
        raise SettingError(
            f"{name} was made with {made_with}, got {description}: its labels were counted by that "
            "one."
        )


def choose_recipe(reducer: Any, recipe: Any, given: Settings) -> Recipe:
    """Return the recipe that is asked for, with the settings of `given` in place of its own.

    A recipe has the settings of model, policy and retrains. `recipe` is what `Recipe.load` takes,
    such as a Recipe, a name or a TOML file. If it is None, the recipe is loaded from `reducer`, or
    from "conv" if both are None. `given` holds settings by name; None keeps the recipe's own.
    Raises SettingError if `recipe` names another reducer than `reducer`, if what is loaded is no
    recipe, for a setting out of range, and for a class that must be imported for a default and
    cannot be; TypeError for an unknown setting.
    """
    source = recipe
    if source is None:
        source = "conv" if reducer is None else reducer
    chosen = Recipe.load(source)
    if recipe is not None and reducer is not None and reducer != chosen.reducer:
        raise SettingError(
            f"The recipe names its reducer, {chosen.name}; got reducer {reducer!r} beside it: "
            "leave one out."
        )
    return chosen.with_settings(**given)


def named_classes(
    reducer: Any = None, recipe: Any = None, policy: Policy | None = None, **others: Any
) -> list[str]:
    """Return each `module:Class` that a caller names in settings, as `DataEngine` takes them.

    A name may stand in reducer, recipe (whose file is read) or policy; the class of a reducer
    object counts, too. Other settings, and classes of dengine, are ignored. A class that is named
    twice may be returned twice. Nothing is imported. Raises SettingError if no recipe can be read
    from one of these.
    """
    recipes = [Recipe.load(source) for source in (reducer, recipe) if source is not None]
    recipes.append(Recipe(policy=policy or Policy()))
    return [name for named in recipes for name in named.user_classes]


def check_imports(recipe: Recipe, store: str, allow_import: AllowedImports) -> None:
    """Raise ImportRefusedError if a stored recipe names a class that may not be imported.

    A recipe has the settings of an engine. Whoever writes to the store could otherwise run code
    here. Only classes of the user are checked, those of the reducer (the model that embeds traces)
    and of the decision rule (`Recipe.user_classes`). With `allow_import` True any of them is
    allowed, with False none; else it holds the names of the allowed ones, `module:Class`. `store`
    is the store's name in the message.
    """
    if allow_import is True:
        return
    refused = [name for name in recipe.user_classes if name not in (allow_import or ())]
    if refused:
        raise ImportRefusedError(
            f"Expected leave to import {shortened(refused[0])}, which {store} names: allow it, "
            "where you trust the store (allow_import=True; --allow-import), or name it again where "
            "a reducer or a guarantee is stated."
        )


def read_peers_trace_spec(store: "SqlStore") -> TraceSpec | None:
    """Return the `TraceSpec` of a product's other robot cells; None if there is none, or no
    product.

    It is that of the first cell that has one. Raises StoreError if it is damaged.
    """
    return next(filter(None, map(stored_trace_spec, store.settings.of_peers().values())), None)


def agreed_trace_spec(store: "SqlStore", stated: TraceSpec | None) -> TraceSpec | None:
    """Return the `TraceSpec` of a store, completed by a stated one.

    It is the store's own, else that of the product's other robot cells, else the stated one. A
    stated one adds rate, units and columns, and only to a `TraceSpec` of its shape. Raises
    StoreError if a stored one is damaged.
    """
    agreed = stored_trace_spec(store.settings.read()) or read_peers_trace_spec(store)
    return stated if agreed is None else agreed.completed(stated)


def fill_from_peers(
    request: Settings, store: "SqlStore", allow_import: AllowedImports
) -> dict[str, Any]:
    """Return a copy of a new engine's settings, in which a peer's replace some that were not given.

    A peer is another robot cell in the store that makes the same product; the first peer that has
    settings is taken. The peer's seed is taken if `request` has none (0 without a peer), and its
    recipe (the settings of model, policy and retrains) if `request` names neither reducer, recipe
    nor model. The recipe is not taken if the peer was given an object, a reducer or a model.
    Nothing is imported. Raises ImportRefusedError if the recipe names a class that may not be
    imported (`check_imports`), SettingError if the recipe cannot be read, ValueError if the seed
    cannot be read, and StoreError if the database fails.
    """
    peer = next(iter(store.settings.of_peers().values()), {})
    filled = dict(request)
    if filled.get("seed") is None:
        filled["seed"] = int(peer.get("seed", 0))
    is_chosen = any(filled.get(name) is not None for name in ("reducer", "recipe", "model"))
    # Where the peer has an object without a name, it must be handed in here as well.
    if "recipe" in peer and not is_chosen and "described" not in peer:
        filled["recipe"] = Recipe.from_toml(peer["recipe"])
        check_imports(filled["recipe"], "a peer in the store", allow_import)
    return filled


def check_model_settings(reducer: Any, given: Settings) -> None:
    """Raise SettingError for settings that have no effect beside a model that is handed in.

    A model that the user hands in decides by its own rule. `reducer` is the setting of that name,
    and `given` holds the other settings by name; None is a setting that was not given. Reducer,
    radius (of the neighbourhood whose labels count) and folds have no effect and must not be given.
    In `given["policy"]` only the fields in `BASELINE_SETTINGS` have an effect: audit_rate (share of
    certain decisions that are verified), stops (whether every bad accepted part stops the line),
    label_within (after how many later decisions a missing report is overdue), force_limits (the
    operator's limits of the signal) and shadow (every part is verified). Any other field must be at
    its default. Settings of other names pass.
    """
    idle = [name for name in ("radius", "folds") if given.get(name) is not None]
    if reducer is not None:
        idle.append("reducer")
    policy = given.get("policy")
    effective = {name: getattr(Policy(), name) for name in BASELINE_SETTINGS}
    if policy is not None and replace(policy, **effective) != Policy():
        idle.append("policy")
    refuse_idle(idle)


def refuse_idle(idle: Collection[str]) -> None:
    """Raise SettingError for settings that have no effect on a handed-in model, if there are any.

    `idle` holds their names.
    """
    if idle:
        raise SettingError(
            f"A model that is handed in decides by its own rule, so {', '.join(idle)} would have "
            "no effect; set it on the model, or leave it out (of a policy "
            f"{listed(BASELINE_SETTINGS)} alone count)."
        )


def flat_settings(recipe: Recipe) -> dict[str, Any]:
    """Return every setting of a recipe by its name, those of its policy in place of `policy`.

    The policy's are as of `Policy.to_values`, so the force limits are one text. The reducer's class
    is imported if the recipe leaves `radius` or `retrain_every` to it; SettingError if it cannot
    be.
    """
    settings = {field.name: getattr(recipe, field.name) for field in fields(recipe)}
    del settings["policy"]
    return settings | recipe.policy.to_values()


class SettingsInForce:
    """The settings in force, and the store's copy of them.

    Parameters
    ----------
    settings : EngineSettings
    outbox : Outbox

    Attributes
    ----------
    now : EngineSettings
    conditions : DecisionConditions or None
        What a decision depends on beside the model; None before the first trace without a fault.
    is_unsaved : bool
        Whether the store lacks the present settings, so that `save` must be called again.
    """

    def __init__(self, settings: EngineSettings, outbox: Outbox) -> None:
        self.change(settings)
        self.is_unsaved = False
        self._outbox = outbox

    def change(self, settings: EngineSettings) -> None:
        """Use other settings from now on, without saving them.

        The attribute `conditions`, what a decision depends on beside the model, is made of them:
        the `TraceSpec` (shape, rate and units of the traces), the operator's force limits, the
        share of audits (checks of parts that the model is certain of) and the seed. It is None if
        the settings have no `TraceSpec`. The attribute `is_unsaved` (whether the store lacks the
        present settings) stays as it is.
        """
        policy = settings.recipe.policy
        self.now = settings
        self.conditions: DecisionConditions | None = None
        if settings.trace is not None:
            self.conditions = DecisionConditions(
                settings.trace, policy.limits, policy.audited_share, settings.seed
            )

    def save(self) -> None:
        """Write the settings to the store and wait for it; a failure of the store is only logged.

        If the engine has a journal (a local file that gets its records before the store), it waits
        at most for the `limit` in seconds of the outbox, through which the engine writes to the
        store, and 2 s more for a write that is committing; without a journal there is no time
        limit. If the store does not take the settings, or does not answer in time, the error is
        logged, and the attribute `is_unsaved` is set, which a later success clears; a commit that
        was too slow may still happen. Raises SettingError if another robot cell of the product
        (cells that share labels) has settings that contradict these, or the recipe (the settings
        of an engine) of one of the two cannot be read; then nothing is written, and `is_unsaved`
        stays as it is.
        """
        texts = self.now.to_store()
        try:
            self._outbox.call_store(lambda: self._outbox.store.settings.save(texts))
            self.is_unsaved = False
        except StoreError:
            self.is_unsaved = True
            log.exception("the settings are stored later")
