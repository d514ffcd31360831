"""A robot's force over RTDE, sample for sample: what was sent, what was recorded, and what was said to be missing.

    python training/benchmark_recording.py --insertions 300 --out out/
    python training/benchmark_recording.py --insertions 20 --speed 20

A controller without a robot (`FakeController`) plays bundled insertions at 500 Hz over TCP on this machine, in real time:
300 of them take ten minutes and a half. Packages are dropped, held back and sent in one burst, sent twice; connections are
closed, in the middle of a package too, or broken by what is no RTDE, each at a random sample. Then a `DataEngine` drives
the same cell, undisturbed, and its decisions are compared with those of a replay.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import pandas as pd
from common import POLICY, options, tell, wall_time

from dengine import Cell, DataEngine, Dataset, Recipe, ReplayCell, load_dataset
from dengine.cells import FakeController, UrCell
from dengine.cells.ur import RobotProgram, Trouble
from dengine.cli.output import duration
from dengine.experiments.tables import write_csv

SHARE = 0.5  # of the insertions that something goes wrong in
LONGEST = {"drop": 60, "hold": 150}  # cycles
KINDS = ("drop", "hold", "close", "half", "garbage", "repeat")


def troubles(insertions: int, samples: int, rng: np.random.Generator) -> list[Trouble]:
    """One in about half of the insertions, at any sample."""
    found = []
    for part in np.flatnonzero(rng.random(insertions) < SHARE).tolist():
        kind = str(rng.choice(KINDS))
        cycles = int(rng.integers(1, LONGEST[kind] + 1)) if kind in LONGEST else 1
        found.append(Trouble(part, int(rng.integers(samples)), kind, cycles))
    return found


def record(data: Dataset, insertions: int, speed: float | None, wrong: Sequence[Trouble]) -> pd.DataFrame:
    """A row an insertion: samples sent and not sent, recorded and said to be missing."""
    samples, kinds, rows = data.X.shape[-1], {each.part: each.kind for each in wrong}, []
    with (
        FakeController(RobotProgram(data), speed=speed, troubles=wrong) as fake,
        UrCell(fake.host, port=fake.port, samples=samples) as cell,
    ):
        for part in range(insertions):
            trace, said = cell.insert(), cell.last
            lost = np.zeros(samples, dtype=bool)
            lost[[sample for lost_part, sample in fake.lost if lost_part == part]] = True
            unseen = bool(lost[0])  # the first sample: then no place is known
            known, expected = ~np.isnan(trace), ~lost & (not unseen)
            rows.append(
                {
                    "part": part,
                    "trouble": kinds.get(part, ""),
                    "not_sent": int(lost.sum()),
                    "start_unseen": unseen,
                    "recorded": int(known.sum()),
                    "differing": int((trace[known] != data.X[part][known]).sum()),
                    "unreported": int((known & ~expected).sum()),
                    "invented": int((~known & expected).sum()),
                    **{name: getattr(said, name) for name in ("missing", "repeated", "reconnects")},
                }
            )
            cell.reject()
        print(f"Packages: {cell.recorder.report()}")
    return pd.DataFrame(rows)


def decisions(cell: Cell, recipe: Recipe, cycles: int) -> list[dict]:
    """What an engine decides and is told, cycle by cycle."""
    with DataEngine.from_recipe(recipe) as engine:
        return [
            {**asdict(c.decision), "id": 0, "outcome": c.outcome, "success": c.success} for c in engine.run(cell, cycles)
        ]


def compare(data: Dataset, recipe: Recipe, cycles: int) -> str:
    """A run by orders to a robot's program beside a replay of the same traces."""
    with (
        FakeController(RobotProgram(data), speed=None) as fake,
        UrCell(fake.host, port=fake.port, samples=data.X.shape[-1]) as cell,
    ):
        live = decisions(cell, recipe, cycles)
    replayed = decisions(ReplayCell(data), recipe, cycles)
    differing = sum(a != b for a, b in zip(live, replayed, strict=True))
    actions = Counter(str(each["action"]) for each in live)
    told = ", ".join(f"{n} {action}" for action, n in sorted(actions.items()))
    return f"{recipe.name}: {differing} of {cycles} decisions differ from the replay's ({told})."


def counted(found: pd.DataFrame) -> list[dict[str, Any]]:
    """A row a kind of trouble."""
    columns = ["not_sent", "recorded", "differing", "unreported", "invented", "repeated", "reconnects"]
    groups = [*((kind or "none", group) for kind, group in found.groupby("trouble")), ("all", found)]
    return [{"trouble": kind, "insertions": len(group), **group[columns].sum().to_dict()} for kind, group in groups]


def main() -> None:
    """Parse, run, print."""
    parser = options(__doc__, samples=None, out=None)
    parser.add_argument("--insertions", type=int, default=300, help="that the robot makes")
    parser.add_argument("--speed", type=float, default=1.0, help="against real time; 0: as fast as it is read")
    parser.add_argument("--recipes", default="pca", help="with commas between; each is compared with a replay")
    parser.add_argument("--seed", type=int, default=0, help="of the faults")
    asked = parser.parse_args()
    data = load_dataset("insertion", asked.samples)
    wrong = troubles(asked.insertions, data.X.shape[-1], np.random.default_rng(asked.seed))
    took, found = wall_time(record, data, asked.insertions, asked.speed or None, wrong)
    tell(counted(found), f"{len(found)} insertions, recorded in {duration(took)}")
    print(f"{int(found.start_unseen.sum())} starts fell into a gap: no sample's place in those traces is known.")
    for name in asked.recipes.split(","):
        print(compare(data, Recipe.load(name).with_policy(**POLICY), asked.insertions))
    if asked.out is not None:
        print(f"Wrote {write_csv(found, asked.out / 'recording.csv', force=True)}")


if __name__ == "__main__":
    main()
