"""Malformed inputs by the kind: an attempt each, on small engines, stores and files of its own."""

from __future__ import annotations

import io
import random
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from click.testing import CliRunner

from dengine import Action, DataEngine, DengineError, Recipe, TraceSpec, load_dataset, open_store
from dengine.cli import main as command_line
from dengine.datasets.importing import import_labelled
from dengine.export import import_journal
from dengine.testing import toy_traces

from .oddities import ODD, SAMPLES, TOML, WORDS, odd_trace, spoilt


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
        return [
            line.split()
            for line in (
                "status store.db --json",
                "export store.db --out model.ts --format torchscript",
                "import-labels cell.csv --store store.db --any-model",
                "data small.npz --samples 20 --fit cut --rate 500 --part part",
                "replay --data small.npz --reducer pca --alpha 0.1 --lower-bound 0.9 --repeats 1 --cycles 4 --seed 0",
                "compare --data small.npz --reducers pca --alphas 0.1 --intervals wilson --repeats 1 --cycles 4",
                "train --data small.npz --store trained.db --reducer pca --seed 0 --retrains 1 --audit-rate 0.1",
                "run --cell replay --data small.npz --store run.db --reducer pca --cycles 2 --guarantee local --stops all",
            )
        ]

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
        if (
            not isinstance(value, bool | int | float | np.generic | np.ndarray)
            or stored is not bool(value)
            or value not in (0, 1)
        ):
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
            raise RuntimeError(
                f"exit code {done.exit_code} and {len(errors)} lines of errors: {words} {done.output[-300:]!r}"
            )
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
