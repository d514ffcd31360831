"""The learned 1-D conv embedding: an encoder that reads no label, and heads that read all but their own fold's.

    >>> reducer = ConvReducer(folds=5).fit(X, y)     # X (n, T) or (n, C, T), y (n,) 1 = success, 0 = failure
    >>> reducer.embed(X).shape                       # (n, K, d): every trace in each of the K spaces

    trace ──► encoder: convolutions, ramps, means over ──► head k ──► axis 1: P(success), from outside fold k
    (C, T)    regions, a linear layer; label-free           (2*W,)  └► axis 2: principal direction

A network trained on labels would exist K times, each on few labels. One trained without labels is shared by all K spaces
and may train as long as a cell idles (`encoder_budget`); only the last layer, convex, is cross-fitted.

Cross-fitting: Wolpert (1992), Neural Networks 5; Chernozhukov et al. (2018), Econometrics Journal 21.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple, Self, cast

import numpy as np
import torch
from numpy.typing import NDArray

from ..errors import SettingError
from .base import Floats, Ints, StopRule, part, seed_of
from .encoder import ConvEncoder, averaging, start_from
from .features import KeptFeatures
from .heads import FeatureReducer, in_chunks
from .training import AUGMENTATIONS, EncoderTraining

AT_ONCE = 60_000  # places of traces that a retrain looks at anew, so that it ends in time however many references there are
HELD_OUT = 8  # one trace in so many is never trained on, by the hash of its part


class _Next(NamedTuple):
    """An encoder that may answer, the features of the traces that are embedded with it by now, and what is said of it."""

    encoder: ConvEncoder
    kept: KeptFeatures
    said: str


class ConvReducer(FeatureReducer):
    """Trace -> point, by a convolutional encoder and cross-fitted heads.

    n_components : d, 1 or 2; the first axis is the predicted probability of success, the second is there to be seen.
    folds : K. More folds train each head on more of the labels; the time to embed hardly grows.
    kernels, dilations, regions, width : sizes of the encoder; see encoder.py.
    augmentations : what distorts the views that the encoder is trained on: names in `training.AUGMENTATIONS`, by spaces.
    start : an .npz of an encoder's weights, from which this one starts, of one channel and equal sizes; None: closed-form.
    l2 : ridge of the heads, in units of one label each.
    max_iter : Newton steps of the heads in one fit, at most.
    random_state : of all that is drawn; None draws anew at each fit.
    """

    train_traces = 2000  # the encoder's features are more than another's

    def __init__(
        self,
        *,
        n_components: int = 2,
        folds: int = 5,
        kernels: int = 28,
        dilations: int = 5,
        regions: int = 3,
        width: int = 64,
        augmentations: str = " ".join(AUGMENTATIONS),
        start: str | None = None,
        l2: float = 1.0,
        max_iter: int = 12,
        random_state: Any = 0,
    ) -> None:
        self.n_components = n_components
        self.folds = folds
        self.kernels = kernels
        self.dilations = dilations
        self.regions = regions
        self.width = width
        self.augmentations = augmentations
        self.start = start
        self.l2 = l2
        self.max_iter = max_iter
        self.random_state = random_state

    def make_features(self, channels: int, samples: int) -> ConvEncoder:
        sizes = (self.kernels, self.dilations, self.regions, self.width)
        return ConvEncoder(channels, samples, self.average_, *sizes)

    @property
    def encoder_(self) -> ConvEncoder:
        """The encoder that answers."""
        return cast(ConvEncoder, self.net_.features)

    def _start(self, traces: Floats) -> None:
        self.average_ = averaging(torch.from_numpy(traces))
        self.training_: EncoderTraining | None = None
        self.next_: _Next | None = None
        super()._start(traces)
        if self.start is not None:
            start_from(self.encoder_, self.start)

    def improve(self, X: Floats, parts: Ints, stop: StopRule) -> int:
        """Train the encoder apart from what answers, which takes it over at the next `train`; see `Reducer.improve`."""
        if "net_" not in vars(self):  # begun on fewer traces than a first model has, it did worse
            return 0
        if self.training_ is None:
            self.training_ = self._new_training()
        apart = torch.from_numpy(parts % HELD_OUT == 0)
        traces = torch.from_numpy(X)
        return self.training_.run(traces[~apart], traces[apart], stop)

    def _new_training(self) -> EncoderTraining:
        return EncoderTraining(self.encoder_, seed_of(self.random_state) or 0, tuple(self.augmentations.split()))

    def _take_over(self, traces: Floats, keys: Sequence[bytes]) -> str:
        """Every reference moves with the encoder; where there are many, some at each retrain until none is left."""
        training = self.training_
        if training is None:
            return ""
        if self.next_ is None and training.waits:
            release = training.release()
            said = f"after {training.steps} steps: held-out loss {release.loss:.4g}, features moved by {release.moved:.2g}"
            if release.encoder is None:
                return f"kept the earlier encoder, {said}"
            self.next_ = _Next(copy.deepcopy(release.encoder), KeptFeatures(len(self.encoder_.gain)), said)
        if self.next_ is None:
            return ""
        encoder, kept, said = self.next_
        left = kept.add(traces, keys, AT_ONCE // encoder.n_places, partial(in_chunks, encoder.raw))
        if left:
            return f"an encoder waits until {left} more traces are embedded with it, {said}"
        for own, trained in zip(self.encoder_.parameters(), encoder.parameters(), strict=True):
            own.copy_(trained)
        self.kept_, self.next_ = kept, None
        return f"encoder {said}"

    def get_state(self) -> dict[str, NDArray[Any]]:
        trained = {} if self.training_ is None else self.training_.get_state()
        own = {f"training.{name}": value for name, value in trained.items()}
        return super().get_state() | own | {"average": np.array(self.average_)}

    def set_state(self, state: Mapping[str, NDArray[Any]]) -> Self:
        self.average_ = int(state["average"])
        super().set_state(state)
        trained = part(state, "training.")
        self.training_ = self._new_training().set_state(trained) if trained else None
        self.next_ = None
        return self

    def check(self) -> None:
        """Raise SettingError for a parameter out of its range."""
        super().check()
        for name in ("kernels", "dilations", "width", "regions"):
            value = getattr(self, name)
            if not isinstance(value, int | np.integer) or value < 1:
                raise SettingError(f"Expected {name} >= 1, an integer, got {value!r}.")
        if self.regions > 16:
            raise SettingError(f"Expected regions <= 16, got {self.regions!r}.")
        unknown = sorted(set(str(self.augmentations).split()) - set(AUGMENTATIONS))
        if unknown:
            raise SettingError(f"Expected augmentations among {', '.join(AUGMENTATIONS)}, got {', '.join(unknown)}.")
