"""Pages that live elsewhere in the repository: changelog, contributing, cards of data and models, notebooks."""

from __future__ import annotations

import base64
import json
import re
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

REPO = Path(__file__).resolve().parents[2]
TAKEN = {  # page or picture of the site -> file of the repository
    "changelog.md": "CHANGELOG.md",
    "contributing.md": "CONTRIBUTING.md",
    "explanation/insertion.md": "dengine/data/insertion.md",
    "explanation/insertion_causes.png": "dengine/data/insertion_causes.png",
    "explanation/insertion_heights.png": "dengine/data/insertion_heights.png",
    "explanation/insertion_scenarios.png": "dengine/data/insertion_scenarios.png",
}
NOTEBOOKS, CARDS = "<!-- every notebook -->", "<!-- every card -->"
SHOWN = 4000  # characters of one output


def on_files(files: Files, config: MkDocsConfig, **others: Any) -> Files:
    """MkDocs has listed docs/: the pages from elsewhere join."""
    for page, path in TAKEN.items():
        files.append(File.generated(config, page, abs_src_path=str(REPO / path)))
    for path in [shown for card in cards() for shown in (card, *sorted(card.parent.glob("*.png")))]:
        files.append(File.generated(config, str(path.relative_to(REPO)), abs_src_path=str(path)))
    for notebook in notebooks():
        for name, content in notebook_files(notebook).items():
            files.append(File.generated(config, f"notebooks/{name}", content=content))
    return files


def on_page_markdown(markdown: str, **others: Any) -> str:
    """MkDocs has read a page: the marks give way to lists of what was found, and links into docs/ find the page."""
    listed = [f"- [{title(path)}]({path.stem}.md)" for path in notebooks()]
    carded = [f"- [{path.parent.name}]({path.parent.name}/card.md)" for path in cards()]
    markdown = re.sub(r"\]\(((?:\.\./)*)docs/", r"](\1", markdown)
    return markdown.replace(NOTEBOOKS, "\n".join(listed)).replace(CARDS, "\n".join(carded))


def notebooks() -> list[Path]:
    """The notebooks of the repository."""
    return sorted((REPO / "notebooks").glob("*.ipynb"))


def cards() -> list[Path]:
    """The cards of the trained models."""
    return sorted((REPO / "models").glob("*/card.md"))


def title(notebook: Path) -> str:
    """A notebook's first heading."""
    found = re.search(r"^# (.+)$", notebook_files(notebook)[f"{notebook.stem}.md"], flags=re.M)
    return found[1] if found else notebook.stem


def notebook_files(notebook: Path) -> dict[str, Any]:
    """A notebook as a page, with its outputs as they were kept, and its pictures: name -> content."""
    page, pictures = [f"*This page is `notebooks/{notebook.name}` of the repository, as it ran.*\n"], {}
    for number, cell in enumerate(json.loads(notebook.read_text(encoding="utf-8"))["cells"]):
        source = "".join(cell["source"])
        page.append(source if cell["cell_type"] == "markdown" else f"```python\n{source}\n```")
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
                page.append(f"```text\n{text[:SHOWN]}\n```")
    return {f"{notebook.stem}.md": "\n\n".join(page)} | pictures
