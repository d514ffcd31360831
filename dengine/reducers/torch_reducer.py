"""`TorchReducer`: train any PyTorch network on the CPU, a few steps at every retrain. The file also
holds `Augmentation`, which changes the traces of a batch, `draw_batches`, and `compile_fault`,
which says why a network cannot be exported. `conv` is a subclass with a network of its own, whose
logit it averages with that of `rocket`.

    >>> reducer = TorchReducer(network=MyNetwork)  # MyNetwork(channels, samples) is an nn.Module
    >>> DataEngine(reducer=reducer)

Copy k of the network is trained on the labels outside fold k alone, so that labels of fold k may
be counted in space k. A retrain goes on from the last one: `fit_loop` takes some AdamW steps on
augmented batches, at a constant learning rate. An exponential average of the weights answers, with
the statistics of batch normalisation estimated anew.

References
----------
Loshchilov and Hutter (2019), Decoupled weight decay regularization, ICLR. Zhang, Cisse, Dauphin and
Lopez-Paz (2018), mixup: Beyond empirical risk minimization, ICLR. Polyak and Juditsky (1992),
Acceleration of stochastic approximation by averaging, SIAM J. Control Optim. 30(4). Chernozhukov et
al. (2018), Double/debiased machine learning, Econometrics Journal 21: cross-fitting.
"""

import copy
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, lru_cache
from os import PathLike
from typing import Self

import numpy as np
import torch
from numpy.random import Generator
from sklearn.utils.validation import check_is_fitted
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812  # PyTorch's own documentation calls it so
from torch.nn.modules.batchnorm import _BatchNorm
from torch.nn.utils.rnn import pad_sequence
from torch.optim.swa_utils import get_ema_multi_avg_fn

from ..decision.scripting import (
    arrays_with_prefix,
    incompatible_model_error,
    module_state,
    reason_of,
    restore,
    script,
)
from ..errors import SettingError, counted, expect, log
from ..records import Arrays, State, is_number
from .base import (
    SAME_POINTS,
    FitReport,
    Floats,
    Ints,
    RowCache,
    StopRule,
    check_integers,
    draw_seed,
    embed_in_chunks,
)
from .checkpoints import load_checkpoint
from .encoder import Encoder, Members, NetworkFactory, fold_batch_norms
from .preprocessing import Preprocessor, averaging
from .probability import ProbabilityReducer

CHUNK = 64  # traces that are embedded at once: what they need stays in the cache
STATISTICS_TRACES = 256  # from which the statistics of batch normalisation are estimated
STEPS_PER_LABEL = 1.2  # that training must have had before it is called complete,
INITIAL_STEPS = 36  # on top of these
MANY_LABELS = 4000  # labels beyond which embedding them leaves no time for more steps
MAX_INTEGER = 10**6  # of a parameter
CATCH_UP_FACTOR = 2  # times the steps of a retrain, as long as training is behind


@dataclass(frozen=True, slots=True)
class Augmentation:
    """Change preprocessed traces in ways that keep their labels.

    Parameters
    ----------
    shift : int
        Largest number of frames by which a trace is moved in time.
    gain : float
        Standard deviation of a factor on the whole trace, whose mean is 1.
    noise : float
        Standard deviation of white noise.
    mixup : float
        Parameter of the Beta distribution by which two traces and their labels are mixed.
    """

    shift: int
    gain: float
    noise: float
    mixup: float

    def __call__(self, x: Tensor, y: Tensor, rng: Generator) -> tuple[Tensor, Tensor]:
        """Augment a batch: shift, scale, add noise, mix; return new tensors.

        A shifted trace repeats its end frame. A trace is mixed with the one before it in the batch,
        of the same copy of the network; its own share is at least a half. If `mixup` is 0, nothing
        is mixed, and `y` itself is returned. Shift, factor and share are drawn for each trace and
        copy.

        Parameters
        ----------
        x : Tensor of float32, shape (B, K, C', L)
            Preprocessed traces for each of the K copies of the network.
        y : Tensor of float32, shape (B, K)
            Labels.
        rng : numpy.random.Generator

        Returns
        -------
        x, y : Tensor
            Of the same shapes; a label lies between 0 and 1.
        """
        batch, members, _, length = x.shape
        size = (batch, members, 1, 1)
        offset = torch.from_numpy(rng.integers(-self.shift, self.shift + 1, size=size))
        frame = (torch.arange(length) + offset).clamp(0, length - 1)
        x = x.gather(3, frame.expand_as(x))
        x = x * (1.0 + self.gain * standard_normal(rng, *size))
        x = x + self.noise * standard_normal(rng, *x.shape)
        if self.mixup <= 0.0:
            return x, y
        share = rng.beta(self.mixup, self.mixup, size=(batch, members)).astype(np.float32)
        weight = torch.from_numpy(np.maximum(share, 1.0 - share))
        return x.roll(1, 0).lerp(x, weight[:, :, None, None]), y.roll(1, 0).lerp(y, weight)


