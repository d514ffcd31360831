"""Replay with scores that are known beforehand, to see how much a better reducer could still gain.

    python training/ideal_score.py --seeds 100:110 --n-jobs 2
    python training/ideal_score.py --screw screw_driving.npz  # as make_screw_driving.py writes it

The score stands in for the reducer, in the same engine:

- on `oscillation`, each trace's probability of success by Bayes' rule. The generator is known, so
  no embedding can say much more about a part;
- on a recorded set, the probability by a `conv` that was trained beforehand on all labels of the
  set. It is cross-fitted: no part is scored by a copy that saw its label.

The table compares them with `conv` and `rocket` on the same parts in the same order, and gives the
95 % interval of the mean difference from `rocket`.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Self

import numpy as np
import pandas as pd
from common import POLICY, options, print_table
from evidence_page import mean_difference
from evidence_sets import (
    GENERATORS,
    GOOD_SHARE,
    NOISE,
    POLE_RADIUS,
    RESONANCES,
    SCATTER,
    load_set,
)
from numpy.typing import ArrayLike, NDArray
from scipy.special import logsumexp

from dengine import Dataset, Recipe
from dengine.experiments.grid import Task, iterate_replays
from dengine.experiments.replay import Contender
from dengine.reducers import ConvReducer
from dengine.reducers.base import Reducer
from dengine.traces import as_traces

FREQUENCIES = np.linspace(0.08, 0.14, 241)  # of the resonance, cycles per sample
N_FOLDS = 10
N_TRAININGS = 10  # since each takes only a few Newton steps of conv's logistic regressions
STEPS = 240  # of AdamW in a training; the first ones take up to twice as many
N_CYCLES = 1503  # of a replay, at most

Traces = NDArray[np.float32]  # (n, C, T)
Floats = NDArray[np.float64]
Score = Callable[[Traces], Floats]


class KnownScore(Reducer):
    """Embed a trace by a function (n, C, T) -> (n,) that gives the probability of success."""

    scores = True
    own_unit = True
    min_traces = ConvReducer.min_traces
    default_radius = ConvReducer.default_radius
    default_retrain_every = ConvReducer.default_retrain_every

    def __init__(self, score: Score) -> None:
        self.score = score

    def fit(self, X: ArrayLike, y: ArrayLike | None = None) -> Self:
        """Remember the shape of the traces; there is nothing to learn."""
        self.check_traces(X, reset=True)
        return self

    def transform(self, X: ArrayLike) -> NDArray[np.float32]:
        """Return the probabilities, (n, 1)."""
        return self.score(self.check_traces(X))[:, None].astype(np.float32)


def oscillation_posterior(traces: Traces) -> Floats:
    """Return the probabilities (n,) that parts of `evidence_sets.oscillation` are good.

    They follow from the traces (n, 1, T) by Bayes' rule, over a grid of frequencies of the
    resonance, with the generator's own priors and Whittle's likelihood (1953), an approximation:
    the values of the periodogram are independent and exponential, with the spectrum as means.
    """
    n_samples = traces.shape[2]
    bins = np.arange(1, n_samples // 2)
    periodogram = np.abs(np.fft.rfft(traces[:, 0])[:, bins]) ** 2 / n_samples
    z = np.exp(-2j * np.pi * bins / n_samples)
    a1 = 2.0 * POLE_RADIUS * np.cos(2.0 * np.pi * FREQUENCIES)[:, None]
    a2 = -(POLE_RADIUS**2)
    variance = (1.0 - a2) / ((1.0 + a2) * ((1.0 - a2) ** 2 - a1**2))
    resonance = 1.0 / np.abs(1.0 - a1 * z - a2 * z**2) ** 2 / variance
    spectrum = resonance + NOISE**2  # (frequencies, bins)
    log_likelihood = -np.log(spectrum).sum(axis=1) - periodogram @ (1.0 / spectrum).T

    def log_evidence(mean: float, share: float) -> Floats:
        log_prior = -0.5 * ((FREQUENCIES - mean) / (SCATTER * mean)) ** 2
        log_prior -= logsumexp(log_prior)
        evidence: Floats = logsumexp(log_likelihood + log_prior, axis=1) + np.log(share)
        return evidence

    good = log_evidence(RESONANCES["good"], GOOD_SHARE)
    bad = log_evidence(RESONANCES["bad"], 1.0 - GOOD_SHARE)
    posterior: Floats = np.exp(-np.logaddexp(0.0, bad - good))
    return posterior


def trained_beforehand(data: Dataset) -> Score:
    """Cross-fit a `conv` on a whole set, and return a function that looks up scores of its traces.

    The score of a trace is that of the one copy that was trained without its label. The function
    raises KeyError for a trace that is not in the set.
    """
    traces = as_traces(data.X)
    folds = np.random.default_rng(0).permutation(len(data)) % N_FOLDS
    reducer = ConvReducer(folds=N_FOLDS, steps=STEPS, fit_steps=STEPS * N_TRAININGS)
    for _ in range(N_TRAININGS):
        points = reducer.train(traces, data.y.astype(np.int64), folds)
    table = {trace.tobytes(): point[0] for trace, point in zip(traces, points, strict=True)}
    return lambda x: np.array([table[trace.tobytes()] for trace in x])


def play(set_name: str, screw_driving: Path | None, seeds: range, n_jobs: int) -> pd.DataFrame:
    """Play rocket, conv and the known score; return the summary of each replay as a row.

    A seed shuffles a recorded set; of a generated set it makes the parts, in their own order.
    """
    is_generated = set_name in GENERATORS
    if is_generated:
        known = Contender("posterior", Recipe(KnownScore(oscillation_posterior)))
    else:
        score = trained_beforehand(load_set(set_name, seeds[0], screw_driving))
        known = Contender("conv, trained beforehand", Recipe(KnownScore(score)))
    contenders = [
        contender.with_policy(**POLICY)
        for contender in (Contender.load("rocket"), Contender.load("conv"), known)
    ]
    rows = list[dict[str, object]]()
    for seed in seeds:
        data = load_set(set_name, seed, screw_driving)
        cycles = min(N_CYCLES, len(data))
        tasks = [Task(contender, seed, cycles, not is_generated) for contender in contenders]
        played = sorted(iterate_replays(data, tasks, n_jobs=n_jobs), key=lambda one: one.position)
        rows += [{"set": set_name} | one.replay.summary() for one in played]
    return pd.DataFrame(rows)


def compare(replays: pd.DataFrame) -> list[dict[str, object]]:
    """Return a row for each method of one set: means, and certain decisions beyond rocket's.

    The difference is paired by seed, and has its 95 % interval.
    """
    certain = replays.pivot_table(index="seed", columns="recipe", values="certain")
    rows = list[dict[str, object]]()
    for method, group in replays.groupby("recipe", sort=False):
        more = mean_difference(certain[method] - certain["rocket"])
        rows.append(
            {
                "set": group["set"].iloc[0],
                "method": method,
                "certain": group["certain"].mean(),
                "bad accepted": group["false_positive"].mean(),
                "beyond rocket": more.mean,
                "from": more.low,
                "to": more.high,
            }
        )
    return rows


def main() -> None:
    parser = options(__doc__, seeds=range(100, 110), n_jobs=1, out=Path("out/ideal_score"))
    parser.add_argument("--screw", type=Path, help="the screw-driving set, an .npz file")
    arguments = parser.parse_args()
    rows = list[dict[str, object]]()
    for set_name in ("oscillation", "insertion", *["screw driving"] * bool(arguments.screw)):
        replays = play(set_name, arguments.screw, arguments.seeds, arguments.n_jobs)
        rows += compare(replays)
    path = arguments.out / "ideal_score.csv"
    print_table(rows, f"{len(arguments.seeds)} shuffles, at alpha 0.1, LB 90 %", path)


if __name__ == "__main__":
    main()
