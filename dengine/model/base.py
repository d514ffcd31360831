"""The two interfaces of a model: `Model` for baselines, `EngineModel` for the engine. The file also
holds `Prediction`, what a model answers; `BaselineAdapter`, which makes an `EngineModel` of a
baseline; and `Exportable`, what a model hands to an exporter. dengine's own
`neighbours.ModelPrediction` implements both interfaces.

Calls that must not raise into the cell go through `engine.guard.guarded`.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, Self, runtime_checkable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from ..decision.decider import Decider, DecisionConditions, Predicted, Verdict
from ..decision.neighbours import CERTAIN, UNCERTAIN
from ..decision.policy import Policy
from ..errors import SettingError, shortened
from ..limits import ForceLimits
from ..records import ACTIONS, Action, Arrays, Embedding, Reason, State, TraceSpec
from ..reducers.base import FitReport, Floats, Ints, StopRule
from ..traces import clip_extremes

NOT_TRAINED = "Nothing was trained yet; report labels until the first retrain, then export."
N_EXAMPLES = 8  # traces on which the answers of a version are compared with what was trained
NO_TRACES: Floats = np.zeros((0, 1, 1), np.float32)


class Prediction(NamedTuple):
    """A model's prediction for one trace; its fields mean the same as those of `Decision`."""

    action: Action
    lower: float
    upper: float
    n_success: int
    n_failure: int
    embedding: Embedding | None
    reason: Reason


@runtime_checkable
class Model(Protocol):
    """What a baseline method must implement, and no more.

    X is an array of float32, shape (n, channels, samples); y is an array of shape (n,) with 1 for
    success and 0 for failure.
    """

    def fit(self, X: Any, y: Any) -> Any:
        """Train from scratch on labelled traces. The return value is not read."""

    def add(self, x: Any, y: Any) -> Any:
        """Learn one labelled trace (channels, samples) between two trainings.

        `y` is 1 for success and 0 for failure. The return value is not read.
        """

    def count(self, X: Any) -> tuple[Any, Any]:
        """Return (n_success, n_failure), each (n,): the labels behind each prediction.

        They are whole numbers from 0 to 2**63 - 1; for others the part is verified.
        """

    def predict_interval(self, X: Any) -> tuple[Any, Any]:
        """Return (lower, upper), each (n,): the bounds of each success probability.

        Unless 0 <= lower <= upper <= 1, an engine verifies the part.
        """

    def decide(self, X: Any) -> Any:
        """Return an `Action`, or the value of one, for each of the n traces."""


