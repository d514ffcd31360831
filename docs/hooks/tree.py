"""Where things are, from the package itself: the tree of the README.

python docs/hooks/tree.py        # writes it anew after a module came, went or changed its first words
"""

from __future__ import annotations

import ast
import re
from pathlib import Path

REPO = Path(__file__).resolve().parents[2]
README = REPO / "README.md"
TREE = re.compile(r"(?<=^```text\n)dengine/ .*?(?=^```$)", flags=re.S | re.M)
BESIDE = {
    "docs/": "tutorials, how-to, reference, explanation; `make docs` builds the site into site/",
    "models/": "recipes/*.toml, and trained files with their cards",
    "training/": "scripts over dengine: train, compare, export, measure",
    "notebooks/": "executed walkthroughs",
    "tests/": "unit, contract, e2e, golden: `make test`; slow: `make test-all`",
}


def clause(module: Path) -> str:
    """The first clause of a module's docstring."""
    text = ast.get_docstring(ast.parse(module.read_text(encoding="utf-8"))) or ""
    return re.split(r"[.:;](?:\s|$)", " ".join(text.split("\n\n")[0].split()), maxsplit=1)[0].replace("`", "")


def rows() -> dict[str, str]:
    """What stands in the repository: the package's modules in one row, each family with its first words, what is beside."""
    package = REPO / "dengine"
    modules = [file.stem for file in sorted(package.glob("*.py")) if not file.stem.startswith("__")]
    families = {f"  {file.parent.name}/": clause(file) for file in sorted(package.glob("*/__init__.py"))}
    return {"dengine/": ", ".join(modules)} | families | BESIDE


def tree() -> str:
    """The rows as text."""
    return "".join(f"{name:<16}{words}".rstrip() + "\n" for name, words in rows().items())


def main() -> None:
    """Write the tree into the README."""
    README.write_text(TREE.sub(lambda _: tree(), README.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main()
