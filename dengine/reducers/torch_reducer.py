"""`TorchReducer`: train any PyTorch encoder of traces on the CPU, a few steps at every retrain.

Member k of the encoder is trained on the labels outside fold k alone, so that labels of fold k may be counted in space k.
A retrain goes on from the last one: it takes some AdamW steps on augmented batches, at a constant learning rate. An
exponential average of the weights answers, with the statistics of batch normalisation taken anew.

    >>> reducer = TorchReducer(network=MyNetwork)      # MyNetwork(channels, samples) is an nn.Module
    >>> DataEngine(reducer=reducer)

References
----------
Loshchilov and Hutter (2019), Decoupled weight decay regularization, ICLR. Zhang, Cisse, Dauphin and Lopez-Paz (2018),
mixup: Beyond empirical risk minimization, ICLR. Polyak and Juditsky (1992), Acceleration of stochastic approximation by
averaging, SIAM J. Control Optim. 30(4). Chernozhukov et al. (2018), Double/debiased machine learning, Econometrics Journal
21: cross-fitting.
"""

import copy
import logging
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache, lru_cache
from io import BytesIO
from pathlib import Path
from pickle import UnpicklingError
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from sklearn.base import clone
from sklearn.utils.validation import check_is_fitted
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812  # PyTorch's own documentation calls it so

from ..decision.scripting import arrays_with_prefix, restore, script
from ..errors import SettingError, expect, instead
from ..files import write_output
from ..records import is_whole
from .base import FitReport, Floats, Ints, Reducer, StopRule, binary_labels, folds_of, seed_of
from .encoder import Encoder, Members, NetworkFactory, fold_batch_norms
from .preprocessing import Preprocessor, averaging

log = logging.getLogger("dengine")
SEPARATE = re.compile(r"^(networks\.networks\.)\d+\.")  # names in `encoder.Separate`

MIN_TRACES = 20
CHUNK = 64  # traces that are embedded at once: what they need stays in the cache
STATISTICS = 256  # traces from which the statistics of batch normalisation are taken
STEPS_A_LABEL = 1.2  # that training must have had before it is called complete
INITIAL_STEPS = 36  # steps on top of these
MANY_LABELS = 4000  # labels beyond which embedding them leaves no time for more steps
CATCH_UP_FACTOR = 2  # times the steps of a retrain, as long as training is behind


