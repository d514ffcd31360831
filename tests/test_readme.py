"""Every command and snippet of the README runs, in its order, as a newcomer would type it; only smaller.

A long command gets options behind its own, of which the last counts. What needs the network or would call this very suite
is held to what can be known without running it.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

REPO = Path(__file__).resolve().parents[1]
README = (REPO / "README.md").read_text(encoding="utf-8")

ONE_REPLAY = "--seeds 100:101 --cycles 60 --policies 0.2:0.8 --n-jobs 1"
SMALLER = {  # by the command's beginning: options that make it quick
    "dengine replay --data insertion": "--repeats 1 --cycles 120",
    "dengine replay --data screw_driving.npz": "--cycles 60",
    "python training/compare_reducers.py report --data insertion": f"{ONE_REPLAY} --reducers conv,pca,rocket",
    "python training/compare_reducers.py report --data screw_driving.npz": f"{ONE_REPLAY} --reducers conv,umap",
    "python training/benchmark_cycle.py": "--data screw_driving.npz --samples 100 --replays 1 --repeats 1 --umap-repeats 1",
    "python training/benchmark_scale.py": "--data screw_driving.npz --samples 100 --sizes 80 --repeats 1 --umap-most 1",
    "python training/check_noise.py": "--data screw_driving.npz --samples 100 --seeds 100:101",
    "dengine run --cell simulated": "--cycles 60",
    "python training/show_scenarios.py": "--cycles 12",
    "python training/compare_costs.py": "--seeds 100:101 --cycles 60 --n-jobs 1",
    "python training/compare_drift.py": "--cycles 40 --scenarios bias_jump --methods dengine,paper-conv",
    "python training/benchmark_export.py": "--data screw_driving.npz --random 40 --calls 20 --damaged 5",
}
RUNS = 80  # of the recordings that stand in for the public ones


@dataclass(frozen=True)
class Block:
    """A fenced block of the README."""

    language: str
    text: str

    @property
    def commands(self) -> list[str]:
        """The lines of a shell block, without comments."""
        return [line for line in re.sub(r"\s+#.*$", "", self.text, flags=re.M).splitlines() if line.strip()]


BLOCKS = [Block(*found) for found in re.findall(r"^```(\w+)\n(.*?)^```$", README, flags=re.S | re.M)]
COMMANDS = [command for block in BLOCKS if block.language == "sh" for command in block.commands]
HAS_CPP = all(shutil.which(tool) for tool in ("cmake", "g++"))


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that looks like a clone to whoever types in it, and keeps what the commands write."""
    desk = tmp_path_factory.mktemp("desk")
    for name in ("training", "tests", "models", "notebooks"):
        (desk / name).symlink_to(REPO / name)
    return desk


def record(folder: Path) -> None:
    """Recordings in the form of the public ones, as `git clone` would bring them: few, and told apart by their height."""
    folder.mkdir(parents=True)
    rng, t = np.random.default_rng(0), np.arange(500) * 0.0012
    for i in range(RUNS):
        good = rng.random() < 0.7
        torque = (2.0 if good else 1.0) * t + rng.normal(0.0, 0.01, len(t))
        graph = {"graph": {"time values": t.tolist(), "torque values": torque.tolist()}}
        run = {"id code": str(i // 10), "result": "OK" if good else "NOK", "tightening steps": [graph]}
        (folder / f"Ch_{i:012d}.json").write_text(json.dumps(run), encoding="utf-8")


def shell(command: str, desk: Path) -> None:
    """Run one command as it is typed, with the environment activated."""
    bin_ = Path(sys.executable).parent
    path = os.pathsep.join([str(bin_), os.environ["PATH"]])
    env = os.environ | {"PATH": path, "OMP_NUM_THREADS": "1", "COLUMNS": "80"}
    done = subprocess.run(["bash", "-c", command], cwd=desk, env=env, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, f"{command}\n{done.stdout[-2000:]}\n{done.stderr[-3000:]}"


def smaller(command: str) -> str:
    """The command with its quick options, where it has any."""
    extra = [options for beginning, options in SMALLER.items() if command.startswith(beginning)]
    return " ".join([command, *extra])


def test_every_command_and_snippet_runs_from_top_to_bottom(desk: Path) -> None:
    for block in BLOCKS:
        if block.language == "python":
            (desk / "snippet.py").write_text(block.text, encoding="utf-8")
            for _ in range(2 if "open_or_create" in block.text else 1):  # a cell's program is started again
                shell("python snippet.py", desk)
            continue
        for command in block.commands:
            if command.startswith("git clone"):
                record(desk / command.rsplit("/", 1)[1] / "data")
            elif command.startswith(("cmake", "build/")) and not HAS_CPP:
                assert "DENGINE_REQUIRE_CPP" not in os.environ
            elif command.startswith("python training/benchmark_export.py") and not HAS_CPP:
                shell(smaller(command).replace("--cell build/cpp/dengine_cell", ""), desk)
            elif not command.startswith(("make ", ". .venv", "python -m pip")):
                shell(smaller(command), desk)
    assert (desk / "engine.db").is_file()
    assert (desk / "out" / "curves.png").is_file()


def test_the_commands_that_install_name_what_is_there() -> None:
    targets = re.findall(r"^(\w+):", (REPO / "Makefile").read_text(encoding="utf-8"), flags=re.M)
    assert {command.split()[1] for command in COMMANDS if command.startswith("make ")} == {"demo", "test"}
    assert {"demo", "test"} <= set(targets)
    extras = tomllib.loads((REPO / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    (installing,) = [command for command in COMMANDS if command.startswith("python -m pip")]
    assert set(re.search(r"\[(.*)\]", installing)[1].split(",")) <= set(extras)
    assert (REPO / "constraints.txt").is_file()


def test_every_shortened_command_is_in_the_readme() -> None:
    assert [beginning for beginning in SMALLER if not any(c.startswith(beginning) for c in COMMANDS)] == []


def test_every_file_and_picture_that_the_readme_links_is_there() -> None:
    linked = re.findall(r"\]\(([^)#:]+)\)", README)
    assert linked
    assert [name for name in linked if not (REPO / name).exists()] == []


def test_every_script_and_module_that_the_documents_name_is_there() -> None:
    for page in ("README.md", "CONTRIBUTING.md"):
        text = (REPO / page).read_text(encoding="utf-8")
        named = set(re.findall(r"\b(?:training|tests|dengine|models)/[\w/]+\.(?:py|toml|md|npz)\b", text))
        assert named
        made = {"dengine/reducers/NAME.py", "dengine/cells/NAME.py", "dengine/cli/NAME.py"}
        assert [name for name in named - made if not (REPO / name).exists()] == []
