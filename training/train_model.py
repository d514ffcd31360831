"""Train a reducer on more and more labels, judge it on the parts that it did not see, and write the decision.

    python training/train_model.py --data insertion --recipe conv --out out/model

A plain loop over amounts of labels: at each the recipe's model is fitted anew, and torchmetrics tells the accuracy, the
area under the ROC curve and the calibration error of its score on the traces that are left. The score is the share of
successes among the radius neighbours in all K spaces, (n_s + 1) / (n_s + n_f + 2). At the end the model is fitted to every
trace. Writes learning.csv, a row an amount of labels, and model.ts with its checksum.
"""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from common import options, tell, wall_time
from torchmetrics import MetricCollection
from torchmetrics.classification import BinaryAccuracy, BinaryAUROC, BinaryCalibrationError

from dengine import Dataset, ModelPrediction, Recipe, export_torchscript, load_dataset

AMOUNTS = (50, 120, 400, 1000)


def learning(data: Dataset, recipe: Recipe, seed: int = 0) -> list[dict[str, Any]]:
    """A row an amount of labels, on one shuffle; at least a fifth of the traces are left to be judged on."""
    order, rows = np.random.default_rng(seed).permutation(len(data)), []
    judges = BinaryAccuracy(), BinaryAUROC(), BinaryCalibrationError()
    metrics = MetricCollection(dict(zip(("accuracy", "AUROC", "calibration error"), judges, strict=True)))
    for n in (n for n in AMOUNTS if n <= 0.8 * len(data)):
        seen, left = order[:n], order[n:]
        model = ModelPrediction.from_recipe(recipe, seed)
        seconds, _ = wall_time(model.fit, data.X[seen], data.y[seen])
        metrics.reset()
        n_success, n_failure = model.count(data.X[left])
        score = (n_success + 1) / (n_success + n_failure + 2)
        metrics.update(torch.from_numpy(score), torch.from_numpy(data.y[left]).int())
        judged = {name: float(value) for name, value in metrics.compute().items()}
        rows.append({"labels": n, "judged on": len(left), **judged, "fit_s": seconds})
    return rows


def main() -> None:
    """Parse, train, print, write."""
    args = options(__doc__, data="insertion", samples=None, recipe="conv", out=Path("out/model")).parse_args()
    data, recipe = load_dataset(args.data, args.samples), Recipe.load(args.recipe)
    args.out.mkdir(parents=True, exist_ok=True)
    tell(learning(data, recipe), f"{args.recipe} on {data.name}", args.out / "learning.csv")
    model = ModelPrediction.from_recipe(recipe).fit(data.X, data.y)
    print(f"Wrote {export_torchscript(model, args.out / 'model.ts', force=True)}")


if __name__ == "__main__":
    main()
