"""A net below the tests: one-line faults of `faults.toml`, each of which some quick test must catch.

    python tests/support/faults.py                              # all of them, two at a time
    python tests/support/faults.py --only "own space" --jobs 1
    python tests/support/faults.py --tier test                  # only by the tests that are not under tests/slow

A fault is a text that occurs once in a file, and what stands there instead. It is put into a copy of the tree, where its
tests are run: caught, where one of them fails. Exit code 0: all were caught; 1: some were not; 2: the list is wrong.
"""

from __future__ import annotations

import argparse
import compileall
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from py_compile import PycInvalidationMode
from queue import SimpleQueue
from typing import TypeVar

REPO = Path(__file__).resolve().parents[2]
LIST = Path(__file__).with_suffix(".toml")
SLOW = "tests/slow/"
SECONDS = 120.0  # for the tests of one fault
FAILED = 1  # pytest's exit code where tests failed; another one says that they could not be run

T = TypeVar("T")
R = TypeVar("R")


class ListError(Exception):
    """What is wrong with the list, or with its tests."""


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault. tests : paths or node ids that must catch it.  hangs : whether to run out of time is to be caught."""

    name: str
    file: str
    before: str
    after: str
    tests: tuple[str, ...]
    hangs: bool = False

    @property
    def place(self) -> str:
        """The file, and the fault."""
        return f"{self.file}: {self.name}"


@dataclass(frozen=True, slots=True)
class Trial:
    """What became of a fault. why : it was missed, where that is not plain."""

    name: str
    file: str
    caught: bool
    seconds: float
    why: str = ""

    @property
    def line(self) -> str:
        """All of it, for people."""
        word, why = "caught" if self.caught else "MISSED", self.why and f" ({self.why})"
        return f"{word}  {self.seconds:5.1f} s  {self.file}: {self.name}{why}"


def read_faults(only: Sequence[str], tier: str) -> list[Fault]:
    """The faults of the list whose names contain one of `only`; ListError for one that fits no longer."""
    rows = tomllib.loads(LIST.read_text(encoding="utf-8"))["fault"]
    faults = [Fault(**row | {"tests": tuple(row["tests"])}) for row in rows]
    wrong = [f"the name {fault.name!r} twice" for fault in faults if sum(fault.name == each.name for each in faults) > 1]
    wrong += [f"no fault named {name!r}" for name in only if not any(name in fault.name for fault in faults)]
    for fault in faults:
        file = REPO / fault.file
        times = file.read_text(encoding="utf-8").count(fault.before) if file.is_file() else 0
        wrong += [f"{fault.place}: expected its text once, found it {times} times"] * (times != 1)
        wrong += [f"{fault.place}: expected another text after it"] * (fault.before == fault.after)
        wrong += [f"{fault.place}: expected tests, got none"] * (not fault.tests)
    if wrong:
        raise ListError("\n".join(wrong))
    asked = [fault for fault in faults if not only or any(name in fault.name for name in only)]
    return [replace(fault, tests=in_tier(fault.tests)) for fault in asked] if tier == "test" else asked


def in_tier(tests: Sequence[str]) -> tuple[str, ...]:
    """Those that are not slow."""
    return tuple(test for test in tests if not test.startswith(SLOW))


@contextmanager
def temporary_folder() -> Iterator[Path]:
    """A folder that goes afterwards."""
    with tempfile.TemporaryDirectory(prefix="faults-") as folder:
        yield Path(folder).resolve()


def copied(folder: Path) -> Path:
    """A copy of the tree in a folder: what git knows of, as it stands."""
    listed = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    names = subprocess.run(listed, cwd=REPO, capture_output=True, check=True).stdout.decode().split("\0")
    for name in filter(None, names):
        if (source := REPO / name).is_file():
            target = folder / name
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(source, target)
    # By content: a file and its fault may be of one size and one second, and one's bytecode be taken for the other's.
    compileall.compile_dir(folder / "dengine", quiet=2, invalidation_mode=PycInvalidationMode.CHECKED_HASH)
    return folder


def run_tests(tests: Sequence[str], tree: Path, seconds: float = SECONDS) -> tuple[int | None, str]:
    """Pytest's exit code in a tree, None where it ran out of time, and what it said."""
    surroundings = os.environ | {"PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *tests]
    with subprocess.Popen(
        command, cwd=tree, env=surroundings, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True
    ) as process:
        try:
            said, _ = process.communicate(timeout=seconds)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)  # the tests' own processes too
            said, _ = process.communicate()
            return None, said.decode(errors="replace")
    return process.returncode, said.decode(errors="replace")


