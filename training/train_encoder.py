"""Train the conv encoder without labels on any recordings, watch it on traces it never saw, and save what it learned.

    python training/train_encoder.py --data insertion --out models/conv
    python training/train_encoder.py --simulate 400 --weights models/encoder/encoder.npz --out out/encoder

A plain loop over the engine's own training: VICReg on seven traces of eight, its loss on the eighth, and at a few
checkpoints what the features are good for, by torchmetrics over the scores of heads that were fitted without the trace's
fold. Labels are read there, and never by the encoder. Writes training.png, card.md, and model.ts with its checksum.
"""

from __future__ import annotations

import shlex
import sys
import time
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
import torch
from common import options, span
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from torchmetrics import MetricCollection
from torchmetrics.classification import BinaryAccuracy, BinaryAUROC, BinaryCalibrationError

from dengine import Dataset, ModelPrediction, Recipe, Replay, export_torchscript, load_dataset
from dengine.cli.output import duration
from dengine.datasets import make_dataset
from dengine.errors import SettingError
from dengine.experiments.figures import BLACK, BLUE, GREEN, ORANGE, PINK, RED, SKY, TRUTH_MARKS, legend_above, plain, save
from dengine.experiments.grid import run_replays
from dengine.experiments.metrics import pooled_error
from dengine.folds import content_hash, fold_of, own_hash
from dengine.reducers.base import StopRule, own_places
from dengine.reducers.conv import HELD_OUT, ConvReducer
from dengine.reducers.encoder import principal_axes, weights_of
from dengine.reducers.heads import in_chunks
from dengine.reducers.training import EncoderTraining
from dengine.traces import as_traces

RUN = 30  # steps between two looks at the loss
CHECKPOINTS = 5  # looks at what the features are good for, after the first: each fits the heads
CELL_SEED = 77  # another one than the bundled set and a cell by default: their parts stay unseen
PALE = "#C8C8C8"  # of good parts where causes of failure are told apart
Row = dict[str, float]
Floats = NDArray[np.float32]


def simulated(n: int) -> Dataset:
    """The first n insertions of each scenario of the simulated cell."""
    from dengine.cells.simulation.conditions import RATE_HZ, SCENARIOS
    from dengine.cells.simulation.generate import simulate

    each = [simulate(n, CELL_SEED, name) for name in SCENARIOS]
    X, y, cause = (np.concatenate([getattr(one, name) for one in each]) for name in ("X", "y", "cause"))
    return make_dataset(X, y, cause=cause, rate_hz=RATE_HZ, name=f"simulated, {n} of each of {', '.join(SCENARIOS)}")


def train(model: ModelPrediction, data: Dataset, steps: int) -> tuple[list[Row], list[Floats]]:
    """Train the encoder for so many steps; a row of figures a run, and the features (n, P) before and after."""
    X, y = as_traces(data.X), data.y.astype(np.int64)
    parts = content_hash(X)
    if data.part is not None:
        parts = np.array([own_hash(int(content), part) for content, part in zip(parts, data.part, strict=True)])
    model.train(X, y, hashes=parts)
    model.improve(X, parts, StopRule(max_steps=0))  # no step yet: what the untrained encoder does
    training = encoder_training(model)
    ends = sorted({*range(RUN, steps, RUN), steps})
    looks = {ends[round(i)] for i in np.linspace(0, len(ends) - 1, CHECKPOINTS + 1)[1:]}
    history = [{"step": 0, "seconds": 0.0} | losses(training, X, parts) | worth(model, X, y, parts)]
    features = [features_of(model, X)]
    for end in ends:
        begin = time.perf_counter()
        model.improve(X, parts, StopRule(max_steps=end - training.steps))
        row = {"step": end, "seconds": history[-1]["seconds"] + time.perf_counter() - begin} | losses(training, X, parts)
        if end in looks:
            model.train(X, y, hashes=parts)  # the encoder is released, then the heads are fitted
            row |= worth(model, X, y, parts)
        history.append(row)
    return history, [*features, features_of(model, X)]