@dataclass(frozen=True, slots=True)
class Augmentation:
    """Change preprocessed traces in ways that keep their labels.

    shift : frames that a trace is moved in time at most.  gain : standard deviation of a factor on the whole trace.
    noise : standard deviation of white noise.  mixup : parameter of the Beta distribution that mixes two traces.
    """

    shift: int
    gain: float
    noise: float
    mixup: float

    def __call__(self, x: Tensor, y: Tensor, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
        """Augment x (B, K, C, L) and y (B, K); traces are mixed with others of the same member."""
        batch, members, _, length = x.shape
        offset = torch.from_numpy(rng.integers(-self.shift, self.shift + 1, size=(batch, members, 1, 1)))
        frame = (torch.arange(length) + offset).clamp(0, length - 1)
        x = x.gather(3, frame.expand_as(x))
        x = x * (1.0 + self.gain * _normal(rng, batch, members, 1, 1))
        x = x + self.noise * _normal(rng, *x.shape)
        if self.mixup <= 0.0:
            return x, y
        share = rng.beta(self.mixup, self.mixup, size=(batch, members)).astype(np.float32)
        own = torch.from_numpy(np.maximum(share, 1.0 - share))
        other_x, other_y = x.roll(1, 0), y.roll(1, 0)
        return other_x.lerp(x, own[:, :, None, None]), other_y.lerp(y, own)


@dataclass(eq=False, repr=False, kw_only=True)
class TorchReducer(Reducer):
    """Embed traces by a PyTorch network that is trained with cross-fitting, within the time of a retrain.

    The first axis of the embedding is the predicted probability of success, the second the difference of the two units
    behind it, times 0.1 (see `dengine.reducers.encoder`). Distances are not rescaled: a radius of 0.07 holds parts whose
    probabilities differ by 0.07 at most.

    Parameters
    ----------
    network : callable
        ``network(channels, samples)`` gives an `nn.Module` from preprocessed traces (B, channels, samples) to features
        (B, features). Of each channel of a trace it sees two: the averaged, standardised trace and its differences.
    n_components : {1, 2}, default 2
        1 leaves the second axis out.
    folds : int, default 5
        K, members and spaces. Member k is trained without the labels of fold k.
    steps : int, default 12
        AdamW steps of a retrain; twice as many as long as training is behind (see `n_steps_left_`).
    fit_steps : int, default 400
        Steps of `fit`, and of the training after many labels came at once; twice as many hardly lower the loss.
    batch_size : int, default 32
        Traces of each member in a step.
    learning_rate, weight_decay : float, default 4e-3, 0.02
        Of AdamW. The rate is constant: training never ends.
    weight_averaging : float, default 0.97
        Share of the averaged weights that a step keeps.
    shift, gain, noise, mixup : default 5, 0.05, 0.03, 0.1
        Augmentation: frames of shift in time, standard deviations of a factor and of white noise, and the parameter of
        mixup; 0 turns each off.
    checkpoint : str, default ""
        File of tensors that `training/train_encoder.py` wrote, from which all members start. It must not have been
        trained on parts that are counted later.
    random_state : int, RandomState or None, default 0
        Of the initial weights, the batches and the augmentation.

    Attributes
    ----------
    n_steps_ : int
        Steps of all trainings so far.
    n_steps_left_ : int
        Steps that are missing to complete training, after many labels came at once; 0 in normal production.
    loss_ : float
        Mean training loss of the last retrain, in nats; NaN where it took no step.
    """

    uses_labels = True
    scores = True
    own_unit = True
    min_traces = MIN_TRACES
    default_radius = 0.07  # of a probability
    default_retrain_every = 10  # small retrains often beat large ones seldom

    network: NetworkFactory
    n_components: int = 2
    folds: int = 5
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
    random_state: Any = 0

    @property
    def n_spaces(self) -> int:
        return int(self.folds)

    def fit(self, X: ArrayLike, y: ArrayLike | None = None, *, folds: Ints | None = None) -> Self:
        """Train from the initial weights to the end.

        Parameters
        ----------
        X : array of float, shape (n, T) or (n, C, T)
        y : array of shape (n,)
            Two classes; the larger value is the success.
        folds : array of int, shape (n,), optional
            Permanent folds; by default those of the traces' content.

        Raises
        ------
        SettingError
            If a parameter is out of its range, or fewer than two traces lie outside a fold.
        """
        traces = self.check_traces(X, reset=True)
        labels = binary_labels(y, len(traces), type(self).__name__)
        folds = folds_of(traces, self.folds, folds)
        self._start(traces)
        self._train(traces, labels, folds, StopRule(), steps=self.fit_steps)
        return self

    def train(self, X: Floats, y: Ints, folds: Ints, stop: StopRule | None = None, numbers: Ints | None = None) -> Floats:
        if "members_" not in vars(self):
            expect(len(X) >= MIN_TRACES, f"at least {MIN_TRACES} traces", len(X), "verify more parts first")
            self._start(self.check_traces(X, reset=True))
        traces = self.check_traces(X)
        labels = binary_labels(y, len(X), type(self).__name__)
        x = self._train(traces, labels, folds, stop or StopRule(), self.n_steps_due(len(traces)))
        return self._embed_own(x, folds)

    def n_steps_due(self, n_labels: int) -> int:
        """Steps that the next retrain takes on so many labels."""
        behind = self._n_steps_wanted(n_labels) - self.n_steps_
        most = self.steps if n_labels > MANY_LABELS else CATCH_UP_FACTOR * self.steps
        return min(max(behind, self.steps), most)

    def _n_steps_wanted(self, n_labels: int) -> int:
        return int(min(self.fit_steps, INITIAL_STEPS + STEPS_A_LABEL * n_labels))

    def _start(self, traces: Floats) -> None:
        """Build preprocessor and members for traces (n, C, T), from which the scales are read; no label is read."""
        x = torch.from_numpy(traces)
        self._build(traces.shape[1], traces.shape[2], averaging(x))
        self.preprocessor_.learn(x)
        if self.checkpoint:
            load_checkpoint(self.members_, self.checkpoint)
            self.averaged_members_.load_state_dict(self.members_.state_dict())

    def _build(self, channels: int, samples: int, average: int) -> None:
        self.check()
        if samples < 2:
            raise SettingError(f"Expected at least 2 samples, got {samples} (n_features = {channels * samples}).")
        self.preprocessor_ = Preprocessor(channels, samples, average)
        self.seed_ = _drawn_seed(self.random_state)
        shape = self.preprocessor_.channels, self.preprocessor_.samples
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.seed_)
            self.members_ = Members(self.network, *shape, self.folds)
        self.averaged_members_ = copy.deepcopy(self.members_)
        self.optimizer_state_: dict[int, dict[str, Tensor]] = {}
        self.n_steps_ = self.n_steps_left_ = self.n_new_steps_ = 0
        self.loss_ = float("nan")
        self.encoder_ = self._new_encoder()

    def _train(self, traces: Floats, labels: Ints, folds: Ints, stop: StopRule, steps: int) -> Tensor:
        """Train on traces (n, C, T) and let the averaged members answer; returns the preprocessed traces."""
        with torch.no_grad():
            x: Tensor = self.preprocessor_(torch.from_numpy(traces))
        self.fit_loop(x, torch.from_numpy(labels).float(), folds, stop, steps)
        missing = self._n_steps_wanted(len(labels)) - self.n_steps_
        # Who limits the steps of a retrain wants no further retrains in their place.
        self.n_steps_left_ = max(0, missing) if stop.max_steps is None else 0
        self.estimate_statistics(x)
        self.encoder_ = self._new_encoder()
        return x

    def fit_loop(self, x: Tensor, y: Tensor, folds: Ints, stop: StopRule, steps: int) -> None:
        """Take AdamW steps on x (n, C', L) and y (n,), member k on the rows outside fold k."""
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
                batch = augmentation(x[rows], y[rows], rng)
                losses.append(self.train_step(optimizer, *batch))
        self.optimizer_state_ = optimizer.state_dict()["state"]
        self.n_new_steps_ = len(losses)
        self.loss_ = float(np.mean(losses)) if losses else float("nan")

    def train_step(self, optimizer: torch.optim.Optimizer, x: Tensor, y: Tensor) -> float:
        """Take one step on x (B, K, C', L) and y (B, K); returns the mean loss of the members."""
        logits = self.members_(x)
        loss = F.binary_cross_entropy_with_logits(logits, y)
        optimizer.zero_grad()
        (self.folds * loss).backward()  # type: ignore[no-untyped-call]  # the members share nothing: each gets the gradient of its own mean loss
        optimizer.step()
        self.n_steps_ += 1
        self.average_weights()
        return float(loss.detach())

    def make_optimizer(self) -> torch.optim.Optimizer:
        """AdamW as the last training left it; weights decay, biases and batch normalisation do not."""
        named = list(self.members_.named_parameters())
        groups: list[dict[str, Any]] = [
            {"params": [p for name, p in named if _decays(name, p)]},
            {"params": [p for name, p in named if not _decays(name, p)], "weight_decay": 0.0},
        ]
        optimizer = torch.optim.AdamW(groups, lr=self.learning_rate, weight_decay=self.weight_decay, fused=True)
        if self.optimizer_state_:
            optimizer.load_state_dict(optimizer.state_dict() | {"state": self.optimizer_state_})
        return optimizer

    @torch.no_grad()
    def average_weights(self) -> None:
        """Move the averaged members towards the trained ones, further in the first steps."""
        kept = min(self.weight_averaging, (1 + self.n_steps_) / (10 + self.n_steps_))
        for average, current in zip(self.averaged_members_.parameters(), self.members_.parameters(), strict=True):
            average.lerp_(current, 1.0 - kept)

    @torch.no_grad()
    def estimate_statistics(self, x: Tensor) -> None:
        """Take the statistics of batch normalisation anew for the averaged weights, on traces x (n, C', L)."""
        members = self.averaged_members_.eval()
        norms = [module for module in members.modules() if isinstance(module, nn.BatchNorm1d)]
        for norm in norms:
            norm.reset_running_stats()
            norm.momentum = None  # the mean over all batches
            norm.train()
        rows = np.random.default_rng(len(x)).permutation(len(x))[:STATISTICS]
        for chunk in torch.from_numpy(rows).chunk(-(-len(rows) // CHUNK)):
            members(x[chunk, None].expand(-1, self.folds, -1, -1))
        members.eval()

    def _new_encoder(self) -> Encoder:
        members = fold_batch_norms(copy.deepcopy(self.averaged_members_).eval())
        encoder = Encoder(self.preprocessor_, members, self.n_components)  # type: ignore[arg-type]  # still `Members`
        return encoder.eval().requires_grad_(False)

    @torch.inference_mode()
    def _embed_own(self, x: Tensor, folds: Ints) -> Floats:
        """Preprocessed traces (n, C', L) -> (n, dim), row i in space folds[i]: each member computes its own rows alone."""
        rows = [np.flatnonzero(folds == k) for k in range(self.folds)]
        longest = max(map(len, rows))
        table = np.stack([np.resize(own, longest) if len(own) else np.zeros(longest, np.int64) for own in rows], axis=1)
        points = np.empty((len(x), self.n_components), dtype=np.float32)
        for first in range(0, longest, CHUNK):
            some = torch.from_numpy(table[first : first + CHUNK])  # (B, K)
            embedded = self.encoder_.embed(x[some]).numpy()
            for k, own in enumerate(rows):
                points[own[first : first + CHUNK]] = embedded[: max(0, len(own) - first), k]
        return points

    @torch.inference_mode()
    def embed(self, X: Floats) -> Floats:
        check_is_fitted(self, "encoder_")
        traces = torch.from_numpy(self.check_traces(X))
        chunks = [self.encoder_(traces[i : i + CHUNK]) for i in range(0, max(1, len(traces)), CHUNK)]
        return torch.cat(chunks).numpy()

    def warm_up(self) -> None:
        warm_optimizer()

    def untrained_module(self, X: Floats) -> Encoder | None:
        if "encoder_" in vars(self):
            return self.module()
        new: Self = clone(self)
        new._build(X.shape[1], X.shape[2], averaging(torch.from_numpy(X)))
        return new.module()

    def module(self) -> Encoder | None:
        check_is_fitted(self, "encoder_")
        compiles = can_compile(self.network, self.preprocessor_.channels, self.preprocessor_.samples)
        return self.encoder_ if compiles else None

    @property
    def report(self) -> FitReport:
        check_is_fitted(self, "encoder_")
        note = f"loss {self.loss_:.3f} after {self.n_steps_} steps" if self.n_new_steps_ else ""
        left = f"{self.n_steps_left_} steps to go" if self.n_steps_left_ else ""
        return FitReport(self.n_new_steps_, ", ".join(filter(None, (note, left))), self.n_steps_left_)

    def get_state(self) -> dict[str, NDArray[Any]]:
        check_is_fitted(self, "encoder_")
        numbers = [self.preprocessor_.average, self.seed_, self.n_steps_, self.n_steps_left_, self.n_new_steps_]
        state = {"shape": np.array(self.trace_shape_), "numbers": np.array(numbers), "loss": np.array(self.loss_)}
        modules = {"preprocessor": self.preprocessor_, "members": self.members_, "averaged": self.averaged_members_}
        for prefix, module in modules.items():
            state |= {f"{prefix}.{name}": value.numpy().copy() for name, value in module.state_dict().items()}
        for i, tensors in self.optimizer_state_.items():
            state |= {f"optimizer.{i}.{name}": value.numpy().copy() for name, value in tensors.items()}
        return state

    def set_state(self, state: Mapping[str, NDArray[Any]]) -> Self:
        channels, samples = (int(value) for value in state["shape"])
        average, seed, n_steps, n_steps_left, n_new_steps = (int(value) for value in state["numbers"])
        self.trace_shape_, self.n_features_in_ = (channels, samples), channels * samples
        self._build(channels, samples, average)
        self.seed_ = seed
        self.n_steps_ = n_steps
        self.n_steps_left_ = n_steps_left
        self.n_new_steps_ = n_new_steps
        self.loss_ = float(state["loss"])
        restore(self.preprocessor_, arrays_with_prefix(state, "preprocessor."))
        restore(self.members_, arrays_with_prefix(state, "members."))
        restore(self.averaged_members_, arrays_with_prefix(state, "averaged."))
        for name, value in arrays_with_prefix(state, "optimizer.").items():
            i, key = name.split(".")
            self.optimizer_state_.setdefault(int(i), {})[key] = torch.from_numpy(np.array(value))
        self.encoder_ = self._new_encoder()
        return self

    def check(self) -> None:
        """Raise SettingError for a parameter out of its range."""
        expect(self.n_components in (1, 2), "n_components 1 or 2", self.n_components)
        expect(is_whole(self.folds, 2, 1000), "folds >= 2 where labels are used", self.folds)
        expect(is_whole(self.steps, 1, 10**6), "steps >= 1, an integer", self.steps)
        expect(is_whole(self.fit_steps, 1, 10**6), "fit_steps >= 1, an integer", self.fit_steps)
        expect(is_whole(self.batch_size, 2, 10**6), "batch_size >= 2, an integer", self.batch_size)
        expect(is_whole(self.shift, 0, 10**6), "shift >= 0 frames, an integer", self.shift)
        expect(self.learning_rate > 0.0, "learning_rate > 0", self.learning_rate)
        expect(0.0 <= self.weight_averaging < 1.0, "weight_averaging from 0 to below 1", self.weight_averaging)
        for name in ("weight_decay", "gain", "noise", "mixup"):
            expect(0.0 <= getattr(self, name) < float("inf"), f"{name} >= 0", getattr(self, name))


def draw_batches(folds: Ints, n_folds: int, batch_size: int, steps: int, rng: np.random.Generator) -> Iterator[Tensor]:
    """Draw rows for each step and member, without replacement until all rows of a member were drawn.

    Parameters
    ----------
    folds : array of int, shape (n,)
        Member k gets no row of fold k.
    n_folds, batch_size, steps : int
        K, B and the number of batches. B is smaller where a member has fewer rows.

    Yields
    ------
    Tensor of int64, shape (B, K)
    """
    pools = [np.flatnonzero(folds != k) for k in range(n_folds)]
    smallest = min(map(len, pools))
    if smallest < 2:
        got = f"{smallest} (n_samples = {len(folds)}); all traces may be the same"
        raise SettingError(f"Expected at least 2 traces outside each fold, got {got}. Look at the sensor, or the unit.")
    size = min(batch_size, smallest)
    drawn = np.empty((steps, size, n_folds), dtype=np.int64)
    for k, pool in enumerate(pools):
        rounds = -(-steps * size // len(pool))
        order = np.concatenate([rng.permutation(pool) for _ in range(rounds)])
        drawn[:, :, k] = order[: steps * size].reshape(steps, size)
    yield from torch.from_numpy(drawn)


@cache
def warm_optimizer() -> None:
    """Take a step on one weight: the first step in a process imports a compiler, which takes two seconds."""
    weight = nn.Parameter(torch.zeros(1))
    weight.grad = torch.zeros(1)
    torch.optim.AdamW([weight], fused=True).step()


def save_checkpoint(members: Members, path: str | Path) -> None:
    """Write the weights of a single member as a file of tensors, from which any number can start."""
    expect(members.count == 1, "a single member", members.count)
    content = BytesIO()  # torch's own writer aborts the process on a full disk
    torch.save(members.state_dict(), content)
    write_output(path, content.getvalue(), force=True)


def load_checkpoint(members: Members, path: str | Path) -> None:
    """Start every member from the weights of a checkpoint; only tensors are read, no code.

    Raises
    ------
    SettingError
        If the file cannot be read, or is of another network.
    """
    unreadable = OSError, RuntimeError, ValueError, EOFError, UnpicklingError
    with instead(SettingError, f"The checkpoint {path} cannot be read", *unreadable):
        single = torch.load(path, map_location="cpu", weights_only=True)
    own = members.state_dict()
    sources = {name: SEPARATE.sub(r"\g<1>0.", name) for name in own}
    wanted = {sources[name]: _shape_of_one(name, value, members.count) for name, value in own.items()}
    if not isinstance(single, dict) or {name: value.shape for name, value in single.items()} != wanted:
        raise SettingError(
            f"Expected a checkpoint of this network for traces of this many channels, {path} is of another; "
            "train one with training/train_encoder.py."
        )
    with torch.no_grad():
        for name, value in own.items():
            times = value.shape[0] // single[sources[name]].shape[0] if value.dim() else 1
            value.copy_(torch.cat([single[sources[name]]] * times) if times > 1 else single[sources[name]])


def _shape_of_one(name: str, value: Tensor, count: int) -> torch.Size:
    """The shape that a tensor of all members has where there is a single member."""
    if value.dim() == 0 or SEPARATE.match(name):
        return value.shape
    return torch.Size([value.shape[0] // count, *value.shape[1:]])


def _decays(name: str, parameter: nn.Parameter) -> bool:
    return parameter.dim() > 1 and name.endswith("weight")


def _drawn_seed(random_state: Any) -> int:
    seed = seed_of(random_state)
    return int(np.random.default_rng().integers(2**31)) if seed is None else seed


def _normal(rng: np.random.Generator, *shape: int) -> Tensor:
    return torch.from_numpy(rng.standard_normal(shape, dtype=np.float32))


@lru_cache(maxsize=32)
def can_compile(network: NetworkFactory, channels: int, samples: int) -> bool:
    """Whether TorchScript takes a network; one of a user's own may hold Python that it does not."""
    with torch.random.fork_rng(devices=[]):
        members = Members(network, channels, samples, 2).eval()
    try:
        script(fold_batch_norms(members))
    except Exception as error:
        name = getattr(network, "__qualname__", repr(network))
        reason = str(error).strip().splitlines()[0]
        log.warning("%s cannot be compiled by TorchScript, so it answers in Python and is not exported: %s", name, reason)
        return False
    return True
