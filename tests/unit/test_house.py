"""The house keeps its size and its shape: what comes in pushes something out."""

import ast
import re
import sys
from contextlib import suppress
from functools import cache
from importlib import import_module
from typing import Protocol

from dengine import DataEngine, TorchReducer
from dengine.decision.rule import DecisionRule
from tests.slow.faults.__main__ import MUTATIONS
from tests.support.faults import REPO, read_faults

PACKAGE = REPO / "dengine"
FILES = {
    ".".join(file.relative_to(REPO).with_suffix("").parts): file
    for file in sorted(PACKAGE.rglob("*.py"))
}
NODES = 220_715
KNOWN = {name.removesuffix(".__init__") for name in FILES} - {"dengine"}


@cache
def parse_modules() -> dict[str, ast.Module]:
    """Each module by its name; a family's is NAME.__init__. Not parsed before a test needs them."""
    return {name: ast.parse(file.read_text("utf-8")) for name, file in FILES.items()}


def test_at_most_ten_modules_stand_at_the_top():
    top = sorted(file.name for file in PACKAGE.glob("*.py") if not file.name.startswith("__"))
    assert len(top) <= 10, (
        f"{len(top)} modules stand at the top; put one into a family: {', '.join(top)}"
    )


def test_the_package_keeps_its_size_in_syntax_nodes():
    nodes = sum(1 for tree in parse_modules().values() for _ in ast.walk(tree))
    assert nodes <= NODES, (
        f"dengine has {nodes} syntax nodes, {nodes - NODES} too many: take something out"
    )


def test_no_base_of_ours_has_a_single_subclass():
    ours = set()
    for name in KNOWN - {"dengine.__main__"}:
        with suppress(ImportError):  # an extra is not installed
            module = import_module(name)
            classes = [value for value in vars(module).values() if isinstance(value, type)]
            ours |= {cls for cls in classes if cls.__module__.startswith("dengine.")}
    # Users derive from these, too.
    aside = {TorchReducer, DecisionRule}
    aside |= {cls for cls in ours if issubclass(cls, Exception) or Protocol in cls.__bases__}
    alone = [str(cls) for cls in ours - aside if len({*cls.__subclasses__()} & ours) == 1]
    assert not alone, f"these have one subclass; make the two one class, or compose them: {alone}"


def test_the_engine_keeps_a_public_face_of_at_most_27_members():
    public = [name for name in dir(DataEngine) if not name.startswith("_")]
    assert len(public) <= 27, (
        f"{len(public)} public members; what only a running engine knows is its `state`: {public}"
    )


def test_no_module_is_imported_by_a_string():
    # The one table of names by string is `dengine/__init__.pyi`; a user's own `module:Class` is
    # imported by `import_class`.
    strings = {
        f"{node.value} ({module}, line {node.lineno})"
        for module, tree in parse_modules().items()
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant)
        and isinstance(node.value, str)
        and {node.value.partition(":")[0]} & KNOWN
    }
    assert not strings, (
        f"import them, or move what needs them; a string only hides a layer: {', '.join(sorted(strings))}"
    )


def test_each_fault_of_the_net_fits_the_code_and_names_tests_that_are_there():
    assert len(read_faults([])) == 63
    for name, file, before, *_ in MUTATIONS:
        assert (REPO / file).read_text("utf-8").count(before) == 1, f"{name}: {before!r} in {file}"


def test_tests_go_through_public_faces():
    private = re.compile(r"\b(?:engine|store)\._[a-z]\w*")
    for folder in ("tests", "training"):
        for file in (REPO / folder).rglob("*.py"):
            found = private.findall(file.read_text("utf-8"))
            assert not found, f"{file.name}: say it by a public face, or leave it out: {found}"


def test_the_readme_shows_where_things_are():
    sys.path.insert(0, str(REPO / "docs" / "hooks"))
    from tree import tree

    assert tree() in (REPO / "README.md").read_text("utf-8"), "run: python docs/hooks/tree.py"


OLD_WORDS = {  # a word of before, and the word of the glossary; stored columns keep their names
    r"\bn?_?unobserved\b": "unreported",
    r"\bn_silent\b|\bsilently confirmed\b": "unreported",
    r"\b(?:store|database|server|controller) is away\b|\bwhile it is away\b": "unavailable",
    r"\bPolicy\([^)]*\bwindows=|policy\.windows|--window\b(?! \d)|operator's windows?\b": "force limits",
    r"\bcore_of\b|\bEngineCore\b": "DataEngine",
}


def test_words_that_the_glossary_replaced_are_gone():
    texts = [REPO / "README.md", *(REPO / "docs").rglob("*.md"), *PACKAGE.rglob("*.py")]
    texts += [*PACKAGE.rglob("*.js"), *PACKAGE.rglob("*.?pp")]
    found = [
        f"{file.relative_to(REPO)}: {match}, now {new}"
        for file in texts
        for old, new in OLD_WORDS.items()
        for match in re.findall(old, file.read_text("utf-8"))
    ]
    assert not found, found


def test_the_names_on_the_page_about_the_life_of_a_trace_exist():
    page = (REPO / "docs" / "explanation" / "life_of_a_trace.md").read_text("utf-8")
    assert len(page.split()) <= 700
    spoken = set(re.findall(r"`([A-Z]\w+(?:\.\w+)?|[a-z]\w+)`", page))
    spoken |= set(re.findall(r"\b[A-Z]\w+\.[a-z]\w+\b", page))
    assert len(spoken) > 30
    texts = [file.read_text("utf-8") for file in FILES.values()]
    for name in spoken:
        owner, _, member = name.partition(".")
        defined = re.compile(rf"\b(?:class|def) {owner}\b")
        assert any(member in text and defined.search(text) for text in texts), name
