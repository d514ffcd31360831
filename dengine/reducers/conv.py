"""The 1-D convolutional network that embeds traces, `ConvNetwork`, and `ConvReducer`, the reducer
"conv", which trains it as `TorchReducer` trains any network, and averages its logit with that of
`RocketReducer`.

    x (B, 2C, L)               preprocessed traces: each signal and its differences in time
    conv 15, stride 4           8 channels per signal
    conv  9, stride 2          16 channels per signal
    conv  9, stride 2          16 channels per signal, (B, C * 16, P)
    pool                       mean and maximum over three regions and over the whole trace,
                               (B, C * 16 * 8)
    hidden layer               32 features, which see all signals and all regions together

With three signals or more there are fewer channels, and on short traces the first stride is 2.
Batch normalisation and ReLU follow each convolution. `encoder.Members` puts two units and a logit
behind the network, and `TorchReducer` trains several copies of it side by side, each without the
labels of one fold.

References
----------
Wang, Yan and Oates (2017), Time series classification from scratch with deep neural networks,
IJCNN: three convolutions, batch normalisation, ReLU. Zheng et al. (2014), Time series
classification using multi-channels deep convolutional neural networks, WAIM: separate convolutions
for each signal.
"""

from dataclasses import dataclass, field
from typing import Self

import torch
from sklearn.utils.validation import check_is_fitted
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812  # PyTorch's own documentation calls it so

from ..decision.scripting import arrays_with_prefix, incompatible_model_error
from ..records import Arrays, State
from .base import Floats, Ints, StopRule
from .encoder import Encoder, FoldableSequential, NetworkFactory
from .rocket import FeatureEmbedding, RocketReducer
from .torch_reducer import TorchReducer

N_REGIONS = 3  # early, middle and late: when a force rises tells as much as how far
SMALLEST_PROBABILITY = 1e-6
HEAD_STEPS = 4  # Newton steps of the heads in a retrain; the next one goes on from there
MIN_SAMPLES_OF_STRIDE_4 = 160  # on shorter traces the first convolution has a stride of 2


