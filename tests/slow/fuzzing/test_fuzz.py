"""A few hundred malformed inputs of every kind: `training/fuzz_inputs.py` tries 100,000."""

import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[3] / "training"


def test_every_malformed_input_is_an_error_of_ours_or_verified(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.syspath_prepend(str(FOLDER))
    from fuzz_inputs import SHARES, fuzz, quiet_folder

    with quiet_folder() as folder:
        found = fuzz(800, 1, folder)
    assert set(found) == set(SHARES)
    raw = {kind: counts["raw"] for kind, counts in found.items() if counts["raw"]}
    assert raw == {}, capsys.readouterr().err
    assert sum(counts["refused"] for counts in found.values()) > 400
    assert found["traces"]["verified"] > 0


def test_the_fuzzer_finds_what_is_raw(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    monkeypatch.syspath_prepend(str(FOLDER))
    import fuzz_inputs

    def broken(self, rng) -> str:
        raise KeyError("not ours")

    monkeypatch.setattr(fuzz_inputs.Fuzz, "journals", broken)
    monkeypatch.setattr(sys, "argv", ["training/fuzz_inputs.py", "--n", "50", "--kinds", "journals"])
    with pytest.raises(SystemExit) as caught:
        fuzz_inputs.main()
    assert caught.value.code == 1
    assert capsys.readouterr().out.splitlines()[-1].split()[-1] == "1"
