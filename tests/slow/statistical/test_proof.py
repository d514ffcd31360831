"""The long proof, `make proof`, in small: planted truths, garbage, a collapse, and going on after
an interruption.
"""

from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from tests.slow.proof.__main__ import make_pieces
from tests.slow.proof.garbage import garbage
from tests.slow.proof.pieces import Piece, finish
from tests.slow.proof.replays import Case, count_broken, judge
from tests.slow.proof.report import write_report
from tests.slow.proof.truths import TRUTHS, planted

SOFT = Case("soft", alpha=0.2, lower_bound=0.8, cycles=400)


@pytest.mark.parametrize("truth", [*TRUTHS, "noise", "parts"])
def test_planted_labels_come_as_often_as_their_truth_says(truth: str) -> None:
    streams = [planted(truth, 500, 0.9, seed, rate=0.8) for seed in range(20)]
    excess = np.array([stream.data.y.mean() - stream.p.mean() for stream in streams])
    assert abs(excess.mean()) < 4.0 * excess.std() / np.sqrt(len(excess)) + 1e-12


def test_the_pooled_guarantee_accepts_and_keeps_the_tolerance(proof_repeats: int) -> None:
    rows = [judge(seed, SOFT) for seed in range(proof_repeats)]
    assert np.mean([row["passed"] for row in rows]) > 30
    k = count_broken(rows, "members, ever", SOFT.tolerance)
    assert stats.binomtest(k, len(rows), SOFT.alpha, alternative="greater").pvalue > 1e-3
    assert np.nanmean([row["members, ever"] for row in rows]) <= SOFT.tolerance


def test_the_gate_keeps_garbage_out_and_lets_parts_in() -> None:
    rows = {row["kind"]: row for row in garbage(0, "conv")}
    clean = rows.pop("clean, certain")
    assert len(rows) >= 12
    assert clean["ungated"] - clean["gated"] <= 0.05
    assert all(row["gated"] <= row["ungated"] for row in rows.values())
    for kind in ("white noise", "random walk", "another machine", "sine"):
        assert rows[kind]["gated"] <= 0.05


def test_what_is_finished_is_not_done_again(tmp_path: Path) -> None:
    case = {"case": Case("short", "sharp", reducer="pca", cycles=80)}
    pieces = [Piece("planted", case, seed) for seed in (0, 1)]
    texts: list[str] = []
    first = finish(pieces[:1], tmp_path, 1, texts.append)
    both = finish(pieces, tmp_path, 1, texts.append)
    assert repr(both[0][1]) == repr(first[0][1])  # NaN is not equal to itself
    assert "1 of 2 pieces are there already." in texts
    text = write_report(both, tmp_path / "docs")
    assert "Of 1 promises" in text
    assert {file.name for file in (tmp_path / "docs").iterdir()} == {"proof.csv", "proof.md"}


def test_another_reducer_takes_the_place_of_conv_and_of_no_other() -> None:
    reducers = {
        piece.settings["case"].reducer
        for part in ("planted", "cost", "noise")
        for piece in make_pieces(part, 1, "rocket")
    }
    assert reducers == {"rocket", "pca"}
