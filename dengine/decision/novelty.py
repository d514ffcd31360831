"""The novelty gate: is a trace like those that the model learned from? `fit_novelty` fits a
`NoveltyGate` to the traces of a training; the gate is a module that compiles to TorchScript and
returns True for a novel trace. The model asks it before labels are counted, and a novel trace is
verified.

    >>> gate = fit_novelty(traces, margin=1.5)
    >>> gate(torch.from_numpy(traces[0]))
    False

The features of a trace x (C, T), and the distances that are taken of them:

    x -> S segments of each channel: minimum, maximum, log roughness of
         first and of second differences                                  (C, 4*S)
      -> log roughness of the quietest and the loudest brief stretches:
         gaps and jumps                                                   (C, 3)
      -> all of them                                                      (P,) = (C*(4*S + 3),)
      -> and their products with D discriminants: distortions             (P + D,)
      -> standardised; squared distance to the nearest reference over
         its limit, for each group: level (minimum, maximum), texture
         (first differences), distortions, gaps                           (4,)

The trace is novel if any of the four exceeds 1. The distance is Hotelling's T^2 (1947) from the
nearest reference and not from the mean, because parts that seat, jam and miss lie in clouds apart
(He and Wang, 2007, IEEE Trans. Semicond. Manuf. 20). Each group has a limit of its own, because
hum, for one, leaves the level where it was (Jackson and Mudholkar, 1979, Technometrics 21). Parts
scatter widely, yet a gain, a drift or a delay moves all features together as parts do not: a
distortion is Fisher's discriminant (1936, Annals of Eugenics 7) between the references and what a
sensor or a clock would make of them. Segments: Nomikos and MacGregor (1994, AIChE Journal 40).
Limits from the references themselves: MacGregor and Kourti (1995, Control Engineering Practice 3).
No label is read here, and nothing is clipped.
"""

import numpy as np
import torch
from torch import Tensor, nn

from ..records import Ints, TraceArray

SEGMENTS = 14
BRIEF = (
    100  # brief stretches in a trace: a gap of half a segment hardly changes a segment's roughness
)
LEAST_GAP_LIMIT = (
    4.0  # squared deviations: gaps' three features lie dense, with some clean ones aside
)
MOST_SEGMENTS = 42  # of all channels together: many channels have fewer each
REFERENCES = 500  # searched at each decision
FEWEST = 20  # traces: fewer cannot say what is usual
QUANTILE = 0.995
TAIL_TRACES = 200  # one in so many lies beyond the quantile
CLUSTER_SIZE = 3  # outliers that lie together make a kind of their own
DISTORTIONS = 14  # D, of `_distort`
DISTORTED = 125  # references that are distorted: the mean of many more is the same


