"""Decisions that must never change by accident: replays, stores and an exported file, made once and kept.

    python tests/golden/golden.py tests/golden        # makes them anew; only where a change of decisions is meant

Made with dengine 0.1.0 before its modules became folders, so that the move could be held to "bit for bit". Everything
here goes through public names, so the same lines ran before and run after. Novelty, which came with 0.3, is turned off.
"""

from __future__ import annotations

import json
import platform
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dengine import Action, DataEngine, Dataset, Recipe, ReplayCell, export_torchscript, load_dataset, load_exported, replay

ACTIONS = tuple(Action)
LEARNED, ASKED = 130, 60  # traces that a kept engine learned from, and that it is asked about afterwards


@dataclass(frozen=True)
class Case:
    """One replay of the bundled set."""

    name: str
    seed: int
    cycles: int
    recipe: dict[str, Any] = field(default_factory=dict)
    policy: dict[str, Any] = field(default_factory=lambda: {"alpha": 0.1, "lower_bound": 0.9})
    options: dict[str, Any] = field(default_factory=dict)

    def play(self) -> dict[str, np.ndarray]:
        recipe = replace(Recipe.load(self.name), novelty=0.0, **self.recipe).with_policy(**self.policy)
        run = replay("insertion", recipe, self.seed, self.cycles, **self.options)
        return {
            "action": np.array([ACTIONS.index(Action(a)) for a in run.action], dtype=np.int8),
            "counts": np.stack([run.n_success, run.n_failure]).astype(np.int32),
            "bounds": np.stack([run.lower, run.upper]),
            "position": run.position,
            "retrains": np.array([(r.version, r.n_traces, r.n_steps, r.accepted) for r in run.retrains], dtype=np.int32),
        }


LOOSE = {"alpha": 0.2, "lower_bound": 0.8}
REPLAYS = {
    "rocket-90": Case("rocket", 4, 300),
    "rocket-in-order": Case("rocket", 5, 300, {"retrain_every": 70}, LOOSE, {"shuffle": False}),
    "pca-80": Case("pca", 6, 600, policy=LOOSE),
    "pca-jeffreys": Case("pca", 7, 600, policy=LOOSE | {"interval": "jeffreys"}),
    "pca-binomial": Case("pca", 8, 400, policy={"interval": "binomial"}, options={"confirm": True}),
    "umap-80": Case("umap", 9, 180, {"retrain_every": 60}, LOOSE),
}


def short() -> Dataset:
    """The bundled set, each trace cut to 200 samples around the contact: small files."""
    data = load_dataset("insertion")
    return replace(data, X=np.ascontiguousarray(data.X[:, 400:800:2]))


def fill() -> DataEngine:
    """An engine that learned, retrained, and took labels after its last retrain."""
    recipe = replace(Recipe.load("conv"), retrain_every=50, window=200, novelty=0.0)
    engine = DataEngine(recipe=recipe.with_policy(**LOOSE, audit_rate=0.1), seed=11, replaying=True)
    list(engine.run(ReplayCell(short(), np.arange(LEARNED)), LEARNED))
    return engine


def ask(decide: Any) -> list[list[Any]]:
    """What is decided on the traces that follow; floats survive JSON unchanged."""
    found = []
    for x in short().X[LEARNED : LEARNED + ASKED]:
        d = decide(x)
        z = None if d.embedding is None else np.asarray(d.embedding, dtype=np.float64).tolist()
        found.append([str(d.action), str(d.reason), d.lower, d.upper, d.n_success, d.n_failure, z])
    return found


def machine() -> dict[str, str]:
    """What may change the last digit of a float: compared before decisions are."""
    return {
        "processor": platform.machine(),
        "capability": torch.backends.cpu.get_cpu_capability(),
        "torch": torch.__version__.split("+")[0],
        "numpy": np.__version__,
    }


def make(folder: Path) -> None:
    for name, case in REPLAYS.items():
        np.savez_compressed(folder / f"replay-{name}.npz", **case.play())
    with fill() as engine:
        export_torchscript(engine, folder / "model.ts")
    answers = {"model.ts": ask(load_exported(folder / "model.ts").decide)}
    (folder / "answers.json").write_text(json.dumps({"machine": machine(), "answers": answers}), encoding="utf-8")


if __name__ == "__main__":
    make(Path(sys.argv[1]))
