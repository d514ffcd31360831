"""`dengine demo-cell`: a cell, its server and its page, at a speed that one can watch."""

from __future__ import annotations

import asyncio
import socket
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import click

from ..errors import OutputError, SettingError
from .options import example, must_have_mujoco, seed_option
from .output import show

if TYPE_CHECKING:
    from ..cells.base import Cell
    from ..serve.service import CellService

NEEDED = ("starlette", "uvicorn", "jinja2", "sse_starlette")
BEFORE = 150  # parts that come at once, so that a model answers before one has read the page
POLICY = {"alpha": 0.1, "lower_bound": 0.9, "audit_rate": 0.05}
ENDLESS = 10**9


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
    """Show a cell at work: parts are inserted and decided on, and a page shows it live.

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


def must_have_serve() -> None:
    """SettingError where the server's packages are missing."""
    missing = [name for name in NEEDED if find_spec(name) is None]
    if missing:
        raise SettingError(f'Expected {", ".join(missing)} for the page, not installed: pip install "dengine[serve]".')


def _run(demo: Demo) -> None:
    from ..engine import DataEngine
    from ..recipe import Recipe
    from ..serve.service import CellService

    recipe = Recipe.load("conv").with_policy(**POLICY)
    cell, cycles = _cell(demo)
    with socket.create_server(("127.0.0.1", demo.port)) as listening:
        # Nobody waits here but those who watch: a retrain is no reason for a late answer.
        service = CellService(
            lambda: DataEngine(recipe=recipe, store=demo.store, seed=demo.seed), demo.store, deadline=10.0
        )
        try:
            with suppress(KeyboardInterrupt):
                asyncio.run(_serve(service, cell, cycles, demo, listening))
        finally:
            service.close()


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


async def _serve(service: CellService, cell: Cell, cycles: int, demo: Demo, listening: socket.socket) -> None:
    """The page, until Ctrl-C; beside it the cell, until its parts are used up or it fails, which is raised."""
    import uvicorn
    from starlette.applications import Starlette

    from ..serve.demo import Pace, drive
    from ..serve.page import routes

    config = uvicorn.Config(
        Starlette(routes=routes(service)), log_level="warning", lifespan="off", ws="none", timeout_graceful_shutdown=1
    )
    server = uvicorn.Server(config)
    serving = asyncio.ensure_future(server.serve(sockets=[listening]))
    show(f"The page: http://127.0.0.1:{listening.getsockname()[1]}/  (Ctrl-C ends it)")
    driving = asyncio.ensure_future(drive(service, cell, Pace(demo.before, demo.speed), cycles))
    done, _ = await asyncio.wait({serving, driving}, return_when=asyncio.FIRST_COMPLETED)
    try:
        if driving in done:
            show(f"All parts are through: {driving.result()} were decided on. The page stays.")
            await serving
    finally:
        server.should_exit = True
        driving.cancel()
        await asyncio.gather(serving, driving, return_exceptions=True)
