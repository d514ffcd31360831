"""What is shown and written of finished replays: the pooled table, the promise, the paper's form, pictures, costs."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .options import OutFolder
from .output import duration, refusals_last, show, write_json
from .playing import Finished, Stream

if TYPE_CHECKING:
    import pandas as pd

    from ..datasets import Dataset
    from ..experiments.replay import Replay

MANY_CORES = 1000


def report(verb: str, finished: Finished, dataset: Dataset, stream: Stream, out: OutFolder | None, as_json: bool) -> None:
    """Print the tables, or one JSON document; write CSV, tables and pictures to `out`."""
    from ..experiments.paper import finding_lines
    from ..experiments.tables import (
        CONDITION,
        encoder_line,
        frame_of,
        pool,
        pooled_table,
        promise_kept,
        promise_lines,
        retrain_line,
    )

    replays = finished.replays
    by_name = _grouped(replays, lambda each: each.name)
    frame = frame_of(replays)
    rows = [row | {"promise_kept": promise_kept(row)} for row in pool(frame, replays)]
    title = _title(dataset.name, by_name, not stream.shuffle)
    with refusals_last() as attempt:
        files = [] if out is None else attempt(lambda: _save(frame, replays, title, out))
        retrains = {name: [r for each in some for r in each.retrains] for name, some in by_name.items()}
        found = _findings(frame)
        if as_json:
            dropped = [sum(not r.accepted for r in each.retrains) for each in replays]
            sums = frame.assign(dropped=dropped).groupby(CONDITION, sort=False)["dropped"].sum()
            rows = [row | {"retrains_dropped": int(n)} for row, n in zip(rows, sums, strict=True)]
            about = {
                "verb": verb,
                "data": dataset.name,
                "in_order": not stream.shuffle,
                "interrupted": finished.interrupted,
            }
            about |= {"faults": dataset.faults}
            costs = _costs(finished) | {"found": finished.found}
            write_json(about | {"rows": rows, "findings": found, "costs": costs, "files": files})
            return
        show(pooled_table(rows, title))
        show(*promise_lines(rows))
        show(*(f"{name}: {retrain_line(reports)}{encoder_line(by_name[name])}" for name, reports in retrains.items()))
        show(*finding_lines(found))
        show(_cost_line(finished))
        show(*(f"Wrote {path}" for path in files))


def _grouped(replays: Sequence[Replay], key: Any) -> dict[Any, list[Replay]]:
    groups: dict[Any, list[Replay]] = {}
    for each in replays:
        groups.setdefault(key(each), []).append(each)
    return groups


def _title(data: str, by_name: Mapping[str, list[Replay]], in_order: bool) -> str:
    each = sorted({len({replay.seed for replay in replays}) for replays in by_name.values()})
    cycles = len(next(iter(by_name.values()))[0])
    order = "in recorded order" if in_order else "shuffled"
    how = f"{order}, {' or '.join(map(str, each))} replay{'s' if each[-1] > 1 else ''} of {cycles} cycles"
    source = "simulated insertions" if data == "insertion" else data
    return f"{', '.join(by_name)} on {source}, {how}"


def _is_grid(frame: pd.DataFrame) -> bool:
    return any(_varies(frame, name) for name in ("interval", "alpha", "lower_bound"))


def _varies(frame: pd.DataFrame, name: str) -> bool:
    return len(frame[name].unique()) > 1


def _findings(frame: pd.DataFrame) -> list[Any]:
    """The paper's findings, where a grid was played under one guarantee and one feedback."""
    from ..experiments.paper import findings

    alike = not any(_varies(frame, name) for name in ("guarantee", "stops", "confirm"))
    return findings(frame) if alike and _is_grid(frame) else []


def _save(frame: pd.DataFrame, replays: Sequence[Replay], title: str, out: OutFolder) -> list[Path]:
    from ..experiments.figures import curves, embedding_map, save
    from ..experiments.tables import write_csv

    files = [write_csv(frame, out.path / "replays.csv", out.force)]
    if _is_grid(frame):
        files += _save_grid(frame, replays, out)
    else:
        by_row = _grouped(replays, lambda each: _row_name(each, frame))
        files.append(save(curves(by_row, title), out.path / "curves.png", force=out.force))
    for name, some in _grouped(replays, lambda each: each.name).items():
        if some[0].embedded:
            picture = embedding_map(some[0], title=f"{name}, newest parts of one replay (seed {some[0].seed})")
            files.append(save(picture, out.path / f"map_{_slug(name)}.png", force=out.force))
    return files


def _save_grid(frame: pd.DataFrame, replays: Sequence[Replay], out: OutFolder) -> list[Path]:
    from ..experiments.figures import save
    from ..experiments.grid_figure import grid_figure
    from ..experiments.paper import grid_lines
    from ..outputs import TABLES, write_output

    page = "\n".join(grid_lines(frame)) + "\n"
    files = [write_output(out.path / "tables.md", page.encode("utf-8"), TABLES, out.force, make_folder=True)]
    for name, some in _grouped(replays, lambda each: _row_name(each, frame, "interval")).items():
        files.append(save(grid_figure(some, name), out.path / f"grid_{_slug(name)}.png", force=out.force))
    return files


def _row_name(replay: Replay, frame: pd.DataFrame, *more: str) -> str:
    """The contender, and in which of the columns that vary it differs from its other rows."""
    policy = replay.recipe.policy
    known = "good ones confirmed" if replay.confirm else "stops alone"
    said = {"guarantee": policy.guarantee, "stops": policy.stops, "confirm": known, "interval": policy.interval}
    return ", ".join([replay.name, *(word for name, word in said.items() if name in more or _varies(frame, name))])


def _slug(name: str) -> str:
    return re.sub(r"[^\w.=-]+", "_", name)


def _costs(finished: Finished) -> dict[str, float]:
    from ..experiments.costs import makespan

    seconds = [each.seconds for each in finished.replays]
    alone = {f"on_{MANY_CORES}_cores_s": makespan(seconds, MANY_CORES)}
    return {"seconds": finished.seconds, "core_seconds": sum(seconds)} | alone


def _cost_line(finished: Finished) -> str:
    costs = _costs(finished)
    many = "" if len(finished.replays) == 1 else "s"
    kept = f"; {finished.found} were there from an earlier run" if finished.found else ""
    return (
        f"{len(finished.replays)} replay{many}, {duration(costs['core_seconds'])} of one core's time, in "
        f"{duration(costs['seconds'])}{kept}. {MANY_CORES:,} cores would take "
        f"{duration(costs[f'on_{MANY_CORES}_cores_s'])}, their start left out."
    )
