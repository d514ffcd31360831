"""dengine-onnx decides by files in ONNX as Python does, without libtorch, and refuses what it must
not use.
"""

import os
import shutil
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dengine import ModelPrediction, TraceSpec, WilsonRadiusClassifier, load_dataset
from dengine.export import export_onnx, load_onnx, make_key
from dengine.export.bundle import write_export
from dengine.records import Action, Reason
from tests.support.exports import NEEDS_ONNX
from tests.support.programs import Program, must_agree

pytestmark = NEEDS_ONNX


@pytest.fixture(scope="module")
def signed(tmp_path_factory):
    """A model of the bundled data, and the key that it was signed with."""
    data, folder = load_dataset("insertion"), tmp_path_factory.mktemp("onnx")
    classifier = WilsonRadiusClassifier(alpha=0.1, lower_bound=0.9)
    model = ModelPrediction("pca", classifier).fit(data.X[:700], data.y[:700])
    key, spec = make_key(folder / "cell.key"), TraceSpec(1000, limit=500.0)
    return export_onnx(model, folder / "model.onnx", trace=spec, key=key), key


def program(programs: Path, *arguments: Any, runtime: str = "") -> Program:
    """One that uses this library, or onnxruntime's as its package for Python brings it."""
    libraries = (Path(find_spec("onnxruntime").origin).parent / "capi").glob("libonnxruntime.so*")
    library = runtime or str(next(libraries, ""))
    if not library:
        pytest.skip("this onnxruntime brings no shared library of its own")
    env = os.environ | {"DENGINE_ONNXRUNTIME": library}
    return Program(programs, *arguments, name="dengine-onnx", env=env)


def test_it_decides_on_the_bundled_traces_as_python_does_and_verifies_the_bad_ones(
    programs, signed
):
    file, key = signed
    X = load_dataset("insertion").X[700:1000].copy()
    X[0, 3], X[1, 5], X[2, 0], X[3], X[4] = np.nan, -np.inf, 1e30, 2.5, X[4] * 9.0
    expected = [*map(load_onnx(file, key=key).decide, X)]
    with program(programs, file, "--key", key) as cell:
        answers = [cell.decide(x, f"P{i}") for i, x in enumerate(X)]
    must_agree(answers, expected, accuracy=1e-12)
    assert {words[0] for words in answers} == {"-"}  # no label of it can come
    assert {d.action for d in expected} >= {Action.ACCEPT, Action.VERIFY}
    bad = {Reason.NOT_FINITE, Reason.SATURATED, Reason.CONSTANT}
    assert bad <= {d.reason for d in expected}


def test_it_learns_nothing_and_says_so(programs, signed, tmp_path):
    learns_nothing = "a model in ONNX learns nothing"
    with program(programs, signed[0]) as cell:
        for line in ("label x-1 1", "stop x-1"):
            assert cell.ask(line) == f"error {learns_nothing}; export TorchScript"
        assert cell.decide(np.ones(2))[:3] == ["-", "verify", "malformed"]
        assert cell.end()[0] == 1
    with program(programs, signed[0], "--journal", tmp_path / "cell.csv") as cell:
        cell.must_refuse(learns_nothing)


@pytest.mark.parametrize(
    ("spoilt", "message"),
    [
        ("model.onnx", "its signature is not one by this key"),
        ("model.onnx.sha256", "copied together"),
        ("model.onnx.sig", "the file is not signed"),
    ],
)
def test_a_file_that_must_not_be_used_is_refused(programs, signed, tmp_path, spoilt, message):
    shutil.copytree(signed[0].parent, tmp_path, dirs_exist_ok=True)
    file = tmp_path / "model.onnx"
    (tmp_path / spoilt).unlink()
    if spoilt == "model.onnx":
        file.write_bytes(b"garbage")
        with program(programs, file) as cell:
            cell.must_refuse("it is damaged or truncated")
    with program(programs, file, "--key", signed[1]) as cell:
        cell.must_refuse(message)


def test_a_file_that_is_no_model_is_refused(programs, tmp_path):
    file = tmp_path / "model.onnx"
    write_export(file, b"garbage")
    with program(programs, file) as cell:
        cell.must_refuse("no loadable ONNX")


@pytest.mark.parametrize(
    ("runtime", "expected"),
    [("nothing.so", "name it in DENGINE_ONNXRUNTIME"), ("libm.so.6", "is no onnxruntime")],
)
def test_without_onnxruntime_it_says_where_to_name_it(programs, signed, runtime, expected):
    with program(programs, signed[0], runtime=runtime) as cell:
        cell.must_refuse(expected)
