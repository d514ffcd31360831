"""The trained files in models/ are whole, load here, and say what they are."""

from pathlib import Path

import numpy as np
import pytest

from dengine import load_dataset, load_exported

MODELS = sorted((Path(__file__).parents[2] / "models").glob("*/model.ts"))


@pytest.mark.parametrize("path", MODELS, ids=lambda p: p.parent.name)
def test_a_shipped_model_is_certain_and_right_of_most_of_its_own_data_and_its_card_says_what_made_it(
    path: Path,
) -> None:
    model, data = load_exported(path), load_dataset("insertion")
    assert model.metadata["references"] == len(data)
    decisions = [model.decide(x) for x in data.X[:300]]
    accepted = np.array([d.action == "accept" for d in decisions])
    rejected = np.array([d.action == "reject" for d in decisions])
    assert (accepted | rejected).mean() > 0.5
    assert data.y[:300][accepted].mean() >= model.metadata["lower_bound"]
    assert f"--out models/{path.parent.name}" in (path.parent / "card.md").read_text(
        encoding="utf-8"
    )
