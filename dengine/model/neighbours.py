"""dengine's own model, `ModelPrediction`: reducer, references and rule, with honest counting. The
engine trains it and asks it for decisions, the exporters write it to a file. The file also holds
`Predictor`, the module of the fitted parts; the compiled deciders that a process keeps
(`template_of`, `compiled`); and `near_repeats`, which notices parts that came twice without a
number.

A label may be counted for a query only in an embedding that never saw that label. So the reducer
spans K spaces, fold k's references live in space k, a query is embedded in all K, and its counts
are summed.

The engine and the exporters ask a `Decider` around `Predictor`, a module of the fitted parts that
compiles to TorchScript. Compiled deciders are copied from templates, because scripting takes long.
"""

import copy
import math
from dataclasses import replace
from enum import Enum
from types import BuiltinFunctionType, FunctionType
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from sklearn.base import clone
from sklearn.utils import check_consistent_length
from torch import Tensor, nn

from ..decision.classifier import WilsonRadiusClassifier
from ..decision.decider import Decider, DecisionConditions, Predicted, Verdict
from ..decision.members import SAFE_MODES
from ..decision.neighbours import RadiusNeighbours
from ..decision.novelty import NoveltyGate, fit_novelty
from ..decision.policy import Policy
from ..decision.references import RadiusIndex
from ..decision.rule import DecisionRule
from ..decision.scripting import (
    arrays_with_prefix,
    attributes_of,
    has_tensor,
    incompatible_model_error,
    module_state,
    restore,
    script,
)
from ..errors import StoreError, expect
from ..folds import content_hash, fold_of
from ..recipe import NOVELTY, Recipe
from ..records import (
    ACTIONS,
    REASONS,
    REPEATS,
    Arrays,
    Embedding,
    Reason,
    State,
    TraceSpec,
    as_success,
)
from ..reducers import class_default, make_reducer
from ..reducers.base import (
    SAME_POINTS,
    FitReport,
    Floats,
    Ints,
    Reducer,
    StopRule,
    as_reducer,
    space_scale,
)
from ..traces import ForceLimitsGate, as_labels, as_traces, clip_extremes
from .base import (
    N_EXAMPLES,
    NO_TRACES,
    EngineModel,
    Prediction,
)

NEWEST = 500  # traces that are searched for repeats: the work does not grow
NEIGHBOURS = 10  # nearest ones before the one that a near repeat is measured by
# A nearest neighbour within this share of the distance to the eleventh is a near repeat; of
# distinct parts about one in two hundred is as near.
NEAR = 0.12
# More near repeats are reported; among 100 to 500 insertions of distinct parts there were up to 15.
MANY_REPEATS = 25
NOVEL = REASONS.index(Reason.NOVEL)
MANY_OF_ONE = 20  # traces of a single part, from which nothing can be learned
KINDS = 16  # compiled modules that a process keeps
N_CHECKS = 2  # times that a restored version must give the same points,
SAME_BATCH = 1e-5  # within this, for the traces are embedded together as before
NOT_RESTORED = (
    "restored, as when its store is opened, it embeds a trace elsewhere or not at all: `forward` "
    "must not be random nor change itself, and must read parameters, buffers and other tensors"
)
OTHERWISE_COMPILED = (
    "a trace that is decided on alone lies elsewhere than the reducer embeds it: `forward` must "
    "depend on nothing but the trace, parameters and other tensors, compiled or not"
)


