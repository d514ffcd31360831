"""How many files and functions of dengine a decision, a report, a retrain and an explanation enter.

python training/count_files.py
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import dengine
from dengine import Action, DataEngine, load_dataset

ROOT = str(Path(dengine.__file__).parent)
PARTS = 200  # before what is counted: then each has been retrained more than once, and everything is compiled


def entered(work: Callable[[], Any]) -> set[tuple[str, str]]:
    """File and name of each function of dengine that is entered while this is done."""
    found: set[tuple[str, str]] = set()

    def look(frame: FrameType, event: str, arg: object) -> None:
        if event == "call" and frame.f_code.co_filename.startswith(ROOT):
            found.add((frame.f_code.co_filename.removeprefix(ROOT).lstrip("/"), frame.f_code.co_qualname))

    sys.setprofile(look)
    try:
        work()
    finally:
        sys.setprofile(None)
    return found


def count(folder: Path) -> dict[str, dict[str, Any]]:
    """What each verb of the default engine enters, with a store in SQLite."""
    data = load_dataset("insertion")
    with DataEngine("conv", store=str(folder / "engine.db")) as engine:
        for x, y in zip(data.X[:PARTS], data.y, strict=False):
            if (decision := engine.decide(x)).action is not Action.REJECT:
                engine.report(decision.id, bool(y))
        ids: list[str] = []
        verbs: dict[str, Callable[[], Any]] = {
            "decide": lambda: ids.append(engine.decide(data.X[PARTS]).id),
            "report": lambda: engine.report(ids[0], bool(data.y[PARTS])),
            "retrain": engine.retrain,
            "explain": lambda: engine.explain(ids[0]),
        }
        found = {name: entered(work) for name, work in verbs.items()}
    return {name: {"files": sorted({file for file, _ in calls}), "functions": len(calls)} for name, calls in found.items()}


def main() -> None:
    """Count, and print."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    with tempfile.TemporaryDirectory() as folder:
        counted = count(Path(folder))
    for name, each in counted.items():
        print(f"{name}: {len(each['files'])} files, {each['functions']} functions\n  {', '.join(each['files'])}")


if __name__ == "__main__":
    main()
