"""Malformed inputs of every kind: each must be refused by an error of dengine's own, or its part be verified.

    python -m tests.slow.fuzzing.inputs --n 1000 --seed 0

Prints a table by kind: what was tried, refused (a `DengineError`; exit code 1 or 2 and one line that begins with "Error:"),
verified, and taken, since what was damaged can still be a good input. Any other exception is raw and is shown; so is what
was taken and must not be. Exit code 1 if there is any.
"""

from __future__ import annotations

import argparse
import io
import logging
import os
import random
import sys
import tempfile
import traceback
import warnings
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from click.testing import CliRunner

from dengine import Action, DataEngine, DengineError, Recipe, TraceSpec, load_dataset, open_store
from dengine.cli import main as command_line
from dengine.datasets.importing import import_labelled
from dengine.export import import_journal
from dengine.testing import toy_traces

SHOWN = 5  # raw exceptions of a kind whose traceback is printed
OUTCOMES = ("refused", "verified", "taken", "raw")
SHARES = {"traces": 0.31, "labels": 0.25, "ids": 0.18, "toml": 0.1, "data": 0.1, "imports": 0.03}  # of all attempts
SHARES |= dict.fromkeys(("journals", "arguments", "stores"), 0.01)  # these take the longest
SAMPLES = 40
NAN, INF = float("nan"), float("inf")
ODD: list[Any] = [
    *(None, True, False, 0, 1, -1, 2, 100, 255, 2**31, 2**63, 2**70, -(2**64), 10**400, 0.0, 1.0, 0.5, -0.0, 1e308, 1e-320),
    *(
        NAN,
        INF,
        -INF,
        1j,
        "",
        "x",
        "NG",
        "0",
        "1",
        "True",
        "nan",
        "\0",
        "\ud800",
        "é" * 300,
        "a\nb",
        "x" * 10_000,
        object(),
    ),
    *(b"", b"\0", b"1", [], [0], [[1]], (), {}, {"a": 1}, {1}, int, len, range(3), slice(1), np.nan, np.int8(1)),
    *(np.uint64(2**63), np.float16("inf"), np.bool_(True), np.array(1), np.array([]), np.array([1]), np.array("a")),
    *(object(), np.array([None]), np.zeros((2, 2)), np.ma.masked, np.datetime64("nat"), np.timedelta64(1)),
]
S = SAMPLES
SHAPES = [(), (0,), (1,), (3,), (S - 1,), (S,), (S,), (1, S), (S, 1), (2, S), (1, 1, S)]
DTYPES = "f2 f4 f8 g i1 u8 ? c8 M8[s] S3 U2 O >f4 >i8"
SETTINGS = '0 1 -1 true nan inf 1e400 "" "x" "none" [] [[1]] {} {a=1} 1979-05-27 07:32:00 "a:b" "\\u0000" 0.05 0.9'
TOML = [*SETTINGS.split(), "9" * 400, "9" * 5000, "[" * 300, "'''", "0x7fffffffffffffffffff", "\x80", "\0"]
TYPED = "x -1 0 nan inf 1e400 1.5 - -- --out --json é , ,, a,b . / .. /dev/null missing/file %s {} a:b : http://x"
WORDS = [*TYPED.split(), "", "\ud800", "a b", "x" * 300, "sqlite://", "none", "=", "*"]
COMMANDS = """status store.db --json
export store.db --out model.ts --format torchscript
import-labels cell.csv --store store.db --any-model
data small.npz --samples 20 --fit cut --rate 500 --part part
replay --data small.npz --reducer pca --alpha 0.1 --lower-bound 0.9 --repeats 1 --cycles 4 --seed 0
compare --data small.npz --reducers pca --alphas 0.1 --intervals wilson --repeats 1 --cycles 4
train --data small.npz --store trained.db --reducer pca --seed 0 --retrains 1 --audit-rate 0.1
run --cell replay --data small.npz --store run.db --reducer pca --cycles 2 --guarantee local --stops all"""


def spoilt(rng: random.Random, content: bytes) -> bytes:
    """The content with bytes changed, cut, doubled, moved or zeroed."""
    out = bytearray(content)
    for _ in range(rng.choice((1, 1, 1, 2, 8, 64))):
        at, size = rng.randrange(len(out) + 1), rng.choice((1, 1, 2, 8, 100))
        match rng.randrange(6):
            case 0 | 1 if at < len(out):
                out[at] = rng.randrange(256)
            case 2:
                del out[at:]
            case 3:
                del out[at : at + size]
            case 4:
                out[at:at] = rng.randbytes(size)
            case _:
                out[at : at + size] = bytes(len(out[at : at + size]))
    return bytes(out)


