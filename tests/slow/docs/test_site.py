"""The documentation site: it builds without a warning, leaves nothing out, and asks nothing of the
network.
"""

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import dengine
from dengine.cli import main
from tests.support.command_line import dengine as command

REPO = Path(__file__).resolve().parents[3]
DOCUMENTS = [REPO / "README.md", REPO / "CONTRIBUTING.md", *sorted((REPO / "docs").rglob("*.md"))]
ASSETS = r'<(?:script|img|iframe|source|link)\b[^>]*?\s(?:src|href)=["\']?([^"\'\s>]+)'


@pytest.fixture(scope="module")
def site(tmp_path_factory):
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


def test_a_page_asks_nothing_of_the_network(site):
    pages = sorted(site.rglob("*.html"))
    asked = set(re.findall(ASSETS, text_of(pages)))
    assert len(pages) > 30
    assert len(asked) > 30
    assert [address for address in asked if re.match(r"(\w+:)?//", address)] == []
    styles = text_of(sorted(site.rglob("*.css")))
    assert re.findall(r"(?:url\(|@import )\s*[\"']?(?:https?:)?//[^)\"']*", styles) == []


# What public methods return, the methods that robots call, and a base: documented, not exported.
RETURNED = """BackupReport Changed Corrections EngineState Explanation ExportedDecision ExportedModel
HistoryFilter HistoryReport ProbabilityReducer RobotCalls Status StoredDecision
CorrectionTable DecisionTable EventTable LabelTable SettingTable VersionTable"""


def is_module(name: str) -> bool:
    try:
        return importlib.util.find_spec(name) is not None
    except ModuleNotFoundError:  # its parent is a class
        return False


def test_the_reference_documents_exactly_the_public_names(site):
    reference = text_of(sorted((site / "reference").glob("*.html")))
    entries = set(re.findall(r'id="(dengine\.[\w.]+)"', reference))
    names = {
        entry.rpartition(".")[2]
        for entry in entries
        if not is_module(entry) and is_module(entry.rpartition(".")[0])
    }
    assert names == {*dengine.__all__, *RETURNED.split()}


def test_the_documents_import_public_names_alone():
    typed = "\n".join(
        re.findall(r"^```python.*?\n(.*?)^```$", text_of(DOCUMENTS), flags=re.S | re.M)
    )
    imported = re.findall(r"^from (dengine[\w.]*) import (\([^)]*\)|.*)$", typed, flags=re.M)
    assert {module for module, _ in imported} == {"dengine"}
    names = set(re.findall(r"\w+", " ".join(names for _, names in imported)))
    assert names - set(dengine.__all__) == set()


def test_the_page_of_the_command_line_has_every_option_of_every_verb(site):
    page = (site / "reference" / "command_line.html").read_text(encoding="utf-8")
    for verb in main.commands:
        section = page.split(f'id="dengine-{verb}"')[1].split("<h2")[0]
        options = re.findall(r"^  (?:-\w, )?(--[\w-]+)", command(verb, "--help").output, flags=re.M)
        assert options
        assert {option for option in options if not re.search(rf"{option}\b", section)} == set()


@pytest.mark.parametrize("page", DOCUMENTS, ids=lambda page: str(page.relative_to(REPO)))
def test_every_file_and_heading_that_a_page_links_is_there(page):
    prose = re.sub(r"^```.*?^```$", "", text_of([page]), flags=re.S | re.M)
    for path, anchor in re.findall(r"\]\(([^)#:\s]*)(?:#([^)]+))?\)", prose):
        linked = page.parent / path if path else page
        assert linked.exists(), path
        if anchor:
            headings = re.findall(r"^#+ (.+)$", text_of([linked]), flags=re.M)
            words = [re.sub(r"[^\w\s-]", "", heading).lower().split() for heading in headings]
            assert anchor in map("-".join, words)
