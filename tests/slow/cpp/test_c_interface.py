"""The sources are written, built and installed; a controller in C finds the package and decides as
Python does.
"""

import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

import dengine
from dengine import Dataset, export_torchscript, load_exported
from dengine.errors import OutputError
from dengine.export import export_sources, import_journal
from dengine.records import ACTIONS, REASONS, Action
from tests.support.command_line import dengine as command
from tests.support.exports import trained

SAMPLES = 80


def run(*command: object, **options: object) -> str:
    done = subprocess.run(
        list(map(str, command)), capture_output=True, text=True, check=False, **options
    )
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    return done.stdout


def test_a_controller_in_c_finds_the_package_decides_as_python_does_and_its_labels_come_back(
    programs: Path, repo: Path, make_data: Callable[..., Dataset], tmp_path: Path
) -> None:
    prefix, build = tmp_path / "prefix", tmp_path / "build"
    run("cmake", "--install", programs, "--prefix", prefix)
    run(
        "cmake",
        "-S",
        repo / "tests" / "slow" / "cpp" / "consumer",
        "-B",
        build,
        f"-DCMAKE_PREFIX_PATH={prefix}",
    )
    run("cmake", "--build", build)
    store, key = tmp_path / "engine.db", tmp_path / "cell.key"
    assert command("export", "--make-key", key).exit_code == 0
    with trained(make_data(400, SAMPLES), store) as engine:
        file = export_torchscript(engine, tmp_path / "model.ts", key=key)
    X = make_data(120, SAMPLES, seed=9).X
    X[3, 4], X[5] = np.nan, 1.5
    X.tofile(tmp_path / "traces.f32")
    journal = tmp_path / "cell.csv"
    completed = run(
        build / "consumer",
        file,
        tmp_path / "traces.f32",
        key,
        journal,
        env=os.environ | {"LC_ALL": "de_DE.UTF-8"},
    )
    *lines, last = completed.splitlines()
    expected = [*map(load_exported(file, key=key).decide, X)]
    for line, decision in zip(lines, expected, strict=True):
        id_, *words = line.split()
        assert len(id_.split("-")[0]) == 12
        reference = [
            ACTIONS.index(decision.action),
            decision.reason,
            decision.n_success,
            decision.n_failure,
        ]
        assert words == list(map(str, reference))
    assert {d.action for d in expected} == set(Action)
    assert last == f"{dengine.__version__} 120 0"
    report = import_journal(store, journal)
    stops = sum(d.action is Action.ACCEPT for d in expected[::10])
    assert report.imported + report.quarantined == stops + sum(
        d.action is Action.VERIFY for d in expected
    )
    assert report.quarantined == 2


@pytest.mark.slow  # it compiles torch's headers once more; dengine-cell loads the same module
def test_libtorch_alone_decides_by_calling_the_module(
    programs: Path, repo: Path, make_data: Callable[..., Dataset], tmp_path: Path
) -> None:
    with trained(make_data(400, SAMPLES)) as engine:
        file = export_torchscript(engine, tmp_path / "model.ts")
    X = make_data(60, SAMPLES, seed=9).X
    X.tofile(tmp_path / "traces.f32")
    build, where = tmp_path / "build", f"-DCMAKE_PREFIX_PATH={torch.utils.cmake_prefix_path}"
    run(
        "cmake",
        "-S",
        repo / "tests" / "slow" / "cpp" / "plain",
        "-B",
        build,
        where,
    )
    run("cmake", "--build", build)
    lines = run(build / "plain", file, SAMPLES, tmp_path / "traces.f32").splitlines()
    expected = [(d.action, d.reason) for d in map(load_exported(file).decide, X)]
    assert [(ACTIONS[int(a)], REASONS[int(r)]) for a, r in map(str.split, lines)] == expected
    assert len({action for action, _ in expected}) > 1


def test_the_sources_come_into_an_empty_folder_alone(tmp_path: Path) -> None:
    done = command("export", "--cpp", tmp_path / "cell")
    assert done.exit_code == 0
    assert (tmp_path / "cell" / "VERSION").read_text() == f"{dengine.__version__}\n"
    assert (tmp_path / "cell" / "include" / "dengine.h").is_file()
    with pytest.raises(OutputError, match="Expected a new or an empty folder"):
        export_sources(tmp_path / "cell")


def test_without_libtorch_the_onnx_program_is_built_alone(tmp_path: Path) -> None:
    if shutil.which("cmake") is None:
        pytest.skip("needs cmake")
    sources = export_sources(tmp_path / "cell")
    run("cmake", "-S", sources, "-B", tmp_path / "build", "-DDENGINE_TORCH=OFF")
    targets = run("cmake", "--build", tmp_path / "build", "--target", "help")
    assert "dengine-onnx" in targets
    assert "dengine-cell" not in targets
