"""Malformed inputs of every kind: each is refused by an error of dengine's own, or its part is
verified.
"""

import io
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dengine import (
    DataEngine,
    DengineError,
    Recipe,
    TraceSpec,
    describe,
    load_dataset,
)
from dengine.export.cell_journal import read_journal
from dengine.records import FITS
from dengine.testing import toy_traces
from tests.support.command_line import dengine
from tests.support.exports import cell_journal

from .damage import SAMPLES, anything, spoilt, traces, tries

pytestmark = pytest.mark.filterwarnings("ignore")
X, Y = toy_traces(70, SAMPLES)
X = X[:, 0]
SOUND = st.builds(lambda i, offset: X[i] + offset, st.integers(0, 69), st.floats(0, 1, width=32))
SPEC = TraceSpec(SAMPLES)
RECIPES = [Recipe.load(name).to_toml() for name in ("conv", "pca", "rocket", "umap")]
SETTINGS = '0 1 -1 true nan inf 1e400 "" "x" "none" [] [[1]] {} {a=1} 1979-05-27 07:32:00 "a:b" "\\u0000" 0.05 0.9'
TOML = [*SETTINGS.split(), "9" * 5000, "[" * 300, "'''", "0x7fffffffffffffffffff", "\x80", "\0"]
ROWS = [",".join(map(str, x)) for x in X + 1]
TABLE = "\n".join(
    ["FZ_0,FZ_1,FZ_2,label"]
    + [f"{','.join(ROWS[i].split(',')[:3])},{('NOK', 'OK')[y]}" for i, y in enumerate(Y[:4])]
)
RECORDING = "timestamp,FZ_Base\n" + "\n".join(f"{i / 500},{v}" for i, v in enumerate(X[0]))
PART = "part,a-{},{:d},7,verify,verify,uncertain,0.2,1.0,3,0,{}"
PARTS = "\n".join(map(PART.format, range(3), Y.tolist(), ROWS)).encode()
TYPED = "x -1 0 nan inf 1e400 1.5 - -- --out --json é , ,, a,b . / .. /dev/null missing/file %s {} a:b : http://x"
WORDS = [*TYPED.split(), "", "\ud800", "a b", "x" * 300, "sqlite://", "none", "=", "*"]
COMMANDS = """status store.db --json
export store.db --out model.ts --format torchscript
import-labels cell.csv --store store.db --any-model
data small.npz --samples 20 --fit cut --rate-hz 500 --part part
replay --data small.npz --reducer pca --alpha 0.1 --lower-bound 0.9 --repeats 1 --cycles 4 --seed 0
compare --data small.npz --reducers pca --alphas 0.1 --intervals wilson --repeats 1 --cycles 4
train --data small.npz --store trained.db --reducer pca --seed 0 --audit-rate 0.1
run --cell replay --data small.npz --store run.db --reducer pca --cycles 2 --guarantee local --stops all"""


def saved(write: Callable[..., None]) -> bytes:
    buffer = io.BytesIO()
    write(buffer, X=X[:6], y=Y[:6])
    return buffer.getvalue()


FILES = {  # by what reads them
    "data.npz": [saved(np.savez), saved(np.savez_compressed)],
    "table.csv": [TABLE.encode()],
    "cell/1_OK.csv": [RECORDING.encode()],
    "labels.csv": [b"file,label,part\n1_OK.csv,OK,7\n"],
}


def learned(store: Path | None = None) -> DataEngine:
    engine = DataEngine("pca", retrain_every=10**9, store=store, trace=SPEC)
    for x, good in zip(X, Y, strict=True):
        engine.report(engine.decide(x).id, good)
    engine.retrain()
    return engine


@pytest.fixture(scope="module")
def engines():
    """With a model, without one, and of an open contract; each works after all that was tried."""
    untrained = [DataEngine("pca", trace=TraceSpec(SAMPLES, fit=fit)) for fit in FITS[::3]]
    items = [learned(), *untrained]
    yield items
    for engine in items:
        id_ = engine.decide(X[0] * -9.0).id
        engine.report(id_, True)
        assert engine.find(id_).success is True
        engine.close()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    created = tmp_path_factory.mktemp("fuzz")
    (created / "small.npz").write_bytes(FILES["data.npz"][0])
    (created / "cell.csv").write_bytes(journal(PARTS))
    learned(created / "store.db").close()
    return created


