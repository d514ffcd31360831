"""Cells of one product in one database: what they share, what stays their own, and what is never
mixed.
"""

import threading
import uuid
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sqlalchemy as sa
from sklearn.decomposition import PCA

from dengine import Action, DataEngine, Dataset, Recipe, SqlStore
from dengine.errors import SettingError, StoreError, TraceError
from dengine.records import RetrainReport
from dengine.store import verify_history
from dengine.store.peers import list_cells
from dengine.store.records import address
from dengine.store.schema import VERSION
from dengine.store.versions import VersionTable
from tests.conftest import DATABASES, insertion_like, url_of
from tests.support.command_line import dengine, document, succeed
from tests.support.driving import learn
from tests.support.plans import plans

EVERY = 20
RECIPE = Recipe("pca", {"n_components": 2}, radius=0.4, retrain_every=EVERY).with_policy(
    alpha=0.2, lower_bound=0.8
)
CONV = Recipe.load("conv").with_settings(retrain_every=EVERY, max_steps=10)
POOLED = RECIPE.with_policy(guarantee="pooled", stops="all", lower_bound=0.7)


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

    def store(self, cell: str, product: str | None = "gear") -> SqlStore:
        return SqlStore(self.url, f"{cell}-{self.tag}", product=product and f"{product}-{self.tag}")

    def engine(
        self, cell: str, product: str | None = "gear", recipe: Any = RECIPE, **options: Any
    ) -> DataEngine:
        store = options.pop("store", None) or self.store(cell, product)
        options = {"clock": ticks(), "replaying": True} | options
        self.opened.append(DataEngine.open_or_create(store, recipe=recipe, **options))
        return self.opened[-1]


# What one database server shares between cells is tried on both before each merge; the rest on
# SQLite alone, and on PostgreSQL with the slow tests.
ON_BOTH = pytest.mark.parametrize("fleet", DATABASES, indirect=True)
SERVER = pytest.param("postgres", marks=[*DATABASES[1].marks, pytest.mark.slow])


@pytest.fixture(params=["sqlite", SERVER])
def fleet(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Fleet]:
    created = Fleet(url_of(request.param, tmp_path))
    yield created
    for engine in created.opened:
        engine.close()


@pytest.fixture(scope="module")
def parts() -> Dataset:
    return insertion_like(260, noise=0.3)


@pytest.fixture(scope="module")
def probe() -> np.ndarray:
    return insertion_like(40, seed=99, noise=0.3).X[:, None]


def predictions(engine: DataEngine, probe: np.ndarray) -> list[Any]:
    """What an engine says of traces that nobody learns from, to the last bit."""
    return [
        (p.action, p.lower, p.upper, p.n_success, p.n_failure, p.embedding)
        for p in engine.model.predict_many(probe)
    ]


def counts(engine: DataEngine, probe: np.ndarray) -> list[tuple[int, int]]:
    return [(p.n_success, p.n_failure) for p in engine.model.predict_many(probe)]


def rule(engine: DataEngine) -> dict[str, list[float]]:
    return {name: value.tolist() for name, value in engine.model.rule.state_dict().items()}


def taught(
    fleet: Fleet, parts: Dataset, n: int, recipe: Recipe = RECIPE
) -> tuple[DataEngine, DataEngine]:
    """Two cells of one product that learned n parts by turns, and have one version of them all."""
    cells = fleet.engine("a", recipe=recipe), fleet.engine("b", recipe=recipe)
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


def numbers(engine: DataEngine) -> list[int]:
    """Return the numbers of the labels that an engine counts, in order."""
    return sorted(engine.model.index.column("numbers").tolist())


def test_a_new_cell_decides_at_once_and_as_its_peers_do(
    fleet: Fleet, parts: Dataset, probe: np.ndarray
) -> None:
    first = fleet.engine("a")
    learn(first, parts, range(100))
    first.retrain()
    second = fleet.engine("b")
    assert second.store.decisions.counts()["labels"] == 0
    assert second.version == first.version > 0
    assert predictions(second, probe) == predictions(first, probe)
    assert any(second.decide(x).action is Action.ACCEPT for x in parts.X[100:140])


