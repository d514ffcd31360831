"""A store as a data set: what was recorded in the shadow mode is replayed as recordings are."""

import numpy as np
import pytest

from dengine import DataEngine, Recipe, load_dataset, replay
from dengine.errors import DataError
from tests.support.driving import drive

RECIPE = Recipe("pca", radius=0.5, retrain_every=40)


@pytest.fixture(scope="module")
def stream(make_data):
    return make_data(120, samples=60, seed=3)


def test_corrected_labels_count_and_forgotten_and_bad_traces_do_not_and_a_part_that_came_twice_is_one(
    stream, tmp_path
):
    path = tmp_path / "cell.db"
    with DataEngine(recipe=RECIPE, store=path) as engine:
        traces = [*stream.X[:12], np.full(60, np.nan)]
        ids = [engine.decide(x, part=i % 10).id for i, x in enumerate(traces)]
        for id_ in ids:
            engine.report(id_, success=True)
        engine.correct(ids[3], success=False)
        engine.forget(ids[5])
    data = load_dataset(path)
    assert np.array_equal(data.X, np.delete(stream.X[:12], 5, axis=0))
    assert np.flatnonzero(data.y == 0).tolist() == [3]
    assert data.part is not None
    assert len({*data.part}) == 9
    assert data.part[:2].tolist() == data.part[9:11].tolist()


def test_in_the_shadow_mode_every_part_is_in_it_in_order_and_replays_as_its_recording(
    stream, tmp_path
):
    path, spec = tmp_path / "cell.db", stream.spec
    with DataEngine(recipe=RECIPE, store=path, trace=spec) as engine:
        engine.set_shadow(True)
        drive(engine, stream)
    data = load_dataset(path)
    assert np.array_equal(data.X, stream.X)
    assert np.array_equal(data.y, stream.y)
    assert (data.name, data.rate_hz, data.unit) == ("cell", spec.rate_hz, stream.unit)
    assert data.part is None
    assert np.array_equal(*[replay(item, RECIPE, seed=0).lower for item in (data, stream)])


def test_a_store_without_a_label_is_refused(tmp_path):
    DataEngine(recipe=RECIPE, store=tmp_path / "new.db").close()
    with pytest.raises(DataError, match=r"labelled traces, .* has none; record some first"):
        load_dataset(tmp_path / "new.db")
