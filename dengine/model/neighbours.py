"""The model prediction: reducer, references and rule together, with honest counting.

And the module that answers.

A label may be counted for a query only in an embedding that never saw that label. So the reducer
spans K spaces, fold k's references live in space k, a query is embedded in all K, and its counts
are summed.

`Predictor` is what the engine asks, and what export saves: `export.decision` puts the trace gate
before it and the audits' coin behind it.
"""

import copy
import logging
import math
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import reduce
from types import FunctionType
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from sklearn.base import clone
from torch import Tensor, nn

from ..decision.classifier import WilsonRadiusClassifier
from ..decision.code import is_code_changed
from ..decision.decider import Decider, DecisionConditions, Predicted, Verdict
from ..decision.members import SAFE_MODES
from ..decision.neighbours import RadiusNeighbours
from ..decision.novelty import NoveltyGate, fit_novelty
from ..decision.policy import Policy
from ..decision.references import Counts, RadiusIndex
from ..decision.rule import DecisionRule
from ..decision.scripting import arrays_with_prefix, incompatible_model_error, restore, script
from ..errors import ExportError, listed
from ..folds import content_hash, fold_of
from ..recipe import NOVELTY, Recipe, describe_estimator
from ..records import ACTIONS, REASONS, Reason, TraceSpec, as_success
from ..reducers import make_reducer, own_default
from ..reducers.base import (
    FitReport,
    Floats,
    Ints,
    Reducer,
    State,
    StopRule,
    as_reducer,
    space_scale,
)
from ..traces import ForceLimitsGate, as_labels, as_traces, clip_extremes
from .base import Embedding, EngineModel, Exportable, Prediction

log = logging.getLogger("dengine")
NEWEST = 500  # traces that are searched for repeats: the work does not grow
NEIGHBOURS = 10
# A nearest neighbour within this share of the distance to the tenth one is a near repeat; of distinct
# parts about one in two hundred is as near.
NEAR = 0.12
# More near repeats are reported; among 100 to 500 insertions of distinct parts up to 15 were counted.
SUSPICIOUS = 25
NOVEL = REASONS.index(Reason.NOVEL)
KINDS = 16  # compiled modules that a process keeps


class Predictor(nn.Module):
    """Encoder, novelty gate, references and rule as one module; compiles if the rule does.

    Parameters
    ----------
    encoder : nn.Module
        (B, C, T) -> (B, K, d).
    scale : Tensor of float32, shape (K,)
        Each space is divided by its scale.
    novelty : NoveltyGate
    neighbours : RadiusNeighbours
    """

    scale: Tensor

    def __init__(
        self,
        encoder: nn.Module,
        scale: Tensor,
        novelty: NoveltyGate,
        neighbours: RadiusNeighbours,
    ) -> None:
        super().__init__()
        self.encoder = encoder
        self.register_buffer("scale", scale[:, None])
        self.scaled = bool((scale != 1.0).any())
        self.novelty = novelty
        self.neighbours: RadiusNeighbours = neighbours
        self.novel = NOVEL

    @torch.jit.export
    def embed(self, x: Tensor) -> Tensor:
        """Return the scaled embedding (K, d) of one trace (C, T)."""
        z: Tensor = self.encoder(x.unsqueeze(0))[0]
        return z / self.scale if self.scaled else z

    def forward(self, x: Tensor, part: int = 0) -> Predicted:
        """Predict one trace (C, T) of float32.

        `part` is the hash of its part, whose references have no vote; 0 excludes none. Returns
        positions of action and reason, lower, upper, n_success, n_failure, and the scaled embedding
        (K, d). A novel trace is verified without counting.
        """
        z = self.embed(x)
        if self.novelty(x):
            return 0, self.novel, 0.0, 1.0, 0, 0, z
        action, lower, upper, n_success, n_failure = self.neighbours(z, part)
        return action, self.neighbours.reason(action), lower, upper, n_success, n_failure, z


