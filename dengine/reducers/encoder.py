"""The module that `TorchReducer` trains and exports: `Members` are K copies of a network with two
units and a logit each, and `Encoder` embeds raw traces by them. `fold_batch_norms` simplifies a
trained network before it is compiled.

    x (B, C, T) raw        -> Preprocessor -> (B, C', L)
    K copies of the network                -> (B, K, F) features
    two units each, sigmoid                -> (B, K, 2) units u1, u2
    logit = slope . units + offset         -> (B, K)
    embedding                              -> (B, K, 2): probability sigmoid(logit),
                                              difference 0.1 * (u1 - u2)

Both coordinates are learned. The probability tells how good a part looks. The difference tells
which of the two units is active, so that parts on which the units disagree are not counted together
with parts on which both are undecided.
"""

from collections.abc import Callable
from inspect import signature

import torch
from torch import Tensor, nn
from torch.nn.utils import fuse_conv_bn_eval

from ..decision.scripting import register_tensors
from ..errors import SettingError, expect, instead
from .preprocessing import Preprocessor

# network(channels, samples) returns a module from (B, channels, samples) to (B, features).
NetworkFactory = Callable[..., nn.Module]

DIFFERENCE_RANGE = 0.1  # of the second coordinate; that of the first one is 1
INITIAL_SLOPE = 4.0  # of each unit in the logit


class Members(nn.Module):
    """K copies of a network, each with two sigmoid units and a logit of its own.

    Parameters
    ----------
    network : callable
        ``network(channels, samples)`` returns a module from (B, channels, samples) to
        (B, features). If it has a parameter ``members``, it returns one module for all copies, from
        (B, K * channels, samples) to (B, K * features).
    channels, samples : int
        Shape of a preprocessed trace.
    count : int
        K.

    Raises
    ------
    SettingError
        If `network` is a module instead of its class, the module does not give features, or two
        copies share weights that are trained: these would see the labels of every fold.
    """

    def __init__(self, network: NetworkFactory, channels: int, samples: int, count: int) -> None:
        super().__init__()
        self.count = count
        expect(
            callable(network) and not isinstance(network, nn.Module),
            "network to be a class or function that returns a module",
            f"an instance of {type(network).__name__}",
            "pass its class",
        )
        grouped = "members" in signature(network).parameters
        shape = f"(B, {channels}, {samples}) to (B, features)"
        if grouped:
            shape = f"(B, {count * channels}, {samples}) to (B, {count} * features), by `members`"
        with instead(SettingError, f"Expected a network that maps {shape}", Exception):
            self.networks: nn.Module = (
                Grouped(network, channels, samples, count)
                if grouped
                else Separate([network(channels, samples) for _ in range(count)])
            )
            features = count_features(self.networks, count, channels, samples)
            register_tensors(self.networks)
        if isinstance(self.networks, Separate):
            expect(
                count_trained(self.networks) == sum(map(count_trained, self.networks.networks)),
                "a network for each member, with weights of its own",
                "one that shares them",
                "make new layers in each call",
            )
        bound = features**-0.5
        self.weight = nn.Parameter(torch.empty(count, features, 2).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.zeros(count, 2))
        self.slope = nn.Parameter(torch.full((count, 2), INITIAL_SLOPE))
        self.offset = nn.Parameter(torch.full((count,), -INITIAL_SLOPE))

    def forward(self, x: Tensor) -> Tensor:
        """Preprocessed traces for each copy (B, K, channels, samples) -> logits (B, K)."""
        return self.logits(self.units(x))

    def units(self, x: Tensor) -> Tensor:
        """Preprocessed traces for each copy (B, K, channels, samples) -> units (B, K, 2).

        The units lie between 0 and 1.
        """
        features = self.networks(x)  # (B, K, F)
        units: Tensor = (features.unsqueeze(2) @ self.weight).squeeze(2) + self.bias
        return units.sigmoid()

    def logits(self, units: Tensor) -> Tensor:
        """Units (B, K, 2) -> logits (B, K): the units times `slope`, summed, plus `offset`."""
        return (units * self.slope).sum(2) + self.offset


