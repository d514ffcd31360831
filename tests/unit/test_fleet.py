"""Cells of one product in one database: what they share, and what is never mixed. What each counts
is recounted in test_histories.py.
"""

import threading
import uuid
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from itertools import count
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import sqlalchemy as sa
from sklearn.decomposition import PCA

from dengine import DataEngine, Dataset, ModelPrediction, Recipe, SqlStore
from dengine.decision.scripting import incompatible_model_error
from dengine.errors import SettingError, StoreError, TraceError
from dengine.store import verify_history
from dengine.store.peers import list_cells
from dengine.store.schema import TRACE, VERSION
from tests.conftest import DATABASES, insertion_like, url_of
from tests.support.command_line import document, refused, succeed
from tests.support.driving import learn, rule_state

EVERY = 20
RECIPE = Recipe("pca", {"n_components": 2}, radius=0.4, retrain_every=EVERY).with_policy(
    alpha=0.2, lower_bound=0.8
)
CONV = Recipe.load("conv").with_settings(retrain_every=EVERY, max_steps=10)


def ticks() -> Callable[[], float]:
    """A clock that goes on by two seconds whenever it is asked, so that it is always time
    for news.
    """
    return count(2.0, 2.0).__next__


@dataclass
class Fleet:
    """A database, with names of cells and products that no other test has."""

    url: str
    tag: str = field(default_factory=lambda: uuid.uuid4().hex)
    opened: list[DataEngine] = field(default_factory=list)

    def store(self, cell: str, product: str | None = "gear"):
        return SqlStore(self.url, f"{cell}-{self.tag}", product=product and f"{product}-{self.tag}")

    def engine(self, cell: str, product="gear", recipe=RECIPE, store=None, **options):
        options = {"clock": ticks(), "replaying": True} | options
        store = store or self.store(cell, product)
        self.opened.append(DataEngine.open_or_create(store, recipe=recipe, **options))
        return self.opened[-1]


# What one database server shares between cells is tried on both before each merge; the rest on
# SQLite alone, and on PostgreSQL with the slow tests.
ON_BOTH = pytest.mark.parametrize("fleet", DATABASES, indirect=True)
SERVER = pytest.param("postgres", marks=[*DATABASES[1].marks, pytest.mark.slow])


@pytest.fixture(params=["sqlite", SERVER])
def fleet(request, tmp_path):
    created = Fleet(url_of(request.param, tmp_path))
    yield created
    for engine in created.opened:
        engine.close()


@pytest.fixture
def pair(fleet):
    """Two cells of one product."""
    return [fleet.engine(name) for name in "ab"]


@pytest.fixture(scope="module")
def parts():
    return insertion_like(260, noise=0.3)


@pytest.fixture(scope="module")
def probe():
    return insertion_like(40, seed=99, noise=0.3).X[:, None]


def predictions(engine: DataEngine, probe: np.ndarray) -> list[Any]:
    """What an engine says of traces that nobody learns from, to the last bit."""
    return engine.model.predict_many(probe)


def counts(engine: DataEngine, probe: np.ndarray) -> list[tuple[int, int]]:
    return [(p.n_success, p.n_failure) for p in engine.model.predict_many(probe)]


def taught(fleet: Fleet, parts: Dataset, n: int, recipe: Recipe = RECIPE) -> list[DataEngine]:
    """Two cells of one product that learned n parts by turns, and have one version of them all."""
    cells = [fleet.engine(name, recipe=recipe) for name in "ab"]
    for i in range(n):
        learn(cells[i % 2], parts, [i])
    share(*cells)
    return cells


def share(first: DataEngine, *others: DataEngine) -> None:
    """Have a cell train on the labels of all, and the others put its version in force."""
    first.retrain()
    for engine in others:
        engine.poll()
        assert engine.version == first.version


def must_be_as(fleet: Fleet, before: DataEngine, probe: np.ndarray) -> None:
    """Open a cell again, whose product is known; it must say what it said."""
    said, learned = predictions(before, probe), rule_state(before)
    before.close()
    fleet.opened.remove(before)
    after = fleet.engine("", recipe=None, store=SqlStore(fleet.url, before.store.cell_id))
    assert (predictions(after, probe), rule_state(after)) == (said, learned)


def numbers(engine: DataEngine) -> list[int]:
    """Return the numbers of the labels that an engine counts, in order."""
    return sorted(engine.model.index.column("numbers").tolist())


