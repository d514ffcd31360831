"""Drawn convolution kernels under cross-fitted logistic heads: no kernel is trained.

    >>> reducer = RocketReducer(folds=5).fit(X, y)     # X (n, T) or (n, C, T), y (n,) 1 = success, 0 = failure
    >>> reducer.embed(X).shape                       # (n, K, d): every trace in each of the K spaces

    x (B, C, T) -> means of a few samples each, one scale a channel                              (B, C, L)
    tower 1     -> conv, F kernels of 9 taps at each of D dilations, at P places                 (B, D, F, P)
                -> a ramp from 0 to 1 around a threshold, its mean over R regions, plus twice that over all (B, D*F*R)
    tower 2     -> conv, G groups of 8 kernels at each dilation, at Q places of the trace and of its differences
                -> how often each of a group answers most, and least; roots                      (B, 4*D*G*8)
    products    -> of every two of the four leading principal components of tower 1              (B, 16)
    all three   -> principal components and heads, one logit of them: `FeatureEmbedding`         (B, K, d)

A network trained on labels would exist K times, each on few labels. The encoder is drawn, not trained, and shared by all K
spaces. As in MiniRocket the kernels of tower 1 have fixed weights, and thresholds are drawn from what they give on the
first traces; instead of a hard share of positive values it counts by a ramp two deviations wide. It tells how large a force
is, and when. In tower 2 kernels compete, as in Hydra, but one that answers nearly most counts in part: so no rounding
decides who wins where a trace is flat. It tells which shapes are frequent.

Sources: Dempster, Schmidt and Webb (2021), MiniRocket, KDD, arXiv:2012.08791, for kernels, dilations and thresholds; by the
same (2023), Hydra, Data Min. Knowl. Disc. 37, for competing kernels; Tan, Dempster, Bergmeir and Webb (2022), MultiRocket,
Data Min. Knowl. Disc. 36, for several channels and differences. Cross-fitting: Wolpert (1992), Neural Networks 5, which
also weighs the towers; Chernozhukov et al. (2018), Econometrics Journal 21.
"""

import copy
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import combinations, pairwise
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from sklearn.base import clone
from sklearn.utils.validation import check_is_fitted
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812  # torch's own name for it

from ..decision.scripting import arrays_with_prefix, restore, script
from ..errors import SettingError, expect
from ..records import is_whole
from .base import (
    FitReport,
    Floats,
    Ints,
    Reducer,
    StopRule,
    binary_labels,
    folds_of,
    points_in_own_space,
    seed_of,
    single_class_error,
)
from .preprocessing import averaging

CLIP = 4.0  # deviations; an outlier may not carry a score by itself
TAPS = 9  # of MiniRocket's kernels; 84 = 9 choose 3 ways to place its three 2s among -1s
MIN_TRACES = 20  # that an engine's first model is trained on
FIRST_STEPS = 3  # of heads that start from nothing, however late: without any, they would hold all parts for alike
TRAIN_TRACES = 4000  # that the heads are fitted to at most, so that it ends in time however many references there are
GROWN = 1.5  # the components are found anew once there are so many times as many traces,
FITS = 20  # and at every 20th fit
# Variance of all components of a tower together: what a ridge is weighed against.
VARIANCES = 40.0, 5.0
PAIRS = 10.0  # of the products
LEADING = 4  # components of the first tower whose products are a tower of their own
DOUBT = 4.0  # nats that products must save to be the whole logit: by chance they would have a share where they tell nothing
SHARES = 11  # of what came before a tower in the logit, from 0 to 1
LEARNED = 256  # traces that channels' scales are read from: more tell no more
MOST = 10**9  # of a parameter that is a whole number
MANY = 3200  # traces, for which a second core is worth taking
PIECE = 512  # of them at once
CHUNK = 32  # traces embedded at a time: what they need stays in the cache, and is not asked of the kernel anew
SECOND_AXIS = 0.04  # range of the second coordinate: seen in a picture, small against a radius of 0.05
WHOLE = 2.0  # weight of the mean over the whole trace beside that over a region: where it does not matter when
PLACES = 600, 100  # of each tower at most: on traces that oscillate fewer say less
RIVALS = 8  # kernels of a group
NEARLY = 1.0  # deviation of the answers: who answers so far below the most of its group counts no more, in between in part