def encoder_training(model: ModelPrediction) -> EncoderTraining:
    """Where the model's encoder is trained; SettingError for a recipe that has none."""
    if not isinstance(model.spaces, ConvReducer) or model.spaces.training_ is None:
        raise SettingError("Expected a recipe with an encoder to train, conv; see models/recipes/conv.toml.")
    return model.spaces.training_


def losses(training: EncoderTraining, X: Floats, parts: NDArray[np.int64]) -> Row:
    """VICReg's loss on traces that train the encoder and on as many held out, distorted alike; NaN for fewer than 2."""
    apart = np.flatnonzero(parts % HELD_OUT == 0)
    found = {}
    for name, rows in {"training loss": np.flatnonzero(parts % HELD_OUT)[: len(apart)], "held-out loss": apart}.items():
        with torch.no_grad():
            averaged, alike = training.encoder.averaged(torch.from_numpy(X[rows])), torch.Generator().manual_seed(0)
            if len(rows) > 1:
                everywhere = training.encoder.thinned(0, 1)
                loss = training.learner.loss(averaged, training.augmentations, alike, everywhere)
        found[name] = float(loss) if len(rows) > 1 else float("nan")
    return found


def worth(model: ModelPrediction, X: Floats, y: NDArray[np.int64], parts: NDArray[np.int64]) -> Row:
    """What the features are good for: neighbours of one label, and heads asked about the fold that they never saw."""
    metrics = MetricCollection(
        {"accuracy": BinaryAccuracy(), "auroc": BinaryAUROC(), "calibration error": BinaryCalibrationError()}
    )
    own = own_places(model.spaces.embed(X), fold_of(parts, model.n_spaces))
    metrics.update(torch.from_numpy(own[:, 0].copy()), torch.from_numpy(y))  # (n,) P(success), out of fold
    found = {name: float(value) for name, value in metrics.compute().items()}
    agree = {"neighbours agree": neighbour_agreement(features_of(model, X), y), "log loss": model.report.holdout_loss}
    return agree | found | {"refused": float("kept the earlier encoder" in model.report.note)}


def features_of(model: ModelPrediction, X: Floats) -> Floats:
    """(n, C, T) -> (n, P): what the encoder gives to the heads."""
    with torch.no_grad():
        return np.asarray(in_chunks(model.spaces.net_.features, torch.from_numpy(X)).numpy())


def neighbour_agreement(features: Floats, y: NDArray[np.int64]) -> float:
    """Share of the traces whose nearest other one in (n, P) features has the same label."""
    distance = torch.cdist(torch.from_numpy(features), torch.from_numpy(features)).fill_diagonal_(float("inf"))
    return float((y[distance.argmin(1).numpy()] == y).mean())


