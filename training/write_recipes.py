"""Write models/recipes/NAME.toml from the defaults in the code; a test keeps the two equal.

python training/write_recipes.py
"""

from __future__ import annotations

import argparse
from pathlib import Path

from dengine.recipe import RECIPES

FOLDER = Path(__file__).resolve().parents[1] / "models" / "recipes"


def write_recipes(folder: Path) -> list[Path]:
    """One file for each of `RECIPES`."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for name, recipe in RECIPES.items():
        head = f"# {name}: the defaults of the code. Written by training/write_recipes.py; copy it to change it.\n"
        paths.append(folder / f"{name}.toml")
        paths[-1].write_text(head + recipe.to_toml(), encoding="utf-8")
    return paths


def main() -> None:
    """Parse, write, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=FOLDER, help="folder to write to; models/recipes by default")
    for path in write_recipes(parser.parse_args().out):
        print(f"Wrote {path}")


if __name__ == "__main__":
    main()
