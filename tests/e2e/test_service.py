"""The line in front of an engine: who asks, who waits, who is told what."""

import asyncio
import queue
import shutil
import threading
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing

import pytest

from dengine import Action, DataEngine, Reason
from dengine.errors import BusyError, StoreError, TraceError
from dengine.serve.service import CellService
from tests.support.serving import RECIPE, WAIT, a_service, busy_engine


def test_a_late_answer_is_on_the_disk_when_it_leaves(stream, tmp_path):
    bad = stream.X[2].copy()
    bad[7] = float("nan")

    async def cell(service):
        free = threading.Event()
        asyncio.get_running_loop().set_default_executor(ThreadPoolExecutor(1))
        # As a store that does not answer.
        read = asyncio.create_task(asyncio.to_thread(free.wait, WAIT))
        await service.decide(stream.X[0], "order-0")
        service.deadline = 0.05
        with busy_engine(service):
            late = await service.decide(stream.X[1], "order-1", part="P1")
            broken = await service.decide(bad, "order-2")
            unnamed = await service.decide(stream.X[3])
            with pytest.raises(TraceError, match="got another"):  # an answer is to one trace
                await service.decide(stream.X[2], "order-0")
            reasons = [answer.decision.reason for answer in (late, broken, unnamed)]
            assert reasons == [Reason.LATE, Reason.NOT_FINITE, Reason.LATE]
            assert (late.late, late.decision.action) == (True, "verify")
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
        assert (service.read_store.decisions.counts()["decisions"], service.late) == (4, 3)


def test_a_part_that_the_next_decision_confirms_may_be_reported_as_good(stream):
    async def cell(service):
        ids = []
        for x, good in zip(stream.X[:120], stream.y, strict=False):
            decision = (await service.decide(x)).decision
            if decision.action is Action.ACCEPT:
                ids.append(decision.id)
            else:
                await service.report(decision.id, bool(good))
        await service.decide(stream.X[0])
        assert ids
        assert all([(await service.report(id_, True)).repeated for id_ in ids])

    with a_service(recipe=RECIPE.with_policy(stops="all")) as service:
        asyncio.run(cell(service))


def test_the_engine_does_what_it_has_to_while_nobody_asks(stream):
    async def cell(service):
        for x, good in zip(stream.X[:40], stream.y, strict=False):
            await service.report((await service.decide(x)).decision.id, bool(good))
        changes = service.changes(WAIT)
        while service.engine.version == 0:
            await asyncio.wait_for(anext(changes), 60)
        await changes.aclose()

    with (
        ThreadPoolExecutor(1) as pool,
        closing(
            CellService(lambda: DataEngine(recipe=RECIPE, executor=pool), None, WAIT)
        ) as service,
    ):
        asyncio.run(cell(service))


def test_a_service_whose_second_connection_fails_closes_its_engine_and_ends_its_thread(tmp_path):
    with pytest.raises(StoreError, match="Could not open"):
        CellService(lambda: DataEngine.open_or_create(tmp_path / "a.db"), tmp_path / "no" / "b.db")
    assert "dengine-engine" not in [thread.name for thread in threading.enumerate()]
    DataEngine.open(tmp_path / "a.db").close()


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_service_whose_thread_died_behind_a_full_line_closes_all_the_same():
    waiting: queue.Queue[Future] = queue.Queue()
    may_die = threading.Event()

    def die(**brief):
        waiting.put(service.submit(lambda engine, late: None))
        may_die.wait(WAIT)
        raise SystemExit

    service = CellService(lambda: DataEngine("pca"), max_waiting=1)
    service.engine.poll = die
    unanswered = waiting.get(timeout=WAIT)
    closing_thread = threading.Thread(target=service.close, daemon=True)
    closing_thread.start()
    closing_thread.join(0.1)  # it waits for room in the line
    may_die.set()
    closing_thread.join(WAIT)
    assert not closing_thread.is_alive()
    with pytest.raises(BusyError):
        unanswered.result(0)


def test_a_request_in_the_instant_of_the_close_is_refused(monkeypatch):
    service = CellService(lambda: DataEngine("pca"))
    monkeypatch.setattr(
        queue.Queue, "put_nowait", lambda jobs, job: (service.close(), jobs.put(job))
    )
    with pytest.raises(BusyError):
        service.submit(lambda engine, late: None).result(0)