@pytest.mark.parametrize(
    "recipe", [RECIPE, pytest.param(CONV, marks=pytest.mark.slow)], ids=["pca", "conv"]
)
def test_one_retrain_serves_all(
    recipe: Recipe, fleet: Fleet, parts: Dataset, probe: np.ndarray
) -> None:
    cells = [fleet.engine(name, recipe=recipe) for name in "abc"]
    for i in range(75):
        learn(cells[i % 3], parts, [i])
    assert 0 < len(cells[0].store.versions.retrains()) < 75 // EVERY
    share(*cells)
    labels = sum(engine.store.decisions.counts()["labels"] for engine in cells)
    newest = cells[0].store.versions.newest()
    assert newest.state["trained_on"].tolist() == list(range(1, labels + 1))
    assert (
        predictions(cells[0], probe) == predictions(cells[1], probe) == predictions(cells[2], probe)
    )
    assert [numbers(engine) for engine in cells] == [list(range(1, labels + 1))] * 3
    assert {engine.state.new_labels for engine in cells} == {0}


def test_a_peers_label_counts_from_the_next_version_on_and_a_cells_own_at_once(
    fleet: Fleet, parts: Dataset, probe: np.ndarray
) -> None:
    first, second = taught(fleet, parts, 60)
    shared = numbers(first)
    learn(first, parts, range(60, 65))
    learn(second, parts, range(65, 70))
    for engine in (first, second):
        engine.poll()
        engine.flush()
        assert numbers(engine)[: len(shared)] == shared
        own = engine.store.labels.past(shared[-1])
        assert numbers(engine)[len(shared) :] == [label.seq for label in own]
    before = predictions(second, probe)
    again = fleet.engine("", recipe=None, store=reopened(fleet, second))
    assert predictions(again, probe) == before
    learn(again, parts, range(70, 72))
    share(first, again)
    assert numbers(first) == numbers(again)
    assert len(first.store.labels.with_traces().seq) == len(numbers(first)) > len(shared) + 5


def test_each_cell_retrains_by_its_own_labels_since_the_newest_version(
    fleet: Fleet, parts: Dataset
) -> None:
    first = fleet.engine("a")
    second = fleet.engine("b", recipe=RECIPE.with_settings(retrain_every=1000))
    for start in range(0, 38, 2):
        learn(first, parts, [start])
        learn(second, parts, [start + 1])
    assert first.store.versions.retrains() == []
    learn(second, parts, [38, 39])
    assert first.store.versions.retrains() == []
    learn(first, parts, [40])
    second.poll()
    assert (first.version, second.version) == (1, 1)
    assert (first.state.new_labels, second.state.new_labels) == (0, 0)


def test_labels_that_come_in_while_an_executor_retrains_are_in_the_new_version(
    fleet: Fleet, parts: Dataset, probe
) -> None:
    waiting = RECIPE.with_settings(retrain_every=1000)
    may_train = threading.Event()
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
            assert engine.version == 1
        assert first.store.versions.newest().state["trained_on"].tolist() == list(range(1, 31))
        assert numbers(first) == numbers(second) == list(range(1, 46))
        assert counts(first, probe) == counts(second, probe)


def test_a_reducer_without_arrays_is_refitted_on_the_same_traces(
    fleet: Fleet, parts: Dataset, probe: np.ndarray
) -> None:
    first, second = (
        fleet.engine(name, recipe=Recipe(PCA(2), radius=0.4, retrain_every=EVERY)) for name in "ab"
    )
    learn(first, parts, range(50))
    learn(second, parts, range(50, 55))
    share(first, second)
    np.testing.assert_array_equal(counts(first, probe), counts(second, probe))


def test_a_trace_that_came_in_two_cells_votes_once(fleet: Fleet, parts: Dataset, probe) -> None:
    wide = RECIPE.with_settings(radius=1e6)  # every label is a neighbour
    first, second = fleet.engine("a", recipe=wide), fleet.engine("b", recipe=wide)
    for engine in (first, second):
        learn(engine, parts, range(15))
    share(first, second)
    for engine in (first, second):
        assert len(numbers(engine)) == 30
        assert {sum(votes) for votes in counts(engine, probe)} == {15}


