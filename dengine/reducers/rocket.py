"""Convolution kernels that are drawn, under cross-fitted logistic heads: no kernel is trained. The
file holds `RocketReducer`, the reducer "rocket"; `FeatureEmbedding`, the module that it exports;
and `Tower` and `weigh_towers`, by which it joins two kinds of features. The kernels are in
`rocket_features`, the heads in `logistic_heads`.

    >>> reducer = RocketReducer(folds=5).fit(X, y)  # X (n, T) or (n, C, T), y (n,), 1 = success
    >>> reducer.embed(X).shape                      # (n, K, d): every trace in each of K spaces

    x (B, C, T) -> two towers of features, `rocket_features.RocketEncoder`       (B, P)
                -> principal components of each tower                            (B, W) each
                -> products of every two of tower 1's leading four components    (B, 16)
                -> logistic heads on the components of each tower and on those
                   of the products, `logistic_heads`, weighed to one logit       (B, K)
                -> its probability, and a second axis: `FeatureEmbedding`        (B, K, d)

A network that is trained on labels would exist K times, each on few labels. Here the encoder is
drawn and shared by all K spaces; only the heads read labels, head k those outside fold k. A
training starts from the last heads and takes milliseconds.

References
----------
Dempster, Schmidt and Webb (2021), MiniRocket, KDD, arXiv:2012.08791; (2023), Hydra, Data Min.
Knowl. Disc. 37. Wolpert (1992), Stacked generalization, Neural Networks 5: towers are weighed by
predictions on held-out rows. Chernozhukov et al. (2018), Double/debiased machine learning,
Econometrics Journal 21: cross-fitting.
"""

from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from sklearn.utils.validation import check_is_fitted
from torch import Tensor, nn

from ..decision.scripting import arrays_with_prefix, module_state, restore
from ..errors import expect
from ..records import Arrays, State
from .base import (
    FitReport,
    Floats,
    Ints,
    RowCache,
    StopRule,
    check_classes,
    check_integers,
    draw_seed,
    embed_in_chunks,
    points_in_fold_space,
)
from .logistic_heads import fit_heads, masked_loss
from .preprocessing import averaging
from .probability import MIN_TRACES, ProbabilityReducer
from .rocket_features import CHUNK, RocketEncoder, compute_raw_features

MIN_FIRST_STEPS = 3  # of the first heads, even after the deadline; without any they tell nothing
MAX_TRAINING_TRACES = 4000  # to which heads are fitted, which bounds the time of a training
GROWTH = 1.5  # times as many traces, after which components are computed anew,
REFRESH_EVERY = 20  # and fits after which they are, too
COMPONENT_TRACES = 1000  # from which components are computed
TOWER_VARIANCES = 40.0, 5.0  # of all components of a tower together: a ridge is relative to it
PRODUCT_VARIANCE = 10.0  # of all components of the products together
N_LEADING = 4  # components of the first tower whose products are features of their own
PRODUCT_PENALTY = 4.0  # nats that products must save: by chance they would get a share of the logit
N_SHARES = 11  # shares that are tried, from 0 to 1
SECOND_AXIS_RANGE = 0.04  # seen in a picture, and small against a radius of 0.07
MAX_INTEGER = 10**9  # of a parameter


