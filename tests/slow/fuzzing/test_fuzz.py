"""A few hundred malformed inputs and requests of every kind; `inputs` and `requests` beside this file try thousands."""

import socket
import sys
from collections import Counter
from pathlib import Path

import pytest

from tests.slow.fuzzing import inputs

NEEDED = ("starlette", "uvicorn", "prometheus_client", "msgspec", "defusedxml", "jinja2", "sse_starlette")


@pytest.fixture
def _server_extras() -> None:
    for name in NEEDED:
        pytest.importorskip(name, reason="the server needs the extra `serve`")


def test_every_malformed_input_is_an_error_of_ours_or_verified(capsys: pytest.CaptureFixture) -> None:
    with inputs.quiet_folder() as folder:
        found = inputs.fuzz(800, 1, folder)
    assert set(found) == set(inputs.SHARES)
    raw = {kind: counts["raw"] for kind, counts in found.items() if counts["raw"]}
    assert raw == {}, capsys.readouterr().err
    assert sum(counts["refused"] for counts in found.values()) > 400
    assert found["traces"]["verified"] > 0


def test_the_fuzzer_finds_what_is_raw(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    def broken(self, rng) -> str:
        raise KeyError("not ours")

    monkeypatch.setattr(inputs.Fuzz, "journals", broken)
    monkeypatch.setattr(sys, "argv", ["inputs", "--n", "50", "--kinds", "journals"])
    with pytest.raises(SystemExit) as caught:
        inputs.main()
    assert caught.value.code == 1
    assert capsys.readouterr().out.splitlines()[-1].split()[-1] == "1"


@pytest.mark.usefixtures("_server_extras")
def test_every_malformed_request_is_refused_and_changes_nothing(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    from tests.slow.fuzzing.requests import SHARES, fuzz

    found, wrong = fuzz(160, 2, tmp_path)
    assert wrong == [], capsys.readouterr().err
    assert {kind for kind, counts in found.items() if counts["refused"]} == set(SHARES)
    counts = sum(found.values(), Counter())
    assert counts["refused"] > 100
    assert counts["late"] > 0  # half a request, of which no more came
    assert set(counts) <= {"refused", "late", "taken"}


@pytest.mark.usefixtures("_server_extras")
def test_what_changed_is_found(tmp_path: Path) -> None:
    from tests.slow.fuzzing.requests import changed

    log = tmp_path / "cell.log"
    log.write_text("Traceback (most recent call last):")
    counts = {"json": Counter(failed=2, closed=3, silent=1)}
    wrong = changed({"a": "1", "b": "2"}, {"a": "1", "b": "3", "c": "4"}, counts, log)
    assert [line.split(":")[0] for line in wrong] == [
        "decisions are changed",
        "1 decisions were recorded, 0 requests taken",
        "3 connections were closed without an answer",
        "1 requests had no answer",
        "2 requests failed",
        "there are tracebacks in the log",
    ]


def test_a_connection_that_is_closed_without_an_answer_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    from tests.slow.fuzzing import requests as wire

    monkeypatch.setattr(wire, "PATIENCE", 0.2)
    found = []
    with socket.create_server(("127.0.0.1", 0)) as listening:
        for answer, ends in (
            (b"", True),
            (b"", False),
            (b"HTTP/1.1 400 Bad", True),
            (b"HTTP/1.1 408 Request Timeout\r\nContent-Length: 1\r\n\r\nx", False),
        ):
            halves, call = wire.Halves(), wire.over_http(listening.getsockname()[1], b"GET")
            there, _ = listening.accept()
            halves.keep(call, lambda call: found.append(call.close()))
            there.sendall(answer)
            if ends:
                there.close()
            halves.finish()
            there.close()
    assert found == ["closed", "silent", "closed", "late"]
