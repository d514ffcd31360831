"""What a user imports: small, complete, and with its dependencies declared. `test_release.py` has what
is in the wheel.
"""

import re
import subprocess
import sys
import tomllib
from importlib.metadata import packages_distributions
from itertools import chain

import pytest

import dengine


def fresh(code: str) -> str:
    """What code prints in a fresh interpreter."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_importing_dengine_loads_nothing_but_the_standard_library_and_its_lazy_loader():
    code = "import sys; before = set(sys.modules); import dengine; print(*sorted(set(sys.modules) - before))"
    tops = {name.split(".")[0] for name in fresh(code).split()}
    assert "dengine" in tops
    assert tops - {"dengine", "lazy_loader"} <= set(sys.stdlib_module_names)


def test_every_public_name_is_there_and_listed():
    assert sorted(dengine.__all__) == sorted(set(dengine.__all__))
    for name in dengine.__all__:
        assert getattr(dengine, name) is not None
        assert name in dir(dengine)
    with pytest.raises(AttributeError, match=r"attribute '?Dataengine"):
        dengine.Dataengine  # noqa: B018 -- the access is what is tested


PROJECT_PAGE = "dengine/data/project_page.md"


def test_the_page_of_an_index_has_no_link_that_leads_into_a_checkout_and_its_example_runs(
    repo, tmp_path, monkeypatch
):
    page = (repo / PROJECT_PAGE).read_text("utf-8")
    assert "](" not in page
    (example,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    monkeypatch.chdir(tmp_path)
    exec(compile(example, PROJECT_PAGE, "exec"), {})
    assert (tmp_path / "engine.db").is_file()


def test_every_package_that_is_imported_is_declared(repo):
    code = "\n".join(path.read_text("utf-8") for path in (repo / "dengine").rglob("*.py"))
    imports = r"^ *(?:from (\w+)[.\w]* import |import (\w+)[.\w]*(?: as \w+)?$)"
    packages = set(chain(*re.findall(imports, code, re.M))) - {"", *sys.stdlib_module_names}
    assert {"torch", "uvicorn"} <= packages
    project = tomllib.loads((repo / "pyproject.toml").read_text("utf-8"))["project"]
    declared = [*project["dependencies"], *chain(*project["optional-dependencies"].values())]
    names = {canonical(re.split(r"[<>=;\[]", requirement)[0]) for requirement in declared}
    installed = packages_distributions()
    for package in packages - {"dengine"}:
        assert names & {*map(canonical, installed.get(package, [package]))}, package


def canonical(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name.strip()).lower()