class RocketEncoder(nn.Module):
    """(B, C, T) raw traces -> (B, P) features of both towers.

    channels, samples : C and T.  average : samples of one mean, `averaging`.  kernels, dilations, regions : F, D and R,
    fewer dilations on short traces.  groups : G; 0: no second tower.
    """

    shift: Tensor
    scale: Tensor
    offset: Tensor
    gain: Tensor
    taps: Tensor
    even: Tensor
    mix: Tensor
    kernel: Tensor
    threshold: Tensor
    rival: Tensor
    nothing: Tensor
    share: Tensor

    def __init__(
        self, channels: int, samples: int, average: int, kernels: int, dilations: int, regions: int, groups: int
    ) -> None:
        super().__init__()
        if samples < 2:
            raise SettingError(f"Expected at least 2 samples, got {samples} (n_features = {channels * samples}).")
        frames = samples // average
        places = max(1, min(frames, PLACES[0]) // regions) * regions
        few = min(frames, PLACES[1])
        taps = _taps(frames, dilations, places)
        widths = len(taps) * regions * kernels, 4 * len(taps) * groups * RIVALS
        ends = np.cumsum([0, *(widths if groups else widths[:1])]).tolist()
        self.towers = [slice(first, end) for first, end in pairwise(ends)]
        # A channel becomes scale * x + shift, a feature gain * f + offset: one pass each.
        self.register_buffer("shift", torch.zeros(channels, 1))
        self.register_buffer("scale", torch.ones(channels, 1))
        self.register_buffer("offset", torch.zeros(ends[-1]))
        self.register_buffer("gain", torch.ones(ends[-1]))
        self.average = average
        self.head = samples % average  # left out at the start: the end of an insertion tells most
        self.n_dilations = len(taps)
        self.n_regions = regions
        self.n_kernels = kernels
        self.n_places = places
        self.n_groups = groups
        self.n_few = few
        self.n_taps = taps.size  # of the first tower
        if groups:  # the differences stand behind the trace
            sparse = _taps(frames, dilations, few)
            both = np.concatenate([sparse, np.where(sparse < frames - 1, frames + sparse, 2 * frames - 1)])
            taps = np.concatenate([taps.ravel(), both.ravel()])
        self.register_buffer("taps", torch.from_numpy(taps.ravel()))
        self.whole = WHOLE / regions
        self.length = places // regions
        self.register_buffer("even", torch.full((self.length,), 1.0 / self.length), persistent=False)
        self.register_buffer("mix", torch.eye(regions) + self.whole, persistent=False)
        self.register_buffer("kernel", torch.zeros(self.n_dilations, kernels, channels * TAPS))
        self.register_buffer("threshold", torch.zeros(self.n_dilations, kernels, 1))
        self.register_buffer("rival", torch.zeros(2 * self.n_dilations, groups * RIVALS, channels * TAPS))
        self.register_buffer("nothing", torch.zeros(1, channels, 1), persistent=False)
        self.register_buffer("share", torch.full((few,), 1.0 / few), persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, T) -> (B, P)."""
        return self.clipped(self.raw(x))

    def clipped(self, raw: Tensor) -> Tensor:
        """(B, P) -> (B, P)."""
        return torch.addcmul(self.offset, raw, self.gain).clamp_(-4.0, 4.0)  # CLIP: a scripted method reads no global

    def learn(self, X: Tensor, rng: np.random.Generator) -> None:
        """Set channel scales and filters from traces (n, C, T); done once, so that the map stays where it is."""
        if len(X) > LEARNED:
            X = X[torch.from_numpy(rng.permutation(len(X))[:LEARNED])]
        wide = X.double()
        centre = wide.mean((0, 2))
        deviation = wide.std((0, 2), unbiased=False)
        scale = 1.0 / torch.where(deviation > 0, deviation, 1.0)
        self.scale.copy_(scale[:, None])
        self.shift.copy_((-centre * scale)[:, None])
        some = X[torch.from_numpy(rng.permutation(len(X))[:64])]
        self.learn_filters(torch.addcmul(self.shift, some, self.scale), rng)

    def standardise(self, raw: Tensor) -> None:
        """Set mean and deviation of the features from raw ones (n, P)."""
        deviation, mean = torch.std_mean(raw.double(), 0, unbiased=False)
        for tower in self.towers[1:]:  # of shares what moves more tells more
            deviation[tower] = deviation[tower].square().mean().sqrt()
        floor = 1e-3 * deviation.median() + 1e-12  # a feature that never moved must not explode when it does
        self.gain.copy_(1.0 / (deviation + floor))
        self.offset.copy_(-mean / (deviation + floor))

    def raw(self, x: Tensor) -> Tensor:
        """(B, C, T) -> (B, P)."""
        a = self.averaged(x)
        seen = self.seen(a)
        n = self.n_taps
        b = a.size(0)
        ramps = self.ramps(self.windows(seen.narrow(1, 0, n), self.n_dilations), b)
        if self.n_groups == 0:
            return ramps
        rivals = self.windows(seen.narrow(1, n, seen.size(1) - n), 2 * self.n_dilations)
        return torch.cat([ramps, self.counts(rivals, b)], 1)

    def averaged(self, x: Tensor) -> Tensor:
        """(B, C, T) raw -> (B, C, L), one scale a channel."""
        if self.average > 1:
            x = x[..., self.head :] if self.head > 0 else x
            x = nn.functional.avg_pool2d(x, [1, self.average])  # half the time of a mean over an axis
        return torch.addcmul(self.shift, x, self.scale).clamp_(-1e6, 1e6)  # or their products would overflow

    def seen(self, a: Tensor) -> Tensor:
        """(B, C, L) -> (C, taps, B): what each tap reads, traces last: it then moves a row of them at once."""
        rows = torch.cat([a, a[:, :, 1:] - a[:, :, :-1], self.nothing.expand(a.size(0), -1, -1)], 2)
        if rows.size(0) * rows.size(1) == 1:  # one trace at a time, as a cell decides: nothing to put in order
            return rows.view(-1).index_select(0, self.taps).view(1, -1, 1)
        return rows.permute(1, 2, 0).contiguous().index_select(1, self.taps)

    def windows(self, seen: Tensor, n: int) -> Tensor:
        """(C, n*9*P, B) -> (n, C*9, P*B): what each place of each dilation sees, so that a convolution is a product."""
        channels = seen.size(0)
        places = seen.size(1) // (n * 9) * seen.size(2)  # where n = 0, -1 could not be inferred
        if channels == 1:
            return seen.reshape(n, 9, places)
        return seen.reshape(channels, n, 9, places).transpose(0, 1).reshape(n, channels * 9, places)

    def ramps(self, windows: Tensor, b: int) -> Tensor:
        """(D, C*9, P*B) -> (B, D*F*R): how far each kernel is above its threshold, in the mean over each region."""
        h = torch.baddbmm(self.threshold, self.kernel, windows).clamp_(0.0, 1.0)  # (D, F, P*B)
        if b == 1:  # one product whose columns are the regions takes four times as long
            means = torch.mv(h.view(-1, self.length), self.even).view(-1, self.n_regions)
            return torch.mm(means, self.mix).view(1, -1)
        h = h.view(self.n_dilations, self.n_kernels, self.n_regions, self.length, b).sum(3) / self.length  # (D, F, R, B)
        h = h + self.whole * h.sum(2, keepdim=True)  # as `mix` has it
        return h.reshape(self.n_dilations * self.n_kernels * self.n_regions, b).t()

    def counts(self, windows: Tensor, b: int) -> Tensor:
        """(2D, C*9, Q*B) -> (B, 4*D*G*8): roots of how often a kernel answers most of its group, or least, by place."""
        # The 8 is RIVALS, the kernels of a group; the 1.0 is NEARLY, by which `learn_filters` has divided the kernels.
        h = torch.bmm(self.rival, windows).view(2 * self.n_dilations * self.n_groups, 8, self.n_few * b)
        won = torch.empty(2, h.size(0), 8, h.size(2))
        torch.sub(h, h.amax(1, keepdim=True) - 1.0, out=won[0])
        torch.sub(h.amin(1, keepdim=True) + 1.0, h, out=won[1])
        won.clamp_(min=0.0)
        if b == 1:
            return torch.mv(won.view(-1, self.n_few), self.share).sqrt_().view(1, -1)
        return won.view(2 * h.size(0) * 8, self.n_few, b).sum(1).mul_(1.0 / self.n_few).sqrt_().t()

    def learn_filters(self, x: Tensor, rng: np.random.Generator) -> None:
        """Draw kernels, thresholds and widths from what they give on traces (n, C, T), their channels scaled."""
        # `x` is scaled already; averaging is linear, so the scale is taken out again.
        seen = self.seen(self.averaged((x - self.shift) / self.scale))  # (C, taps, n)
        kernels = _kernels(x.size(1), self.n_kernels, rocket_kernels(), rng)
        # Low-discrepancy quantiles, as in MiniRocket; none at the very ends.
        n = self.n_dilations * self.n_kernels
        quantiles = 0.05 + 0.9 * (np.arange(1, n + 1) * (np.sqrt(5.0) + 1.0) / 2.0 % 1.0)
        for d, rows in enumerate(self.windows(seen[:, : self.n_taps], self.n_dilations)):  # (C*9, P*n)
            given = (kernels @ rows).numpy()
            of_dilation = quantiles[d * self.n_kernels : (d + 1) * self.n_kernels]
            places = (of_dilation * (given.shape[1] - 1)).astype(np.int64)
            chosen = [np.partition(row, place)[place] for row, place in zip(given, places, strict=True)]
            slope = 1.0 / (2.0 * torch.from_numpy(given.std(1)) + 1e-6)  # a ramp two deviations wide
            self.kernel[d] = kernels * slope[:, None]
            self.threshold[d, :, 0] = 0.5 - torch.tensor(chosen) * slope
        if self.n_groups:
            for d, rows in enumerate(self.windows(seen[:, self.n_taps :], 2 * self.n_dilations)):  # (C*9, Q*n)
                drawn = rng.standard_normal((self.rival.size(1), TAPS))
                drawn -= drawn.mean(1, keepdims=True)  # as all kernels: offsets do not matter
                rivals = _kernels(x.size(1), len(drawn), torch.from_numpy(drawn).float(), rng)
                self.rival[d] = rivals / (NEARLY * (rivals @ rows).std() + 1e-6)


class InChunks(nn.Module):
    """The raw features of many traces: compiled it holds up no Python, while an engine opens or compiles beside it."""

    def __init__(self, features: RocketEncoder) -> None:
        super().__init__()
        self.features = features
        self.chunk = CHUNK  # a scripted method reads no global

    def forward(self, x: Tensor, out: Tensor) -> None:
        """(n, C, T) -> out (n, P), n whole chunks."""
        for i in range(0, x.size(0), self.chunk):
            out[i : i + self.chunk] = self.features.raw(x[i : i + self.chunk])


def rocket_kernels() -> Tensor:
    """(84, 9): every way to place three 2s among -1s; each kernel sums to zero, so offsets do not matter."""
    places = torch.tensor(list(combinations(range(TAPS), 3)))
    return torch.full((84, TAPS), -1.0).scatter_(1, places, 2.0)


def dilations_of(samples: int, n: int) -> list[int]:
    """At most n spreads of a kernel, from 1 to the length of a trace."""
    widest = np.log2((samples - 1) / (TAPS - 1)) if samples > TAPS else 0.0
    return [int(d) for d in np.unique(np.floor(2.0 ** np.linspace(0.0, widest, n)))]


class FeatureEmbedding(nn.Module):
    """(B, C, T) raw traces -> (B, K, d): axis 1 the success probability of head k, axis 2 a principal direction.

    A probability is the natural axis for counting: what is sure lies close together, and a radius of 0.05 means "parts as
    promising as this one, give or take five in a hundred".
    """

    weight: Tensor
    bias: Tensor
    of_pairs: Tensor
    unit: Tensor

    def __init__(self, features: RocketEncoder, folds: int, dim: int, leading: int) -> None:
        super().__init__()
        self.features = features
        self.folds = folds
        self.dim = dim
        self.leading = leading
        self.n_scores = folds * dim
        # Axis 2 is the same in every space; its copies cost less than an op to spread it. Leading components come last.
        self.register_buffer("weight", torch.zeros(len(features.gain), folds * dim + leading))
        self.register_buffer("bias", torch.zeros(folds * dim + leading))
        self.register_buffer("of_pairs", torch.zeros(leading * leading, folds * dim))
        self.register_buffer("unit", torch.tensor([1.0, SECOND_AXIS][:dim]).repeat(folds))

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, T) float32 -> (B, K, d) float32."""
        return self.places(self.features(x))

    def places(self, f: Tensor) -> Tensor:
        """(B, P) clipped features -> (B, K, d)."""
        scores = torch.addmm(self.bias, f, self.weight)
        pairs = products(scores.narrow(1, self.n_scores, self.leading))
        scores = torch.addmm(scores.narrow(1, 0, self.n_scores), pairs, self.of_pairs)
        return scores.sigmoid_().mul_(self.unit).view(-1, self.folds, self.dim)


def products(g: Tensor) -> Tensor:
    """(n, m) -> (n, m * m): of every two."""
    return (g.unsqueeze(2) * g.unsqueeze(1)).flatten(1)


def fit_heads(
    g: Tensor,
    y: Tensor,
    outside: Tensor,
    w: Tensor,
    l2: float,
    max_iter: int,
    stop: StopRule | None,
    least: int = 0,
) -> tuple[Tensor, Tensor, list[int], int]:
    """Fit K ridge logistic regressions by Newton's method with a line search.

    Each minimises its log loss plus ``l2 / 2 * |w| ** 2``. That is convex, so it ends at the same
    weights wherever it starts. A head whose leave-one-out loss is above that of its base rate
    predicts the base rate. Each head decides this alone: a common decision would let the labels
    of fold k choose head k.

    Parameters
    ----------
    g : Tensor of float32, shape (n, W)
        Features.
    y : Tensor of int64, shape (n,)
        Labels, 1 or 0.
    outside : Tensor of bool, shape (K, n)
        Which rows train head k.
    w : Tensor of float64, shape (K, W + 1)
        Where the heads start, the bias last.
    l2 : float
        Ridge.
    max_iter : int
        Steps at most.
    stop : StopRule, optional
        Asked before each step after the first `least`.
    least : int, default 0
        Steps that are taken however late it is.

    Returns
    -------
    w : Tensor of float64, shape (K, W + 1)
    left_out : Tensor of float64, shape (K, n)
        Leave-one-out logits of each row by each head.
    at_base_rate : list of int
        Heads that predict their base rate.
    n_steps : int
        Steps that were taken.
    """
    small = torch.cat([g, torch.ones(len(g), 1)], 1)
    g = small.double()
    y = y.double()
    mask = outside.double()
    ridge = torch.full_like(w, l2)
    ridge[:, -1] = 1e-3  # the base rate is not shrunk

    def objective(w: Tensor) -> Tensor:
        s = w @ g.T
        return (mask * (F.softplus(s) - y * s)).sum(1) + 0.5 * (ridge * w * w).sum(1)

    def cholesky_of_hessian(k: int, p: Tensor) -> Tensor:
        """Factor the Hessian of head k, (W+1, W+1); p (n,) are its predicted probabilities."""
        curvature = (mask[k] * p * (1.0 - p)).float()
        product = (small * curvature[:, None]).T @ small  # a step need not be exact
        factor: Tensor = torch.linalg.cholesky(product.double() + torch.diag(ridge[k]))
        return factor

    # Every head takes part in every product, whether it has converged or not: a product of another
    # shape rounds differently, and would so let the labels of fold k reach head k. For the same
    # reason each head decides alone when its factor is computed anew.
    done = torch.zeros(len(w), dtype=torch.bool)
    before = objective(w)
    step = 0
    factors = [cholesky_of_hessian(k, torch.sigmoid(w[k] @ g.T)) for k in range(len(w))]
    stale = done
    last = torch.ones(len(w), dtype=torch.float64)
    while step < max_iter and not done.all() and not (stop is not None and stop.exhausted(step, least)):
        p = torch.sigmoid(w @ g.T)
        for k in stale.nonzero().flatten().tolist():
            factors[k] = cholesky_of_hessian(k, p[k])
        slope = (mask * (p - y)) @ g + ridge * w
        d = torch.cholesky_solve(slope[..., None], torch.stack(factors))[..., 0]
        d[done] = 0.0
        for _ in range(6):
            after = objective(w - d)
            rises = after > before + 1e-9 * before.abs()
            if not rises.any():
                break
            d[rises] /= 2.0
        d[rises] = 0.0
        w = w - d
        before = torch.where(rises, before, after)
        step += 1
        size = d.abs().amax(1)
        done |= (size * (size / last).clamp(max=1.0) < 2e-4) & (
            stale | (step == 1) | ~rises
        )  # about what the next step would be
        # A step with a former factor costs a tenth: a new one where that serves no more.
        stale = ~done & (rises | (size > (last / 4.0).clamp(max=0.3)))
        last = size
    left_out = leave_one_out(small, y, w @ g.T, torch.stack(factors))
    return *base_rate_if_better(w, left_out, y, mask), step


def base_rate_if_better(w: Tensor, left_out: Tensor, y: Tensor, mask: Tensor) -> tuple[Tensor, Tensor, list[int]]:
    """Set heads to their base rate where that has the smaller log loss on held-out labels.

    Parameters
    ----------
    w : Tensor of float64, shape (K, W + 1)
        Heads, the bias last; they stay as they are.
    left_out : Tensor of float64, shape (K, n)
        Their leave-one-out logits.
    y : Tensor of float64, shape (n,)
        Labels, 1 or 0.
    mask : Tensor of float64, shape (K, n)
        1 for the rows that train head k, else 0.

    Returns
    -------
    w, left_out : Tensor
        As the arguments, with the base rate where it is better.
    at_base_rate : list of int
        The heads that were set to it.
    """
    rate = torch.logit((mask @ y) / mask.sum(1))[:, None].expand_as(left_out)
    worse = masked_loss(left_out, y, mask) > masked_loss(rate, y, mask)
    w = torch.where(worse[:, None], 0.0, w)
    w[worse, -1] = rate[worse, 0]
    left_out = torch.where(worse[:, None], rate, left_out)
    return w, left_out, worse.nonzero().flatten().tolist()


def leave_one_out(x: Tensor, y: Tensor, s: Tensor, factors: Tensor) -> Tensor:
    """(K, n) logits of every row by the head without it, to first order: Rad and Maleki (2020), JRSS B 82(4).

    x (n, W+1), y (n,).  s (K, n) logits by the heads.  factors (K, W+1, W+1) of the Hessians.
    """
    p = torch.sigmoid(s)
    lever = torch.stack([((x @ inverse) * x).sum(1) for inverse in torch.cholesky_inverse(factors).float()])
    return s + lever * (p - y) / (1.0 - lever * p * (1.0 - p)).clamp(min=0.05)


def masked_loss(s: Tensor, y: Tensor, mask: Tensor) -> Tensor:
    """(..., K, n) logits -> (..., K) mean log losses of labels (n,) on the rows that count, mask (K, n)."""
    return (mask * (F.softplus(s) - y * s)).sum(-1) / mask.sum(1)


class Tower(NamedTuple):
    """Principal components of some of the features, and the heads on them."""

    axes: Tensor  # (P of the tower, W), scaled so that all traces together have the tower's variance
    centre: Tensor  # (W,) what is added
    w: Tensor  # (K, W+1) float64, each head's bias last

    @classmethod
    def over(cls, f: Tensor, width: int, variance: float, weights: Tensor, scores: Tensor) -> Self:
        """Of standardised features (n, P), with heads near `weights` (P, K) on them, whose mean is `scores` (K,)."""
        centred = f - f.mean(0)
        # In float32, in half the time: components are told from noise to 1e-6.
        sizes, axes = torch.linalg.eigh(centred.T @ centred / len(f))
        sizes = sizes.clamp(min=0.0)[-width:].flip(-1)
        axes = axes[:, -width:].flip(-1)
        axes = axes * (sizes > 1e-6 * sizes[0])
        size = (variance / sizes.sum().clamp(min=1e-9)).sqrt()
        w = torch.cat([(axes.T @ weights / size).T, scores[:, None]], 1).double()
        scaled = axes * size
        return cls(scaled, -(f.mean(0) @ scaled), w)

    def components(self, f: Tensor) -> Tensor:
        """(n, P) -> (n, W)."""
        return torch.addmm(self.centre, f, self.axes)

    def heads(self) -> tuple[Tensor, Tensor]:
        """Weights (P, K) and biases (K,) on the features."""
        w = self.w[:, :-1]
        bias = self.w[:, -1]
        return (self.axes.double() @ w.T).float(), (bias + w @ self.centre.double()).float()


@dataclass(eq=False, repr=False, kw_only=True)
class RocketReducer(Reducer):
    """Embed traces by drawn kernels and cross-fitted logistic heads.

    The first axis of the embedding is the predicted probability of success; the second is there to be seen.

    Parameters
    ----------
    n_components : {1, 2}, default 2
    folds : int, default 5
        K, heads and spaces.
    kernels, dilations, regions : int, default 28, 5, 3
        Sizes of the first tower, F, D and R.
    groups : int, default 2
        G, groups of competing kernels of the second tower; 0 leaves it out.
    width : int, default 128
        Principal components that are kept of each tower.
    l2 : float, default 0.5
        Ridge of the heads, in units of one label each.
    max_iter : int, default 20
        Newton steps of the heads in one fit, at most.
    random_state : int, RandomState or None, default 0
        Of all that is drawn.

    Attributes
    ----------
    n_iter_ : int
        Steps of the last fit.
    holdout_losses_ : array of float64, shape (K,)
        Leave-one-out log losses of the heads, each on rows outside its fold.
    note_ : str
        One line for the operator.
    """

    uses_labels = True
    scores = True
    min_traces = MIN_TRACES
    own_unit = True
    default_radius = 0.07  # of a probability: seven in a hundred, never rescaled

    n_components: int = 2
    folds: int = 5
    kernels: int = 28
    dilations: int = 5
    regions: int = 3
    groups: int = 2
    width: int = 128
    l2: float = 0.5
    max_iter: int = 20
    random_state: Any = 0

    @property
    def n_spaces(self) -> int:
        return int(self.folds)

    def fit(self, X: ArrayLike, y: ArrayLike | None = None, *, folds: Ints | None = None) -> Self:
        """Fit afresh.

        folds : (n,) permanent folds; None: by content.
        Raises SettingError where a setting is out of range, or a head would see one class alone.
        """
        traces = self.check_traces(X, reset=True)
        labels = binary_labels(y, len(traces), type(self).__name__)
        folds = folds_of(traces, self.folds, folds)
        self._start(traces)
        self._fit_heads(self.raw_features(traces), labels, folds)
        return self

    def train(self, X: Floats, y: Ints, folds: Ints, stop: StopRule | None = None, numbers: Ints | None = None) -> Floats:
        """Fit the heads from their present weights, on features that the first training set; see `Reducer.train`."""
        expect(len(X) >= MIN_TRACES, f"at least {MIN_TRACES} traces", len(X), "verify more parts first")
        raw = self.raw_features(self._checked(X), numbers)
        self._fit_heads(raw, binary_labels(y, len(X), type(self).__name__), folds, stop, numbers)
        with torch.inference_mode():
            places = in_chunks(lambda some: self.net_.places(self.net_.features.clipped(some)), raw, 16 * CHUNK)
            return points_in_own_space(places.numpy(), folds)

    def untrained_module(self, X: Floats) -> FeatureEmbedding:
        new: Self = self if len(X) >= MIN_TRACES or "net_" in vars(self) else clone(self)
        new._checked(X)
        return new.net_

    def precompute(self, X: Floats, numbers: Ints | None = None) -> None:
        """Compute the features of traces that a store brings: in the first retrain it would take too long."""
        if len(X) >= MIN_TRACES:
            self.raw_features(self._checked(X), numbers)

    def _checked(self, X: Floats) -> Floats:
        """Return the traces (n, C, T), checked; the first ones set the scales and the filters."""
        if "net_" not in vars(self):
            self._start(self.check_traces(X, reset=True))
        return self.check_traces(X)

    def _start(self, traces: Floats) -> None:
        """Learn what stays where it is from now on: the scales of the channels and the filters. No label is read."""
        self.average_ = averaging(torch.from_numpy(traces))
        self._build(*self.trace_shape_)
        self.net_.features.learn(torch.from_numpy(traces), np.random.default_rng(seed_of(self.random_state)))

    def _build(self, channels: int, samples: int) -> None:
        self.check()
        sizes = self.kernels, self.dilations, self.regions, self.groups
        features = RocketEncoder(channels, samples, self.average_, *sizes)
        leading = min(LEADING, self.width, features.towers[0].stop)
        self.net_ = FeatureEmbedding(features, self.folds, self.n_components, leading).eval()
        self.n_fits_ = self.n_seen_ = 0
        self.towers_: list[Tower] = []
        self._numbers = np.zeros(0, dtype=np.int64)  # of the labels that were seen last
        self._raw = torch.empty(0, len(features.gain))

    def _fit_heads(
        self, raw: Tensor, labels: Ints, folds: Ints, stop: StopRule | None = None, numbers: Ints | None = None
    ) -> None:
        """Train head k on rows outside fold k of the features (n, P), from the present weights."""
        with torch.no_grad():
            if len(raw) >= GROWN * self.n_seen_ or self.n_fits_ % FITS == 0:
                self._compress(raw)
            least = 0 if self.n_fits_ else FIRST_STEPS
            rows = np.arange(len(raw))
            if len(rows) > TRAIN_TRACES:
                # A draw that is blind to labels, even in time, and mostly the last fit's: the heads are near their places.
                draw = (rows if numbers is None else numbers).astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
                rows = np.sort(np.argpartition(draw, TRAIN_TRACES)[:TRAIN_TRACES])
                raw = raw[rows]
            outside = self.trained_on(folds[rows])
            for k, training in enumerate(outside):
                classes = len(np.unique(labels[rows][training]))
                if classes < 2:
                    raise single_class_error(k, int(training.sum()), classes)
            f = self.net_.features.clipped(raw)
            y = torch.from_numpy(labels[rows])
            rows_of = torch.from_numpy(outside)
            towers = []
            fits = []  # of each tower: leave-one-out logits, heads that say the base rate, steps
            for tower, columns in zip(self.towers_, self._tower_features(f), strict=True):
                w, *rest = fit_heads(tower.components(columns), y, rows_of, tower.w, self.l2, self.max_iter, stop, least)
                towers.append(tower._replace(w=w))
                fits.append(rest)
            left_out, unsure, steps = zip(*fits, strict=True)
            # Leave-one-out logits of rows outside fold k alone weigh the towers of head k, one after the other.
            mixed = left_out[0]
            shares = [torch.ones(self.folds)]
            tried = torch.linspace(0.0, 1.0, SHARES).double()
            for i, logits in enumerate(left_out[1:], 1):
                losses = masked_loss(logits + tried[:, None, None] * (mixed - logits), y, rows_of.double())
                doubt = DOUBT if i == len(self.net_.features.towers) else 0.0  # of products
                share = tried[(losses + doubt * (1.0 - tried)[:, None] / rows_of.sum(1)).argmin(0)]
                mixed = logits + share[:, None] * (mixed - logits)
                shares = [*(share.float() * former for former in shares), 1.0 - share.float()]
            self._answer_by(towers, shares)
            losses = masked_loss(mixed, y, rows_of.double())
        self.towers_ = towers
        self.n_iter_ = max(steps)
        self.holdout_losses_ = losses.numpy()
        self.n_fits_ = self.n_fits_ + 1
        heads = ", ".join(map(str, sorted(set.intersection(*map(set, unsure)))))
        self.note_ = f"head {heads} says the base rate: it would have done worse" if heads else ""

    def _answer_by(self, towers: list[Tower], shares: list[Tensor]) -> None:
        """Put the towers' heads into what answers, each head in its share (K,) of the logit."""
        net = self.net_
        first = slice(0, self.net_.n_scores, self.n_components)
        net.bias[first] = 0.0
        weights = [*(net.weight[columns] for columns in net.features.towers), net.of_pairs]
        for tower, share, columns in zip(towers, shares, weights, strict=False):
            weight, bias = tower.heads()
            columns[:, first] = share * weight
            net.bias[first] += share * bias

    def _tower_features(self, f: Tensor) -> list[Tensor]:
        """Return what each tower reads of features (n, P): its own ones; the last, products of leading components."""
        features = [f[:, columns] for columns in self.net_.features.towers]
        leading = self.towers_[0].components(features[0])[:, : self.net_.leading]
        return [*features, products(leading)]

    def trained_on(self, folds: Ints) -> NDArray[np.bool_]:
        """(n,) -> (K, n): fold k never trains head k, or its labels would count themselves."""
        return np.asarray(folds != np.arange(self.folds)[:, None])

    def _compress(self, raw: Tensor) -> None:
        """Find the principal components of raw features (n, P), and what the heads, if any, come to on these."""
        net = self.net_
        self.n_seen_ = len(raw)
        some = raw[:: 1 + (len(raw) - 1) // 1000]
        f = net.features.clipped(some)
        gain = net.features.gain.clone()
        former = self.towers_
        net.features.standardise(some)
        now = net.features.clipped(some)
        self.towers_ = []
        for i, (columns, variance) in enumerate(zip(net.features.towers, VARIANCES, strict=False)):
            weights = torch.zeros(len(gain[columns]), self.folds)
            scores = torch.zeros(self.folds)
            if former:
                weights, biases = former[i].heads()
                scores = torch.addmm(biases, f[:, columns], weights).mean(0)
                weights = weights * (gain / net.features.gain)[columns, None]
            self.towers_.append(Tower.over(now[:, columns], self.width, variance, weights, scores))
        columns = net.features.towers[0]
        n = net.n_scores
        first = self.towers_[0]
        # The heads of the products begin anew: they are products of other components now.
        blank = torch.zeros(net.leading**2, self.folds), torch.zeros(self.folds)
        self.towers_.append(Tower.over(self._tower_features(now)[-1], self.width, PAIRS, *blank))
        net.weight[columns, n:] = first.axes[:, : net.leading]
        net.bias[n:] = first.centre[: net.leading]
        if self.n_components == 2:  # the second axis is the first component, of one deviation at both sides in the sigmoid
            axis = first.axes[:, 0]
            second = 2.0 * axis / (now[:, columns] @ axis).std().clamp(min=1e-12)
            second = second if second @ net.weight[columns, 1] >= 0 else -second  # its sign as it was
            net.weight[columns, 1:n:2] = second[:, None]
            net.bias[1:n:2] = -(now[:, columns].mean(0) @ second)

    def raw_features(self, traces: Floats, numbers: Ints | None = None) -> Tensor:
        """(n, C, T) -> (n, P), not standardised: computed once a label's number, and forgotten once that is not given."""
        with torch.no_grad():
            if numbers is None:
                return self._computed(traces)
            at = np.searchsorted(self._numbers, numbers)
            new = np.append(self._numbers, -1)[at] != numbers
            if new.all():
                at = np.arange(len(at))
                self._raw = self._computed(traces)
            elif new.any():
                at[new] = len(self._raw) + np.arange(new.sum())
                self._raw = torch.cat([self._raw, self._computed(traces[new])])
            joined = len(at) > 0 and (np.diff(at) == 1).all()  # as long as nothing is forgotten: then none is moved
            self._numbers = numbers
            self._raw = self._raw[at[0] : at[-1] + 1] if joined else self._raw[torch.from_numpy(at)]
        return self._raw

    def _computed(self, traces: Floats) -> Tensor:
        """(n, C, T) -> (n, P), the same to the bit whatever is beside a trace: each chunk is full, or filled up."""
        features = self.net_.features
        x = torch.from_numpy(traces)
        n = len(traces)
        whole = n // CHUNK * CHUNK
        out = torch.empty(n, len(features.gain))
        rest = torch.zeros(CHUNK, *x.shape[1:])
        rest[: n - whole] = x[whole:]
        out[whole:] = features.raw(rest)[: n - whole]
        if n < MANY:
            InChunks(features)(x[:whole], out[:whole])
            return out
        many = script(InChunks(features))  # of a store that is opened
        for _ in range(2):  # TorchScript's first calls compile
            many(x[:CHUNK], out[:CHUNK])
        with ThreadPoolExecutor(2, "dengine-features", torch.set_num_threads, (1,)) as pool:
            pieces = [slice(i, min(i + PIECE, whole)) for i in range(0, whole, PIECE)]
            list(pool.map(lambda piece: many(x[piece], out[piece]), pieces))
        return out

    def __getstate__(self) -> dict[str, Any]:
        state: dict[str, Any] = super().__getstate__()
        return state | {"_raw": self._raw.numpy()} if "net_" in vars(self) else state  # an array travels at less cost

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state | {"_raw": torch.from_numpy(state["_raw"])} if "net_" in state else state)

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        """A training changes the module in place; all else it binds anew, so that may be shared."""
        new = copy.copy(self)
        if "net_" in vars(self):
            new.net_ = copy.deepcopy(self.net_, memo)
        return new

    @property
    def report(self) -> FitReport:
        check_is_fitted(self, "net_")
        return FitReport(self.n_iter_, self.note_)

    def embed(self, X: ArrayLike) -> Floats:
        traces = self.check_traces(X)
        with torch.inference_mode():
            out: Floats = in_chunks(self.net_, torch.from_numpy(traces)).numpy()
        return out

    def module(self) -> nn.Module:
        check_is_fitted(self, "net_")
        return self.net_

    def get_state(self) -> dict[str, NDArray[Any]]:
        check_is_fitted(self, "net_")
        counts = np.array([*self.trace_shape_, self.average_, self.n_fits_, self.n_seen_, self.n_iter_])
        state = {"counts": counts, "losses": self.holdout_losses_}
        for i, tower in enumerate(self.towers_):
            state |= {f"{name}.{i}": value.numpy() for name, value in tower._asdict().items()}
        return state | {f"net.{name}": value.numpy().copy() for name, value in self.net_.state_dict().items()}

    def set_state(self, state: Mapping[str, NDArray[Any]]) -> Self:
        channels, samples, self.average_, n_fits, n_seen, self.n_iter_ = (int(v) for v in state["counts"])
        self.trace_shape_ = (channels, samples)
        self.n_features_in_ = channels * samples
        self._build(channels, samples)
        restore(self.net_, arrays_with_prefix(state, "net."))
        by_field = [arrays_with_prefix(state, f"{name}.").values() for name in Tower._fields]
        self.towers_ = [
            Tower(*(torch.from_numpy(np.array(value)) for value in values)) for values in zip(*by_field, strict=True)
        ]
        self.n_fits_ = n_fits
        self.n_seen_ = n_seen
        self.holdout_losses_ = np.array(state["losses"])
        self.note_ = ""
        return self

    def check(self) -> None:
        """Raise SettingError for a parameter out of its range."""
        for name in ("n_components", "folds", "max_iter", "kernels", "dilations", "regions", "width"):
            value = getattr(self, name)
            expect(is_whole(value, 1, MOST), f"{name} >= 1, an integer", value)
        expect(self.regions <= 16, "regions <= 16", self.regions)
        expect(is_whole(self.groups, 0, 64), "groups from 0 to 64, an integer", self.groups)
        expect(self.n_components <= 2, "n_components 1 or 2", self.n_components)
        expect(self.l2 > 0, "l2 > 0, or separable labels have no solution", self.l2)
        expect(self.folds >= 2, "folds >= 2 where labels are used", self.folds)


def in_chunks(f: Any, x: Tensor, size: int = CHUNK) -> Tensor:
    """The function over x, so many rows at a time."""
    return torch.cat([f(x[i : i + size]) for i in range(0, max(1, len(x)), size)])


def _taps(frames: int, dilations: int, places: int) -> NDArray[np.int64]:
    """(D, 9, P) positions in the averaged trace of so many frames; 2 * frames - 1, where a zero stands, beyond its ends."""
    spread = np.array(dilations_of(frames, dilations), dtype=np.int64)
    middle = ((np.arange(places) + 0.5) / places * frames).astype(np.int64)
    taps = middle + spread[:, None, None] * (np.arange(TAPS) - TAPS // 2)[:, None]
    return np.where((taps < 0) | (taps >= frames), 2 * frames - 1, taps)


def _kernels(channels: int, n: int, every: Tensor, rng: np.random.Generator) -> Tensor:
    """(n, C*9): kernels (N, 9), drawn at random and of unit size; each reads a few of the channels."""
    kernels = every[torch.from_numpy(rng.permutation(max(n, len(every)))[:n] % len(every))]
    read = torch.zeros(n, channels)
    for row in range(n):
        some = rng.permutation(channels)[: int(2.0 ** rng.uniform(0.0, np.log2(channels + 1)))]
        read[row, torch.from_numpy(some)] = len(some) ** -0.5
    return torch.flatten(read[:, :, None] * (kernels / kernels.square().sum(1, keepdim=True).sqrt())[:, None], 1)
