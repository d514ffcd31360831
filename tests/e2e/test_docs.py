"""Every command and snippet of the README and of the site runs, page by page, as a newcomer would
type it; only smaller.

Each page has a desk, stores and folders of its own, and runs from top to bottom; README, tutorials
and how-to in an empty folder. A long command gets options behind its own, of which the last counts.
`make test` runs one page, `make test-all` every one, and README and two others in one folder.
`tests/slow/test_release.py` runs pages with the installed wheel.
"""

import json
import multiprocessing
import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

REPO = Path(__file__).resolve().parents[2]
PAGES = [REPO / "README.md", *sorted((REPO / "docs").rglob("*.md"))]
QUICK = {"docs/howto/parts.md"}
CHECKOUT = "docs/explanation/"  # pages that say that they need one

SMALLER = {  # by the command's beginning: options that make it quick
    "dengine replay --data insertion": "--repeats 1 --cycles 120",
    "dengine replay --data screw_driving.npz": "--cycles 60",
    "dengine compare --data insertion": "--repeats 1 --cycles 80 --n-jobs 1",
    "dengine compare --data insertion --reducers conv --paper": "--cycles 50",
    "dengine compare --reducers pca,my_reducers:PeakReducer": "--cycles 80",
    "dengine run --cell replay": "--cycles 80",
    "dengine run --cell simulated": "--cycles 15",
    "dengine costs": "--repeats 2 --cycles 70 --alphas 0.5 --lower-bounds 0.8 --n-jobs 1",
    "dengine simulate": "--n 12 --n-jobs 1",
    "dengine compare --data recordings": "--repeats 1 --cycles 60 --n-jobs 1",
    "dengine replay --data recordings": "--repeats 1 --cycles 80",
    "dengine replay --data numbered.npz": "--cycles 80",
    "dengine train --data insertion": "--data small.npz",
    "dengine train --data recordings": "--reducer pca",
    "python training/benchmark_cycle.py": "--data small.npz --replays 1 --repeats 1 --umap-repeats 0",
    "python training/benchmark_scale.py": "--data small.npz --sizes 80 --repeats 1",
    "python -m tests.slow.proof --only null": "--repeats 2",
    "python -m tests.slow.faults": "--trials 1 --kills 1 --others 1 --only locked",
    "python training/benchmark_fleet.py": "--cells 2 --minutes 0.05 --cycles 0 --samples 100",
    "python training/benchmark_store.py": "--data small.npz --reducer pca --parts 40",
    "cmake -S cell_cpp": "-DCMAKE_CXX_FLAGS_RELEASE=-O0 -DDENGINE_ONNX=OFF",  # test_cpp.py builds it as it is meant
    "cmake --build build/cpp": "--parallel 2",
    "python training/benchmark_export.py": "--data small.npz --random 40 --calls 20",
}
NOT_RUN = ("make ", ". .venv", "python -m pip")  # this very suite, and what installs
CPP = ("cmake", "build/")
HAS_CPP = all(shutil.which(tool) for tool in ("cmake", "g++"))
PYTHON = ("dengine ", "python training/", "python -m tests.", "python snippet.py")
SPAWNS = "python training/benchmark_fleet.py"  # its processes need a `__main__` of their own
PRELOADED = """dengine.cli dengine.engine.engine dengine.experiments.grid dengine.store.sql
matplotlib.pyplot pandas rich.table scipy.special sklearn.linear_model"""
FORKS = multiprocessing.get_context("forkserver")
FORKS.set_forkserver_preload(PRELOADED.split())
RUNS, STEP_S = 80, 0.0012  # of the recordings that stand in for the public ones


class Block(NamedTuple):
    """A fenced block of a page; a title names the file that a reader would save it as."""

    language: str
    title: str
    text: str

    @property
    def commands(self) -> list[str]:
        """The lines of a shell block, without comments."""
        lines = re.sub(r"\s+#.*$", "", self.text, flags=re.M).splitlines()
        return [line for line in lines if line.strip()] if self.language == "sh" else []


def blocks(page: Path) -> list[Block]:
    fenced = r'^```(sh|python)(?: title="([^"]+)")?\n(.*?)^```$'
    return [Block(*match) for match in re.findall(fenced, page.read_text("utf-8"), re.S | re.M)]


def name(page: Path) -> str:
    return str(page.relative_to(REPO))


@pytest.fixture
def desk(tmp_path):
    """A folder that keeps what the commands write, with nothing in it but a small set."""
    X, y = recordings()
    # In the place of a large set.
    np.savez(tmp_path / "small.npz", X=X[:, ::5], y=y, workpiece=np.arange(len(y)))
    return tmp_path


