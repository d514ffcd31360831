"""The module that answers: preprocessor, K members of a network, and the embedding of each.

    x (B, C, T) raw        -> Preprocessor -> (B, C', L)
    K copies of the network                -> (B, K, F) features
    two units each, sigmoid                -> (B, K, 2) units u1, u2
    logit = slope . units + offset         -> (B, K)
    embedding                              -> (B, K, 2) probability sigmoid(logit), difference SPREAD * (u1 - u2)

Both coordinates are learned. The probability says how good a part looks; the difference says which of the two units
speaks for it, so that parts of which the units disagree are not counted together with parts of which both are half sure.
"""

from collections.abc import Callable
from inspect import signature

import torch
from torch import Tensor, nn
from torch.nn.utils import fuse_conv_bn_eval

from ..errors import SettingError
from .preprocessing import Preprocessor

NetworkFactory = Callable[..., nn.Module]  # (channels, samples) -> module, (B, channels, samples) -> (B, features)

SPREAD = 0.1  # range of the second coordinate, against the first one's range of 1
SLOPE = 4.0  # of each unit in the logit, to begin with


class Members(nn.Module):
    """K copies of a network, each with two sigmoid units and a logit of its own.

    Parameters
    ----------
    network : callable
        ``network(channels, samples)`` gives a module from (B, channels, samples) to (B, features). A factory that takes
        ``members`` as well gives one module for all of them, from (B, K * channels, samples) to (B, K * features).
    channels, samples : int
        Shape of a preprocessed trace.
    count : int
        K.

    Raises
    ------
    SettingError
        If the module gives another shape.
    """

    def __init__(self, network: NetworkFactory, channels: int, samples: int, count: int) -> None:
        super().__init__()
        self.count = count
        grouped = "members" in signature(network).parameters
        self.networks: nn.Module = (
            Grouped(network, channels, samples, count)
            if grouped
            else Separate([network(channels, samples) for _ in range(count)])
        )
        features = _features_of(self.networks, count, channels, samples)
        bound = features**-0.5
        self.weight = nn.Parameter(torch.empty(count, features, 2).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.zeros(count, 2))
        self.slope = nn.Parameter(torch.full((count, 2), SLOPE))
        self.offset = nn.Parameter(torch.full((count,), -SLOPE))

    def forward(self, x: Tensor) -> Tensor:
        """(B, K, channels, samples), the traces of each member -> (B, K) logits."""
        return self.logits(self.units(x))

    def units(self, x: Tensor) -> Tensor:
        """(B, K, channels, samples) -> (B, K, 2), from 0 to 1."""
        features = self.networks(x)  # (B, K, F)
        units: Tensor = (features.unsqueeze(2) @ self.weight).squeeze(2) + self.bias
        return units.sigmoid()

    def logits(self, units: Tensor) -> Tensor:
        """(B, K, 2) -> (B, K)."""
        return (units * self.slope).sum(2) + self.offset


class Grouped(nn.Module):
    """One module that computes all members: (B, K, C', L) -> (B, K, F)."""

    def __init__(self, network: NetworkFactory, channels: int, samples: int, count: int) -> None:
        super().__init__()
        self.count = count
        self.network = network(channels, samples, members=count)

    def forward(self, x: Tensor) -> Tensor:
        features: Tensor = self.network(x.flatten(1, 2))
        return features.view(x.size(0), self.count, -1)


class Separate(nn.Module):
    """A module for each member: (B, K, C', L) -> (B, K, F)."""

    def __init__(self, networks: list[nn.Module]) -> None:
        super().__init__()
        self.networks = nn.ModuleList(networks)

    def forward(self, x: Tensor) -> Tensor:
        return torch.stack([network(x[:, k]) for k, network in enumerate(self.networks)], 1)


class Encoder(nn.Module):
    """Embed raw traces in the space of every member: (B, C, T) -> (B, K, dim).

    Parameters
    ----------
    preprocessor : Preprocessor
    members : Members
        Those that answer, in evaluation mode; batch normalisation is folded into the convolutions before it.
    dim : int
        2, or 1 for the probability alone.
    """

    def __init__(self, preprocessor: Preprocessor, members: Members, dim: int) -> None:
        super().__init__()
        self.preprocessor = preprocessor
        self.members = members
        self.count = members.count
        self.dim = dim
        self.spread = SPREAD

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, T) raw -> (B, K, dim)."""
        x = self.preprocessor(x)
        return self.embed(x.unsqueeze(1).expand(-1, self.count, -1, -1))

    @torch.jit.export
    def embed(self, x: Tensor) -> Tensor:
        """(B, K, C', L), the preprocessed traces of each member -> (B, K, dim)."""
        units = self.members.units(x)
        probability = self.members.logits(units).sigmoid()
        if self.dim == 1:
            return probability.unsqueeze(2)
        difference = units.select(2, 0) - units.select(2, 1)
        return torch.stack([probability, self.spread * difference], 2)


def fold_batch_norms(module: nn.Module) -> nn.Module:
    """Return the module with each batch normalisation in a `Sequential` folded into the convolution before it.

    The module must be in evaluation mode. Folding is done once, before anything is compiled, so that the engine and an
    exported file compute with the same numbers.
    """
    for name, child in module.named_children():
        setattr(module, name, fold_batch_norms(child))
    if not isinstance(module, nn.Sequential):
        return module
    layers: list[nn.Module] = []
    for layer in module:
        if isinstance(layer, nn.BatchNorm1d) and layers and isinstance(layers[-1], nn.Conv1d):
            layers[-1] = fuse_conv_bn_eval(layers[-1], layer)
        else:
            layers.append(layer)
    return nn.Sequential(*layers)


def _features_of(networks: nn.Module, count: int, channels: int, samples: int) -> int:
    """Find out how many features a network gives, by two traces of zeros; SettingError for another shape."""
    networks.eval()
    with torch.no_grad():
        features = networks(torch.zeros(2, count, channels, samples))
    networks.train()
    if features.dim() != 3:
        raise SettingError(
            f"Expected a network that maps (B, {channels}, {samples}) to (B, features), "
            f"got one that gives {features.dim() - 1} dimensions; flatten its output."
        )
    return int(features.size(2))