def test_the_newest_labels_of_the_product_fill_the_window_and_bad_traces_leave_gaps(
    fleet: Fleet, parts, probe
) -> None:
    first, second = taught(fleet, parts, 60, RECIPE.with_settings(window=30))
    for i in range(60, 70):
        first.report(first.decide(np.full(100, np.nan)).id, False)
        learn((first, second)[i % 2], parts, [i])
    share(first, second)
    newest = first.store.labels.with_traces(30)
    np.testing.assert_array_equal(newest.seq, second.store.labels.with_traces(30).seq)
    assert len(newest.seq) == len(first.model.index) == len(second.model.index) == 30
    assert counts(first, probe) == counts(second, probe)


@ON_BOTH
def test_two_cells_that_retrain_at_once_make_two_versions_and_the_later_one_answers(
    fleet: Fleet, parts, probe, monkeypatch: pytest.MonkeyPatch
) -> None:
    reports = []
    first, second = fleet.engine("a"), fleet.engine("b")
    put = second.store.versions.put

    def put_late(*version: Any) -> int:
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
def test_what_one_cell_puts_right_reaches_its_peers_and_a_reopened_one(
    fleet: Fleet, parts: Dataset, probe
) -> None:
    first, second = taught(fleet, parts, 60)
    wrong, *gone = [past.decision.id for past in first.history() if past.success is not None][20:24]
    first.correct(wrong, not first.store.decisions.get(wrong).success)
    first.forget(*gone)
    second.poll()
    assert first.version == second.version > 0
    assert counts(first, probe) == counts(second, probe)
    assert (
        len(first.model.index)
        == len(second.model.index)
        == len(first.store.labels.with_traces().seq)
    )
    assert second.state.new_labels == first.state.new_labels
    results = [verify_history(fleet.url, engine.store.cell_id) for engine in (first, second)]
    assert [report.faults for report in results] == [(), ()]
    assert results[0].cells[0].digest != results[1].cells[0].digest  # each has a ledger of its own
    newest = first.version
    second.rollback(1)
    first.poll()
    assert first.version == second.version == newest + 1
    assert counts(first, probe) == counts(second, probe)
    before = counts(second, probe), rule(second)
    again = fleet.engine("", recipe=None, store=reopened(fleet, second))
    assert (counts(again, probe), rule(again)) == before


def test_no_cell_replaces_what_a_peer_rolled_back_to_before_one_of_them_releases_it(
    fleet: Fleet, parts: Dataset
) -> None:
    first, second = taught(fleet, parts, 60)
    with ThreadPoolExecutor(1) as executor:
        third = fleet.engine("c", executor=executor)
        third.retrain(wait=False)  # it does not know of the rollback
        first.rollback(1)
        executor.shutdown()
    pinned = first.version
    for engine, rows in (
        (third, range(60, 61)),
        (second, range(61, 100)),
        (first, range(100, 140)),
    ):
        engine.poll()
        learn(engine, parts, rows)
    for engine in (first, second, third):
        engine.poll()
        assert (engine.version, engine.status().pinned) == (pinned, 1)
    second.release()
    for engine in (first, second, third):
        engine.poll()
        assert (engine.version > pinned, engine.status().pinned) == (True, 0)


def test_each_cell_counts_what_became_of_its_own_parts(fleet: Fleet, parts: Dataset) -> None:
    first, second = fleet.engine("a", recipe=POOLED), fleet.engine("b", recipe=POOLED)
    learn(first, parts, range(80))
    learn(second, parts, range(80, 120))
    evidence = [len(engine.store.labels.outcomes_since(0)) for engine in (first, second)]
    assert evidence == [engine.store.decisions.counts()["labels"] for engine in (first, second)]
    assert rule(first) != rule(second)
    assert first.store.decisions.tally().outcomes != second.store.decisions.tally().outcomes
    assert (
        rule(second)["evidence.level_totals"]
        != rule(fleet.engine("c", recipe=POOLED))["evidence.level_totals"]
    )
    assert second.store.decisions.get("nobody") is None


def test_a_peers_version_leaves_the_rule_as_it_was(fleet: Fleet, parts: Dataset) -> None:
    first, second = fleet.engine("a", recipe=POOLED), fleet.engine("b", recipe=POOLED)
    learn(first, parts, range(60))
    second.poll()
    learn(second, parts, range(60, 75))
    custom = rule(second)
    first.retrain()
    second.poll()
    assert second.version == first.version
    assert rule(second) == custom


