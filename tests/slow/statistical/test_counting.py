"""Honest counting, and nine ways to cheat: each one is seen by the very check that the honest
engine passes beside it.

The count-only statistic sees labels that are counted where they were learned; the blindness check,
what is chosen by them, however little it is worth; the guarantee's replay, evidence that was taken
after its label or came unasked.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from dengine import Decision, load_dataset
from dengine.engine.learner import Learner
from dengine.engine.live_model import LiveModel
from dengine.folds import content_fold
from dengine.model import neighbours as prediction
from dengine.model.neighbours import ModelPrediction
from dengine.recipe import RECIPES
from dengine.reducers import rocket, torch_reducer
from tests.slow.proof.counts import (
    count_noise,
    decision_embeddings,
    mean_square,
    relabel,
    share_moved,
    weak_signal,
    white_noise,
)
from tests.slow.proof.replays import Case, count_broken, judge

HONEST = (0.8, 1.3)  # mean z^2; heads trained on all folds: 3 to 4.4
SEEDS = 16
JUST_BEYOND = Case(
    "just beyond", "just beyond", reducer="pca", alpha=0.2, lower_bound=0.8, cycles=500
)
WORSENS = replace(JUST_BEYOND, truth="jumping", cycles=1000)


def z2(reducer: str = "conv", seeds: int = SEEDS) -> float:
    return mean_square(
        count_noise(RECIPES[reducer], white_noise(500, 0.8, seed), seed) for seed in range(seeds)
    )


def peeks(*strengths: float, folds: tuple[int, ...] = (3,), reducer: str = "conv") -> float:
    """Largest share of traces whose place in a fold's space was moved by the fold's labels."""
    return max(
        share_moved(RECIPES[reducer], weak_signal(200, s, seed=1), fold, seed=0)
        for s in strengths
        for fold in folds
    )


def worse_than_allowed(replays: int, case: Case = JUST_BEYOND) -> float:
    """Share of replays in which accepted parts were worse than the tolerance, as where every part
    is.
    """
    return (
        count_broken([judge(seed, case) for seed in range(replays)], "passed, end", 0.2) / replays
    )


@pytest.mark.parametrize(
    ("reducer", "seeds"), [("rocket", SEEDS), ("pca", 2 * SEEDS)]
)  # the plane of pca has fewer balls
def test_labels_of_noise_are_counted_as_chance_says(reducer: str, seeds: int) -> None:
    assert HONEST[0] <= z2(reducer, seeds) <= HONEST[1]


def test_labels_of_noise_are_counted_by_a_trained_network_as_chance_says() -> None:
    # A network says the same of all noise: the balls of a seed hold the same labels, and z^2 varies
    # between seeds.
    assert 0.5 <= z2("conv", 2 * SEEDS) <= HONEST[1]


def test_labels_of_noise_on_real_traces_are_counted_as_chance_says(proof_repeats: int) -> None:
    X = load_dataset("insertion").X[:, ::10]
    seeds = range(max(2 * SEEDS, proof_repeats))  # of one seed z^2 is 0.4 to 2.5
    result = mean_square(
        count_noise(RECIPES["conv"], relabel(X, 500, 0.5, seed), seed) for seed in seeds
    )
    assert HONEST[0] - 0.1 <= result <= HONEST[1]


def test_no_label_of_a_fold_moves_anything_in_its_own_space() -> None:
    assert peeks(2.0, 8.0, folds=(0, 3)) == 0.0


def test_it_would_be_seen_in_the_other_spaces() -> None:
    # Or a check that compares nothing would pass.
    data = weak_signal(200, 8.0, seed=1)
    custom = content_fold(data.X[:, None, :], 5)
    turned = replace(data, y=np.where(custom == 0, 1 - data.y, data.y).astype(np.int8))
    first, other = (
        decision_embeddings(RECIPES["conv"], data, 0),
        decision_embeddings(RECIPES["conv"], turned, 0),
    )
    assert np.nanmax(np.abs(first[:, 1] - other[:, 1])) > 0.05


def test_where_every_part_is_just_beyond_the_tolerance_hardly_any_replay_accepts(
    proof_repeats: int,
) -> None:
    assert worse_than_allowed(max(5, proof_repeats)) <= 0.2


Mutation = Callable[[pytest.MonkeyPatch], None]


def members_of_all_folds(patch: pytest.MonkeyPatch) -> None:
    """Member k of a network is trained on the labels of fold k as well."""
    honest = torch_reducer.draw_batches
    patch.setattr(
        torch_reducer, "draw_batches", lambda folds, *rest: honest(np.full_like(folds, -1), *rest)
    )


def heads_of_all_folds(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(
        rocket.RocketReducer,
        "training_masks",
        lambda self, folds: np.ones((self.folds, len(folds)), dtype=np.bool_),
    )


def folds_dealt_anew(patch: pytest.MonkeyPatch) -> None:
    train, fold_of, rng = ModelPrediction.train, prediction.fold_of, np.random.default_rng(0)
    salt = [0]

    def train_anew(self: Any, *args: Any, **options: Any) -> Any:
        salt[0] = int(rng.integers(2**62))
        return train(self, *args, **options)

    patch.setattr(ModelPrediction, "train", train_anew)
    patch.setattr(
        prediction, "fold_of", lambda hashes, folds: fold_of(hashes ^ np.int64(salt[0]), folds)
    )


def references_at_the_mean_of_heads(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(
        rocket, "points_in_fold_space", lambda Z, folds: np.ascontiguousarray(Z.mean(axis=1))
    )


def one_gate_for_all_heads(patch: pytest.MonkeyPatch) -> None:
    fit_heads = rocket.fit_heads

    def gated(g: Tensor, y: Tensor, outside: Tensor, *rest: Any) -> Any:
        fit = fit_heads(g, y, outside, *rest)
        if (fit.w[:, :-1] == 0).all(1).any():  # a head was replaced by its base rate
            fit.w.zero_()
            fit.w[:, -1] = torch.logit((outside.double() @ y.double()) / outside.sum(1))
        return fit

    patch.setattr(rocket, "fit_heads", gated)


def features_screened_by_labels(patch: pytest.MonkeyPatch) -> None:
    fit_heads = rocket.fit_heads

    def screened(g: Tensor, y: Tensor, *rest: Any) -> Any:
        relevance = ((g - g.mean(0)) * (y - y.double().mean())[:, None]).mean(0).abs() / (
            g.std(0) + 1e-9
        )
        best = torch.zeros(g.size(1)).index_fill_(0, relevance.topk(10).indices, 1.0)
        fit = fit_heads(g * best, y, *rest)
        fit.w[:, :-1] *= best
        return fit

    patch.setattr(rocket, "fit_heads", screened)


def evidence_after_its_label(patch: pytest.MonkeyPatch) -> None:
    whole = LiveModel.learn

    def learn(self: Any, item: Any, success: bool, number: int, silent: int | None) -> Any:
        if (model := self.answering) is not None:
            model.add_reference(item.trace, int(success), item.content_hash, number)
            now = model.predict_one(item.trace)
            item = replace(item, decision=replace(item.decision, lower=now.lower, upper=now.upper))
        return whole(self, item, success, number, silent)

    patch.setattr(LiveModel, "learn", learn)


TAKEN_BACK = [
    (Learner, "apply_corrections", lambda self, may_retrain=True: None),
    (LiveModel, "rebuild_rule", lambda self: None),
]
SAID: list[tuple[list[Any], Case]] = [
    (
        [(Decision, "inclusion_probability", 1.0)],
        replace(WORSENS, stops="some", audit_rate=0.3, confirms=True),
    ),
    (
        [(LiveModel, "count_overdue", lambda self, decision: None)],
        replace(WORSENS, truth="edge", missing=0.9, label_within=20),
    ),
    (TAKEN_BACK, replace(WORSENS, late=5)),
]


@contextmanager
def mutated(mutation: Mutation) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        mutation(patch)
        yield


@pytest.mark.parametrize("mutation", [heads_of_all_folds, references_at_the_mean_of_heads])
def test_labels_counted_where_they_were_learned_are_caught(mutation: Mutation) -> None:
    with mutated(mutation):
        assert z2("rocket", seeds=SEEDS // 4) > 1.5 * HONEST[1]


@pytest.mark.parametrize(
    ("reducer", "mutation"),
    [
        ("conv", members_of_all_folds),
        ("rocket", heads_of_all_folds),
        ("rocket", folds_dealt_anew),
        ("rocket", one_gate_for_all_heads),
        ("rocket", features_screened_by_labels),
    ],
)
def test_whatever_a_label_chose_in_its_own_space_is_caught(
    reducer: str, mutation: Mutation
) -> None:
    with mutated(mutation):
        assert peeks(2.0, reducer=reducer) > 0.1


def test_evidence_that_is_taken_after_its_label_is_caught() -> None:
    with mutated(evidence_after_its_label):
        assert worse_than_allowed(3) > 0.5


@pytest.mark.parametrize(("patches", "case"), SAID, ids=["unasked", "never", "taken back"])
def test_outcomes_that_came_unasked_or_never_or_were_taken_back_are_no_evidence(
    patches, case, monkeypatch
) -> None:
    assert worse_than_allowed(3, case) <= 0.34
    for patch in patches:
        monkeypatch.setattr(*patch)
    assert worse_than_allowed(3, case) == 1.0