class EngineModel(ABC):
    """The model that the engine drives: it predicts, learns references, retrains and is stored.

    A subclass implements `train`, `build_decider`, `add_reference` and `successor`; every other
    method has a default that fits a model without a rule, without a safe mode and without a stored
    state.

    Attributes
    ----------
    user_model : object
        What `DataEngine.model` shows: the model as its author knows it.
    name : str
        Shown in a status or a table.
    rule_is_stale : bool
        An update of the rule failed, so the model raises instead of predicting until the engine is
        opened again.
    rule_learns : bool
        Whether outcomes change the rule at all.
    keeps_references : bool
        Whether `get_state`, and the points that are stored with labels, restore the references.
        Otherwise the model is trained again on the traces of its version.
    min_traces : int
        Number of labelled traces that the first training waits for.
    """

    keeps_references = True
    min_traces = 1
    rule_is_stale = False
    rule_learns = False

    user_model: Any
    name: str
    _decider: Decider | None = None
    _conditions: DecisionConditions | None = None

    @abstractmethod
    def train(
        self,
        X: Floats,
        y: NDArray[Any],
        hashes: Ints,
        stop: StopRule | None = None,
        numbers: Ints | None = None,
    ) -> Self:
        """Learn from labelled traces, starting where an earlier training ended.

        Parameters
        ----------
        X : array of float32, shape (n, channels, samples)
        y : array of int, shape (n,)
            1 is success, 0 is failure.
        hashes : array of int64, shape (n,)
            Hash of each trace's part, or of its content; the fold follows from it.
        stop : StopRule, optional
            Ends the training by steps or by the clock; None: the reducer's own number of steps.
        numbers : array of int64, shape (n,), optional
            The labels' sequence numbers in the store.

        Returns
        -------
        self
        """

    def warm_up(self) -> None:  # noqa: B027  # a default: nothing to load
        """Load the libraries that the first training needs; called before each training.

        The default does nothing.
        """

    def precompute(self, X: Floats, numbers: Ints | None = None) -> None:  # noqa: B027  # a default
        """Compute in advance, and keep, what a training on these traces (n, C, T) begins with.

        `numbers` are the labels' sequence numbers, by which `train` finds the results again. An
        engine calls it in a thread, and logs what it raises. The default does nothing.
        """

    def decide_one(self, x: Floats, part_hash: int, conditions: DecisionConditions) -> Verdict:
        """Decide on one trace: check faults and force limits, predict, and draw audits.

        The model predicts only if the trace has no fault and is within the limits; what it raises
        is raised here, and an engine verifies the part then. An audit verifies a part that the
        model was certain of; whether it is drawn is a fixed function of the trace's content hash
        and the seed.

        Parameters
        ----------
        x : array of float32, shape (channels, samples)
            The raw trace.
        part_hash : int
            Hash of its part's number; 0 for an unknown part, for which the content hash stands.
        conditions : DecisionConditions
            Force limits, range of the sensor and audits. The decider for them is kept, and used
            again while they stay equal.

        Returns
        -------
        Verdict
            (fault, content hash, action, predicted action, reason, lower, upper, n_success,
            n_failure, embedding, propensity), as `Decider.forward` returns them. The embedding is
            empty, shape (0, 0).
        """
        return self.decider(conditions).forward(torch.from_numpy(x), part_hash)

    def decider(self, conditions: DecisionConditions | None) -> Decider:
        """Return the module that decides under these conditions, and keep it for the next call.

        The conditions are the force limits (an operator's limits of the signal), the range of the
        sensor and the audits (random checks of parts about which the model is certain). The module
        is built anew if none is kept, or if the kept module is for other conditions; this raises
        what `build_decider` raises. None, which only a `ModelPrediction` (dengine's own model)
        takes, stands for no force limits, a sensor without a known range, and no audits.
        """
        is_same = conditions is self._conditions or conditions == self._conditions
        if self._decider is None or not is_same:
            self._decider = self.build_decider(conditions)
            self._conditions = conditions
        return self._decider

    @abstractmethod
    def build_decider(self, conditions: Any) -> Decider:
        """Build a decider for these conditions, which asks this model.

        It is returned, not kept; `decider` keeps one. Raises SettingError if the force limits do
        not fit the traces.
        """

    @abstractmethod
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
        """Make a labelled trace a reference.

        Parameters
        ----------
        x : array of float32, shape (channels, samples)
        y : int
            1 is success, 0 is failure.
        hash_ : int
            Hash of the trace's part, or of its content.
        number : int
            Sequence number of the label; negative, and provisional, until a store that several
            robot cells share has given one.
        embedding : tuple, shape (K, d), optional
            The trace's embedding by this version, where it was computed for the decision.
        point : array of float32, shape (d,), optional
            The reference point itself, where it is known.

        Returns
        -------
        array of float32, shape (d,)
            The reference point, which is stored with the label so that it need not be computed
            again.
        """

    def renumber_reference(self, old: int, new: int) -> None:  # noqa: B027  # a default
        """Replace the provisional number of a reference by the one that the store gave its label.

        Labels have provisional numbers only in a store that several robot cells share. The default
        does nothing.
        """

    def change_reference(self, number: int, hash_: int, y: int | None) -> bool:
        """Relabel the reference with this label number, or remove it if `y` is None.

        Returns True, also if there is no such reference. Returns False, with nothing changed, if
        the reference has another hash than `hash_`, or if the model cannot change references; this
        is the default.
        """
        return False

    def with_policy(self, policy: Policy) -> Self:
        """Return a model with the same references and a new rule of another policy.

        The default returns the model itself, which has no rule.
        """
        return self

    def update_rule(  # noqa: B027  # a default: no rule that learns
        self,
        lower: float,
        upper: float,
        success: bool,
        novel: bool,
        n_unreported: int,
        predicted: int = 0,
        inclusion_probability: float = 1.0,
    ) -> None:
        """Update the rule with the outcome of one part; the default does nothing.

        Parameters
        ----------
        lower, upper : float
            The bounds of the success probability by which the part was decided, before its label
            was known.
        success : bool
            The label.
        novel : bool
            Whether the decision's reason was `Reason.NOVEL`.
        n_unreported : int
            Accepted parts without a known outcome since the previous update.
        predicted : int
            `ActionCode` of what the model alone would have done.
        inclusion_probability : float
            Probability, fixed beforehand, that the outcome would be asked for.
        """

    def reset_rule(self, safe_mode: int) -> None:  # noqa: B027  # a default: no rule that learns
        """Reset the rule, so that no outcome counts; it starts in this safe mode, a `SafeMode`.

        In a safe mode parts are verified until new outcomes allow decisions again; NONE is no safe
        mode. The default does nothing.
        """

    @abstractmethod
    def successor(self) -> EngineModel:
        """Return a model to train next, which starts from this one and does not change it."""

    def prepare(self, previous: EngineModel) -> None:  # noqa: B027  # a default: nothing to prepare
        """Take over the previous model's rule, and be ready to predict at once.

        A rule that is stale, because an update of it failed, is taken over as well, and this model
        is stale then. The default does nothing.
        """

    @property
    def safe_mode(self) -> str:
        """Why the safe mode began; "" outside a safe mode, and by default."""
        return ""

    def defect(self) -> str:
        """Return why the trained model must not be used; "" if it may be used.

        It is called right after the training, in the same process. An implementation must not read
        labels. The default returns "".
        """
        return ""

    def check_answers(self) -> str:
        """Decide on some training traces; return why the model must not be used, "" if it may be.

        It is called in the process that will decide, after `prepare`. The default returns "".
        """
        return ""

    @property
    def report(self) -> FitReport:
        """The report of the last training; by default an empty one."""
        return FitReport()

    def get_state(self) -> State:
        """Return the model's state as arrays by name, for the store; by default none."""
        return {}

    def set_state(self, state: Arrays) -> Self:
        """Restore the state that `get_state` returned; returns self.

        The default restores nothing.
        """
        return self

    def needs_refit(self, state: Arrays) -> bool:
        """Return whether a model must be trained again before `set_state` can restore the state.

        It is then trained on the traces of the version that gave the state. True by default.
        """
        return True