@contextmanager
def put_into(tree: Path, fault: Fault) -> Iterator[None]:
    """Have the fault in a tree for a while."""
    file = tree / fault.file
    text = file.read_text(encoding="utf-8")
    file.write_text(text.replace(fault.before, fault.after), encoding="utf-8")
    try:
        yield
    finally:
        file.write_text(text, encoding="utf-8")


def try_one(fault: Fault, tree: Path) -> Trial:
    """Put a fault into a tree, and run its tests."""
    if not fault.tests:
        return Trial(fault.name, fault.file, False, 0.0, "all its tests are slow")
    begin = time.monotonic()
    with put_into(tree, fault):
        code, _ = run_tests(fault.tests, tree)
    caught = fault.hangs if code is None else code == FAILED
    why = f"no end within {SECONDS:g} s" if code is None else "" if code in (0, FAILED) else "its tests could not be run"
    return Trial(fault.name, fault.file, caught, time.monotonic() - begin, why)


def tests_by_file(faults: Sequence[Fault]) -> list[list[str]]:
    """The different tests of all faults, those of one file together: they share what is made for them once."""
    groups: dict[str, list[str]] = {}
    for test in dict.fromkeys(test for fault in faults for test in fault.tests):
        groups.setdefault(test.partition("::")[0], []).append(test)
    return list(groups.values())


def check_without(tests: Sequence[str], tree: Path) -> str:
    """What to say of tests that do not pass in the tree as it is; "" where they do."""
    code, said = run_tests(tests, tree, SECONDS * len(tests))
    return "" if code == 0 else f"tests fail without the fault: {' '.join(tests)}\n{said[-1500:]}"


def side_by_side(work: Callable[[T, Path], R], items: Sequence[T], trees: Sequence[Path]) -> Iterator[R]:
    """Do work on each item in a tree of its own for that time; the results in the order of the items."""
    free: SimpleQueue[Path] = SimpleQueue()
    for tree in trees:
        free.put(tree)

    def in_a_tree(item: T) -> R:
        tree = free.get()
        try:
            return work(item, tree)
        finally:
            free.put(tree)

    with ThreadPoolExecutor(len(trees)) as pool:
        yield from pool.map(in_a_tree, items)


def main(arguments: Sequence[str] | None = None) -> int:
    """Try the faults; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="faults whose names contain one of these")
    parser.add_argument("--tier", choices=["all", "test"], default="all", help="test: without the tests under tests/slow")
    parser.add_argument("--jobs", type=int, default=2, help="faults that are tried at a time")
    parser.add_argument("--json", action="store_true", help="one document in place of lines")
    asked = parser.parse_args(arguments)
    try:
        faults = read_faults(asked.only, asked.tier)
        with ExitStack() as stack:
            trees = [copied(stack.enter_context(temporary_folder())) for _ in range(max(1, asked.jobs))]
            if wrong := list(filter(None, side_by_side(check_without, tests_by_file(faults), trees))):
                raise ListError("\n".join(wrong))
            trials = []
            for trial in side_by_side(try_one, faults, trees):
                trials.append(trial)
                if not asked.json:
                    print(trial.line, flush=True)
    except ListError as error:
        print(error, file=sys.stderr)
        return 2
    caught = sum(trial.caught for trial in trials)
    if asked.json:
        document = {"tier": asked.tier, "caught": caught, "faults": len(trials), "trials": list(map(asdict, trials))}
        print(json.dumps(document, indent=1))
    else:
        print(f"caught {caught} of {len(trials)}" + (" by make test" if asked.tier == "test" else ""))
    return int(caught < len(trials))


if __name__ == "__main__":
    sys.exit(main())
