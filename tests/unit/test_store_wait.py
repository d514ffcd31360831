"""How long a cell waits for its store, and what a full disk raises."""

import subprocess
import sys

import pytest

from dengine import DataEngine
from dengine.errors import StoreError
from dengine.store.sql import SqlStore


@pytest.mark.parametrize(
    ("text", "argument", "wait"), [("", None, 0.4), ("7.5", None, 7.5), ("7.5", 2.0, 2.0)]
)
def test_the_argument_comes_before_the_environment_before_the_default(
    text, argument, wait, tmp_path, monkeypatch
):
    monkeypatch.setenv("DENGINE_STORE_WAIT", text)
    for _ in range(2):  # it is made, then opened
        with DataEngine.open_or_create(tmp_path / "a.db", wait=argument) as engine:
            assert engine.store.wait == wait


@pytest.mark.parametrize("text", ["soon", "0", "nan"])
def test_an_environment_that_says_no_seconds_is_named(text, tmp_path, monkeypatch):
    monkeypatch.setenv("DENGINE_STORE_WAIT", text)
    with pytest.raises(StoreError, match="Expected DENGINE_STORE_WAIT above 0 seconds"):
        DataEngine(store=tmp_path / "a.db")


@pytest.mark.parametrize("wait", [[0.4], object(), 10**400])
def test_a_wait_that_is_no_number_of_seconds_is_named(wait, tmp_path):
    with pytest.raises(StoreError, match="Expected a wait above 0 seconds"):
        SqlStore(tmp_path / "a.db", wait=wait)


FULL_DISK = """
import resource, sys
import numpy as np
from dengine import DataEngine
from dengine.errors import NotTakenError

traces = np.random.default_rng(0).normal(size=(40, 30))
with DataEngine("pca", retrain_every=1000, store=sys.argv[1]) as engine:
    for trace in traces[:10]:
        engine.report(engine.decide(trace).id, True)
    engine.flush()
    resource.setrlimit(resource.RLIMIT_FSIZE, (300, resource.RLIM_INFINITY))  # no file may grow
    for trace in traces[10:]:
        decision = engine.decide(trace)
        try:
            engine.report(decision.id, True)
        except NotTakenError:
            print(decision.action, decision.reason)
    print(engine.status().alarm)
print("closed")
"""


@pytest.mark.merge
def test_on_a_full_disk_only_report_raises(tmp_path):
    store = tmp_path / "engine.db"
    done = subprocess.run(
        [sys.executable, "-c", FULL_DISK, store], capture_output=True, text=True, check=False
    )
    lines = done.stdout.splitlines()
    assert (done.returncode, lines[-1]) == (0, "closed"), done.stderr
    assert "verify no_store" in lines
    assert lines[-2].startswith("The store cannot be written: Could not use the journal")
    assert "closed without the newest records, which no report acknowledged" in done.stderr
    with DataEngine.open(store) as engine:
        assert (engine.status().labels, engine.status().alarm) == (10, "")
