"""`dengine data` and `dengine simulate`: what a data set is before anything is learned from it; a simulated one."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ..errors import percent
from . import options
from .options import DataChoice, OutFolder, left_out
from .output import duration, facts, progress, show, write_json

if TYPE_CHECKING:
    from ..experiments.survey import Drift, Survey

MOST = 10  # faults that are named
CLEAR = 0.01  # p-values below it are called drift
FITTED = {
    "cut": "longer ones lose their end",
    "pad": "longer ones lose their end, shorter ones repeat their last sample",
    "resample": "the whole of each on so many points",
}


@click.command(epilog=options.example("dengine data insertion --out out/"))
@options.data_options(argument=True)
@options.out_option
@options.json_option
def data(source: DataChoice, out: OutFolder | None, as_json: bool) -> None:
    """Say what a data set is, and what is wrong with it.

    A folder of CSV files, one an insertion, its label in its name; a wide .csv or .parquet, a row an insertion; .npz or .h5
    with X (traces, samples) and y (1 success, 0 failure); one long .mcap, cut by --trigger; the file of a store, for what
    is labelled in it; or the bundled set, insertion.
    """
    from ..experiments.figures import data_picture
    from ..experiments.survey import survey

    dataset = source.load(quiet=True)
    found = survey(dataset)
    with options.written(out, lambda out: out.picture(data_picture(dataset, found.name), "data.png")) as files:
        if as_json:
            write_json({"verb": "data", "data": source.data, "survey": found, "files": files})
            return
        table = facts(found.name, [*_form(found), *_state(found), *_order(found)])
        show(table, *left_out(dataset, MOST), *(f"Wrote {path}" for path in files))


def _form(found: Survey) -> Iterator[tuple[str, str]]:
    yield "traces", f"{found.traces}, {len(found.faults)} left out" if found.faults else str(found.traces)
    named = f" ({', '.join(found.names)})" if found.names else ""
    several = f"{found.channels} channel{'s' if found.channels > 1 else ''}{named}"
    yield "form", f"{several} of {found.samples} samples, {duration(found.seconds)}, in {found.unit}"
    if found.lengths is not None:
        low, median, high = (f"{x:g}" for x in (found.lengths.low, found.lengths.median, found.lengths.high))
        yield "lengths", f"all {low}" if low == high else f"{low} to {high} samples, median {median}"
    if found.fit != "strict":
        yield "fit", f"{found.fit}, to {found.samples} samples: {FITTED[found.fit]}"
    yield "rate", _rate(found)


def _rate(found: Survey) -> str:
    if found.rates is None:
        return f"{found.rate_hz:g} Hz, as stated: there are no timestamps that say so"
    low, high = f"{found.rates.low:g}", f"{found.rates.high:g}"
    each = f"{low} Hz each" if low == high else f"{low} to {high} Hz, median {found.rates.median:g}"
    stated = (
        "" if math.isclose(found.rate_hz, found.rates.median, rel_tol=1e-3) else f"; of the traces {found.rate_hz:g} Hz"
    )
    return f"{each}, by the timestamps{stated}"


def _state(found: Survey) -> Iterator[tuple[str, str]]:
    from ..model.neighbours import SUSPICIOUS

    yield "labels", f"{found.good} good, {found.bad} bad: {percent(found.good / found.traces)} good"
    if found.parts is not None:
        yield "parts", f"{found.parts}, {found.traces - found.parts} traces are of a part that came before"
    bad = [f"{n} {what}" for n, what in ((found.not_finite, "not finite"), (found.constant, "constant")) if n]
    yield "bad traces", f"{', '.join(bad)}: verified, never learned from" if bad else "none"
    again = f", {found.contradicting} of them with another label" if found.contradicting else ""
    yield "duplicates", f"{found.duplicates} equal an earlier trace{again}" if found.duplicates else "none"
    many = found.near_repeats > SUSPICIOUS * found.looked_at
    advice = ": if parts come twice, give their numbers (--part)" if many else ", no more than different parts do"
    near = f"{found.near_repeats} of the newest {found.looked_at} nearly repeat another part's{advice}"
    yield "near repeats", near if found.near_repeats else "none"


def _order(found: Survey) -> Iterator[tuple[str, str]]:
    for each in found.drift:
        shares = " ".join(f"{100 * x:.0f}" for x in each.tenths) + " %"
        means = " ".join("-" if math.isnan(x) else f"{x:.3g}" for x in each.tenths)
        yield f"{each.name} by tenths", f"{shares if each.name == 'good' else means}\n{_trend(each)}"


def _trend(each: Drift) -> str:
    if math.isnan(each.rho):
        return "never changes"
    said = "no drift is seen" if each.p >= CLEAR else "rises with the order" if each.rho > 0 else "falls with the order"
    return f"{said} (Spearman's rho {each.rho:+.2f}, p {each.p:.2g})"


OUT = "The .npz file to write: X (n, 1000) forces at 500 Hz, newtons when multiplied by scale; y (n,) labels."


@click.command(epilog=options.example("dengine simulate --n 50 --out traces.npz --seed 0"))
@click.option("--n", type=options.COUNT, default=1503, show_default=True, help="Insertions to simulate, of 2 s each.")
@click.option("--out", type=options.FILE, required=True, help=OUT)
@options.scenario_option
@options.seed_option
@options.n_jobs_option(-1, "Processes; -1: one a core.")
@options.force_option
@options.json_option
def simulate(n: int, out: Path, scenario: str, seed: int, n_jobs: int, force: bool, as_json: bool) -> None:
    """Simulate insertions and write their forces and labels."""
    from ..files import check_output

    options.must_have_mujoco()
    check_output(out, force)  # before minutes of physics
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
