"""Train a reducer on more and more labels, evaluate it on the other parts, and export the model.

    python training/train_model.py --data insertion --recipe conv --out out/model

For each number of labels the recipe's model is fitted anew. torchmetrics computes accuracy, area
under the ROC curve and calibration error of its score on the other traces. The score is the share
of successes among the radius neighbours in all K spaces, (n_s + 1) / (n_s + n_f + 2). At the end
the model is fitted to every trace. Writes learning.csv, a row per number of labels, and model.ts
with its checksum.
"""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from common import options, print_table, wall_time
from torchmetrics import MetricCollection
from torchmetrics.classification import BinaryAccuracy, BinaryAUROC, BinaryCalibrationError

from dengine import Dataset, ModelPrediction, Recipe, export_torchscript, load_dataset

N_LABELS = (50, 120, 400, 1000)


def learning(data: Dataset, recipe: Recipe, seed: int = 0) -> list[dict[str, Any]]:
    """Return a row per number of labels, on one shuffle of the traces.

    At least a fifth of the traces is left to evaluate on.
    """
    order = np.random.default_rng(seed).permutation(len(data))
    rows = []
    metrics = MetricCollection(
        {
            "accuracy": BinaryAccuracy(),
            "AUROC": BinaryAUROC(),
            "calibration error": BinaryCalibrationError(),
        }
    )
    for n in (n for n in N_LABELS if n <= 0.8 * len(data)):
        training = order[:n]
        held_out = order[n:]
        model = ModelPrediction.from_recipe(recipe, seed)
        seconds, _ = wall_time(model.fit, data.X[training], data.y[training])
        metrics.reset()
        n_success, n_failure = model.count(data.X[held_out])
        score = (n_success + 1) / (n_success + n_failure + 2)
        metrics.update(torch.from_numpy(score), torch.from_numpy(data.y[held_out]).int())
        values = {name: float(value) for name, value in metrics.compute().items()}
        rows.append({"labels": n, "judged on": len(held_out), **values, "fit_s": seconds})
    return rows


def main() -> None:
    """Parse the command line, train, print the table and write the files."""
    out = Path("out/model")
    args = options(__doc__, data="insertion", samples=None, recipe="conv", out=out).parse_args()
    data = load_dataset(args.data, samples=args.samples)
    recipe = Recipe.load(args.recipe)
    args.out.mkdir(parents=True, exist_ok=True)
    print_table(learning(data, recipe), f"{args.recipe} on {data.name}", args.out / "learning.csv")
    model = ModelPrediction.from_recipe(recipe).fit(data.X, data.y)
    print(f"Wrote {export_torchscript(model, args.out / 'model.ts', force=True)}")


if __name__ == "__main__":
    main()
