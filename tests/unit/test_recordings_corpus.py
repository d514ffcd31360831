"""Every folder below `tests/recordings`: what is proposed for it, and what is read by it.

A folder holds recordings, the description that was saved for them, and `expected.json`: the open
keys of the proposal with what their notes show, the `set` that completes it, and what is read.
"""

import json
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from dengine.cli.options import parse_stated
from dengine.datasets import Dataset, describe, load_dataset
from dengine.datasets.read import places
from dengine.errors import DataError

CORPUS = Path(__file__).parents[1] / "recordings"
FOLDERS = sorted(path.parent for path in CORPUS.glob("*/expected.json"))
EXPECTED = {
    folder.name: json.loads((folder / "expected.json").read_text("utf-8")) for folder in FOLDERS
}
ASKED = [name for name, expected in EXPECTED.items() if "refused" not in expected]
REFUSED = [name for name in EXPECTED if name not in ASKED]
READ = [name for name in ASKED if "set" in EXPECTED[name]]  # a table of results cannot be read


def summary(data: Dataset) -> dict[str, Any]:
    """What `expected.json` states of a data set that was read; None for a lost sample."""
    samples = np.round(data.X.reshape(len(data), -1).astype(np.float64), 4)
    first, last = ([None if np.isnan(v) else v for v in samples[:, i].tolist()] for i in (0, -1))
    return {
        "labels": data.y.tolist(),
        "parts": None if data.part is None else data.part.tolist(),
        "channels": [*data.channels],
        "unit": data.unit,
        "rate_hz": data.rate_hz,
        "shape": [*data.X.shape],
        "first": pytest.approx(first, abs=1e-3),
        "last": pytest.approx(last, abs=1e-3),
        "faults": sorted([fault.source, fault.line, fault.column] for fault in data.faults),
        "unlabelled": data.unlabelled,
    }


@pytest.mark.parametrize("name", READ)
def test_a_saved_description_and_a_completed_proposal_read_what_was_recorded(name):
    expected = EXPECTED[name]
    source = CORPUS / name / expected["source"]
    data = load_dataset(source)
    completed = load_dataset(source, describe(source, parse_stated(expected["set"])))
    assert {key: expected[key] for key in summary(data)} == summary(data)
    np.testing.assert_array_equal(completed.X, data.X)
    for name in ("y", "part", "source"):
        assert np.array_equal(getattr(completed, name), getattr(data, name)), name


@pytest.mark.parametrize("name", ASKED)
def test_a_proposal_leaves_open_what_nothing_proves_and_shows_the_candidates(name):
    expected = EXPECTED[name]
    proposal = describe(CORPUS / name / expected["source"])
    assert sorted(proposal.open_keys) == sorted(expected["open"])
    for key, candidates in expected["open"].items():
        missing = [text for text in candidates if text not in proposal.notes[key]]
        assert not missing, proposal.notes[key]


def test_a_proposal_reads_a_listing_once(monkeypatch):
    read = Mock(wraps=places.read_file)
    monkeypatch.setattr(places, "read_file", read)
    describe(CORPUS / "a_listing_tells_the_order/data")
    read.assert_called_once()


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_described_is_refused_with_the_reason(name):
    with pytest.raises(DataError, match=EXPECTED[name]["refused"]):
        describe(CORPUS / name / EXPECTED[name]["source"])
