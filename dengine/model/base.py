"""Two contracts: what a baseline method must give (`Model`), and what the engine drives (`EngineModel`).

`BaselineAdapter` makes an `EngineModel` of a baseline; our own, `neighbours.ModelPrediction`, is both.
"""

from __future__ import annotations

import copy
import logging
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol, Self, TypeVar, runtime_checkable

import torch
from numpy.typing import NDArray

from ..decision.policy import Policy
from ..errors import ExportError, SettingError, shortened
from ..limits import ForceLimits
from ..recipe import Recipe
from ..records import Action, Reason, TraceSpec
from ..reducers.base import FitReport, Floats, Ints, State, StopRule
from ..traces import clip_extremes

log = logging.getLogger("dengine")

Embedding = tuple[tuple[float, ...], ...]  # (K, d)
T = TypeVar("T")


class Prediction(NamedTuple):
    """What a model says of one trace; fields as in `Decision`."""

    action: Action
    lower: float
    upper: float
    n_success: int
    n_failure: int
    embedding: Embedding | None
    reason: Reason


Gate = Callable[[Any], tuple[int, int]]  # a trace (C, T) -> fault, content hash
Looked = tuple[int, int, Prediction | None]  # fault, content hash, what a model says of a trace without a fault


@runtime_checkable
class Model(Protocol):
    """What a baseline method must give, and no more. X is (n, C, T) float32, y (n,) of 1 = success and 0 = failure."""

    def fit(self, X: Any, y: Any) -> Any:
        """Train anew on labelled traces."""

    def add(self, x: Any, y: Any) -> Any:
        """Take in one labelled trace (C, T) between two trainings."""

    def count(self, X: Any) -> tuple[Any, Any]:
        """(n_success, n_failure) behind each prediction."""

    def predict_interval(self, X: Any) -> tuple[Any, Any]:
        """(lower, upper) of each success probability."""

    def decide(self, X: Any) -> Any:
        """An `Action` for each trace."""