def reopened(fleet: Fleet, engine: DataEngine) -> SqlStore:
    cell_id = engine.store.cell_id
    engine.close()
    fleet.opened.remove(engine)
    return SqlStore(fleet.url, cell_id)  # its product is known


@ON_BOTH
def test_nothing_is_mixed_between_products_and_cells_without(
    fleet: Fleet, parts: Dataset, probe: np.ndarray
) -> None:
    products = {"a": "gear", "b": "gear", "c": "nut", "d": None}
    cells = {name: fleet.engine(name, product) for name, product in products.items()}
    alone = DataEngine(recipe=RECIPE, store=SqlStore(), clock=ticks(), replaying=True)
    for i in range(120):
        name = "abcd"[i % 4]
        learn(cells[name], parts, [i])
        if name == "d":
            learn(alone, parts, [i])
    for engine in cells.values():
        engine.poll()
    assert predictions(cells["d"], probe) == predictions(alone, probe)
    rows = {name: np.arange(i, 120, 4) for i, name in enumerate("abcd")}
    for name, kin in {"a": "ab", "b": "ab", "c": "c", "d": "d"}.items():
        labelled = cells[name].store.labels.with_traces()
        theirs = {parts.X[i].tobytes() for other in kin for i in rows[other]}
        assert {trace.tobytes() for trace in labelled.traces} <= theirs
        assert labelled.seq.tolist() == list(range(1, len(labelled.seq) + 1))
        assert len(labelled.seq) == sum(
            cells[other].store.decisions.counts()["labels"] for other in kin
        )


@ON_BOTH
def test_label_numbers_are_unique_and_increase_over_the_product(
    fleet: Fleet, parts: Dataset
) -> None:
    for name in "abcd":
        fleet.engine(name, recipe=RECIPE.with_settings(retrain_every=10_000))
    with ThreadPoolExecutor(4) as pool:
        list(
            pool.map(
                lambda engine, i: learn(engine, parts, range(10 * i, 10 * i + 10)),
                fleet.opened,
                range(4),
            )
        )
    assert [engine.store.decisions.counts()["labels"] for engine in fleet.opened] == [10] * 4
    seen = fleet.opened[0].store.labels.with_traces()
    assert seen.seq.tolist() == list(range(1, 41))
    assert {trace.tobytes() for trace in seen.traces} == {x.tobytes() for x in parts.X[:40]}


class ShakyNews:
    """Looks for a product's newest version, which fail while `lost`; counts them."""

    def __init__(self, versions: VersionTable) -> None:
        self.lost, self.asked, self._newest_number = False, 0, versions.newest_number
        versions.newest_number = self

    def __call__(self) -> int:
        self.asked += 1
        if self.lost:
            raise StoreError("The connection is gone.")
        return self._newest_number()


@ON_BOTH
def test_a_cell_without_news_goes_on_and_says_so_once(
    fleet: Fleet, parts: Dataset, probe: np.ndarray, caplog
) -> None:
    first, second = fleet.engine("a"), fleet.engine("b")
    shaky = ShakyNews(second.store.versions)
    learn(first, parts, range(30))
    second.poll()
    asked = shaky.asked
    for x in parts.X[:10]:
        second.decide(x)
    assert shaky.asked == asked  # no decision waits for news
    shaky.lost = True
    for i in range(60):
        learn((first, second)[i % 2], parts, [100 + i])
        second.poll()
    assert second.version < first.version
    with pytest.raises(StoreError, match="gone"):
        second.retrain()
    assert [r.levelname for r in caplog.records if "news" in r.message] == ["WARNING"]
    shaky.lost = False
    second.poll()
    assert "comes again" in caplog.text
    share(first, second)
    assert counts(first, probe) == counts(second, probe)
    again = fleet.engine("", recipe=None, store=reopened(fleet, second))
    assert counts(again, probe) == counts(first, probe)


