"""Is this trace like those learned from? Distances to the nearest reference, by level, texture, distortion and gaps.

    >>> gate = fit_novelty(traces, margin=1.5)
    >>> gate(torch.from_numpy(traces[0]))
    False

    x (C, T) -> S segments: minimum, maximum, logarithms of the roughness of samples and of steps  (C, 4*S)
             -> roughness of the quietest and the loudest of all brief stretches: gaps and jumps   (P,) = (C*(4*S + 3),)
             -> level (the first two), texture (the third), distortions (products of all), gaps    (P + D,)
             -> standardised, squared distance to the nearest reference over its limit, of each of these four  (4,)

Hotelling's T^2 (1947), taken from the nearest reference and not from the mean: parts that seat, jam and miss lie in clouds
apart (He and Wang, 2007, IEEE Trans. Semicond. Manuf. 20). Each statistic has a limit of its own, and any alone tells: hum
leaves the level where it was (Jackson and Mudholkar, 1979, Technometrics 21). Parts scatter widely, yet a gain, a drift or
a delay moves all features together as parts do not: a distortion is Fisher's discriminant (1936, Annals of Eugenics 7)
between the references and what a sensor or a clock would make of them. Segments: Nomikos and MacGregor (1994, AIChE Journal
40). Limits from the references themselves: MacGregor and Kourti (1995, Control Engineering Practice 3). No label is read
here, and nothing is clipped.
"""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

SEGMENTS = 14
BRIEF = 100  # of a trace: a gap of half a segment hardly changes the roughness of a segment
FAR = 4.0  # squared deviations that a gap lies away at least: its three features lie dense, with some clean ones aside
WIDEST = 42  # segments of all channels together: many channels have fewer each
REFERENCES = 500  # searched at each decision
FEWEST = 20  # traces: fewer cannot say what is usual
QUANTILE = 0.995
TAIL_TRACES = 200  # one of so many lies beyond the quantile
LIKE = 3  # strangers that make a kind
DISTORTIONS = 14  # D, of `_distorted`
DISTORTED = 125  # references that are distorted: the mean of many more is the same


