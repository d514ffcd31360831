"""Is this trace like those learned from? Its distance to the nearest reference, in level and in texture, against limits.

    >>> gate = fit_novelty(traces, margin=1.5)
    >>> gate(torch.from_numpy(traces[0]))
    False

    x (C, T) -> S segments: minimum and maximum (the level), logarithm of the roughness (the texture)   (3*C*S,)
             -> standardised
             -> squared distance to the nearest reference over its limit, of the level, of the texture  (2,)

Hotelling's T^2 (1947), taken from the nearest reference and not from the mean: parts that seat, jam and miss lie in clouds
apart (He and Wang, 2007, IEEE Trans. Semicond. Manuf. 20). Two statistics have a limit each, and either alone tells: hum
leaves the level where it was (Jackson and Mudholkar, 1979, Technometrics 21). Segments: Nomikos and MacGregor (1994, AIChE
Journal 40). Limits from the references themselves: MacGregor and Kourti (1995, Control Engineering Practice 3). No label is
read here, and nothing is clipped.
"""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

SEGMENTS = 14
WIDEST = 42  # segments of all channels together: many channels have fewer each
REFERENCES = 500  # searched at each decision
FEWEST = 20  # traces: fewer cannot say what is usual
QUANTILE = 0.995
TAIL_TRACES = 200  # one of so many lies beyond the quantile
LIKE = 3  # strangers that make a kind