def odd_trace(rng: random.Random) -> Any:
    """Something in the place of a trace."""
    if rng.random() < 0.3:
        return rng.choice(ODD)
    shape, dtype = rng.choice(SHAPES), rng.choice(DTYPES.split())
    values = np.random.default_rng(rng.randrange(2**32)).normal(size=shape) * 10.0 ** rng.randint(-3, 3)
    with np.errstate(all="ignore"), suppress(TypeError, ValueError):
        array = np.array(values if dtype[-1] in "fgdO" or dtype[1:2] in "248" else np.abs(values)).astype(dtype)
        if array.size and array.dtype.kind == "f" and rng.random() < 0.5:
            array.flat[rng.randrange(array.size)] = rng.choice((np.nan, np.inf, -np.inf, 1e30, 0.0))
        return array if rng.random() < 0.7 else array.tolist()
    return values


class Fuzz:
    """Attempts of every kind on small engines, stores and files in a folder of their own."""

    def __init__(self, folder: Path) -> None:
        X, y = toy_traces(70, SAMPLES)
        self.folder, self.X, self.y = folder, X[:, 0], y
        trace = TraceSpec(SAMPLES)
        self.engines = [DataEngine("pca", retrain_every=10**9, trace=trace) for _ in range(2)]
        self.engines += [DataEngine("pca", retrain_every=10**9, store=folder / "own.db", trace=trace)]
        for engine in self.engines[1:]:
            self._teach(engine)
        self.stops = [self.engines[1], DataEngine("pca", retrain_every=10**9, trace=TraceSpec(SAMPLES, fit="resample"))]
        self.store = self._small_store("store.db")
        self.npz = self._saved(lambda file: np.savez(file, X=self.X[:6], y=self.y[:6], rate_hz=np.float32(500.0)))
        self.packed = self._saved(lambda file: np.savez_compressed(file, X=self.X[:6], y=self.y[:6]))
        header = ",".join([*(f"FZ_{i}" for i in range(6)), "label"])
        self.csv = "\n".join(
            [header, *(",".join([*map(str, x[:6]), "OK" if good else "NOK"]) for x, good in zip(X[:4, 0], y, strict=False))]
        )
        self.recording = "timestamp,FZ_Base\n" + "\n".join(f"{i / 500},{value}" for i, value in enumerate(self.X[0]))
        self.recipes = [Recipe.load(name).to_toml() for name in ("conv", "pca", "rocket", "umap")]
        self.commands = self._commands()

    def _teach(self, engine: DataEngine) -> None:
        for x, good in zip(self.X, self.y, strict=True):
            engine.report(engine.decide(x).id, good)
        engine.retrain()

    def _small_store(self, name: str) -> bytes:
        with DataEngine("pca", retrain_every=10**9, store=self.folder / name) as engine:
            self._teach(engine)
        lines = [f"part,a-{i},{y},7,verify,verify,uncertain,0.2,1.0,3,0" for i, y in enumerate(self.y[:3])]
        lines = [f"{line},{','.join(map(str, x))}" for line, x in zip(lines, self.X[:3] + 1, strict=True)]
        self.journal = "\n".join(["# dengine 3 abc", *(f"{line},{zlib.crc32(line.encode()):08x}" for line in lines), ""])
        return (self.folder / name).read_bytes()

    def _saved(self, write: Callable[[Any], None]) -> bytes:
        buffer = io.BytesIO()
        write(buffer)
        return buffer.getvalue()

    def _commands(self) -> list[list[str]]:
        (self.folder / "small.npz").write_bytes(self.npz)
        (self.folder / "cell.csv").write_text(self.journal)
        return [line.split() for line in COMMANDS.splitlines()]

    # Each takes a random generator and returns an outcome, or raises.

    def traces(self, rng: random.Random) -> str:
        """Anything in the place of a trace, to engines with and without a model, and with an open contract."""
        engine = rng.choice(self.engines) if rng.random() < 0.9 else DataEngine("pca")
        return "verified" if engine.decide(odd_trace(rng)).action is Action.VERIFY else "taken"

    def labels(self, rng: random.Random) -> str:
        """Anything in the place of a label; what is taken must be a bool, or exactly 1 or 0."""
        engine, value = self._one(rng), rng.choice(ODD)
        id_ = engine.decide(self._sound(rng)).id
        before = engine.new_labels
        try:
            engine.report(id_, value)
        except DengineError:
            if engine.new_labels != before or engine.store.get_decision(id_).success is not None:
                raise RuntimeError(f"a label that was refused is stored: {value!r}") from None
            raise
        stored = engine.store.get_decision(id_).success
        number = isinstance(value, bool | int | float | np.generic | np.ndarray)
        if not number or stored is not bool(value) or value not in (0, 1):
            raise RuntimeError(f"stored {stored} for the label {value!r}")
        return "taken"

    def _one(self, rng: random.Random) -> DataEngine:
        return self.engines[2] if rng.random() < 0.02 else self.engines[rng.randrange(2)]  # a database syncs each label

    def _sound(self, rng: random.Random) -> Any:
        return self.X[rng.randrange(len(self.X))] + rng.random()

    def ids(self, rng: random.Random) -> str:
        """Anything in the place of a decision's id, of a part's number, or of a lost stop's trace."""
        engine, value = self._one(rng), rng.choice(ODD)
        match rng.randrange(4):
            case 0:
                engine.report(value, rng.random() < 0.5)
            case 1:
                engine.report(value, False, trace=self._sound(rng))
            case 2:
                engine.report(f"lost-{rng.randrange(10**9)}", False, odd_trace(rng), rng.choice((None, value)))
            case _:
                return "verified" if engine.decide(self._sound(rng), part=value).action is Action.VERIFY else "taken"
        return "taken"

    def toml(self, rng: random.Random) -> str:
        """Recipes with another value at a key, or with damaged bytes, up to the engine that is made by them."""
        lines = rng.choice(self.recipes).split("\n")
        if rng.random() < 0.6:
            at = rng.choice([i for i, line in enumerate(lines) if " = " in line])
            lines[at] = lines[at].split(" = ")[0] + " = " + rng.choice(TOML)
        content = "\n".join(lines).encode("utf-8", "surrogatepass")
        path = self.folder / "recipe.toml"
        path.write_bytes(content if rng.random() < 0.5 else spoilt(rng, content))
        DataEngine(recipe=Recipe.load(path)).close()
        return "taken"

    def data(self, rng: random.Random) -> str:
        """Damaged .npz and .csv files, as a table, a folder, or a file of labels."""
        folder = self.folder / "data"
        folder.mkdir(exist_ok=True)
        table, cell, listed = folder / "table.csv", folder / "cell", folder / "labels.csv"
        cell.mkdir(exist_ok=True)
        match rng.randrange(5):
            case 0 | 1:
                path = folder / "data.npz"
                path.write_bytes(spoilt(rng, rng.choice((self.npz, self.packed))))
                load_dataset(path)
            case 2:
                table.write_bytes(spoilt(rng, self.csv.encode()))
                load_dataset(table)
            case 3:
                (cell / "1_OK.csv").write_bytes(spoilt(rng, self.recording.encode()))
                load_dataset(cell)
            case _:
                (cell / "1_OK.csv").write_text(self.recording)
                listed.write_bytes(spoilt(rng, b"file,label,part\n1_OK.csv,OK,7\n"))
                load_dataset(cell, labels=listed)
        return "taken"

    def journals(self, rng: random.Random) -> str:
        """Damaged journals into a store."""
        path = self.folder / "journal.csv"
        path.write_bytes(spoilt(rng, self.journal.encode()))
        place = self.folder / "journals.db"
        if not place.exists() or rng.random() < 0.02:
            place.write_bytes(self.store)
        import_journal(place, path)
        return "taken"

    def arguments(self, rng: random.Random) -> str:
        """A command with words that are changed, left out, doubled or added."""
        words = list(rng.choice(self.commands))
        for _ in range(rng.choice((1, 1, 2, 3))):
            at = rng.randrange(len(words) + 1) if rng.random() < 0.1 else rng.randrange(1, max(2, len(words)))
            match rng.randrange(4):
                case 0:
                    words[at : at + 1] = []
                case 1:
                    words.insert(at, rng.choice(WORDS))
                case _:
                    words[at : at + 1] = [rng.choice(WORDS)]
        return self._command(words)

    def _command(self, words: list[str]) -> str:
        done = CliRunner().invoke(command_line, words)
        if done.exception is not None and not isinstance(done.exception, SystemExit):
            raise done.exception
        errors = [line for line in done.output.splitlines() if line.startswith("Error: ")]
        if done.exit_code == 0:
            return "taken"
        if done.exit_code not in (1, 2) or len(errors) != 1:
            raise RuntimeError(f"exit code {done.exit_code}, {len(errors)} errors: {words} {done.output[-300:]!r}")
        return "refused"

    def stores(self, rng: random.Random) -> str:
        """A store's file with damaged bytes: opened, decided with, reported to; or shown."""
        path = self.folder / f"damaged{rng.randrange(10**9)}.db"
        path.write_bytes(spoilt(rng, self.store))
        try:
            if rng.random() < 0.3:
                return self._command(["status", str(path)])
            with DataEngine.open(path) as engine:
                decision = engine.decide(self._sound(rng))
                if decision.action is Action.VERIFY:
                    engine.report(decision.id, True)
            return "verified" if decision.action is Action.VERIFY else "taken"
        finally:
            for each in self.folder.glob(f"{path.name}*"):
                each.unlink()

    def imports(self, rng: random.Random) -> str:
        """Odd arrays, labels and parts' numbers as labelled traces into a store."""
        labels = [rng.choice((0, 1, rng.choice(ODD))) for _ in range(3)]
        X = self.X[:3] + rng.random() if rng.random() < 0.5 else odd_trace(rng)
        import_labelled(open_store(None), (X, labels), recipe="pca")
        return "taken"

    def close(self) -> None:
        """Show that the engines work after all that: a label each is taken and found."""
        for engine in self.engines:
            decision = engine.decide(self.X[0] + 5)
            if decision.action is Action.VERIFY:
                engine.report(decision.id, True)
                engine.flush()
                assert engine.store.get_decision(decision.id).success is True
            engine.close()


