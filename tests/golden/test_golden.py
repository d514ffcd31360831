"""Engines and exported files decide as they did before the modules were moved and merged, bit for
bit.
"""

import json
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from dengine import Action, Reason
from tests.support.programs import Program

GOLDEN = Path(__file__).parent
sys.path.insert(0, str(GOLDEN))
from golden import (
    STORIES,
    Arrays,
    Exported,
    Replayed,
    machine,
)  # the very lines that made what is kept

KEPT = GOLDEN / "default"
# Another processor or another NumPy may add in another order: one decision that differs moves the
# retrains after it.
SAME_MACHINE = json.loads((KEPT / "machine.json").read_text(encoding="utf-8")) == machine()
MOVED = 0.03  # share of decisions that another machine may take otherwise
EXPORTED = [name for name, story in STORIES.items() if isinstance(story, Exported)]


def kept(name: str) -> Arrays:
    with np.load(KEPT / f"{name}.npz") as file:
        return dict(file)


def assert_same(result: Arrays, expected: Arrays) -> None:
    if not SAME_MACHINE:
        assert (result["action"] != expected["action"]).mean() <= MOVED
        return
    assert set(result) == set(expected)
    for key, values in expected.items():
        np.testing.assert_array_equal(result[key], values, err_msg=key)
        assert (result[key].dtype, result[key].tobytes()) == (values.dtype, values.tobytes()), key


@pytest.mark.parametrize("name", [name for name in STORIES if name not in EXPORTED])
def test_an_engine_takes_every_decision_that_it_took(name: str, tmp_path: Path) -> None:
    if name.startswith("umap") and not SAME_MACHINE:
        pytest.skip(
            "another processor's umap-learn lays the traces out otherwise, and its decisions are other ones"
        )
    assert_same(STORIES[name].play(tmp_path), kept(name))


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Finds the file of a story, exported once."""
    files: dict[str, Path] = {}

    def find(name: str) -> Path:
        if name not in files:
            story = STORIES[name]
            assert isinstance(story, Exported)
            files[name] = story.export(tmp_path_factory.mktemp(name))
        return files[name]

    return find


@pytest.mark.parametrize("name", EXPORTED)
def test_an_exported_file_takes_every_decision_that_it_took(
    name: str, exported: Callable[[str], Path]
) -> None:
    assert_same(STORIES[name].ask(exported(name)), kept(name))


@pytest.mark.merge  # it compiles the program
@pytest.mark.parametrize("name", EXPORTED)
def test_the_cell_program_takes_the_same_decisions(
    name: str, exported, programs: Path, tmp_path: Path
) -> None:
    (data, labels), answers = STORIES[name].told(), []
    with Program(programs, exported(name), "--journal", tmp_path / "cell.csv") as cell:
        for x, part, label in zip(data.X, data.part, labels, strict=True):
            id_, *text, _ = cell.decide(x, part)  # without the time that it took
            answers.append(text)
            if label and text[0] != Action.REJECT:
                assert cell.ask(f"label {id_} {label}") == f"ok {id_}"
    words = np.array(answers)
    expected = kept(name)
    if not SAME_MACHINE:
        assert (words[:, 0] != expected["action"]).mean() <= MOVED
        return
    for column, key in enumerate(("action", "reason")):
        assert words[:, column].tolist() == expected[key].tolist()
    for column, key in enumerate(("lower", "upper", "n_success", "n_failure"), start=2):
        np.testing.assert_allclose(
            words[:, column].astype(float), expected[key], atol=1e-6, err_msg=key
        )
    points = expected["embedding"].reshape(len(words), -1)
    np.testing.assert_allclose(words[:, 6:].astype(float), points, rtol=1e-5, atol=1e-5)


def test_a_restart_changes_no_decision() -> None:
    whole, restarted = kept("parts"), kept("restarted")
    for key in whole:
        np.testing.assert_array_equal(restarted[key], whole[key], err_msg=key)


def test_what_is_kept_has_met_everything_that_it_stands_for() -> None:
    stories = {
        name: kept(name) for name, story in STORIES.items() if not isinstance(story, Replayed)
    }
    reasons = set(np.concatenate([item["reason"] for item in stories.values()]))
    never = {
        Reason.SATURATED,
        Reason.MODEL_ERROR,
        Reason.NO_STORE,
        Reason.LATE,
        Reason.OUTSIDE,
        Reason.TOO_LARGE,
    }
    assert reasons == {str(item) for item in set(Reason) - never}
    assert all(set(item["action"]) == {str(item) for item in Action} for item in stories.values())
    assert all(item["action"].shape == item["lower"].shape for item in stories.values())
    assert all(len(item["retrains"]) >= 2 for name, item in stories.items() if name not in EXPORTED)
