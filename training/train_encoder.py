"""Train the conv encoder on a labelled data set, step by step, and watch it on labels that each head never saw.

    python training/train_encoder.py --data insertion --out models/conv

A plain loop: one step of every head at a time, then torchmetrics over the out-of-fold scores (row i by the head that was
trained without fold i). Writes model.ts with its checksum, and card.md, to --out.
"""

from __future__ import annotations

import argparse
import shlex
import sys
import time
from pathlib import Path

import numpy as np
import torch
from compare_reducers import span
from rich.console import Console
from rich.table import Table
from torchmetrics import MetricCollection
from torchmetrics.classification import BinaryAccuracy, BinaryAUROC, BinaryCalibrationError

from dengine import Dataset, ModelPrediction, Recipe, Replay, export_torchscript, load_dataset
from dengine.cli.output import duration
from dengine.experiments.grid import run_replays
from dengine.experiments.rates import pooled_error
from dengine.folds import content_fold
from dengine.reducers.base import StopRule
from dengine.traces import as_traces


def train(model: ModelPrediction, data: Dataset, steps: int) -> list[dict[str, float]]:
    """Fit one step at a time, warm from the last; a row of held-out figures a step."""
    X, y = as_traces(data.X), data.y.astype(np.int64)
    folds = content_fold(X, model.n_spaces)
    metrics = MetricCollection(
        {"accuracy": BinaryAccuracy(), "auroc": BinaryAUROC(), "calibration_error": BinaryCalibrationError()}
    )
    history = []
    for step in range(steps):
        begin = time.perf_counter()
        model.train(X, y, stop=StopRule(max_steps=1))
        seconds = time.perf_counter() - begin
        scores = torch.from_numpy(model.spaces.embed_own(X, folds)[:, 0].copy())  # (n,) P(success), out of fold
        metrics.reset()
        metrics.update(scores, torch.from_numpy(y))
        row = {name: float(value) for name, value in metrics.compute().items()}
        history.append({"step": step + 1, "seconds": seconds, "held-out loss": model.report.holdout_loss, **row})
        if model.report.n_steps == 0:
            break
    return history


def card(data: Dataset, recipe: Recipe, history: list[dict[str, float]], replays: list[Replay], command: str) -> str:
    """What model.ts is: its data, its recipe, how it was made, how well it scores, and what it is not for."""
    last, seconds, policy = history[-1], sum(row["seconds"] for row in history), recipe.policy
    figures = "\n".join(f"| {name} | {value:.4f} |" for name, value in last.items() if name not in ("step", "seconds"))
    seeds = f"{replays[0].seed} to {replays[-1].seed}"
    shape = " x ".join(str(n) for n in data.X.shape[1:])
    return f"""# {recipe.name}, trained on `{data.name}`

The whole decision, raw trace to action, as one TorchScript file: input checks, novelty, encoder, {len(data)} references,
counting, interval and rule.

    {command}

**Data.** `{data.name}`: {len(data)} traces of {shape} samples at {data.rate_hz:g} Hz in {data.unit};
{int(data.y.sum())} good and {int((data.y == 0).sum())} bad parts.

**Recipe.** `{recipe.name}` as it is (`models/recipes/`), alpha {policy.alpha:g}, LB {policy.lower_bound:g}, guarantee
{policy.guarantee}. Trained from nothing in {seconds:.2f} s, all steps.

**Measured: the scores.** Every trace by the head that never saw its fold.

| held out | |
| --- | --- |
{figures}

**Measured: the decisions.** What fresh engines made of the same traces, shuffled, learning as they went (seeds {seeds},
means a replay; wrong ones of all together, with the 95 % interval for other parts of this kind). The file itself was
trained on all of them, so it cannot be measured on them.

| | |
| --- | --- |
| certain of {len(replays[0])} | {np.mean([r.summary()["certain"] for r in replays]):.0f} |
| bad among the accepted | {said(replays, "accepted")} |
| good among the rejected | {said(replays, "rejected")} |

**Limits.** It decides on traces like those of `{data.name}`, verifies what is unlike them, and knows nothing of another
part, tool or sensor: for those, train on your own. Nothing in it watches whether the world has changed but novelty; an
engine that goes on learning does. Its checksum guards against damage and not against an adversary: load it with
`dengine.load_exported`, which checks model.ts.sha256 first.
"""


def said(replays: list[Replay], side: str) -> str:
    """A pooled share of wrong ones, in words."""
    error = pooled_error(replays, side)
    if not error.decided:
        return "none were"
    return f"{100 * error.rate:.1f} % of {error.decided} ({100 * error.lower:.1f} to {100 * error.upper:.1f} %)"


def main() -> None:
    """Parse, train, show, save."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", default="insertion", help="a bundled set, or an .npz file with X and y")
    parser.add_argument("--samples", type=int, help="use the first so many samples of each trace; all by default")
    parser.add_argument("--recipe", default="conv", help="a recipe's name or TOML file, of conv or rocket")
    parser.add_argument("--steps", type=int, default=15, help="optimiser steps of every head, at most")
    parser.add_argument("--seed", type=int, default=0, help="of the encoder, an integer")
    parser.add_argument(
        "--replays", type=span, default="100:110", help="first:last seed of the replays that the card tells of"
    )
    parser.add_argument("--out", type=Path, default=Path("models/conv"), help="folder for model.ts and card.md")
    args = parser.parse_args()
    data, recipe = load_dataset(args.data, args.samples), Recipe.load(args.recipe)
    model = ModelPrediction.from_recipe(recipe, args.seed)
    history = train(model, data, args.steps)
    table = Table(*history[0], title=f"{args.recipe} on {data.name}: held-out figures, step by step")
    for row in history:
        table.add_row(*(duration(value) if name == "seconds" else f"{value:.4g}" for name, value in row.items()))
    Console().print(table)
    args.out.mkdir(parents=True, exist_ok=True)
    export_torchscript(model, args.out / "model.ts", trace=data.spec)
    replays = run_replays(data, [recipe], args.replays, n_jobs=-1)
    command = shlex.join(["python", "training/train_encoder.py", *sys.argv[1:]])
    (args.out / "card.md").write_text(card(data, recipe, history, replays, command), encoding="utf-8")


if __name__ == "__main__":
    main()