class NoveltyGate(nn.Module):
    """Says whether a trace is novel; compiles to TorchScript.

    Parameters
    ----------
    channels, samples : int
        Shape of the traces; it fixes the shapes of all buffers.

    Attributes
    ----------
    disabled : bool
        If True, nothing is novel. It is True until `fit_novelty` or a stored state enables the
        gate.
    noise_floor : Tensor of float32, shape (C, 2*S + 3)
        Added to each roughness before its logarithm.
    discriminants : Tensor of float32, shape (P, D)
    offset, gain : Tensor of float32, shape (4, P + D)
        For level, texture, distortions and gaps: they standardise the features of the group,
        divided by the root of its limit, and are zero for the features of the other groups.
    points : Tensor of float32, shape (P + D, REFERENCES)
        Standardised features of the references, one column each.
    norms : Tensor of float32, shape (4, REFERENCES)
        Squared norm of each reference in each group, less what it reaches farther than others;
        infinity in a column without a reference.
    """

    noise_floor: Tensor
    offset: Tensor
    gain: Tensor
    points: Tensor
    norms: Tensor
    discriminants: Tensor

    def __init__(self, channels: int, samples: int) -> None:
        super().__init__()
        self.disabled = True
        segments = max(1, min(SEGMENTS, MOST_SEGMENTS // channels, samples // 2))
        self.stride = samples // segments
        # Segments overlap a little, so that no sample is left out.
        self.length = samples - (segments - 1) * self.stride
        self.segments = segments
        self.brief = max(1, samples // BRIEF)
        n_plain = channels * (4 * segments + 3)  # P
        n_features = n_plain + DISTORTIONS
        self.register_buffer("noise_floor", torch.ones(channels, 2 * segments + 3))
        shapes = {
            "discriminants": (n_plain, DISTORTIONS),
            "offset": (4, n_features),
            "gain": (4, n_features),
            "points": (n_features, REFERENCES),
            "norms": (4, REFERENCES),
        }
        for name, shape in shapes.items():
            self.register_buffer(name, torch.zeros(shape))

    def forward(self, x: Tensor) -> bool:
        """Return whether a trace (C, T) of float32 is novel: any of its `scores` is above 1.

        A trace whose features overflow to NaN is novel. Nothing is novel if the gate is disabled.
        """
        if self.disabled:
            return False
        return not float(self.scores(x).amax().item()) <= 1.0

    @torch.jit.export
    def scores(self, x: Tensor) -> Tensor:
        """Return four scores of a trace (C, T), float32 (4,); if any is above 1, it is novel.

        Each score looks at one group of features, in this order: the level of the signals, their
        texture (how rough they are), distortions (what a faulty sensor or clock would do), and
        gaps. It is the squared distance to the nearest reference in these features, divided by the
        largest one that is still usual; references are traces that this module was fitted to. A
        reference in a small cluster of unusual traces counts as nearer than it is, so a score near
        it may be below 0. A score is NaN or infinite if a feature overflows; the trace is novel
        then, too. If the module is `disabled`, the scores mean nothing.
        """
        plain = self.plain_features(x)
        features = torch.cat([plain, plain @ self.discriminants])
        z = torch.addcmul(self.offset, features, self.gain)  # (4, P + D)
        nearest = torch.addmm(self.norms, z, self.points, alpha=-2.0).amin(1)
        return nearest + (z * z).sum(1)

    def plain_features(self, x: Tensor) -> Tensor:
        """Return all features of traces (..., C, T) but the distortions: (..., P) float32.

        The distortions, features of what a faulty sensor or clock would do, are computed from these
        by `scores`. P is C * (4*S + 3). A channel is cut into S segments, stretches of equal length
        that together cover the trace, and may overlap. For each channel the features are the S
        minima and the S maxima of the segments, then 2*S + 3 logarithms of roughness, which is the
        norm of the differences of successive samples in a stretch, plus `noise_floor` (a share of
        the usual roughness of the traces of the training). The first S are of first differences in
        the segments, the next S of second differences in the segments. The last three, for gaps,
        are of first differences in brief stretches. Such a stretch has T / 100 differences, rounded
        down, and at least one. These three are the least roughness over stretches of twice that
        length, then the least and the largest over stretches of that length.
        """
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
        logs = torch.cat(rough, -1).add_(self.noise_floor).log_()
        # Two calls, for aminmax takes half as long again as both.
        return torch.cat([pieces.amin(-1), pieces.amax(-1), logs], -1).flatten(-2)

    def roughness(self, x: Tensor, length: int, stride: int) -> Tensor:
        """Return the norm of each stretch of `length` values of x (..., T), shape (..., n).

        A stretch begins at every `stride`-th value, as long as it fits; values behind the last one
        are not read. A shorter x is one stretch.
        """
        stretches = x.unfold(-1, max(0, min(length, x.size(-1))), stride)
        norms: Tensor = torch.linalg.vector_norm(stretches, dim=-1)
        return norms


def fit_novelty(traces: TraceArray, margin: float, parts: Ints | None = None) -> NoveltyGate:
    """Fit a novelty gate, the test whether a trace is unlike these (novel), without randomness.

    At most 500 (`REFERENCES`) of the traces, evenly spaced in time, become references, to which
    other traces are compared; of these, traces whose features overflow are left out. A reference is
    not novel; of the other traces some may be. Each of four groups of features has a limit of its
    own: level (minima and maxima), texture (roughness), distortions (what a faulty sensor or clock
    would do) and gaps (the quietest and the loudest brief stretches).

    Parameters
    ----------
    traces : array of float32, shape (n, C, T)
        Finite, with any labels, oldest first.
    margin : float
        Factor on the limits, which are squared distances of standardised features; above 0, which
        is not checked. A limit is the 99.5 % quantile of the references' squared distances to the
        nearest other reference, capped at six times the 90 % quantile, so that a few outliers do
        not set it, and at least 0.001. With k < 200 different references it is multiplied by
        200 / k; the limit of distortions is multiplied by 500 / k with k < 500. The limit of gaps
        is at least 4 in the end. An outlier in a cluster of outliers has a wider limit, by the
        distance to its third nearest outlier.
    parts : array of int64, shape (n,), optional
        Hash of the part of each trace; traces with the same value, also 0, are of one part. None:
        each trace is of another part. Only distances between different parts and different traces
        count, because a trace that came twice is near itself.

    Returns
    -------
    NoveltyGate
        Disabled (no trace is novel) if fewer than 20 (`FEWEST`) of the references differ in part
        and content.
    """
    n, channels, samples = traces.shape
    gate = NoveltyGate(channels, samples)
    chosen = np.linspace(0, n - 1, min(n, REFERENCES)).round().astype(np.intp)  # evenly in time
    same, n_distinct = _find_same(traces[chosen], None if parts is None else parts[chosen])
    if n_distinct < FEWEST:
        return gate
    x = torch.from_numpy(traces[chosen])
    gate.noise_floor.copy_(_noise_floor(gate, x))
    plain = gate.plain_features(x).double().nan_to_num()
    # Kind of each feature: 0 minimum, 1 maximum, 2 and 3 roughness, 4 gaps; 5 distortions.
    counts = torch.tensor([*4 * [gate.segments], 3])
    kinds = torch.arange(5).repeat_interleave(counts).repeat(channels)
    gate.discriminants.copy_(_discriminants(gate, x, plain, kinds < 4))
    features = torch.cat([plain, plain @ gate.discriminants.double()], 1).nan_to_num()
    offset, gain = _standardise(features)
    standard = torch.addcmul(offset, features, gain).float()
    is_sound = standard.abs().amax(1) < 1e15  # the square of a larger distance would overflow
    standard = standard[is_sound]
    same = same[is_sound][:, is_sound]
    kinds = torch.cat([kinds, torch.full((DISTORTIONS,), 5)])
    # The features of each group, the traces that its limit needs, and its least limit. Of fewer
    # traces the farthest stands for the quantile: the tail beyond it is taken as 1 / d^2. And of
    # fewer than REFERENCES the discriminants fit these too well.
    groups = [
        (kinds < 2, TAIL_TRACES, 0.0),
        (kinds == 2, TAIL_TRACES, 0.0),
        (kinds == 5, REFERENCES, 0.0),
        (kinds == 4, TAIL_TRACES, LEAST_GAP_LIMIT),
    ]
    for i, (group, n_needed, least) in enumerate(groups):
        points = standard[:, group]
        limit, reach = _usual_distance_and_reach(points, same)
        limit = max(least, margin * max(1.0, n_needed / n_distinct) * limit)
        factor = limit**-0.5
        gate.offset[i, group] = (factor * offset[group]).float()
        gate.gain[i, group] = (factor * gain[group]).float()
        gate.points[group, : len(points)] = factor * points.t()
        gate.norms[i] = float("inf")
        farther = (margin * reach / limit - 1.0).clamp(min=0.0)
        gate.norms[i, : len(points)] = points.square().sum(1) / limit - farther
    gate.disabled = False
    return gate


def _noise_floor(gate: NoveltyGate, x: Tensor) -> Tensor:
    """Return what is added to each roughness before its logarithm, float32 (C, 2*S + 3).

    `gate` says how many samples each of the 2*S + 3 roughnesses of a channel is taken over (they
    are norms of differences in a stretch of samples; S is the number of segments of a channel, see
    `plain_features`). The result is a twentieth of the roughness of a whole trace (the norm of its
    first differences in the channel, as the median over the traces x (n, C, T)), times the root of
    the share of samples in the stretch, and at least 1e-12, as for a channel that is constant in
    half of the traces or more: any movement there is then far away.
    """
    n_samples = x.size(2)
    steps: Tensor = torch.linalg.vector_norm(torch.diff(x), dim=2).median(0).values
    # In the order of `plain_features`: first and second differences of segments, then brief ones.
    lengths = torch.tensor(
        [*2 * gate.segments * [gate.length], 2 * gate.brief, gate.brief, gate.brief]
    )
    return (0.05 * (lengths / n_samples).sqrt() * steps[:, None]).clamp(min=1e-12)


def _distort(x: Tensor) -> list[Tensor]:
    """Return distorted copies of traces x (n, C, T): a list of 14 tensors of that shape.

    They are what a faulty sensor or clock would make of the traces. Four have another gain: 0.6,
    1.6, and a gain that begins at 1 and falls or rises by 0.4 in the course of the trace. Six are
    moved up or down, in units of the channel's standard deviation within a trace (the median over
    the n traces): by an offset of 0.4, by a drift that grows to 0.5, and by a step of 0.5 in the
    middle. Four have another time: 8 % slower or faster, a 30th of the trace later or earlier.
    Beyond its ends a trace is continued by its mirror image.
    """
    n_samples = x.size(2)
    t = torch.linspace(0.0, 1.0, n_samples)
    size = x.std(2, unbiased=False).median(0).values[:, None]  # (C, 1)
    scaled = [factor * x for factor in (0.6, 1.6, 1.0 - 0.4 * t, 1.0 + 0.4 * t)]
    shifts = (0.4 * size, 0.5 * size * t, 0.5 * size * (t >= 0.5))
    moved = [x + sign * shift for shift in shifts for sign in (1.0, -1.0)]
    # Beyond the ends of a trace is its mirror image, for what stands still would give it away.
    at = torch.arange(n_samples)
    last = n_samples - 1
    clocks = (at / 1.08, at * 1.08, at - n_samples / 30, at + n_samples / 30)
    mirrored = [last - (last - clock.abs()).abs() for clock in clocks]
    timed = [
        torch.lerp(x[..., p.floor().long()], x[..., p.ceil().long()], p.frac()) for p in mirrored
    ]
    return scaled + moved + timed


def _discriminants(gate: NoveltyGate, x: Tensor, plain: Tensor, used: Tensor) -> Tensor:
    """Return Fisher's discriminants of traces and their D distortions, float32 (P, D), P features.

    Column j separates the traces x (n, C, T) from their j-th distortion (`_distort`); it is for
    features that are not standardised. `plain` (n, P), float64, are the traces' features by `gate`,
    the module that tests whether a trace is novel. Only features that `used` (P,), bool, marks are
    read; the rows of the others are 0. Of the traces fewer than 250, evenly spaced, are distorted,
    for the mean difference. The covariance is that of all traces, plus the identity times (number
    of used features / n)**2, because the covariance of few traces is not known, plus half of the
    covariance of the distorted traces. Inside, standardised features are clipped at 6 deviations.
    """
    offset, gain = (used * values for values in _standardise(plain))
    z = torch.addcmul(offset, plain, gain).clamp(-6.0, 6.0)
    # The covariance of few traces is not known: it is shrunk towards the identity.
    shrinkage = (int(used.sum()) / len(plain)) ** 2
    covariance = torch.cov(z.T) + shrinkage * torch.eye(plain.size(1), dtype=z.dtype)
    step = max(1, len(plain) // DISTORTED)
    directions = []
    for distorted in _distort(x[::step]):
        features = gate.plain_features(distorted).double().nan_to_num()
        other = torch.addcmul(offset, features, gain).clamp(-6.0, 6.0)
        directions.append(
            torch.linalg.solve(covariance + 0.5 * torch.cov(other.T), (other - z[::step]).mean(0))
        )
    return (gain[:, None] * torch.stack(directions, 1)).float()


def _standardise(features: Tensor) -> tuple[Tensor, Tensor]:
    """Return (offset, gain), float64 (P,) each, so that offset + gain * features is standardised.

    `features` are float64 (n, P); n, the number of references, is at least 3. The 1 + n // 200
    smallest and largest values of each feature are first clipped to the next value inside, so that
    a glitch sets no scale; mean and deviation are those of the clipped values. The gain is 1 /
    (deviation + floor). The floor is 1 % of the median deviation of all features, plus 1e-5 of the
    feature's absolute mean, for its rounding errors, plus 1e-12: a feature that is constant in the
    references lies far out as soon as it moves.
    """
    n = len(features)
    n_outer = 1 + n // TAIL_TRACES
    ordered = np.partition(features.numpy().T, (n_outer, n - 1 - n_outer), 1)  # (P, n)
    inner = features.clamp(
        torch.from_numpy(ordered[:, n_outer]), torch.from_numpy(ordered[:, -1 - n_outer])
    )
    mean = inner.mean(0)
    deviation = inner.std(0, unbiased=False)
    deviation += 1e-2 * deviation.median() + 1e-5 * mean.abs() + 1e-12
    return -mean / deviation, 1.0 / deviation


def _find_same(traces: TraceArray, parts: Ints | None) -> tuple[Tensor, int]:
    """Return which traces are equal or of one part, and how many are not repeats.

    `traces` is (n, C, T), `parts` (n,) holds the hash of the part of each trace. The first result
    is (n, n) bool, with a diagonal of True. The second counts the traces that are not the same as
    an earlier one. Traces with the hash 0 are of one part, too. If `parts` is None, only equal
    traces are the same.
    """
    numbers: dict[bytes, int] = {}
    content = np.array([numbers.setdefault(x.tobytes(), len(numbers)) for x in traces])
    part = content if parts is None else parts
    same = (content[:, None] == content) | (part[:, None] == part)
    return torch.from_numpy(same), int((~np.tril(same, -1).any(1)).sum())


def _usual_distance_and_reach(points: Tensor, same: Tensor) -> tuple[float, Tensor]:
    """Return (usual squared distance between nearest points, squared reach of each point (n,)).

    `points` (n, P) are features of n references; `same` (n, n), bool, marks pairs whose distance
    does not count. The usual distance is the 99.5 % quantile of squared distances to the nearest
    other point, at most six times their 90 % quantile, and at least 0.001. The squared reach of a
    point, within which another point is still near it, is the usual distance, except for some
    outliers.

    A point is an outlier if its squared distance to the nearest other point is above the usual one,
    or above both 0.001 and three times the 90 % quantile. If there are more than three outliers,
    the squared reach of an outlier is the squared distance to its third nearest outlier, if this is
    larger than the usual one, and if all points that are no outliers are more than twice as far
    away.
    """
    norms = points.square().sum(1)
    squared = torch.addmm(norms + norms[:, None], points, points.t(), alpha=-2.0)
    squared.masked_fill_(same, float("inf"))
    nearest = squared.amin(1)
    nine_in_ten, quantile = torch.quantile(nearest, torch.tensor([0.9, QUANTILE])).tolist()
    usual = max(1e-3, min(quantile, 6.0 * nine_in_ten))
    reach = torch.full_like(nearest, usual)
    is_outlier = nearest > max(1e-3, min(usual, 3.0 * nine_in_ten))
    if CLUSTER_SIZE < is_outlier.sum() < len(points):
        rows = squared[is_outlier]
        cluster = rows[:, is_outlier].kthvalue(CLUSTER_SIZE, 1).values
        is_apart = 4.0 * cluster < rows[:, ~is_outlier].amin(1)
        reach[is_outlier] = torch.where(is_apart, cluster.clamp(min=usual), usual)
    return usual, reach
