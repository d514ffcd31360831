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
from tests.support.programs import Program, must_agree

# Looked for, not imported: that would take every worker seconds.
NEEDED = ("onnx", "onnxruntime", "onnxscript")
pytestmark = pytest.mark.skipif(not all(map(find_spec, NEEDED)), reason=f"needs {NEEDED}")


def library() -> Path:
    """onnxruntime's shared library, as its package for Python brings it."""
    names = sorted(
        (Path(find_spec("onnxruntime").origin).parent / "capi").glob("libonnxruntime.so*")
    )
    if not names:
        pytest.skip("this onnxruntime brings no shared library of its own")
    return names[0]


@pytest.fixture(scope="module")
def signed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A model of the bundled data, and the key that it was signed with."""
    data, folder = load_dataset("insertion"), tmp_path_factory.mktemp("onnx")
    classifier = WilsonRadiusClassifier(alpha=0.1, lower_bound=0.9)
    model = ModelPrediction("pca", classifier).fit(data.X[:700], data.y[:700])
    key = make_key(folder / "cell.key")
    return export_onnx(
        model, folder / "model.onnx", trace=TraceSpec(1000, limit=500.0), key=key
    ), key


def program(programs: Path, *arguments: Any, runtime: Any = None) -> Program:
    env = os.environ | {"DENGINE_ONNXRUNTIME": str(library() if runtime is None else runtime)}
    return Program(programs, *arguments, name="dengine-onnx", env=env)


def test_it_decides_on_the_bundled_traces_as_python_does_and_verifies_the_bad_ones(
    programs: Path, signed
) -> None:
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


def test_it_learns_nothing_and_says_so(
    programs: Path, signed: tuple[Path, Path], tmp_path: Path
) -> None:
    learns_nothing = "a model in ONNX learns nothing"
    with program(programs, signed[0]) as cell:
        assert (
            cell.ask("label x-1 1")
            == f"error {learns_nothing}; export TorchScript"
            == cell.ask("stop x-1")
        )
        assert cell.decide(np.ones(2))[:3] == ["-", "verify", "malformed"]
        assert cell.end()[0] == 1
    with program(programs, signed[0], "--journal", tmp_path / "cell.csv") as cell:
        cell.must_refuse(learns_nothing)


def flip(file: Path) -> None:
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)


def replace(file: Path) -> None:
    write_export(file, b"garbage", force=True, key=file.with_name("cell.key"))


SPOILT = {
    "flip": (flip, "its signature is not one by this key"),
    "foreign": (replace, "no loadable ONNX"),
    "no sum": (lambda file: file.with_name("model.onnx.sha256").unlink(), "copied together"),
    "unsigned": (lambda file: file.with_name("model.onnx.sig").unlink(), "the file is not signed"),
}


@pytest.mark.parametrize("kind", SPOILT)
def test_a_file_that_must_not_be_used_is_refused(
    programs: Path, signed, tmp_path: Path, kind: str
) -> None:
    shutil.copytree(signed[0].parent, tmp_path, dirs_exist_ok=True)
    spoil, expected = SPOILT[kind]
    spoil(file := tmp_path / "model.onnx")
    with program(programs, file, "--key", signed[1]) as cell:
        cell.must_refuse(expected)
    if kind == "flip":  # by its sum as well
        with program(programs, file) as cell:
            cell.must_refuse("it is damaged or truncated")


@pytest.mark.parametrize(
    ("runtime", "expected"),
    [("nothing.so", "name it in DENGINE_ONNXRUNTIME"), ("libm.so.6", "is no onnxruntime")],
)
def test_without_onnxruntime_it_says_where_to_name_it(
    programs: Path, signed, runtime: str, expected: str
) -> None:
    with program(programs, signed[0], runtime=runtime) as cell:
        cell.must_refuse(expected)
