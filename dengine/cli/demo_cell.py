"""`dengine demo-cell`: a cell, its server and its page, at a speed that one can watch."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import ExitStack, asynccontextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import click

from ..errors import OutputError
from .options import example, must_have_mujoco, seed_option
from .output import show
from .serving import must_have_serve

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from ..cells.base import Cell
    from ..serve.service import CellService

BEFORE = 150  # parts that come at once, so that a model answers before one has read the page
POLICY = {"alpha": 0.1, "lower_bound": 0.9, "audit_rate": 0.05}
ENDLESS = 10**9
PATIENT = 5.0  # seconds that a decision may wait: nobody but who watches waits for it


@dataclass(frozen=True)
class Demo:
    """What was asked for.  cycles : None for all that there are."""

    store: str
    port: int
    speed: float
    before: int
    cycles: int | None
    kind: str
    seed: int


@click.command("demo-cell", epilog=example("dengine demo-cell --speed 2"))
@click.option("--port", type=click.IntRange(0, 65535), default=8000, show_default=True, help="0 takes a free one.")
@click.option(
    "--speed", type=click.FloatRange(0.01, 1000.0), default=1.0, show_default=True, help="Parts a second, to look on."
)
@click.option(
    "--before",
    type=click.IntRange(0),
    default=BEFORE,
    show_default=True,
    help="Parts that come first, as fast as they can.",
)
@click.option("--cycles", type=click.IntRange(1), help="Parts in all; the page stays afterwards.  [default: all there are]")
@click.option(
    "--cell",
    "kind",
    type=click.Choice(["replay", "simulated"]),
    default="replay",
    show_default=True,
    help="replay: the bundled recordings, shuffled. simulated: physics in MuJoCo, without end.",
)
@click.option("--keep", metavar="FILE", help="A new file that remembers everything.  [default: forgotten at the end]")
@seed_option
def demo_cell(port: int, speed: float, before: int, cycles: int | None, kind: str, keep: str | None, seed: int) -> None:
    """Show a cell at work, live on a page.

    Parts are inserted and decided on, and the page shows what became of them.

    No robot is needed: recordings are played, or simulated. They go the way that a robot's traces go.
    Only this computer can see the page. Ctrl-C ends it.
    """
    must_have_serve()
    if kind == "simulated":
        must_have_mujoco()
    if keep is not None and Path(keep).exists():
        raise OutputError(f"Expected a new file to keep the demonstration in, {keep} is there; name another one.")
    with ExitStack() as stack:
        file = keep or str(Path(stack.enter_context(TemporaryDirectory(prefix="dengine-demo-"))) / "demo.db")
        _run(Demo(file, port, speed, before, cycles, kind, seed))
    show(f"Everything is in {keep}." if keep else "It ended, and nothing of it was kept.")


def _run(demo: Demo) -> None:
    from ..engine import DataEngine
    from ..recipe import Recipe
    from ..serve.server import Serving, serve

    recipe = Recipe.load("conv").with_policy(**POLICY)
    cell, cycles = _cell(demo)

    def make(executor: Executor) -> DataEngine:
        return DataEngine(recipe=recipe, store=demo.store, seed=demo.seed, executor=executor)

    serving = Serving(port=demo.port, deadline=PATIENT, beside=(partial(_driven, cell, cycles, demo),))
    serve(make, demo.store, serving, lambda line: click.echo(f"{line} Look at it in a browser; Ctrl-C ends it."))


def _cell(demo: Demo) -> tuple[Cell, int]:
    """The cell, and how many parts it inserts."""
    if demo.kind == "simulated":
        from ..cells.simulation.cell import SimulatedCell

        return SimulatedCell(seed=demo.seed), demo.cycles or ENDLESS
    import numpy as np

    from ..cells.replay import ReplayCell
    from ..datasets import load_dataset

    data = load_dataset("insertion")
    order = np.random.default_rng(demo.seed).permutation(len(data))
    return ReplayCell(data, order), min(demo.cycles or len(data), len(data))


@asynccontextmanager
async def _driven(cell: Cell, cycles: int, demo: Demo, service: CellService) -> AsyncIterator[None]:
    """The cell at work, as long as the server is there."""
    from ..serve.demo import Pace, drive

    driving = asyncio.ensure_future(drive(service, cell, Pace(demo.before, demo.speed), cycles))
    driving.add_done_callback(_say_how_it_ended)
    yield
    driving.cancel()
    await asyncio.wait([driving])


def _say_how_it_ended(driving: asyncio.Future[int]) -> None:
    if driving.cancelled():
        return
    if (error := driving.exception()) is not None:
        click.echo(f"The cell stopped: {error}", err=True)
        return
    click.echo(f"All parts are through: {driving.result()} were decided on. The page stays until Ctrl-C.")
