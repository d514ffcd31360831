"""Train the network of `conv` on recorded traces, and write a checkpoint for engines to start from.

    python training/train_encoder.py --data recordings.npz --out out/encoder

The traces are preprocessed as `ConvReducer` does it, a fifth of the parts is held out, and a plain
PyTorch loop trains a single copy. After each epoch the held-out parts are predicted. The weights
of the epoch with the smallest held-out log loss are kept. Writes to --out:

    encoder.pt   the weights, tensors only: ConvReducer(checkpoint="out/encoder/encoder.pt")
    curve.csv    one row per epoch, and curve.png, its picture
    card.md      data, training, figures and limits; other sections of a card stay as they are
"""

import argparse
import copy
import math
import re
import shlex
import sys
import time
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from common import message_for_errors, options
from numpy.typing import NDArray
from rich.progress import Progress
from sklearn.model_selection import GroupShuffleSplit
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812  # PyTorch's own documentation calls it so
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn, update_bn
from torch.utils.data import DataLoader, TensorDataset
from torchmetrics import MeanMetric
from torchmetrics.classification import BinaryAUROC, BinaryCalibrationError

from dengine import ConvReducer, Dataset, load_dataset
from dengine.errors import DataError, OutputError, expect, instead
from dengine.experiments.figures import BLUE, GREY, LIMIT, blank, finish, save
from dengine.experiments.tables import write_csv
from dengine.reducers.checkpoints import save_checkpoint
from dengine.reducers.conv import ConvNetwork
from dengine.reducers.encoder import Members
from dengine.reducers.preprocessing import Preprocessor, averaging
from dengine.reducers.torch_reducer import Augmentation
from dengine.traces import as_traces

Batches = DataLoader[tuple[Tensor, ...]]  # x (B, 1, channels, samples) preprocessed, y (B, 1)

DEFAULTS = ConvReducer()  # batch size, learning rate and augmentation are those of the reducer
SECTION = re.compile(r"## encoder\.pt\n.*?(?=\n## |\Z)", flags=re.S)


@dataclass(frozen=True)
class Epoch:
    """One row of the curve.

    Parameters
    ----------
    epoch : int
        From 1.
    train_loss : float
        Mean loss of the training batches, in nats; with augmentation and dropout.
    log_loss, auroc, calibration_error : float
        Of the averaged weights on the held-out parts.
    seconds : float
        Wall time of the epoch.
    """

    epoch: int
    train_loss: float
    log_loss: float
    auroc: float
    calibration_error: float
    seconds: float


def split_parts(data: Dataset, held_out: float, seed: int) -> tuple[TensorDataset, TensorDataset]:
    """Preprocess the traces and split them into a training and a held-out set.

    Parameters
    ----------
    data : Dataset
        Traces of one part stay together where their parts are known.
    held_out : float
        Share of the parts that is held out.
    seed : int
        Of the split.

    Returns
    -------
    training, held_out : TensorDataset
        Pairs of x (1, channels, samples), a preprocessed trace, and y (1,), its label.

    Raises
    ------
    DataError
        If there are too few parts, if one of the sets has labels of one class only, or for samples
        that are not finite.
    """
    parts = np.arange(len(data)) if data.part is None else data.part
    splitter = GroupShuffleSplit(n_splits=1, test_size=held_out, random_state=seed)
    with instead(DataError, "The parts cannot be split", ValueError):
        training_rows, held_out_rows = next(splitter.split(data.X, groups=parts))
    traces = torch.from_numpy(as_traces(data.X))  # (n, C, T)
    n_damaged = int((~traces.isfinite()).flatten(1).any(1).sum())
    actual = f"{n_damaged} with NaN or infinite ones"
    expect(n_damaged == 0, "traces of finite samples", actual, "leave them out", DataError)
    _, channels, samples = traces.shape
    preprocessor = Preprocessor(channels, samples, averaging(traces[training_rows]))
    preprocessor.learn(traces[training_rows])
    with torch.no_grad():
        x = preprocessor(traces).unsqueeze(1)  # (n, 1, 2 * C, L)
    y = torch.from_numpy(data.y).float().unsqueeze(1)  # (n, 1)
    for rows in (training_rows, held_out_rows):
        check_classes(data.y[rows])
    training = TensorDataset(x[training_rows], y[training_rows])
    return training, TensorDataset(x[held_out_rows], y[held_out_rows])


def check_classes(labels: NDArray[np.int8]) -> None:
    """Raise DataError unless there are labels of both classes."""
    n_success = int(labels.sum())
    if n_success in (0, len(labels)):
        raise DataError(
            f"Expected good and bad parts in the training and the held-out set, got {n_success} "
            f"good of {len(labels)}; record more parts, or change --held-out or --seed."
        )


