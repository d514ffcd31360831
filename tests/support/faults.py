"""A net below the tests: one-line faults of `faults.toml`, each of which some quick test must catch.

    python tests/support/faults.py                              # all of them, two at a time
    python tests/support/faults.py --only "own space" --jobs 1
    python tests/support/faults.py --tier test                  # only by the tests that `make test` runs

A fault is a text that occurs once in a file, and what stands there instead. It is put into a copy
of the tree, where its tests are run: caught, where one of them fails. Exit code 0: all were caught;
1: some were not; 2: the list is wrong.
"""

import argparse
import compileall
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
from dataclasses import dataclass
from pathlib import Path
from py_compile import PycInvalidationMode
from queue import SimpleQueue
from typing import Any

REPO = Path(__file__).resolve().parents[2]
LIST = Path(__file__).with_suffix(".toml")
TIERS = {"all": [], "test": ["-m", "not slow"]}  # options of pytest
SECONDS = (
    300.0  # for the tests of one fault: umap-learn compiles for a minute, more on a busy machine
)
FAILED, NONE = 1, 5  # pytest's exit codes where tests failed, and where none was selected


class ListError(Exception):
    """What is wrong with the list, or with its tests."""


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault. tests : paths or node ids that must catch it.  hangs : whether to run out of time
    is to be caught.
    """

    name: str
    file: str
    before: str
    after: str
    tests: list[str]
    hangs: bool = False

    def wrong(self) -> Iterator[str]:
        """What is wrong with it."""
        file = REPO / self.file
        if (
            times := file.read_text(encoding="utf-8").count(self.before) if file.is_file() else 0
        ) != 1:
            yield f"{self.file}: {self.name}: expected its text once, found it {times} times"
        if self.before == self.after or not self.tests:
            yield f"{self.file}: {self.name}: expected another text after it, and tests"
        for test in self.tests:
            path, _, function = test.partition("[")[0].partition("::")
            there = (REPO / path).is_file() and f"def {function}" in (REPO / path).read_text(
                encoding="utf-8"
            )
            if not there:
                yield f"{self.file}: {self.name}: expected a test that is there, got {test}"


@dataclass(frozen=True, slots=True)
class Trial:
    """What became of a fault. why : it was missed, where that is not plain."""

    name: str
    file: str
    caught: bool
    seconds: float
    why: str = ""


def read_faults(only: Sequence[str]) -> list[Fault]:
    """The faults of the list whose names contain one of `only`; ListError for one that fits no
    longer.
    """
    faults = [Fault(**row) for row in tomllib.loads(LIST.read_text(encoding="utf-8"))["fault"]]
    wrong = [item for fault in faults for item in fault.wrong()]
    wrong += [
        f"no fault named {name!r}"
        for name in only
        if not any(name in fault.name for fault in faults)
    ]
    if wrong or len({fault.name for fault in faults}) < len(faults):
        raise ListError("\n".join(wrong) or "two faults of one name")
    return [fault for fault in faults if not only or any(name in fault.name for name in only)]


def copied(folder: Path) -> Path:
    """A copy of the tree in a folder: what git knows of, as it stands."""
    listed = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    names = (
        subprocess.run(listed, cwd=REPO, capture_output=True, check=True)
        .stdout.decode()
        .split("\0")
    )
    for name in filter(None, names):
        if (source := REPO / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(source, folder / name)
    # By content: a file and its fault may be of one size and one second, and one's bytecode be
    # taken for the other's.
    compileall.compile_dir(
        folder / "dengine", quiet=2, invalidation_mode=PycInvalidationMode.CHECKED_HASH
    )
    return folder


def run_tests(
    tests: Sequence[str], tree: Path, tier: str, seconds: float = SECONDS
) -> tuple[int | None, str]:
    """Pytest's exit code in a tree, None where it ran out of time, and what it said."""
    surroundings = os.environ | {"PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-x",
        "-q",
        "-p",
        "no:cacheprovider",
        *TIERS[tier],
        *tests,
    ]
    pipes: dict[str, Any] = {
        "stdout": subprocess.PIPE,
        "stderr": subprocess.STDOUT,
        "text": True,
        "errors": "replace",
    }
    with subprocess.Popen(
        command, cwd=tree, env=surroundings, start_new_session=True, **pipes
    ) as process:
        try:
            text, _ = process.communicate(timeout=seconds)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)  # the tests' own processes too
            return None, process.communicate()[0]
    return process.returncode, text


