"""The null test in small: one shuffle, the same with each planted leak, and going on after an
interruption.
"""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.slow.proof.keeping import play_kept
from tests.slow.proof.null.__main__ import summarize
from tests.slow.proof.null.shuffles import LEAKS, N_TWICE, Shuffle, play


def log_call(path: str, number: int) -> int:
    """Add a line to a file, and return the number."""
    with Path(path).open("a", encoding="utf-8") as file:
        file.write(f"{number}\n")
    return number


def test_no_label_of_a_fold_moves_what_is_counted_for_it() -> None:
    row = play(0)
    assert (row["moved"], row["traces"], row["misplaced"]) == (0, 0, 0)
    assert row["labels"] > 80
    assert row["certain"] <= 5


@pytest.mark.parametrize("leak", [leak for leak in LEAKS if leak])
def test_a_leak_of_one_label_in_a_hundred_is_found(leak: str) -> None:
    row = play(0, leak)
    assert row["moved"] > 0
    assert row["traces"] > 0


def test_a_shuffle_has_near_repeats_with_the_fold_and_the_label_of_their_part() -> None:
    shuffle = Shuffle(0)
    numbers, n_times = np.unique(shuffle.part, return_counts=True)
    assert (n_times == 2).sum() == N_TWICE
    for number in numbers[n_times == 2]:
        first, second = np.flatnonzero(shuffle.part == number)
        assert shuffle.fold[first] == shuffle.fold[second]
        assert shuffle.good[first] == shuffle.good[second]
        distances = np.linalg.norm(shuffle.X - shuffle.X[first], axis=1)
        assert 0.0 < distances[second] < np.median(distances) / 5.0
    assert 0.008 < shuffle.leaking.mean() < 0.02


def test_a_row_of_the_table_sums_the_shuffles_of_its_leak() -> None:
    row = {"seed": 0, "leak": "", "labels": 100, "moved": 0, "traces": 0, "misplaced": 0}
    row |= {"certain": 1}
    rows = [row, row | {"seed": 1}, row | {"leak": "trained", "moved": 3}]
    honest, trained = summarize(pd.DataFrame(rows)).to_dict("records")
    assert (honest["leak"], honest["shuffles"], honest["found"], honest["labels"]) == (
        "none",
        2,
        0,
        200,
    )
    assert honest["certain of 1,000"] == 2.0
    assert (trained["found"], trained["moved"]) == (1, 3)


def test_finished_work_is_kept_and_other_source_is_played_anew(tmp_path: Path) -> None:
    def played(source: str, n: int) -> list[str]:
        calls = [(str(tmp_path / "log"), i) for i in range(n)]
        list(play_kept(log_call, calls, source, tmp_path / "kept", 1))
        return (tmp_path / "log").read_text().split()

    assert played("a", 2) == ["0", "1"]
    assert played("a", 3) == ["0", "1", "2"]
    assert played("b", 1) == ["0", "1", "2", "0"]