class BaselineAdapter(EngineModel):
    """Makes an `EngineModel` of a baseline, which decides by its own rule.

    An engine trains a deep copy of the baseline, see `successor`, so the present one goes on
    answering. The baseline itself is not copied, and only the names of its methods are checked.

    Parameters
    ----------
    model : Model

    Attributes
    ----------
    description : str
        Name of its class, the same at every start: a store compares it with the model that made it,
        and not its settings.

    Raises
    ------
    SettingError
        For a class, for an object that lacks a method of `Model` (fit, add, count,
        predict_interval or decide), and for a model of dengine's own.
    """

    keeps_references = False

    def __init__(self, model: Model) -> None:
        if isinstance(model, type) or not isinstance(model, Model):
            raise SettingError(
                "Expected a model with fit, add, count, predict_interval and decide, "
                f"got {model!r}."
            )
        if isinstance(model, EngineModel):
            raise SettingError(
                f"Expected a baseline, got a {type(model).__name__}; describe dengine's own model "
                "by reducer=, policy= and recipe=."
            )
        self.user_model = model
        self.name = type(model).__name__
        self.description = type(model).__qualname__

    def train(self, X: Floats, y: NDArray[Any], *_: object, **__: object) -> Self:
        """Train the baseline from scratch on a copy of the traces, which it may write to.

        Extreme samples are clipped first. Hashes, `stop` and numbers have no effect. Returns self.
        """
        self.user_model.fit(clip_extremes(X).copy(), y)
        return self

    def build_decider(self, conditions: Any) -> Decider:
        """Build a decider that asks the baseline; SettingError if force limits do not fit.

        It is not compiled, has no embedding, and asks the very object, so what the baseline learns
        later counts.
        """
        return Decider(BaselinePredictor(self.user_model), conditions)

    def add_reference(self, x: Floats, y: int, *_: object, **__: object) -> Floats:
        """Pass the labelled trace to the baseline's `add`, which changes the baseline in place.

        Extreme samples are not clipped here. Returns the trace itself, in place of a reference
        point. Number, hash, embedding and point have no effect.
        """
        self.user_model.add(x, y)
        return x

    def successor(self) -> BaselineAdapter:
        """Return an adapter around a deep copy of the baseline, with what it has learned."""
        return BaselineAdapter(copy.deepcopy(self.user_model))