class Grouped(nn.Module):
    """Compute all copies of a network by one module, `network`: (B, K, C', L) -> (B, K, F).

    The module reads all copies' channels one after another, (B, K * C', L), and gives (B, K * F).
    """

    def __init__(self, network: NetworkFactory, channels: int, samples: int, count: int) -> None:
        super().__init__()
        self.count = count
        self.network = network(channels, samples, members=count)

    def forward(self, x: Tensor) -> Tensor:
        features: Tensor = self.network(x.flatten(1, 2))
        return features.view(x.size(0), self.count, features.size(1) // self.count)


class Separate(nn.Module):
    """Compute each copy of a network by a module of its own: (B, K, C', L) -> (B, K, F).

    Module k of `networks` maps the traces of copy k, (B, C', L), to its features (B, F).
    """

    def __init__(self, networks: list[nn.Module]) -> None:
        super().__init__()
        self.networks = nn.ModuleList(networks)

    def forward(self, x: Tensor) -> Tensor:
        return torch.stack([network(x[:, k]) for k, network in enumerate(self.networks)], 1)


class FoldableSequential(nn.Sequential):
    """A `Sequential` whose batch normalisations `fold_batch_norms` folds into convolutions.

    Use it only if its layers are never called or hooked one by one: a folded convolution already
    gives normalised values. A plain `Sequential` is not folded.
    """


class Encoder(nn.Module):
    """Embed raw traces in K spaces, one for each copy of a network: (B, C, T) -> (B, K, dim).

    Parameters
    ----------
    preprocessor : Preprocessor
    members : Members
        In evaluation mode, after `fold_batch_norms`.
    dim : int
        2, or 1 for the probability alone.
    """

    def __init__(self, preprocessor: Preprocessor, members: Members, dim: int) -> None:
        super().__init__()
        self.preprocessor = preprocessor
        self.members = members
        self.dim = dim
        self.difference_range = DIFFERENCE_RANGE

    def forward(self, x: Tensor) -> Tensor:
        """Raw traces (B, C, T) -> (B, K, dim)."""
        x = self.preprocessor(x)
        return self.embed(x.unsqueeze(1).expand(-1, self.members.count, -1, -1))

    @torch.jit.export
    def embed(self, x: Tensor) -> Tensor:
        """Embed preprocessed traces by each copy of the network: (B, K, C', L) -> (B, K, dim).

        Each of the K copies embeds the traces at its own index k; a preprocessed trace has C'
        channels of L averaged, standardised samples. The first coordinate is the copy's probability
        of success. The second, if `dim` is 2, is 0.1 times the difference between the two sigmoid
        units from which the copy computes the probability.
        """
        units = self.members.units(x)
        probability = self.members.logits(units).sigmoid()
        if self.dim == 1:
            return probability.unsqueeze(2)
        difference = units.select(2, 0) - units.select(2, 1)
        return torch.stack([probability, self.difference_range * difference], 2)


def fold_batch_norms(module: nn.Module) -> nn.Module:
    """Fold the batch normalisations of each `FoldableSequential` of a module into convolutions.

    `FoldableSequential` is a `Sequential` that a network marks in this way as safe to simplify. A
    batch normalisation in it is folded into the `Conv1d` right before it, by torch's
    `fuse_conv_bn_eval`. Batch normalisations without a `Conv1d` before them, and those outside a
    `FoldableSequential`, stay. The module must be in evaluation mode. It is changed in place and
    returned; use the return value, because each `FoldableSequential`, perhaps the module itself, is
    replaced by a new, plain `Sequential`.
    """
    for name, child in module.named_children():
        setattr(module, name, fold_batch_norms(child))
    if not isinstance(module, FoldableSequential):
        return module
    layers: list[nn.Module] = []
    for layer in module:
        if isinstance(layer, nn.BatchNorm1d) and layers and isinstance(layers[-1], nn.Conv1d):
            layers[-1] = fuse_conv_bn_eval(layers[-1], layer)
        else:
            layers.append(layer)
    return nn.Sequential(*layers)


def count_trained(module: nn.Module) -> int:
    """Return the number of tensors of a module that are trained; a shared tensor counts once."""
    return sum(weight.requires_grad for weight in module.parameters())


def count_features(networks: nn.Module, count: int, channels: int, samples: int) -> int:
    """Return how many features each copy of a network gives, by a trial on three traces of zeros.

    `networks` computes K copies at once, (B, K, channels, samples) -> (B, K, features); `count` is
    K. The trial is in evaluation mode, so that no statistics change; afterwards the networks are in
    training mode. Raises ValueError unless the output holds floats and has three dimensions, three
    rows and at least one feature, and AttributeError if it is no tensor. What the networks'
    `forward` raises is raised as it is; they stay in evaluation mode then.
    """
    networks.eval()
    with torch.no_grad():
        features = networks(torch.zeros(3, count, channels, samples))
    networks.train()
    if features.dim() != 3 or len(features) != 3 or not features.size(2):
        shape = (*features.shape[:1], *features.shape[2:])
        raise ValueError(f"for three traces it gives {shape}; flatten its output")
    if not features.is_floating_point():
        raise ValueError(f"it gives {features.dtype}, expected floats")
    return int(features.size(2))
