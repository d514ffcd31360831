"""The subcommands `dengine replay`, `compare` and `costs`: recorded streams through fresh engines.

All three take the options of `stream_options` for how streams are played. After Ctrl-C or an error
they show what was finished.
"""

from __future__ import annotations

import shlex
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from ..errors import amount, counted, percent
from . import options
from .options import (
    ALPHA,
    COUNT,
    LOWER_BOUND,
    OWN_RECIPE,
    CommaList,
    DataChoice,
    NameChoice,
    Options,
    RecipeChoice,
    short_name,
    verb,
)
from .output import (
    Out,
    Record,
    exit_interrupted,
    explain_option,
    format_duration,
    legend_or_hint,
    print_result,
    progress_bar,
)

if TYPE_CHECKING:
    import pandas as pd

    from ..datasets import Dataset
    from ..experiments.costs import CostCurve, PolicyCost
    from ..experiments.grid import PlayedReplay, Task
    from ..experiments.metrics import ErrorRate
    from ..experiments.replay import Contender, Replay


@dataclass(frozen=True)
class Stream:
    """How the recorded stream is played.

    Parameters
    ----------
    seeds : range
        Each gives a replay of every contender and policy.
    shuffle : bool
        Whether the parts are shuffled, by the seed; False: in recorded order.
    n_jobs : int
        Replays at a time, as joblib counts them.
    cycles : int or None
        Parts of a replay; None: all.
    keep : Path or None
        Folder of finished replays, which are read from there and not played again.
    """

    seeds: range
    shuffle: bool
    n_jobs: int
    cycles: int | None = None
    keep: Path | None = None


def _play(
    dataset: Dataset, tasks: Sequence[Task], stream: Stream, advance: Callable[[int], None]
) -> tuple[list[PlayedReplay], BaseException | None]:
    """Play replays; return the finished ones, and what ended the work early.

    A replay plays recorded parts through a new engine; each of `tasks` is a replay to be played.
    The finished replays are in the order of their tasks. The error or Ctrl-C that ended the work
    early (None if nothing did) is not raised: the caller must pass it to `_end`. `advance(n)` is
    called for each n cycles that are played, and with the length of each replay that was finished
    earlier. Of `stream` these are used: the number of processes, and the folder of replays that
    were finished earlier and are not played again.
    """
    from ..experiments.grid import iterate_replays

    played: list[PlayedReplay] = []
    error: BaseException | None = None
    try:
        for item in iterate_replays(
            dataset,
            tasks,
            n_jobs=stream.n_jobs,
            keep=stream.keep,
            on_cycle=lambda cycle: advance(1),
        ):
            played.append(item)
            # A callback cannot travel to other processes: there the bar moves by whole replays.
            if stream.n_jobs != 1 or item.kept:
                advance(len(item.replay))
    except (KeyboardInterrupt, Exception) as interruption:  # what was finished is shown first
        error = interruption
    return sorted(played), error


def _end(error: BaseException | None, text: str, is_shown: bool = True) -> None:
    """End the subcommand if an error or Ctrl-C interrupted its replays; do nothing for None.

    `error` is what interrupted them, and `text` says which replays are shown. After Ctrl-C `text`
    is printed to stderr, and the exit code is 130. Any other error is raised; before, `text` is
    printed to stderr if `is_shown`.
    """
    if isinstance(error, KeyboardInterrupt):
        exit_interrupted(f"Interrupted: {text}")
    if error is not None:
        if is_shown:
            click.echo(f"Interrupted: {text}", err=True)
        raise error


