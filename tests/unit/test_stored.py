"""A store as a data set: what was recorded in the shadow mode is replayed as recordings are."""

from pathlib import Path

import numpy as np
import pytest

from dengine import DataEngine, Dataset, Recipe, ReplayCell, load_dataset, replay
from dengine.errors import DataError

RECIPE = Recipe("pca", radius=0.5, retrain_every=40)


@pytest.fixture(scope="module")
def stream(make_data) -> Dataset:
    return make_data(120, samples=60, seed=3)


@pytest.fixture(scope="module")
def store(stream: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("stored") / "cell.db"
    with DataEngine(recipe=RECIPE, store=path, trace=stream.spec) as engine:
        engine.set_shadow(True)
        list(engine.run(ReplayCell(stream, np.arange(len(stream))), len(stream)))
    return path


def test_in_the_shadow_mode_every_part_is_in_it_in_order_and_replays_as_its_recording(
    store: Path, stream: Dataset
) -> None:
    data = load_dataset(store)
    assert data.X.shape == stream.X.shape
    assert np.array_equal(data.X, stream.X)
    assert np.array_equal(data.y, stream.y)
    assert (data.name, data.rate_hz, data.unit, data.part) == (
        "cell",
        stream.spec.rate_hz,
        stream.unit,
        None,
    )
    lower = [replay(item, RECIPE, seed=0).lower for item in (data, stream)]
    assert np.array_equal(*lower)


def test_corrected_labels_count_and_forgotten_and_bad_traces_do_not(
    stream: Dataset, tmp_path: Path
) -> None:
    path = tmp_path / "cell.db"
    with DataEngine(recipe=RECIPE, store=path) as engine:
        ids = [engine.decide(x).id for x in stream.X[:12]]
        bad = engine.decide(np.full(60, np.nan)).id
        for id_ in [*ids, bad]:
            engine.report(id_, success=True)
        engine.correct(ids[3], success=False)
        engine.forget(ids[5])
    data = load_dataset(path)
    assert np.array_equal(data.X, np.delete(stream.X[:12], 5, axis=0))
    assert np.flatnonzero(data.y == 0).tolist() == [3]


def test_a_part_that_came_twice_is_one_part_there_too(stream: Dataset, tmp_path: Path) -> None:
    path = tmp_path / "cell.db"
    with DataEngine(recipe=RECIPE, store=path) as engine:
        for x, part in zip(stream.X[:3], ("A", "B", "A"), strict=True):
            engine.report(engine.decide(x, part=part).id, success=True)
    part = load_dataset(path).part
    assert part is not None
    assert (part[0] == part[2], part[0] == part[1]) == (True, False)


def test_a_store_without_a_label_is_refused(tmp_path: Path) -> None:
    DataEngine(recipe=RECIPE, store=tmp_path / "new.db").close()
    with pytest.raises(
        DataError, match=r"Expected a store with labelled traces, .* has none; record some first"
    ):
        load_dataset(tmp_path / "new.db")
