"""Data that many tests share: small, synthetic, insertion-like; the real set where it is
at hand.
"""

from __future__ import annotations

import gc
import os

# A collection goes through the objects of every imported library, and frees next to nothing.
gc.set_threshold(50_000)
os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch: one thread is steadier at these sizes
os.environ.setdefault(
    "DENGINE_STORE_WAIT", "30"
)  # a disk that others use stalls for longer than a cell would wait

import shutil
import signal
import subprocess
import uuid
from pathlib import Path
from typing import TYPE_CHECKING

REPO = Path(__file__).resolve().parents[1]
os.environ.setdefault(
    "NUMBA_CACHE_DIR", str(REPO / "build" / "numba")
)  # before umap: what it compiled is kept

import pytest

if TYPE_CHECKING:  # what loads torch waits: the process that starts the workers runs no test
    from dengine import Dataset

signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background ignores it
SCREW_DRIVING = REPO.parent / "shared" / "data" / "screw_driving.npz"


# Files that take longest come first: a long one that begins last keeps one core waiting for the
# other.
LONG = (
    "test_docs",
    "test_golden",
    "test_release",
    "test_notebooks",
    "test_data_verb",
    "test_page",
    "test_requests",
    "test_null",
    "test_training",
    "test_cli",
    "test_serve_process",
    "test_without_posix",
    "test_estimators",
    "test_feedback",
    "test_fleet",
    "test_serve_http",
    "test_reducers",
    "test_reading",
    "test_export",
    "test_engine",
    "test_corrections",
    "test_settings",
)
# The C++ programs are built once, by one worker; each process that uses umap-learn compiles it
# anew, for 25 s.
PROGRAMS = ("test_cpp", "test_cell_program", "test_c_interface", "test_onnx_program", "test_golden")
GROUPS = dict.fromkeys(PROGRAMS, "cpp")
GROUPS |= dict.fromkeys(("test_estimators", "test_reducers", "test_umap"), "umap-learn")
# `make test` leaves out what is slow: these folders, and the cases of other tests that have these
# names.
SLOW = REPO / "tests" / "slow"
SLOW_CASES = ("umap-learn", "UmapLearn", "postgres", "minirocket")
# What is slow and yet run before each merge: tests that start many processes, a browser or a
# compiler. Single tests are marked where they stand.
MERGE = (
    "test_without_posix",
    "test_serve_process",
    "test_page",
    "test_read_only",
    "test_cpp",
    "test_c_interface",
    "test_onnx_program",
    "test_estimators",
    "test_store_postgres",
    "test_site",
)


@pytest.hookimpl(tryfirst=True)  # before xdist reads the groups, and -m the marks
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark tiers and groups; long files first, and a file's own order stays as it is."""
    items.sort(key=lambda item: LONG.index(item.path.stem) if item.path.stem in LONG else len(LONG))
    for item in items:
        stem, case = item.path.stem, item.callspec.id if hasattr(item, "callspec") else ""
        item.add_marker(pytest.mark.xdist_group(GROUPS.get(stem, stem)))
        is_slow_case = any(name in case for name in SLOW_CASES)
        is_marked = item.get_closest_marker("slow") is not None
        if not is_marked and ("postgres" in case or (stem in MERGE and not is_slow_case)):
            item.add_marker("merge")
        if item.get_closest_marker("merge") or SLOW in item.path.parents or is_slow_case:
            item.add_marker("slow")


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_node_collection_finished(node, ids: list[str]) -> None:
    """End where the groups are not in force: files would be split, and two workers build the same
    programs at once.
    """
    if node.config.getoption("dist") == "loadgroup" and not all("@" in name for name in ids):
        pytest.exit(
            "these versions of pytest and pytest-xdist do not keep groups of tests together",
            returncode=4,
        )


def insertion_like(
    n: int = 200,
    samples: int = 100,
    channels: int = 1,
    *,
    seed: int = 0,
    failures: float = 0.2,
    noise: float = 0.5,
) -> Dataset:
    """n traces as `toy_traces` has them: a failure that met the rim early stays on a plateau
    (newtons).
    """
    from dengine import Dataset
    from dengine.testing import toy_traces

    X, y = toy_traces(n, samples, channels, seed, failures, noise)
    return Dataset(X[:, 0] if channels == 1 else X, y.astype("int8"), name="insertion-like")


