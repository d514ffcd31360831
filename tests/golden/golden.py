"""Decisions that must never change by accident: made once, kept, and played again by the test.

Most are of `rocket`, whose training is convex: its decisions are the same on every machine but for
a few. A network that is trained by gradient carries the last digit of a float from step to step, so
`conv` has no golden decisions.

    OMP_NUM_THREADS=1 python tests/golden/golden.py tests/golden/default    # makes them anew; only where that is meant

Novelty is on, as nobody who names no recipe turns it off. Everything here goes through names that
`dengine` itself exports, so that the same lines run before and after. Only decisions are kept, no
store and no exported file: their forms may change, what they answer may not.
"""

import json
import platform
import re
import sys
import tempfile
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dengine import (
    Action,
    Cycle,
    DataEngine,
    Dataset,
    Decision,
    Policy,
    Recipe,
    ReplayCell,
    RetrainReport,
    export_torchscript,
    load_dataset,
    load_exported,
    replay,
)

CYCLES = 250
ASKED = 100  # parts that an exported file is asked about and told of
LATE = 5  # parts that come before a label does, where labels are late
LOCAL = {"alpha": 0.1, "lower_bound": 0.9}
LOOSE = {"alpha": 0.2, "lower_bound": 0.8}
AUDITED = LOOSE | {"audit_rate": 0.15}
POOLED = AUDITED | {"guarantee": "pooled"}
ALL = {"stops": "all"}  # every bad part that is accepted stops the system
Arrays = dict[str, np.ndarray]
CycleList = list[Cycle]
Settings = Mapping[str, Any]
Verb = Callable[
    [DataEngine, CycleList, Path], DataEngine
]  # what people do to an engine between two parts


def plain(seed: int) -> Dataset:
    """Parts of the bundled set, shuffled, each trace cut to 200 samples around the contact."""
    data = load_dataset("insertion")
    order = np.random.default_rng(seed).permutation(len(data))[: CYCLES + ASKED]
    return Dataset(np.ascontiguousarray(data.X[order, 400:800:2]), data.y[order])


def numbered(seed: int) -> Dataset:
    """The same with part numbers: some parts come again, some traces are novel, one is not finite,
    one is constant.
    """
    rng, data = np.random.default_rng(seed), plain(seed)
    origin = np.arange(len(data))
    for i in np.flatnonzero(rng.random(len(data)) < 0.2)[1:]:
        origin[i] = origin[rng.integers(i)]
    X = data.X[origin] * (1.0 + 0.01 * rng.standard_normal((len(data), 1)))
    X[rng.random(len(data)) < 0.04] *= 3.0
    X[140, 3], X[160] = np.nan, 2.5
    return Dataset(X.astype(np.float32), data.y[origin], part=np.array([f"P{i}" for i in origin]))


def turned(seed: int, begin: int = 150) -> Dataset:
    """The same in a world that becomes another one: most labels are the other way round from a part
    on.
    """
    data = numbered(seed)
    other = (np.arange(len(data)) >= begin) & (np.random.default_rng(seed).random(len(data)) < 0.9)
    return replace(data, y=data.y ^ other)


def restart(engine: DataEngine, cycles: CycleList, store: Path) -> DataEngine:
    engine.close()
    return DataEngine.open(str(store), replaying=True)


def correct(engine: DataEngine, cycles: CycleList, store: Path) -> DataEngine:
    """Five labels were wrong."""
    for cycle in [item for item in cycles if item.success][-5:]:
        engine.correct(cycle.decision.id, success=False)
    return engine


def forget(engine: DataEngine, cycles: CycleList, store: Path) -> DataEngine:
    """Ten labels are worth nothing."""
    engine.forget(*[cycle.decision.id for cycle in cycles if cycle.success is not None][-10:])
    return engine


def roll_back(engine: DataEngine, cycles: CycleList, store: Path) -> DataEngine:
    engine.rollback(1)
    return engine


def loosen(engine: DataEngine, cycles: CycleList, store: Path) -> DataEngine:
    engine.set_policy(Policy(alpha=0.2, lower_bound=0.8, stops="all"))
    return engine


def shadow(on: bool) -> Verb:
    """The one place that knows how the shadow mode is asked for."""

    def ask(engine: DataEngine, cycles: CycleList, store: Path) -> DataEngine:
        engine.set_shadow(on)
        return engine

    return ask


