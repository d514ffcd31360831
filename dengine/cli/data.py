"""`dengine data`, `simulate` and `train`: what a data set is; a simulated one; and a store that has learned from one."""

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..errors import as_options, listed
from . import options
from .options import DataChoice, RecipeChoice, left_out, short_name, verb
from .output import EndAskedError, Out, end_interrupted, facts, progress, rows_of, steps, tell

if TYPE_CHECKING:
    from ..experiments.survey import Drift

MOST = 10  # faults that are named
CLEAR = 0.01  # p-values below it are called drift


@verb("dengine data insertion --out out/")
@options.data_options(argument=True)
@options.out_option
def data(source: DataChoice, out: Out | None) -> None:
    """Say what a data set is, and what is wrong with it.

    A folder of CSV files, one an insertion, its label in its name or in a column; a wide .csv or .parquet, a row an
    insertion; a long one, a row a sample, with --part, --time and --label; .npz with X (traces, samples) and y (1 success,
    0 failure); one long .mcap, cut by --trigger; the file of a store, for what is labelled in it; or the bundled set,
    insertion.
    """
    from ..datasets import load_dataset
    from ..experiments.figures import data_picture
    from ..experiments.survey import survey
    from ..model.neighbours import SUSPICIOUS

    dataset = load_dataset(source.data, **source.how)
    found = survey(dataset)
    rows = list(rows_of(found, "name", "faults", "drift", "not_finite_in"))
    rows += [] if found.rate_hz else [("rate", "unknown")]
    tables: list[Any] = [facts(found.name, rows), *map(as_options, dataset.notes)]
    if found.not_finite_in:
        tables.append(f"Not finite, for cells are empty or no number: {listed(found.not_finite_in)}.")
    if dataset.ordered:
        tables.append(facts("By tenths of the recorded order", map(_drift, found.drift), ("", "means", "")))
    else:
        tables.append("The files are in the order of their labels, not of their recording: no drift is looked for.")
    if found.near_repeats > SUSPICIOUS:
        tables.append("Many traces nearly repeat another part's: if parts come twice, give their numbers (--part).")
    tell(
        {"data": source.data, "survey": found, "notes": dataset.notes},
        *(*tables, *left_out(dataset, MOST)),
        out=out,
        made=lambda: {"data.png": data_picture(dataset, found.name)},
    )


def _drift(one: "Drift") -> tuple[str, str, str]:
    means = " ".join(f"{x:.2g}" for x in one.tenths)
    if math.isnan(one.rho):
        return one.name, means, "never changes"
    went = "no drift is seen" if one.p >= CLEAR else f"{'rises' if one.rho > 0 else 'falls'} with the order"
    return one.name, means, f"{went} (Spearman's rho {one.rho:+.2f}, p {one.p:.2g})"


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
        insertions = simulated(n, seed, scenario, n_jobs, progress=advance)
    path, good = save_insertions(out, insertions, seed, scenario, force), sum(each.success for each in insertions)
    record = {"simulated": True, "scenario": scenario, "n": n, "successes": good, "file": path}
    tell(record, f"Simulated {n} insertions ({scenario}): {good} successes. Wrote {path}")


@verb("dengine train --data insertion --store engine.db --reducer conv")
@options.data_options(None)
@options.store_option("Where the engine remembers; made if need be.", "--cell", required=True)
@options.recipe_options
@options.allow_import_option
@options.new_seed_option
def train(choice: RecipeChoice, source: DataChoice, store: str, seed: int | None, allow_import: bool) -> None:
    """Import labelled traces into a store and train on them.

    Each trace counts once, however often its file is imported. A bad trace (not finite, constant) is kept, but never
    trained on. A store that has been used keeps its own recipe and seed. Ctrl-C keeps what was imported; the same
    command goes on from there.
    """
    from ..datasets.importing import import_labelled, stored_form
    from ..engine.engine import DataEngine, core_of
    from ..experiments.tables import retrain_line
    from ..store.opening import UNHURRIED

    before = stored_form(store, source.data)  # of what the store has, where no other form was asked for
    data = replace(source, how={**before, **source.how}).load()
    try:
        with steps(f"importing {data.name}", len(data)) as count:
            imported = import_labelled(store, data, choice.if_asked(), seed, count, allow_import)
    except EndAskedError as end:
        there = f"{end.args[0]} of {len(data)} traces are in {store}"
        end_interrupted(f"Interrupted: {there}; the same command goes on from there.")
    asked: dict[str, Any] = {"recipe": choice.if_asked(), "allow_import": allow_import}
    with DataEngine.open_or_create(store, wait=UNHURRIED, **asked) as engine:
        name = short_name(engine.recipe.name)
        record = {"store": store, "faults": data.faults, "notes": data.notes, "import": imported}
        if not (imported.imported or core_of(engine).new_labels) and engine.version:
            said = f"{store} knows all of {data.name}, nothing was done. Version {engine.version} of {name} answers."
            tell(record | {"retrain": None}, said)
            return
        with progress("training", None):
            reports = [engine.retrain()]
            while reports[-1].accepted and engine.model.report.n_steps_left:
                reports.append(engine.retrain())
        report = reports[-1]
        labels = engine.store.status()["labels"]
    answers = f"Version {report.version} of {name} answers. {retrain_line(reports)}"
    answers = answers if report.version else "No version answers yet: every part is verified."
    table = facts(f"{data.name} into {store}", rows_of(imported))
    tell(record | {"retrain": report}, table, answers, f"{store} holds {labels} labels.")
    if not report.accepted:
        raise click.ClickException(f"The retrain was {report.reason}.")
