"""`dengine data`, `simulate` and `train`: what a data set is; a simulated one; and a store that has learned from one."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..errors import percent
from . import options
from .options import DataChoice, RecipeChoice, left_out, short_name, verb
from .output import EndAskedError, Out, duration, end_interrupted, facts, imported_line, progress, steps, tell

if TYPE_CHECKING:
    from ..experiments.survey import Survey
    from ..records import RetrainReport

MOST = 10  # faults that are named
CLEAR = 0.01  # p-values below it are called drift
FITTED = {
    "cut": "longer ones lose their end",
    "pad": "longer ones lose their end, shorter ones repeat their last sample",
    "resample": "the whole of each on so many points",
}


@verb("dengine data insertion --out out/")
@options.data_options(argument=True)
@options.out_option
def data(source: DataChoice, out: Out | None) -> None:
    """Say what a data set is, and what is wrong with it.

    A folder of CSV files, one an insertion, its label in its name; a wide .csv or .parquet, a row an insertion; .npz or .h5
    with X (traces, samples) and y (1 success, 0 failure); one long .mcap, cut by --trigger; the file of a store, for what
    is labelled in it; or the bundled set, insertion.
    """
    from ..datasets import load_dataset
    from ..experiments.figures import data_picture
    from ..experiments.survey import survey

    dataset = load_dataset(source.data, **source.how)
    found = survey(dataset)
    lines = [facts(found.name, [*_form(found), *_state(found), *_order(found)]), *left_out(dataset, MOST)]
    tell(
        {"data": source.data, "survey": found},
        *lines,
        out=out,
        made=lambda: {"data.png": data_picture(dataset, found.name)},
    )


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
    rate = f"{found.rate_hz:g} Hz, as stated: there are no timestamps that say so"
    if found.rates is not None:
        low, median, high = (f"{x:g}" for x in (found.rates.low, found.rates.median, found.rates.high))
        rate = (f"{low} Hz each" if low == high else f"{low} to {high} Hz, median {median}") + ", by the timestamps"
        rate += (
            "" if math.isclose(found.rate_hz, found.rates.median, rel_tol=1e-3) else f"; of the traces {found.rate_hz:g} Hz"
        )
    yield "rate", rate


def _state(found: Survey) -> Iterator[tuple[str, str]]:
    from ..model.neighbours import SUSPICIOUS

    yield "labels", f"{found.good} good, {found.bad} bad: {percent(found.good / found.traces)} good"
    if found.parts is not None:
        yield "parts", f"{found.parts}, {found.traces - found.parts} traces are of a part that came before"
    bad = [f"{n} {what}" for n, what in ((found.not_finite, "not finite"), (found.constant, "constant")) if n]
    yield "bad traces", f"{', '.join(bad)}: verified, never learned from" if bad else "none"
    again = f", {found.contradicting} of them with another label" if found.contradicting else ""
    yield "duplicates", f"{found.duplicates} equal an earlier trace{again}" if found.duplicates else "none"
    if found.near_repeats > SUSPICIOUS * found.looked_at:
        near = f"{found.near_repeats} of the newest {found.looked_at} nearly repeat another part's"
        yield "near repeats", f"{near}: if parts come twice, give their numbers (--part)"


def _order(found: Survey) -> Iterator[tuple[str, str]]:
    for each in found.drift:
        shares = " ".join(f"{100 * x:.0f}" for x in each.tenths) + " %"
        means = " ".join("-" if math.isnan(x) else f"{x:.3g}" for x in each.tenths)
        trend = "never changes"
        if not math.isnan(each.rho):
            went = "no drift is seen" if each.p >= CLEAR else f"{'rises' if each.rho > 0 else 'falls'} with the order"
            trend = f"{went} (Spearman's rho {each.rho:+.2f}, p {each.p:.2g})"
        yield f"{each.name} by tenths", f"{shares if each.name == 'good' else means}\n{trend}"


OUT = "The .npz file to write: X (n, 1000) forces at 500 Hz, newtons when multiplied by scale; y (n,) labels."


@verb("dengine simulate --n 50 --out traces.npz --seed 0")
@click.option("--n", type=options.COUNT, default=1503, show_default=True, help="Insertions to simulate, of 2 s each.")
@click.option("--out", type=options.FILE, required=True, help=OUT)
@options.scenario_option
@options.seed_option
@options.n_jobs_option(-1, "Processes; -1: one a core.")
@options.force_option
def simulate(n: int, out: Path, scenario: str, seed: int, n_jobs: int, force: bool) -> None:
    """Simulate insertions and write their forces and labels."""
    from ..files import check_output

    options.must_have("the simulated cell", "sim", "mujoco")
    check_output(out, force)  # before minutes of physics
    from ..cells.simulation.generate import save_insertions
    from ..cells.simulation.generate import simulate as simulated

    with progress(f"simulating {scenario}", n) as advance:
        insertions = simulated(n, seed, scenario, n_jobs, progress=lambda done, of: advance(1))
    path, good = save_insertions(out, insertions, seed, scenario, force), sum(each.success for each in insertions)
    record = {"simulated": True, "scenario": scenario, "n": n, "successes": good, "file": path}
    tell(record, f"Simulated {n} insertions ({scenario}): {good} successes, {n - good} failures.", f"Wrote {path}")


WITHIN = "At most so many, each within the recipe's seconds and going on from the last; umap and pca need but one."


@verb("dengine train --data insertion --store engine.db --reducer conv")
@options.data_options(None)
@options.store_option("Where the engine remembers; made if need be.", "--cell", required=True)
@options.recipe_options
@options.allow_import_option
@options.new_seed_option
@click.option("--retrains", type=options.COUNT, default=10, show_default=True, help=WITHIN)
def train(
    choice: RecipeChoice, source: DataChoice, store: str, seed: int | None, retrains: int, allow_import: bool
) -> None:
    """Import labelled traces into a store and train on them.

    Each trace counts once, however often its file is imported. A bad trace (not finite, constant) is kept, but never
    trained on. A store that has been used keeps its own recipe and seed. Ctrl-C keeps what was imported; the same
    command goes on from there.
    """
    from ..datasets.importing import form_in, import_labelled, train_until_done
    from ..engine.engine import DataEngine
    from ..experiments.tables import retrain_line
    from ..store.opening import UNHURRIED

    before = form_in(store, source.data)  # of what the store has, where no other form was asked for
    data = replace(source, how={**before, **source.how}).load()
    reports: list[RetrainReport] = []
    interrupted = False

    def trained(report: RetrainReport) -> None:
        reports.append(report)
        count(1)

    try:
        with steps(f"importing {data.name}", len(data)) as count:
            imported = import_labelled(store, data, choice.if_asked(), seed, count, allow_import)
    except EndAskedError as end:
        there = f"{end.args[0]} of {len(data)} traces are in {store}"
        end_interrupted(f"Interrupted: {there}; the same command goes on from there.")
    asked: dict[str, Any] = {"recipe": choice.if_asked(), "allow_import": allow_import}
    with DataEngine.open_or_create(store, wait=UNHURRIED, **asked) as engine:
        try:
            with steps("training", retrains) as count:
                train_until_done(engine, retrains, trained)
        except EndAskedError:
            interrupted = True
        name, labels = short_name(engine.recipe.name), engine.store.status()["labels"]
    kind = "a used store" if imported.resumed else "a new store"
    answers = f"Version {reports[-1].version} of {name} answers. {retrain_line(reports)}"
    answers = answers if reports[-1].version else "No version answers yet: every part is verified."
    record = {"store": store, "interrupted": interrupted, "faults": data.faults, "import": imported, "retrains": reports}
    tell(record, imported_line(imported, f"{store}, {kind}"), answers, f"{store} holds {labels} labels.")
    if interrupted:
        end_interrupted(f"Interrupted after {len(reports)} of at most {retrains} retrains; they are in {store}.")
    if not reports[-1].accepted:
        raise click.ClickException(f"The last retrain was {reports[-1].reason}.")