class ConvNetwork(nn.Module):
    """Three convolutions, pooling over regions and a hidden layer; one or several such networks.

    Parameters
    ----------
    channels, samples : int
        2 * C and L of the preprocessed traces: each signal is followed by its differences.
    members : int, default 1
        Number of separate networks that the module computes at once. Network k reads the `channels`
        inputs from ``k * channels`` on and writes the `features` outputs from ``k * features`` on.
        Grouped convolutions keep the networks apart.
    width : int, default 8
        Outputs of the first convolution for each signal; the others have twice as many. With many
        signals it is reduced, down to `width` // 3, so that the time of a step hardly grows.
    features : int, default 32
        Outputs of each network.
    """

    def __init__(
        self, channels: int, samples: int, members: int = 1, width: int = 8, features: int = 32
    ) -> None:
        super().__init__()
        signals = channels // 2
        width = max(width // 3, min(width, 2 * width // signals))
        groups = members * signals  # a convolution sees one signal; the hidden layer sees all
        stride = 4 if samples >= MIN_SAMPLES_OF_STRIDE_4 else 2
        self.convolutions = FoldableSequential(
            *conv_layers(groups, 2, width, kernel=15, stride=stride),
            *conv_layers(groups, width, 2 * width, kernel=9, stride=2),
            *conv_layers(groups, 2 * width, 2 * width, kernel=9, stride=2),
        )
        positions = -(-samples // (stride * 2 * 2))  # P, after the last convolution
        regions = min(N_REGIONS, positions)
        self.stride = positions // regions
        self.window = positions - (regions - 1) * self.stride  # so that regions cover the trace
        pooled = signals * 2 * width * 2 * (regions + 1)
        self.dropout = nn.Dropout(0.1)
        self.hidden = nn.Conv1d(members * pooled, members * features, kernel_size=1, groups=members)
        self.hidden_dropout = nn.Dropout(0.2)

    def forward(self, x: Tensor) -> Tensor:
        """Compute features (B, members * features) of traces (B, members * channels, L).

        The traces are preprocessed: averaged to L samples and standardised, with the differences in
        time as further channels. The module computes `members` separate networks of the same form
        at once, each on `channels` channels of its own. The outputs of the convolutions are pooled
        to the mean and maximum of each region of the trace (early, middle, late) and of the whole
        trace (whose mean is that of the means of the regions), and then pass the hidden layer and a
        ReLU. In training mode dropout makes the result random, and the running statistics of batch
        normalisation change.
        """
        h = self.convolutions(x)  # (B, members * C * 2 * width, P)
        mean = F.avg_pool1d(h, self.window, self.stride)  # (B, ..., regions)
        maximum = F.max_pool1d(h, self.window, self.stride)  # (B, ..., regions)
        whole_mean = mean.mean(2, keepdim=True)
        whole_maximum = maximum.amax(2, keepdim=True)
        pooled = torch.cat([mean, maximum, whole_mean, whole_maximum], 2)
        h = self.dropout(pooled.flatten(1)).unsqueeze(2)  # (B, members * pooled, 1)
        features: Tensor = self.hidden_dropout(self.hidden(h).relu())
        return features.flatten(1)


def conv_layers(
    groups: int, inputs: int, outputs: int, kernel: int, stride: int
) -> list[nn.Module]:
    """Return a list of three layers: convolution, batch normalisation and ReLU.

    The convolution has `groups` groups, which it keeps apart; `inputs` and `outputs` are channels
    of each group. It has no bias and pads `kernel` // 2 zeros at both ends.
    """
    return [
        nn.Conv1d(
            groups * inputs,
            groups * outputs,
            kernel,
            stride,
            padding=kernel // 2,
            groups=groups,
            bias=False,
        ),
        nn.BatchNorm1d(groups * outputs),
        nn.ReLU(),
    ]


class ConvEncoder(nn.Module):
    """Embed raw traces in the space of every fold: (B, C, T) -> (B, K, dim).

    The first coordinate is the probability of success whose logit is the mean of those of the
    network and of `RocketReducer`. The second, if any, is the network's.

    Parameters
    ----------
    network : Encoder
        Preprocessor and trained copies of the network, one for each fold.
    rocket : FeatureEmbedding
        With one coordinate, the probability of success.
    """

    def __init__(self, network: Encoder, rocket: FeatureEmbedding) -> None:
        super().__init__()
        self.network = network
        self.rocket = rocket
        self.dim = network.dim

    def forward(self, x: Tensor) -> Tensor:
        """Raw traces (B, C, T) -> (B, K, dim)."""
        return average_logits(self.network(x), self.rocket(x))


def average_logits(
    points: Tensor, probabilities: Tensor, smallest: float = SMALLEST_PROBABILITY
) -> Tensor:
    """Replace the first coordinate by the probability whose logit is the mean of both logits.

    Parameters
    ----------
    points : Tensor of float32, shape (..., dim)
        Embedding; its first coordinate is a probability.
    probabilities : Tensor of float32, shape (..., 1)
        The other probability of each point.
    smallest : float, default 1e-6
        Probabilities are clipped to [smallest, 1 - smallest] before their logits are taken.

    Returns
    -------
    Tensor of float32, shape (..., dim)
        A new tensor. The other coordinates are those of `points`.
    """
    logits = 0.5 * (points.narrow(-1, 0, 1).logit(smallest) + probabilities.logit(smallest))
    return torch.cat([logits.sigmoid(), points.narrow(-1, 1, points.size(-1) - 1)], -1)


@dataclass(eq=False, repr=False, kw_only=True)
class ConvReducer(TorchReducer):
    """Embed traces by a convolutional network that is trained on the CPU, in steps at each retrain.

    It is `TorchReducer` with `ConvNetwork`; the parameters are those of `TorchReducer`. The logit
    of success is the mean of two: that of the network, and that of a `RocketReducer`, which is
    better with few labels. Both have the weight 1/2, which is not fitted.

    Attributes
    ----------
    rocket_ : RocketReducer
        It is trained on the same labels and folds.

    Examples
    --------
    >>> from dengine.testing import toy_traces
    >>> X, y = toy_traces(60)  # X (n, C, T), y (n,) 1 = success, 0 = failure
    >>> ConvReducer(folds=2).fit(X, y).embed(X).shape  # every trace in each of the spaces
    (60, 2, 2)
    """

    network: NetworkFactory = field(init=False, default=ConvNetwork)

    def precompute(self, X: Floats, numbers: Ints | None = None) -> None:
        """Compute the features of traces (n, C, T) for `rocket_`, and cache them for `train`.

        `train` finds them again by `numbers`; without numbers they are not kept. The first call
        also builds the network and draws the kernels. With fewer than `min_traces` traces nothing
        is done. No label is read. Raises the errors of `check_traces`, and at the first call those
        of `_initialize`.
        """
        if len(X) >= self.min_traces:
            traces = self._check_and_initialize(X)
            self.rocket_.raw_features(traces, numbers)

    def _initialize(self, traces: Floats) -> None:
        """Do what `TorchReducer._initialize` does, and draw the kernels of a new `rocket_`."""
        super()._initialize(traces)
        self.rocket_._initialize(traces)

    def _build(self, channels: int, samples: int, average: int, seed: int | None = None) -> None:
        """Build `rocket_`, preprocessor and networks anew for traces of this shape.

        `rocket_` becomes a new `RocketReducer` (random convolution kernels under logistic
        regressions), whose kernels are not drawn yet. Then `TorchReducer._build` makes the
        preprocessor, and one copy of the network for each fold (a fixed group of traces), with
        initial weights; it resets the counts of steps and the optimiser, and sets `is_initialized_`
        to False. `average` is the number of samples that are averaged to one. Without `seed` the
        seed of the networks comes from `random_state`. Raises SettingError for a parameter out of
        its range, fewer than 2 samples, or a `random_state` that gives no seed; `rocket_` has been
        replaced by then.
        """
        # Before `encoder_`, by which other threads see that there is a module.
        self.rocket_ = RocketReducer(
            n_components=1,
            folds=self.folds,
            max_iter=HEAD_STEPS,
            random_state=self.random_state,
        )
        super()._build(channels, samples, average, seed)

    def _train(
        self,
        traces: Floats,
        labels: Ints,
        folds: Ints,
        stop: StopRule,
        steps: int,
        numbers: Ints | None = None,
    ) -> Floats:
        """Fit the classifier heads of `rocket_`, then train the network until `stop` ends it.

        `stop` is asked before the steps of both, and counts each from 0. `numbers` (n,) identify
        the traces, see `RocketReducer.train`. Returns the points of the traces, float32 (n, d),
        with averaged logits, row i in space ``folds[i]``. Sets what `TorchReducer._train` and
        `RocketReducer.train_heads` set; raises SettingError like the former, with `rocket_` trained
        already.
        """
        probabilities = self.rocket_.train_heads(traces, labels, folds, stop, numbers)  # (n, 1)
        points = super()._train(traces, labels, folds, stop, steps, numbers)
        return average_logits(torch.from_numpy(points), torch.from_numpy(probabilities)).numpy()

    def embed(self, X: Floats) -> Floats:
        """Embed traces (n, T) or (n, C, T) in every embedding space; return float32 (n, K, d).

        There is a space for each of the K folds (fixed groups of traces); the models of space k
        were trained without the labels of fold k. The first of the d coordinates is a probability
        of success; its logit is the mean of the logits of the network and of `rocket_`, the
        `RocketReducer` beside it. The second coordinate, if any, is the network's: 0.1 times the
        difference of its two sigmoid units. Raises NotFittedError before there are networks, and
        the errors of `check_traces`, such as ValueError for traces of another shape.
        """
        traces = self.check_traces(X)  # once, since `rocket_` knows no names of columns
        return average_logits(
            torch.from_numpy(super().embed(traces)), torch.from_numpy(self.rocket_.embed(traces))
        ).numpy()

    def module(self) -> ConvEncoder:
        """Return a new module that embeds, (B, C, T) -> (B, K, d), in evaluation mode.

        It is never None. It shares its tensors with the reducer: later trainings change the half of
        `rocket_` in place, but not the network's. Raises NotFittedError before a fit.
        """
        check_is_fitted(self, "encoder_")
        return ConvEncoder(self.encoder_, self.rocket_.module()).eval()

    def get_state(self) -> State:
        """Return the arrays of `TorchReducer.get_state`, and those of `rocket_`.

        The names of the latter begin with "rocket.". `set_state` restores the reducer from them bit
        for bit. Raises NotFittedError before a fit, AttributeError before the first training.
        """
        return super().get_state() | {
            f"rocket.{name}": value for name, value in self.rocket_.get_state().items()
        }

    def set_state(self, state: Arrays) -> Self:
        """Restore what `get_state` returned, and return self.

        `rocket_`, the `RocketReducer` beside the network, is restored, too. The constructor's
        parameters must be the same. Raises StoreError if the state has no arrays of `rocket_`, as
        in an older release, or if it is of another network or of other sizes; KeyError, ValueError
        or StoreError if it lacks other arrays; and SettingError for a parameter out of its range.
        After an error do not use the reducer.
        """
        rocket = arrays_with_prefix(state, "rocket.")
        if not rocket:  # stored when conv was its network alone
            raise incompatible_model_error("conv has no rocket beside its network")
        super().set_state(state)
        self.rocket_.set_state(rocket)
        return self