def stream_options(repeats: int, least: int, n_jobs: int, text: str) -> options.Option:
    """Return a decorator that adds the options that say how recorded streams are played.

    A stream is the parts of a data set in the order in which an engine gets them. The options are
    `--repeats`, `--seed`, `--cycles`, `--in-order`, `--n-jobs` and `--keep`. The subcommand gets
    them as one `Stream`, its argument `stream`. `--repeats` together with `--in-order` is a usage
    error.

    Parameters
    ----------
    repeats, n_jobs : int
        Defaults of `--repeats` and `--n-jobs`.
    least : int
        Smallest number that `--repeats` takes. If it is above 1, there is no option `--in-order`,
        because that plays the stream only once.
    text : str
        Help of `--repeats`.
    """

    def make_stream(repeats: int, seed: int, in_order: bool = False, **settings: Any) -> Stream:
        """Return the stream; in order it has one seed, and a given `--repeats` is a usage error."""
        if in_order:
            source = click.get_current_context().get_parameter_source("repeats")
            if source is not ParameterSource.DEFAULT:
                raise click.UsageError("--in-order plays the one stream once; leave --repeats out.")
            repeats = 1
        return Stream(range(seed, seed + repeats), shuffle=not in_order, **settings)

    flags: dict[str, options.Option] = {
        "repeats": click.option(
            "--repeats",
            type=click.IntRange(least),
            default=repeats,
            help=text,
        ),
        "seed": options.seed_option,
        "cycles": click.option(
            "--cycles", type=COUNT, help="Only this many parts of each stream.  [default: all]"
        ),
        "in_order": click.option(
            "--in-order",
            is_flag=True,
            help="Play the stream once, in its recorded order, drift included.",
        ),
        "n_jobs": options.n_jobs_option(
            n_jobs,
            "Number of replays at a time; -1: one for each core. Timings are right with 1 only.",
        ),
        "keep": click.option(
            "--keep",
            type=options.FOLDER,
            metavar="FOLDER",
            help=(
                "Folder of finished replays, which are not played again: an interrupted run "
                "continues, and the costs at other prices take no new replays."
            ),
        ),
    }
    if least > 1:
        del flags["in_order"]
    return options.bundle_options("stream", make_stream, flags)


replay_stream = stream_options(30, 1, 1, "Number of shuffled replays of each recipe.")
GRID_LISTS = {
    "alphas": click.option(
        "--alphas", type=CommaList(ALPHA), help="Values to try, like 0.5,0.1,0.05."
    ),
    "lower_bounds": click.option(
        "--lower-bounds", type=CommaList(LOWER_BOUND), help="Values to try, like 0.8,0.9,0.95."
    ),
}
POLICY_LISTS = GRID_LISTS | {
    "intervals": click.option(
        "--intervals", type=CommaList(NameChoice("interval")), help="Names to try."
    ),
}


@verb(
    "dengine replay --data insertion --reducer conv --alpha 0.1 --lower-bound 0.9 --repeats 3 "
    "--out out/"
)
@options.data_options()
@options.recipe_options
@replay_stream
@options.check_option
@explain_option
@options.out_option("replays.csv", "curves.png")
def replay(choice: RecipeChoice, **played: Any) -> None:
    """Replay a recorded stream, shuffled, through fresh engines.

    Shows what was decided and how much of it was wrong, over all shuffles, and whether the accepted
    parts kept to LB, the --lower-bound. --out writes a CSV file and pictures. Ctrl-C, or an error
    in a replay, ends it and shows the replays that were finished.
    """
    _replay_and_print([choice.make_contender()], {}, **played)


@verb("dengine compare --data insertion --reducers conv,pca --repeats 2 --out compared/")
@options.data_options()
@click.option(
    "--reducers",
    "names",
    default="conv,umap,pca",
    type=CommaList(NameChoice("method", OWN_RECIPE)),
    help="With commas between; names that are no reducers of dengine are baselines.",
)
@options.policy_options
@click.option(
    "--paper", is_flag=True, help="The paper's whole grid: 3 alphas, 3 lower bounds, 2 intervals."
)
@options.bundle_options("lists", dict, POLICY_LISTS)
@replay_stream
@options.check_option
@explain_option
@options.out_option("replays.csv", "curves.png")
def compare(
    names: Sequence[str],
    settings: Options,
    paper: bool,
    lists: Options,
    **played: Any,
) -> None:
    """Replay the same streams through several methods.

    Methods are reducers, and baselines (published methods, for comparison), each with a name of its
    own. A stream is a shuffle of the recordings, or with --in-order their recorded order. Each
    method plays it under one policy (the settings of its decisions) or a grid of policies: give a
    setting either as one value (--alpha) or as a list to try (--alphas); both are a usage error.
    --paper gives the lists of the paper, each unless you give your own; beside it, --alpha and
    --lower-bound are usage errors. One table, with a row for each method and policy, shows what was
    decided and how much of it was wrong, like that of `dengine replay`. umap-learn takes much
    longer than the others. Ctrl-C (exit code 130), or an error in a replay (1), ends it and shows
    the replays that were finished.
    """
    short_names = [short_name(name) for name in names]
    if len(set(short_names)) < len(short_names):
        raise click.UsageError(
            f"--reducers needs a name of its own for each method, got {', '.join(short_names)}."
        )
    from ..experiments.grid import PAPER_GRID

    grid: dict[str, Any] = {**(PAPER_GRID if paper else {}), **lists}
    _refuse_value_beside_list(settings, grid)
    _replay_and_print(
        [RecipeChoice(name, settings).make_contender() for name in names], grid, **played
    )


