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
def gate():
    return fit_novelty(KNOWN, 1.5)


def share(gate: NoveltyGate, traces: Traces) -> float:
    return float(np.mean([gate(torch.from_numpy(np.array(x, dtype=np.float32))) for x in traces]))


def spike(x: Traces, rng: np.random.Generator) -> Traces:
    spiked = x.copy()
    spiked[np.arange(len(x)), 0, rng.integers(0, x.shape[2], len(x))] += 4 * SD
    return spiked


Spoil = Callable[[Traces, np.random.Generator], Traces]


def proof(name: str) -> Spoil:
    """A kind of the proof's."""
    return lambda x, rng: KINDS[name](x[:, 0], x[:, 0], rng)[:, None].astype(np.float32)


noise, hum = proof("white noise"), proof("hum on good parts")
GARBAGE: dict[str, Spoil] = {
    "noise": noise,
    "sine": proof("sine"),
    "hum": hum,
    "spike": spike,
    "offset": lambda x, _: x + np.float32(SD),
    "drift": lambda x, _: x - np.linspace(0, SD, x.shape[2], dtype=np.float32),
    "silent": lambda x, _: np.zeros_like(x),
    "stuck": lambda x, _: np.full_like(x, MEAN),
}


@pytest.mark.parametrize("kind", GARBAGE)
def test_garbage_is_novel(gate, kind):
    # Of the reversed traces those that never touched anything are what they were: one in twenty.
    assert share(gate, GARBAGE[kind](HELD_OUT[:100], np.random.default_rng(1))) >= 0.94


def test_clean_traces_are_hardly_ever_novel(gate):
    assert share(gate, HELD_OUT) <= 0.02


@pytest.mark.parametrize("n", [50, 200])
def test_few_references_do_not_make_clean_traces_novel(n):
    gates = [fit_novelty(TRACES[i : i + n], 1.5) for i in range(0, 500, 100)]
    assert np.mean([share(gate, HELD_OUT[:200]) for gate in gates]) <= 0.015


@pytest.mark.parametrize("kind", ["noise", "sine", "silent"])
def test_a_learned_kind_is_no_longer_novel_and_the_others_still_are(kind):
    rng = np.random.default_rng(1)
    examples = GARBAGE[kind](HELD_OUT[:100], rng)
    gate = fit_novelty(np.concatenate([KNOWN, examples[:50]]), 1.5)
    assert share(gate, examples[50:]) <= 0.2
    others = [GARBAGE[other] for other in GARBAGE if other != kind]
    assert np.mean([share(gate, make(HELD_OUT[100:150], rng)) for make in others]) >= 0.75


@pytest.mark.parametrize("size", [1e6, 3e38])
def test_a_glitch_among_the_references_blinds_to_nothing_else(size):
    traces = KNOWN.copy()
    traces[100], traces[200, 0, 500] = size, -size
    gate = fit_novelty(traces, 1.5)
    assert share(gate, HELD_OUT[:300]) <= 0.01
    assert share(gate, hum(HELD_OUT[:50], np.random.default_rng(1))) == 1.0


@pytest.mark.parametrize("value", [0.0, MEAN])
def test_a_channel_that_dies_is_novel(value):
    noise = 2 * np.random.default_rng(3).normal(size=(350, 1, 1000))
    traces = np.concatenate([TRACES[:350], noise], axis=1).astype(np.float32)
    gate, held_out = fit_novelty(traces[:300], 1.5), traces[300:]
    assert share(gate, held_out) <= 0.04
    held_out[:, 0] = value
    assert share(gate, held_out) == 1.0


def test_compiled_and_eager_agree_to_the_bit(gate):
    compiled = script(gate)
    traces = [HELD_OUT[:50], hum(HELD_OUT[:50], np.random.default_rng(0))]
    for x in torch.from_numpy(np.concatenate(traces)):
        assert torch.equal(compiled.scores(x), gate.scores(x))
        assert compiled(x) == gate(x) == bool((gate.scores(x) > 1).any())


@pytest.mark.parametrize("shape", [(1, 1), (1, 2), (2, 399), (50, 20)])
def test_shapes_depend_on_channels_and_samples_alone(shape):
    traces = np.random.default_rng(0).normal(size=(1100, *shape)).astype(np.float32)
    gates = [NoveltyGate(*shape), fit_novelty(traces[:10], 1.5), fit_novelty(traces, 1.5)]
    shapes = [[tensor.shape for tensor in gate.state_dict().values()] for gate in gates]
    assert shapes[0] == shapes[1] == shapes[2]
