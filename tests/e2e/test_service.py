"""The line in front of an engine: who asks, who waits, who is told what."""

import asyncio
import shutil
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path

import pytest

from dengine import Action, DataEngine, Dataset, Reason
from dengine.errors import StoreError, TraceError
from dengine.serve.service import CellService
from tests.support.serving import RECIPE, WAIT, a_service, busy_engine


def test_a_late_answer_is_on_the_disk_when_it_leaves(stream: Dataset, tmp_path: Path) -> None:
    bad = stream.X[2].copy()
    bad[7] = float("nan")

    async def cell(service: CellService) -> None:
        free = threading.Event()
        asyncio.get_running_loop().set_default_executor(ThreadPoolExecutor(1))
        read = asyncio.create_task(
            asyncio.to_thread(free.wait, WAIT)
        )  # as a store that does not answer
        await service.decide(stream.X[0], "order-0")
        service.deadline = 0.05
        with busy_engine(service):
            late = await service.decide(stream.X[1], "order-1", part="P1")
            broken = await service.decide(bad, "order-2")
            with pytest.raises(TraceError, match="got another"):  # an answer is to one trace
                await service.decide(stream.X[2], "order-0")
            text = late.late, late.decision.action, late.decision.reason, broken.decision.reason
            assert text == (True, "verify", Reason.LATE, Reason.NOT_FINITE)
            free.set()
            assert await read
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

    with a_service(tmp_path / "cell.db") as service:
        asyncio.run(cell(service))
        assert (service.read_store.decisions.counts()["decisions"], service.late) == (3, 2)


def test_a_part_that_the_next_decision_confirms_may_be_reported_as_good(stream: Dataset) -> None:
    async def cell(service: CellService) -> None:
        ids = []
        for i in range(120):
            decision = (await service.decide(stream.X[i])).decision
            if decision.action is Action.ACCEPT:
                ids.append(decision.id)
            else:
                await service.report(decision.id, bool(stream.y[i]))
        await service.decide(stream.X[0])
        assert ids
        assert all([(await service.report(id_, True)).repeated for id_ in ids])

    with a_service(recipe=RECIPE.with_policy(stops="all")) as service:
        asyncio.run(cell(service))


def test_the_engine_does_what_it_has_to_while_nobody_asks(stream: Dataset) -> None:
    async def cell(service: CellService) -> None:
        for i in range(40):
            await service.report((await service.decide(stream.X[i])).decision.id, bool(stream.y[i]))
        changes = service.changes()
        while service.engine.version == 0:
            await asyncio.wait_for(anext(changes), 60)
        await changes.aclose()

    with (
        ThreadPoolExecutor(1) as pool,
        closing(CellService(lambda: DataEngine(recipe=RECIPE, executor=pool))) as created,
    ):
        created.deadline = WAIT
        asyncio.run(cell(created))


def test_a_request_without_an_id_is_verified_where_the_engine_is_late(stream: Dataset) -> None:
    async def cell(service: CellService) -> None:
        await service.decide(stream.X[0])
        service.deadline = 0.05
        with busy_engine(service):
            late = await service.decide(stream.X[1])
        assert (late.decision.action, late.decision.reason) == (Action.VERIFY, Reason.LATE)

    with a_service() as service:
        asyncio.run(cell(service))


def test_a_service_whose_second_connection_fails_closes_its_engine_and_ends_its_thread(
    tmp_path: Path,
) -> None:
    with pytest.raises(StoreError, match="Could not open"):
        CellService(lambda: DataEngine.open_or_create(tmp_path / "a.db"), tmp_path / "no" / "b.db")
    assert "dengine-engine" not in [thread.name for thread in threading.enumerate()]
    DataEngine.open(tmp_path / "a.db").close()