def _refuse_value_beside_list(settings: Options, lists: Iterable[str]) -> None:
    """Raise UsageError if a setting has both one value (`--alpha`) and a list to try (`--alphas`).

    Parameters
    ----------
    settings : mapping
        Settings that were given one value, by name.
    lists : iterable of str
        Names of the lists, such as "alphas".
    """
    for name in settings:
        if f"{name}s" in lists:
            flag = f"--{name.replace('_', '-')}"
            raise click.UsageError(
                f"{flag} gives one value, but a list is tried here: use {flag}s."
            )


def _replay_and_print(
    contenders: Sequence[Contender],
    grid: Options,
    source: DataChoice,
    stream: Stream,
    check_seconds: float,
    out: Out | None,
) -> None:
    """Play replays with all combinations of the values in `grid`; print and write the results.

    A replay plays recorded parts through a new engine. Tables are printed, or one JSON document
    with `--json`, and the files of `out` are written. After Ctrl-C or an error the finished replays
    are shown, if there are some, and a line on stderr says how many; after an error without
    finished replays there is no such line. Then the process ends with exit code 130, or the error
    is raised. Errors of the data set, and settings out of range, are raised before anything is
    played. A file that cannot be written is an OutputError, raised after the result was printed,
    and then in place of the error or exit code 130.

    Parameters
    ----------
    contenders : sequence of Contender
        Who plays: recipes (all settings of an engine) and baselines (published methods).
    grid : mapping
        Values to try, by the argument of `grid_tasks` that takes them, such as "alphas".
    source : DataChoice
        The data set that the user asked for.
    stream : Stream
        How it is played: seeds, number of parts (cycles), order, replays at a time, and a folder of
        finished replays, which are read from there and not played again.
    check_seconds : float
        Duration of a verification, from which the saved time is computed.
    out : Out or None
        Folder of the files; None: no files.
    """
    from ..experiments import tables
    from ..experiments.grid import grid_tasks

    dataset = source.load()
    tasks = grid_tasks(
        contenders, seeds=stream.seeds, cycles=stream.cycles, shuffle=stream.shuffle, **grid
    )
    begin = time.perf_counter()
    n_cycles = len(tasks) * (stream.cycles or len(dataset))
    with progress_bar(f"replaying {dataset.name}", n_cycles) as advance:
        played, error = _play(dataset, tasks, stream, advance)
    finished = f"{len(played)} of {len(tasks)} replays were finished"
    if not played:
        _end(error, f"{finished}; there is nothing to show.", False)
    replays = [item.replay for item in played]
    seconds = time.perf_counter() - begin
    n_kept = sum(item.kept for item in played)
    frame = tables.frame_of(replays, check_seconds)
    rows = tables.pool(frame, replays)
    by_name = _group_replays(replays, lambda replay: replay.name)
    order = "shuffled" if stream.shuffle else "in recorded order"
    subject = "simulated insertions" if dataset.name == "insertion" else dataset.name
    repeats = counted(len({replay.seed for replay in replays}), "replay")
    title = f"{', '.join(by_name)} on {subject}, {order}, {repeats} of {len(replays[0])} cycles"
    record = {
        "data": dataset.name,
        "in_order": not stream.shuffle,
        "faults": dataset.faults,
        "rows": rows,
        "interrupted": error is not None,
        "costs": {"seconds": seconds, "kept": n_kept},
    }
    parts = [
        tables.pooled_table(rows, title, legend_or_hint(tables.LEGEND)),
        *tables.promise_lines(rows),
    ]
    for name, group in by_name.items():
        retrains = [retrain for replay in group for retrain in replay.retrains]
        parts.append(f"{name}: {tables.retrain_line(retrains)}")
    kept = f"; {n_kept} of them were kept from before" if n_kept else ""
    parts.append(f"{counted(len(replays), 'replay')} in {format_duration(seconds)}{kept}.")
    print_result(
        record, *parts, out=out, make_files=lambda: dict(_replay_files(frame, replays, title))
    )
    _end(error, f"{finished}; the table shows those.")