@dataclass(frozen=True)
class Story:
    """One engine over `CYCLES` parts.  verbs : by the number of parts before."""

    seed: int
    policy: Settings
    parts: Callable[[int], Dataset] = numbered
    verbs: Mapping[int, Verb] = field(default_factory=dict)

    def start(self, store: Path) -> DataEngine:
        recipe = Recipe.load("rocket").with_policy(**self.policy)
        return DataEngine(recipe=recipe, store=str(store), seed=self.seed, replaying=True)

    def live(self, store: Path) -> tuple[DataEngine, CycleList]:
        """The engine after its last part, still open, and what happened."""
        engine, cell, cycles = self.start(store), ReplayCell(self.parts(self.seed)), CycleList()
        for done in sorted({*self.verbs, CYCLES}):
            cycles += engine.run(cell, done - len(cycles))
            if done in self.verbs:
                engine = self.verbs[done](engine, cycles, store)
        return engine, cycles

    def play(self, folder: Path) -> Arrays:
        engine, cycles = self.live(folder / "engine.db")
        engine.close()
        return of_decisions([cycle.decision for cycle in cycles]) | of_retrains(
            cycle.retrain for cycle in cycles
        )


class Late(Story):
    """A program that asks and reports by itself: labels come late, and people retrain before the
    last parts.
    """

    def play(self, folder: Path) -> Arrays:
        data, decisions, retrains = (
            self.parts(self.seed),
            list[Decision](),
            list[RetrainReport | None](),
        )
        with self.start(folder / "engine.db") as engine:
            for i in range(CYCLES):
                decisions.append(engine.decide(data.X[i], part=str(data.part[i])))
                due = decisions[max(0, i - LATE)]
                if i >= LATE and (
                    due.action is Action.VERIFY
                    or (due.action is Action.ACCEPT and not data.y[i - LATE])
                ):
                    engine.report(due.id, bool(data.y[i - LATE]))
                if i == CYCLES - 40:
                    engine.retrain()
                retrains.append(engine.poll())
        return of_decisions(decisions) | of_retrains(retrains)


@dataclass(frozen=True)
class Replayed:
    """One `replay` of the bundled set, with whole traces.  changes : of the recipe's fields.
    options : of `replay`.
    """

    name: str
    seed: int
    policy: Settings
    cycles: int = CYCLES
    changes: Settings = field(default_factory=dict)
    options: Settings = field(default_factory=dict)

    def play(self, folder: Path) -> Arrays:
        recipe = replace(Recipe.load(self.name), **self.changes).with_policy(**self.policy)
        run = replay("insertion", recipe, self.seed, self.cycles, **self.options)
        names = ("action", "lower", "upper", "n_success", "n_failure", "position", "index")
        return {name: np.asarray(getattr(run, name)) for name in names} | of_retrains(run.retrains)


class Exported(Story):
    """An exported file, which goes on where the engine ended: parts, labels, stops."""

    def export(self, folder: Path) -> Path:
        engine, _ = self.live(folder / "engine.db")
        with engine:
            return export_torchscript(engine, folder / "model.ts")

    def told(self) -> tuple[Dataset, list[str]]:
        """The parts after the engine's, and what is heard of each: 1, 0, or nothing, which is most
        of the good ones.
        """
        data = self.parts(self.seed)
        rest = Dataset(data.X[CYCLES:], data.y[CYCLES:], part=data.part[CYCLES:])
        heard = np.random.default_rng(self.seed).random(len(rest)) < np.where(rest.y == 1, 0.4, 1.0)
        return rest, [str(y) if item else "" for y, item in zip(rest.y, heard, strict=True)]

    def play(self, folder: Path) -> Arrays:
        return self.ask(self.export(folder))

    def ask(self, file: Path) -> Arrays:
        model, decisions, (data, labels) = load_exported(file), [], self.told()
        for x, part, label in zip(data.X, map(str, data.part), labels, strict=True):
            decisions.append(model.decide(x, part))
            if decisions[-1].action is Action.ACCEPT and label == "0":
                model.stop(x, part)
            elif decisions[-1].action is not Action.REJECT and label:
                model.learn(x, label == "1", part)
        return of_answers(decisions)