class NoveltyGate(nn.Module):
    """(C, T) -> novel? All that it learns is in buffers whose shapes `channels` and `samples` fix.

    asleep : whether nothing is novel, as it is until `fit_novelty` or a stored state wakes it.
    """

    quiet: Tensor
    offset: Tensor
    gain: Tensor
    points: Tensor
    norms: Tensor
    distortions: Tensor

    def __init__(self, channels: int, samples: int) -> None:
        super().__init__()
        self.asleep = True
        segments = max(1, min(SEGMENTS, WIDEST // channels, samples // 2))
        self.stride = samples // segments
        self.length = samples - (segments - 1) * self.stride  # overlapping a little: no sample is left out
        self.segments, self.brief = segments, max(1, samples // BRIEF)
        n_plain = channels * (4 * segments + 3)  # P
        n_features = n_plain + DISTORTIONS
        self.register_buffer("quiet", torch.ones(channels, 2 * segments + 3))
        self.register_buffer("distortions", torch.zeros(n_plain, DISTORTIONS))
        # A row for the level, for the texture, for distortions and for gaps, zero in the others' features.
        self.register_buffer("offset", torch.zeros(4, n_features))
        self.register_buffer("gain", torch.zeros(4, n_features))
        self.register_buffer("points", torch.zeros(n_features, REFERENCES))
        self.register_buffer("norms", torch.zeros(4, REFERENCES))

    def forward(self, x: Tensor) -> bool:
        """(C, T) float32, one trace, in the references' unit -> whether it is unlike all of them."""
        if self.asleep:
            return False
        far: list[float] = self.scores(x).tolist()
        return not (far[0] <= 1.0 and far[1] <= 1.0 and far[2] <= 1.0 and far[3] <= 1.0)  # what overflowed to NaN is novel

    @torch.jit.export
    def scores(self, x: Tensor) -> Tensor:
        """(C, T) -> (4,) float32: squared distances over their limits, by level, texture, distortion, gaps."""
        plain = self.plain(x)
        z = torch.addcmul(self.offset, torch.cat([plain, plain @ self.distortions]), self.gain)  # (4, P + D)
        nearest = torch.addmm(self.norms, z, self.points, alpha=-2.0).amin(1)
        return nearest + (z * z).sum(1)

    def plain(self, x: Tensor) -> Tensor:
        """(..., C, T) -> (..., P): of each channel its segments' minima, maxima, logarithms of roughness; and gaps."""
        pieces = x.unfold(-1, self.length, self.stride)  # (..., C, S, L)
        steps = x[..., 1:] - x[..., :-1]  # from sample to sample
        bends = steps[..., 1:] - steps[..., :-1]
        brief = self.roughness(steps, self.brief, (self.brief + 1) // 2)
        rough = [
            self.roughness(steps, self.length - 1, self.stride),
            self.roughness(bends, self.length - 2, self.stride),
            self.roughness(steps, 2 * self.brief, self.brief).amin(-1, keepdim=True),
            brief.amin(-1, keepdim=True),
            brief.amax(-1, keepdim=True),
        ]
        # One after the other: aminmax takes half as long again as both.
        own = [pieces.amin(-1), pieces.amax(-1), torch.cat(rough, -1).add_(self.quiet).log_()]
        return torch.cat(own, -1).flatten(-2)

    def roughness(self, x: Tensor, length: int, stride: int) -> Tensor:
        """(..., T) -> (..., n): the norm of each stretch of so many, of all where these are fewer."""
        stretches = x.unfold(-1, max(0, min(length, x.size(-1))), stride)
        norms: Tensor = torch.linalg.vector_norm(stretches, dim=-1)
        return norms


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
    segments, brief = gate.segments, gate.brief
    lengths = torch.tensor([*2 * segments * [gate.length], 2 * brief, brief, brief])
    gate.quiet.copy_((0.05 * (lengths / samples).sqrt() * steps[:, None]).clamp(min=1e-12))
    plain = gate.plain(x).double().nan_to_num()
    of = torch.arange(5).repeat_interleave(torch.tensor([*4 * [segments], 3])).repeat(channels)
    gate.distortions.copy_(_discriminants(gate, x, plain, of < 4))
    features = torch.cat([plain, plain @ gate.distortions.double()], 1).nan_to_num()
    offset, gain = _standardising(features)
    standard = torch.addcmul(offset, features, gain).float()
    sound = standard.abs().amax(1) < 1e15  # the square of a larger distance would overflow
    if not sound.all():
        standard, same = standard[sound], same[sound][:, sound]
    of = torch.cat([of, torch.full((DISTORTIONS,), 5)])
    # Of fewer than TAIL_TRACES the farthest stands for the quantile: the tail beyond it is taken as 1 / d^2.
    # And of fewer than REFERENCES the discriminants fit these too well.
    level, texture, distortion = (of < 2, TAIL_TRACES, 0.0), (of == 2, TAIL_TRACES, 0.0), (of == 5, REFERENCES, 0.0)
    for i, (group, enough, least) in enumerate((level, texture, distortion, (of == 4, TAIL_TRACES, FAR))):
        points = standard[:, group]
        limit, reach = _limits(points, same)
        limit = max(least, margin * max(1.0, enough / distinct) * limit)
        gate.offset[i, group] = (limit**-0.5 * offset[group]).float()
        gate.gain[i, group] = (limit**-0.5 * gain[group]).float()
        gate.points[group, : len(points)] = limit**-0.5 * points.t()
        gate.norms[i] = float("inf")  # of no reference: never the nearest
        gate.norms[i, : len(points)] = points.square().sum(1) / limit - (margin * reach / limit - 1.0).clamp(min=0.0)
    gate.asleep = False
    return gate


def _distorted(x: Tensor) -> list[Tensor]:
    """What a sensor or a clock would make of traces (n, C, T): gain, offset, drift, speed, delay, fading gain, a step."""
    samples = x.size(2)
    t = torch.linspace(0.0, 1.0, samples)
    size = x.std(2, unbiased=False).median(0).values[:, None]  # (C, 1)
    scaled = [factor * x for factor in (0.6, 1.6, 1.0 - 0.4 * t, 1.0 + 0.4 * t)]
    moved = [x + sign * each for each in (0.4 * size, 0.5 * size * t, 0.5 * size * (t >= 0.5)) for sign in (1.0, -1.0)]
    # Beyond the ends of a trace is its mirror image: what stands still would give it away.
    at, last = torch.arange(samples), samples - 1
    places = [last - (last - p.abs()).abs() for p in (at / 1.08, at * 1.08, at - samples / 30, at + samples / 30)]
    timed = [torch.lerp(x[..., p.floor().long()], x[..., p.ceil().long()], p.frac()) for p in places]
    return scaled + moved + timed


def _discriminants(gate: NoveltyGate, x: Tensor, plain: Tensor, read: Tensor) -> Tensor:
    """(P, D): Fisher's discriminants between traces x (n, C, T), of features plain (n, P) float64, and these distorted.

    read : (P,) bool, the features that they read.
    """
    offset, gain = (read * each for each in _standardising(plain))
    z = torch.addcmul(offset, plain, gain).clamp(-6.0, 6.0)
    # Of few traces the covariance is not known: it is drawn to one.
    known = torch.cov(z.T) + (int(read.sum()) / len(plain)) ** 2 * torch.eye(plain.size(1), dtype=z.dtype)
    some = slice(None, None, max(1, len(plain) // DISTORTED))
    directions = []
    for traces in _distorted(x[some]):
        other = torch.addcmul(offset, gate.plain(traces).double().nan_to_num(), gain).clamp(-6.0, 6.0)
        directions.append(torch.linalg.solve(known + 0.5 * torch.cov(other.T), (other - z[some]).mean(0)))
    return (gain[:, None] * torch.stack(directions, 1)).float()


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