def _group_replays(
    replays: Sequence[Replay], key: Callable[[Replay], str]
) -> dict[str, list[Replay]]:
    """Return a dict: `key(replay)` -> the replays with this key, in their order.

    Replays with one key must follow each other; otherwise only those of the last group count.
    """
    return {name: list(group) for name, group in groupby(replays, key)}


def _replay_files(
    frame: pd.DataFrame, replays: Sequence[Replay], title: str
) -> Iterator[tuple[str, Any]]:
    """Yield the name and the content of each file that `--out` writes.

    These are replays.csv, a table with a row for each replay (`frame`); curves.png, with the shares
    of errors and of decisions without a check over the parts played; and for each recipe (the
    settings of an engine) a picture of the embedding in its first replay, map_NAME.png. There is
    none if no trace was embedded, such as in a replay of a baseline, a published method. `title` is
    the title of the curves.
    """
    import numpy as np

    from ..experiments.figures import curves, embedding_map

    yield "replays.csv", frame
    groups = _group_replays(replays, lambda replay: _row_name(replay, frame))
    yield "curves.png", curves(groups, title)
    for name, (first, *_) in _group_replays(replays, lambda replay: replay.name).items():
        if not np.isnan(first.position).all():  # baselines embed nothing
            map_title = f"{name}, newest parts of one replay (seed {first.seed})"
            yield f"map_{name}.png", embedding_map(first, map_title)


def _row_name(replay: Replay, frame: pd.DataFrame) -> str:
    """Return a label for a replay in figures, like "conv, alpha 0.1, LB 90 %".

    It has the name of what was played (a recipe, the settings of an engine, or a baseline, a
    published method), and those settings of the policy that vary in `frame`, the table of all
    replays: guarantee, stops (whether every bad accepted part is reported), interval, alpha and
    lower bound (LB).
    """
    policy = replay.recipe.policy
    settings = {
        "guarantee": policy.guarantee,
        "stops": policy.stops,
        "interval": policy.interval,
        "alpha": f"alpha {policy.alpha:g}",
        "lower_bound": f"LB {percent(policy.lower_bound, 'g')}",
    }
    shown = [text for name, text in settings.items() if len(frame[name].unique()) > 1]
    return ", ".join([replay.name, *shown])


CAPTION = (
    "cost: of a part, the mean over {shuffles} of {cycles} parts that chose nothing; "
    "below it a 95 % interval, with the luck of the recordings and of the order. late: over the "
    "last third of a shuffle, when something has been learned. verified: share of the parts that "
    "were checked. bad of accepted, good of rejected: over these shuffles, with their intervals "
    "below. The choice, >, is the cheapest, or one that lets fewer bad parts through and is not "
    "dearer beyond chance. All shuffles play the same parts: only parts that are recorded later "
    "are a clean test. Shuffles also hide drift, which dengine replay --in-order shows."
)
COLUMNS = ("rule", "LB", "cost", "late", "verified", "bad of\naccepted", "good of\nrejected")
CURVE_FIELDS = (
    "recipe",
    "verdict",
    "policy",
    "sentence",
    "missing",
    "price_changes",
    "out_of_reach",
    "costs",
    "cycles",
    "shuffles",
    "fresh",
)


PRICES = {
    "check": click.option("--check", type=float, default=5.0, help="Cost of one verification."),
    "escape": click.option(
        "--escape",
        type=float,
        required=True,
        help="Cost of a bad part that is accepted: a line stop, or worse.",
    ),
    "false_reject": click.option(
        "--false-reject", type=float, required=True, help="Cost of a good part that is rejected."
    ),
}