@ON_BOTH
def test_every_label_counts_once_whoever_releases_a_version_or_brings_a_label_back(
    fleet: Fleet, parts: Dataset, probe: np.ndarray
) -> None:
    waiting = RECIPE.with_settings(retrain_every=1000)
    first, second = taught(fleet, parts, 60, waiting)
    first.rollback(1)
    second.poll()
    learn(first, parts, range(60, 66))
    learn(second, parts, range(66, 72))
    gone = [past.decision.id for past in first.history() if past.success is not None][-1]
    first.forget(gone)
    first.release()  # its version lacks the second cell's newest labels, which that cell keeps
    second.poll()
    first.correct(gone, True)
    second.poll()
    learn(second, parts, range(72, 75))
    second.rollback(second.version)
    second.release()
    first.poll()
    everything = first.store.labels.with_traces().seq.tolist()
    for engine in (first, second):
        assert numbers(engine) == everything
    assert counts(first, probe) == counts(second, probe)
    before = predictions(first, probe)
    again = fleet.engine("", recipe=None, store=reopened(fleet, first))
    assert predictions(again, probe) == before


def test_a_peers_version_that_is_damaged_is_left_out_and_the_next_one_answers(
    fleet: Fleet, parts: Dataset, caplog
) -> None:
    first, second = taught(fleet, parts, 60)
    version = second.version
    first.retrain()
    first.store.flush()
    with first.store.database._engine.begin() as connection:
        spoiled = sa.update(VERSION).where(VERSION.c.version == first.version)
        connection.execute(spoiled.values(state=b"nothing"))
    for _ in range(3):
        second.poll()
    assert second.version == version
    assert caplog.text.count("cannot be used") == 1
    share(first, second)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"recipe": Recipe("umap")}, "reducer"),
        ({"recipe": RECIPE.with_settings(folds=3)}, "folds"),
        ({"recipe": RECIPE.with_settings(window=500)}, "window"),
        ({"recipe": RECIPE.with_settings(novelty=0.0)}, "novelty"),
        ({"recipe": RECIPE, "seed": 7}, "seed 0"),
    ],
    ids=["reducer", "folds", "window", "novelty", "seed"],
)
def test_what_decides_the_embedding_must_agree(
    change: dict[str, Any], named: str, fleet: Fleet
) -> None:
    fleet.engine("a")
    with pytest.raises(SettingError, match=f"product.*{named}"):
        fleet.engine("b", **change)


def test_the_first_trace_of_any_cell_sets_the_trace_spec(fleet: Fleet, parts: Dataset) -> None:
    first, second = fleet.engine("a"), fleet.engine("b")
    first.decide(parts.X[0])
    with pytest.raises(TraceError, match="100 samples"):
        second.decide(np.arange(50.0))
    assert second.trace == first.trace == fleet.engine("c").trace


@ON_BOTH
def test_a_cell_keeps_its_product_and_one_that_worked_alone_joins_none(
    fleet: Fleet, parts: Dataset
) -> None:
    fleet.engine("a").close()
    learn(fleet.engine("b", None), parts, [0])
    fleet.opened.pop().close()
    for cell, product, message in (
        ("a", "nut", "leave it out"),
        ("b", "gear", "name a new cell"),
        ("c", "\n", "printable"),
    ):
        with pytest.raises(StoreError, match=message):
            SqlStore(
                fleet.url,
                f"{cell}-{fleet.tag}",
                product=product if cell == "c" else f"{product}-{fleet.tag}",
            )
    result = {
        cell.cell_id: cell.product for cell in list_cells(fleet.url) if fleet.tag in cell.cell_id
    }
    assert result == {f"a-{fleet.tag}": f"gear-{fleet.tag}", f"b-{fleet.tag}": None}


def test_questions_about_a_product_go_down_an_index(tmp_path: Path) -> None:
    with SqlStore(str(tmp_path / "a.db"), "a", product="gear") as store:
        store.versions.put(RetrainReport(1, 0.1, 10, 1, True, ""), 0, {"w": np.ones(3)})
        with plans(tmp_path / "a.db") as result:
            store.versions.newest_number()
            store.corrections.newest_number()
            store.labels.with_traces(10, first=5)
            store.labels.with_traces(10, first=5, cell_only=True)
            store.versions.load(1)
            store.corrections.after(1)
    assert len(result) >= 7
    tables = ("label", "trace", "model_version", "decision", "correction")
    for statement, plan in result:
        assert not [
            step for step in plan if step.startswith("SCAN") and step.split()[1] in tables
        ], (statement, plan)


