"""The process in which a served engine retrains, and what goes there and back."""

import copy
import logging
import os
import signal
import time
from concurrent.futures import BrokenExecutor, ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
import torch

from dengine import DataEngine, Policy, Recipe
from dengine.engine import trainer
from dengine.serve.retraining import RetrainingProcess
from tests.support.driving import evidence, learn

CONV = replace(
    Recipe.load("conv"), retrain_every=30, max_steps=20, policy=Policy(alpha=0.1, lower_bound=0.9)
)
PCA = replace(CONV, reducer="pca", params={})


@pytest.fixture(scope="module")
def running():
    """The process that runs, which serves tests until one of them ends it; its start takes seconds."""
    processes: list[RetrainingProcess] = []
    yield processes
    for process in processes:
        process.shutdown()


def pid_of(process: RetrainingProcess) -> int:
    """The number of the process, which answers once it has started."""
    return process.submit(os.getpid).result(300)


@pytest.fixture
def process(running):
    if not running:
        running.append(RetrainingProcess())
        pid_of(running[0])
    return running[0]


def settle(engine: DataEngine) -> None:
    while engine.state.is_retraining:
        engine.poll()
        time.sleep(0.01)


def test_a_call_is_answered_there_its_error_raised_and_its_arrays_and_tensors_arrive_writable(
    process,
):
    x = torch.arange(60_000.0).reshape(300, 200)
    sent = x, x.t()[3:, 5:], torch.empty(0), torch.nn.Linear(3, 4).weight, x.numpy()[:, ::2]
    for received, was in zip(process.submit(copy.copy, sent).result(300), sent, strict=True):
        assert np.array_equal(torch.as_tensor(received).detach(), torch.as_tensor(was).detach())
        with torch.no_grad():
            received[:1] = 7.0
    assert pid_of(process) != os.getpid()
    with pytest.raises(ZeroDivisionError):
        process.submit(divmod, 17, 0).result(300)
    with pytest.raises(Exception, match="pickle"):
        process.submit(lambda: 1).result(300)
    assert process.submit(divmod, 17, 5).result(300) == (3, 2)


def test_a_conv_retrain_there_ends_where_one_in_a_thread_ends(process, data, caplog):
    decided = []
    with ThreadPoolExecutor(1) as thread, caplog.at_level(logging.INFO, "dengine"):
        for executor in (process, thread):
            engine = DataEngine(recipe=CONV, replaying=True, executor=executor)
            learn(engine, data, range(40))
            settle(engine)
            assert engine.version == 1
            decided.append([evidence(engine.decide(x)) for x in data.X[40:60]])
    assert decided[0] == decided[1]  # bit for bit
    assert caplog.text.count("the first retrain begins, on 30 labels") == 2


@pytest.mark.merge
def test_a_process_that_died_or_hangs_is_started_again_and_no_change_waits_while_it_imports(
    process, data, monkeypatch
):
    pids = [pid_of(process)]
    engine = DataEngine(recipe=PCA, executor=process)
    os.kill(pids[0], signal.SIGKILL)
    with pytest.raises(BrokenExecutor):
        pid_of(process)
    with monkeypatch.context() as patched:
        patched.setattr(trainer, "HUNG", 0.001)  # one that still imports is not taken for hung
        learn(engine, data, range(30))
        assert engine.version == 1  # in line, and the process is started again
        learn(engine, data, range(30, 60))
        engine.set_policy(replace(engine.policy, alpha=0.2))
        engine.forget(next(engine.history()).decision.id)
        assert engine.state.is_retraining
        assert not process.ready.done()  # to be ready takes it seconds
    settle(engine)
    reasons = [report.reason.partition(";")[0] for report in engine.store.versions.retrains()]
    assert reasons == ["accepted", "another policy, the same model", "accepted"]
    pids.append(pid_of(process))
    process.submit(time.sleep, 600)
    assert engine.retrain(wait=False) is None  # there
    with monkeypatch.context() as patched:
        patched.setattr(trainer, "HUNG", 0.0)
        engine.poll()
    assert engine.retrain(wait=False) is None
    settle(engine)
    pids.append(pid_of(process))
    accepted = [report.accepted for report in engine.store.versions.retrains()[3:]]
    assert (accepted, engine.version) == ([False, True], 4)
    assert len({*pids}) == 3


def test_it_ends_with_whoever_made_it_also_at_work(process, running):
    running.clear()
    with process:
        pid = pid_of(process)
        at_work = process.submit(time.sleep, 600)
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)
    with pytest.raises(BrokenExecutor):
        at_work.result(0)
