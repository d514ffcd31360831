"""What a release uploads: an sdist and a wheel that a stranger installs without the repository."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

THIS = f"python3.{sys.version_info.minor}"  # the others only in `make test-all`
PYTHONS = [
    pytest.param(name, marks=[pytest.mark.merge] if name == THIS else [])
    for name in ("python3.11", "python3.12", "python3.13")
]


def run(command: list[str], folder: Path) -> str:
    """Run a command outside the repository; return what it printed."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    completed = subprocess.run(
        command,
        cwd=folder,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    assert completed.returncode == 0, completed.stdout
    return completed.stdout


def find_interpreter(name: str) -> str | None:
    """Return the path of an interpreter that starts; one on the path, or of the version manager.

    pyenv puts a name on the path for each version, and behind it starts the chosen ones alone.
    """
    version = name.removeprefix("python")
    managed = sorted(Path.home().glob(f".pyenv/versions/{version}*/bin/{name}"))
    for path in filter(None, (shutil.which(name), *map(str, managed))):
        if subprocess.run([path, "--version"]).returncode == 0:
            return path
    return None


@pytest.fixture(scope="module")
def distributions(repo: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the sdist, and the wheel that is built from it."""
    if shutil.which("git") is None:
        pytest.skip("git, which lists the files of a release, is not on this machine")
    source = tmp_path_factory.mktemp("source")
    subprocess.run(
        f"git -C '{repo}' ls-files -z | tar -C '{repo}' --null -T - -c | tar -C '{source}' -x",
        shell=True,
        check=True,
    )
    folder = tmp_path_factory.mktemp("dist")
    run(
        [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(folder), str(source)],
        folder,
    )
    return folder


@pytest.mark.merge
def test_both_files_pass_the_checks_of_the_package_index(distributions: Path) -> None:
    files = sorted(distributions.iterdir())
    assert [file.name.split("-")[0] for file in files] == ["dengine", "dengine"]
    assert {"".join(file.suffixes)[-4:] for file in files} == {".whl", "r.gz"}
    printed = run(
        [sys.executable, "-m", "twine", "check", "--strict", *map(str, files)], distributions
    )
    assert printed.count("PASSED") == 2


@pytest.mark.parametrize("python", PYTHONS)
def test_the_wheel_alone_runs_the_readmes_example(
    python: str, distributions: Path, repo: Path, tmp_path: Path
) -> None:
    interpreter = find_interpreter(python)
    if interpreter is None:
        pytest.skip(f"{python} is not on this machine")
    (wheel,) = distributions.glob("*.whl")
    run([interpreter, "-m", "venv", "clean"], tmp_path)
    install = [
        "clean/bin/python",
        "-m",
        "pip",
        "install",
        "--quiet",
        "--disable-pip-version-check",
        "--no-compile",
    ]
    run([*install, "--constraint", str(repo / "constraints.txt"), str(wheel)], tmp_path)
    example, *_ = re.findall(
        r"```python\n(.*?)```", (repo / "README.md").read_text("utf-8"), re.DOTALL
    )
    (tmp_path / "example.py").write_text(example, "utf-8")
    printed = run(["clean/bin/python", "-I", "example.py"], tmp_path)
    totals = re.search(r"(\d+) accepted, (\d+) rejected, 400 decided", printed)
    assert totals is not None, printed
    assert 0 not in map(int, totals.groups())
    assert "dengine" in run(["clean/bin/dengine", "--version"], tmp_path)