def train(
    members: Members, training: TensorDataset, held_out: TensorDataset, epochs: int, seed: int
) -> tuple[Members, list[Epoch]]:
    """Train a single copy; return the weights of the best epoch, and a row per epoch.

    Each epoch prints a line.

    Parameters
    ----------
    members : Members
        A single copy; its weights are changed.
    training, held_out : TensorDataset
        As `split_parts` returns them.
    epochs : int
        Passes over the training set.
    seed : int
        Of the batches and the augmentation.

    Returns
    -------
    best : Members
        Averaged weights of the epoch with the smallest held-out log loss.
    curve : list of Epoch
    """
    rng = np.random.default_rng(seed)
    batches: Batches = DataLoader(training, DEFAULTS.batch_size, shuffle=True)
    augmentation = Augmentation(DEFAULTS.shift, DEFAULTS.gain, DEFAULTS.noise, DEFAULTS.mixup)
    optimizer = torch.optim.AdamW(
        members.parameters(),
        lr=DEFAULTS.learning_rate,
        weight_decay=DEFAULTS.weight_decay,
    )
    average = get_ema_multi_avg_fn(DEFAULTS.weight_averaging)  # type: ignore[no-untyped-call]
    averaged = AveragedModel(members, multi_avg_fn=average)
    best = copy.deepcopy(members)
    smallest = math.inf
    curve = []
    with Progress() as progress:
        for epoch in progress.track(range(1, epochs + 1), description="Training"):
            begin = time.perf_counter()
            train_loss = MeanMetric()
            members.train()
            for x, y in batches:
                x, y = augmentation(x, y, rng)
                logits = members(x)  # (B, 1)
                loss = F.binary_cross_entropy_with_logits(logits, y)
                optimizer.zero_grad()
                loss.backward()  # type: ignore[no-untyped-call]
                optimizer.step()
                averaged.update_parameters(members)
                train_loss.update(loss.detach(), weight=len(x))
            update_bn(batches, averaged)  # the statistics that fit the averaged weights
            metrics = evaluate(averaged, DataLoader(held_out, batch_size=256))
            seconds = time.perf_counter() - begin
            row = Epoch(epoch, float(train_loss.compute()), **metrics, seconds=seconds)
            curve.append(row)
            progress.console.print(
                f"epoch {epoch:3}  training loss {row.train_loss:.3f}  "
                f"held out: log loss {row.log_loss:.3f}, AUROC {row.auroc:.3f}"
            )
            if row.log_loss < smallest:
                smallest = row.log_loss
                best.load_state_dict(averaged.module.state_dict())
    return best, curve


@torch.inference_mode()
def evaluate(network: nn.Module, batches: Batches) -> dict[str, float]:
    """Predict batches; return log loss, AUROC and calibration error by name.

    The network is in evaluation mode afterwards.
    """
    log_loss = MeanMetric()
    auroc = BinaryAUROC()
    calibration_error = BinaryCalibrationError()
    network.eval()
    for x, y in batches:
        logits = network(x)
        log_loss.update(F.binary_cross_entropy_with_logits(logits, y, reduction="none"))
        auroc.update(logits.sigmoid(), y.int())
        calibration_error.update(logits.sigmoid(), y.int())
    metrics = {"log_loss": log_loss, "auroc": auroc, "calibration_error": calibration_error}
    return {name: float(metric.compute()) for name, metric in metrics.items()}


def base_rate_loss(training: TensorDataset, held_out: TensorDataset) -> float:
    """Held-out log loss of a prediction that is the training set's share of good parts."""
    rate = training.tensors[1].mean()
    labels = held_out.tensors[1]
    return float(F.binary_cross_entropy(rate.expand_as(labels), labels))


def draw_curve(curve: list[Epoch], base_rate: float, path: Path) -> None:
    """Draw log loss, AUROC and calibration error against the epoch."""
    columns = {field.name: [getattr(row, field.name) for row in curve] for field in fields(Epoch)}
    epochs = columns["epoch"]
    figure = blank(10.0, 3.2)
    left, middle, right = figure.subplots(1, 3)
    left.plot(epochs, columns["train_loss"], "--", color=GREY, marker=".", label="training")
    left.plot(epochs, columns["log_loss"], color=BLUE, marker=".", label="held out")
    left.axhline(base_rate, **LIMIT, label="base rate")
    finish(left, legend=0, xlabel="epoch", ylabel="log loss [nats]", ylim=(0.0, None))
    left.legend(frameon=False, loc="best")
    middle.plot(epochs, columns["auroc"], color=BLUE, marker=".")
    finish(middle, legend=0, xlabel="epoch", ylabel="AUROC, held out")
    right.plot(epochs, columns["calibration_error"], color=BLUE, marker=".")
    finish(right, legend=0, xlabel="epoch", ylabel="calibration error, held out", ylim=(0.0, None))
    for axes in (left, middle, right):
        axes.xaxis.get_major_locator().set_params(integer=True)
    save(figure, path, force=True)