@ON_BOTH
def test_the_cells_of_a_database_are_listed(fleet: Fleet, parts: Dataset) -> None:
    learn(fleet.engine("a"), parts, range(30))
    fleet.engine("b")
    fleet.engine("d", None)
    for engine in fleet.opened:
        engine.store.flush()
    result = {
        cell.cell_id.split("-")[0]: cell
        for cell in list_cells(fleet.url)
        if fleet.tag in cell.cell_id
    }
    assert {name: cell.product for name, cell in result.items()} == dict.fromkeys(
        "ab", f"gear-{fleet.tag}"
    ) | {"d": None}
    assert (result["a"].decisions, result["b"].decisions) == (30, 0)
    assert result["a"].labels == fleet.opened[0].store.decisions.counts()["labels"]
    assert (result["a"].version, result["b"].version, result["d"].version) == (1, 1, None)
    assert result["a"].last_seen is not None
    assert result["b"].last_seen is None


def test_every_verb_that_names_a_store_names_a_cell(
    fleet: Fleet, parts: Dataset, tmp_path: Path
) -> None:
    np.savez(tmp_path / "parts.npz", X=parts.X[:60], y=parts.y[:60])
    cell, product, data = f"a-{fleet.tag}", f"gear-{fleet.tag}", str(tmp_path / "parts.npz")
    peer = f"b-{fleet.tag}"

    succeed(
        "train",
        "--data",
        data,
        "--store",
        fleet.url,
        "--reducer",
        "pca",
        "--cell",
        cell,
        "--product",
        product,
    )
    succeed("run", "--cell", "replay", "--data", data, "--cycles", "60", "--store", fleet.url, "--cell-id", peer,
        "--product", product)  # fmt: skip
    status = document("status", fleet.url, "--cell", peer)
    assert (status["cell"], status["ever"]["decisions"], status["product"]) == (peer, 60, product)
    assert cell in succeed("status", fleet.url, "--cell-id", cell)
    succeed("export", fleet.url, "--cell", peer, "--out", str(tmp_path / "model.ts"))
    listed = document("status", fleet.url)["cells"]
    assert [row["product"] for row in listed if row["cell_id"] in (cell, peer)] == [
        product,
        product,
    ]
    assert cell[:10] in succeed("status", fleet.url)
    with SqlStore(fleet.url, peer) as store:
        assert (
            len(store.labels.with_traces().seq)
            > len(store.labels.with_traces(cell_only=True).seq)
            > 0
        )


@pytest.mark.parametrize("verb", ["status", "export"])
def test_a_cell_that_is_not_there_is_refused_and_not_made(
    verb: str, tmp_path: Path, parts: Dataset
) -> None:
    url = str(tmp_path / "a.db")
    with DataEngine.open_or_create(address(url, "cell-7"), recipe=RECIPE) as engine:
        learn(engine, parts, range(25))
    words = [verb, url, "--cell", "cell-8"] + (
        ["--out", str(tmp_path / "m.ts")] if verb == "export" else []
    )
    done = dengine(*words)
    assert done.exit_code == 1
    assert "it holds cell-7" in done.output
    assert [cell.cell_id for cell in list_cells(url)] == ["cell-7"]


@pytest.mark.parametrize("has_decided", [True, False])
def test_a_cell_that_was_given_a_reducer_object_saves_its_settings_again_after_a_restart(
    fleet: Fleet, parts: Dataset, has_decided: bool
) -> None:
    # Its peers' settings have the object's description, which its own must keep.
    cells = [fleet.engine(name, recipe=Recipe(PCA(n_components=2))) for name in "ab"]
    if has_decided:
        cells[1].decide(parts.X[0])
    cells[1].close()
    cells[0].decide(parts.X[1])  # sets the TraceSpec, if the other cell has not
    second = DataEngine.open(fleet.store("b"), reducer=PCA(n_components=2))
    fleet.opened.append(second)
    second.set_policy(replace(second.policy, alpha=0.1))
    assert second.trace == cells[0].trace
    assert second.policy.alpha == 0.1
