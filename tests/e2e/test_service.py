"""The line in front of an engine: who asks, who waits, who is told what."""

import asyncio
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from dengine import DataEngine, Dataset, Policy, Reason, Recipe
from dengine.errors import BusyError, ReportError, StoreError, TraceError
from dengine.serve.service import CellService
from tests.support.serving import held

RECIPE = Recipe("pca", radius=0.5, retrain_every=40, policy=Policy(alpha=0.1, lower_bound=0.9))


@pytest.fixture(scope="module")
def stream(make_data) -> Dataset:
    return make_data(200, samples=60, seed=3)


@pytest.fixture
def service(make_service: Callable[[Recipe], CellService]) -> CellService:
    return make_service(RECIPE)


def test_the_same_report_twice_is_no_error_and_another_one_is(service: CellService, stream: Dataset) -> None:
    async def cell() -> None:
        await service.decide(stream.X[0], "order-0")
        assert not (await service.report("order-0", True)).repeated
        assert (await service.report("order-0", True)).repeated
        with pytest.raises(ReportError, match="success from verification was reported first"):
            await service.report("order-0", False)
        with pytest.raises(ReportError):
            await service.report("unknown", True)
        with pytest.raises(TraceError):
            await service.decide(stream.X[0][:10], "order-1")
        assert (await service.look(lambda store: store.status()))["labels"] == 1

    asyncio.run(cell())


def test_a_late_answer_is_on_the_disk_when_it_leaves(service: CellService, stream: Dataset, tmp_path: Path) -> None:
    bad = stream.X[2].copy()
    bad[7] = float("nan")

    async def cell() -> None:
        await service.decide(stream.X[0], "order-0")
        service.deadline = 0.05
        with held(service):
            late = await service.decide(stream.X[1], "order-1", part="P1")
            broken = await service.decide(bad, "order-2")
            with pytest.raises(TraceError, match="got another"):
                await service.decide(stream.X[2], "order-0")  # in time or late, an answer is to one trace
            with pytest.raises(TraceError, match="60"):
                await service.decide(stream.X[0][:10], "order-3")
            assert (late.late, broken.decision.reason) == (True, Reason.NOT_FINITE)
            (tmp_path / "killed").mkdir()  # as a process that is killed now leaves it
            for file in tmp_path.glob("cell.db*"):
                shutil.copy(file, tmp_path / "killed")
        with DataEngine.open(tmp_path / "killed" / "cell.db") as again:
            assert again.decide(stream.X[1], "P1", decision_id="order-1") == late.decision
            assert again.decide(bad, decision_id="order-2") == broken.decision
            again.report("order-1", True)
        service.deadline = 30.0
        assert (await service.decide(stream.X[1], "order-1")).decision == late.decision
        assert (await service.find("order-2")).quarantined

    asyncio.run(cell())
    assert service.reading.status()["decisions"] == 3
    assert service.late == 2


def test_a_full_line_takes_no_more_and_records_nothing_of_it(stream: Dataset) -> None:
    service = CellService(lambda: DataEngine(recipe=RECIPE), deadline=30.0, most=2)

    async def cell() -> None:
        with held(service):
            waiting = [asyncio.ensure_future(service.decide(stream.X[i], f"order-{i}")) for i in range(2)]
            await asyncio.sleep(0)
            with pytest.raises(BusyError, match="at most 2 requests in line"):
                await service.decide(stream.X[2], "order-2")
        await asyncio.gather(*waiting)

    asyncio.run(cell())
    assert service.reading.status()["decisions"] == 2
    assert service.busy == 1
    service.close()
    with pytest.raises(BusyError, match="closing"):
        asyncio.run(service.decide(stream.X[0]))


def test_what_cannot_be_opened_is_told_where_the_service_is_made(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="found no file"):
        CellService(lambda: DataEngine.open(tmp_path / "none.db"))


def test_the_engine_does_what_it_has_to_while_nobody_asks(make_data, tmp_path: Path) -> None:
    from concurrent.futures import ThreadPoolExecutor

    data = make_data(60, samples=60, seed=3)
    with ThreadPoolExecutor(1) as pool:
        service = CellService(lambda: DataEngine(recipe=RECIPE, executor=pool), deadline=30.0)

        async def cell() -> None:
            for i in range(40):
                await service.report((await service.decide(data.X[i])).decision.id, bool(data.y[i]))
            changes = service.changes()
            while service.engine.version == 0:
                await asyncio.wait_for(anext(changes), 60)
            await changes.aclose()

        asyncio.run(cell())
        service.close()
