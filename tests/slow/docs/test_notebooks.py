"""The notebooks are stored as they ran, without errors, and their code still runs.

Cells that take long run with fewer replays and parts. Cells with the tag "exact" run unchanged,
and must print what is stored. After a change: `jupyter execute --inplace notebooks/NAME.ipynb`,
and look at every picture.
"""

import copy
from pathlib import Path
from typing import Any

import pytest

FOLDER = Path(__file__).parents[3] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
MAX_BYTES = 600_000  # of a notebook with its pictures
# Notebook -> text of its code, and the text that replaces it to make long cells quick.
SMALLER = {
    "comparing_reducers": {
        "replay(data, recipe, seed=0)": "replay(data, recipe, seed=0, cycles=400)",
        "[1, 60, 400, 800, 1500]": "[1, 60, 400]",
        "seeds=[0, 1], cycles=600": "seeds=[0, 1], cycles=120",
        "range(100, 1501, 100)": "(100, 400, 1500)",
        "(200, 800, 1500)": "(100, 400)",
        "cycles=300": "cycles=100",
    },
    "recordings_to_deployment": {"repeats=2": "repeats=1, cycles=80"},
    "shadow_and_costs": {'"repeats": 6': '"repeats": 2'},
    "the_guarantee_seen": {
        "n_parts = 400": "n_parts = 160",
        "for seed in range(4)": "for seed in range(1)",
        "cycles=500": "cycles=150",
        "cycles=900": "cycles=300",
    },
    "training_an_encoder": {"range(1, 13)": "range(1, 4)", "cycles=400": "cycles=120"},
}

every_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def read(path: Path) -> Any:
    return pytest.importorskip("nbformat").read(path, as_version=4)


def code_cells(notebook: Any) -> list[Any]:
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def exact_cells(notebook: Any) -> list[Any]:
    return [cell for cell in notebook.cells if "exact" in cell.metadata.get("tags", [])]


def has_picture(notebook: Any) -> bool:
    outputs = [output for cell in code_cells(notebook) for output in cell.outputs]
    return any("image/png" in output.get("data", {}) for output in outputs)


def printed(cell: Any) -> str:
    """Join what a cell printed and shows as text; a kernel may send it in several outputs."""
    return "".join(
        output.get("text", output.get("data", {}).get("text/plain", "")) for output in cell.outputs
    )


@every_notebook
def test_a_notebook_is_stored_as_it_ran_without_errors_and_paths(path):
    notebook = read(path)
    cells = code_cells(notebook)
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    assert "'output_type': 'error'" not in str(cells)
    assert "'name': 'stderr'" not in str(cells)
    assert has_picture(notebook)
    assert any(printed(cell) for cell in exact_cells(notebook))
    assert path.stat().st_size < MAX_BYTES
    text = "".join(printed(cell) for cell in cells)
    for folder in ("/home/", "/root/", "/tmp/", "/Users/", str(FOLDER.parent)):
        assert folder not in text


@every_notebook
def test_a_notebook_runs_and_its_exact_cells_print_what_is_stored(path):
    nbclient = pytest.importorskip("nbclient")
    stored = read(path)
    notebook = copy.deepcopy(stored)
    exact = exact_cells(notebook)
    others = [cell for cell in code_cells(notebook) if cell not in exact]
    for long, short in SMALLER[path.stem].items():
        assert any(long in cell.source for cell in others), f"{long} is in no cell"
        for cell in others:
            cell.source = cell.source.replace(long, short)
    client = nbclient.NotebookClient(
        notebook,
        timeout=240,  # of each cell
        kernel_name="python3",
        resources={"metadata": {"path": str(FOLDER)}},
    )
    executed = client.execute()
    assert has_picture(executed)
    assert [printed(cell) for cell in exact_cells(executed)] == [
        printed(cell) for cell in exact_cells(stored)
    ]
