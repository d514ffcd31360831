"""The documentation site: it builds without a warning, leaves nothing out, and asks nothing of the
network.
"""

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import dengine
from dengine.cli import main
from tests.support.command_line import dengine as command

REPO = Path(__file__).resolve().parents[3]
DOCUMENTS = [REPO / "README.md", REPO / "CONTRIBUTING.md", *sorted((REPO / "docs").rglob("*.md"))]
ASSETS = r'<(?:script|img|iframe|source|link)\b[^>]*?\s(?:src|href)=["\']?([^"\'\s>]+)'
TO_BE_MADE = {f"dengine/{folder}/NAME.py" for folder in ("reducers", "cells", "cli")}


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the site: the one that `make docs` has just built where DENGINE_SITE names it, or a new one."""
    if built := os.environ.get("DENGINE_SITE"):
        return Path(built)
    for package in ("mkdocs", "material", "mkdocstrings_handlers.python"):
        pytest.importorskip(
            package, reason="the site needs the extra docs: pip install 'dengine[docs]'"
        )
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    done = subprocess.run(command, cwd=REPO, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-3000:]
    return folder


def text_of(pages: list[Path]) -> str:
    return "\n".join(page.read_text(encoding="utf-8") for page in pages)


def test_a_page_asks_nothing_of_the_network(site: Path) -> None:
    pages = sorted(site.rglob("*.html"))
    asked = set(re.findall(ASSETS, text_of(pages)))
    assert (len(pages) > 30, len(asked) > 30) == (True, True)
    assert [address for address in asked if re.match(r"(\w+:)?//", address)] == []
    styles = text_of(sorted(site.rglob("*.css")))
    assert re.findall(r"(?:url\(|@import )\s*[\"']?(?:https?:)?//[^)\"']*", styles) == []


def test_every_public_name_is_in_the_reference(site: Path) -> None:
    reference = text_of(sorted((site / "reference").glob("*.html")))
    explained = set(re.findall(r'id="dengine\.[\w.]*?(\w+)"', reference))
    tables = {name for name in dengine.__all__ if not callable(getattr(dengine, name))}
    assert set(dengine.__all__) - tables - explained == set()
    assert {name for name in tables if f"<code>{name}</code>" not in reference} == set()


def test_the_page_of_the_command_line_has_every_option_of_every_verb(site: Path) -> None:
    page = (site / "reference" / "command_line.html").read_text(encoding="utf-8")
    for verb in main.commands:
        section = page.split(f'id="dengine-{verb}"')[1].split("<h2")[0]
        options = re.findall(r"^  (?:-\w, )?(--[\w-]+)", command(verb, "--help").output, flags=re.M)
        assert options
        assert {option for option in options if not re.search(rf"{option}\b", section)} == set()


@pytest.mark.parametrize("page", ["README.md", "CONTRIBUTING.md"])
def test_every_file_and_heading_that_a_page_links_is_there(page: str) -> None:
    for path, anchor in re.findall(r"\]\(([^)#:]*)(?:#([^)]+))?\)", text_of([REPO / page])):
        linked = REPO / (path or page)
        assert linked.exists(), path
        headings = re.findall(r"^#+ (.+)$", text_of([linked]), flags=re.M) if anchor else []
        assert not anchor or anchor in {
            re.sub(r"\s+", "-", re.sub(r"[^\w\s-]", "", h).strip().lower()) for h in headings
        }


def test_every_script_and_module_that_the_documents_name_is_there() -> None:
    files = r"(?<![\w./-])(?:training|tests|dengine|models|docs)/[\w/]+\.(?:py|toml|md|npz|png)\b"
    named = set(re.findall(files, text_of(DOCUMENTS)))
    assert {"training/benchmark_cycle.py", "dengine/decision/members.py"} <= named
    assert [path for path in sorted(named - TO_BE_MADE) if not (REPO / path).exists()] == []


def test_the_commands_that_install_name_what_is_there() -> None:
    typed = "\n".join(re.findall(r"^```sh\n(.*?)^```$", text_of(DOCUMENTS), flags=re.S | re.M))
    targets = re.findall(r"^([\w-]+):", text_of([REPO / "Makefile"]), flags=re.M)
    assert set(re.findall(r"^make ([\w-]+)", typed, flags=re.M)) <= set(targets)
    named = ",".join(re.findall(r"^python -m pip install .*\[([\w,]+)\]", typed, flags=re.M))
    extras = tomllib.loads(text_of([REPO / "pyproject.toml"]))["project"]["optional-dependencies"]
    assert set() < set(named.split(",")) <= set(extras)
