"""The novelty gate: what is like no reference is called novel, what is like one is not, and no
label is asked.
"""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from dengine import load_dataset
from dengine.decision.novelty import NoveltyGate, fit_novelty
from dengine.decision.scripting import script
from tests.slow.proof.garbage import KINDS

Traces = NDArray[np.float32]


def shuffled() -> Traces:
    X = load_dataset("insertion").X
    return X[np.random.default_rng(0).permutation(len(X))][:, None]


TRACES = shuffled()
KNOWN, HELD_OUT = TRACES[:800], TRACES[800:]
MEAN, SD = float(KNOWN.mean()), float(KNOWN.std())


@pytest.fixture(scope="module")
def gate() -> NoveltyGate:
    return fit_novelty(KNOWN, 1.5)


def share(gate: NoveltyGate, traces: Traces) -> float:
    return float(np.mean([gate(torch.from_numpy(np.array(x, dtype=np.float32))) for x in traces]))


def spike(x: Traces, rng: np.random.Generator) -> Traces:
    spiked = x.copy()
    spiked[np.arange(len(x)), 0, rng.integers(0, x.shape[2], len(x))] += 4 * SD
    return spiked


def proofs(name: str) -> Callable[[Traces, np.random.Generator], Traces]:
    """A kind of the proof's."""
    return lambda x, rng: KINDS[name](x[:, 0], x[:, 0], rng)[:, None].astype(np.float32)


noise, sine, hum = (proofs(name) for name in ("white noise", "sine", "hum on good parts"))
GARBAGE: dict[str, Callable[[Traces, np.random.Generator], Traces]] = {
    "noise": noise,
    "sine": sine,
    "hum": hum,
    "spike": spike,
    "offset": lambda x, _: x + np.float32(SD),
    "drift": lambda x, _: x - np.linspace(0, SD, x.shape[2], dtype=np.float32),
    "late": lambda x, _: np.concatenate([np.repeat(x[..., :1], 270, 2), x[..., :-270]], 2),
    "gap": lambda x, _: np.concatenate(
        [x[..., :600], np.repeat(x[..., 600:601], 20, 2), x[..., 620:]], 2
    ),
    "reversed": lambda x, _: x[..., ::-1],
    "silent": lambda x, _: np.zeros_like(x),
    "stuck": lambda x, _: np.full_like(x, MEAN),
}


@pytest.mark.parametrize("kind", GARBAGE)
def test_garbage_is_novel(gate: NoveltyGate, kind: str) -> None:
    # Of the reversed traces those that never touched anything are what they were: one in twenty.
    assert share(gate, GARBAGE[kind](HELD_OUT[:100], np.random.default_rng(1))) >= 0.94


def test_clean_traces_are_hardly_ever_novel(gate: NoveltyGate) -> None:
    assert share(gate, HELD_OUT) <= 0.02


@pytest.mark.parametrize("n", [50, 100, 200])
def test_few_references_do_not_make_clean_traces_novel(n: int) -> None:
    starts = range(0, 500, 100)
    assert (
        np.mean([share(fit_novelty(TRACES[i : i + n], 1.5), HELD_OUT[:300]) for i in starts])
        <= 0.015
    )


def test_a_learned_kind_is_no_longer_novel_and_the_others_still_are() -> None:
    rng = np.random.default_rng(1)
    for kind in ("noise", "sine", "silent"):
        some = GARBAGE[kind](HELD_OUT[:100], rng)
        gate = fit_novelty(np.concatenate([KNOWN, some[:50]]), 1.5)
        assert share(gate, some[50:]) <= (0.2 if kind == "noise" else 0.1)
        others = {
            other: share(gate, make(HELD_OUT[100:150], rng))
            for other, make in GARBAGE.items()
            if other != kind
        }
        assert np.mean(list(others.values())) >= 0.75, (kind, others)


@pytest.mark.parametrize("size", [1e6, 1e30, 3e38, -3e38])
def test_huge_values_are_novel_to_a_gate_that_learned_and_to_no_other(
    gate: NoveltyGate, size: float
) -> None:
    x = torch.from_numpy(HELD_OUT[0].copy())
    x[0, 500] = size
    for trace in (x, torch.full_like(x, size), size * torch.sin(torch.arange(1000.0))[None]):
        assert gate(trace)
        assert not NoveltyGate(1, 1000)(trace)


@pytest.mark.parametrize("size", [1e6, 1e30, 3e38])
def test_a_glitch_among_the_references_blinds_to_nothing_else(size: float) -> None:
    traces = KNOWN.copy()
    traces[100], traces[200, 0, 500] = size, -size
    gate = fit_novelty(traces, 1.5)
    assert share(gate, HELD_OUT[:300]) <= 0.01
    for kind in ("noise", "hum", "offset"):
        assert share(gate, GARBAGE[kind](HELD_OUT[:50], np.random.default_rng(1))) == 1.0


def three_channels(x: Traces) -> Traces:
    rng = np.random.default_rng(3)
    copies = [x, 0.6 * x + rng.normal(size=x.shape), -0.3 * x + 2 * rng.normal(size=x.shape)]
    return np.concatenate(copies, 1).astype(np.float32)


@pytest.mark.parametrize("channel", range(3))
def test_a_channel_that_dies_is_novel(channel: int) -> None:
    traces, held_out = three_channels(KNOWN[:300]), three_channels(HELD_OUT[:50])
    gate = fit_novelty(traces, 1.5)
    assert share(gate, held_out) <= 0.04
    for value in (0.0, traces[:, channel].mean()):
        dead = held_out.copy()
        dead[:, channel] = value
        assert share(gate, dead) == 1.0


def test_compiled_and_eager_agree_to_the_bit(gate: NoveltyGate) -> None:
    compiled = script(gate)
    for x in torch.from_numpy(
        np.concatenate([HELD_OUT[:50], hum(HELD_OUT[:50], np.random.default_rng(0))])
    ):
        assert torch.equal(compiled.scores(x), gate.scores(x))
        assert compiled(x) == gate(x) == (not bool((gate.scores(x) <= 1).all()))


@pytest.mark.parametrize(
    ("channels", "samples"), [(1, 1), (1, 2), (1, 30), (2, 399), (6, 101), (50, 20)]
)
def test_shapes_depend_on_channels_and_samples_alone(channels: int, samples: int) -> None:
    fresh = {name: t.shape for name, t in NoveltyGate(channels, samples).state_dict().items()}
    for n in (10, 40, 1100):
        traces = np.random.default_rng(n).normal(size=(n, channels, samples)).astype(np.float32)
        gate = fit_novelty(traces, 1.5)
        assert {name: t.shape for name, t in gate.state_dict().items()} == fresh
        assert gate.scores(torch.from_numpy(traces[0])).shape == (4,)


@pytest.mark.parametrize("n", [4, 8, 40])
def test_a_few_strangers_among_the_references_do_not_blind_to_others(n: int) -> None:
    x, rng = shuffled(), np.random.default_rng(n)
    strangers = spike(x[:n], rng)
    gate = fit_novelty(np.concatenate([x[n : n + 400], strangers]), 1.5)
    for garbage in (noise, sine):
        assert share(gate, garbage(x[500:550], rng)) >= 0.95