def attempt(run: Callable[[random.Random], str], rng: random.Random) -> tuple[str, str]:
    """An outcome, and the traceback of a raw exception."""
    try:
        return run(rng), ""
    except DengineError:
        return "refused", ""
    except Exception:
        return "raw", traceback.format_exc(limit=-6)


def fuzz(n: int, seed: int, folder: Path, kinds: list[str] | None = None) -> dict[str, Counter[str]]:
    """Try n inputs; outcomes by kind. Raw exceptions are printed, the first few of each kind."""
    subject, found = Fuzz(folder), dict[str, Counter[str]]()
    for kind, share in SHARES.items():
        if kinds and kind not in kinds:
            continue
        counts = found.setdefault(kind, Counter())
        for i in range(max(1, round(share * n))):
            outcome, said = attempt(getattr(subject, kind), random.Random(f"{seed} {kind} {i}"))
            counts[outcome] += 1
            if said and counts["raw"] <= SHOWN:
                print(f"{kind} {i}: {said}", file=sys.stderr)
    subject.close()
    return found


@contextmanager
def quiet_folder() -> Iterator[Path]:
    """A folder to work in, without logs and warnings of what is expected."""
    here = Path.cwd()
    logging.disable(logging.CRITICAL)
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        os.chdir(folder)
        try:
            yield Path(folder)
        finally:
            os.chdir(here)
            logging.disable(logging.NOTSET)


def main() -> None:
    """Parse, try, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n", type=int, default=100_000, help="inputs to try")
    parser.add_argument("--seed", type=int, default=0, help="the same seed, the same inputs")
    parser.add_argument("--kinds", nargs="+", choices=SHARES, help="only these; all by default")
    args = parser.parse_args()
    with quiet_folder() as folder:
        found = fuzz(args.n, args.seed, folder, args.kinds)
    total = sum(found.values(), Counter[str]())
    print(f"{'kind':10} {'tried':>8} " + " ".join(f"{name:>9}" for name in OUTCOMES))
    for kind, counts in (*found.items(), ("all", total)):
        print(f"{kind:10} {sum(counts.values()):8} " + " ".join(f"{counts[name]:9}" for name in OUTCOMES))
    raise SystemExit(1 if total["raw"] else 0)


if __name__ == "__main__":
    main()