class EngineModel(ABC):
    """What the engine drives: it predicts, takes references, trains a successor, and is stored.

    user_model : what `DataEngine.model` shows, the model as its author knows it.  name : in a status or a table.
    description : what it is, its numbers included, the same at every start: a store compares it.
    untold : whether its rule missed what became of a part; it then raises instead of predicting.
    keeps_references : whether its state and the points stored with labels restore its references; a baseline is refitted.
    min_traces : how many labelled traces the first training waits for.
    is_compiled : whether no Python runs where it is asked, once it is trained.
    """

    keeps_references = True
    is_compiled = False
    min_traces = 1
    untold = False

    user_model: Any
    name: str
    description: str

    def in_force(self, recipe: Recipe) -> Recipe:
        """A recipe with this model's own numbers in the place of those that have no effect on it."""
        return recipe

    @abstractmethod
    def train(
        self, X: Floats, y: NDArray[Any], hashes: Ints, stop: StopRule | None = None, numbers: Ints | None = None
    ) -> Self:
        """Learn from traces (n, C, T), labels, parts' hashes and labels' numbers (n,), from where a training ended."""

    def warm_up(self) -> None:  # noqa: B027  # a default: nothing to load
        """Load what the first training would load, beside the engine; see `Reducer.warm_up`."""

    def precompute(self, X: Floats, numbers: Ints | None = None) -> None:  # noqa: B027  # a default: nothing to begin with
        """Begin with a training on traces (n, C, T) with labels of these numbers; see `Reducer.precompute`."""

    @abstractmethod
    def predict_one(self, x: Floats, hash_: int = 0) -> Prediction:
        """What it says of one trace (C, T) of the part with this hash (0: it is nobody's), which has no vote on itself."""

    def look(self, x: Floats, part: int | None, gate: Gate, limit: float) -> Looked:
        """Fault and content hash of one trace (C, T), and what it says of it where there is no fault.

        part : the hash of its part's number; None: it goes by its content.  gate : `TraceGate` by the sensor's `limit`.
        """
        fault, content = gate(torch.from_numpy(x))
        return fault, content, None if fault else self.predict_one(x, content if part is None else part)

    @abstractmethod
    def reference_point(self, x: Floats, hash_: int, embedding: Embedding | None = None) -> Floats:
        """Where a trace (C, T) with this hash lies as a reference; embedding : (K, d), where it is computed already."""

    @abstractmethod
    def add_reference(self, point: Floats, y: int, hash_: int, number: int = 0) -> None:
        """Make a labelled trace a reference, by its point; number : of its label."""

    def renumber_reference(self, was: int, number: int) -> None:  # noqa: B027  # a default: a baseline numbers nothing
        """Give a reference the number that its label has by now."""

    def change_reference(self, number: int, hash_: int, y: int | None) -> bool:
        """Give the reference of a label another one, or take it out where `y` is None; False where it is another hash's."""
        return False

    @property
    def remembers(self) -> bool:
        """Whether its rule learns anything from being told what became of parts."""
        return False

    def under(self, policy: Policy) -> Self:
        """The same model, references shared, under another policy, with a rule that was told nothing yet."""
        return self

    def begin_safely_in(self, mode: int) -> None:  # noqa: B027  # a default: it has no safe mode
        """Verify everything for this reason, a position in `SAFE_MODES`, until fresh evidence keeps the tolerance."""

    @abstractmethod
    def successor(self) -> EngineModel:
        """A model to train next, from where this one is; nothing that training changes is shared, so this one goes on."""

    def prepare(self, previous: EngineModel) -> None:  # noqa: B027  # a default: nothing to prepare
        """Be ready to answer at once, in the place of `previous`."""

    def tell(  # noqa: B027  # a default: nothing to learn
        self, lower: float, upper: float, success: bool, novel: bool, unobserved: int,
        predicted: int = 0, looked: float = 1.0,
    ) -> None:  # fmt: skip
        """Learn what became of a part.

        lower, upper : the bound that it was decided by, before its label was known.  success : its label.
        novel : whether it was like nothing learned from.  unobserved : accepted parts of no known outcome since the last.
        predicted, looked : as in `DecisionRule.tell`.
        """

    def forget(self) -> None:  # noqa: B027  # a default: nothing was learned
        """Be as if nothing had been told."""

    @property
    def safe_mode(self) -> str:
        """Why everything is verified at present; "" where it is not."""
        return ""

    def defect(self) -> str:
        """Why it must not answer after a training, label-free reasons only; "" where there is nothing against it."""
        return ""

    @property
    def report(self) -> FitReport:
        """What the last training says of itself."""
        return FitReport()

    def get_state(self) -> State:
        """Plain arrays for the store."""
        return {}

    def set_state(self, state: Mapping[str, NDArray[Any]]) -> Self:
        """Restore what `get_state` gave."""
        return self

    def needs_refit(self, state: Mapping[str, NDArray[Any]]) -> bool:
        """Whether a training on the very traces of that state must come before `set_state`."""
        return True

    def exported(self, trace: TraceSpec | None) -> Exportable:
        """What an exporter starts from; ExportError where there is nothing that can be exported."""
        raise ExportError(f"{self.name} is a baseline and stays in Python; only dengine's own model can be exported.")

    # No exception inside a model reaches the cell or costs a label. The engine's calls go through these five.

    def precompute_safely(self, X: Floats, numbers: Ints | None = None) -> None:
        """`precompute`, or nothing where it fails."""
        _guarded(lambda: self.precompute(X, numbers), "traces could not be looked at ahead of a retrain")

    def tell_safely(self, *told: Any) -> None:
        """`tell`; a model whose rule fails at it must not decide any more: `untold`."""
        try:
            self.tell(*told)
        except Exception:
            self.untold = True
            log.exception("the rule cannot be told of a part; every part is verified until the engine is opened again")

    def prepare_safely(self, previous: EngineModel) -> None:
        """`prepare`; one that fails at it will verify, and say so, on every part."""
        _guarded(lambda: self.prepare(previous), "the model that was trained cannot be made to answer")

    def place_safely(self, x: Floats, hash_: int, embedding: Embedding | None = None) -> Floats | None:
        """`reference_point`, or None where it fails."""
        failed = "the model cannot place a labelled trace; the next version learns it from the store"
        return _guarded(lambda: self.reference_point(x, hash_, embedding), failed)

    def add_safely(self, point: Floats | None, y: int, hash_: int, number: int) -> None:
        """`add_reference`, where there is a point; nothing where it fails."""
        if point is not None:
            failed = "the model cannot take a labelled trace; the next version learns it from the store"
            _guarded(lambda: self.add_reference(point, y, hash_, number), failed)


