"""`python training/write_recipes.py` writes models/recipes/NAME.toml from the code's defaults; a test keeps them equal."""

from pathlib import Path

from dengine.recipe import RECIPES

FOLDER = Path(__file__).resolve().parents[1] / "models" / "recipes"

if __name__ == "__main__":
    for name, recipe in RECIPES.items():
        head = f"# {name}: the defaults of the code. Written by training/write_recipes.py; copy it to change it.\n"
        (FOLDER / f"{name}.toml").write_text(head + recipe.to_toml(), encoding="utf-8")