class InPython(nn.Module):
    """The embedding of a reducer that has no module, umap-learn for one."""

    def __init__(self, reducer: Reducer) -> None:
        super().__init__()
        self.reducer = reducer

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, T) -> (B, K, d)."""
        return torch.from_numpy(self.reducer.embed(x.numpy()))


CONSTANTS = bool, int, float, str, list, tuple, dict, FunctionType, type(None)
_COMPILED: dict[
    Any, Any
] = {}  # a module of each structure: to script takes 24 ms and more, a copy of one 1 ms


def template_of(eager: Decider, trace_shape: tuple[int, ...]) -> Any:
    """Return the compiled and warm decider of this structure; compile it if there is none yet.

    It is shared: `compiled` copies it.
    """
    structure = structure_of(eager)
    if (template := _COMPILED.get(structure)) is None:
        template = script(eager)
        x = torch.linspace(0.0, 1.0, math.prod(trace_shape)).view(trace_shape)
        with torch.inference_mode():
            for _ in range(3):  # TorchScript's first calls compile; a cell should not wait for that
                template(x, 0)
        while len(_COMPILED) >= KINDS:
            _COMPILED.pop(next(iter(_COMPILED)), None)
        _COMPILED[structure] = template
    return template


def structure_of(eager: nn.Module) -> tuple[Any, ...]:
    """Everything that scripting compiles into a module: classes, attributes and shapes, but not the
    tensors' values.

    The classes themselves are part of it, not their names: a notebook cell that is run again
    defines another class.
    """
    return tuple(
        (
            name,
            type(module),
            *sorted(
                (key, _as_key(value))
                for key, value in vars(module).items()
                if is_compiled_in(key, value)
            ),
            *(
                (key, None if isinstance(module, ForceLimitsGate) else tuple(tensor.shape))
                for key, tensor in _tensors_of(module)
            ),
        )
        for name, module in eager.named_modules()
    )


def is_compiled_in(name: str, value: object) -> bool:
    """Whether scripting compiles an attribute into the code, as it does with plain values and
    functions.
    """
    return not name.startswith("_") and isinstance(value, CONSTANTS)


def _as_key(value: object) -> object:
    """A value to compare by; a function itself, for another may later have its address."""
    return value if isinstance(value, FunctionType) else repr(value)


def _compiles(*modules: nn.Module) -> bool:
    """Whether TorchScript compiles these as they are now.

    What it compiled before it was changed answers in Python.
    """
    changed = [type(module).__name__ for module in modules if is_code_changed(module)]
    if changed:
        do = "start Python anew to have it compiled"
        log.warning(
            "the code of %s was changed after it was compiled: it answers in Python; %s",
            listed(changed),
            do,
        )
    return not changed


def _tensors_of(module: nn.Module, recurse: bool = False) -> list[tuple[str, Tensor]]:
    return [*module.named_parameters(recurse=recurse), *module.named_buffers(recurse=recurse)]


def compiled(eager: Decider, trace_shape: tuple[int, ...]) -> Any:
    """A scripted module with another one's tensors, shared, not copied."""
    module = copy.deepcopy(template_of(eager, trace_shape))
    for name, tensor in _tensors_of(eager, recurse=True):
        *path, leaf = name.split(".")
        setattr(reduce(getattr, path, module), leaf, tensor)
    return module


