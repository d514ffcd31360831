"""The 1-D convolutional network that embeds traces, `ConvNetwork`, and `ConvReducer`, the reducer
"conv", which trains it as `TorchReducer` trains any network.

    x (B, 2C, L)               preprocessed traces: each signal and its differences in time
    conv 15, stride 4           8 channels per signal
    conv  9, stride 2          16 channels per signal
    conv  9, stride 2          16 channels per signal, (B, C * 16, P)
    pool                       mean and maximum over three regions and over the whole trace,
                               (B, C * 16 * 8)
    hidden layer               32 features, which see all signals and all regions together

Batch normalisation and ReLU follow each convolution. `encoder.Members` puts two units and a logit
behind the network, and `TorchReducer` trains several members of it side by side, each without the
labels of one fold.

References
----------
Wang, Yan and Oates (2017), Time series classification from scratch with deep neural networks,
IJCNN: three convolutions, batch normalisation, ReLU. Zheng et al. (2014), Time series
classification using multi-channels deep convolutional neural networks, WAIM: separate convolutions
for each signal.
"""

from dataclasses import dataclass, field

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812  # PyTorch's own documentation calls it so

from .encoder import NetworkFactory
from .torch_reducer import TorchReducer

N_REGIONS = 3  # early, middle and late: when a force rises tells as much as how far
MIN_SAMPLES_OF_STRIDE_4 = 160  # on shorter traces the first convolution has a stride of 2


class ConvNetwork(nn.Module):
    """Three convolutions, pooling over regions and a hidden layer, for one or several members.

    Parameters
    ----------
    channels, samples : int
        2 * C and L of the preprocessed traces: each signal is followed by its differences.
    members : int, default 1
        Networks that are computed at once. Member k reads the `channels` inputs from
        ``k * channels`` on and writes the `features` outputs from ``k * features`` on. Grouped
        convolutions keep the members apart.
    width : int, default 8
        Outputs of the first convolution for each signal; the others have twice as many. With many
        signals it is reduced, to a third at least, so that the time of a step hardly grows.
    features : int, default 32
        Outputs of each member.
    """

    def __init__(
        self, channels: int, samples: int, members: int = 1, width: int = 8, features: int = 32
    ) -> None:
        super().__init__()
        signals = channels // 2
        width = max(width // 3, min(width, 2 * width // signals))
        groups = members * signals  # a convolution sees one signal; the hidden layer sees all
        strides = (4 if samples >= MIN_SAMPLES_OF_STRIDE_4 else 2, 2, 2)
        self.convolutions = nn.Sequential(
            *conv_layers(groups, 2, width, kernel=15, stride=strides[0]),
            *conv_layers(groups, width, 2 * width, kernel=9, stride=strides[1]),
            *conv_layers(groups, 2 * width, 2 * width, kernel=9, stride=strides[2]),
        )
        positions = samples  # P, after the last convolution
        for stride in strides:
            positions = (positions - 1) // stride + 1
        regions = min(N_REGIONS, positions)
        self.stride = positions // regions
        self.window = positions - (regions - 1) * self.stride  # so that regions cover the trace
        pooled = signals * 2 * width * 2 * (regions + 1)
        self.dropout = nn.Dropout(0.1)
        self.hidden = nn.Conv1d(members * pooled, members * features, kernel_size=1, groups=members)
        self.hidden_dropout = nn.Dropout(0.2)

    def forward(self, x: Tensor) -> Tensor:
        """Preprocessed traces (B, members * channels, L) -> features (B, members * features).

        The convolutions' outputs are pooled, as mean and maximum of each region and of the whole
        trace, and pass the hidden layer with a ReLU. In training mode dropout makes the result
        random.
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

    `inputs` and `outputs` are channels of each group. The convolution has no bias and pads kernel
    // 2 zeros at both ends.
    """
    convolution = nn.Conv1d(
        groups * inputs,
        groups * outputs,
        kernel,
        stride,
        padding=kernel // 2,
        groups=groups,
        bias=False,
    )
    return [convolution, nn.BatchNorm1d(groups * outputs), nn.ReLU()]


@dataclass(eq=False, repr=False, kw_only=True)
class ConvReducer(TorchReducer):
    """Embed traces by a convolutional network that is trained on the CPU, a bit at each retrain.

    It is `TorchReducer` with `ConvNetwork`; the parameters are those of `TorchReducer`.

    Examples
    --------
    >>> from dengine.testing import toy_traces
    >>> X, y = toy_traces(60)  # X (n, C, T), y (n,) 1 = success, 0 = failure
    >>> ConvReducer(folds=2).fit(X, y).embed(X).shape  # every trace in each of the spaces
    (60, 2, 2)
    """

    network: NetworkFactory = field(init=False, default=ConvNetwork)
