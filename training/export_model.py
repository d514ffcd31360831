"""Train a reducer on labelled traces and write the decision as one file for the cell controller.

python training/export_model.py --data insertion --reducer conv --out model.ts
python training/export_model.py --store engine.db --out model.onnx --format onnx
"""

from __future__ import annotations

import argparse
from pathlib import Path

from dengine import DataEngine, Recipe, export_torchscript, load_dataset
from dengine.cli.output import size
from dengine.datasets.importing import import_labelled, train_until_done
from dengine.export import sum_file
from dengine.export.onnx import export_onnx
from dengine.store import MemoryStore

FORMATS = {"torchscript": export_torchscript, "onnx": export_onnx}


def trained(data: str, recipe: Recipe, retrains: int) -> DataEngine:
    """An engine in memory that was trained on every trace of a data set."""
    store = MemoryStore()
    import_labelled(store, load_dataset(data), recipe)
    engine = DataEngine.open(store)
    train_until_done(engine, retrains)
    return engine


def main() -> None:
    """Parse, export, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", default="insertion", help="a bundled set, or an .npz file with X and y")
    parser.add_argument("--store", help="a trained engine's store, instead of --data")
    parser.add_argument("--reducer", default="conv", help="a recipe's name or TOML file")
    parser.add_argument("--retrains", type=int, default=10, help="at most, each within the recipe's budget")
    parser.add_argument("--format", choices=FORMATS, default="torchscript", help="onnx only decides")
    parser.add_argument("--out", type=Path, default=Path("model.ts"), help="the file; its .sha256 beside it")
    args = parser.parse_args()
    recipe = Recipe.load(args.reducer)
    with DataEngine.open(args.store) if args.store else trained(args.data, recipe, args.retrains) as engine:
        path = FORMATS[args.format](engine, args.out)
        about = f"{size(path.stat().st_size)}, {len(engine.model.index)} labelled references"
        print(f"Wrote {path} ({about}) and {sum_file(path).name}.")


if __name__ == "__main__":
    main()