class NoveltyGate(nn.Module):
    """(C, T) -> novel? All that it learns is in buffers whose shapes `channels` and `samples` fix.

    asleep : whether nothing is novel, as it is until `fit_novelty` or a stored state wakes it.
    """

    quiet: Tensor
    offset: Tensor
    gain: Tensor
    points: Tensor
    norms: Tensor

    def __init__(self, channels: int, samples: int) -> None:
        super().__init__()
        self.asleep = True
        segments = max(1, min(SEGMENTS, WIDEST // channels, samples // 2))
        self.stride = samples // segments
        self.length = samples - (segments - 1) * self.stride  # overlapping a little: no sample is left out
        n_features = 3 * channels * segments  # P
        self.register_buffer("quiet", torch.ones(channels, segments))
        # A row for the level and one for the texture, zero in the other one's features.
        self.register_buffer("offset", torch.zeros(2, n_features))
        self.register_buffer("gain", torch.zeros(2, n_features))
        self.register_buffer("points", torch.zeros(n_features, REFERENCES))
        self.register_buffer("norms", torch.zeros(2, REFERENCES))

    def forward(self, x: Tensor) -> bool:
        """(C, T) float32, one trace, in the references' unit -> whether it is unlike all of them."""
        if self.asleep:
            return False
        far: list[float] = self.scores(x).tolist()
        return not (far[0] <= 1.0 and far[1] <= 1.0)  # what overflowed to NaN is novel

    @torch.jit.export
    def scores(self, x: Tensor) -> Tensor:
        """(C, T) -> (2,) float32: squared distance to the nearest reference over its limit, in level and in texture."""
        z = torch.addcmul(self.offset, self.features(x), self.gain)  # (2, P)
        nearest = torch.addmm(self.norms, z, self.points, alpha=-2.0).amin(1)
        return nearest + (z * z).sum(1)

    def features(self, x: Tensor) -> Tensor:
        """(..., C, T) -> (..., P): of each channel its segments' minima, maxima, logarithms of roughness."""
        pieces = x.unfold(-1, self.length, self.stride)  # (..., C, S, L)
        steps = (x[..., 1:] - x[..., :-1]).unfold(
            -1, self.length - 1, self.stride
        )  # from sample to sample, (..., C, S, L - 1)
        rough = torch.linalg.vector_norm(steps, dim=-1)
        # One after the other: aminmax takes half as long again as both.
        return torch.cat([pieces.amin(-1), pieces.amax(-1), rough.add_(self.quiet).log_()], -1).flatten(-2)


def fit_novelty(traces: NDArray[np.float32], margin: float, parts: NDArray[np.int64] | None = None) -> NoveltyGate:
    """The gate that takes traces (n, C, T) for usual: finite, any labels, oldest first. No randomness.

    margin : factor on the limits, 99.5 % quantiles of the references' squared distances to one another.
    parts : (n,) hashes of their parts; None: each is a part of its own. What came twice, a trace or a part, is near itself
        and says nothing of others: only distances between different parts and different traces count.
    """
    n, channels, samples = traces.shape
    gate = NoveltyGate(channels, samples)
    if n < FEWEST:
        return gate
    chosen = np.linspace(0, n - 1, min(n, REFERENCES)).round().astype(np.intp)  # evenly in time
    same, distinct = _same(traces[chosen], None if parts is None else parts[chosen])
    if distinct < FEWEST:
        return gate
    x = torch.from_numpy(traces[chosen])
    # Of each trace the middle one, (C,). A channel that never moved is silent at the least number: any sound is far away.
    steps = torch.linalg.vector_norm(torch.diff(x), dim=2).median(0).values if samples > 1 else torch.zeros(channels)
    gate.quiet.copy_((0.05 * (gate.length / samples) ** 0.5 * steps).clamp(min=1e-12)[:, None])
    features = gate.features(x).double()
    offset, gain = _standardising(features)
    standard = torch.addcmul(offset, features, gain).float()
    sound = standard.abs().amax(1) < 1e15  # the square of a larger distance would overflow
    if not sound.all():
        standard, same = standard[sound], same[sound][:, sound]
    texture = torch.arange(3 * gate.quiet.size(1)).ge(2 * gate.quiet.size(1)).repeat(channels)  # (P,)
    for i, group in enumerate((~texture, texture)):
        points = standard[:, group]
        limit, reach = _limits(points, same)
        # Of fewer than TAIL_TRACES the farthest stands for the quantile: the tail beyond it is taken as 1 / d^2.
        limit = margin * max(1.0, TAIL_TRACES / distinct) * limit
        gate.offset[i, group] = (limit**-0.5 * offset[group]).float()
        gate.gain[i, group] = (limit**-0.5 * gain[group]).float()
        gate.points[group, : len(points)] = limit**-0.5 * points.t()
        gate.norms[i] = float("inf")  # of no reference: never the nearest
        gate.norms[i, : len(points)] = points.square().sum(1) / limit - (margin * reach / limit - 1.0).clamp(min=0.0)
    gate.asleep = False
    return gate


def _standardising(features: Tensor) -> tuple[Tensor, Tensor]:
    """(n, P) float64 -> offset, gain, (P,) each."""
    # A glitch among the references must not be the measure of the others: the outermost of each feature are drawn in.
    few, n = 1 + len(features) // TAIL_TRACES, len(features)
    ordered = torch.from_numpy(np.partition(features.numpy().T, (few, n - 1 - few), 1))  # (P, n)
    inner = torch.minimum(torch.maximum(features, ordered[:, few]), ordered[:, -1 - few])
    mean, deviation = inner.mean(0), inner.std(0, unbiased=False)
    # What never moved is far away once it does, but not by the rounding of its own size.
    floor = 1e-2 * deviation.median() + 1e-5 * mean.abs() + 1e-12
    return -mean / (deviation + floor), 1.0 / (deviation + floor)


def _same(traces: NDArray[np.float32], parts: NDArray[np.int64] | None) -> tuple[Tensor, int]:
    """(n, n) bool, which traces (n, C, T) are one trace or of one part, themselves too; and how many are different."""
    for some in (traces[..., ::16], traces):  # a few samples tell most apart
        found: dict[bytes, int] = {}
        trace = np.array([found.setdefault(x.tobytes(), len(found)) for x in some])
        if len(found) == len(traces):
            break
    own = trace if parts is None else parts
    same = (trace[:, None] == trace) | (own[:, None] == own)
    return torch.from_numpy(same), int((~np.tril(same, -1).any(1)).sum())


def _limits(points: Tensor, same: Tensor) -> tuple[float, Tensor]:
    """The usual squared distance from points (n, P) to the nearest other one, not zero; and each point's own, (n,).

    same : (n, n) bool, those that are no other ones to one another.

    A few strangers among the references must not be the measure of the others: the QUANTILE is capped by what nine in ten
    show. A stranger reaches further only among its like: as far as its third nearest stranger, where all others are twice
    as far.
    """
    norms = points.square().sum(1)
    squared = torch.addmm(norms + norms[:, None], points, points.t(), alpha=-2.0)
    squared.masked_fill_(same, float("inf"))
    nearest = squared.amin(1)
    nine, most = torch.quantile(nearest, torch.tensor([0.9, QUANTILE])).tolist()
    usual = max(1e-3, min(most, 6.0 * nine))
    reach = torch.full_like(nearest, usual)
    strange = nearest > max(1e-3, min(usual, 3.0 * nine))
    if LIKE < int(strange.sum()) < len(points):
        own = squared[strange]
        alike = own[:, strange].kthvalue(LIKE, 1).values
        reach[strange] = torch.where(4.0 * alike < own[:, ~strange].amin(1), alike.clamp(min=usual), usual)
    return usual, reach
