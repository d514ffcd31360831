"""What a user installs: small to import, complete, and nothing but `dengine`."""

import re
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest

import dengine


def fresh(code: str, *flags: str, cwd: Path | None = None) -> str:
    """What code prints in a fresh interpreter."""
    done = subprocess.run(
        [sys.executable, *flags, "-c", code], capture_output=True, text=True, cwd=cwd
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_importing_dengine_loads_nothing_but_the_standard_library_and_its_lazy_loader() -> None:
    code = "import sys; before = set(sys.modules); import dengine; print(*sorted(set(sys.modules) - before))"
    tops = {name.split(".")[0] for name in fresh(code).split()}
    assert "dengine" in tops
    assert tops - {"dengine", "lazy_loader"} <= set(sys.stdlib_module_names)


def test_every_public_name_is_there_and_listed() -> None:
    assert sorted(dengine.__all__) == sorted(set(dengine.__all__))
    for name in dengine.__all__:
        assert getattr(dengine, name) is not None
        assert name in dir(dengine)
    with pytest.raises(AttributeError, match=r"attribute '?Dataengine"):
        dengine.Dataengine  # noqa: B018 -- the access is what is tested


PROJECT_PAGE = "dengine/data/project_page.md"


def test_the_page_of_an_index_has_no_link_that_leads_into_a_checkout_and_its_example_runs(
    repo: Path, tmp_path: Path, monkeypatch
) -> None:
    page = (repo / PROJECT_PAGE).read_text("utf-8")
    assert "](" not in page
    (example,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    monkeypatch.chdir(tmp_path)
    exec(compile(example, PROJECT_PAGE, "exec"), {})
    assert (tmp_path / "engine.db").is_file()


@pytest.fixture(scope="module")
def wheel(repo: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    # From a copy: setuptools leaves build/ behind and must not meet an old one.
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    shutil.copytree(
        repo / "dengine", source / "dengine", ignore=shutil.ignore_patterns("__pycache__")
    )
    for folder in ("models", "training", "tests", "notebooks"):
        (source / folder).mkdir()
        (source / folder / "__init__.py").touch()  # a trap: none of these may be packaged
    for name in ("pyproject.toml", "LICENSE"):
        shutil.copy(repo / name, source / name)
    command = [
        sys.executable,
        "-m",
        "build",
        "--wheel",
        "--no-isolation",
        "--outdir",
        str(out),
        str(source),
    ]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    (built,) = out.glob("*.whl")
    return built


@pytest.mark.merge
def test_the_wheel_has_dengine_whole_and_no_other_top_level_name(wheel: Path, repo: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    assert {name.split("/")[0] for name in names} == {
        "dengine",
        f"dengine-{dengine.__version__}.dist-info",
    }
    modules = {str(p.relative_to(repo)) for p in (repo / "dengine").rglob("*.py")}
    assert modules <= names
    assert {
        "dengine/py.typed",
        "dengine/data/insertion.npz",
        "dengine/serve/page/static/uplot.LICENSE",
    } <= names
    sources = {
        p.relative_to(repo).as_posix()
        for p in (repo / "dengine" / "export" / "cpp").rglob("*")
        if p.is_file()
    }
    assert len(sources) > 10
    assert sources <= names
    assert f"dengine-{dengine.__version__}.dist-info/licenses/LICENSE" in names


HEAVY = {"matplotlib", "mujoco", "numba", "onnx", "onnxruntime", "umap"}
USE = """
import sys
sys.path[:0] = [{target!r}, {dependencies!r}]  # no .pth files
import dengine, numpy as np
from dengine import DataEngine, Recipe, load_dataset, replay
print(dengine.__file__)
DataEngine(recipe=Recipe("pca")).decide(np.random.default_rng(0).normal(size=100))
print(*{{name.partition(".")[0] for name in sys.modules}})
data = load_dataset("insertion")
print(len(data), data.X.shape[1])
print(len(replay(data, "pca", cycles=60).action))
"""


@pytest.fixture(scope="module")
def target(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("installed") / "site"


@pytest.fixture(scope="module")
def used(wheel: Path, target: Path) -> list[str]:
    """The lines that `USE` prints of the installed wheel: one process for several claims."""
    zipfile.ZipFile(wheel).extractall(target)  # what installing a pure wheel with --target does
    code = USE.format(target=str(target), dependencies=sysconfig.get_path("purelib"))
    return fresh(code, "-I", "-S", cwd=target.parent).splitlines()


@pytest.mark.merge
def test_the_wheel_works_where_there_is_no_checkout(
    used: list[str], target: Path, repo: Path
) -> None:
    where, _, size, played = used
    assert Path(where).is_relative_to(target)
    assert not Path(where).is_relative_to(repo)
    assert (size, played) == ("1503 1000", "60")


@pytest.mark.merge
def test_an_engine_with_pca_in_memory_loads_nothing_heavy(used: list[str]) -> None:
    loaded = {*used[1].split()}
    assert {"dengine", "torch"} <= loaded
    assert HEAVY & loaded == set(), "import it in the function that uses it"