class BaselinePredictor(nn.Module):
    """Lets a `Decider` ask a baseline.

    Parameters
    ----------
    model : Model
    """

    def __init__(self, model: Model) -> None:
        super().__init__()
        self.model = model

    def forward(self, x: Tensor, part: int = 0) -> Predicted:
        """Predict one trace (C, T) by the baseline, a model that the user handed in.

        Returns the positions of action and reason in `ACTIONS` and `REASONS`, the bounds of the
        success probability, the numbers of good and bad labels behind the prediction (n_success,
        n_failure), and an embedding that is always empty, shape (0, 0). The baseline gets the
        samples of `x` without a copy, so what it writes to them changes `x`. The reason is
        UNCERTAIN for VERIFY (the part must be checked), otherwise CERTAIN. `part` has no effect,
        because a baseline knows nothing of parts. Raises ValueError for an unknown action, for
        other than one value of each bound or count, and for counts that are not whole numbers from
        0 to 2**63 - 1 (OverflowError for an infinite count). Of several actions the first counts;
        without one IndexError is raised. Errors of the baseline are raised as they are, and bounds
        are not checked.
        """
        X = x.numpy()[None]
        (lower,), (upper,) = self.model.predict_interval(X)
        (n_success,), (n_failure,) = self.model.count(X)
        action = ACTIONS.index(Action(self.model.decide(X)[0]))
        reason = CERTAIN if action else UNCERTAIN
        counts = (int(n_success), int(n_failure))
        if counts != (n_success, n_failure) or not all(0 <= n < 2**63 for n in counts):
            raise ValueError(
                "Expected whole numbers of labels below 2**63, "
                f"got {shortened((n_success, n_failure))}."
            )
        return action, reason, float(lower), float(upper), *counts, self.embed(x)

    def embed(self, x: Tensor) -> Tensor:
        """Return an empty embedding, shape (0, 0): a baseline has none."""
        return torch.empty(0, 0)


@dataclass(frozen=True, slots=True)
class Exportable:
    """What an exporter starts from.

    Attributes
    ----------
    model : ModelPrediction
        A fitted model.
    trace : TraceSpec
        What the traces look like.
    examples : array of float32, shape (n, C, T)
        Traces on which the embeddings of the exported decider are compared with the reducer's.
    audit_rate : float
        Share of the certain decisions that are verified as audits.
    seed : int
        Seed of the audit draw.
    stops_all : bool
        Whether an accepted part is confirmed if nothing is reported until the next decision.
    force_limits : tuple of ForceLimits
        The force limits of the policy.
    model_version, recipe : int, str
        Version and recipe that the exported file names; 0 and "" if no engine made the model.
    note : callable, optional
        Called with the kind and the text of an event, to record the export.
    """

    model: Any
    trace: TraceSpec
    examples: Floats
    audit_rate: float = 0.0
    seed: int = 0
    stops_all: bool = False
    force_limits: tuple[ForceLimits, ...] = ()
    model_version: int = 0
    recipe: str = ""
    note: Callable[[str, str], object] | None = None
