"""One shuffle of the null test: labels that are independent of the traces go through an engine.

    >>> play(seed=0, leak="")["moved"]
    0

Each stream has 500 of the bundled traces. 420 parts come once or twice: the second trace of a part
is its first one with a little noise, and has the same label. The labels are a shuffle over the
parts, four in five good. An engine with `conv` plays the stream in shadow mode, so that all labels
become known, and trains twice. Two things are measured.

**Moved.** The stream is played once more with all labels of one fold inverted. What is counted for
a label of this fold, its reference point, must be the same to the last bit, and so must be the
place of every trace in the space of this fold. Folds are computed by `engine.hashing`.

**Certain.** Decisions that the model alone would have made without a check at alpha 0.1, LB 90 %.

Three leaks of one label in a hundred are planted, in which the same must be found: see `LEAKS`.
"""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from dengine import DataEngine, Policy, Recipe, load_dataset
from dengine.model import neighbours
from dengine.model.neighbours import ModelPrediction
from dengine.reducers import torch_reducer

from ..engine.hashing import fold, hash_of_part

N_TRACES = 500
N_TWICE = 80  # parts that come twice
RETRAIN_EVERY = 200
N_STEPS = 14  # of a retrain: each member sees each of its labels
FOLDS = 5
NOISE = 0.02  # of a second trace, in standard deviations of the samples
SHARE_GOOD = 0.8
ONE_IN = 100  # labels of a fold leak
RECIPE = Recipe.load("conv").with_settings(
    policy=Policy(alpha=0.1, lower_bound=0.9, shadow=True),
    retrain_every=RETRAIN_EVERY,
    max_steps=N_STEPS,
    novelty=0.0,
    folds=FOLDS,
)
Row = dict[str, Any]
Bools = NDArray[np.bool_]
Floats = NDArray[np.float32]
Ints = NDArray[np.int64]


class Shuffle:
    """Traces, parts and shuffled labels of one seed.

    Attributes
    ----------
    X : array of float32, shape (N_TRACES, T)
    part : array of int64, shape (N_TRACES,)
        Number of each trace's part.
    good : array of bool, shape (N_TRACES,)
    fold : array of int64, shape (N_TRACES,)
        Fold of each trace's part.
    leaking : array of bool, shape (N_TRACES,)
        Of each fold every hundredth trace, the first one among them.
    """

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng([seed, 11])
        all_traces = load_dataset("insertion").X[:, ::10]
        n_parts = N_TRACES - N_TWICE
        first = all_traces[rng.permutation(len(all_traces))[:n_parts]]
        noise = rng.normal(0.0, NOISE * all_traces.std(), (N_TWICE, first.shape[1]))
        X = np.concatenate([first, first[:N_TWICE] + noise]).astype(np.float32)
        part = np.concatenate([np.arange(n_parts), np.arange(N_TWICE)])
        good = rng.permutation(np.arange(n_parts) < SHARE_GOOD * n_parts)[part]
        order = rng.permutation(N_TRACES)
        self.X = X[order]
        self.part = part[order]
        self.good = good[order]
        self.fold = np.array([fold(hash_of_part(str(number)), FOLDS) for number in self.part])
        self.leaking = np.zeros(N_TRACES, dtype=bool)
        for k in range(FOLDS):
            self.leaking[np.flatnonzero(self.fold == k)[::ONE_IN]] = True


@contextmanager
def trained_on_its_own(shuffle: Shuffle) -> Iterator[None]:
    """Leak: one label in a hundred is also trained on in the space in which it is counted."""
    honest = torch_reducer.draw_batches

    def draw(folds: Ints, *rest: Any) -> Any:
        leaking = shuffle.leaking[: len(folds)]
        return honest(np.where(leaking, -1, folds), *rest)

    with patch.object(torch_reducer, "draw_batches", draw):
        yield


@contextmanager
def counted_elsewhere(shuffle: Shuffle) -> Iterator[None]:
    """Leak: from the second training on, one label in a hundred is in the next fold."""
    hashes = [hash_of_part(str(number)) for number in shuffle.part[shuffle.leaking]]
    honest_fold = neighbours.fold_of
    honest_train = ModelPrediction.train
    n_trainings = [0]

    def fold_of(hashes_: Ints, n_folds: int) -> Ints:
        moves = np.isin(hashes_, hashes) & (n_trainings[0] > 1)
        return (honest_fold(hashes_, n_folds) + moves) % n_folds

    def train(self: ModelPrediction, *args: Any, **options: Any) -> ModelPrediction:
        n_trainings[0] += 1
        return honest_train(self, *args, **options)

    with ExitStack() as stack:
        stack.enter_context(patch.object(neighbours, "fold_of", fold_of))
        stack.enter_context(patch.object(ModelPrediction, "train", train))
        yield


LEAKS = {
    "": nullcontext,
    "trained": trained_on_its_own,
    "counted": counted_elsewhere,
    # The engine does not hear the parts' numbers, see `Played`: the two traces of a part, which are
    # one in six, have the folds of their contents.
    "no part numbers": nullcontext,
}


class Played:
    """What an engine has after a stream.

    Attributes
    ----------
    places : array of float32, shape (N_TRACES, FOLDS, d)
        Where each trace was in each space when it was decided; NaN before the first training.
    points : array of float32, shape (N_TRACES, d)
        Reference point of each trace.
    n_certain : int
        Decisions that the model would have made without a check.
    """

    def __init__(self, shuffle: Shuffle, good: Bools, leak: str) -> None:
        decisions = []
        with LEAKS[leak](shuffle), DataEngine(recipe=RECIPE, replaying=True) as engine:
            for x, number, label in zip(shuffle.X, shuffle.part, good, strict=True):
                part = None if leak == "no part numbers" else int(number)
                decisions.append(engine.decide(x, part=part))
                engine.report(decisions[-1].id, bool(label))
            index = engine.model.index
        order = np.argsort(index.column("numbers"))
        # The labels' numbers are 1, 2, ...: each of them is counted once.
        np.testing.assert_array_equal(index.column("numbers")[order], np.arange(1, N_TRACES + 1))
        self.points = index.column("points")[order].copy()
        self.spaces = index.column("spaces")[order].copy()
        nowhere = np.full(np.shape(decisions[-1].embedding), np.nan)
        self.places = np.array(
            [nowhere if item.embedding is None else item.embedding for item in decisions]
        )
        self.n_certain = sum(item.predicted != "verify" for item in decisions)


def play(seed: int, leak: str = "") -> Row:
    """Play one shuffle, and once more with the labels of one fold inverted.

    Returns
    -------
    row : dict
        seed, leak; labels: how many there are in the inverted fold; moved: how many of these had
        another reference point; traces, of which the place in the space of the fold was another;
        misplaced: references that were not in the space of their fold; certain.
    """
    shuffle = Shuffle(seed)
    k = seed % FOLDS
    inside = shuffle.fold == k
    first = Played(shuffle, shuffle.good, leak)
    second = Played(shuffle, np.where(inside, ~shuffle.good, shuffle.good), leak)
    moved = (first.points[inside] != second.points[inside]).any(axis=1)
    before = first.places[:, k]
    after = second.places[:, k]
    is_same = (before == after) | (np.isnan(before) & np.isnan(after))
    return {
        "seed": seed,
        "leak": leak,
        "labels": int(inside.sum()),
        "moved": int(moved.sum()),
        "traces": int((~is_same).any(axis=1).sum()),
        "misplaced": int((first.spaces != shuffle.fold).sum()),
        "certain": first.n_certain,
    }