class ModelPrediction(EngineModel):
    """Reducer + references + rule, from traces.

    reducer : a name in `REDUCERS`, a `Reducer`, or any scikit-learn transformer; it is cloned,
    never fitted itself. classifier : a `WilsonRadiusClassifier` holding radius and policy; it is
    cloned, never fitted itself.
        None: of the reducer's own radius.
    folds : K, for a label-using transformer that does not cross-fit by itself.
    rule : what turns counts into an action; None: the classifier's policy.
    novelty : how far beyond its references a trace may lie, as in `Recipe`; 0: anywhere.

    Embeddings are scaled space by space to a root mean square radius of 1, so that one `radius`
    means the same in every reducer; the scale of space k comes from fold k's traces, whose labels
    that space never saw. One whose axis has a unit of its own (`Reducer.own_unit`) is left as it
    is: where probabilities hardly differ, they are not to be spread.
    """

    def __init__(
        self,
        reducer: Any = "conv",
        classifier: WilsonRadiusClassifier | None = None,
        folds: int = 2,
        rule: DecisionRule | None = None,
        novelty: float = NOVELTY,
    ) -> None:
        self.novelty = novelty
        self.reducer = make_reducer(reducer) if isinstance(reducer, str) else reducer
        self.classifier = classifier or WilsonRadiusClassifier(
            own_default(self.reducer, "default_radius")
        )
        self.folds, self.name = folds, type(self.reducer).__name__
        self.rule = rule or self.classifier.policy().rule()
        self.spaces: Reducer = as_reducer(clone(self.reducer), folds)
        self._note = ""

    @classmethod
    def from_recipe(cls, recipe: Recipe, seed: int = 0) -> Self:
        """The untrained model that a recipe describes."""
        policy = recipe.policy
        own = {name: getattr(policy, name) for name in ("alpha", "lower_bound", "interval")}
        classifier = WilsonRadiusClassifier(recipe.radius, **own, capacity=recipe.window)
        return cls(
            recipe.make_reducer(seed), classifier, recipe.folds, policy.rule(), recipe.novelty
        )

    @property
    def user_model(self) -> "ModelPrediction":  # itself: an attribute would be a circle
        return self

    @property
    def description(self) -> str:  # type: ignore[override]  # asked when the rule may be another
        own = f"{describe_estimator(self.reducer)} under {describe_estimator(self.classifier)}"
        return f"{own}, {self.folds} folds, {type(self.rule).__name__}"

    def effective_recipe(self, recipe: Recipe) -> Recipe:
        """Return the recipe with this model's classifier settings, folds and novelty."""
        own = self.classifier
        policy = replace(
            recipe.policy, alpha=own.alpha, lower_bound=own.lower_bound, interval=own.interval
        )
        return replace(
            recipe, radius=own.radius, policy=policy, folds=max(2, self.folds), novelty=self.novelty
        )

    @property
    def n_spaces(self) -> int:
        return self.spaces.n_spaces

    @property
    def min_traces(self) -> int:  # type: ignore[override]  # it depends on the reducer
        return self.spaces.min_traces

    @property
    def report(self) -> FitReport:
        own = self.spaces.report
        return replace(own, note="; ".join(filter(None, (own.note, self._note))))

    def fit(self, X: ArrayLike, y: ArrayLike, *, hashes: Ints | None = None) -> Self:
        """Train the reducer afresh, and make every trace a reference.

        X : (n, T) or (n, C, T); y : (n,) 1 = success, 0 = failure; hashes : (n,) `folds.trace_hash`
        of each, or None: of their content. Raises SettingError where the reducer cannot be trained
        on this (one class only, too few traces).
        """
        X, y = as_traces(X), as_labels(y)
        self.spaces = as_reducer(clone(self.reducer), self.folds)
        return self.train(
            X, y, content_hash(X) if hashes is None else np.asarray(hashes, dtype=np.int64)
        )

    def train(
        self,
        X: Floats,
        y: NDArray[Any],
        hashes: Ints,
        stop: StopRule | None = None,
        numbers: Ints | None = None,
    ) -> Self:
        """Train the reducer, warm where it can be, and make every trace a reference."""
        X, y = clip_extremes(X), y.astype(np.int64)
        folds = fold_of(hashes, self.n_spaces)
        points = self.spaces.train(X, y, folds, stop, numbers)
        self.trace_shape = X.shape[1:]
        own_unit = self.spaces.own_unit
        self.scale = (
            np.ones(self.n_spaces, np.float32)
            if own_unit
            else space_scale(points, folds, self.n_spaces)
        )
        self.index = RadiusIndex(points.shape[1], self.classifier.capacity)
        self.index.add(points / self.scale[folds, None], y, folds, hashes, numbers)
        self.index.estimate_agreement()
        self._note = repeats_note(X, hashes)
        self.gate = (
            fit_novelty(X, self.novelty, hashes) if self.novelty else NoveltyGate(*self.trace_shape)
        )
        self._decider = None  # built by `prepare`, or when it is asked
        return self

    def warm_up(self) -> None:
        self.spaces.warm_up()

    def precompute(self, X: Floats, numbers: Ints | None = None) -> None:
        """Let the reducer compute in advance.

        Before the first training also compile the predictor's template.
        """
        X = clip_extremes(X)
        blank = self.spaces.untrained_module(X)
        with ThreadPoolExecutor(1, "dengine-ahead", torch.set_num_threads, (1,)) as pool:
            ahead = pool.submit(self.spaces.precompute, X, numbers)
            if (
                blank is not None
                and self.rule.scriptable
                and "index" not in vars(self)
                and _compiles(self.rule, blank)
            ):
                shape, own = X.shape[1:], self.classifier
                gate = NoveltyGate(*shape)
                gate.disabled = not self.novelty
                around = own.neighbours_over(
                    RadiusIndex(blank.dim, own.capacity), self.rule, self.spaces.scores
                )
                predictor = Predictor(blank, torch.ones(self.n_spaces), gate, around)
                conditions = DecisionConditions(TraceSpec(channels=shape[0], samples=shape[1]))
                decider = Decider(predictor, conditions, (self.n_spaces, blank.dim))
                template_of(decider.eval(), shape)
            ahead.result()

    def prepare(self, previous: EngineModel) -> None:
        """Take over the rule of the previous model, stale or not, and compile the predictor unless
        that is done.
        """
        if not isinstance(previous, ModelPrediction):
            return
        compiled_with_rule = self._decider is not None and self.rule is previous.rule
        self.rule = previous.rule
        self.rule_is_stale = self.rule_is_stale or previous.rule_is_stale
        if not compiled_with_rule:
            self._conditions = previous._conditions or self._conditions
            self._decider = self._build_decider()

    def _build_decider(self) -> Decider:
        """Return a decider for `_conditions`, compiled if encoder and rule can be compiled."""
        encoder = self.spaces.module()
        neighbours: Any = self.classifier.neighbours_over(self.index, self.rule, self.spaces.scores)
        scale = torch.from_numpy(self.scale)
        channels, samples = self.trace_shape
        conditions = self._conditions or DecisionConditions(TraceSpec(samples, channels=channels))
        shape = (self.n_spaces, self.index.dim)
        rule_compiles = self.rule.scriptable and _compiles(self.rule)
        if encoder is not None and not _compiles(encoder):
            encoder = None
        if encoder is not None and rule_compiles:
            predictor = Predictor(encoder, scale, self.gate, neighbours)
            decider: Decider = compiled(
                Decider(predictor, conditions, shape).eval(), self.trace_shape
            )
            return decider
        encoder = InPython(self.spaces) if encoder is None else script(encoder)
        neighbours = script(neighbours) if rule_compiles else neighbours
        predictor = Predictor(encoder, scale, script(self.gate), neighbours)
        return Decider(predictor, conditions, shape).eval()

    @property
    def is_compiled(self) -> bool:  # type: ignore[override]  # asked when there is a predictor
        return isinstance(self._decider, torch.jit.ScriptModule)

    @property
    def predictor(self) -> Any:
        """The `Predictor` in the decider; ValueError if nothing was fitted."""
        return self.decider(self._conditions).predictor

    def decider(self, conditions: DecisionConditions | None) -> Decider:
        """Return the module that decides under these conditions, built if there is none yet.

        None stands for no force limits, no sensor limit and no audits. Raises ValueError if nothing
        was fitted.
        """
        is_same = conditions is self._conditions or conditions == self._conditions
        if self._decider is None or not is_same:
            if "index" not in vars(self):
                raise ValueError("Expected a fitted model; call fit(X, y) first.")
            self._conditions = conditions
            self._decider = self._build_decider()
        return self._decider

    def add(self, x: ArrayLike, y: ArrayLike) -> Self:
        """Take in one labelled trace, (T,) or (C, T), as a reference."""
        X = as_traces(np.asarray(x)[None])
        hash_ = int(content_hash(X)[0])
        self.add_reference(X[0], int(as_success(np.asarray(y))), hash_)
        return self

    def add_reference(
        self,
        x: Floats,
        y: int,
        hash_: int,
        number: int = 0,
        *,
        embedding: Embedding | None = None,
        point: Floats | None = None,
    ) -> Floats:
        """Add one labelled trace (channels, samples) to the index, in the space of its fold.

        Returns its point (d,).
        """
        if point is None:
            point = self._reference_point(x, hash_, embedding)
        self.index.add_one(
            torch.from_numpy(np.array(point)), float(y), self._fold(hash_), hash_, number
        )
        return point

    def _reference_point(self, x: Floats, hash_: int, embedding: Embedding | None) -> Floats:
        """Return the scaled point (d,) of a trace in the space of its fold, computed where
        `embedding` is None.
        """
        if embedding is not None:
            return np.array(embedding[self._fold(hash_)], dtype=np.float32)
        with torch.inference_mode():
            return np.asarray(self.predictor.embed(torch.from_numpy(x))[self._fold(hash_)].numpy())

    def renumber_reference(self, old: int, new: int) -> None:
        self.index.renumber(old, new)

    def change_reference(self, number: int, hash_: int, y: int | None) -> bool:
        return self.index.relabel(number, hash_, y)

    def _fold(self, hash_: int) -> int:
        return int(fold_of(np.array([hash_], dtype=np.int64), self.n_spaces)[0])

    def update_rule(
        self,
        lower: float,
        upper: float,
        success: bool,
        novel: bool,
        unobserved: int,
        predicted: int = 0,
        inclusion_probability: float = 1.0,
    ) -> None:
        """Update the rule in place with the outcome of one part.

        An update that fails leaves `rule_is_stale` set.
        """
        was_stale = self.rule_is_stale
        self.rule_is_stale = True
        before = dict(self.rule.state_dict())
        self.rule.observe(unobserved, novel)
        self.rule.update(lower, upper, success, predicted, inclusion_probability)
        for name, value in self.rule.state_dict().items():
            # The compiled module reads the tensor that it shares, so a tensor that was bound anew
            # is copied into it.
            if value.data_ptr() != before[name].data_ptr():
                before[name].copy_(value)
                path, _, leaf = name.rpartition(".")
                setattr(self.rule.get_submodule(path), leaf, before[name])
        self.rule_is_stale = was_stale

    def reset_rule(self, safe_mode: int) -> None:
        """Reset the rule in place, because the compiled module shares its tensors, and start it in
        a safe mode.
        """
        self.rule.load_state_dict(self.rule.clone().state_dict())
        self.rule.start_in_safe_mode(safe_mode)

    @property
    def rule_learns(self) -> bool:  # type: ignore[override]  # it depends on the rule
        return self.rule.learns()

    def with_policy(self, policy: Policy) -> Self:
        """Return a model under another policy, to be compiled anew around the same references."""
        settings = {name: getattr(policy, name) for name in ("alpha", "lower_bound", "interval")}
        model = copy.copy(self)
        model.classifier = clone(self.classifier).set_params(**settings)
        model.rule = policy.rule()
        model.rule_is_stale = False
        model._decider = None
        return model

    @property
    def safe_mode(self) -> str:
        return SAFE_MODES[self.rule.safe_mode()]

    def predict_one(self, x: Floats, hash_: int = 0) -> Prediction:
        """The whole prediction on one trace (C, T).

        The part with this hash, if it is known, has no vote.
        """
        with torch.inference_mode():
            predicted = self.predictor(torch.from_numpy(x), hash_)
        self._check_rule()
        action, reason, lower, upper, n_success, n_failure, z = predicted
        embedding = tuple(map(tuple, z.tolist()))
        return Prediction(
            ACTIONS[action], lower, upper, n_success, n_failure, embedding, REASONS[reason]
        )

    def decide_one(self, x: Floats, part: int, conditions: DecisionConditions) -> Verdict:
        decider = self.decider(conditions)
        # As `torch.inference_mode`, whose entering costs 3 % of a decision.
        with torch._C._InferenceMode(True):
            verdict: Verdict = decider.forward(torch.from_numpy(x), part)
        if verdict[0] == 0:  # a faulty trace does not ask the rule
            self._check_rule()
        return verdict

    def _check_rule(self) -> None:
        """Raise RuntimeError if the rule has missed an outcome."""
        if self.rule_is_stale:
            raise RuntimeError("the rule has missed what became of a part, so it cannot be asked")

    def predict_many(self, X: ArrayLike) -> list[Prediction]:
        """The prediction on each trace of (n, T) or (n, C, T)."""
        return [self.predict_one(x) for x in as_traces(X)]

    def count(self, X: ArrayLike) -> Counts:
        """(n_success, n_failure), each (n,): labels in the balls around each trace, summed over the
        K spaces.
        """
        found = self.predict_many(X)
        return np.array([p.n_success for p in found], dtype=np.int64), np.array(
            [p.n_failure for p in found], np.int64
        )

    def predict_interval(self, X: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(lower, upper), each (n,): the bound on each trace's success probability."""
        found = self.predict_many(X)
        return np.array([p.lower for p in found]), np.array([p.upper for p in found])

    def decide(self, X: ArrayLike) -> NDArray[Any]:
        """(n,) array of `Action`."""
        return np.array([p.action for p in self.predict_many(X)], dtype=object)

    def successor(self) -> "ModelPrediction":
        """A model to train next, warm from this one.

        All but the rule is its own, so this one goes on answering.
        """
        new = copy.copy(self)
        new.spaces, new._decider, new._note = copy.deepcopy(self.spaces), None, ""
        return new

    def defect(self) -> str:
        return (
            ""
            if np.isfinite(self.index.column("points")).all()
            else "the embedding of a reference is not finite"
        )

    def get_state(self) -> State:
        """Plain arrays: references always.

        The reducer's and the rule's own where they have any ("reducer.", "rule.").
        """
        state = {
            "trace_shape": np.array(self.trace_shape),
            "scale": self.scale,
        } | self.index.get_state()
        if self.rule_is_stale:
            state["rule_is_stale"] = np.array(
                True
            )  # an engine that opens the store rebuilds the rule
        else:
            state |= {
                f"rule.{name}": buffer.numpy().copy()
                for name, buffer in self.rule.state_dict().items()
            }
        if not self.gate.disabled:
            state |= {
                f"novelty.{name}": buffer.numpy().copy()
                for name, buffer in self.gate.state_dict().items()
            }
        return state | {
            f"reducer.{name}": value for name, value in (self.spaces.get_state() or {}).items()
        }

    def set_state(self, state: Mapping[str, NDArray[Any]]) -> Self:
        if not self.needs_refit(state):
            self.spaces.set_state(arrays_with_prefix(state, "reducer."))
        elif (
            self.spaces.get_state() is not None
        ):  # another reducer of that name, whose points lie elsewhere
            raise incompatible_model_error(f"{type(self.spaces).__name__} has no state")
        self.trace_shape = tuple(int(n) for n in state["trace_shape"])
        self.scale = np.asarray(state["scale"])
        self.index = RadiusIndex.from_state(state, self.classifier.capacity)
        self.gate = NoveltyGate(*self.trace_shape)
        self.gate.disabled = not arrays_with_prefix(state, "novelty.")
        for module, prefix in ((self.rule, "rule."), (self.gate, "novelty.")):
            if arrays := arrays_with_prefix(state, prefix):
                restore(module, arrays)
        self._decider = None
        return self

    def needs_refit(self, state: Mapping[str, NDArray[Any]]) -> bool:
        """Whether the reducer gave no arrays of its own."""
        return not arrays_with_prefix(state, "reducer.")

    def exported(self, trace: TraceSpec | None) -> Exportable:
        if "trace_shape" not in vars(self):
            raise ExportError(
                "Nothing was trained yet; report labels until the first retrain, then export."
            )
        return Exportable(
            self, trace or TraceSpec(channels=self.trace_shape[0], samples=self.trace_shape[1])
        )

    def __getstate__(self) -> dict[str, Any]:
        # A scripted module does not travel between processes; the receiver builds its own.
        return self.__dict__ | {"_decider": None}


def near_repeats(traces: Floats, parts: NDArray[np.int64]) -> int:
    """How many of the newest traces (n, C, T) nearly repeat one of another part; parts (n,) hashes.

    Labels are counted as independent trials, so a part that is inserted again must be known as such
    (`part=`). This notices the plain cases where it is not; it changes no decision. More repeats
    than `NEIGHBOURS` are not seen.
    """
    x, own = traces[-NEWEST:], parts[-NEWEST:]
    if len(x) < 100:
        return 0
    n, channels, samples = x.shape
    length = max(1, samples // 50)  # means of equal stretches: the sensor's noise is no difference
    whole = x[:, :, : samples // length * length].astype(np.float64)
    means = whole.reshape(n, channels, -1, length).mean(3)
    scale = means.std((0, 2), keepdims=True)
    rows = torch.from_numpy(
        ((means - means.mean(0)) / np.where(scale > 0, scale, 1.0)).reshape(n, -1)
    )
    distances = torch.cdist(rows, rows)
    distances[torch.from_numpy(own[:, None] == own)] = torch.inf
    tenth = np.partition(distances.numpy(), NEIGHBOURS)[
        :, NEIGHBOURS
    ]  # a quarter of the time of `kthvalue`
    return int(((distances.numpy().min(1) < NEAR * tenth) & (tenth > 1e-6)).sum())


def repeats_note(traces: Floats, parts: NDArray[np.int64]) -> str:
    """What to say of near repeats; "" where there are few."""
    n, looked_at = near_repeats(traces, parts), min(len(traces), NEWEST)
    if n <= SUSPICIOUS:
        return ""
    return (
        f"{n} of the newest {looked_at} traces nearly repeat another: "
        "if parts come twice, give their numbers (part=)"
    )
