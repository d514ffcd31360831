"""The layers: who may import whom, who may import what is heavy, and how long a file may grow."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import dengine

ROOT = Path(dengine.__file__).parent

LAYER = {  # by module, or by package for all that is in it; the longest name that fits counts
    "dengine": 0,  # __init__: the version, and lazy names
    "_lazy": 0,
    "errors": 0,
    "records": 0,
    "wording": 0,
    "values": 0,
    "labels": 1,
    "documents": 1,
    "outputs": 1,
    "archives": 1,
    "folds": 1,
    "traces": 1,
    "decision": 2,
    "datasets": 3,
    "recordings": 3,
    "recipe": 3,  # holds a policy
    "reducers": 4,
    "model": 5,
    "store": 6,
    "cells": 7,
    "settings": 8,
    "retraining": 8,
    "resuming": 8,
    "contracts": 8,
    "references": 8,
    "fleet": 8,
    "deciding": 8,
    "interrupts": 1,
    "asking": 8,
    "backlog": 8,
    "recent": 8,
    "agreeing": 8,
    "lateness": 8,
    "keeping": 8,
    "pending": 8,
    "incoming": 8,
    "facts": 8,
    "versions": 8,
    "current": 8,
    "window": 8,
    "feedback": 8,
    "envelope": 2,
    "history": 8,
    "standing": 8,
    "stored": 8,
    "verdict": 8,
    "answering": 8,
    "explaining": 8,
    "reviewing": 8,
    "corrections": 8,
    "loop": 8,
    "engine": 9,
    "checks": 10,
    "forms": 9,
    "importing": 10,
    "journals": 9,
    "export": 10,
    "experiments": 11,
    "serve": 12,
    "cli": 13,
    "__main__": 13,
}
HEAVY = {  # at the top of a module only in those dedicated to it, which are themselves imported where they are used
    "umap": (),
    "mujoco": ("cells.simulation.world",),
    "matplotlib": ("experiments.figures",),
    "sqlalchemy": (
        *("store.cell_history", "store.dump", "store.history"),
        "store.migrations",
        "store.migrations.versions.v0001_schema_1",
        "store.migrations.versions.v0002_part_silent_event",
        "store.migrations.versions.v0003_ledger",
        *("store.sql", "store.sql_connections", "store.sql_engine", "store.sql_history", "store.sql_ledger"),
        *("store.sql_owning", "store.sql_queries", "store.sql_queue", "store.sql_snapshot", "store.sql_tables"),
        *("store.sql_fleet", "store.sql_scope", "store.sql_traces", "store.sql_versions", "store.sql_views"),
    ),
    "alembic": (
        "store.migrations",
        "store.migrations.env",
        "store.migrations.versions.v0001_schema_1",
        "store.migrations.versions.v0002_part_silent_event",
        "store.migrations.versions.v0003_ledger",
    ),
    "pandas": (),
    "torchmetrics": (),
    "onnxruntime": (),
}
LINES = 300

MODULES = {
    ".".join(p.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__").replace("__init__", "dengine"): p
    for p in sorted(ROOT.rglob("*.py"))
}


def typing_only(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)


def nodes(tree: ast.AST, functions: bool = True) -> Iterator[ast.AST]:
    """Every node that runs: without blocks for type checkers; without functions, those that run on import."""
    for node in ast.iter_child_nodes(tree):
        if typing_only(node) or (not functions and isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)):
            continue
        yield node
        yield from nodes(node, functions)


@cache
def tree(module: str) -> ast.Module:
    return ast.parse(MODULES[module].read_text(encoding="utf-8"))


def resolve(name: str) -> str:
    """The module that a dotted name under dengine means: `cells.replay.ReplayCell` -> `cells.replay`."""
    while name and name not in MODULES:
        name = name.rpartition(".")[0]
    return name or "dengine"


@cache
def imports(module: str) -> set[str]:
    """Modules of dengine that a module imports, at its top or within its functions."""
    package = MODULES[module].relative_to(ROOT).parts[:-1]
    found = set()
    for node in nodes(tree(module)):
        if isinstance(node, ast.ImportFrom):
            base = (*package[: len(package) - node.level + 1], node.module or "") if node.level else (node.module or "",)
            if node.level or base[0].split(".")[0] == "dengine":
                full = ".".join(part for part in base if part).removeprefix("dengine").lstrip(".")
                found |= {resolve(f"{full}.{alias.name}".lstrip(".")) for alias in node.names}
        elif isinstance(node, ast.Import):
            ours = [a.name for a in node.names if a.name.split(".")[0] == "dengine"]
            found |= {resolve(name.removeprefix("dengine").lstrip(".")) for name in ours}
    return found - {module}


def layer(module: str) -> int:
    name = module
    while name and name not in LAYER:
        name = name.rpartition(".")[0]
    assert name, f"dengine/{module} has no layer yet: give it one in tests/test_layering.py, as in the design"
    return LAYER[name]


@pytest.mark.parametrize("module", MODULES)
def test_a_module_imports_only_from_its_own_layer_or_lower_ones(module: str) -> None:
    above = {other: layer(other) for other in imports(module) if layer(other) > layer(module)}
    assert not above, f"{module} (layer {layer(module)}) imports {above}"


def test_no_modules_import_each_other_in_a_circle() -> None:
    # A package's __init__ names what is in it; whoever imports from inside the package does not mean the __init__.
    order = list(TopologicalSorter({m: imports(m) for m in MODULES}).static_order())  # raises CycleError
    assert set(order) == set(MODULES)


def test_the_parser_sees_the_imports_that_are_there() -> None:
    assert {"decision.rule", "decision.neighbors", "decision.policy", "records"} <= imports("decision.classifier")
    assert "reducers.base" in imports("model.module")
    assert "errors" in imports("reducers.pca")
    assert "store.sql" in imports("store.base")  # within a function
    assert imports("dengine") == {"_lazy"}  # the rest for type checkers alone


@pytest.mark.parametrize("heavy", HEAVY)
def test_what_is_heavy_is_imported_where_it_is_used(heavy: str) -> None:
    at_the_top = set()
    for module in MODULES:
        for node in nodes(tree(module), functions=False):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) and not node.level else []
            names += [a.name for a in node.names] if isinstance(node, ast.Import) else []
            if heavy in {name.split(".")[0] for name in names}:
                at_the_top.add(module)
    assert at_the_top <= set(HEAVY[heavy])


def test_an_engine_with_pca_in_memory_loads_nothing_heavy() -> None:
    code = (
        "import sys, numpy as np; from dengine import DataEngine; e = DataEngine('pca', retrain_every=10)\n"
        "for i in range(12): e.report(e.decide(np.random.default_rng(i).normal(size=30)).id, i % 2 == 0)\n"
        "assert e.version == 1\n"
        f"print(*[m for m in {[m for m in HEAVY if m != 'pandas']} if m in sys.modules])"  # scikit-learn may load pandas
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


@pytest.mark.parametrize("module", MODULES)
def test_a_file_is_one_idea_long(module: str) -> None:
    lines = len(MODULES[module].read_text(encoding="utf-8").splitlines())
    assert lines <= LINES, f"{module} has {lines} lines: it is two ideas"


def test_no_layer_outlives_its_module() -> None:
    names = set(MODULES) | {module.rpartition(".")[0] for module in MODULES}
    assert set(LAYER) - names == set()


@pytest.mark.parametrize(
    "module", ["engine", "versions", "incoming", "retraining", "resuming", "deciding", "export.file", "export.torchscript"]
)
def test_what_drives_a_model_asks_its_contract_and_never_its_class(module: str) -> None:
    asked = [
        ast.unparse(node)
        for node in ast.walk(tree(module))
        if isinstance(node, ast.Call) and ast.unparse(node.func) in ("isinstance", "hasattr", "getattr")
    ]
    assert [call for call in asked if "model" in call.lower()] == []
