"""The sources are written, built and installed; a controller in C finds the package and decides as
Python does.
"""

import os
import shutil
import subprocess

import numpy as np
import pytest

import dengine
from dengine import export_torchscript, load_exported
from dengine.errors import OutputError
from dengine.export import export_sources, import_journal
from dengine.records import ACTIONS, Action
from tests.support.command_line import dengine as command
from tests.support.exports import trained

SAMPLES = 80


def run(*words: object, **options: object) -> str:
    command = list(map(str, words))
    done = subprocess.run(command, capture_output=True, text=True, check=False, **options)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    return done.stdout


def test_a_controller_in_c_finds_the_package_decides_as_python_does_and_its_labels_come_back(
    programs, repo, make_data, tmp_path
):
    prefix, build = tmp_path / "prefix", tmp_path / "build"
    run("cmake", "--install", programs, "--prefix", prefix)
    consumer = repo / "tests" / "slow" / "cpp" / "consumer"
    run("cmake", "-S", consumer, "-B", build, f"-DCMAKE_PREFIX_PATH={prefix}")
    run("cmake", "--build", build)
    store, key = tmp_path / "engine.db", tmp_path / "cell.key"
    assert command("export", "--make-key", key).exit_code == 0
    with trained(make_data(400, SAMPLES), store) as engine:
        file = export_torchscript(engine, tmp_path / "model.ts", key=key)
    X = make_data(120, SAMPLES, seed=9).X
    X[3, 4], X[5] = np.nan, 1.5
    X.tofile(tmp_path / "traces.f32")
    words = file, tmp_path / "traces.f32", key, tmp_path / "cell.csv"
    german = os.environ | {"LC_ALL": "de_DE.UTF-8"}
    *lines, last = run(build / "consumer", *words, env=german).splitlines()
    expected = [*map(load_exported(file, key=key).decide, X)]
    for line, decision in zip(lines, expected, strict=True):
        action = ACTIONS.index(decision.action)
        reference = action, decision.reason, decision.n_success, decision.n_failure
        assert line.split()[1:] == list(map(str, reference))
    actions = [d.action for d in expected]
    assert set(actions) == set(Action)
    assert last == f"{dengine.__version__} 120 0"
    report = import_journal(store, tmp_path / "cell.csv")
    stops = actions[::10].count(Action.ACCEPT)
    assert report.imported + report.quarantined == stops + actions.count(Action.VERIFY)
    assert report.quarantined == 2


def test_the_sources_come_into_an_empty_folder_alone(tmp_path):
    assert command("export", "--cpp", tmp_path / "cell").exit_code == 0
    assert (tmp_path / "cell" / "VERSION").read_text() == f"{dengine.__version__}\n"
    with pytest.raises(OutputError, match="Expected a new or an empty folder"):
        export_sources(tmp_path / "cell")


@pytest.mark.skipif(shutil.which("cmake") is None, reason="needs cmake")
def test_without_libtorch_the_onnx_program_is_built_alone(tmp_path):
    sources = export_sources(tmp_path / "cell")
    run("cmake", "-S", sources, "-B", tmp_path / "build", "-DDENGINE_TORCH=OFF")
    targets = run("cmake", "--build", tmp_path / "build", "--target", "help")
    assert "dengine-onnx" in targets
    assert "dengine-cell" not in targets
