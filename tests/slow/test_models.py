"""The trained files in models/ are whole, load here, and say what they are."""

from pathlib import Path

import numpy as np
import pytest

from dengine import load_dataset, load_exported

MODELS = sorted((Path(__file__).parents[2] / "models").glob("*/model.ts"))


@pytest.mark.parametrize("path", MODELS, ids=lambda p: p.parent.name)
def test_a_shipped_model_is_certain_and_right_of_most_of_its_own_data_and_its_card_says_what_made_it(
    path,
):
    model, data = load_exported(path), load_dataset("insertion")
    assert model.metadata["references"] == len(data)
    actions = np.array([model.decide(x).action for x in data.X[:300]])
    assert (actions != "verify").mean() > 0.5
    assert data.y[:300][actions == "accept"].mean() >= model.metadata["lower_bound"]
    card = (path.parent / "card.md").read_text(encoding="utf-8")
    assert f"--out models/{path.parent.name}" in card
