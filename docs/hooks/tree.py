"""Writes the tree of the README, which says where things are, from the package itself.

python docs/hooks/tree.py        # after a module was added, removed or got other first words
"""

from __future__ import annotations

import ast
import re
from pathlib import Path

REPO = Path(__file__).resolve().parents[2]
README = REPO / "README.md"
TREE = re.compile(r"(?<=^```text\n)dengine/ .*?(?=^```$)", flags=re.DOTALL | re.MULTILINE)
BUNDLED = "The bundled set insertion with its card, and the units of channels"  # no module says it
OTHER_FOLDERS = {
    "docs/": "tutorials, how-to, reference, explanation; `make docs` builds the site into site/",
    "models/": "trained files with their cards",
    "training/": "scripts over dengine: train, compare, export, measure",
    "notebooks/": "executed walkthroughs",
    "tests/": "unit, contract, e2e, golden: `make test`; slow: `make test-all`",
}


def clause(module: Path) -> str:
    """Return the first clause of a module's docstring."""
    text = ast.get_docstring(ast.parse(module.read_text(encoding="utf-8"))) or ""
    paragraph = " ".join(text.split("\n\n")[0].split())
    return re.split(r"[.:;](?:\s|$)", paragraph, maxsplit=1)[0].replace("`", "")


def rows() -> dict[str, str]:
    """Return the rows, name -> text: the modules in one row, the families, other folders."""
    package = REPO / "dengine"
    modules = sorted(path.stem for path in package.glob("[!_]*.py"))
    clauses = {f"  {path.parent.name}/": clause(path) for path in package.glob("*/__init__.py")}
    clauses["  data/"] = BUNDLED
    return {"dengine/": ", ".join(modules)} | dict(sorted(clauses.items())) | OTHER_FOLDERS


def tree() -> str:
    """Return the tree as text."""
    return "".join(f"{name:<16}{words}".rstrip() + "\n" for name, words in rows().items())


def main() -> None:
    """Write the tree into the README."""
    README.write_text(
        TREE.sub(lambda _: tree(), README.read_text(encoding="utf-8")), encoding="utf-8"
    )


if __name__ == "__main__":
    main()
