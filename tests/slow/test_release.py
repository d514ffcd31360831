"""What a release uploads: an sdist and a wheel that a stranger installs without the repository, and in
which all is that README, tutorials and how-to need.
"""

import os
import re
import shlex
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import zipfile
from pathlib import Path

import pytest

import dengine

HEAVY = {"aeon", "matplotlib", "mujoco", "numba", "onnx", "onnxruntime", "umap"}
USE = """
import dengine, dengine.experiments.baselines, numpy as np, sys
from dengine import DataEngine, Recipe, load_dataset, replay
print(dengine.__file__)
DataEngine(recipe=Recipe("pca")).decide(np.random.default_rng(0).normal(size=100))
print(*{name.partition(".")[0] for name in sys.modules})
data = load_dataset("insertion")
print(len(data), data.X.shape[1])
print(len(replay(data, "pca", cycles=60).action))
"""
# Pages that are typed with the wheel alone: README before each merge, the others in `make test-all`.
TYPED = [
    pytest.param("README.md", marks=pytest.mark.merge),
    "docs/tutorials/",
    "docs/howto/",
]


def run(command: str | list[str], folder: Path) -> str:
    """Run a command outside the repository; return what it printed."""
    words = shlex.split(command) if isinstance(command, str) else command
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    completed = subprocess.run(words, cwd=folder, env=environment, **pipes)
    assert completed.returncode == 0, completed.stdout
    return completed.stdout


def find_interpreter(name: str) -> str | None:
    """Return the path of an interpreter that starts; one on the path, or of the version manager.

    pyenv puts a name on the path for each version, and behind it starts the chosen ones alone.
    """
    managed = sorted(Path.home().glob(f".pyenv/versions/{name.removeprefix('python')}*/bin/{name}"))
    for path in filter(None, (shutil.which(name), *map(str, managed))):
        if subprocess.run([path, "--version"]).returncode == 0:
            return path
    return None


@pytest.fixture(scope="module")
def distributions(repo, tmp_path_factory):
    """Folder with the sdist, and the wheel that is built from it."""
    if shutil.which("git") is None:
        pytest.skip("git, which lists the files of a release, is not on this machine")
    source, folder = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("dist")
    copied = f"git -C '{repo}' ls-files -z | tar -C '{repo}' --null -T - -c | tar -C '{source}' -x"
    subprocess.run(copied, shell=True, check=True)
    for name in ("models", "training", "tests", "notebooks"):
        (source / name / "__init__.py").touch()  # a trap: none of these may be packaged
    run(f"'{sys.executable}' -m build --no-isolation --outdir '{folder}' '{source}'", folder)
    return folder


@pytest.mark.merge
def test_both_files_pass_the_checks_of_the_package_index(distributions):
    files = " ".join(f"'{file}'" for file in distributions.iterdir())
    printed = run(f"'{sys.executable}' -m twine check --strict {files}", distributions)
    assert printed.count("PASSED") == 2


@pytest.mark.parametrize(("version", "code"), [("2.13.0", 0), ("2.13.0+cpu", 1)])
def test_the_lock_refuses_a_build_that_the_public_index_lacks(repo, version, code):
    makefile = (repo / "Makefile").read_text("utf-8")
    program = makefile.split("define LOCKED\n")[1].split("\nendef")[0]
    report = (
        '{"install": [{"metadata": {"name": "torch", "version": "VERSION"},'
        ' "download_info": {"archive_info": {"hashes": {"sha256": "1"}}}}]}'
    ).replace("VERSION", version)
    locked = subprocess.run(
        [sys.executable, "-c", program], input=report, capture_output=True, text=True
    )
    assert locked.returncode == code
    assert ("--hash=sha256:1" in locked.stdout) is not bool(code)


@pytest.fixture(scope="module")
def installed(distributions, tmp_path_factory):
    """The Python of an environment with the wheel, and with the other packages of this one."""
    folder = tmp_path_factory.mktemp("installed")
    run(f"'{sys.executable}' -m venv --without-pip venv", folder)
    python = folder / "venv" / "bin" / "python"
    (wheel,) = distributions.glob("*.whl")
    pip = f"'{sys.executable}' -m pip --python '{python}' install --quiet --no-deps '{wheel}'"
    run(f"{pip} --disable-pip-version-check", folder)
    (site,) = folder.glob("venv/lib/*/site-packages")
    (site / "others.pth").write_text(sysconfig.get_path("purelib"))  # but no .pth of these others
    return python


@pytest.mark.merge
def test_the_wheel_and_the_sdist_have_dengine_whole_and_no_other_package(distributions, repo):
    (wheel,) = distributions.glob("*.whl")
    names = set(zipfile.ZipFile(wheel).namelist())
    information = f"dengine-{dengine.__version__}.dist-info"
    assert {name.split("/")[0] for name in names} == {"dengine", information}
    assert f"{information}/licenses/LICENSE" in names
    files = set(run(["git", "-C", str(repo), "ls-files", "dengine"], repo).split())
    assert "dengine/data/insertion.npz" in files
    assert files - names == set()
    (sdist,) = distributions.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        packed = {name.partition("/")[2] for name in archive.getnames()}
    assert {*files, "pyproject.toml", "LICENSE", "PKG-INFO"} - packed == set()
    assert {name.partition("/")[0] for name in packed if name.endswith(".py")} == {"dengine"}


@pytest.mark.merge
def test_the_wheel_works_where_there_is_no_checkout_and_an_engine_with_pca_loads_nothing_heavy(
    installed,
):
    printed = run([str(installed), "-I", "-c", USE], installed.parent)
    where, loaded, size, played = printed.splitlines()
    assert Path(where).is_relative_to(installed.parents[1])
    assert (size, played) == ("1503 1000", "60")
    assert HEAVY & {*loaded.split()} == set(), "import it in the function that uses it"


@pytest.mark.parametrize("pages", TYPED)
def test_the_commands_of_a_page_run_in_an_empty_folder_with_the_wheel_alone(
    pages, installed, repo, tmp_path
):
    chosen = ["-k", f"from_top_to_bottom and {pages}", f"--basetemp={tmp_path / 'typed'}"]
    options = ["-p", "no:xdist", "-p", "no:cacheprovider", "-o", "addopts=--import-mode=importlib"]
    test = repo / "tests" / "e2e" / "test_docs.py"
    printed = run([str(installed), "-m", "pytest", *options, *chosen, str(test)], tmp_path)
    assert re.search(r"\d+ passed", printed), printed


@pytest.mark.parametrize("python", ["python3.11", "python3.12", "python3.13"])
def test_with_its_dependencies_from_the_index_the_wheel_runs_the_readmes_example(
    python, distributions, repo, tmp_path
):
    interpreter = find_interpreter(python)
    if interpreter is None:
        pytest.skip(f"{python} is not on this machine")
    (wheel,) = distributions.glob("*.whl")
    run([interpreter, "-m", "venv", "clean"], tmp_path)
    quiet = "--quiet --disable-pip-version-check --no-compile"
    constraint = repo / "constraints.txt"
    run(f"clean/bin/python -m pip install {quiet} --constraint '{constraint}' '{wheel}'", tmp_path)
    example = (repo / "README.md").read_text("utf-8").split("```python\n")[1].split("```")[0]
    (tmp_path / "example.py").write_text(example, "utf-8")
    printed = run("clean/bin/python -I example.py", tmp_path)
    totals = re.search(r"([1-9]\d*) accepted, ([1-9]\d*) rejected, 400 decided", printed)
    assert totals is not None, printed
    assert "dengine" in run("clean/bin/dengine --version", tmp_path)
