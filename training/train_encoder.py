"""Train the conv encoder on a labelled data set, step by step, and watch it on labels that each head never saw.

    python training/train_encoder.py --data insertion --out models/conv

A plain loop: one step of every head at a time, then torchmetrics over the out-of-fold scores (row i by the head that was
trained without fold i). Writes model.ts with its checksum, and card.md, to --out.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.table import Table
from torchmetrics import MetricCollection
from torchmetrics.classification import BinaryAccuracy, BinaryAUROC, BinaryCalibrationError

from dengine import Dataset, ModelPrediction, Recipe, export_torchscript, load_dataset
from dengine.cli.output import duration
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


def card(data: Dataset, recipe: Recipe, history: list[dict[str, float]], seconds: float) -> str:
    """What model.ts is, how it was made and how well it scores."""
    last = history[-1]
    figures = "\n".join(f"| {name} | {value:.4f} |" for name, value in last.items() if name not in ("step", "seconds"))
    return f"""# conv, trained on `{data.name}`

The whole decision, raw trace to action, as TorchScript: {len(data)} references, recipe `models/recipes/conv.toml`, alpha
{recipe.policy.alpha:g}, LB {recipe.policy.lower_bound:g}. Trained from nothing in {seconds:.2f} s, all steps.

    python training/train_encoder.py --data {data.name} --out models/conv

| held out (row by the head that never saw its fold) | |
| --- | --- |
{figures}

It decides on traces like those of `{data.name}` and on nothing else; see that set's card for what they are. Load it with
`dengine.load_exported("models/conv/model.ts")`, which checks model.ts.sha256 first. Integrity, not authenticity.
"""


def main() -> None:
    """Parse, train, show, save."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", default="insertion", help="a bundled set, or an .npz file with X and y")
    parser.add_argument("--samples", type=int, help="use the first so many samples of each trace; all by default")
    parser.add_argument("--recipe", default="conv", help="a recipe's name or TOML file, of conv or rocket")
    parser.add_argument("--steps", type=int, default=15, help="optimiser steps of every head, at most")
    parser.add_argument("--seed", type=int, default=0, help="of the encoder, an integer")
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
    export_torchscript(model, args.out / "model.ts")
    text = card(data, recipe, history, sum(row["seconds"] for row in history))
    (args.out / "card.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
