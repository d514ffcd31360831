"""The null test in small: one shuffle, the same with each planted leak, and going on after an
interruption.
"""

from pathlib import Path

import numpy as np
import pytest

from tests.slow.proof.null.__main__ import append, read_finished, summarize
from tests.slow.proof.null.shuffles import FOLDS, LEAKS, N_TWICE, Shuffle, agreement, play


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


def test_z_is_standard_for_shuffled_labels_and_large_for_scores_that_saw_them() -> None:
    rng = np.random.default_rng(0)
    part = np.concatenate([np.arange(400), np.arange(100)])
    folds = (part * 7919) % FOLDS
    zs = []
    for _ in range(400):
        good = (rng.random(400) < 0.8)[part]
        score = rng.normal(size=400)[part] + 0.1 * rng.normal(size=500)
        zs.append(agreement(score, good, part, folds))
    assert abs(np.mean(zs)) < 0.2
    assert 0.85 < np.std(zs) < 1.15
    assert agreement(score + good, good, part, folds) > 5.0


def test_what_is_finished_is_read_again(tmp_path: Path) -> None:
    path = tmp_path / "shuffles.csv"
    assert read_finished(path) == []
    row = {"seed": 0, "leak": "", "labels": 100, "moved": 0, "traces": 0}
    row |= {"misplaced": 0, "z": 0.5, "certain": 1}
    rows = [row, row | {"seed": 1, "z": 1.5}, row | {"leak": "trained", "moved": 3}]
    for finished in rows:
        append(path, finished)
    assert read_finished(path) == rows
    honest = summarize(rows, "")
    assert (honest["shuffles"], honest["found"], honest["z"]) == (2, 0, 1.0)
    assert summarize(rows, "trained")["found"] == 1
