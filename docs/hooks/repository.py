"""Adds pages to the site that stand elsewhere in the repository.

They are the changelog, CONTRIBUTING, the cards of data and models, and the notebooks.
"""

from __future__ import annotations

import base64
import json
import re
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

REPO = Path(__file__).resolve().parents[2]
COPIED = {  # page or picture of the site -> file of the repository
    "changelog.md": "CHANGELOG.md",
    "contributing.md": "CONTRIBUTING.md",
    "security.md": "SECURITY.md",
    "explanation/insertion.md": "dengine/data/insertion.md",
    "explanation/insertion_causes.png": "dengine/data/insertion_causes.png",
    "explanation/insertion_heights.png": "dengine/data/insertion_heights.png",
    "explanation/insertion_scenarios.png": "dengine/data/insertion_scenarios.png",
}
CARDS = "<!-- every card -->"
MOST_OUTPUT = 4000  # characters of one output


def on_files(files: Files, config: MkDocsConfig, **others: Any) -> Files:
    """Return the files of the site, with the pages from elsewhere added."""
    for page, path in COPIED.items():
        files.append(File.generated(config, page, abs_src_path=str(REPO / path)))
    for card in cards():
        for path in (card, *sorted(card.parent.glob("*.png"))):
            name = str(path.relative_to(REPO))
            files.append(File.generated(config, name, abs_src_path=str(path)))
    for notebook in notebooks():
        for name, content in notebook_files(notebook).items():
            files.append(File.generated(config, f"notebooks/{name}", content=content))
    return files


def on_page_markdown(markdown: str, **others: Any) -> str:
    """Return a page with the list of cards, and with links into the repository corrected."""
    card_links = [f"- [{path.parent.name}]({path.parent.name}/card.md)" for path in cards()]
    markdown = re.sub(r"\]\(((?:\.\./)*)docs/", r"](\1", markdown)
    markdown = re.sub(r"\]\((?:\.\./\.\./notebooks/)?(\w+)\.ipynb\)", r"](\1.md)", markdown)
    for page_name, path in COPIED.items():
        markdown = markdown.replace(f"](../../{path}", f"](../{page_name}")
    return markdown.replace(CARDS, "\n".join(card_links))


def notebooks() -> list[Path]:
    """Return the paths of the notebooks."""
    return sorted((REPO / "notebooks").glob("*.ipynb"))


def cards() -> list[Path]:
    """Return the paths of the trained models' cards."""
    return sorted((REPO / "models").glob("*/card.md"))


def notebook_files(notebook: Path) -> dict[str, Any]:
    """Return a notebook as a page, with its stored outputs, and its pictures: name -> content."""
    page = [f"*This page is `notebooks/{notebook.name}` of the repository, as it ran.*\n"]
    pictures = {}
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    for number, cell in enumerate(cells):
        source = "".join(cell["source"])
        is_text = cell["cell_type"] == "markdown"
        page.append(source if is_text else f"```python\n{source}\n```")
        for k, output in enumerate(cell.get("outputs", [])):
            data = output.get("data", {})
            if "image/png" in data:
                name = f"{notebook.stem}_{number}_{k}.png"
                pictures[name] = base64.b64decode("".join(data["image/png"]))
                page.append(f"![]({name})")
            elif "text/markdown" in data:
                page.append("".join(data["text/markdown"]))
            else:
                text = "".join(output.get("text", data.get("text/plain", "")))
                page.append(f"```text\n{text[:MOST_OUTPUT]}\n```")
    return {f"{notebook.stem}.md": "\n\n".join(page)} | pictures
