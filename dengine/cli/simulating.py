"""`dengine simulate`: traces of the simulated cell, into a file."""

from __future__ import annotations

from pathlib import Path

import click

from .options import example, force_option, json_option, must_have_mujoco, n_jobs_option, scenario_option, seed_option
from .output import progress, show, write_json


@click.command(epilog=example("dengine simulate --n 50 --out traces.npz --seed 0"))
@click.option("--n", type=click.IntRange(1), default=1503, show_default=True, help="Insertions to simulate, of 2 s each.")
@click.option(
    "--out",
    type=click.Path(dir_okay=False, path_type=Path),
    required=True,
    help="The .npz file to write: X (n, 1000) forces at 500 Hz, newtons when multiplied by scale; y (n,) labels.",
)
@scenario_option
@seed_option
@n_jobs_option(-1, "Processes; -1: one a core.")
@force_option
@json_option
def simulate(n: int, out: Path, scenario: str, seed: int, n_jobs: int, force: bool, as_json: bool) -> None:
    """Simulate insertions and write their forces and labels."""
    from ..outputs import TRACES, check_output

    must_have_mujoco()
    check_output(out, TRACES, force)  # before minutes of physics
    from ..cells.simulation.generate import save_traces
    from ..cells.simulation.generate import simulate as simulate_traces

    with progress(f"simulating {scenario}", n, as_json) as advance:
        traces = simulate_traces(n, seed, scenario, n_jobs, progress=lambda done, of: advance(1))
    path = save_traces(out, traces, force)
    good = int(traces.y.sum())
    if as_json:
        write_json({"verb": "simulate", "simulated": True, "scenario": scenario, "n": n, "successes": good, "file": path})
        return
    show(f"Simulated {n} insertions ({scenario}): {good} successes, {n - good} failures.", f"Wrote {path}")