def picture(history: list[Row], features: list[Floats], data: Dataset) -> Figure:
    """Loss and worth over the steps; below, where the traces lie before and after, by label and by cause."""
    figure = Figure(figsize=(13.0, 9.0), layout="constrained")
    axes = figure.subplot_mosaic("LLAA;BBGG" if data.cause is None else "LLLAAA;BBGGCC", height_ratios=(2, 3))
    for each in axes.values():
        plain(each)
    draw_line(axes["L"], history, "training loss", "traces that train it", ORANGE)
    draw_line(axes["L"], history, "held-out loss", "traces held out", GREEN)
    draw_line(axes["A"], history, "neighbours agree", "nearest neighbour alike", BLUE, 100.0)
    draw_line(axes["A"], history, "accuracy", "heads right, out of fold", PINK, 100.0)
    axes["L"].set(ylabel="VICReg loss", xlabel="label-free steps")
    axes["A"].set(
        ylabel="share of the traces [%]", xlabel="label-free steps", ylim=(min(90.0, axes["A"].get_ylim()[0]), 100)
    )
    before, after = (principal_plane(each) for each in features)
    after *= np.sign((before * after).sum(0))  # an axis has no direction: the one that it had before
    truth = {mark.name: (data.y == good, mark.colour, mark.marker) for good, mark in TRUTH_MARKS.items()}
    draw_map(axes["B"], before, truth, "before training")
    draw_map(axes["G"], after, truth, f"after {history[-1]['step']:.0f} steps")
    if data.cause is not None:
        looks = zip(cycle((BLACK, RED, GREEN, PINK, BLUE, ORANGE, SKY)), cycle("oX^sDvP*"), strict=False)
        groups: dict[str, Any] = {"good": (data.y == 1, PALE, "o")}
        for name, look in zip(sorted(set(data.cause[data.y == 0])), looks, strict=False):
            groups[name.replace("_", " ")] = ((data.cause == name) & (data.y == 0), *look)
        draw_map(axes["C"], after, groups, "the same, by cause of failure")
    figure.suptitle(f"The encoder, trained without labels on {data.name}")
    return figure


def draw_line(axes: Axes, history: list[Row], name: str, label: str, colour: str, factor: float = 1.0) -> None:
    """One column over the steps, where it was looked at."""
    seen = [(row["step"], factor * row[name]) for row in history if name in row]
    axes.plot(*zip(*seen, strict=True), ".-", color=colour, label=f"{label}: {seen[0][1]:.3g} to {seen[-1][1]:.3g}")
    legend_above(axes)


def principal_plane(features: Floats) -> Floats:
    """(n, P) -> (n, 2): along their two principal axes."""
    g = torch.from_numpy(features)
    return np.asarray(((g - g.mean(0)) @ principal_axes(g, 2)).numpy())


def draw_map(axes: Axes, z: Floats, groups: dict[str, Any], title: str) -> None:
    """Points (n, 2), each group in its colour and marker."""
    look: dict[str, Any] = {"s": 16, "alpha": 0.7, "linewidths": 0}
    for name, (rows, colour, marker) in groups.items():
        axes.scatter(z[rows, 0], z[rows, 1], color=colour, marker=marker, label=f"{name} ({rows.sum()})", **look)
    axes.set(xlabel=f"principal axis 1 of the features\n{title}", ylabel="principal axis 2")
    legend_above(axes, 2)