def recordings() -> tuple[np.ndarray, np.ndarray]:
    """A few traces (RUNS, 500), told apart by their height, and labels."""
    rng = np.random.default_rng(0)
    y = (rng.random(RUNS) < 0.7).astype(np.int8)
    slope = np.where(y == 1, 2.0, 1.0)[:, None]
    return slope * np.arange(500) * STEP_S + rng.normal(0.0, 0.01, (RUNS, 500)), y


def record(folder: Path) -> None:
    """Recordings in the form of the public ones, as `git clone` would bring them."""
    folder.mkdir(parents=True)
    time = (np.arange(500) * STEP_S).tolist()
    for i, (torque, good) in enumerate(zip(*recordings(), strict=True)):
        graph = {"graph": {"time values": time, "torque values": torque.tolist()}}
        run = {"id code": str(i // 10), "result": "OK" if good else "NOK"}
        text = json.dumps(run | {"tightening steps": [graph]})
        (folder / f"Ch_{i:012d}.json").write_text(text, encoding="utf-8")


def shell(command: str, desk: Path) -> None:
    """Run one command as it is typed, with the environment activated."""
    is_plain = not re.search(r"[<>|$&;`]", command)
    if command.startswith(PYTHON) and not command.startswith(SPAWNS) and is_plain:
        python(shlex.split(command.removeprefix("python ")), desk)
        return
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    env = os.environ | {"PATH": path, "OMP_NUM_THREADS": "1", "COLUMNS": "80"}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    done = subprocess.run(["bash", "-c", command], cwd=desk, env=env, timeout=300, **pipes)
    assert done.returncode == 0, f"{command}\n{done.stdout[-4000:]}"


def python(words: list[str], desk: Path) -> None:
    """Run a script or `dengine` in a fork of a process that has imported torch already: eighty
    would wait for it.
    """
    text, typed = desk / "said.txt", REPO / "tests" / "support" / "typed.py"
    given = {"WHERE": str(desk), "ARGV": words, "SAID": str(text)}
    typed_run = partial(runpy.run_path, str(typed), init_globals=given, run_name="typed")
    process = FORKS.Process(target=typed_run)
    process.start()
    process.join(900)
    process.kill()
    assert process.exitcode == 0, f"{' '.join(words)}\n{text.read_text(encoding='utf-8')[-4000:]}"


def smaller(command: str) -> str:
    """The command with its quick options, where it has any."""
    return " ".join([command, *(SMALLER[start] for start in SMALLER if command.startswith(start))])


def type_in(command: str, desk: Path) -> None:
    """One line of a shell block, as far as it can be run here."""
    if command.startswith("git clone"):
        record(desk / command.rsplit("/", 1)[1] / "data")
    elif command.startswith(CPP) and not HAS_CPP:
        assert "DENGINE_REQUIRE_CPP" not in os.environ
    elif not command.startswith(NOT_RUN):
        shell(smaller(command), desk)


def snippet(block: Block, desk: Path) -> None:
    """A block of Python, with fewer parts: saved if it has a file's name, otherwise run."""
    text = re.sub(r"(range\(|cycles=)[4-9]00\b", r"\g<1>100", block.text)
    (desk / (block.title or "snippet.py")).write_text(text, encoding="utf-8")
    # A cell's program is started again.
    for _ in range(0 if block.title else 2 if "open_or_create" in block.text else 1):
        shell("python snippet.py", desk)


def typed_pages() -> list:
    """The pages with something to type; those that are not quick are slow."""
    pages = {name(page): page for page in PAGES if blocks(page)}
    marks = {text: () if text in QUICK else pytest.mark.slow for text in pages}
    return [pytest.param(page, marks=marks[text], id=text) for text, page in pages.items()]


@pytest.mark.parametrize("page", typed_pages())
def test_every_command_and_snippet_of_a_page_runs_from_top_to_bottom(page, desk):
    type_page(page, desk)


def type_page(page: Path, desk: Path) -> None:
    """All blocks of a page, from top to bottom."""
    for folder in ("training", "tests") if name(page).startswith(CHECKOUT) else ():
        (desk / folder).symlink_to(REPO / folder)
    for block in blocks(page):
        if block.language == "python":
            snippet(block, desk)
        for command in block.commands:
            type_in(command, desk)


def test_every_shortened_command_is_on_a_page():
    commands = [command for page in PAGES for block in blocks(page) for command in block.commands]
    assert [
        key for key in SMALLER if not any(command.startswith(key) for command in commands)
    ] == []


@pytest.mark.slow
def test_readme_tutorial_and_production_are_typed_one_after_the_other_in_one_folder(desk):
    (suggested,) = re.findall(
        r"Go on with:.*&& (dengine .*)'", (REPO / "Makefile").read_text("utf-8")
    )
    shell(suggested.replace("--cycles 600", "--cycles 80"), desk)
    for page in ("README.md", "docs/tutorials/first_part.md", "docs/howto/production.md"):
        type_page(REPO / page, desk)
