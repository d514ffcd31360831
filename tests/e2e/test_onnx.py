"""The ONNX twin decides as the model does, says what it cannot carry, and is refused where it must
not be used.
"""

import hashlib
import re

import numpy as np
import pytest

from dengine import (
    ModelPrediction,
    TraceSpec,
    export_torchscript,
    load_exported,
)
from dengine.decision.rule import DecisionRule
from dengine.errors import ExportError, TraceError
from dengine.export import export_onnx, load_onnx
from dengine.records import Action, Reason
from tests.support.exports import NEEDS_ONNX, fitted, trained

pytestmark = NEEDS_ONNX
SPEC = TraceSpec(100, limit=500.0)
# Another interval is the same file with another number in it.
BALLS = [{}, pytest.param({"interval": "binomial", "radius": 0.5}, marks=pytest.mark.slow)]


@pytest.fixture(scope="module")
def file(make_data, tmp_path_factory):
    return export_onnx(
        fitted(make_data(300)), tmp_path_factory.mktemp("onnx") / "model.onnx", trace=SPEC
    )


@pytest.mark.parametrize("ball", BALLS)
def test_both_formats_decide_alike(file, make_data, tmp_path, ball):
    model = fitted(make_data(300), **ball)
    first = load_onnx(export_onnx(model, tmp_path / "model.onnx", trace=SPEC) if ball else file)
    two = load_exported(export_torchscript(model, tmp_path / "model.ts", trace=SPEC))
    bad = make_data(5, seed=1).X
    bad[0, 3], bad[1, 5], bad[2, 0], bad[3], bad[4] = np.nan, -np.inf, 1e30, 2.5, np.nan
    novel = 3.0 * make_data(50, seed=8).X
    X = [*make_data(200, seed=9).X, *make_data(50, seed=7, noise=3.0).X, *novel, *bad]
    results = [*map(first.decide, X)]
    for result, expected in zip(results, map(two.decide, X), strict=True):
        assert result[:2] == expected[:2]
        assert result[2:4] == pytest.approx(expected[2:4], abs=1e-6)
        assert result[4:6] == expected[4:6]
        np.testing.assert_allclose(result.embedding, expected.embedding, rtol=1e-4, atol=1e-5)
    reasons = {result.reason for result in results}
    assert reasons >= {Reason.NOT_FINITE, Reason.CONSTANT, Reason.SATURATED, Reason.NOVEL}
    assert Action.ACCEPT in {result.action for result in results}


class OwnRule(DecisionRule):
    """A rule of the user's own; the twin cannot know what it does."""


EVERYTHING = (
    "ONNX carries no audits or shadow mode (set audit_rate = 0, shadow = false); nor PooledRule, a "
    "rule that learns (set guarantee = 'local' and stops = 'some'); nor an operator's force limits."
    " Export torchscript instead."
)


def test_what_the_twin_cannot_do_is_refused(data, tmp_path, monkeypatch):
    hashes = np.arange(1, len(data) + 1)
    hashes[7] = hashes[3]
    limits = {"guarantee": "pooled", "stops": "all", "force_limits": ("0.01:0.1:-50:50",)}
    learning = ModelPrediction("pca", rule=OwnRule(0.1, 0.9)).fit(data.X, data.y)
    repeated = ModelPrediction("pca").fit(data.X, data.y, hashes=hashes)
    with trained(data, audit_rate=0.1, **limits) as engine:
        for model, why in (
            (engine, re.escape(EVERYTHING)),
            (repeated, r"ONNX carries no votes of parts that came again \(1 references\)"),
            (fitted(data, interval="jeffreys"), "use wilson or binomial"),
            (learning, "no OwnRule, a rule that learns"),
        ):
            with pytest.raises(ExportError, match=why):
                export_onnx(model, tmp_path / "model.onnx")
    monkeypatch.setattr("dengine.export.onnx.find_spec", lambda name: name != "onnxscript" or None)
    with pytest.raises(ExportError, match=r'needs onnxscript; pip install "dengine\[onnx\]"'):
        export_onnx(fitted(data), tmp_path / "model.onnx")
    assert not any(tmp_path.iterdir())


def test_a_damaged_file_and_a_foreign_one_are_refused(file, tmp_path):
    metadata, content = load_onnx(file).metadata, file.read_bytes()
    assert (metadata["format"], metadata["learns"], metadata["references"]) == ("onnx", False, 300)
    with pytest.raises(TraceError, match="Expected 100 samples, got 98"):
        load_onnx(file).decide(np.ones(98))
    copy = tmp_path / "model.onnx"
    for written, summed, words in (
        (content[:-9], content, "is damaged or truncated"),
        (b"garbage", b"garbage", "is not a dengine export in ONNX"),
    ):
        copy.write_bytes(written)
        copy.with_name("model.onnx.sha256").write_text(hashlib.sha256(summed).hexdigest())
        with pytest.raises(ExportError, match=words):
            load_onnx(copy)