def _guarded(call: Callable[[], T], failed: str) -> T | None:
    """What the call returns; None, logged, where it raises."""
    try:
        return call()
    except Exception:
        log.exception(failed)
        return None


def as_engine_model(model: Model) -> EngineModel:
    """A model as the engine drives it: our own as it is, a baseline adapted. SettingError for what is no model."""
    if isinstance(model, EngineModel):
        return model
    if isinstance(model, type) or not isinstance(model, Model):
        raise SettingError(f"Expected a model with fit, add, count, predict_interval and decide, got {model!r}.")
    return BaselineAdapter(model)


class BaselineAdapter(EngineModel):
    """Makes an `EngineModel` of a baseline. It decides by its own rule, and it is trained on a deep copy."""

    keeps_references = False

    def __init__(self, model: Model) -> None:
        self.model = self.user_model = model
        self.name, self.description = type(model).__name__, type(model).__qualname__  # its settings are its author's affair

    def train(self, X: Floats, y: NDArray[Any], *_: object, **__: object) -> Self:
        self.model.fit(clip_extremes(X).copy(), y)  # the window's own, which a baseline may write to
        return self

    def predict_one(self, x: Floats, hash_: int = 0) -> Prediction:
        """The baseline's own decision on one trace (C, T), with its evidence; it knows nothing of parts."""
        X = x[None]
        (lower,), (upper,) = self.model.predict_interval(X)
        (n_success,), (n_failure,) = self.model.count(X)
        action = Action(self.model.decide(X)[0])
        reason = Reason.UNCERTAIN if action is Action.VERIFY else Reason.CERTAIN
        counts = int(n_success), int(n_failure)
        if counts != (n_success, n_failure) or not all(0 <= n < 2**63 for n in counts):
            raise ValueError(f"Expected whole numbers of labels below 2**63, got {shortened((n_success, n_failure))}.")
        return Prediction(action, float(lower), float(upper), *counts, None, reason)

    def reference_point(self, x: Floats, hash_: int, embedding: Embedding | None = None) -> Floats:
        return x

    def add_reference(self, point: Floats, y: int, hash_: int, number: int = 0) -> None:
        self.model.add(point, y)

    def successor(self) -> BaselineAdapter:
        return BaselineAdapter(copy.deepcopy(self.model))


@dataclass(frozen=True, slots=True)
class Exportable:
    """What an exporter starts from.

    model : fitted.  trace : the contract of its traces.  audit_rate, seed : of the audits' coin.
    windows : an operator's, as they act.  stops_all : whether silence until the next decision confirms an accepted part.
    model_version, recipe : what the file says of the engine; 0 and "" without one.
    note : takes what is to be remembered of the export, a kind and a text, as `SqlStore.put_event`; None: nobody remembers.
    """

    model: Any
    trace: TraceSpec
    audit_rate: float = 0.0
    seed: int = 0
    stops_all: bool = False
    windows: tuple[ForceLimits, ...] = ()
    model_version: int = 0
    recipe: str = ""
    note: Callable[[str, str], object] | None = None

    def exported(self, trace: TraceSpec | None = None) -> Exportable:
        """Itself, as of what exports it; trace : another contract."""
        return self if trace is None else replace(self, trace=trace)