def test_a_cell_with_too_few_labels_for_a_training_asks_the_store_no_more_than_once_a_second(
    fleet, parts, monkeypatch
):
    engine = fleet.engine("a", recipe=CONV.with_settings(retrain_every=2), clock=lambda: 7.0)
    asked, newest = [], engine.store.versions.newest_number
    monkeypatch.setattr(engine.store.versions, "newest_number", lambda: asked.append(1) or newest())
    learn(engine, parts, range(12))
    assert engine.state.new_labels == 12
    assert len(asked) <= 1


@pytest.mark.parametrize(
    "recipe",
    [RECIPE, replace(RECIPE, reducer=PCA(2)), pytest.param(CONV, marks=pytest.mark.slow)],
    ids=["pca", "a reducer without arrays", "conv"],
)
def test_one_retrain_serves_all_and_a_new_cell_that_decides_at_once(recipe, fleet, parts, probe):
    cells = [fleet.engine(name, recipe=recipe) for name in "abc"]
    for i in range(75):
        learn(cells[i % 3], parts, [i])
    assert 0 < len(cells[0].store.versions.retrains()) < 75 // EVERY
    share(*cells)
    labels = sum(engine.store.decisions.counts()["labels"] for engine in cells)
    cells.append(fleet.engine("d", recipe=recipe))
    assert cells[-1].version == cells[0].version
    for engine in cells:
        assert numbers(engine) == list(range(1, labels + 1))
        assert predictions(engine, probe) == predictions(cells[0], probe)
        assert engine.state.new_labels == 0


def test_each_cell_retrains_by_its_own_labels_since_the_newest_version(fleet, parts):
    first = fleet.engine("a")
    second = fleet.engine("b", recipe=RECIPE.with_settings(retrain_every=1000))
    for start in range(0, 38, 2):
        learn(first, parts, [start])
        learn(second, parts, [start + 1])
    learn(second, parts, [38, 39])
    assert first.store.versions.retrains() == []
    learn(first, parts, [40])
    second.poll()
    assert (first.version, second.version) == (1, 1)
    assert (first.state.new_labels, second.state.new_labels) == (0, 0)


def test_labels_that_come_in_while_an_executor_retrains_are_in_the_new_version(fleet, parts, probe):
    waiting, may_train = RECIPE.with_settings(retrain_every=1000), threading.Event()
    with ThreadPoolExecutor(1) as executor:
        first = fleet.engine("a", recipe=waiting, executor=executor)
        second = fleet.engine("b", recipe=waiting)
        learn(first, parts, range(30))
        executor.submit(may_train.wait)
        first.retrain(wait=False)
        learn(second, parts, range(30, 40))
        learn(first, parts, range(40, 45))
        may_train.set()
        executor.shutdown(wait=True)
        for engine in (first, second):
            engine.poll()
            assert (engine.version, numbers(engine)) == (1, list(range(1, 46)))
        assert first.store.versions.newest().state["trained_on"].tolist() == list(range(1, 31))
        assert counts(first, probe) == counts(second, probe)


@ON_BOTH
def test_two_cells_that_retrain_at_once_make_two_versions_and_the_later_one_answers(
    pair, parts, probe, monkeypatch
):
    first, second = pair
    reports, put = [], second.store.versions.put

    def put_late(*version: Any):
        """Store a version after a peer's."""
        if not reports:
            reports.append(first.retrain())
        return put(*version)

    monkeypatch.setattr(second.store.versions, "put", put_late)
    learn(first, parts, range(15))
    reports.append(second.retrain())
    assert [report.version for report in reports] == [1, 2]
    first.poll()
    assert first.version == second.version == 2
    assert predictions(first, probe) == predictions(second, probe)


@ON_BOTH
def test_what_one_cell_puts_right_reaches_its_peers_and_a_reopened_one(fleet, parts, probe):
    first, second = taught(fleet, parts, 60)
    wrong, *gone = [past.decision.id for past in first.history(label="good")][20:24]
    first.correct(wrong, False)
    first.forget(*gone)
    results = [verify_history(fleet.url, engine.store.cell_id) for engine in (first, second)]
    assert [report.faults for report in results] == [(), ()]
    assert results[0].cells[0].digest != results[1].cells[0].digest  # each has a ledger of its own
    with first.store.database._engine.begin() as connection:  # a peer needs no trace to forget it
        connection.execute(sa.delete(TRACE).where(TRACE.c.decision_id == gone[0]))
    second.poll()
    assert numbers(first) == numbers(second) == first.store.labels.with_traces().seq.tolist()
    newest = first.version
    for number in (newest, newest + 1):
        assert first.version == second.version == number > 0
        assert counts(first, probe) == counts(second, probe)
        assert first.state.new_labels == second.state.new_labels
        if number == newest:
            second.rollback(1)
            first.poll()
    must_be_as(fleet, second, probe)


