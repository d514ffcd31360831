"""A few hundred malformed requests over every interface of a real server: `training/fuzz_requests.py` tries 20,000."""

from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[1] / "training"
NEEDED = ("starlette", "uvicorn", "prometheus_client", "msgpack", "defusedxml", "jinja2", "sse_starlette", "asyncua")


def test_every_malformed_request_is_refused_and_changes_nothing(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    for name in NEEDED:
        pytest.importorskip(name, reason="the server needs the extras `serve` and `opcua`")
    monkeypatch.syspath_prepend(str(FOLDER))
    from fuzz_requests import SHARES, fuzz

    found, wrong = fuzz(160, 2, tmp_path, slow=0)
    assert wrong == [], capsys.readouterr().err
    assert {kind for kind, counts in found.items() if counts["refused"]} == set(SHARES)
    assert sum(counts["refused"] for counts in found.values()) > 100


def test_what_changed_is_found(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in NEEDED:
        pytest.importorskip(name, reason="the server needs the extras `serve` and `opcua`")
    monkeypatch.syspath_prepend(str(FOLDER))
    from collections import Counter

    from fuzz_requests import _changed

    log = tmp_path / "cell.log"
    log.write_text("Traceback (most recent call last):")
    wrong = _changed({"a": "1", "b": "2"}, {"a": "1", "b": "3", "c": "4"}, {"json": Counter(failed=2)}, log)
    assert [line.split(":")[0] for line in wrong] == [
        "decisions are changed",
        "1 decisions were recorded, 0 requests taken",
        "2 requests failed",
        "there are tracebacks in the log",
    ]
