"""Decisions that must never change by accident: replays, made once and kept.

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

from dengine import Action, Recipe, replay

ACTIONS = tuple(Action)


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
    (folder / "machine.json").write_text(json.dumps(machine()), encoding="utf-8")


if __name__ == "__main__":
    make(Path(sys.argv[1]))
