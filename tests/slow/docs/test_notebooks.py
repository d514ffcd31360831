"""The walkthroughs are committed as they ran, with pictures and without errors, and run again from their code alone.

Cells that take long run again with fewer replays and parts; those that are exact run as they are.

After a change: `jupyter execute --inplace notebooks/NAME.ipynb`, and look at every picture.
"""

import copy
from pathlib import Path
from typing import Any

import pytest

FOLDER = Path(__file__).parents[3] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
BIGGEST = 600_000  # bytes, pictures included
SMALLER = {  # by notebook: what makes its long cells quick; never in an exact one
    "comparing_reducers": {
        "replay(data, recipe, seed=0)": "replay(data, recipe, seed=0, cycles=400)",
        "[1, 60, 400, 800, 1500]": "[1, 60, 400]",
        "seeds=[0, 1], cycles=600": "seeds=[0, 1], cycles=120",
        "range(100, 1501, 100)": "(100, 400, 1500)",
        "(200, 800, 1500)": "(100, 400)",
        "cycles=300": "cycles=100",
    },
    "corrections": {"range(200)": "range(20)"},
    "recordings_to_deployment": {"--repeats 2": "--repeats 1 --cycles 80"},
    "training_an_encoder": {"range(1, 13)": "range(1, 4)", "cycles=400": "cycles=120"},
    "shadow_and_costs": {
        '"alphas": (0.5, 0.1, 0.05)': '"alphas": (0.5, 0.1)',
        '"repeats": 6': '"repeats": 2',
    },
    "the_guarantee_seen": {
        "n_parts = 400": "n_parts = 160",
        "for seed in range(4)": "for seed in range(1)",
        "cycles=500": "cycles=150",
        "cycles=900": "cycles=300",
    },
}


def read(path: Path) -> Any:
    return pytest.importorskip("nbformat").read(path, as_version=4)


def outputs(notebook: Any) -> list[Any]:
    return [out for cell in notebook.cells for out in cell.get("outputs", [])]


def text(cell: Any) -> str:
    """What a cell printed, and what it shows as text, in one piece: a kernel may send it in several."""
    return "".join(
        out.get("text", out.get("data", {}).get("text/plain", "")) for out in cell.outputs
    )


def exact(notebook: Any) -> list[Any]:
    """The cells whose output depends on no machine: seeded counts, files that are read, and no model."""
    return [cell for cell in notebook.cells if "exact" in cell.metadata.get("tags", [])]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_a_notebook_is_committed_as_it_ran_small_and_shows_no_folder_of_its_author(
    path: Path,
) -> None:
    notebook = read(path)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    assert not [
        out
        for out in outputs(notebook)
        if out.output_type == "error" or out.get("name") == "stderr"
    ]
    assert any("image/png" in out.get("data", {}) for out in outputs(notebook))
    assert any(text(cell) for cell in exact(notebook))
    assert path.stat().st_size < BIGGEST
    shown = "".join(map(text, code))
    assert not [
        folder
        for folder in ("/home/", "/root/", "/tmp/", "/Users/", str(FOLDER.parent))
        if folder in shown
    ]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_a_notebook_runs_anew_and_its_exact_cells_say_what_they_said(path: Path) -> None:
    nbclient = pytest.importorskip("nbclient")
    committed = read(path)
    notebook = copy.deepcopy(committed)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    for cell in code:
        cell.outputs = []
    left = [cell for cell in code if cell not in exact(notebook)]
    for long, short in SMALLER[path.stem].items():
        assert any(long in cell.source for cell in left), (
            f"{long} is in no cell that may be shorter"
        )
        for cell in left:
            cell.source = cell.source.replace(long, short)
    there = {"metadata": {"path": str(FOLDER)}}
    done = nbclient.NotebookClient(
        notebook, timeout=240, kernel_name="python3", resources=there
    ).execute()  # raises
    assert any("image/png" in out.get("data", {}) for out in outputs(done))
    assert [text(cell) for cell in exact(done)] == [text(cell) for cell in exact(committed)]