@verb(
    "dengine costs --data insertion --reducer pca --cycles 200 --repeats 2 --escape 120 "
    "--false-reject 30"
)
@options.data_options()
@options.bundle_options("part_prices", dict, PRICES)
@click.option("--cost-unit", default="s", help="Unit of these costs: s, EUR, ...")
@options.recipe_options
@options.bundle_options("lists", dict, GRID_LISTS)
@stream_options(
    4,
    2,
    -1,
    "Number of shuffles that the last two policies play; earlier shuffles choose these policies.",
)
@explain_option
@options.out_option("costs.csv", "costs.png")
def costs(
    choice: RecipeChoice,
    part_prices: dict[str, Any],
    cost_unit: str,
    lists: Options,
    source: DataChoice,
    stream: Stream,
    out: Out | None,
) -> None:
    """Find out, by three prices, which policy pays.

    A policy is how the engine decides: a guarantee (its rule) with settings like alpha. The prices
    are those of a check, of a bad part that is accepted (--escape) and of a good part that is
    rejected (--false-reject), all in one unit, such as seconds of production or money. Policies are
    replayed on shuffles of your recordings. The output shows what a part costs under the best
    policies, and what it costs if everything is verified. It says how certain these costs are, and
    how to set the policy. A policy pays if the whole interval of its cost is below the cost of
    verifying everything, and may pay if that is open. If no policy pays or may pay, the choice is
    to verify everything, and the output names no policy to set.

    The policies that are tried have the guarantee local (LB, the lower bound of the success
    probability, is for each accepted part) or pooled (LB is for all parts together that reach its
    threshold), each with values of LB around break-even, where accepting costs as much as verifying
    (or with those of --lower-bounds), or the guarantee cost, which decides by the prices; these
    replace --guarantee and --prices. A rule of your own is tried in place of all three. With
    --stops some, and without an audit rate, pooled and cost check 5 % of the parts that they could
    decide (audits). --alpha and --lower-bound are usage errors: give --alphas and --lower-bounds.

    --out writes costs.csv and costs.png. Ctrl-C (exit code 130), or an error in a replay (1), ends
    it and shows what was finished, if at least two shuffles are finished by every policy that is
    left. The exit code is 1 if a check costs as much as a bad accepted part or more, if a false
    reject costs nothing, or if the recordings have one label only or are too few.
    """
    _refuse_value_beside_list(choice.settings, ("alphas", "lower_bounds"))
    from ..experiments.costs import find_policy, settings_of
    from ..experiments.figures import cost_picture
    from ..experiments.metrics import Costs
    from ..experiments.tables import table_of_numbers

    dataset = source.load()
    error: BaseException | None = None

    def play(tasks: Sequence[Task]) -> list[Replay]:
        """Play tasks; return the finished replays in the order of the tasks, and keep what
        interrupted them in `error`, None if nothing did.
        """
        nonlocal error
        played, error = _play(dataset, tasks, stream, advance)
        return [item.replay for item in played]

    with progress_bar(f"replaying {dataset.name}, cycles", None) as advance:
        curve = find_policy(
            dataset,
            choice.make_contender(),
            Costs(**part_prices),
            play,
            repeats=len(stream.seeds),
            seed=stream.seeds[0],
            cycles=stream.cycles,
            **lists,
        )
    if curve is None:
        _end(error, "too little was finished; there is nothing to show.", False)
        return
    check = amount(curve.costs.check)
    name = f"{'' if curve.policy else '> '}check all"
    verify_all = (name, "-", check, check, "100 %", "-", "-")
    rows = [verify_all, *(_cost_cells(row, row.policy == curve.policy) for row in curve.rows)]
    title = f"{curve.recipe} on {curve.dataset}: what a part costs, in {cost_unit}"
    lines = list(_curve_lines(curve, dataset))
    record: Record = {
        "data": curve.dataset,
        "unit": cost_unit,
        "interrupted": error is not None,
    }
    record |= {name: getattr(curve, name) for name in CURVE_FIELDS}
    if curve.policy is not None:
        settings = settings_of(curve.policy)
        record["python"] = f"Policy({', '.join(f'{k}={v!r}' for k, v in settings.items())})"
        store = source.data if source.data.endswith(".db") else "cell.db"
        # What is not given stays as it is in the store.
        kept = {
            name: getattr(curve.policy, name)
            for name in ("guarantee", "alpha", "audit_rate", "stops")
        }
        record["command"] = f"dengine policy {shlex.quote(store)} {_as_flags(settings | kept)}"
        command = " \\\n    ".join(
            wrap(record["command"], 72, break_on_hyphens=False, break_long_words=False)
        )
        lines.append(f"Set it by\n  {command}\n  {record['python']}")
    frame = curve.to_frame()
    print_result(
        record | {"rows": frame.to_dict("records")},
        table_of_numbers(
            title,
            [dict(zip(COLUMNS, row, strict=True)) for row in rows],
            legend_or_hint(
                CAPTION.format(shuffles=counted(curve.shuffles, "shuffle"), cycles=curve.cycles)
            ),
        ),
        *lines,
        out=out,
        make_files=lambda: {
            "costs.csv": frame,
            "costs.png": cost_picture(curve, unit=cost_unit),
        },
    )
    _end(error, "what was finished is shown.")


