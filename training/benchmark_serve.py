"""`dengine serve` over loopback: how long a decision takes beside `engine.decide`, and what kills take back.

    python training/benchmark_serve.py --n 10000 --kills 50
    python training/benchmark_serve.py --n 0 --kills 50 --deadline 0.01

Run it on an idle machine. Every part that is not rejected is reported, so that retrains go on in the background all the
time. With --kills the client and the server are killed so often each, at random moments; each client writes what it was
answered to the disk before it goes on. With --deadline others fill the server's line, so that many answers are late. At the
end all of it is compared: with what is answered then, and with the store. Exit code 1 if an acknowledged label was lost, or
an id was answered twice differently. --folder is where the stores are: a decision under a caller's own id is on the disk
before it is answered, so its disk counts.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from serving.kills import Kept, kill
from serving.latency import over_the_network, syncs, within

from dengine import Recipe, load_dataset
from dengine.cli.output import progress

TARGET = 5.0  # milliseconds, of HTTP's p99


def row(name: str, seconds: np.ndarray) -> dict[str, Any]:
    """One line of the table, in milliseconds."""
    p50, p99, worst = 1e3 * np.quantile(seconds, [0.5, 0.99, 1.0])
    return {"what": name, "n": len(seconds), "p50": p50, "p99": p99, "worst": worst}


def latencies(args: argparse.Namespace, folder: Path) -> list[dict[str, Any]]:
    """Every row: the disk, the engine itself, the network."""
    data, recipe = load_dataset(args.data, args.samples), folder / "recipe.toml"
    chosen = Recipe.load(args.recipe).with_policy(alpha=0.1, lower_bound=0.9)
    recipe.write_text(chosen.to_toml(), encoding="utf-8")
    rows = [row("fdatasync of 4 kB", syncs(folder))]
    rows += [row(name, seconds) for name, seconds in within(data, args.n, recipe, folder, args.pace)]
    rows += [row(name, seconds) for name, seconds in over_the_network(data, args.n, recipe, folder, args.pace)]
    return rows


def table(rows: list[dict[str, Any]]) -> Table:
    """For people, with the ratio to the engine itself."""
    shown = Table(title=f"milliseconds; HTTP's p99 is to be at most {TARGET:g}")
    for name in ("what", "n", "p50", "p99", "worst", "p50 to engine.decide's", "p99 to engine.decide's"):
        shown.add_column(name, justify="left" if name == "what" else "right")
    by_name = {each["what"]: each for each in rows}
    for each in rows:
        base = by_name["engine.decide, request id" if "request id" in each["what"] else "engine.decide"]
        ratios = [f"{each[q] / base[q]:.1f}" if "report" not in each["what"] else "" for q in ("p50", "p99")]
        shown.add_row(each["what"], f"{each['n']:,}", *(f"{each[q]:.2f}" for q in ("p50", "p99", "worst")), *ratios)
    return shown


def tell(kept: Kept, console: Console) -> bool:
    """What the kills left; whether all of it was kept."""
    console.print(
        f"{kept.kills['client']} kills of the client, {kept.kills['server']} of the server: {kept.asked:,} ids, "
        f"{kept.answers:,} answers ({kept.late} ids late), {kept.acknowledged:,} acknowledged labels, {kept.versions} "
        f"versions. Answered twice differently: {len(set(kept.differently))}. Lost: {len(set(kept.lost))}."
    )
    return not kept.differently and not kept.lost


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n", type=int, default=10_000, help="decisions by each way of asking; 0: none")
    parser.add_argument("--kills", type=int, default=0, help="of the client, and as many of the server")
    parser.add_argument("--deadline", type=float, help="seconds, of the server under kills, whose line others fill then")
    parser.add_argument("--data", default="insertion", help="whose traces are sent")
    parser.add_argument("--samples", type=int, help="of each trace; all by default")
    parser.add_argument("--recipe", default="conv", help="of the served engine")
    parser.add_argument("--pace", type=float, default=0.002, help="seconds between two parts")
    parser.add_argument("--folder", type=Path, help="where the stores are; the system's own for such files by default")
    parser.add_argument("--seed", type=int, default=0, help="of the kills' moments")
    parser.add_argument("--out", type=Path, help="a JSON file of all of it")
    args = parser.parse_args()
    console, found, well = Console(width=124), dict[str, Any](), True
    with tempfile.TemporaryDirectory(dir=args.folder) as name:
        folder = Path(name)
        if args.n:
            found["rows"] = latencies(args, folder)
            console.print(table(found["rows"]))
        if args.kills:
            (folder / "kills").mkdir()
            with progress("kills", 2 * args.kills, not sys.stderr.isatty()) as advance:
                kept = kill(args.kills, folder / "kills", args.seed, advance, args.deadline)
            well = tell(kept, console)
            found["kills"] = asdict(kept)
    if args.out is not None:
        args.out.write_text(json.dumps(found, indent=2), encoding="utf-8")
    sys.exit(0 if well else 1)


if __name__ == "__main__":
    main()
