"""What a release uploads: an sdist and a wheel that a stranger installs without the repository, and in
which all is that README, tutorials and how-to need.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
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
    for name in ("models", "training", "tests", "notebooks"):
        (source / name / "__init__.py").touch()  # a trap: none of these may be packaged
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


@pytest.fixture(scope="module")
def installed(distributions: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The Python of an environment with the wheel, and with the other packages of this one."""
    folder = tmp_path_factory.mktemp("installed")
    run([sys.executable, "-m", "venv", "--without-pip", "venv"], folder)
    python = folder / "venv" / "bin" / "python"
    (wheel,) = distributions.glob("*.whl")
    install = ["-m", "pip", "--python", str(python), "install", "--quiet", "--no-deps"]
    run([sys.executable, *install, "--disable-pip-version-check", str(wheel)], folder)
    (site,) = folder.glob("venv/lib/*/site-packages")
    (site / "others.pth").write_text(sysconfig.get_path("purelib"))  # but no .pth of these others
    return python


@pytest.mark.merge
def test_the_wheel_and_the_sdist_have_dengine_whole_and_no_other_package(
    distributions: Path, repo: Path
) -> None:
    (wheel,) = distributions.glob("*.whl")
    names = set(zipfile.ZipFile(wheel).namelist())
    information = f"dengine-{dengine.__version__}.dist-info"
    assert {name.split("/")[0] for name in names} == {"dengine", information}
    assert f"{information}/licenses/LICENSE" in names
    listed = subprocess.run(
        ["git", "-C", str(repo), "ls-files", "dengine"], capture_output=True, text=True, check=True
    )
    files = set(listed.stdout.split())
    assert {
        "dengine/data/insertion.npz",
        "dengine/export/cpp/CMakeLists.txt",
        "dengine/serve/deploy/grafana.json",
        "dengine/serve/deploy/alerts.yml",
    } <= files
    assert files - names == set()
    (sdist,) = distributions.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        packed = {name.partition("/")[2] for name in archive.getnames()}
    assert {*files, "pyproject.toml", "LICENSE", "PKG-INFO"} - packed == set()
    assert {name.partition("/")[0] for name in packed if name.endswith(".py")} == {"dengine"}


@pytest.fixture(scope="module")
def used(installed: Path) -> list[str]:
    """The lines that `USE` prints of the installed wheel: one process for several claims."""
    return run([str(installed), "-I", "-c", USE], installed.parent).splitlines()


@pytest.mark.merge
def test_the_wheel_works_where_there_is_no_checkout(used: list[str], installed: Path) -> None:
    where, _, size, played = used
    assert Path(where).is_relative_to(installed.parents[1])
    assert (size, played) == ("1503 1000", "60")


@pytest.mark.merge
def test_an_engine_with_pca_in_memory_and_the_table_of_baselines_load_nothing_heavy(
    used: list[str],
) -> None:
    loaded = {*used[1].split()}
    assert {"dengine", "torch"} <= loaded
    assert HEAVY & loaded == set(), "import it in the function that uses it"


@pytest.mark.parametrize("pages", TYPED)
def test_the_commands_of_a_page_run_in_an_empty_folder_with_the_wheel_alone(
    pages: str, installed: Path, repo: Path, tmp_path: Path
) -> None:
    chosen = ["-k", f"from_top_to_bottom and {pages}", f"--basetemp={tmp_path / 'typed'}"]
    options = ["-p", "no:xdist", "-p", "no:cacheprovider", "-o", "addopts=--import-mode=importlib"]
    test = repo / "tests" / "e2e" / "test_docs.py"
    printed = run([str(installed), "-m", "pytest", *options, *chosen, str(test)], tmp_path)
    assert re.search(r"\d+ passed", printed), printed


def test_the_lock_covers_each_extra_of_a_user_and_takes_the_public_build_of_torch(
    repo: Path,
) -> None:
    makefile = (repo / "Makefile").read_text("utf-8")
    (extras,) = re.findall(r"^EXTRAS = (.*)$", makefile, flags=re.M)
    project = tomllib.loads((repo / "pyproject.toml").read_text("utf-8"))["project"]
    assert {*extras.split(",")} == {*project["optional-dependencies"]} - {"docs", "dev"}
    commands = run(["make", "--dry-run", "dist"], repo)
    assert f'".[{extras}]"' in commands
    (pinned,) = re.findall("^torch==(.*)$", (repo / "constraints.txt").read_text(), flags=re.M)
    (wanted,) = re.findall(r"sed -n '(s/.*?/p)' constraints.txt", commands)
    assert run(["sed", "-n", wanted, "constraints.txt"], repo).strip() == f"torch==={pinned}"


def test_a_lock_has_plain_versions_and_hashes_alone(repo: Path) -> None:
    makefile = (repo / "Makefile").read_text("utf-8")
    (program,) = re.findall(r"^define LOCKED\n(.*?)^endef$", makefile, flags=re.M | re.S)

    def lock(*versions: str) -> subprocess.CompletedProcess[str]:
        packages = [
            {
                "metadata": {"name": f"package-{i}", "version": version},
                "download_info": {"archive_info": {"hashes": {"sha256": f"{i:064}"}}},
            }
            for i, version in enumerate(versions)
        ]
        checkout = {"metadata": {"name": "dengine", "version": "1"}, "download_info": {}}
        return subprocess.run(
            [sys.executable, "-c", program],
            input=json.dumps({"install": [*packages, checkout]}),
            capture_output=True,
            text=True,
            check=False,
        )

    locked = lock("2.13.0", "0.7.post1")
    assert locked.stdout.splitlines() == [
        f"package-0==2.13.0 --hash=sha256:{0:064}",
        f"package-1==0.7.post1 --hash=sha256:{1:064}",
    ]
    refused = lock("2.13.0+cpu")
    assert (refused.returncode, refused.stdout) == (1, "")
    assert "no package-0 2.13.0+cpu" in refused.stderr


@pytest.mark.parametrize("python", ["python3.11", "python3.12", "python3.13"])
def test_with_its_dependencies_from_the_index_the_wheel_runs_the_readmes_example(
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