CARD = """## encoder.pt

The weights of the network of `conv`. An engine has five copies of this network, which can start
from these weights.

    {command}

**Data.** {data}

**Training.** A single `ConvNetwork` of {n_weights:,} weights: {epochs} epochs of AdamW on
augmented batches of {batch_size} traces, {seconds:.0f} s on the CPU. The file holds the averaged
weights of epoch {epoch}, whose held-out log loss was the smallest.

| on the held-out parts | |
| --- | --- |
| log loss | {log_loss:.3f} nats |
| log loss of the base rate | {base_rate:.3f} nats |
| AUROC | {auroc:.3f} |
| calibration error | {calibration_error:.3f} |

The epoch was chosen on the same parts, so the figures are a little better than those of new parts.
`curve.csv` has a row per epoch.

![Log loss, AUROC and calibration error of each epoch](curve.png)

**Use.** In another cell, for traces of {channels}:

    DataEngine(reducer=ConvReducer(checkpoint="{checkpoint}"))

**Limits.** Do not use this file to judge an engine on `{name}`, and do not import the labels of
`{name}` into an engine that starts from it. The weights were trained on these labels. An engine
that counts them is more certain than the evidence allows. The file does not contain the scales of
the signals: each engine learns them from its own traces.
"""


def write_card(path: Path, section: str) -> None:
    """Write a section into a card in the place of an earlier one; other sections stay."""
    text = path.read_text(encoding="utf-8") if path.is_file() else "# An encoder of traces\n"
    text, n_replaced = SECTION.subn(lambda _: section, text)
    if not n_replaced:
        text = f"{text}\n{section}"
    path.write_text(text, encoding="utf-8")


def parse_arguments() -> argparse.Namespace:
    """Parse the command line."""
    parser = options(__doc__, data="insertion", samples=None, out=Path("out/encoder"))
    parser.add_argument("--epochs", type=int, default=40, help="passes over the training set")
    parser.add_argument("--seed", type=int, default=0, help="of the split, weights and batches")
    parser.add_argument("--held-out", type=float, default=0.2, help="share of parts held out")
    arguments = parser.parse_args()
    if arguments.epochs < 1:
        parser.error(f"expected --epochs of at least 1, got {arguments.epochs}")
    if not 0.0 < arguments.held_out < 1.0:
        parser.error(f"expected --held-out between 0 and 1, got {arguments.held_out}")
    if not 0 <= arguments.seed < 2**32:
        parser.error(f"expected --seed from 0 to 2**32 - 1, got {arguments.seed}")
    return arguments


def main() -> None:
    """Train on a data set; write checkpoint, curve and card."""
    arguments = parse_arguments()
    data = load_dataset(arguments.data, samples=arguments.samples)
    training, held_out = split_parts(data, arguments.held_out, arguments.seed)
    torch.manual_seed(arguments.seed)
    _, _, channels, samples = training.tensors[0].shape
    members = Members(ConvNetwork, channels, samples, count=1)
    best, curve = train(members, training, held_out, arguments.epochs, arguments.seed)
    chosen = min(curve, key=lambda row: row.log_loss)
    base_rate = base_rate_loss(training, held_out)
    with instead(OutputError, f"Cannot make the folder {arguments.out}", OSError):
        arguments.out.mkdir(parents=True, exist_ok=True)
    checkpoint = arguments.out / "encoder.pt"
    save_checkpoint(best, checkpoint)
    write_csv(pd.DataFrame([asdict(row) for row in curve]), arguments.out / "curve.csv", force=True)
    draw_curve(curve, base_rate, arguments.out / "curve.png")
    figures = asdict(chosen) | {"seconds": sum(row.seconds for row in curve)}
    section = CARD.format(
        **figures,
        command=shlex.join(["python", "training/train_encoder.py", *sys.argv[1:]]),
        data=describe_data(data, len(held_out)),
        name=data.name,
        channels=describe_channels(data),
        checkpoint=checkpoint.as_posix(),
        n_weights=sum(weight.numel() for weight in best.parameters()),
        epochs=arguments.epochs,
        batch_size=DEFAULTS.batch_size,
        base_rate=base_rate,
    )
    write_card(arguments.out / "card.md", section)
    print(
        f"Wrote {checkpoint}: epoch {chosen.epoch}, held-out log loss {chosen.log_loss:.3f}, "
        f"{base_rate:.3f} by the base rate, AUROC {chosen.auroc:.3f}."
    )


def describe_channels(data: Dataset) -> str:
    """Describe how many channels the traces of a data set have."""
    n_channels = data.spec.channels
    return "one channel" if n_channels == 1 else f"{n_channels} channels"


def describe_data(data: Dataset, n_held_out: int) -> str:
    """Describe a data set and its split in two sentences."""
    n_success = int(data.y.sum())
    rate = "an unknown rate" if data.rate_hz is None else f"{data.rate_hz:g} Hz"
    unit = data.unit or "an unknown unit"
    return (
        f"`{data.name}`: {len(data)} traces of {describe_channels(data)} and {data.spec.samples} "
        f"samples at\n{rate} in {unit}; {n_success} good and "
        f"{len(data) - n_success} bad parts. {n_held_out} traces were held out."
    )


if __name__ == "__main__":
    with message_for_errors():
        main()