class Predictor(nn.Module):
    """Encoder, novelty gate, references and rule in one module.

    TorchScript compiles it if it compiles the encoder and the rule.

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
        self.neighbours = neighbours
        self.novel = NOVEL

    @torch.jit.export
    def embed(self, x: Tensor) -> Tensor:
        """Return the embedding (K, d) of one trace (C, T), each space divided by its scale."""
        z: Tensor = self.encoder(x.unsqueeze(0))[0]
        return z / self.scale if self.scaled else z

    def forward(self, x: Tensor, part: int = 0) -> Predicted:
        """Predict one trace (C, T) of float32.

        `part` is the hash of the part that the trace is of; references (labelled points) of this
        part are not counted, and 0 excludes none. Returns the positions of action and reason in
        `ACTIONS` and `REASONS`, the bounds lower and upper of the success probability, the counts
        n_success and n_failure of the labels within the radius (a fixed distance in the embedding),
        and the embedding (K, d), a point in each of K spaces, divided by the scale (unit of length)
        of the space. Several labels of one part may count as fewer. If the decision rule uses the
        bounds only to sort parts, and the reducer gives a probability of success
        (`RadiusNeighbours.scored`), both bounds are the mean of this probability over the K spaces,
        drawn towards 1/2 while few references are known: with n references its logit is multiplied
        by n / (n + the rule's `prior_labels`). A novel trace, unlike all training traces, is
        verified (sent to the slow check) without counting: its bounds are 0 and 1, its counts are
        0.
        """
        z = self.embed(x)
        if self.novelty(x):
            return 0, self.novel, 0.0, 1.0, 0, 0, z
        action, lower, upper, n_success, n_failure = self.neighbours(z, part)
        return action, self.neighbours.reason(action), lower, upper, n_success, n_failure, z


class InPython(nn.Module):
    """Embeds by calling a reducer that has no module, such as umap-learn, in Python."""

    def __init__(self, reducer: Reducer) -> None:
        super().__init__()
        self.reducer = reducer

    def forward(self, x: Tensor) -> Tensor:
        """Return the embeddings (B, K, d) of traces (B, C, T)."""
        return torch.from_numpy(self.reducer.embed(x.numpy()))


# Types of attributes whose values TorchScript compiles into the code, or copies from the template.
CONSTANTS = (bool, int, float, complex, str, type(None), Enum, torch.dtype, torch.device)
FUNCTIONS = (FunctionType, BuiltinFunctionType, torch.jit.ScriptFunction)
# A compiled decider for each structure: scripting takes 24 ms and more, copying a template 1 ms.
_COMPILED: dict[Any, Any] = {}


def template_of(eager: Decider, warm_up_shape: tuple[int, ...]) -> Any:
    """Return the template of a decider: a compiled decider of the same structure (`structure_of`).

    A decider is the module that decides on one trace. Deciders have the same structure if their
    classes, constants and shapes of tensors are the same. If the process keeps no template of this
    structure, `eager`, a decider in Python, is compiled, which takes tens of milliseconds. The new
    template then decides three times on a trace of shape `warm_up_shape` (C, T) whose samples rise
    from 0 to 1, so that later calls are fast. The process keeps it, and drops the oldest if there
    were 16 (`KINDS`) before. All deciders of a structure have the same template, which shares the
    tensors of the decider that was compiled, so do not change it: `compiled` copies it. Raises what
    `script` raises if TorchScript cannot compile the decider, and torch.jit.Error if it cannot run.
    """
    structure = structure_of(eager)
    if (template := _COMPILED.get(structure)) is None:
        template = script(eager)
        x = torch.linspace(0.0, 1.0, math.prod(warm_up_shape)).view(warm_up_shape)
        with torch.inference_mode():
            for _ in range(3):  # TorchScript's first calls compile; a cell should not wait for that
                template(x, 0)
        while len(_COMPILED) >= KINDS:
            _COMPILED.pop(next(iter(_COMPILED)), None)
        _COMPILED[structure] = template
    return template


def structure_of(eager: nn.Module) -> tuple[Any, ...]:
    """Return a hashable key, equal for two modules if one compiled module can serve for both.

    The key holds the class and the attributes of all submodules of `eager`, a module in Python; of
    a tensor it holds only the shape, because `compiled` sets the values. Objects that are no
    constant, tensor, function, list, tuple or dict make no difference. The module of the force
    limits (an operator's limits of the signal) is left out, so that their number makes no
    difference. The class itself is in the key, not its name: a notebook cell that is run again
    defines another class.
    """
    return tuple(
        (path, type(module), _as_key(attributes_of(module)))
        for path, module in eager.named_modules(remove_duplicate=False)
        if not isinstance(module, ForceLimitsGate)  # limits may change in number
    )


def _as_key(value: object) -> object:
    """Return a hashable key of an attribute for `structure_of`; None if it makes no difference.

    `structure_of` finds modules for which one compiled module can serve. A list, tuple or dict
    gives its type and the sorted names and keys of its items. A constant (`CONSTANTS`, like a
    number or a text) gives its text, and a tensor its shape. A function is its own key: its address
    would not do, since another function may get it later. Any other value gives None.
    """
    if isinstance(value, FUNCTIONS):
        return value
    if isinstance(value, CONSTANTS):
        return repr(value)
    if isinstance(value, Tensor):
        return value.shape
    if not isinstance(value, list | tuple | dict):
        return None
    items = value.items() if isinstance(value, dict) else enumerate(value)
    return (type(value), *sorted((repr(name), _as_key(item)) for name, item in items))


def compiled(eager: Decider, warm_up_shape: tuple[int, ...]) -> Any:
    """Return a compiled decider that shares the tensors of an eager one.

    A decider is the module that decides on one trace, the sensor's samples of a part; `eager` is
    one in Python. The result is a copy of the template, a compiled decider that the process keeps
    for all deciders with the same classes, attributes and shapes of tensors (`structure_of`). If
    the process has no such template, `template_of` compiles it, and calls it on a trace of
    `warm_up_shape` (C, T). Raises what `template_of` raises, if TorchScript cannot compile or run
    the decider.
    """
    module = copy.deepcopy(template_of(eager, warm_up_shape))
    submodules = dict(module.named_modules(remove_duplicate=False))
    for path, submodule in eager.named_modules(remove_duplicate=False):
        for name, value in attributes_of(submodule).items():
            if has_tensor(value):
                setattr(submodules[path], name, value)
    return module


def compare_points(decider: Decider, X: Floats, points: Floats) -> str:
    """Compare the embeddings of a decider, which decides on one trace, with a reducer's points.

    Raises what the decider raises, and ValueError if there are not as many points as traces.

    Parameters
    ----------
    decider : Decider
        Compiled or not. It is asked about each trace alone, without the number of a part.
    X : array of float32, shape (n, C, T)
    points : array of float32, shape (n, K, d)
        The embeddings that the reducer gives, one in each of its K spaces, each divided by the
        scale (unit of length) of the space.

    Returns
    -------
    str
        A sentence on what is wrong; "" if the two agree on each trace in which the decider finds no
        fault, such as a NaN: no coordinate is NaN, and each may differ by 0.001 times (1 + its
        absolute value).
    """
    for x, expected in zip(X, points, strict=True):
        with torch.inference_mode():
            verdict = decider(torch.from_numpy(x), 0)
        if verdict[0] == 0 and not is_close(verdict[9].numpy(), expected):
            return OTHERWISE_COMPILED
    return ""


def is_close(points: Floats, expected: Floats, tolerance: float = SAME_POINTS) -> bool:
    """Return whether points are not NaN and equal the expected ones within a tolerance.

    A coordinate may differ by `tolerance` times (1 + the absolute value of the expected one). Equal
    infinities are close. For empty arrays it is True.
    """
    return np.allclose(points, expected, rtol=tolerance, atol=tolerance)


class ModelPrediction(EngineModel):
    """Predicts from traces: reducer, references and decision rule together.

    Embeddings are scaled space by space to a root mean square radius of 1, so that one `radius`
    means the same for every reducer. The scale of space k comes from fold k's traces, whose labels
    that space never saw. A space with a unit of its own (`Reducer.own_unit`), such as a
    probability, is not scaled, so that small differences stay small.

    Parameters
    ----------
    reducer : str, Reducer or object
        A name in `REDUCERS`, a `Reducer`, or any scikit-learn transformer; it is cloned, never
        fitted itself.
    classifier : WilsonRadiusClassifier, optional
        Holds the radius, the policy and the largest number of references; it is never fitted. None:
        one with the reducer's `default_radius`.
    folds : int
        Number of folds K for a transformer that uses labels and does not cross-fit by itself.
    rule : DecisionRule, optional
        Turns counts into an action; None: the rule of the classifier's policy.
    novelty : float
        A trace is novel if it lies farther from the references than this allows, see `Recipe`; 0:
        no trace is novel.

    Attributes
    ----------
    spaces : Reducer
        The fitted reducer, cross-fitted if it uses labels.
    index : RadiusIndex
        The references; set by `fit`.
    scale : array of float32, shape (K,)
        Each space is divided by its scale; set by `fit`.
    gate : NoveltyGate
        Finds novel traces; set by `fit`.
    examples : array of float32, shape (n, C, T)
        Some of the training traces; none in a model that was restored.
    """

    examples: Floats = NO_TRACES

    def __init__(
        self,
        reducer: Any = "conv",
        classifier: WilsonRadiusClassifier | None = None,
        folds: int = 2,
        rule: DecisionRule | None = None,
        novelty: float = NOVELTY,
    ) -> None:
        self.novelty = novelty
        self.folds = folds
        self.reducer = make_reducer(reducer) if isinstance(reducer, str) else reducer
        self.classifier = classifier or WilsonRadiusClassifier(
            class_default(self.reducer, "default_radius")
        )
        self.name = type(self.reducer).__name__
        self.rule = rule or self.classifier.policy().rule()
        self.spaces: Reducer = as_reducer(clone(self.reducer), folds)
        self._note = ""

    @classmethod
    def from_recipe(cls, recipe: Recipe, seed: int = 0) -> Self:
        """Return the untrained model that a `Recipe`, the settings of an engine, describes.

        `seed` is the `random_state` of a reducer that the recipe names, if its class takes that and
        `params` do not set it; it has no effect on a reducer that is an object. Reducer, radius,
        number of folds, novelty limit, policy and decision rule are the recipe's; `recipe.window`
        is the largest number of references (labelled points). A user's class, of the reducer or the
        rule, is imported. Raises SettingError if the reducer or the rule cannot be made; other
        errors of the constructor of a user's class are raised as they are.
        """
        policy = recipe.policy
        return cls(
            recipe.make_reducer(seed),
            WilsonRadiusClassifier(
                recipe.radius,
                alpha=policy.alpha,
                lower_bound=policy.lower_bound,
                interval=policy.interval,
                capacity=recipe.window,
            ),
            recipe.folds,
            policy.rule(),
            recipe.novelty,
        )

    @property
    def user_model(self) -> "ModelPrediction":  # an attribute would be a reference circle
        return self

    @property
    def n_spaces(self) -> int:
        """Number of spaces K: one for a reducer that uses no labels."""
        return self.spaces.n_spaces

    @property
    def min_traces(self) -> int:  # type: ignore[override]  # it depends on the reducer
        """Number of labelled traces that the first training waits for, as the reducer says."""
        return self.spaces.min_traces

    @property
    def report(self) -> FitReport:
        """The report of the reducer's last training; its note also names repeats (`repeats_note`).

        Without a training it is an empty report.
        """
        report = self.spaces.report
        return replace(report, note="; ".join(filter(None, (report.note, self._note))))

    def fit(self, X: ArrayLike, y: ArrayLike, *, hashes: Ints | None = None) -> Self:
        """Train the reducer from scratch, and make the traces the references in place of the old.

        References are the labelled points with which a new trace is compared. If there are more
        traces than the classifier's `capacity`, only the last become references. Extreme samples,
        also infinite ones, are clipped first (`clip_extremes`). The scale (unit of length) of each
        embedding space and the novelty gate (which notices traces unlike these) are computed anew
        as well; the decision rule stays as it is. If the training raises, the reducer is left
        untrained: call `fit` again.

        Parameters
        ----------
        X : array, shape (n, samples) or (n, channels, samples)
        y : array of int, shape (n,)
            1 is success, 0 is failure.
        hashes : array of int64, shape (n,), optional
            `folds.trace_hash` of each trace, which stands for its part and gives its fold (the
            group for cross-fitting). None: `folds.content_hash`.

        Returns
        -------
        self

        Raises
        ------
        SettingError
            If the reducer cannot be trained: there are too few traces, or, for some reducers, a
            single class. If 20 traces or more are all of one part, which means of one hash.
        TraceError, DataError
            If X has another shape or no real numbers, or all samples are below 1e-12 but not all
            are 0; and if a label is neither 1 nor 0.
        ValueError
            If there are not as many labels or hashes as traces, and if a sample is NaN. Other
            errors of a user's transformer are raised as they are.
        """
        X = as_traces(X)
        y = as_labels(y)
        hashes = content_hash(X) if hashes is None else np.asarray(hashes, dtype=np.int64)
        check_consistent_length(X, y, hashes)
        self.spaces = as_reducer(clone(self.reducer), self.folds)
        return self.train(X, y, hashes)

    def train(
        self,
        X: Floats,
        y: NDArray[Any],
        hashes: Ints,
        stop: StopRule | None = None,
        numbers: Ints | None = None,
    ) -> Self:
        """Train the reducer on traces (n, C, T), and replace the references by them; return self.

        The reducer maps traces to points; references are the labelled points with which a new trace
        is compared. y (n,) are labels, 1 good or 0 bad; `hashes` (n,) stand for the parts, and give
        the folds for cross-fitting; `numbers` (n,), the labels' sequence numbers, are kept with the
        references, and by them the reducer finds what it computed in advance (`precompute`); `stop`
        may end its training early, after a number of steps or at a deadline. Extreme samples are
        clipped first. A reducer that can go on from its last training does so. If there are more
        traces than the classifier's `capacity`, only the last become references.

        Replaced are `index` (the references), `scale` (the divisor of the points in each embedding
        space), `gate` (the novelty gate, which notices traces unlike these; disabled if `novelty`
        is 0, or if fewer than 20 traces differ in part and content, see `fit_novelty`), `examples`
        (up to 8 of the traces), `trace_shape`, and in `report` the note on parts that seem to have
        come twice. The module that decides is dropped and built anew when it is used; the decision
        rule stays as it is.

        Raises what the reducer's `train` raises, such as SettingError if it cannot be trained on
        these traces, and SettingError if 20 traces or more are all of one part. If the reducer
        raises, it may be changed already; all else is not.
        """
        X = clip_extremes(X)
        y = y.astype(np.int64)
        n = len(X)
        is_one_part = n >= MANY_OF_ONE and (hashes == hashes[0]).all()
        expect(
            not is_one_part,
            "traces of several parts",
            f"{n} of one: all have its number, or are the same to 1/65536 of their unit",
            "check part=, the sensor and the unit",
        )
        folds = fold_of(hashes, self.n_spaces)
        points = self.spaces.train(X, y, folds, stop, numbers)
        self.trace_shape = X.shape[1:]
        if self.spaces.own_unit:
            self.scale = np.ones(self.n_spaces, np.float32)
        else:
            self.scale = space_scale(points, folds, self.n_spaces)
        self.index = RadiusIndex(points.shape[1], self.classifier.capacity)
        self.index.add(points / self.scale[folds, None], y, folds, hashes, numbers)
        self.index.estimate_agreement()
        self.examples = X[np.linspace(0, n - 1, min(n, N_EXAMPLES)).astype(int)]
        self._note = repeats_note(X, hashes)
        if self.novelty:
            self.gate = fit_novelty(X, self.novelty, hashes)
        else:
            self.gate = NoveltyGate(*self.trace_shape)
        self._decider = None  # built by `prepare`, or when it is used first
        return self

    def warm_up(self) -> None:
        self.spaces.warm_up()

    def precompute(self, X: Floats, numbers: Ints | None = None) -> None:
        """Let the reducer compute in advance what a training on these traces (n, C, T) begins with.

        `numbers` are the sequence numbers of the traces' labels, by which the reducer finds its
        results again; without them a reducer of dengine keeps none. Samples far larger than usual
        are clipped first (`clip_extremes`). Before the first training, if the reducer gives an
        `untrained_module` and the decision rule is `scriptable`, a decider (the module that decides
        on a trace) without references (labelled points) is compiled as well, because the first
        training has no time for that; the process keeps it as a template (`template_of`). Raises
        what `template_of` and the reducer raise.
        """
        X = clip_extremes(X)
        encoder = self.spaces.untrained_module(X)
        self.spaces.precompute(X, numbers)
        if "index" not in vars(self) and encoder is not None and self.rule.scriptable:
            model = copy.copy(self)
            model.trace_shape = X.shape[1:]
            model.gate = NoveltyGate(*model.trace_shape)
            model.gate.disabled = not self.novelty
            model.index = RadiusIndex(encoder.dim, self.classifier.capacity)
            model.scale = np.ones(self.n_spaces, np.float32)
            template_of(model._eager_decider(encoder, None), model.trace_shape)

    def prepare(self, previous: EngineModel) -> None:
        """Take over the decision rule object of the previous model, and build the decider.

        A rule turns the bounds of a success probability into an action. If the rule of either model
        is stale, because an update of it failed, this model is stale afterwards. The decider, the
        module that decides on one trace, is built for the `DecisionConditions` (force limits,
        sensor range and audits) under which the previous model decided, or, if that never decided,
        for those of this model, if it has any. A decider that this model has already, with the same
        rule and for the same conditions, is kept. Nothing happens if the previous model is no
        `ModelPrediction`. Raises what `build_decider` raises; the rule is taken over all the same.
        """
        if not isinstance(previous, ModelPrediction):
            return
        if self.rule is not previous.rule:
            self.rule = previous.rule
            self._decider = None
        self.rule_is_stale = self.rule_is_stale or previous.rule_is_stale
        self.decider(previous._conditions or self._conditions)

    def build_decider(self, conditions: DecisionConditions | None) -> Decider:
        """Build a decider, the module that decides on a trace, for this model.

        It shares the references (labelled points) and the decision rule of this model. It is
        returned, not kept; `decider` keeps one.

        Parameters
        ----------
        conditions : DecisionConditions or None
            Force limits (an operator's limits of the signal), range of the sensor, and audits
            (random checks of parts about which the model is certain). None stands for no force
            limits, a sensor without a known range, and no audits.

        Returns
        -------
        Decider
            Compiled if the reducer has a module (`Reducer.module`) and the rule is `scriptable`.
            Otherwise it runs in Python, and only some of its submodules are compiled.

        Raises
        ------
        ValueError, AttributeError
            If nothing was fitted.
        SettingError
            If the force limits do not fit the traces.
        RuntimeError, torch.jit.Error, FrontendError, OSError
            If TorchScript cannot compile or run the reducer's module or a `scriptable` rule, see
            `script`. There is no way back to Python then.
        """
        encoder = self.spaces.module()
        if encoder is not None and self.rule.scriptable:
            decider: Decider = compiled(self._eager_decider(encoder, conditions), self.trace_shape)
            return decider
        encoder = InPython(self.spaces) if encoder is None else script(encoder)
        decider = self._eager_decider(encoder, conditions)
        decider.predictor.novelty = script(self.gate)
        if self.rule.scriptable:
            decider.predictor.neighbours = script(decider.predictor.neighbours)
        return decider

    def _eager_decider(self, encoder: Any, conditions: DecisionConditions | None) -> Decider:
        """Return the module that decides on a trace, not compiled, in evaluation mode.

        `encoder` is the module that embeds, (B, C, T) -> (B, K, d), compiled or not. The result
        shares references (labelled points), decision rule and novelty gate (which notices traces
        unlike those of the training) with this model. `conditions` are force limits, sensor range
        and audits, as in `build_decider`. Raises SettingError if the force limits do not fit the
        traces, and AttributeError if nothing was fitted.
        """
        predictor = Predictor(
            encoder,
            torch.from_numpy(self.scale),
            self.gate,
            self.classifier.neighbours_over(self.index, self.rule, self.spaces.scores),
        )
        conditions = conditions or DecisionConditions(self.trace_spec)
        return Decider(predictor, conditions, (self.n_spaces, self.index.dim)).eval()

    @property
    def trace_spec(self) -> TraceSpec:
        """`TraceSpec` with the shape of the training traces, all else as by default.

        A `TraceSpec` says what traces look like: shape, sampling rate, units. Raises ValueError if
        nothing was fitted.
        """
        if "index" not in vars(self):
            raise ValueError("Expected a fitted model; call fit(X, y) first.")
        channels, samples = self.trace_shape
        return TraceSpec(samples, channels=channels)

    @property
    def predictor(self) -> Any:
        """The `Predictor` in the decider; a decider is built and kept if none is.

        Raises ValueError if nothing was fitted, and what `build_decider` raises.
        """
        return self.decider(self._conditions).predictor

    def add(self, x: ArrayLike, y: ArrayLike) -> Self:
        """Make one labelled trace, shape (samples,) or (channels, samples), a reference.

        `y` is 1 for success, 0 for failure. The hash of the trace's content gives the fold and
        stands for the part. The reducer is not trained, and a full index drops its oldest
        reference. Samples are neither checked nor clipped here: a NaN makes a reference of NaN, but
        some reducers that embed in Python raise ValueError for it. Returns self. Raises ValueError
        if nothing was fitted or the rows of the trace have different lengths, TraceError for a
        trace of another shape or length, or not of real numbers, and ReportError for another label;
        also what `build_decider` raises, if no decider is kept.
        """
        X = as_traces(np.asarray(x)[None], self.trace_spec)
        self.add_reference(X[0], int(as_success(np.asarray(y))), int(content_hash(X)[0]))
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
        """Make one labelled trace (channels, samples) a reference in the space of its fold.

        A reference is a labelled point with which a new trace is compared. The hash of its part,
        `hash_`, gives the fold, one of K permanent groups, which is also the number of the
        embedding space. The reference point is `point` if given, otherwise the row of `embedding`
        (K, d) for that space, both divided by the scale (unit of length) of the space already;
        without both it is computed from the trace. If there is no room, the oldest reference is
        dropped. `y` is 1 for success, 0 for failure; `number` is the sequence number of this label.
        Returns the reference point, float32 (d,), divided by the scale. If it must be computed, the
        reducer's encoder gets the trace unchecked and may raise errors of its own, and a decider
        (the module that decides on a trace) is built and kept if none is, which raises what
        `build_decider` raises (ValueError or AttributeError if nothing was fitted). Otherwise
        raises AttributeError if nothing was fitted.
        """
        # The fold of a hash is also the space of its reference.
        fold = int(fold_of(hash_, self.n_spaces))
        if point is None:
            if embedding is None:
                with torch.inference_mode():
                    embedding = self.predictor.embed(torch.from_numpy(x)).numpy()
            point = np.array(embedding[fold], dtype=np.float32)
        self.index.add_one(torch.from_numpy(np.array(point)), float(y), fold, hash_, number)
        return point

    def renumber_reference(self, old: int, new: int) -> None:
        self.index.renumber(old, new)

    def change_reference(self, number: int, hash_: int, y: int | None) -> bool:
        """Relabel the reference with this label number, or remove it if `y` is None.

        Returns False, with nothing changed, if it is of another part than `hash_`. Returns True
        otherwise, also if the reference has left the index (`RadiusIndex.relabel`).
        """
        return self.index.relabel(number, hash_, y)

    def update_rule(
        self,
        lower: float,
        upper: float,
        success: bool,
        novel: bool,
        n_unreported: int,
        predicted: int = 0,
        inclusion_probability: float = 1.0,
    ) -> None:
        """Update the decision rule, in place, with the outcome of one part.

        The rule's `observe` gets `n_unreported`, the number of accepted parts without a known
        outcome since the last update, and `novel`, whether the part's trace was unlike all training
        traces; then its `update` gets the bound on the success probability by which the part was
        decided (`lower`, `upper`), the label `success`, what the model alone would have done
        (`predicted`: 0 verify, 1 accept, 2 reject), and the probability, fixed beforehand, that the
        outcome would be asked for. The next decision is by the new state. If `observe` or `update`
        raises, the exception is passed on, and `rule_is_stale` becomes True; later updates leave it
        True.
        """
        was_stale = self.rule_is_stale
        self.rule_is_stale = True
        before = self.rule.state_dict()
        self.rule.observe(n_unreported, novel)
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
        """Reset the rule, so that no outcome counts; it starts in this safe mode, a `SafeMode`.

        NONE is no safe mode. The rule is reset in place, because the compiled module shares
        its tensors. `rule_is_stale` stays as it is.
        """
        self.rule.load_state_dict(self.rule.clone().state_dict())
        self.rule.start_in_safe_mode(safe_mode)

    @property
    def rule_learns(self) -> bool:  # type: ignore[override]  # it depends on the rule
        return self.rule.learns()

    def with_policy(self, policy: Policy) -> Self:
        """Return a model under another policy; it shares all that was trained.

        A policy holds the settings of decisions, such as error level and lower bound. The decision
        rule of the new model has learned nothing, and is not stale (no update of it failed); the
        module that decides is not built yet. This model does not change. But the two share reducer
        and references (labelled points): a reference that is added, relabelled or removed in one is
        so in the other, and `train` of one trains the reducer of both; so train a `successor`,
        which has a copy of the reducer, instead. Raises what `Policy.rule` raises, such as
        SettingError if the rule cannot be made.
        """
        model = copy.copy(self)
        model.classifier = clone(self.classifier).set_params(
            alpha=policy.alpha, lower_bound=policy.lower_bound, interval=policy.interval
        )
        model.rule = policy.rule()
        model.rule_is_stale = False
        model._decider = None
        return model

    @property
    def safe_mode(self) -> str:
        """Why the rule's safe mode began, a text of `SAFE_MODES`; "" outside a safe mode."""
        return SAFE_MODES[self.rule.safe_mode()]

    def predict_one(self, x: Floats, hash_: int = 0) -> Prediction:
        """Predict one trace (channels, samples) without fault checks, force limits and audits.

        Returns action, bounds of the success probability, numbers of good and bad labels nearby,
        embedding (K, d), a point in each of K spaces, and reason, as a `Prediction`. Left out are
        force limits (an operator's limits of the signal) and audits (random checks of parts about
        which the model is certain). References (labelled points) of the part with the hash `hash_`
        are not counted; 0 excludes none. The trace is not checked, and what the reducer's encoder
        or the rule raises is raised. A decider (the module that decides) is built and kept if none
        is. Raises RuntimeError if the decision rule is stale, because an update of it failed, and
        what `build_decider` raises (ValueError or AttributeError if nothing was fitted).
        """
        with torch.inference_mode():
            action, reason, lower, upper, n_success, n_failure, z = self.predictor(
                torch.from_numpy(x), hash_
            )
        self._check_rule()
        embedding = tuple(map(tuple, z.tolist()))
        return Prediction(
            ACTIONS[action], lower, upper, n_success, n_failure, embedding, REASONS[reason]
        )

    def decide_one(self, x: Floats, part_hash: int, conditions: DecisionConditions) -> Verdict:
        """Decide on one raw trace x (C, T), in the unit of the sensor, under these conditions.

        The `conditions` are force limits (an operator's limits of the signal), sensor range and
        audits (random checks of parts about which the model is certain). The decider, the module
        that decides, is built first, and kept, unless the model keeps a decider for these
        conditions. References (labelled points) of the part with the hash `part_hash` are not
        counted. 0 stands for a part without a number: then references with the same content hash as
        the trace are not counted.

        Returns
        -------
        Verdict
            The tuple that `Decider.forward` returns: fault and content hash of the trace, action,
            action of the model alone, reason, bounds of the success probability (lower, upper),
            numbers of good and bad labels nearby, embedding, and the probability with which the
            part is checked. The embedding (K, d) has a point in each of the K embedding spaces,
            divided by the scale (unit of length) of the space.

        Raises
        ------
        RuntimeError
            If the decision rule is stale, because an update of it failed, and the trace has no
            fault, even if a force limit decides. A faulty trace (NaN, constant, ...) gets VERIFY
            without the rule.
        ValueError, ...
            What `build_decider`, the reducer's encoder or the rule raises.
        """
        decider = self.decider(conditions)
        # As `torch.inference_mode`, whose entering costs 3 % of a decision.
        with torch._C._InferenceMode(True):
            verdict = decider.forward(torch.from_numpy(x), part_hash)
        if verdict[0] == 0:  # a faulty trace does not ask the rule
            self._check_rule()
        return verdict

    def _check_rule(self) -> None:
        """Raise RuntimeError if the rule is stale: an update of it failed."""
        if self.rule_is_stale:
            raise RuntimeError("the rule has missed what became of a part, so it cannot be asked")

    def predict_many(self, X: ArrayLike) -> list[Prediction]:
        """Predict each trace of X, shape (n, samples) or (n, channels, samples).

        Raises TraceError for traces of another shape than those it was trained on, and what
        `predict_one` raises. No part is excluded.
        """
        return [self.predict_one(x) for x in as_traces(X, self.trace_spec)]

    def count(self, X: ArrayLike) -> tuple[Ints, Ints]:
        """Count the labels in the neighbourhood of each trace of X, summed over the K spaces.

        X has the shape (n, samples) or (n, channels, samples). Returns (n_success, n_failure), each
        an array of int64, shape (n,); 0 for a novel trace. No part is excluded, so a reference
        counts itself. Raises TraceError for another shape, and what `predict_one` raises.
        """
        predictions = self.predict_many(X)
        return (
            np.array([prediction.n_success for prediction in predictions], np.int64),
            np.array([prediction.n_failure for prediction in predictions], np.int64),
        )

    def predict_interval(self, X: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return (lower, upper), each float64 (n,): the bounds of each trace's success probability.

        X has the shape (n, samples) or (n, channels, samples). The bound is (0, 1) for a novel
        trace. Raises TraceError for another shape, and what `predict_one` raises.
        """
        predictions = self.predict_many(X)
        return (
            np.array([prediction.lower for prediction in predictions]),
            np.array([prediction.upper for prediction in predictions]),
        )

    def decide(self, X: ArrayLike) -> NDArray[Any]:
        """Return an array of `Action`, shape (n,): what the model would do with each trace.

        Force limits, fault checks and audits have no part in it. Raises what `count` raises.
        """
        return np.array([prediction.action for prediction in self.predict_many(X)], dtype=object)

    def successor(self) -> "ModelPrediction":
        """Return a model to train next, with a copy of this one's reducer to start from.

        Its module that decides is not built yet. It shares decision rule, references (labelled
        points), scale (the divisor of the points in each embedding space) and novelty gate (which
        notices traces unlike those of the training) with this model. Training replaces the last
        three in the successor only, so this model goes on deciding.
        """
        model = copy.copy(self)
        model.spaces = copy.deepcopy(self.spaces)
        model._decider = None
        model._note = ""
        return model

    def defect(self) -> str:
        """Return why an engine must not use this trained model; "" if no test finds a reason.

        The references (labelled points) must be finite, and the reducer, which maps traces to
        points, must map `examples`, some training traces, to no NaN. A reducer that is restored
        from the state of this one must map `examples` to the same points, twice in a row; each
        coordinate may differ by 1e-5 times (1 + its absolute value). If this reducer gives no
        state, it is itself asked twice in place of a restored reducer. The points, divided by the
        scale of their embedding space, are kept for `check_answers`, unless a reference is not
        finite. If restoring raises a StoreError, that is a defect; other errors are raised. Call
        this right after a training: a restored model has no `examples`, and some reducers raise
        TraceError then.
        """
        if not np.isfinite(self.index.column("points")).all():
            return "the embedding of a reference is not finite"
        points = self.spaces.embed(self.examples)
        self._example_points = points / self.scale[:, None]
        state = self.spaces.get_state()
        restored = self.spaces
        try:
            if state is not None:
                restored = as_reducer(clone(self.reducer), self.folds).set_state(state)
        except StoreError:  # of the test trace, whose points `set_state` compares
            return NOT_RESTORED
        is_restored = all(
            is_close(restored.embed(self.examples), points, SAME_BATCH) for _ in range(N_CHECKS)
        )
        return "" if is_restored else NOT_RESTORED

    def check_answers(self) -> str:
        """Compare the decider's embeddings of `examples` with the points that `defect` kept.

        Returns why the model must not be used, "" if it may be used. Call `defect` before. Raises
        what `build_decider` raises, and what the decider raises.
        """
        return compare_points(self.decider(self._conditions), self.examples, self._example_points)

    def get_state(self) -> State:
        """Return the state as arrays by name, which `set_state` takes.

        Trace shape, references (labelled points) and scale (the divisor of the points in each
        embedding space) are always in it. The names of the arrays of the reducer, the decision rule
        and the novelty gate (which notices traces unlike those of the training) begin with
        "reducer.", "rule." and "novelty.". A reducer without a state and a disabled gate have no
        arrays. If the rule is stale (an update of it failed), there is "rule_is_stale" in place of
        its arrays. Arrays of the scale and the reducer may be views. Raises AttributeError before
        the first training.
        """
        state: State = {"trace_shape": np.array(self.trace_shape), "scale": self.scale}
        state |= self.index.get_state()
        if self.rule_is_stale:
            state["rule_is_stale"] = np.array(True)  # an engine that opens the store rebuilds it
        else:
            state |= module_state(self.rule, "rule.")
        if not self.gate.disabled:
            state |= module_state(self.gate, "novelty.")
        return state | {
            f"reducer.{name}": values for name, values in (self.spaces.get_state() or {}).items()
        }

    def set_state(self, state: Arrays) -> Self:
        """Restore the state that `get_state` returned; returns self.

        Trace shape, references (labelled points), scale (the divisor of the points in each
        embedding space), decision rule (in place) and novelty gate (which notices traces unlike
        those of the training) are restored, and the reducer if the state holds it. If it does not
        (`needs_refit`), train this model on the same traces before this call. The module that
        decides is dropped and built anew when it is used; `examples` (some of the training traces)
        stay. If the classifier's `capacity` is smaller than the number of references, the newest
        are kept. If the state has no arrays of a rule, because the rule was stale (an update of it
        had failed) or has no tensors, this model's rule stays as it is; `rule_is_stale` always
        stays as it is. Raises StoreError if the state holds no reducer although this fitted reducer
        gives a state, and for a rule or gate of other sizes. For the state of another reducer it
        raises StoreError, KeyError, ValueError or NotImplementedError. After an error do not use
        the model.
        """
        if not self.needs_refit(state):
            self.spaces.set_state(arrays_with_prefix(state, "reducer."))
        elif self.spaces.get_state() is not None:
            # Another reducer of that name, which would embed traces elsewhere.
            raise incompatible_model_error(f"{type(self.spaces).__name__} has no state")
        self.trace_shape = tuple(map(int, state["trace_shape"]))
        self.scale = state["scale"]
        self.index = RadiusIndex.from_state(state, self.classifier.capacity)
        self.gate = NoveltyGate(*self.trace_shape)
        self.gate.disabled = not arrays_with_prefix(state, "novelty.")
        for module, prefix in ((self.rule, "rule."), (self.gate, "novelty.")):
            if arrays := arrays_with_prefix(state, prefix):
                restore(module, arrays)
        self._decider = None
        return self

    def needs_refit(self, state: Arrays) -> bool:
        """Return whether a state does not hold the reducer, which must then be trained again.

        The state holds it if the name of an array begins with "reducer.".
        """
        return not arrays_with_prefix(state, "reducer.")

    def __getstate__(self) -> dict[str, Any]:
        # A scripted module does not travel between processes; the receiver builds its own.
        return self.__dict__ | {"_decider": None}


def near_repeats(traces: Floats, parts: Ints) -> int:
    """Count the traces among the newest 500 that nearly repeat a trace of another part.

    Labels are counted as independent trials, so a part that comes again must be given the number by
    which it is known (`part=`). This function notices plain cases in which it was not; no decision
    depends on it. A trace is compared with the traces of other parts only, by the distance between
    the means of 50 to 99 stretches of samples (fewer if there are fewer samples), from which the
    mean over all traces is subtracted, in units of the standard deviation of the channel. A trace
    counts if the nearest of the others is nearer than 0.12 times the distance to the eleventh
    nearest (`NEAR`, `NEIGHBOURS`), and the eleventh nearest is farther than 1e-6. So a trace with
    11 or more equally near traces does not count. If there are only 1 to 10 traces of other parts,
    the eleventh counts as infinitely far, so the trace counts.

    Parameters
    ----------
    traces : array of float32, shape (n, channels, samples)
        Oldest first; only the newest 500 (`NEWEST`) are read, and they are compared with each
        other.
    parts : array of int64, shape (n,)
        Hash of each trace's part; if the part is unknown, the content hash of the trace, not 0.
        Traces with equal hashes are not compared.

    Returns
    -------
    int
        0 for fewer than 100 traces.
    """
    traces = traces[-NEWEST:]
    parts = parts[-NEWEST:]
    if len(traces) < 100:
        return 0
    n, channels, samples = traces.shape
    # Means of equal stretches, so that the sensor's noise makes no difference.
    length = max(1, samples // 50)
    stretches = traces[:, :, : samples // length * length].astype(np.float64)
    means = stretches.reshape(n, channels, -1, length).mean(3)
    scale = means.std((0, 2), keepdims=True)
    scaled = (means - means.mean(0)) / np.where(scale > 0, scale, 1.0)
    rows = torch.from_numpy(scaled.reshape(n, -1))
    distances = torch.cdist(rows, rows).numpy()
    distances[parts[:, None] == parts] = np.inf
    # A quarter of the time of `kthvalue`.
    eleventh = np.partition(distances, NEIGHBOURS)[:, NEIGHBOURS]
    return int(((distances.min(1) < NEAR * eleventh) & (eleventh > 1e-6)).sum())


def repeats_note(traces: Floats, parts: Ints) -> str:
    """Return a note for the report of a retrain if many traces nearly repeat another, else "".

    The note advises to give the parts' numbers, by which a part is known when it comes again,
    because parts seem to have come twice without one. It takes the arguments of `near_repeats`,
    which counts such traces among the newest 500: traces (n, C, T), oldest first, and `parts`, the
    hash of the part of each, or the content hash if the part is unknown. More than 25 traces
    (`MANY_REPEATS`) are many; fewer than 100 traces have none.
    """
    n_repeats = near_repeats(traces, parts)
    if n_repeats <= MANY_REPEATS:
        return ""
    return (
        f"{n_repeats} of the newest {min(len(traces), NEWEST)} {REPEATS}: "
        "if parts come twice, give their numbers (part=)"
    )
