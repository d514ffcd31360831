"""The learned 1-D conv embedding: an encoder that reads no label, and heads that read all but their own fold's.

    >>> reducer = ConvReducer(folds=5).fit(X, y)     # X (n, T) or (n, C, T), y (n,) 1 = success, 0 = failure
    >>> reducer.embed(X).shape                       # (n, K, d): every trace in each of the K spaces

    trace ──► encoder: convolutions, ramps, means over ──► head k ──► axis 1: P(success), from outside fold k
    (C, T)    regions, a linear layer; label-free           (2*W,)  └► axis 2: principal direction

Why so. A label counts only in a space that never saw it (honest counting), so a network trained on labels exists K times,
each on fewer of the few labels there are. One trained without labels is shared by all K spaces, honest by construction, and
may train as long as it likes, in the time that a cell idles (`encoder_budget`); only the last layer is cross-fitted. That
layer is convex: Newton's method ends it in a few steps at one place.

Sources: encoder.py, vicreg.py and logistic.py; stacking's cross-fitting: Wolpert (1992), Neural Networks 5; Chernozhukov et
al. (2018), Econometrics Journal 21.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..errors import SettingError
from .base import Floats, Ints, StopRule, seed_of
from .encoder import ConvEncoder, averaging, start_from
from .features import ConvFeatures, Features, KeptFeatures, keys_of
from .scored import FeatureReducer, in_chunks
from .training import AUGMENTATIONS, EncoderTraining

MOST_REGIONS = 16
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
    kernels, dilations, regions, width : sizes of the encoder; see encoder.py. 0 kernels: the features of dengine 0.4,
        segment statistics and closed-form filters (features.py), which nothing trains.
    augmentations : what distorts the views that the encoder is trained on: names in `vicreg.AUGMENTATIONS`, by spaces.
    start : an .npz of an encoder's weights, from which this one starts, of one channel and equal sizes; None: closed-form.
    segments, filters : sizes of the features of 0.4.
    l2 : ridge of the heads, in units of one label each.
    max_iter : Newton steps of the heads in one fit, at most.
    random_state : of all that is drawn; None draws anew at each fit.
    """

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
        segments: int = 10,
        filters: int = 4,
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
        self.segments = segments
        self.filters = filters
        self.l2 = l2
        self.max_iter = max_iter
        self.random_state = random_state

    @property
    def train_traces(self) -> int:  # type: ignore[override]  # a constant of other kinds
        """Fewer for the encoder's features, which are more."""
        return 2000 if self.kernels else 4000

    @property
    def keeps_features(self) -> bool:  # type: ignore[override]  # a constant of other kinds
        """Whether pooled outputs are kept from one training to the next: they change with a new encoder alone."""
        return self.kernels > 0

    def make_features(self, channels: int, samples: int) -> Features:
        """The encoder, or the features of dengine 0.4."""
        if not self.kernels:
            return ConvFeatures(channels, samples, self.segments, self.filters, self.regions)
        sizes = (self.kernels, self.dilations, self.regions, self.width)
        return ConvEncoder(channels, samples, self.average_, *sizes)

    def _start(self, traces: Floats) -> None:
        self.average_ = averaging(torch.from_numpy(traces)) if self.kernels else 1
        self.training_: EncoderTraining | None = None
        self.next_: _Next | None = None
        super()._start(traces)
        if self.start is not None and isinstance(self.net_.features, ConvEncoder):
            start_from(self.net_.features, self.start)

    def improve(self, X: Floats, parts: Ints, stop: StopRule) -> int:
        """Train the encoder apart from what answers, which takes it over at the next `train`; see `Reducer.improve`."""
        if not self.kernels or "net_" not in vars(self):  # begun on fewer traces than a first model has, it did worse
            return 0
        if self.training_ is None:
            self.training_ = self._new_training()
        apart = parts % HELD_OUT == 0
        traces = torch.from_numpy(X)
        return self.training_.run(traces[torch.from_numpy(~apart)], traces[torch.from_numpy(apart)], stop)

    def _new_training(self) -> EncoderTraining:
        names = tuple(self.augmentations.split())
        encoder = self.net_.features
        assert isinstance(encoder, ConvEncoder)  # for the type checker: there are kernels
        return EncoderTraining(encoder, seed_of(self.random_state) or 0, names)

    def train(self, X: Floats, y: Ints, folds: Ints, stop: StopRule | None = None) -> Floats:
        """Take over what the encoder has learned since, then fit the heads; see `Reducer.train`."""
        self._told = ""
        points = super().train(X, y, folds, stop)
        self.note_ = "; ".join(filter(None, (self._told, self.note_)))
        return points

    def _features_to_train_on(self, traces: Floats) -> Tensor:
        if not self.kernels:
            return super()._features_to_train_on(traces)
        keys = keys_of(traces)
        self._told = self._take_over(traces, keys)
        return self.kept_.of(traces, self._computed, keys)

    def _take_over(self, traces: Floats, keys: list[bytes]) -> str:
        """Let the encoder that was trained answer from now on; what is to be said of it, "" where nothing was trained.

        Every reference moves with it. Where there are many, some are embedded at each retrain until none is left.
        """
        training = self.training_
        if training is None:
            return ""
        if self.next_ is None and training.waits:
            release = training.release()
            said = f"after {training.steps} steps: held-out loss {release.loss:.4g}, features moved by {release.moved:.2g}"
            if release.encoder is None:
                return f"kept the earlier encoder, {said}"
            self.next_ = _Next(copy.deepcopy(release.encoder), KeptFeatures(len(self.net_.features.gain)), said)
        if self.next_ is None:
            return ""
        encoder, kept, said = self.next_
        left = kept.add(traces, keys, AT_ONCE // encoder.n_places, partial(in_chunks, encoder.raw))
        if left:
            return f"an encoder waits until {left} more traces are embedded with it, {said}"
        for own, trained in zip(self.net_.features.parameters(), encoder.parameters(), strict=True):
            own.copy_(trained)
        self.kept_, self.next_ = kept, None
        return f"encoder {said}"

    def get_state(self) -> dict[str, NDArray[Any]]:
        """What every reducer by features gives, and the encoder's training with its optimiser."""
        state = super().get_state()
        if not self.kernels:
            return state
        state["average"] = np.array(self.average_)
        trained = {} if self.training_ is None else self.training_.get_state()
        return state | {f"training.{name}": value for name, value in trained.items()}

    def set_state(self, state: Mapping[str, NDArray[Any]]) -> Self:
        """Become what `get_state` was taken from; a state of dengine 0.4 brings its own features, and keeps them."""
        if "average" not in state:
            self.kernels = 0
        self.average_ = int(state.get("average", 1))
        super().set_state(state)
        trained = {name[9:]: value for name, value in state.items() if name.startswith("training.")}
        self.training_ = self._new_training().set_state(trained) if trained else None
        self.next_ = None
        return self

    def check(self) -> None:
        """Raise SettingError for a parameter out of its range."""
        super().check()
        for name in ("kernels", "dilations", "width", "regions", "segments", "filters"):
            value, least = getattr(self, name), int(name != "kernels")
            if not isinstance(value, int | np.integer) or value < least:
                raise SettingError(f"Expected {name} >= {least}, an integer, got {value!r}.")
        if self.regions > MOST_REGIONS:
            raise SettingError(f"Expected regions <= {MOST_REGIONS}, got {self.regions!r}.")
        unknown = sorted(set(str(self.augmentations).split()) - set(AUGMENTATIONS))
        if unknown:
            raise SettingError(f"Expected augmentations among {', '.join(AUGMENTATIONS)}, got {', '.join(unknown)}.")
