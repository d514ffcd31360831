"""The exported file decides as the engine does, goes on learning honestly, and is refused where it
must not be used.
"""

import hashlib
import json
import shutil
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from sklearn.decomposition import PCA

from dengine import (
    DataEngine,
    Dataset,
    ModelPrediction,
    Recipe,
    TraceSpec,
    export_torchscript,
    load_exported,
)
from dengine.decision.rule import DecisionRule
from dengine.errors import ExportError
from dengine.export import ExportedModel
from dengine.export.bundle import metadata_of, read_checked
from dengine.export.decision import FIELDS
from dengine.records import ACTIONS, REASONS, Action
from tests.support.exports import (
    LIMIT,
    SAMPLES,
    bad_traces,
    fitted,
    recipe,
    row,
    trained,
    wild_traces,
)


@pytest.fixture(scope="module")
def audited(make_data):
    with trained(make_data(400, SAMPLES), audit_rate=0.3) as engine:
        yield engine


@pytest.fixture(scope="module")
def file(audited, tmp_path_factory):
    return export_torchscript(audited, tmp_path_factory.mktemp("export") / "model.ts")


def a_stream(
    make_data: Callable[..., Dataset], n: int, seed: int
) -> Iterator[tuple[np.ndarray, bool, str | int | None]]:
    """Traces, labels and parts' numbers: parts that come again, bad traces, novel ones, and a world
    that changes.
    """
    rng, data = np.random.default_rng(seed), make_data(n, SAMPLES, seed=seed, noise=3.0)
    for i, (x, y) in enumerate(zip(data.X.copy(), data.y, strict=True)):
        part = (None, f"P{i}", i)[i % 3]
        if i > 5 and rng.random() < 0.1:
            part = int(rng.integers(i))
        kind, share = rng.random(), i / n
        if kind < 0.08:
            x = bad_traces(x)[i % 5] if kind < 0.04 else x * 5.0
        if 0.85 < share < 0.9:
            x = np.ascontiguousarray(x[::-1] + 30.0 * np.sin(np.arange(SAMPLES, dtype=np.float32)))
        yield x, bool(y) != (0.6 < share < 0.75 and rng.random() < 0.4), part


METHODS = "forward decide learn stop settle safe_mode restore predicted drop n_references"


def test_a_plain_torch_load_decides_by_calling_the_module_and_reads_the_seven_fields(
    file, make_data
):
    plain, exported = torch.jit.load(str(file)), load_exported(file)
    for x in wild_traces(make_data(30, SAMPLES, seed=9).X)[:40]:
        called, expected = (
            dict(zip(FIELDS, plain(torch.from_numpy(x)), strict=True)),
            exported.decide(x),
        )
        assert ACTIONS[called["action"]] == expected.action
        assert REASONS[called["reason"]] == expected.reason
        assert [*called.values()][2:6] == [*expected[2:6]]
    assert [name for name in METHODS.split() if not hasattr(plain, name)] == []


LEARNED = """references.points references.parts references.repeats references.total
evidence.member_counts evidence.detector_sums evidence.thresholds"""


