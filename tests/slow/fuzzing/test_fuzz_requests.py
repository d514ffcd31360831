"""A few hundred malformed requests over every interface of a real server: `training/fuzz_requests.py` tries 20,000."""

import socket
from collections import Counter
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[3] / "training"
NEEDED = ("starlette", "uvicorn", "prometheus_client", "msgpack", "defusedxml", "jinja2", "sse_starlette", "asyncua")


def test_every_malformed_request_is_refused_and_changes_nothing(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    for name in NEEDED:
        pytest.importorskip(name, reason="the server needs the extras `serve` and `opcua`")
    monkeypatch.syspath_prepend(str(FOLDER))
    from fuzz_requests import SHARES, fuzz

    found, wrong = fuzz(160, 2, tmp_path)
    assert wrong == [], capsys.readouterr().err
    assert {kind for kind, counts in found.items() if counts["refused"]} == set(SHARES)
    counts = sum(found.values(), Counter())
    assert counts["refused"] > 100
    assert counts["late"] > 0  # half a request, of which no more came
    assert set(counts) <= {"refused", "late", "taken"}


def test_what_changed_is_found(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in NEEDED:
        pytest.importorskip(name, reason="the server needs the extras `serve` and `opcua`")
    monkeypatch.syspath_prepend(str(FOLDER))
    from fuzz_requests import changed

    log = tmp_path / "cell.log"
    log.write_text("Traceback (most recent call last):")
    wrong = changed(
        {"a": "1", "b": "2"}, {"a": "1", "b": "3", "c": "4"}, {"json": Counter(failed=2, closed=3, silent=1)}, log
    )
    assert [line.split(":")[0] for line in wrong] == [
        "decisions are changed",
        "1 decisions were recorded, 0 requests taken",
        "3 connections were closed without an answer",
        "1 requests had no answer",
        "2 requests failed",
        "there are tracebacks in the log",
    ]


def test_a_connection_that_is_closed_without_an_answer_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(FOLDER))
    from fuzzing import wire

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