def test_no_cell_replaces_what_a_peer_rolled_back_to_before_one_of_them_releases_it(fleet, parts):
    first, second = taught(fleet, parts, 60)
    with ThreadPoolExecutor(1) as executor:
        third = fleet.engine("c", executor=executor)
        third.retrain(wait=False)  # it does not know of the rollback
        first.rollback(1)
        second.retrain(wait=False)  # it hears of the rollback only now
        executor.shutdown()
    pinned, cells = first.version, (third, second, first)
    for engine, start in zip(cells, (60, 61, 100), strict=True):
        engine.poll()
        learn(engine, parts, range(start, start + 40))
    for engine in cells:
        engine.poll()
        assert (engine.version, engine.status().pinned) == (pinned, 1)
    second.release()
    for engine in cells:
        engine.poll()
        assert engine.version > pinned
        assert engine.status().pinned == 0
    first.rollback(1)
    second.retrain()  # which somebody asked for
    assert second.store.events.newest(1)[0].kind == "release"


@ON_BOTH
def test_nothing_is_mixed_between_products_and_cells_without(fleet, parts, probe):
    products = {"a": "gear", "b": "gear", "c": "nut", "d": None}
    cells = [fleet.engine(name, product) for name, product in products.items()]
    alone = DataEngine(recipe=RECIPE, store=SqlStore(), clock=ticks(), replaying=True)
    for i in range(120):
        learn(cells[i % 4], parts, [i])
        if i % 4 == 3:
            learn(alone, parts, [i])
    for engine in cells:
        engine.poll()
    assert predictions(cells[3], probe) == predictions(alone, probe)
    for kin in ([0, 1], [2], [3]):
        theirs = {parts.X[i].tobytes() for i in range(120) if i % 4 in kin}
        n = sum(cells[i].store.decisions.counts()["labels"] for i in kin)
        for i in kin:
            labelled = cells[i].store.labels.with_traces()
            assert {trace.tobytes() for trace in labelled.traces} <= theirs
            assert labelled.seq.tolist() == list(range(1, n + 1))


@ON_BOTH
def test_label_numbers_are_unique_and_increase_over_the_product(fleet, parts):
    waiting = RECIPE.with_settings(retrain_every=10_000)
    cells = [fleet.engine(name, recipe=waiting) for name in "abcd"]
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda i: learn(cells[i], parts, range(10 * i, 10 * i + 10)), range(4)))
    seen = cells[0].store.labels.with_traces()
    assert seen.seq.tolist() == list(range(1, 41))
    assert {trace.tobytes() for trace in seen.traces} == {x.tobytes() for x in parts.X[:40]}


@ON_BOTH
def test_a_cell_without_news_goes_on_and_says_so_once(
    fleet, pair, parts, probe, caplog, monkeypatch
):
    first, second = pair
    versions, asked, lost = second.store.versions, [], []
    newest_number = versions.newest_number

    def shaky():
        asked.append(len(lost))
        if lost:
            raise StoreError("The connection is gone.")
        return newest_number()

    monkeypatch.setattr(versions, "newest_number", shaky)
    learn(first, parts, range(30))
    second.poll()
    n_asked = len(asked)
    for x in parts.X[:10]:
        second.decide(x)
    assert len(asked) == n_asked  # no decision waits for news
    lost.append("the connection")
    for i in range(60):
        learn(pair[i % 2], parts, [100 + i])
        second.poll()
    assert second.version < first.version
    with pytest.raises(StoreError, match="gone"):
        second.retrain()
    assert [r.levelname for r in caplog.records if "news" in r.message] == ["WARNING"]
    lost.clear()
    second.poll()
    assert "comes again" in caplog.text
    share(first, second)
    must_be_as(fleet, second, probe)