def card(data: Dataset, recipe: Recipe, history: list[Row], replays: list[Replay], command: str) -> str:
    """What model.ts is: its data, its recipe, how it was made, how well it scores, and what it is not for."""
    first, last, policy = history[0], history[-1], recipe.policy
    names = [name for name in last if name not in ("step", "seconds", "refused")]
    figures = "\n".join(f"| {name} | {first[name]:.4g} | {last[name]:.4g} |" for name in names)
    looked = [row["refused"] for row in history[1:] if "refused" in row]
    seeds = f"{replays[0].seed} to {replays[-1].seed}"
    shape = " x ".join(str(n) for n in data.X.shape[1:])
    more = "More" if last["neighbours agree"] > first["neighbours agree"] else "No more"
    better = "no worse" if last["log loss"] <= first["log loss"] else "no better"
    return f"""# {recipe.name}, trained on `{data.name}`

The whole decision, raw trace to action, as one TorchScript file: input checks, novelty, encoder, {len(data)} references,
counting, interval and rule.

    {command}

**Data.** `{data.name}`: {len(data)} traces of {shape} samples at {data.rate_hz:g} Hz in {data.unit};
{int(data.y.sum())} good and {int((data.y == 0).sum())} bad parts.

**Recipe.** `{recipe.name}` as it is (`models/recipes/`), alpha {policy.alpha:g}, LB {policy.lower_bound:g}, guarantee
{policy.guarantee}.

**The encoder.** {last["step"]:.0f} steps without labels in {last["seconds"]:.0f} s, from the closed form;
looked at {len(looked)} times, and refused {sum(looked):.0f} times for doing worse on the traces held out.

| | before | after |
| --- | --- | --- |
{figures}

The losses are VICReg's, on traces that trained the encoder and on as many that never did. `neighbours agree` is the share
of the traces whose nearest other one, in the encoder's features, has the same label. The rest is of the heads: every trace
by the one that never saw its fold. {more} neighbours agree after it, and the heads, with all labels at hand, do {better}.

![Loss, agreement and the embedding](training.png)

**Measured: the decisions.** What fresh engines made of the same traces, shuffled, learning as they went, the encoder
too (seeds {seeds}, means a replay; wrong ones of all together, with the 95 % interval for other parts of this kind). The
file itself was trained on all of them, so it cannot be measured on them.

| | |
| --- | --- |
| certain of {len(replays[0])} | {np.mean([r.summary()["certain"] for r in replays]):.0f} |
| bad among the accepted | {said(replays, "accepted")} |
| good among the rejected | {said(replays, "rejected")} |

**Limits.** It decides on traces like those of `{data.name}`, verifies what is unlike them, and knows nothing of another
part, tool or sensor: for those, train on your own. A lower loss without labels is no promise of better decisions: the
encoder learns what two views of a trace have in common, whether or not it is what makes a part good. Nothing in the file
watches whether the world has changed but novelty; an engine that goes on learning does. Its checksum guards against damage
and not against an adversary: load it with `dengine.load_exported`, which checks model.ts.sha256 first.
"""


def said(replays: list[Replay], side: str) -> str:
    """A pooled share of wrong ones, in words."""
    error = pooled_error(replays, side)
    if not error.decided:
        return "none were"
    return f"{100 * error.rate:.1f} % of {error.decided} ({100 * error.lower:.1f} to {100 * error.upper:.1f} %)"


def table_of(history: list[Row], title: str) -> Table:
    """A line a run; empty where it was not looked at."""
    table = Table(*history[0], title=title)
    for row in history:
        told = {name: duration(row[name]) if name == "seconds" else f"{row[name]:.4g}" for name in row}
        table.add_row(*(told.get(name, "") for name in history[0]))
    return table


def main() -> None:
    """Parse, train, show, save."""
    parser = options(__doc__, data="insertion", samples=None, recipe="conv", out=Path("models/conv"))
    parser.add_argument("--simulate", type=int, help="instead of --data: so many simulated insertions of each scenario")
    parser.add_argument("--steps", type=int, default=600, help="label-free steps of the encoder")
    parser.add_argument("--seed", type=int, default=0, help="of the encoder, an integer")
    parser.add_argument("--replays", type=span, default="100:104", help="first:last seed of the replays of the card")
    parser.add_argument("--weights", type=Path, help="also write what the encoder learned, an .npz for `start` of conv")
    args = parser.parse_args()
    data = simulated(args.simulate) if args.simulate else load_dataset(args.data, args.samples)
    recipe = Recipe.load(args.recipe)
    model = ModelPrediction.from_recipe(recipe, args.seed)
    history, features = train(model, data, args.steps)
    Console(width=150).print(table_of(history, f"{args.recipe} on {data.name}"))
    save(picture(history, features, data), args.out / "training.png", dpi=80, force=True)
    export_torchscript(model, args.out / "model.ts", trace=data.spec)
    if args.weights is not None:
        learned: dict[str, Any] = weights_of(model.spaces.net_.features)
        args.weights.parent.mkdir(parents=True, exist_ok=True)
        np.savez(args.weights, **learned)
    replays = run_replays(data, [recipe], args.replays, n_jobs=-1)
    command = shlex.join(["python", "training/train_encoder.py", *sys.argv[1:]])
    (args.out / "card.md").write_text(card(data, recipe, history, replays, command), encoding="utf-8")


if __name__ == "__main__":
    main()