@pytest.mark.parametrize(
    ("guarantee", "stops", "n", "more"),
    [
        (
            "local",
            "all",
            600,
            {"reducer": "rocket", "params": {"folds": 2, "kernels": 4}, "folds": 2},
        ),
        ("pooled", "some", 1500, {}),
        pytest.param("pooled", "all", 900, {}, marks=pytest.mark.slow),
        pytest.param("cost", "all", 1500, {}, marks=pytest.mark.slow),
    ],
)
def test_the_file_decides_and_learns_as_the_engine_does_until_its_next_retrain(
    make_data,
    tmp_path,
    guarantee,
    stops,
    n,
    more,
):
    rates = {"audit_rate": 0.1, "label_within": 2000, "force_limits": ["0.1:0.15:-20:"]}
    settings = recipe(guarantee=guarantee, stops=stops, window=700, **rates, **more)
    spec = TraceSpec(SAMPLES, rate_hz=500.0, limit=LIMIT)
    rng, happened, saved = np.random.default_rng(7), Counter[str](), False
    with DataEngine(recipe=settings, trace=spec, seed=3, replaying=True) as engine:
        for x, y, part in a_stream(make_data, n // 3, 1):
            engine.report(engine.decide(x, part).id, y)
        engine.retrain()
        exported = load_exported(export_torchscript(engine, tmp_path / "model.ts"))
        for i, (x, y, part) in enumerate(a_stream(make_data, n, 2)):
            decision, result = engine.decide(x, part), exported.decide(x, part)
            assert row(result) == row(decision)
            if decision.embedding is not None:
                assert result.embedding.tolist() == np.float32(decision.embedding).tolist()
            # How often something is heard of a part.
            is_accept = decision.action is Action.ACCEPT
            share = (0.1 if y else 0.5 + (stops == "all")) if is_accept else 0.9
            heard = decision.action is not Action.REJECT and rng.random() < share
            if heard:
                stops_line = is_accept and not y
                heard = (exported.stop(x, part) if stops_line else exported.learn(x, y, part)) > 0
            if heard:
                engine.report(decision.id, y)
            elif is_accept and not saved and i > 0.4 * n:  # while one waits
                exported, saved = load_exported(exported.save(tmp_path / "later.ts")), True
            assert exported.safe_mode == engine.safe_mode
            mode = f"safe mode {engine.safe_mode}"
            happened.update([decision.reason, f"{decision.action} {heard}", mode])
        ours = {f"references.{name}": t for name, t in engine.model.index.state_dict().items()}
        kept = buffers(exported)
        ours = {k: t for k, t in (ours | engine.model.rule.state_dict()).items() if k in kept}
        for name, tensor in ours.items():
            torch.testing.assert_close(kept[name], tensor, rtol=0, atol=0)
        remembers = type(engine.model.rule) is not DecisionRule
        assert ours.keys() >= {*LEARNED.split()[: None if remembers else 4]}
    for outcome in ("verify True", "verify False", "accept True", "accept False"):
        assert happened[outcome] > 10
    assert happened.keys() >= {"novel", "audit", "not_finite", "saturated", "outside"}
    assert sum(name.startswith("safe mode") for name in happened) > (stops == "all")
    assert saved


def test_the_file_says_what_it_is_without_being_loaded(audited, file, monkeypatch):
    monkeypatch.setattr(torch.jit, "load", lambda *a, **k: pytest.fail("the code was loaded"))
    metadata = metadata_of(read_checked(file), file)
    assert metadata["trace"] == asdict(TraceSpec(SAMPLES, 500.0, limit=LIMIT)) | {"columns": []}
    assert Recipe.from_toml(metadata["recipe"]) == audited.recipe
    assert (metadata["schema"], metadata["model_version"]) == (2, audited.version)
    assert metadata["references"] == len(audited.model.index)
    assert file.with_name("model.ts.sha256").read_text() == sum_of(file)


def test_loading_unpickles_nothing_in_python(file, monkeypatch):
    import pickle

    for name in ("load", "loads", "Unpickler"):
        monkeypatch.setattr(pickle, name, lambda *a, **k: pytest.fail("a pickle was read"))
    monkeypatch.setattr(torch, "load", lambda *a, **k: pytest.fail("a pickle was read"))
    load_exported(file)


def sum_of(file: Path) -> str:
    """What stands beside a file, as sha256sum reads it."""
    return f"{hashlib.sha256(file.read_bytes()).hexdigest()}  {file.name}\n"


@pytest.fixture
def copy(file, tmp_path):
    return Path(shutil.copytree(file.parent, tmp_path / "copy")) / file.name


@pytest.mark.parametrize("kind", ["flip", "truncation", "block"])
def test_every_damaged_file_is_refused(copy, kind):
    content, rng = copy.read_bytes(), np.random.default_rng(1)
    for i, j in np.sort(rng.integers(len(content) - 512, size=(20, 2))).tolist():
        flipped, other_block = bytes([content[i] ^ 1 << j % 8]), rng.bytes(512)
        written = {"flip": flipped, "truncation": b"", "block": other_block}[kind]
        rest = b"" if kind == "truncation" else content[i + len(written) :]
        copy.write_bytes(changed := content[:i] + written + rest)
        if changed == content:  # both blocks are padding
            continue
        with pytest.raises(ExportError, match="is damaged or truncated: its SHA-256 is"):
            load_exported(copy)


def zipped(path: Path, name: str, text: str) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(name, text)


def described(path: Path, **changes: Any) -> None:
    """The same module under another description."""
    exported = load_exported(path)
    about = json.dumps(exported.metadata | changes).encode()
    torch.jit.save(exported.module, str(path), {"dengine.json": about})


ELSEWHERE = {"trace": [[1.0] * SAMPLES], "embedding": [[0.01, 0.01]]}
FOREIGN = {  # by what is said of it
    r"it holds no dengine\.json": lambda path: path.write_bytes(b"no model at all" * 1000),
    "is not a dengine export": lambda path: zipped(path, "holiday.txt", "sand"),
    "model.ts is not a dengine export": lambda path: torch.jit.save(
        torch.jit.script(torch.nn.ReLU()), str(path)
    ),
    "is no loadable TorchScript": lambda path: zipped(
        path, "model/extra/dengine.json", json.dumps(load_exported(path).metadata)
    ),
    r"schema 1, written by dengine 9\.0; this one": lambda path: described(
        path, schema=1, dengine="9.0"
    ),
    "description": lambda path: described(path, trace={"samples": 99, "colour": "red"}),
    "does not reproduce its golden embedding": lambda path: described(path, golden=ELSEWHERE),
}


@pytest.mark.parametrize("words", FOREIGN)
def test_a_foreign_file_with_its_sum_is_refused(copy, words):
    FOREIGN[words](copy)
    copy.with_name("model.ts.sha256").write_text(sum_of(copy))
    with pytest.raises(ExportError, match=words):
        load_exported(copy)


def test_a_missing_file_or_sum_is_named(copy):
    total = copy.with_name("model.ts.sha256")
    with pytest.raises(ExportError, match=r"other\.ts cannot be read: No such file"):
        load_exported(copy.with_name("other.ts"))
    for content in ("", "0" * 64, "not a sum\n"):
        total.write_text(content)
        with pytest.raises(ExportError, match=r"holds no SHA-256 sum|is damaged"):
            load_exported(copy)
    total.unlink()
    with pytest.raises(ExportError, match=r"model\.ts\.sha256 cannot be read: No such file"):
        load_exported(copy)


def test_what_cannot_be_exported_says_why_and_names_the_alternative(data, tmp_path):
    missed = fitted(data)
    missed.rule_is_stale = True
    baseline = type("Thing", (), {"model": object()})()
    for value, words in (
        (fitted(data, PCA(2)), r"PCA cannot be exported, for it has no module: .* nn\.Module"),
        (fitted(data, interval="jeffreys"), "use wilson or binomial"),
        (missed, "missed what became of a part"),
        (DataEngine("pca"), "Nothing was trained yet"),
        (ModelPrediction("pca"), "Nothing was trained yet"),
        (baseline, "a baseline stays in Python"),
    ):
        with pytest.raises(ExportError, match=words):
            export_torchscript(value, tmp_path / "model.ts")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("limit", [1e19, float("inf")])
def test_a_file_for_a_sensor_without_a_real_limit_is_checked_and_loaded(data, tmp_path, limit):
    spec = TraceSpec(SAMPLES, limit=limit)
    exported = load_exported(export_torchscript(fitted(data), tmp_path / "model.ts", trace=spec))
    assert np.isfinite(exported.metadata["golden"]["embedding"]).all()


def test_a_file_that_no_machine_could_check_is_not_written(data, tmp_path):
    spec = TraceSpec(SAMPLES, limit=1e-60)
    with pytest.raises(ExportError, match="is not finite, so no machine could check the file"):
        export_torchscript(fitted(data), tmp_path / "model.ts", trace=spec)
    assert list(tmp_path.iterdir()) == []


def buffers(exported: ExportedModel) -> dict[str, torch.Tensor]:
    """What a file has learned, by the last two words of its name."""
    return {".".join(name.split(".")[-2:]): t for name, t in exported.module.named_buffers()}


def test_checking_a_file_teaches_it_nothing_and_what_waits_is_kept_apart_from_what_is_told(
    make_data, tmp_path
):
    """The file accepts whatever comes, and silence confirms it."""
    data, new = make_data(300, SAMPLES, failures=0.02), make_data(4, SAMPLES, seed=4).X
    lenient = {"lower_bound": 0.6, "stops": "all", "radius": 10.0, "novelty": 0.0}
    engine = trained(data, trace=TraceSpec(SAMPLES), **lenient)
    exported = load_exported(export_torchscript(engine, tmp_path / "model.ts"))
    count = exported.module.n_references
    assert not exported.module.settle()
    assert count() == 300
    # Its golden trace could have been confirmed, too.
    for x in (exported.metadata["golden"]["trace"], new[0]):
        assert exported.decide(x).action is Action.ACCEPT
    assert exported.learn(new[1], False) == 302  # not the one that waits
    exported.decide(new[2])
    assert count() == 303  # the first one is confirmed
    exported.module.drop()
    exported.decide(new[3])
    assert count() == 303
    assert exported.stop(new[3]) == 304
    assert not exported.module.settle()