@pytest.fixture(scope="session")
def programs(tmp_path_factory):
    """The folder of the built libraries and programs; kept, so that only the first run compiles."""
    missing = [tool for tool in ("cmake", "g++") if shutil.which(tool) is None]
    if missing:
        message = f"building the cell program needs {' and '.join(missing)}"
        if os.environ.get("DENGINE_REQUIRE_CPP") == "1":
            pytest.fail(message)
        pytest.skip(message)
    import torch

    from dengine.export import export_sources

    sources, build = REPO / "build" / "cell_sources", REPO / "build" / "cell"
    written = export_sources(tmp_path_factory.mktemp("cell") / "sources")
    for file in (path for path in written.rglob("*") if path.is_file()):
        kept = sources / file.relative_to(written)
        if (
            not kept.exists() or kept.read_bytes() != file.read_bytes()
        ):  # what has not changed is not compiled again
            kept.parent.mkdir(parents=True, exist_ok=True)
            kept.write_bytes(file.read_bytes())
    prefix = f"-DCMAKE_PREFIX_PATH={torch.utils.cmake_prefix_path}"
    for command in (
        ["cmake", "-S", str(sources), "-B", str(build), prefix],
        ["cmake", "--build", str(build), "--parallel", "2", "--target", "all", "sha256sum_check"],
    ):
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    return build


@pytest.fixture(scope="session")
def make_data():
    return insertion_like


@pytest.fixture(scope="session")
def data():
    return insertion_like(200)


@pytest.fixture(scope="session")
def repo():
    return REPO


@pytest.fixture(scope="session")
def screw_driving():
    if not SCREW_DRIVING.is_file():
        pytest.skip(f"the real screw-driving set is not at {SCREW_DRIVING}")
    return SCREW_DRIVING


@pytest.fixture(scope="session")
def proof_repeats():
    """Repeats of a statistical test: few in `make test`, many in `make proof`."""
    return int(os.environ.get("DENGINE_PROOF_REPEATS", "2"))


@pytest.fixture(scope="session")
def stream():
    """Parts that come one after the other; a file that needs fewer, or more, has its own."""
    return insertion_like(400, samples=60, seed=3)


POSTGRES = os.environ.get("DENGINE_TEST_POSTGRES")
NO_POSTGRES = "DENGINE_TEST_POSTGRES is unset: . .ci/postgres.sh"
DATABASES = [
    "sqlite",
    pytest.param("postgres", marks=pytest.mark.skipif(not POSTGRES, reason=NO_POSTGRES)),
]


def url_of(kind: str, directory: Path) -> str | None:
    if kind == "memory":
        return None
    return str(directory / "engine.db") if kind == "sqlite" else str(POSTGRES)


@pytest.fixture
def database(tmp_path, monkeypatch):
    """A new database on the PostgreSQL server, whose other users are left alone."""
    import sqlalchemy as sa

    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    url, name = sa.make_url(POSTGRES), f"test_{uuid.uuid4().hex}"
    admin = sa.create_engine(url, isolation_level="AUTOCOMMIT")
    with admin.connect() as connection:
        connection.execute(sa.text(f"CREATE DATABASE {name}"))
        yield url.set(database=name).render_as_string(hide_password=False)
        connection.execute(sa.text(f"DROP DATABASE {name} WITH (FORCE)"))
    admin.dispose()


@pytest.fixture(params=["memory", *DATABASES])
def store(request, tmp_path):
    """A new store of each kind."""
    from dengine import SqlStore

    cell_id = uuid.uuid4().hex  # one PostgreSQL database serves every test
    created = SqlStore(url_of(request.param, tmp_path), cell_id)
    yield created
    created.close()


@pytest.fixture(params=DATABASES)
def place(request, tmp_path):
    """A URL and a cell of its own, to open again and again."""
    return url_of(request.param, tmp_path), uuid.uuid4().hex