@pytest.mark.parametrize("is_damaged", [True, False], ids=["damaged", "of another model"])
def test_a_peers_version_that_is_of_no_use_is_left_out_and_the_next_one_answers(
    is_damaged, fleet, parts, caplog, monkeypatch
):
    first, second = taught(fleet, parts, 60)
    version = second.version
    first.retrain()
    first.flush()
    spoiled = sa.update(VERSION).where(VERSION.c.version == first.version).values(state=b"nothing")
    with monkeypatch.context() as patch:
        if is_damaged:
            with first.store.database._engine.begin() as connection:
                connection.execute(spoiled)
        else:  # as another release would say
            error = incompatible_model_error("encoder has other sizes")
            patch.setattr(ModelPrediction, "set_state", Mock(side_effect=error))
        for _ in range(3):
            second.poll()
    assert (second.version, caplog.text.count("cannot be used")) == (version, 1)
    share(first, second)


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({"folds": 3}, "folds"),
        ({"window": 500}, "window"),
        ({"novelty": 0.0}, "novelty"),
        ({}, "seed 0"),
    ],
)
def test_what_decides_the_embedding_must_agree(settings, named, fleet):
    fleet.engine("a")
    with pytest.raises(SettingError, match=f"product.*{named}"):
        fleet.engine("b", recipe=replace(RECIPE, **settings), seed=0 if settings else 7)
    with pytest.raises(SettingError, match=r"product.*reducer"):
        fleet.engine("b", recipe=Recipe("umap"))


def test_the_first_trace_of_any_cell_sets_the_trace_spec(fleet, pair, parts):
    first, second = pair
    first.decide(parts.X[0])
    with pytest.raises(TraceError, match="100 samples"):
        second.decide(np.arange(50.0))
    assert second.trace == first.trace == fleet.engine("c").trace


@ON_BOTH
def test_cells_are_listed_with_their_products_which_they_keep(fleet, parts):
    cells = [fleet.engine(*names) for names in (("a", "gear"), ("b", "gear"), ("d", None))]
    learn(cells[0], parts, range(30))
    learn(cells[2], parts, [0])
    labels, ids = cells[0].store.decisions.counts()["labels"], [e.store.cell_id for e in cells]
    while fleet.opened:
        fleet.opened.pop().close()
    with pytest.raises(StoreError, match="leave it out"):
        fleet.store("a", "nut")
    with pytest.raises(StoreError, match="name a new cell"):
        fleet.store("d", "gear")
    with pytest.raises(StoreError, match="printable"):
        SqlStore(fleet.url, "c", product="\n")
    listed = [cell for cell in list_cells(fleet.url) if fleet.tag in cell.cell_id]
    assert [cell.cell_id for cell in listed] == ids
    assert [cell.product for cell in listed] == [f"gear-{fleet.tag}"] * 2 + [None]
    counted = [(cell.decisions, cell.labels, cell.version) for cell in listed]
    assert counted == [(30, labels, 1), (0, 0, 1), (1, 1, None)]
    assert [cell.last_seen is None for cell in listed] == [False, True, False]


VERBS = """
train --data DATA --store URL --reducer pca --product PRODUCT --cell ONE
run --data DATA --store URL --cell replay --cycles 60 --product PRODUCT --cell-id TWO
export URL --cell TWO --out MODEL
"""


def test_every_verb_that_names_a_store_names_a_cell(fleet, parts, tmp_path):
    names = {"DATA": tmp_path / "parts.npz", "MODEL": tmp_path / "model.ts", "URL": fleet.url}
    one, two, product = (f"{name}-{fleet.tag}" for name in ("a", "b", "gear"))
    names |= {"ONE": one, "TWO": two, "PRODUCT": product}
    np.savez(names["DATA"], X=parts.X[:60], y=parts.y[:60])
    for line in VERBS.strip().splitlines():
        succeed(*(names.get(word, word) for word in line.split()))
    status = document("status", fleet.url, "--cell", two)
    assert (status["cell"], status["ever"]["decisions"], status["product"]) == (two, 60, product)
    assert one in succeed("status", fleet.url, "--cell-id", one)
    assert one[:10] in succeed("status", fleet.url)
    listed = document("status", fleet.url)["cells"]
    assert [row["cell_id"] for row in listed if row["product"] == product] == [one, two]
    with SqlStore(fleet.url, two) as store:
        own = store.labels.with_traces(cell_only=True)
        assert len(store.labels.with_traces().seq) > len(own.seq) > 0
    for words in (["status"], ["export", "--out", names["MODEL"]]):
        # The cell is not made.
        assert "it holds " in refused(*words, fleet.url, "--cell", "another")
    assert "another" not in [row.cell_id for row in list_cells(fleet.url)]
