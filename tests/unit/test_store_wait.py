"""How long a cell waits for its store: the argument, the environment, the default."""

from pathlib import Path

import pytest

from dengine import DataEngine
from dengine.errors import StoreError
from dengine.store import SqlStore, open_store


@pytest.mark.parametrize(
    ("text", "argument", "wait"),
    [(None, None, 0.4), ("7.5", None, 7.5), ("7.5", 2.0, 2.0), ("", None, 0.4)],
)
def test_the_argument_comes_before_the_environment_before_the_default(
    text, argument, wait, tmp_path, monkeypatch
) -> None:
    monkeypatch.delenv("DENGINE_STORE_WAIT")
    if text is not None:
        monkeypatch.setenv("DENGINE_STORE_WAIT", text)
    with SqlStore(str(tmp_path / "a.db"), wait=argument) as store:
        assert store.wait == wait
    opened = open_store(tmp_path / "a.db", wait=argument)
    assert opened.wait == wait
    opened.close()


@pytest.mark.parametrize("text", ["soon", "0", "-1", "nan", "inf"])
def test_an_environment_that_says_no_seconds_is_named(
    text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DENGINE_STORE_WAIT", text)
    with pytest.raises(StoreError, match="Expected DENGINE_STORE_WAIT above 0 seconds"):
        DataEngine(store=tmp_path / "a.db")


def test_an_engine_that_is_opened_hands_its_wait_to_the_store(tmp_path: Path) -> None:
    with DataEngine.open_or_create(tmp_path / "a.db", wait=3.0) as engine:
        assert engine.store.wait == 3.0
    with DataEngine.open(tmp_path / "a.db", wait=4.0) as engine:
        assert engine.store.wait == 4.0
