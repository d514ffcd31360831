"""Grids of replays: kept, gone on with, and the same on every backend."""

from dataclasses import replace
from importlib import import_module, reload
from pathlib import Path

import numpy as np
import pytest
from joblib import parallel_config
from sklearn.decomposition import PCA
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import FunctionTransformer, StandardScaler

from dengine import Recipe, replay, run_grid
from dengine.errors import SettingError
from dengine.experiments.grid import KeptReplays, Task, iterate_replays, load_contenders
from dengine.experiments.replay import Contender
from tests.support.driving import RECIPE
from tests.support.replays import same

TIMED = ["retrain_p50_s", "retrain_max_s", "decide_p50_us", "decide_p99_us", "seconds"]
GRID = {
    "alphas": (0.1, 0.5),
    "lower_bounds": (0.9,),
    "intervals": ("wilson",),
    "repeats": 2,
    "cycles": 70,
}


def test_another_setting_seed_length_or_data_is_another_replay_another_name_is_none(data, tmp_path):
    kept, who = KeptReplays(tmp_path, data), Contender.load(RECIPE)
    task = Task(who, seed=1, cycles=60)
    adding = [FunctionTransformer(np.add, kw_args={"x2": np.full(3, i)}) for i in range(2)]
    others = [who.with_policy(alpha=0.2), PCA(2), PCA(2, whiten=True), *adding, "knn"]
    tasks = [task, *(replace(task, contender=Contender.load(other)) for other in others)]
    changes = {"seed": 2, "cycles": 61, "shuffle": False}
    tasks += [replace(task, **{name: value}) for name, value in changes.items()]
    assert len({*map(kept.path, tasks)}) == len(tasks)
    assert kept.path(task) != KeptReplays(tmp_path, replace(data, y=1 - data.y)).path(task)
    assert kept.path(task) == kept.path(replace(task, contender=replace(who, name="mine")))


def test_a_reducer_without_a_source_is_not_kept(data, tmp_path):
    task = Task(Contender.load(FunctionTransformer(lambda x: x)), 0)
    with pytest.raises(SettingError, match="define it in a module"):
        KeptReplays(tmp_path, data).path(task)


def test_a_reducer_of_ones_own_is_played_again_when_its_source_changes(data, tmp_path, monkeypatch):
    source = "from sklearn.decomposition import PCA\n\nclass Own(PCA):\n    pass\n"
    module = tmp_path / "own_reducer_of_test_grid.py"
    module.write_text(source, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    loaded, kept = import_module(module.stem), KeptReplays(tmp_path / "kept", data)

    def paths() -> list[Path]:
        asked = (make_pipeline(StandardScaler(), loaded.Own()), f"{module.stem}:Own")
        return [kept.path(Task(Contender.load(custom), seed=1)) for custom in asked]

    before = paths()
    module.write_text(source + "    # changed\n", encoding="utf-8")
    assert paths() == before  # what is being played is what was imported, not the file of now
    reload(loaded)
    assert not {*paths()} & {*before}


def test_a_file_is_whole_or_not_there_wherever_it_is_damaged(data, tmp_path):
    task, rng = Task(Contender.load(RECIPE), seed=1, cycles=50), np.random.default_rng(0)
    kept, played = KeptReplays(tmp_path, data), replay(data, RECIPE, seed=1, cycles=50)
    kept.put(task, played)
    path, whole = kept.path(task), kept.path(task).read_bytes()
    same(kept.get(task), played)
    for size in [1, 3, 50] * 10:
        damaged = np.frombuffer(whole, dtype=np.uint8).copy()
        damaged[rng.integers(len(damaged), size=size)] = rng.integers(256, size=size)
        path.write_bytes(damaged.tobytes())
        back = kept.get(task)
        assert back is None or back.lower.tolist() == played.lower.tolist()
    path.write_bytes(b"")
    (again,) = iterate_replays(data, [task], keep=tmp_path)
    assert not again.kept
    same(kept.get(task), played)


def test_a_grid_that_is_run_again_plays_nothing_again(data, tmp_path):
    first, again = (run_grid(data, [RECIPE], **GRID, n_jobs=1, keep=tmp_path) for _ in range(2))
    assert first.equals(again)  # times and all
    assert len([*tmp_path.iterdir()]) == len(first) == 4


def test_two_of_one_name_and_policy_are_refused_and_another_policy_is_not():
    plain = Recipe("pca", radius=0.5)
    load_contenders([plain, plain.with_policy(guarantee="pooled", stops="all")])
    with pytest.raises(SettingError, match=r"a name of its own for each.*by Contender\(name"):
        load_contenders([plain, replace(plain, radius=0.3)])


def test_a_baseline_that_cannot_be_imported_is_refused_before_anything_is_played(data, tmp_path):
    absent = replace(Contender.load("always"), baseline="no_such_module:Baseline")
    with pytest.raises(SettingError, match="no_such_module:Baseline"):
        run_grid(data, [RECIPE, absent], **GRID, n_jobs=1, keep=tmp_path)
    assert list(tmp_path.iterdir()) == []


# Processes import torch for seconds; `compare` on docs/howto/own_reducer.md starts some, too.
@pytest.mark.parametrize(
    "backend", ["threading", pytest.param("loky", marks=pytest.mark.merge, id="processes")]
)
def test_a_grid_is_the_same_on_other_backends(backend, data):
    with parallel_config(backend=backend):
        first, two = (
            run_grid(data, [RECIPE, "always"], **GRID, n_jobs=workers) for workers in (1, 2)
        )
    assert first.drop(columns=TIMED).equals(two.drop(columns=TIMED))
