"""The subcommands `dengine data`, which surveys a data set, `simulate`, which generates one, and
`train`, which imports one into a store and trains an engine on it.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from . import options
from .options import DataChoice, RecipeChoice, fault_lines, short_name, verb
from .output import (
    Out,
    StepInterruptedError,
    exit_interrupted,
    field_rows,
    interruptible_steps,
    print_result,
    progress_bar,
    table_of_rows,
)

if TYPE_CHECKING:
    from ..datasets import Dataset
    from ..experiments.survey import Survey

MOST_FAULTS = 10  # that are shown
MOST_EMPTY_RETRAINS = 10  # in a row, without a step: on a busy machine one alone means nothing


@verb("dengine data insertion --out out/")
@options.data_options(argument=True)
@click.option(
    "--sample",
    is_flag=True,
    help=(
        "First write recordings to try it on into DATA, a new or an empty folder: "
        "200 files of the bundled set, one of them broken."
    ),
)
@click.option(
    "--save",
    is_flag=True,
    help="Write the description, recordings.toml in a folder or FILE.toml beside a file.",
)
@click.option("--check", is_flag=True, help="End with exit code 1 if there is any fault.")
@options.out_option("data.png")
@click.pass_context
def data(
    context: click.Context,
    source: DataChoice,
    sample: bool,
    save: bool,
    check: bool,
    out: Out | None,
) -> None:
    """Describe recordings, and list what is wrong with them.

    DATA is a folder of files, one for each insertion of a part, or a file with many: text, Parquet,
    JSON, .npz, .ts or .mcap. A description, a TOML file, says how the recordings are read. The
    subcommand shows the saved description or, without one, a proposal, in which ? marks what you
    have to state with --set. While a ? is left, no recording is read by it, no picture is drawn,
    and --check ends with exit code 1; --save writes the description all the same, and later calls
    propose anew what is not answered in it. Below the description it shows what was read: the
    counts of traces and labels, and the recordings that were left out, with the reasons. --out
    draws the traces, and how they drift. Look at them, and write the description with --save,
    because every other subcommand needs it to read the recordings; --save replaces a file that
    exists only with --force.

    DATA may also be a source that needs no description: a bundled set (data that come with
    dengine), the file of a store (an engine's database), or an .npz file with X (traces, samples)
    and y (1 success, 0 failure). For such a source --save does nothing.
    """
    from ..datasets.description import Seen
    from ..datasets.sample import write_sample
    from ..experiments.figures import data_picture
    from ..experiments.survey import survey_dataset

    if sample:
        write_sample(source.data)
    force = context.params["force"]
    description = source.describe(propose=True)
    if description is not None and description.open_keys:
        path = description.save(source.path, force) if save else None
        text = description.to_toml()
        print_result(
            {"data": source.data, "description": text, "open": description.open_keys},
            text,
            f"Wrote {path}." if path else "",
            "Still open, so nothing was read; state each with --set KEY=VALUE:",
            *(
                f"- {key}: {description.notes.get(key, 'not known')}"
                for key in description.open_keys
            ),
        )
        context.exit(int(check))
    dataset = source.load(description, quiet=True)
    survey = survey_dataset(dataset)
    shown = ""
    last_line = ""
    if description is not None:
        shown = description.to_toml()
        if save:
            seen = Seen(
                recordings=len(dataset) + dataset.unlabelled + len(dataset.faults),
                good=survey.good,
                bad=survey.bad,
            )
            path = replace(description, seen=seen).save(source.path, force)
            last_line = f"Wrote {path}."
        elif not source.path.is_file():
            last_line = (
                "Look at the traces (--out FOLDER); if they are right, write the description with "
                "--save."
            )
    print_result(
        {"data": source.data, "description": shown, "survey": survey, "notes": dataset.notes},
        *filter(None, [shown, *_survey_parts(dataset, survey), last_line]),
        *fault_lines(dataset, MOST_FAULTS),
        out=out,
        make_files=lambda: {"data.png": data_picture(dataset, survey.name)},
    )
    if check and dataset.faults:
        context.exit(1)


def _survey_parts(dataset: "Dataset", survey: "Survey") -> Iterator[Any]:
    """Yield what `dengine data` prints of a data set and its survey: a table, and texts.

    First comes a table with the counts of the survey, such as labels and faults, and with the first
    and the last trace. Then come the notes of the data set, a sentence if the order of recording is
    unknown, and a sentence if more than 25 of the newest usable traces (finite, not constant, not
    too large) nearly repeat the trace of another part. The last text is a warning if accepting
    every part of the data set would meet the tolerance of the default policy, the share of accepted
    parts that may be bad; else it is "". The data set must have a trace.
    """
    from ..datasets.checks import tolerance_note
    from ..decision.policy import Policy
    from ..model.neighbours import MANY_REPEATS
    from ..records import REPEATS, REPEATS_MEANING

    rows = list(field_rows(survey, "name", "faults", "not_finite_in"))
    rows += [] if survey.rate_hz else [("rate", "unknown")]
    rows += [] if survey.unit else [("unit", "unknown")]
    rows += [("first", _trace_line(dataset, 0)), ("last", _trace_line(dataset, -1))]
    yield table_of_rows(survey.name, rows)
    yield from dataset.notes
    if not dataset.ordered:
        yield (
            "All parts of one label come first, so this is not the order of their recording: drift "
            "cannot be seen."
        )
    if survey.near_repeats > MANY_REPEATS:
        yield f"{survey.near_repeats} {REPEATS}. {REPEATS_MEANING}"
    yield tolerance_note(dataset, Policy().lower_bound)


def _trace_line(dataset: "Dataset", i: int) -> str:
    """Return a text on trace `i` of a data set: its source, its label and five of its samples.

    The source is the file or row that it comes from, and is left out if it is unknown. The samples
    are the first three and the last two, with 4 significant digits, of several channels those of
    the first.
    """
    trace = dataset.cube[i, 0]
    samples = [f"{value:.4g}" for value in (*trace[:3], *trace[-2:])]
    source = "" if dataset.source is None else f"{dataset.source[i]}, "
    label = "good" if dataset.y[i] else "bad"
    return f"{source}{label}: {', '.join(samples[:3])}, ..., {', '.join(samples[3:])}"


@verb("dengine simulate --n 50 --out traces.npz --seed 0")
@click.option(
    "--n",
    type=options.COUNT,
    default=1503,
    help="Number of insertions, of 2 s each.",
)
@click.option(
    "--out",
    type=options.FILE,
    required=True,
    help=(
        "The .npz file to write: X (n, 1000) forces at 500 Hz, newtons when "
        "multiplied by scale; y (n,) labels."
    ),
)
@options.scenario_option
@options.seed_option
@options.n_jobs_option(-1, "Number of processes; -1: one for each core.")
@options.force_option
def simulate(n: int, out: Path, scenario: str, seed: int, n_jobs: int, force: bool) -> None:
    """Simulate insertions and write their forces and labels.

    They go into an .npz file, whose folder is made if it is missing. A file that exists is refused
    before the simulation, or replaced with --force. The file is written at the end, so Ctrl-C
    leaves no file, or the old file. The number of successes, the parts that sit correctly, is
    printed. Without MuJoCo, which dengine[sim] installs, the exit code is 1.
    """
    from ..files import check_output

    options.require_modules("the simulated cell", "sim", "mujoco")
    check_output(out, force)  # before minutes of physics
    from ..cells.simulation.generate import save_insertions
    from ..cells.simulation.generate import simulate as simulate_insertions

    with progress_bar(f"simulating {scenario}", n) as advance:
        insertions = simulate_insertions(n, seed, scenario, n_jobs, progress=advance)
    path = save_insertions(out, insertions, force)
    successes = sum(insertion.success for insertion in insertions)
    print_result(
        {
            "simulated": True,
            "scenario": scenario,
            "n": n,
            "successes": successes,
            "file": path,
        },
        f"Simulated {n} insertions ({scenario}): {successes} successes. Wrote {path}",
    )


@verb("dengine train --data insertion --store engine.db --reducer conv")
@options.data_options(None)
@options.store_option("The engine's store; created if it does not exist.", "--cell", required=True)
@options.recipe_options
@options.allow_import_option
@options.new_seed_option
def train(
    choice: RecipeChoice, source: DataChoice, store: str, seed: int | None, allow_import: bool
) -> None:
    """Import labelled traces into a store and train on them.

    Each trace counts once, however often its file is imported. A faulty trace (not finite,
    constant, at the sensor's limit or too large) is stored, but never trained on. A label that
    contradicts the stored label of its trace is left out, and counted in the output; a recording
    that cannot be read is left out with a note. A store that has been used has its own recipe (all
    settings of the engine) and seed: leave these options out, because other values are refused.
    Recordings are brought to the length of the store's traces.

    If there is a version (a trained model), no label is new to it, and it lacks no training step (a
    step of the optimizer), nothing is trained. Otherwise a version that `dengine rollback` pinned,
    so that no automatic retrain replaces it, is pinned no more. If training needs more time than
    one retrain may take (the recipe's time budget), several retrains follow each other. The exit
    code is 1 if a new version is dropped, which leaves the one before in use (the training or a
    test of it fails, it cannot be stored, or there is no label to train on), or if training steps
    are missing at the end, because ten retrains in a row had no time for a single step. If steps
    are missing, and after Ctrl-C, which keeps what was imported, the same command continues there.
    The subcommand is refused while an engine runs on the robot cell.
    """
    from ..datasets.importing import import_labelled, in_form_of
    from ..engine.engine import DataEngine
    from ..experiments.tables import retrain_line
    from ..store.opening import LONG_WAIT

    description = source.describe()
    if description is not None:
        description = in_form_of(store, description)
    dataset = source.load(description)
    recipe = choice.load_if_given(store)
    try:
        with interruptible_steps(f"importing {dataset.name}", len(dataset)) as count:
            imported = import_labelled(store, dataset, recipe, seed, count, allow_import)
    except StepInterruptedError as interrupt:
        exit_interrupted(
            f"Interrupted: {interrupt.args[0]} of {len(dataset)} traces are in {store}; the same "
            "command continues there."
        )
    with DataEngine.open_or_create(
        store, wait=LONG_WAIT, recipe=recipe, allow_import=allow_import
    ) as engine:
        name = short_name(engine.recipe.name)
        record = {
            "store": store,
            "faults": dataset.faults,
            "notes": dataset.notes,
            "import": imported,
        }
        if engine.version and not (
            imported.imported or engine.state.new_labels or engine.model.report.n_steps_left
        ):
            print_result(
                record | {"retrain": None},
                f"{store} already has all of {dataset.name}, nothing was done. "
                f"Version {engine.version} of {name} answers.",
            )
            return
        with progress_bar("training", None):
            reports = [engine.retrain()]
            n_empty = 0
            while (
                reports[-1].accepted
                and engine.model.report.n_steps_left
                and n_empty < MOST_EMPTY_RETRAINS
            ):
                reports.append(engine.retrain())
                n_empty = 0 if reports[-1].n_steps else n_empty + 1
        report = reports[-1]
        n_labels = engine.store.decisions.counts()["labels"]
    answers = "No version answers yet: every part is verified."
    if report.version:
        answers = f"Version {report.version} of {name} answers. {retrain_line(reports)}"
    print_result(
        record | {"retrain": report},
        table_of_rows(f"{dataset.name} into {store}", field_rows(imported)),
        answers,
        f"{store} holds {n_labels} labels.",
    )
    if not report.accepted:
        raise click.ClickException(f"The retrain was {report.reason}.")
    n_steps_left = engine.model.report.n_steps_left
    if n_steps_left:
        raise click.ClickException(
            f"{n_steps_left} training steps are missing: {n_empty} retrains in a row had no time "
            f"for one in their budget of {engine.recipe.budget:g} s. If the machine is busy, "
            "repeat the command later, and training continues. If it is not, set a larger budget "
            "or fewer labels (window) in the recipe."
        )