NOT_NOVEL = {"novelty": 0.0}  # as it was before 0.3
STORIES: dict[str, Story | Replayed] = {
    "replay": Replayed("rocket", 0, LOCAL),
    "pca-80": Replayed("pca", 6, LOOSE, 600, NOT_NOVEL),
    "pca-jeffreys": Replayed("pca", 7, LOOSE | {"interval": "jeffreys"}, 600, NOT_NOVEL),
    "pca-binomial": Replayed("pca", 8, {"interval": "binomial"}, 400, NOT_NOVEL, {"confirm": True}),
    "umap-learn-80": Replayed("umap-learn", 9, LOOSE, 180, NOT_NOVEL | {"retrain_every": 60}),
    "local": Story(1, LOCAL, plain),
    "local-all": Story(5, AUDITED | ALL, turned, {180: restart}),  # in safe mode, from part 167
    "pooled-some": Story(3, POOLED | {"audit_rate": 0.5}),  # its only evidence
    "pooled-all": Story(4, POOLED | ALL),
    "parts": Story(5, AUDITED),
    "restarted": Story(5, AUDITED, verbs={80: restart, 180: restart}),
    "corrected": Story(5, AUDITED, verbs={115: correct}),
    "corrected-pooled": Story(4, POOLED | ALL, verbs={150: correct, 155: restart}),
    "put-right": Story(6, LOCAL, verbs={110: forget, 170: roll_back, 220: loosen}),
    "shadow": Story(7, AUDITED, verbs={60: shadow(True), 130: restart, 170: shadow(False)}),
    "late": Late(8, AUDITED),
    "exported": Exported(9, AUDITED),
    "exported-pooled": Exported(4, POOLED | ALL, partial(turned, begin=CYCLES + 20)),
}


def of_answers(decisions: list[Any]) -> Arrays:
    """What an engine and an exported file both say; enumerations by name, no embedding as NaN."""
    shape = next(
        np.shape(decision.embedding) for decision in decisions if decision.embedding is not None
    )
    points = [
        np.full(shape, np.nan) if decision.embedding is None else decision.embedding
        for decision in decisions
    ]
    return {
        "action": np.array([str(decision.action) for decision in decisions]),
        "reason": np.array([str(decision.reason) for decision in decisions]),
        "lower": np.array([decision.lower for decision in decisions]),
        "upper": np.array([decision.upper for decision in decisions]),
        "n_success": np.array([decision.n_success for decision in decisions]),
        "n_failure": np.array([decision.n_failure for decision in decisions]),
        "embedding": np.array(points, dtype=np.float64),
    }


def of_decisions(decisions: list[Decision]) -> Arrays:
    return of_answers(decisions) | {
        "version": np.array([decision.model_version for decision in decisions]),
        "audit": np.array([decision.audit for decision in decisions]),
        "predicted": np.array([str(decision.predicted) for decision in decisions]),
    }


def of_retrains(retrains: Iterable[RetrainReport | None]) -> Arrays:
    """One row a retrain."""
    rows = [
        (retrain.version, retrain.n_traces, retrain.n_steps, retrain.accepted)
        for retrain in retrains
        if retrain is not None
    ]
    return {"retrains": np.array(rows, dtype=np.int64)}


def machine() -> dict[str, str]:
    """What may change the last digit of a float: libraries choose their code by the model."""
    about = Path("/proc/cpuinfo")
    existing = (
        dict(re.findall(r"^(.+?)\s*: (.*)$", about.read_text(encoding="utf-8"), re.M))
        if about.exists()
        else {}
    )
    return {
        "processor": " ".join(
            [
                platform.machine(),
                *(existing.get(key, "") for key in ("vendor_id", "cpu family", "model")),
            ]
        ),
        "capability": torch.backends.cpu.get_cpu_capability(),
        "torch": torch.__version__.split("+")[0],
        "numpy": np.__version__,
    }


def make(folder: Path) -> None:
    for name, story in STORIES.items():
        with tempfile.TemporaryDirectory() as place:
            np.savez_compressed(folder / f"{name}.npz", **story.play(Path(place)))
    (folder / "machine.json").write_text(json.dumps(machine(), indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    make(Path(sys.argv[1]))