@dataclass(eq=False, repr=False, kw_only=True)
class TorchReducer(ProbabilityReducer):
    """Embed traces by a PyTorch network, cross-fitted, that is trained some steps at each retrain.

    The first axis of the embedding is the predicted probability of success, the second the
    difference of the two units behind it, times 0.1 (see `dengine.reducers.encoder`). Distances are
    not rescaled: within a radius of 0.07, probabilities differ by 0.07 at most.

    Parameters
    ----------
    network : callable
        ``network(channels, samples)`` returns an `nn.Module` from preprocessed traces
        (B, channels, samples) to features (B, features). Of each channel of a trace it sees two:
        the averaged, standardised trace and its differences. If it has a parameter `members`, it
        returns all copies in one module, see `dengine.reducers.encoder.Members`.
    n_components : {1, 2}, default 2
        1 leaves the second axis out.
    folds : int, default 5
        K, the number of folds, and so of copies of the network and of spaces. Copy k is trained
        without the labels of fold k.
    steps : int, default 12
        AdamW steps of a retrain; up to twice as many while training is behind (see
        `n_steps_left_`).
    fit_steps : int, default 400
        Steps of `fit`, and the steps of all retrains together after which training is complete,
        however many labels there are; twice as many hardly lower the loss.
    batch_size : int, default 32
        Traces in a step, for each copy of the network.
    learning_rate, weight_decay : float, default 4e-3, 0.02
        Of AdamW. The rate is constant, since training never ends.
    weight_averaging : float, default 0.97
        Share of the averaged weights that remains in a step; the rest comes from the new weights.
        In the first steps it is smaller.
    shift, gain, noise, mixup : default 5, 0.05, 0.03, 0.1
        Augmentation: frames of shift in time, standard deviations of a factor and of white noise,
        and the parameter of mixup; 0 turns each off.
    checkpoint : str, default ""
        File of tensors that `save_checkpoint` wrote, from which all copies of the network start.
        They must not have been trained on parts that are counted later.
    random_state : int, RandomState or None, default 0
        Seed of the initial weights, the batches and the augmentation.

    Attributes
    ----------
    n_steps_ : int
        Steps of all trainings so far.
    n_steps_left_ : int
        Steps that are missing until training is complete: many if many labels came at once, some
        after the first retrains, and some if `steps` is small for the number of labels between two
        retrains. If there are some, an engine without a product retrains again without waiting for
        new labels.
    loss_ : float
        Mean training loss of the last retrain, in nats; NaN if it took no step.
    """

    default_retrain_every = 10  # small retrains often beat large ones seldom

    network: NetworkFactory
    steps: int = 12
    fit_steps: int = 400
    batch_size: int = 32
    learning_rate: float = 4e-3
    weight_decay: float = 0.02
    weight_averaging: float = 0.97
    shift: int = 5
    gain: float = 0.05
    noise: float = 0.03
    mixup: float = 0.1
    checkpoint: str = ""

    def train(
        self,
        X: Floats,
        y: Ints,
        folds: Ints,
        stop: StopRule | None = None,
        numbers: Ints | None = None,
    ) -> Floats:
        """Train on traces X (n, C, T), labels y (n,) and folds (n,); return the traces' points.

        Labels are 1 or 0. Copy k of the network is trained without the labels of fold k, one of K
        fixed groups of traces; folds are 0 to K - 1, which is not checked. The training starts from
        the weights of the last training, or from initial weights the first time, and takes as many
        steps as `n_steps_due` says, or fewer if `stop` (a limit on their number, a deadline, or
        both) ends them. Afterwards a new module `encoder_` embeds traces. Augmentation and
        randomness are those of `fit_loop`.

        `numbers` (n,), strictly increasing, are the numbers of the labels, which identify the
        traces. If `stop` allows no step at all, and this and the last training have `numbers`,
        `encoder_` stays: a trace keeps its point of the last training, and a new trace is embedded
        by it.

        The points are float32 (n, d), row i in embedding space ``folds[i]``, the one of copy
        ``folds[i]``. Raises the errors of `check_traces`, and SettingError for fewer than two
        traces outside a fold, and at the first training for fewer than 20 traces, or a parameter,
        network, checkpoint or `random_state` that cannot be used.
        """
        traces = self._check_and_initialize(X)
        return self._train(
            traces, y, folds, stop or StopRule(), self.n_steps_due(len(traces)), numbers
        )

    def n_steps_due(self, n_labels: int) -> int:
        """Return the number of steps that the next retrain takes on `n_labels` labels.

        It is `steps`, or as many as are missing to complete training if these are more, up to twice
        `steps`; beyond 4000 labels it is always `steps`.
        """
        n_missing = self._n_steps_wanted(n_labels) - self.n_steps_
        largest = self.steps if n_labels > MANY_LABELS else CATCH_UP_FACTOR * self.steps
        return min(max(n_missing, self.steps), largest)

    def _n_steps_wanted(self, n_labels: int) -> int:
        """Return the number of steps, over all trainings, that make training complete.

        It is 36 plus 1.2 for each label, but at most `fit_steps`.
        """
        return int(min(self.fit_steps, INITIAL_STEPS + STEPS_PER_LABEL * n_labels))

    def _initialize(self, traces: Floats) -> None:
        """Build preprocessor, networks and `encoder_` anew for traces (n, C, T).

        `encoder_` is the module that embeds traces. Earlier trainings are discarded; no label is
        read. The preprocessor averages and scales the samples; its scales are computed from the
        traces. The weights of the networks are read from the checkpoint, a file of stored weights,
        if one is given, and otherwise drawn from the seed. At the end `is_initialized_` becomes
        True. Raises SettingError for a checkpoint that cannot be used, with `is_initialized_`
        False, and the errors of `_build`, which leave it as it was.
        """
        x = torch.from_numpy(traces)
        self._build(traces.shape[1], traces.shape[2], averaging(x))
        self.preprocessor_.learn(x)
        if self.checkpoint:
            load_checkpoint(self.members_, self.checkpoint)
            self.averaged_members_.load_state_dict(self.members_.state_dict())
        self.encoder_ = self._new_encoder()
        self.is_initialized_ = True

    def _build(self, channels: int, samples: int, average: int, seed: int | None = None) -> None:
        """Build preprocessor and networks for traces of this shape, with initial weights.

        The networks are K copies of one, `members_`, and copies of these for the averages of their
        weights. The counts of steps, the loss, `why_no_module_` (why there is no module to export)
        and the state of the optimiser are reset, and `is_initialized_` becomes False. The caller
        then sets scales and weights of a checkpoint, makes `encoder_`, the module that embeds, and
        sets `is_initialized_` to True. `average` is the number of samples that are averaged to one.
        Without `seed` the seed comes from `random_state`; torch's global generator keeps its state.
        Raises SettingError for a parameter out of its range, fewer than 2 samples, a `random_state`
        that gives no seed (another type, or an integer below 0 or above 2**32 - 1), or a network
        that cannot be used, like one that does not give (B, features). The first two errors change
        nothing; after the others do not use the reducer.
        """
        self.check()
        if samples < 2:
            raise SettingError(
                f"Expected at least 2 samples, got {samples} (n_features = {channels * samples})."
            )
        self.preprocessor_ = Preprocessor(channels, samples, average)
        self.seed_ = draw_seed(self.random_state) if seed is None else seed
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.seed_)
            self.members_ = Members(
                self.network, self.preprocessor_.channels, self.preprocessor_.samples, self.folds
            )
        self.averaged_members_ = copy.deepcopy(self.members_)
        self.optimizer_state_: dict[int, dict[str, Tensor]] = {}
        self.why_no_module_ = None  # until it was tried
        self._points = RowCache()  # by `encoder_`, of the traces of the last training
        self.is_initialized_ = False  # until scales and checkpoint are read
        self.n_steps_ = 0
        self.n_steps_left_ = 0
        self.n_new_steps_ = 0
        self.loss_ = float("nan")

    def _fit(self, traces: Floats, labels: Ints, folds: Ints) -> None:
        """Take `fit_steps` steps on checked traces (n, C, T), without a deadline; see `_train`."""
        self._train(traces, labels, folds, StopRule(), self.fit_steps)

    def _train(
        self,
        traces: Floats,
        labels: Ints,
        folds: Ints,
        stop: StopRule,
        steps: int,
        numbers: Ints | None = None,
    ) -> Floats:
        """Take up to `steps` steps on traces (n, C, T); return the points of the traces.

        `labels` (n,) are 1 or 0, `folds` (n,) the folds, 0 to K - 1: fixed groups of traces.
        `fit_loop` trains copy k of the network on the rows outside fold k; this changes the copies,
        the averages of their weights, the optimiser's state, the counts of steps and `loss_`. Then
        a copy of the networks with averaged weights and new statistics of batch normalisation
        becomes `encoder_`, the module that embeds. `stop` (a limit on the number of steps, a
        deadline, or both) may end the steps earlier.

        But if `stop` allows no step at all, and this and the last training have `numbers` (n,), the
        increasing numbers of the labels, `encoder_` stays: traces of the last training, found by
        number, keep their points, and others are embedded by `encoder_`; `n_new_steps_` becomes 0
        and `loss_` NaN. In both cases `n_steps_left_` becomes 0 if `stop.max_steps` is set, else
        the number of steps that are missing until training is complete.

        The points are float32 (n, d), row i in embedding space ``folds[i]``, the one of copy
        ``folds[i]``. Raises SettingError for fewer than two traces outside a fold; `encoder_` and
        the counts of steps stay then.
        """
        if numbers is not None and self._points.numbers is not None and stop.exhausted(0):
            self.n_new_steps_ = 0
            self.loss_ = float("nan")
            points = self._points.update(
                numbers, lambda i: self._embed_in_fold_space(self._preprocess(traces[i]), folds[i])
            )
        else:
            x = self._preprocess(traces)
            self.fit_loop(x, torch.from_numpy(labels).float(), folds, stop, steps)
            self.estimate_statistics(x)
            self.encoder_ = self._new_encoder()
            points = self._embed_in_fold_space(x, folds)
            self._points = RowCache(numbers, points)
        n_missing = self._n_steps_wanted(len(labels)) - self.n_steps_
        # A caller who limits the steps of a retrain wants no further retrains in their place.
        self.n_steps_left_ = max(0, n_missing) if stop.max_steps is None else 0
        return points

    def _preprocess(self, traces: Floats) -> Tensor:
        """Return traces (n, C, T) averaged and standardised by `preprocessor_`, without gradients.

        They are float32 (n, C', L): C' channels of L samples.
        """
        x: Tensor = self.preprocessor_(torch.from_numpy(traces))
        return x

    def fit_loop(self, x: Tensor, y: Tensor, folds: Ints, stop: StopRule, steps: int) -> None:
        """Take AdamW steps on augmented batches, copy k of the network on the rows outside fold k.

        A fold is one of K fixed groups of rows. This changes `members_`, the K copies, and the
        running averages of their weights in place, goes on from the optimiser's stored moments, and
        stores the new ones. `n_new_steps_` becomes the number of steps taken, by which `n_steps_`
        grows, and `loss_` their mean loss (NaN if no step is taken). Batches, augmentation
        (`Augmentation`) and dropout follow from `seed_` and `n_steps_`; torch's global generator
        keeps its state. `encoder_`, the module that embeds, stays as it is. Afterwards `members_`
        is in training mode.

        Parameters
        ----------
        x : Tensor of float32, shape (n, C', L)
            Preprocessed traces.
        y : Tensor of float32, shape (n,)
            Labels, 1 or 0.
        folds : array of int64, shape (n,)
            Fold of each row, 0 to K - 1.
        stop : StopRule
            Limit on the number of steps, a deadline, or both; asked before each step.
        steps : int
            Largest number of steps.

        Raises
        ------
        SettingError
            If fewer than two rows lie outside a fold.
        """
        optimizer = self.make_optimizer()
        augmentation = Augmentation(self.shift, self.gain, self.noise, self.mixup)
        rng = np.random.default_rng([self.seed_, self.n_steps_])
        losses: list[float] = []
        self.members_.train()
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(int(rng.integers(2**31)))  # of dropout
            for rows in draw_batches(folds, self.folds, self.batch_size, steps, rng):  # (B, K)
                if stop.exhausted(len(losses)):
                    break
                batch_x, batch_y = augmentation(x[rows], y[rows], rng)
                losses.append(self.train_step(optimizer, batch_x, batch_y))
        self.optimizer_state_ = optimizer.state_dict()["state"]
        self.n_new_steps_ = len(losses)
        self.loss_ = float(np.mean(losses)) if losses else float("nan")

    def train_step(self, optimizer: torch.optim.Optimizer, x: Tensor, y: Tensor) -> float:
        """Take one step on traces x (B, K, C', L), labels y (B, K); return the loss, in nats.

        `optimizer` is that of `make_optimizer`. `members_`, the K copies of the network, with their
        statistics of batch normalisation, and the running averages of their weights change in
        place, and `n_steps_` grows by 1. Copy k sees the preprocessed traces and the labels at
        index k. Dropout draws from torch's global generator, if `members_` is in training mode. The
        loss is the one before the step, the mean over the batch and over the K copies; each copy
        moves by the gradient of its own mean loss.
        """
        logits = self.members_(x)  # (B, K)
        loss = F.binary_cross_entropy_with_logits(logits, y)
        optimizer.zero_grad()
        # Members share no weights, so each gets the gradient of its own mean loss.
        (self.folds * loss).backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        self.n_steps_ += 1
        self.average_weights()
        return float(loss.detach())

    def make_optimizer(self) -> torch.optim.Optimizer:
        """Return a new AdamW for `members_`, with the moments that the last training left.

        `members_` are the copies of the network that are trained. The moments are the running means
        of gradients and of their squares. They are not copied: a step of the optimiser changes
        `optimizer_state_`, in which they are stored. Weight decay is only for parameters of two
        dimensions or more whose name ends in "weight", so not for biases and batch normalisation.
        """
        parameters: dict[bool, list[nn.Parameter]] = {True: [], False: []}  # by whether they decay
        for name, parameter in self.members_.named_parameters():
            parameters[parameter.dim() > 1 and name.endswith("weight")].append(parameter)
        optimizer = torch.optim.AdamW(
            [
                {"params": parameters[True], "weight_decay": self.weight_decay},
                {"params": parameters[False], "weight_decay": 0.0},
            ],
            lr=self.learning_rate,
            fused=True,
        )
        if self.optimizer_state_:
            optimizer.load_state_dict(optimizer.state_dict() | {"state": self.optimizer_state_})
        return optimizer

    def average_weights(self) -> None:
        """Move the averaged weights of the networks, in place, towards the trained weights.

        Each parameter of `averaged_members_` becomes ``c * average + (1 - c) * trained``, where
        `trained` is that of `members_`, and c is `weight_averaging`. In the first steps c is
        smaller, (1 + n) / (10 + n), where n is `n_steps_`. Statistics of batch normalisation are
        not averaged.
        """
        kept = min(self.weight_averaging, (1 + self.n_steps_) / (10 + self.n_steps_))
        average = get_ema_multi_avg_fn(kept)  # type: ignore[no-untyped-call]
        average([*self.averaged_members_.parameters()], [*self.members_.parameters()], None)

    @torch.no_grad()
    def estimate_statistics(self, x: Tensor) -> None:
        """Estimate the running statistics of batch normalisation anew, for the averaged weights.

        `averaged_members_`, the networks with these weights, are changed in place, as by
        `torch.optim.swa_utils.update_bn`. At most 256 of the preprocessed traces x (n, C', L) are
        read; they are drawn with the seed n. The statistics are the means of those of batches of at
        most 64. No label is read, so each copy of the network may see all traces. Other buffers are
        copied from the trained networks, `members_`. Afterwards `averaged_members_` is in
        evaluation mode.
        """
        members = self.averaged_members_.eval()
        for buffer, trained in zip(members.buffers(), self.members_.buffers(), strict=True):
            buffer.copy_(trained)
        for module in members.modules():
            if isinstance(module, _BatchNorm):
                module.reset_running_stats()
                module.momentum = None  # the mean over all batches
                module.train()
        rows = np.random.default_rng(len(x)).permutation(len(x))[:STATISTICS_TRACES]
        for chunk in torch.from_numpy(rows).chunk(-(-len(rows) // CHUNK)):
            members(x[chunk, None].expand(-1, self.folds, -1, -1))
        members.eval()

    def _new_encoder(self) -> Encoder:
        """Return a new module that embeds: the preprocessor itself and a copy of the averages."""
        members = fold_batch_norms(copy.deepcopy(self.averaged_members_).eval())
        encoder = Encoder(self.preprocessor_, members, self.n_components)  # type: ignore[arg-type]
        return encoder.eval().requires_grad_(False)

    @torch.inference_mode()
    def _embed_in_fold_space(self, x: Tensor, folds: Ints) -> Floats:
        """Embed preprocessed traces (n, C', L), each in one embedding space: float32 (n, d).

        There are K spaces; space k is that of copy k of the network, which is trained without the
        labels of fold k, a fixed group of traces. Row i is the point of trace i in space
        ``folds[i]``. Folds must be 0 to K - 1, which is not checked; rows of other folds are
        undefined. Copy k embeds the rows of fold k alone, so this takes 1 / K of the time of
        `embed` if the folds are equally large.
        """
        rows_of_fold = [torch.from_numpy(np.flatnonzero(folds == k)) for k in range(self.folds)]
        points = torch.empty(len(x), self.n_components)
        # Column k has the rows of fold k, and -1 after the last one.
        for rows in torch.split(pad_sequence(rows_of_fold, padding_value=-1), CHUNK):  # (B, K)
            is_row = rows >= 0
            points[rows[is_row]] = self.encoder_.embed(x[rows])[is_row]
        return points.numpy()

    def embed(self, X: Floats) -> Floats:
        """Embed traces (n, T) or (n, C, T) in every embedding space; return float32 (n, K, d).

        The points in space k come from network k, which was trained without the labels of fold k.
        Raises NotFittedError before there are networks, and the errors of `check_traces`, such as
        ValueError for traces of another shape.
        """
        check_is_fitted(self, "encoder_")
        return embed_in_chunks(self.encoder_, torch.from_numpy(self.check_traces(X)), CHUNK)

    def warm_up(self) -> None:
        """Import what AdamW's first step needs, once in a process; see `warm_optimizer`."""
        warm_optimizer()

    def module(self) -> nn.Module | None:
        """Return the module that embeds, (B, C, T) -> (B, K, d), for compiling or exporting.

        It is the present `encoder_`, which later trainings replace and do not change. None if
        TorchScript cannot compile the user's network: the first call finds this out, and logs a
        warning, unless a warning for this network and shape was logged before (`compile_fault`).
        Raises NotFittedError before there are networks, and TypeError if the parameter `network`,
        the class or function that makes one, is not hashable.
        """
        check_is_fitted(self, "encoder_")
        if self.why_no_module_ is None:  # copies of the reducer, which an engine trains, keep it
            self.why_no_module_ = compile_fault(
                self.network, self.preprocessor_.channels, self.preprocessor_.samples
            )
        return None if self.why_no_module_ else self.encoder_

    @property
    def report(self) -> FitReport:
        """Return the report of the last training: its steps, the steps still missing, and a note.

        Training is complete after 36 steps plus 1.2 for each label, but at most `fit_steps`, over
        all trainings. If the caller limited the number of steps of the last training, none counts
        as missing. The note gives the loss and the number of all steps so far if the last training
        took a step, and the number of missing steps if there are any. If neither holds, it is "".
        Raises NotFittedError before there are networks.
        """
        check_is_fitted(self, "encoder_")
        note = f"loss {self.loss_:.3f} after {self.n_steps_} steps" if self.n_new_steps_ else ""
        left = f"{counted(self.n_steps_left_, 'step')} to go" if self.n_steps_left_ else ""
        note = ", ".join(filter(None, (note, left)))
        return FitReport(self.n_new_steps_, note, self.n_steps_left_)

    def get_state(self) -> State:
        """Return arrays from which `set_state` restores the reducer bit for bit, by name.

        They are the shape of the traces, counters, the loss, and the tensors of the preprocessor,
        of the networks, of their copies with averaged weights, and of the optimiser, so that
        training can go on. They include the points of a fixed trace, by which `set_state`
        recognises the network. Raises NotFittedError before there are networks.
        """
        check_is_fitted(self, "encoder_")
        state = {
            "shape": np.array(self.trace_shape_),
            "counts": np.array(
                [
                    self.preprocessor_.average,
                    self.seed_,
                    self.n_steps_,
                    self.n_steps_left_,
                    self.n_new_steps_,
                ]
            ),
            "loss": np.array(self.loss_),
            "points": self._embed_ramp(),
        }
        for name, module in self._modules().items():
            state |= module_state(module, name)
        for i, moments in self.optimizer_state_.items():
            for name, value in moments.items():
                state[f"optimizer.{i}.{name}"] = value.numpy().copy()
        return state

    def set_state(self, state: Arrays) -> Self:
        """Restore what `get_state` returned, and return self.

        The constructor's parameters must be the same. A tensor that the state lacks keeps its
        initial value, since earlier releases stored fewer. Raises StoreError if a tensor has
        another size than in the modules, if the state has a tensor that the modules lack, or if the
        network gives points for a fixed trace that differ by more than 0.001 from those when the
        state was taken; a state without these points is not checked so. Raises KeyError if an array
        of counts, shape or loss is missing, and SettingError for a parameter or network that cannot
        be used. The sizes of the optimiser's tensors are not checked. After an error do not use the
        reducer.
        """
        channels, samples = self.restore_shape(state)
        average, seed, *counts = map(int, state["counts"])
        self._build(channels, samples, average, seed)
        self.n_steps_, self.n_steps_left_, self.n_new_steps_ = counts
        self.loss_ = float(state["loss"])
        for name, module in self._modules().items():
            # A state of an earlier release lacks buffers that are not persistent.
            restore(module, module_state(module, "") | arrays_with_prefix(state, name))
        for name, value in arrays_with_prefix(state, "optimizer.").items():
            i, key = name.split(".")
            self.optimizer_state_.setdefault(int(i), {})[key] = torch.from_numpy(np.array(value))
        self.is_initialized_ = True
        self.encoder_ = self._new_encoder()
        points = state.get("points")
        if points is not None and not np.allclose(points, self._embed_ramp(), atol=SAME_POINTS):
            raise incompatible_model_error("network has the same sizes and is another one")
        return self

    def _modules(self) -> dict[str, nn.Module]:
        """Return the modules whose tensors `get_state` returns, by the prefix of their names.

        They are the preprocessor ("preprocessor."), the trained copies of the network ("members.")
        and the copies with averaged weights ("averaged.").
        """
        return {
            "preprocessor.": self.preprocessor_,
            "members.": self.members_,
            "averaged.": self.averaged_members_,
        }

    def _embed_ramp(self) -> Floats:
        """Return the points (1, K, d) of a fixed trace, by which `set_state` knows the network.

        There is a point for each of the K copies of the network. The trace is a preprocessed one,
        whose channels all rise from -1 to 1.
        """
        channels = self.preprocessor_.channels
        samples = self.preprocessor_.samples
        ramp = torch.linspace(-1.0, 1.0, samples).expand(1, self.folds, channels, samples)
        return self.encoder_.embed(ramp).numpy()

    def check(self) -> None:
        """Raise SettingError for a parameter out of its range.

        These parameters must be integers: folds from 2 to 1000, batch_size of at least 2, steps and
        fit_steps of at least 1, shift of at least 0 (these four up to a million), and n_components,
        1 or 2. The numbers learning_rate, weight_averaging, weight_decay, gain, noise and mixup
        must not be negative, infinite or NaN; besides, learning_rate must not be 0, and
        weight_averaging must be below 1. checkpoint must be a text or path; no file is looked at.
        The other parameters are not checked.
        """
        check_integers(
            self,
            n_components=(1, 2),
            folds=(2, 1000),
            steps=(1, MAX_INTEGER),
            fit_steps=(1, MAX_INTEGER),
            batch_size=(2, MAX_INTEGER),
            shift=(0, MAX_INTEGER),
        )
        for name in ("learning_rate", "weight_averaging", "weight_decay", "gain", "noise", "mixup"):
            value = getattr(self, name)
            expect(
                is_number(value) and 0.0 <= value < float("inf"), f"{name} >= 0, a number", value
            )
        expect(self.learning_rate > 0.0, "learning_rate > 0", self.learning_rate)
        expect(
            isinstance(self.checkpoint, str | PathLike),
            'checkpoint, the name of a file, or ""',
            self.checkpoint,
        )
        expect(
            self.weight_averaging < 1.0, "weight_averaging from 0 to below 1", self.weight_averaging
        )


def draw_batches(
    folds: Ints, n_folds: int, batch_size: int, steps: int, rng: Generator
) -> Iterator[Tensor]:
    """Yield, for each step, the rows on which each of K networks is trained.

    Network k passes over all rows outside fold k, a fixed group of rows, in random order, and then
    again in another order; a batch may span two passes.

    Parameters
    ----------
    folds : array of int, shape (n,)
        Fold of each row. Network k gets no row of fold k.
    n_folds, batch_size, steps : int
        K, B and the number of batches, which must be at least 1. If a network has fewer than B
        rows, B is reduced to the smallest number of rows of a network.
    rng : numpy.random.Generator
        Draws the orders.

    Yields
    ------
    Tensor of int64, shape (B, K)
        Column k holds rows for network k.

    Raises
    ------
    SettingError
        At the first batch, if fewer than two rows lie outside a fold.
    """
    pools = [np.flatnonzero(folds != k) for k in range(n_folds)]
    smallest = min(map(len, pools))
    if smallest < 2:
        raise SettingError(
            f"Expected at least 2 traces outside each fold, got {smallest} "
            f"(n_samples = {len(folds)}); all traces may be the same. "
            "Check the sensor and the unit."
        )
    size = min(batch_size, smallest)
    columns = []
    for pool in pools:
        n_passes = -(-steps * size // len(pool))
        order = np.concatenate([rng.permutation(pool) for _ in range(n_passes)])
        columns.append(order[: steps * size].reshape(steps, size))
    yield from torch.from_numpy(np.stack(columns, axis=2))


@cache
def warm_optimizer() -> None:
    """Take a step on one weight, once in a process.

    The first step of an optimiser imports a compiler, which takes two seconds. Later calls do
    nothing.
    """
    weight = nn.Parameter(torch.zeros(1))
    weight.grad = torch.zeros(1)
    torch.optim.AdamW([weight], fused=True).step()


def standard_normal(rng: Generator, *shape: int) -> Tensor:
    """Draw a float32 tensor of this shape from the standard normal distribution, by `rng`."""
    return torch.from_numpy(rng.standard_normal(shape, dtype=np.float32))


@lru_cache(32)
def compile_fault(network: NetworkFactory, channels: int, samples: int) -> str:
    """Return why TorchScript cannot compile a network, and log it as a warning; "" if it can.

    ``network(channels, samples)`` makes a module for preprocessed traces of this shape. A user's
    network may hold Python that TorchScript does not support. To find out, two copies of it are
    built, compiled and run; any exception counts as a fault, and none is raised, but TypeError if
    `network` is not hashable. A process keeps the answers for the last 32 networks and shapes, and
    logs nothing when it gives such an answer again. The state of torch's global random generator
    does not change.
    """
    try:
        with torch.random.fork_rng(devices=[]), torch.inference_mode():
            members = Members(network, channels, samples, 2).eval()
            script(fold_batch_norms(members))(torch.zeros(1, 2, channels, samples))
    except Exception as error:
        name = getattr(network, "__qualname__", repr(network))
        fault = f"{name} cannot be compiled by TorchScript: {reason_of(error)}"
        log.warning("%s. So it answers in Python and is not exported.", fault)
        return fault
    return ""
