"""The process in which a served engine retrains, and what goes there and back."""

from __future__ import annotations

import os
import signal
import time
from concurrent.futures import BrokenExecutor, ThreadPoolExecutor
from dataclasses import replace
from multiprocessing import Pipe
from threading import Thread
from typing import Any

import numpy as np
import pytest
import torch

from dengine import DataEngine, Dataset, Policy, Recipe
from dengine.serve.retraining import RetrainingProcess, receive, retraining_process, send

CONV = replace(
    Recipe.load("conv"), retrain_every=30, max_steps=20, encoder_budget=0.01, policy=Policy(alpha=0.1, lower_bound=0.9)
)


def there_and_back(what: Any) -> Any:
    here, other = Pipe()
    got: list[Any] = []
    reader = Thread(target=lambda: got.append(receive(other)))
    reader.start()
    send(here, what)
    reader.join()
    return got[0]


def test_arrays_and_tensors_arrive_as_they_are_writable_and_share_what_they_shared() -> None:
    x = torch.arange(60_000.0).reshape(300, 200)
    sent = x, x.t()[3:, 5:], x > 7.0, torch.empty(0), torch.tensor(1.5, dtype=torch.float64), torch.nn.Linear(3, 4)
    whole, part, mask, nothing, number, layer = there_and_back(sent)
    for got, was in zip((whole, part, mask, nothing, number, layer.weight), (*sent[:5], sent[5].weight), strict=True):
        assert (got.dtype, got.stride()) == (was.dtype, was.stride())
        assert torch.equal(got, was)
    assert layer.weight.requires_grad
    whole.zero_()
    assert not part.any()
    for array in (x[:, :1].numpy(), x.numpy()[:, ::2], x.numpy().T):
        (copy,) = there_and_back([array])
        assert np.array_equal(copy, array)
        copy[0] = 7.0


def test_a_call_is_answered_and_its_error_is_raised() -> None:
    with RetrainingProcess() as process:
        assert process.submit(divmod, 17, 5).result(60) == (3, 2)
        with pytest.raises(RuntimeError, match="ZeroDivisionError"):
            process.submit(divmod, 17, 0).result(60)
        with pytest.raises(Exception, match="pickle"):
            process.submit(lambda: 1).result(60)
        assert process.submit(os.getpid).result(60) != os.getpid()


def test_it_ends_with_whoever_made_it_also_at_work() -> None:

    with RetrainingProcess() as process:
        pid = process.submit(os.getpid).result(60)
        at_work = process.submit(time.sleep, 600)
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)
    with pytest.raises(BrokenExecutor):
        at_work.result(0)


def learn(engine: DataEngine, data: Dataset) -> None:
    for x, y in zip(data.X[:40], data.y[:40], strict=True):
        decision = engine.decide(x)
        if decision.action != "reject":
            engine.report(decision.id, bool(y))


def wait_for(engine: DataEngine) -> None:
    while engine.retraining:
        engine.settle()
        time.sleep(0.01)


def test_a_conv_retrain_there_ends_where_one_in_a_thread_ends(data: Dataset) -> None:
    decided = []
    with retraining_process() as process, ThreadPoolExecutor(1) as thread:
        for executor in (process, thread):
            engine = DataEngine(recipe=CONV, replaying=True, executor=executor)
            learn(engine, data)
            wait_for(engine)
            assert engine.version == 1
            decided.append([(each.embedding, each.lower, each.upper) for each in map(engine.decide, data.X[40:60])])
    assert decided[0] == decided[1]  # bit for bit


def test_after_its_process_was_killed_it_takes_no_more_calls_and_the_engine_retrains_in_line(data: Dataset) -> None:
    with retraining_process() as process:
        engine = DataEngine(recipe=replace(CONV, reducer="pca", params={}), executor=process)
        os.kill(process.submit(os.getpid).result(60), signal.SIGKILL)
        with pytest.raises(BrokenExecutor, match="has ended"):
            process.submit(os.getpid).result(60)
        learn(engine, data)
        wait_for(engine)
        engine.start_retrain()
    assert engine.version >= 1