class FeatureEmbedding(nn.Module):
    """Embed raw traces in each of K spaces: (B, C, T) -> (B, K, d).

    The first coordinate in space k is the success probability by head k, a classifier head that is
    trained without the labels of fold k. The second is a sigmoid of the first principal component
    of the first `Tower`. A probability is the natural axis for counting: parts that are certain lie
    close together, and a radius of 0.05 means "parts as promising as this one, give or take five in
    a hundred".

    Parameters
    ----------
    encoder : RocketEncoder
    folds : int
        K.
    dim : int
        d, 1 or 2.
    n_leading : int
        Number of components of the first `Tower` whose products are features.
    """

    weight: Tensor
    bias: Tensor
    product_weight: Tensor
    axis_range: Tensor

    def __init__(self, encoder: RocketEncoder, folds: int, dim: int, n_leading: int) -> None:
        super().__init__()
        self.encoder = encoder
        self.folds = folds
        self.dim = dim
        self.n_leading = n_leading
        self.n_scores = folds * dim
        # Columns: K times (logit, second axis), then the leading components. The second axis is the
        # same in every space; its copies cost less than an operation that repeats it.
        n_columns = self.n_scores + n_leading
        axis_range = torch.tensor([1.0, SECOND_AXIS_RANGE][:dim]).repeat(folds)
        self.register_buffer("weight", torch.zeros(len(encoder.gain), n_columns))
        self.register_buffer("bias", torch.zeros(n_columns))
        self.register_buffer("product_weight", torch.zeros(n_leading * n_leading, self.n_scores))
        self.register_buffer("axis_range", axis_range)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, T) raw traces -> (B, K, d)."""
        return self.embed_features(self.encoder(x))

    def embed_features(self, f: Tensor) -> Tensor:
        """Embed traces, given by their scaled features f (B, P), in each of K spaces: (B, K, d).

        There is an embedding space for each of K folds (fixed groups of traces). The first
        coordinate in space k is the probability of success, from 0 to 1, by classifier head k: the
        sigmoid of a weighted mean of the logits of logistic regressions, trained without the labels
        of fold k, on the features and on the products of every two leading principal components of
        the first `Tower` (group of features). If d is 2, the second coordinate is the sigmoid of
        the first of these components, scaled to 0 to 0.04; it is the same in all spaces.
        """
        columns = torch.addmm(self.bias, f, self.weight)
        products = pairwise_products(columns.narrow(1, self.n_scores, self.n_leading))
        scores = torch.addmm(columns.narrow(1, 0, self.n_scores), products, self.product_weight)
        return scores.sigmoid_().mul_(self.axis_range).view(-1, self.folds, self.dim)


def pairwise_products(g: Tensor) -> Tensor:
    """Multiply every column with every column: (n, m) -> (n, m * m).

    Column ``i * m + j`` of the result is column i times column j, so i = j gives squares, and each
    other product comes twice.
    """
    return (g.unsqueeze(2) * g.unsqueeze(1)).flatten(1)


class Tower(NamedTuple):
    """A group of features with its principal components, and K classifier heads on these.

    Head k is a logistic regression that is trained without the labels of fold k.

    Attributes
    ----------
    axes : Tensor of float32, shape (p, W)
        Principal axes of the tower's p features, scaled so that all components together have a
        fixed variance.
    centre : Tensor of float32, shape (W,)
        Added to the components, so that their mean is 0.
    w : Tensor of float64, shape (K, W + 1)
        Weights of the heads on the components, the bias last.
    """

    axes: Tensor
    centre: Tensor
    w: Tensor

    @classmethod
    def from_features(
        cls, f: Tensor, width: int, variance: float, weights: Tensor, mean_logits: Tensor
    ) -> Self:
        """Compute the principal components of features, and classifier heads on the components.

        A tower holds both: the components of a group of features, and K heads, logistic
        regressions. The heads are taken over from given heads on the features themselves: over the
        rows of `f`, the logits of a new head are the least-squares fit to the logits of the given
        head.

        Parameters
        ----------
        f : Tensor of float32, shape (n, p)
            Scaled features.
        width : int
            W, the largest number of components.
        variance : float
            Variance of all components together, to which they are scaled.
        weights : Tensor of float32, shape (p, K)
            Weights of the given heads on the features.
        mean_logits : Tensor of float32, shape (K,)
            Mean logit of each given head over the rows of `f`; it becomes the bias.

        Returns
        -------
        Tower
            Its components are sorted by variance, the largest first. The axes of components that
            are no more than noise, with a millionth of the largest variance or less, are 0.
        """
        centred = f - f.mean(0)
        # In float32, in half the time: components are told from noise to 1e-6.
        sizes, axes = torch.linalg.eigh(centred.T @ centred / len(f))
        sizes = sizes.clamp(min=0.0)[-width:].flip(-1)
        axes = axes[:, -width:].flip(-1)
        axes = axes * (sizes > 1e-6 * sizes[0])
        factor = (variance / sizes.sum().clamp(min=1e-9)).sqrt()
        w = torch.cat([(axes.T @ weights / factor).T, mean_logits[:, None]], 1).double()
        scaled_axes = axes * factor
        return cls(scaled_axes, -(f.mean(0) @ scaled_axes), w)

    def components(self, f: Tensor) -> Tensor:
        """Scaled features (n, p) of this tower -> components (n, W): f @ axes + centre."""
        return torch.addmm(self.centre, f, self.axes)

    def heads(self) -> tuple[Tensor, Tensor]:
        """Return the classifier heads as weights (p, K) and biases (K,) on the features, float32.

        They give the same logits on the tower's features as `w` on its components.
        """
        w = self.w[:, :-1]
        weights = (self.axes.double() @ w.T).float()
        return weights, (self.w[:, -1] + w @ self.centre.double()).float()


def weigh_towers(
    left_out: list[Tensor], penalties: list[float], y: Tensor, outside: Tensor
) -> tuple[list[Tensor], Tensor]:
    """Choose for each fold the shares by which the logits of several towers are mixed to one logit.

    Each `Tower`, a group of features, has a classifier head for each of K folds (groups of rows):
    head k is a logistic regression, trained without the labels of fold k. The first tower starts
    with a share of 1. Then each further tower gets a share s of 0 to 1 in steps of 0.1, and the
    shares of the towers before it are multiplied by 1 - s. That s is chosen for which the log loss
    on the rows outside fold k, plus a penalty, is smallest (of several the largest). So the labels
    of fold k do not influence mixed logit k.

    Parameters
    ----------
    left_out : list of Tensor of float64, shape (K, n)
        Leave-one-out logits of each tower.
    penalties : list of float
        For each tower, the penalty of a share of 1, in nats of the log loss summed over the rows;
        that of a smaller share is in proportion. The first value is not read.
    y : Tensor of int64, shape (n,)
        Labels, 1 or 0.
    outside : Tensor of bool, shape (K, n)
        Which rows are outside fold k.

    Returns
    -------
    shares : list of Tensor of float32, shape (K,)
        The K shares of each tower; for each fold they sum to 1 over all towers.
    losses : Tensor of float64, shape (K,)
        Leave-one-out log loss of the mixed logit k over the rows outside fold k, in nats per row.
    """
    n_rows = outside.sum(1)
    mask = outside.double()
    kept_shares = torch.linspace(0.0, 1.0, N_SHARES).double()
    mixed = left_out[0]
    shares = [torch.ones(len(outside))]
    for logits, penalty in zip(left_out[1:], penalties[1:], strict=True):
        losses = masked_loss(logits + kept_shares[:, None, None] * (mixed - logits), y, mask)
        penalised = losses + penalty * (1.0 - kept_shares)[:, None] / n_rows
        kept = kept_shares[penalised.argmin(0)]
        mixed = logits + kept[:, None] * (mixed - logits)
        shares = [kept.float() * share for share in shares]
        shares.append(1.0 - kept.float())
    return shares, masked_loss(mixed, y, mask)


@dataclass(eq=False, repr=False, kw_only=True)
class RocketReducer(ProbabilityReducer):
    """Embed traces by random convolution kernels and cross-fitted classifier heads.

    The first axis of the embedding is the predicted probability of success. The second spreads the
    points in pictures; it is small against the radius. Of more than 4000 traces, the heads are
    fitted to 4000.

    Parameters
    ----------
    n_components : {1, 2}, default 2
        1 leaves the second axis out.
    folds : int, default 5
        K, the number of folds, and so of classifier heads and of spaces.
    kernels, dilations, regions : int, default 28, 5, 3
        Sizes of the first `Tower`, F, D and R, see `RocketEncoder`.
    groups : int, default 2
        G, groups of competing kernels of the second `Tower`; 0 leaves it out.
    width : int, default 128
        Largest number of principal components of each `Tower`.
    l2 : float, default 0.5
        Ridge penalty of each weight of the heads; the loss of each label counts 1.
    max_iter : int, default 20
        Largest number of Newton steps of the heads in one fit.
    random_state : int, RandomState or None, default 0
        Seed of kernels, thresholds and sampled traces.

    Attributes
    ----------
    n_iter_ : int
        Newton steps of the last fit, of the tower that took most.
    holdout_losses_ : array of float64, shape (K,)
        Leave-one-out log loss of the logit of each space, over the rows outside its fold.

    Examples
    --------
    >>> from dengine.testing import toy_traces
    >>> X, y = toy_traces(60)  # X (n, C, T), y (n,) 1 = success, 0 = failure
    >>> RocketReducer(folds=2).fit(X, y).embed(X).shape
    (60, 2, 2)
    """

    kernels: int = 28
    dilations: int = 5
    regions: int = 3
    groups: int = 2
    width: int = 128
    l2: float = 0.5
    max_iter: int = 20

    def _fit(self, traces: Floats, labels: Ints, folds: Ints) -> None:
        """Fit the heads on checked traces (n, C, T) without a deadline; see `train_heads`.

        Raises SettingError if the traces outside a fold have a single class.
        """
        check_classes(labels, self.training_masks(folds))
        self.train_heads(traces, labels, folds, StopRule())

    def train(
        self,
        X: Floats,
        y: Ints,
        folds: Ints,
        stop: StopRule | None = None,
        numbers: Ints | None = None,
    ) -> Floats:
        """Fit the classifier heads, from their last weights on; return the points of the traces.

        X are traces (n, C, T), y (n,) their labels 1 or 0, `folds` (n,) their folds: a fold is one
        of K fixed groups of traces. Head k, a logistic regression on features of a trace, is fitted
        without the labels of fold k. The features come from convolution kernels, which are drawn at
        the first call of `train` or `precompute`, unless `fit` or `set_state` has set them, and
        stay. `numbers` (n,), increasing, are the numbers of the labels, which identify the traces:
        the features of a trace that was in the last call of `train` or `precompute` are taken from
        a cache, which then holds these traces. None: the cache is not used. `stop` (a limit on the
        number of steps, a deadline, or both) may end the Newton steps, but in the first fit up to
        three are taken even after its deadline. If there are more than 4000 traces, the heads are
        fitted to 4000 of them, chosen by a hash of the numbers, or of the row indices if there are
        no numbers.

        The module `net_`, which embeds, is changed in place, and so is the module that `module`
        returned before. The points are float32 (n, d); row i lies in embedding space ``folds[i]``,
        whose first coordinate is the probability by head ``folds[i]``. Raises the errors of
        `check_traces`, and SettingError for fewer than 20 traces, if the traces outside a fold have
        a single class, and at the first call also for a parameter out of its range, fewer than 2
        samples or a `random_state` that gives no seed.
        """
        expect(
            len(X) >= MIN_TRACES, f"at least {MIN_TRACES} traces", len(X), "verify more parts first"
        )
        traces = self._check_and_initialize(X)
        check_classes(y, self.training_masks(folds))
        return self.train_heads(traces, y, folds, stop or StopRule(), numbers)

    def _initialize(self, traces: Floats) -> None:
        """Build the module `net_`, which embeds traces, for traces of this shape (n, C, T).

        No label is read. The convolution kernels are drawn with the seed `random_state`, and their
        thresholds set from the traces. A channel is scaled so that its samples have the mean 0 and
        the standard deviation 1 in at most 256 of the traces; one that never moves is only shifted.
        The weights of the classifier heads (logistic regressions on the kernels' features) are 0.
        Earlier fits are discarded, and `is_initialized_` becomes True. Raises SettingError for a
        parameter out of its range, fewer than 2 samples or a `random_state` that gives no seed.
        """
        x = torch.from_numpy(traces)
        self.build(traces.shape[1], traces.shape[2], averaging(x))
        self.net_.encoder.learn(x, np.random.default_rng(draw_seed(self.random_state)))
        self.is_initialized_ = True

    def build(self, channels: int, samples: int, average: int) -> None:
        """Make a new `net_` for traces of this shape, with kernels and classifier heads of 0.

        `net_` is the module that embeds traces; its heads are logistic regressions on the features
        that the convolution kernels give. The caller sets the kernels, and then makes
        `is_initialized_` True, which becomes False here. `average` is the number of samples that
        are averaged to one. `trace_shape_` and `average_` are set. `towers_` (the groups of
        features with their heads) and the cache of features become empty, `n_fits_` (the number of
        fits) and `n_component_traces_` (of the traces from which principal components were
        computed) 0; what a fit reports (`n_iter_`, `holdout_losses_`) stays. Raises SettingError
        for a parameter out of its range or fewer than 2 samples.
        """
        self.check()
        self.trace_shape_ = (channels, samples)
        self.average_ = average
        encoder = RocketEncoder(
            channels,
            samples,
            average,
            self.kernels,
            self.dilations,
            self.regions,
            self.groups,
        )
        self.net_ = FeatureEmbedding(
            encoder,
            self.folds,
            self.n_components,
            min(N_LEADING, self.width, encoder.towers[0].stop),
        ).eval()
        self.is_initialized_ = False  # until kernels are drawn or restored
        self.n_fits_ = 0
        self.n_component_traces_ = 0
        self.towers_: list[Tower] = []
        self._raw = RowCache()  # the unscaled features of the last traces, (n, P)

    def train_heads(
        self,
        traces: Floats,
        labels: Ints,
        folds: Ints,
        stop: StopRule,
        numbers: Ints | None = None,
    ) -> Floats:
        """Fit the classifier heads like `train`, but without checking the input; return the points.

        Call `_initialize` first, which draws the convolution kernels. Traces are (n, C, T), labels
        (n,) 1 or 0; they may be of one class. `folds` (n,) are the folds, 0 to K - 1: fixed groups
        of traces. `numbers` (n,), the increasing numbers of the labels, identify the traces:
        features are computed only for those that the cache lacks, which then holds these traces
        alone. Without numbers the cache is not used.

        Head k is a logistic regression. It starts from its last weights, and is fitted on the rows
        outside fold k of at most 4000 rows (`sample_rows`). Each `Tower`, a group of features with
        its principal components, has K heads. `stop` (a limit on the number of steps, a deadline,
        or both) may end the Newton steps of each tower; in the first fit up to three are taken even
        after its deadline. The principal components are computed anew at the first fit, after every
        20 fits, and if there are at least 1.5 times as many rows as at the last time.

        The heads of all towers, weighed to one logit, are written to `net_`, the module that
        embeds. `towers_` and what a fit reports (`n_iter_`, the most steps of a tower, and
        `holdout_losses_`, a leave-one-out loss for each fold) are replaced, and `n_fits_` grows by
        1. The points are float32 (n, d), row i in embedding space ``folds[i]``, whose head did not
        see the label of row i.
        """
        raw = self.raw_features(traces, numbers)
        if len(raw) >= GROWTH * self.n_component_traces_ or self.n_fits_ % REFRESH_EVERY == 0:
            self._compute_components(raw)
        min_steps = 0 if self.n_fits_ else MIN_FIRST_STEPS
        rows = sample_rows(len(raw), numbers)
        f = self.net_.encoder.scale_features(raw[rows])
        y = torch.from_numpy(labels[rows])
        outside = torch.from_numpy(self.training_masks(folds[rows]))
        fits = [
            fit_heads(
                tower.components(features),
                y,
                outside,
                tower.w,
                self.l2,
                self.max_iter,
                stop,
                min_steps,
            )
            for tower, features in zip(self.towers_, self._tower_features(f), strict=True)
        ]
        self.towers_ = [
            tower._replace(w=fit.w) for tower, fit in zip(self.towers_, fits, strict=True)
        ]
        penalties = [0.0] * (len(fits) - 1) + [PRODUCT_PENALTY]
        shares, losses = weigh_towers([fit.left_out for fit in fits], penalties, y, outside)
        self._set_heads(shares)
        self.n_iter_ = max(fit.n_steps for fit in fits)
        self.holdout_losses_ = losses.numpy()
        self.n_fits_ += 1
        return points_in_fold_space(embed_in_chunks(self._embed_raw, raw, 16 * CHUNK), folds)

    def precompute(self, X: Floats, numbers: Ints | None = None) -> None:
        """Compute the features of traces (n, C, T), and cache them for the next `train`.

        `train` finds them again by `numbers`, the numbers of the labels; without numbers nothing is
        cached. The cache then holds these traces and no others. The first call also draws the
        kernels. With fewer than `MIN_TRACES` traces nothing is done. Raises the errors of
        `check_traces`, and at the first call those of `build`.
        """
        if len(X) >= MIN_TRACES:
            self.raw_features(self._check_and_initialize(X), numbers)

    def _set_heads(self, shares: list[Tensor]) -> None:
        """Write the classifier heads of `towers_`, weighed by `shares`, to `net_`, in place.

        `net_` embeds traces in K spaces. Each `Tower`, a group of features, has K heads, logistic
        regressions. Logit k of `net_`, for space k, becomes the sum over the towers of share k
        times the tower's own logit k. `shares` has a tensor (K,) for each tower; `weigh_towers`
        returns them. The heads that `net_` had before are overwritten.
        """
        net = self.net_
        logit_columns = slice(0, net.n_scores, self.n_components)
        net.bias[logit_columns] = 0.0
        weights = [*(net.weight[columns] for columns in net.encoder.towers), net.product_weight]
        for tower, share, tower_weight in zip(self.towers_, shares, weights, strict=False):
            weight, bias = tower.heads()
            tower_weight[:, logit_columns] = share * weight
            net.bias[logit_columns] += share * bias

    def _tower_features(self, f: Tensor) -> list[Tensor]:
        """Return the features (n, p) of each `Tower` from all scaled features (n, P).

        The last are the products of the leading components.
        """
        features = [f[:, columns] for columns in self.net_.encoder.towers]
        leading = self.towers_[0].components(features[0])[:, : self.net_.n_leading]
        return [*features, pairwise_products(leading)]

    def training_masks(self, folds: Ints) -> NDArray[np.bool_]:
        """Return bool masks (K, n): row k selects the traces outside fold k, which train head k.

        `folds` (n,) are the folds of the traces; K is the parameter `folds`.
        """
        return np.asarray(folds != np.arange(self.folds)[:, None])

    def _compute_components(self, raw: Tensor) -> None:
        """Compute feature scales and principal components anew from unscaled features (n, P).

        At most 1000 rows of `raw`, evenly spaced, are read; `n_component_traces_` becomes n.
        `towers_` gets a new `Tower` for each group of features: its principal components, and K
        classifier heads (logistic regressions) whose logits are nearest to those of the old heads,
        or 0 if there are none. A last tower, whose heads are 0, has as features the products of
        every two leading components of the first tower. Scales, leading components and, if
        `n_components` is 2, the second axis of the embedding are written to `net_`, the module that
        embeds. The heads are not: call `_set_heads` before `net_` is used.
        """
        net = self.net_
        encoder = net.encoder
        self.n_component_traces_ = len(raw)
        sample = raw[:: 1 + (len(raw) - 1) // COMPONENT_TRACES]
        old_features = encoder.scale_features(sample)
        old_gain = encoder.gain.clone()
        old_towers = self.towers_
        encoder.learn_feature_scales(sample)
        f = encoder.scale_features(sample)
        self.towers_ = []
        for i, columns in enumerate(encoder.towers):
            weights = torch.zeros(len(old_gain[columns]), self.folds)
            mean_logits = torch.zeros(self.folds)
            if old_towers:
                weights, biases = old_towers[i].heads()
                mean_logits = torch.addmm(biases, old_features[:, columns], weights).mean(0)
                weights = weights * (old_gain / encoder.gain)[columns, None]
            self.towers_.append(
                Tower.from_features(
                    f[:, columns], self.width, TOWER_VARIANCES[i], weights, mean_logits
                )
            )
        self.towers_.append(
            Tower.from_features(
                self._tower_features(f)[-1],
                self.width,
                PRODUCT_VARIANCE,
                torch.zeros(net.n_leading**2, self.folds),
                torch.zeros(self.folds),
            )
        )
        self._set_axes(f[:, encoder.towers[0]])

    def _set_axes(self, f: Tensor) -> None:
        """Write the axes of the first tower's leading components, and the second axis, to `net_`.

        The first `Tower`, a group of features with its principal components, is ``towers_[0]``;
        `net_` is the module that embeds, and is changed in place. The leading components are the
        first four, or fewer if there are not so many. The products of every two of them are the
        features of the last tower. If the embedding has a second coordinate, it is a sigmoid of the
        first component. Before the sigmoid the component is scaled to mean 0 and standard deviation
        2 over the tower's features `f` (n, p). Its sign is changed if it would point against the
        second coordinate that `net_` had before.
        """
        net = self.net_
        columns = net.encoder.towers[0]
        first = self.towers_[0]
        net.weight[columns, net.n_scores :] = first.axes[:, : net.n_leading]
        net.bias[net.n_scores :] = first.centre[: net.n_leading]
        if self.n_components == 2:
            axis = first.axes[:, 0]
            second = 2.0 * axis / (f @ axis).std().clamp(min=1e-12)
            second = second if second @ net.weight[columns, 1] >= 0 else -second
            net.weight[columns, 1 : net.n_scores : 2] = second[:, None]
            net.bias[1 : net.n_scores : 2] = -(f.mean(0) @ second)

    def raw_features(self, traces: Floats, numbers: Ints | None = None) -> Tensor:
        """Return the unscaled features (n, P) of traces (n, C, T), as a tensor.

        They are float32, computed from the outputs of the convolution kernels. `numbers` (n,) are
        the numbers of the traces' labels, which identify the traces: only features that the cache
        lacks are computed. The numbers must strictly increase and not be -1, which is not checked.
        Afterwards the cache holds the features of these traces and no others; it keeps `numbers`
        and shares its memory with the returned tensor, so change neither. Without numbers the cache
        is neither read nor written.
        """
        return torch.from_numpy(
            self._raw.update(
                numbers,
                lambda index: compute_raw_features(self.net_.encoder, traces[index]).numpy(),
            )
        )

    @property
    def report(self) -> FitReport:
        """Return the report of the last fit: its Newton steps.

        Raises NotFittedError before there are kernels, AttributeError before the first fit.
        """
        check_is_fitted(self, "net_")
        return FitReport(self.n_iter_)

    def embed(self, X: ArrayLike) -> Floats:
        """Embed traces (n, T) or (n, C, T) in every embedding space; return float32 (n, K, d).

        The points in space k come from head k, the classifier that was fitted without the labels of
        fold k. If kernels were drawn (`precompute`) but nothing was fitted, all probabilities are
        0.5. Raises NotFittedError before there are kernels, ValueError for traces of another shape
        and for values that are not finite.
        """
        return embed_in_chunks(self.net_, torch.from_numpy(self.check_traces(X)), CHUNK)

    def _embed_raw(self, raw: Tensor) -> Tensor:
        """Unscaled features (n, P) -> points of their traces in every space (n, K, d)."""
        return self.net_.embed_features(self.net_.encoder.scale_features(raw))

    def module(self) -> FeatureEmbedding:
        """Return the module `net_` itself, (B, C, T) -> (B, K, d), which later trainings change.

        A new `fit`, or a restored state, makes another one. It is in evaluation mode. Raises
        NotFittedError before there are kernels.
        """
        check_is_fitted(self, "net_")
        return self.net_

    def get_state(self) -> State:
        """Return arrays from which `set_state` restores the reducer bit for bit, by name.

        They are the shape of the traces, the counters (of fits, traces and steps), the losses, the
        arrays of each `Tower` (a group of features with its classifier heads), and the tensors of
        `net_`, the module that embeds, whose names begin with "net.". The cache of features is not
        among them. The losses and the towers' arrays are not copies. Raises NotFittedError before
        there are kernels, which the first `precompute` or fit draws, and AttributeError between
        `precompute` and the first fit.
        """
        check_is_fitted(self, "net_")
        state = {
            "shape": np.array(self.trace_shape_),
            "counts": np.array(
                [self.average_, self.n_fits_, self.n_component_traces_, self.n_iter_]
            ),
            "losses": self.holdout_losses_,
        }
        for i, tower in enumerate(self.towers_):
            state |= {f"{name}.{i}": value.numpy() for name, value in tower._asdict().items()}
        return state | module_state(self.net_, "net.")

    def set_state(self, state: Arrays) -> Self:
        """Restore what `get_state` returned, and return self.

        The constructor's parameters must be the same. Afterwards the cache of features is empty.
        Raises SettingError for a parameter out of its range, and StoreError if an array of `net_`,
        the module that embeds, is missing or has a size that does not follow from the parameters.
        Raises ValueError if a `Tower`, a group of features with its classifier heads, lacks an
        array, and KeyError if the shape, the counters (of fits, traces and steps) or the losses
        (log loss of the heads of each fold) are missing. The sizes of a tower's arrays are not
        checked. After an error the fitted model may be lost.
        """
        channels, samples = self.restore_shape(state)
        average, *counts = map(int, state["counts"])
        self.build(channels, samples, average)
        restore(self.net_, arrays_with_prefix(state, "net."))
        fields = [arrays_with_prefix(state, f"{name}.").values() for name in Tower._fields]
        for arrays in zip(*fields, strict=True):
            self.towers_.append(Tower(*map(torch.from_numpy, map(np.array, arrays))))
        self.n_fits_, self.n_component_traces_, self.n_iter_ = counts
        self.holdout_losses_ = np.array(state["losses"])
        self.is_initialized_ = True
        return self

    def check(self) -> None:
        """Raise SettingError for a parameter out of its range.

        `kernels`, `dilations`, `width` (the most principal components that are kept of the
        features) and `max_iter` must be integers from 1 to a billion, `regions` (stretches of the
        trace, over each of which a kernel is averaged) from 1 to 16, `groups` (of kernels that
        compete with each other) from 0 to 64, `n_components` 1 or 2, and `folds` from 2 to 1000;
        booleans and floats are refused. `l2` must be above 0; TypeError is raised if it cannot be
        compared with 0. `random_state` is not checked.
        """
        check_integers(
            self,
            n_components=(1, 2),
            folds=(2, 1000),
            kernels=(1, MAX_INTEGER),
            dilations=(1, MAX_INTEGER),
            regions=(1, 16),
            groups=(0, 64),
            width=(1, MAX_INTEGER),
            max_iter=(1, MAX_INTEGER),
        )
        expect(self.l2 > 0, "l2 > 0, or separable labels have no solution", self.l2)


def sample_rows(n: int, numbers: Ints | None) -> Ints | slice:
    """Draw 4000 (`MAX_TRAINING_TRACES`) of n rows, always the same ones; return their indices.

    They are int64 (4000,), increasing. If there are no more rows than that, the result is instead
    ``slice(None)``, which selects all. No label is read.

    `numbers` (n,) are the numbers of the rows' labels; a row keeps its number from training to
    training. None stands for 0 to n - 1. The rows whose numbers have the smallest hashes are drawn,
    old and new labels alike. So most rows are those of the last fit, and the classifier heads that
    are fitted to them start near their final weights.
    """
    if n <= MAX_TRAINING_TRACES:
        return slice(None)
    values = np.arange(n) if numbers is None else numbers
    hashes = values.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    return np.sort(np.argpartition(hashes, MAX_TRAINING_TRACES)[:MAX_TRAINING_TRACES])