def _curve_lines(curve: CostCurve, dataset: Dataset) -> Iterator[str]:
    """Yield the sentences below the table of what a part costs under each policy.

    They say which policy was chosen, and how the choice depends on the three prices (of a check, a
    bad accepted part and a good rejected part). If there are any, they also say how many recordings
    of the data set equal an earlier one (by a hash of their samples), which policies were left
    behind because they were dearer in the first shuffles (random orders of the parts), and which
    were not tried.
    """
    from ..experiments.costs import policy_name
    from ..experiments.survey import survey_dataset

    yield curve.sentence
    yield curve.price_sentence
    repeats = survey_dataset(dataset).duplicates
    if repeats:
        yield (
            f"Of the recordings {repeats:,} repeat another: remove them, because the cost is too "
            "low and its interval too narrow."
        )
    by_shuffles = [f"{policy_name(row.policy)} {amount(row.cost)}" for row in curve.left_behind]
    if by_shuffles:
        yield f"Left behind by other shuffles, at costs of these: {', '.join(by_shuffles)}."
    if curve.out_of_reach:
        yield f"Not tried: {'; '.join(curve.out_of_reach)}."


def _as_flags(settings: Options) -> str:
    """Return settings of a policy, given by name, as options of the command line in one text.

    It is like "--alpha 0.1 --lower-bound 0.9", in the order of the settings; the prices (of a
    check, a bad accepted part and a good rejected part) are joined by commas. Without settings it
    is "".
    """
    texts = {
        name: ",".join(f"{price:.15g}" for price in value) if name == "prices" else str(value)
        for name, value in settings.items()
    }
    return " ".join(f"--{name.replace('_', '-')} {text}" for name, text in texts.items())


def _cost_cells(row: PolicyCost, is_chosen: bool) -> tuple[str, ...]:
    """Return the cells of a policy's row in the table of costs, under the titles in `COLUMNS`.

    They are its rule ("> " stands before it if the policy is chosen), its LB in percent
    (`lower_bound` of the policy; "-" if its guarantee is cost), cost with its interval in a second
    line, late cost (over the last third of each shuffle), share of verified parts, and wrong
    accepts and rejects with the intervals of their shares. The guarantee is what is promised about
    decisions, and the rule that keeps it; the cell of the rule is its name, or like "alpha 0.1" if
    it is local (about the neighbourhood of each trace).
    """
    policy = row.policy
    rule = f"alpha {policy.alpha:g}" if policy.guarantee == "local" else policy.guarantee
    return (
        f"> {rule}" if is_chosen else rule,
        "-" if policy.guarantee == "cost" else percent(policy.lower_bound, "g"),
        f"{amount(row.cost)}\n{amount(row.lower)} to {amount(row.upper)}",
        amount(row.late),
        percent(row.verified, ".0f"),
        _error_cell(row.bad),
        _error_cell(row.good),
    )


def _error_cell(error: ErrorRate) -> str:
    """Return how many decisions were wrong and the interval of their share, in two lines of text.

    The lines are like "3 of 120" and "0.5–7.1 %". The ends of the interval have at most three
    significant digits. The text is "-" if there was no decision.
    """
    if not error.decided:
        return "-"
    interval = f"{amount(100 * error.lower)}–{amount(100 * error.upper)} %"
    return f"{error.wrong} of {error.decided}\n{interval}"