def try_one(fault: Fault, tree: Path, tier: str) -> Trial:
    """Put a fault into a tree for a while, and run its tests."""
    file, begin = tree / fault.file, time.monotonic()
    text = file.read_text(encoding="utf-8")
    file.write_text(text.replace(fault.before, fault.after), encoding="utf-8")
    try:
        code, _ = run_tests(fault.tests, tree, tier)
    finally:
        file.write_text(text, encoding="utf-8")
    why = {None: f"no end within {SECONDS:g} s", 0: "", FAILED: "", NONE: "all its tests are slow"}
    caught = fault.hangs if code is None else code == FAILED
    return Trial(
        fault.name,
        fault.file,
        caught,
        time.monotonic() - begin,
        why.get(code, "its tests could not be run"),
    )


def check_without(tests: Sequence[str], tree: Path, tier: str) -> str:
    """What to say of tests that do not pass in the tree as it is; "" where they do."""
    code, text = run_tests(tests, tree, tier, SECONDS * len(tests))
    return (
        ""
        if code in (0, NONE)
        else f"tests fail without the fault: {' '.join(tests)}\n{text[-1500:]}"
    )


def tests_by_file(faults: Sequence[Fault]) -> list[list[str]]:
    """The different tests of all faults, those of one file together: they share what is made for
    them once.
    """
    groups: dict[str, list[str]] = {}
    for test in dict.fromkeys(test for fault in faults for test in fault.tests):
        groups.setdefault(test.partition("::")[0], []).append(test)
    return list(groups.values())


def side_by_side(
    work: Callable[[Any, Path, str], Any], items: Sequence[Any], trees: Sequence[Path], tier: str
) -> Iterator[Any]:
    """Do work on each item in a tree of its own for that time; the results in the order of the
    items.
    """
    free: SimpleQueue[Path] = SimpleQueue()
    for tree in trees:
        free.put(tree)

    def in_a_tree(item: Any) -> Any:
        tree = free.get()
        try:
            return work(item, tree, tier)
        finally:
            free.put(tree)

    with ThreadPoolExecutor(len(trees)) as pool:
        yield from pool.map(in_a_tree, items)


def main(arguments: Sequence[str] | None = None) -> int:
    """Try the faults; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--only",
        nargs="+",
        default=[],
        metavar="NAME",
        help="faults whose names contain one of these",
    )
    parser.add_argument(
        "--tier", choices=list(TIERS), default="all", help="test: by what `make test` runs"
    )
    parser.add_argument("--jobs", type=int, default=2, help="faults that are tried at a time")
    asked = parser.parse_args(arguments)
    try:
        faults = read_faults(asked.only)
        with tempfile.TemporaryDirectory(prefix="faults-") as folder:
            trees = [copied(Path(folder).resolve() / str(k)) for k in range(max(1, asked.jobs))]
            if wrong := list(
                filter(None, side_by_side(check_without, tests_by_file(faults), trees, asked.tier))
            ):
                raise ListError("\n".join(wrong))
            trials = []
            for trial in side_by_side(try_one, faults, trees, asked.tier):
                trials.append(trial)
                word, why = "caught" if trial.caught else "MISSED", trial.why and f" ({trial.why})"
                print(
                    f"{word}  {trial.seconds:5.1f} s  {trial.file}: {trial.name}{why}", flush=True
                )
    except ListError as error:
        print(error, file=sys.stderr)
        return 2
    caught = sum(trial.caught for trial in trials)
    print(f"caught {caught} of {len(trials)}" + (" by make test" if asked.tier == "test" else ""))
    return int(caught < len(trials))


if __name__ == "__main__":
    sys.exit(main())