def journal(lines: bytes) -> bytes:
    """A cell program's journal of these lines, each with its sum."""
    return cell_journal(*lines.split(b"\n"))


@given(value=traces, which=st.integers(0, 2))
@tries(3.0)
def test_anything_in_the_place_of_a_trace_is_decided_on_or_refused(engines, value, which):
    with suppress(DengineError):
        engines[which].decide(value)


@given(
    value=anything | st.sampled_from([0, 1, True, 1.0, np.int8(1), np.bool_(True), np.array(1)]),
    x=SOUND,
)
@tries(3.0)
def test_a_label_is_a_bool_or_exactly_1_or_0_and_else_leaves_nothing(engines, value, x):
    engine = engines[0]
    id_, before = engine.decide(x * -3.0).id, engine.state.new_labels
    try:
        engine.report(id_, value)
    except DengineError:
        assert (engine.find(id_).success, engine.state.new_labels) == (None, before)
    else:
        assert value in (0, 1)
        assert engine.find(id_).success is bool(value)


@given(value=anything, x=SOUND)
@tries(2.0)
def test_anything_in_the_place_of_an_id_or_a_part_is_taken_or_refused(engines, value, x):
    with suppress(DengineError):
        engines[0].report(value, True)
    with suppress(DengineError):
        engines[0].decide(x, part=value)


@given(
    data=st.data(), value=st.sampled_from(TOML), lines=st.sampled_from(RECIPES).map(str.splitlines)
)
@tries()
def test_a_recipe_with_another_value_or_damaged_makes_an_engine_or_is_refused(
    folder, data, value, lines
):
    at = data.draw(st.sampled_from([i for i, line in enumerate(lines) if " = " in line]))
    lines[at] = lines[at].partition(" = ")[0] + " = " + value
    content = "\n".join(lines).encode("utf-8", "surrogatepass")
    (folder / "recipe.toml").write_bytes(data.draw(st.just(content) | spoilt(content)))
    with suppress(DengineError):
        DataEngine(recipe=Recipe.load(folder / "recipe.toml")).close()


@pytest.mark.parametrize("name", FILES)
@given(data=st.data())
@tries(0.3)
def test_a_damaged_file_of_data_is_read_or_refused(name, tmp_path_factory, data):
    here = tmp_path_factory.mktemp("data")
    cell = here / "cell"
    cell.mkdir()
    (cell / "1_OK.csv").write_bytes(FILES["cell/1_OK.csv"][0])
    (here / name).write_bytes(data.draw(st.sampled_from(FILES[name]).flatmap(spoilt)))
    source = here / name if name in ("data.npz", "table.csv") else cell
    with suppress(DengineError):
        load_dataset(source, describe(source))


@given(content=spoilt(PARTS).map(journal) | spoilt(journal(PARTS)))
@tries()
def test_a_damaged_journal_is_read_or_refused(folder, content):
    (folder / "damaged.csv").write_bytes(content)
    with suppress(DengineError):
        read_journal(folder / "damaged.csv", SPEC)


def must_be_one_line(words: list[str]) -> None:
    done = dengine(*words)
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    errors = sum(line.startswith("Error: ") for line in done.output.splitlines())
    assert done.exit_code == 0 or (done.exit_code in (1, 2) and errors == 1), done.output


@given(data=st.data(), words=st.sampled_from(COMMANDS.splitlines()).map(str.split))
@tries(0.1)
def test_a_command_with_other_words_works_or_says_one_error(folder, data, words):
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(1, len(words)))
        words[at : at + data.draw(st.integers(0, 1))] = data.draw(
            st.lists(st.sampled_from(WORDS), max_size=1)
        )
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        must_be_one_line(words)


@given(data=st.data(), shown=st.booleans())
@tries(0.1)
def test_a_damaged_store_is_opened_and_decides_or_is_refused(folder, tmp_path_factory, data, shown):
    path = tmp_path_factory.mktemp("damaged") / "cell.db"
    path.write_bytes(data.draw(spoilt((folder / "store.db").read_bytes())))
    if shown:
        must_be_one_line(["status", str(path)])
        return
    with suppress(DengineError), DataEngine.open(path) as engine:
        engine.report(engine.decide(X[0] * -3.0).id, True)
