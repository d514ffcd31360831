"""Write models/recipes/NAME.toml from the defaults of the code: `python training/write_recipes.py`.

A test checks that the files and the defaults are equal.
"""

from pathlib import Path

from dengine.recipe import RECIPES

FOLDER = Path(__file__).resolve().parents[1] / "models" / "recipes"
HEAD = (
    "# {name}: the defaults of the code. Written by training/write_recipes.py; "
    "copy it to change it.\n"
)

if __name__ == "__main__":
    for name, recipe in RECIPES.items():
        text = HEAD.format(name=name) + recipe.to_toml()
        (FOLDER / f"{name}.toml").write_text(text, encoding="utf-8")
