"""Options that several verbs share, and the records that verbs get of them."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import wraps
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import click

from ..errors import DengineError, SettingError

if TYPE_CHECKING:
    import pandas as pd

    from ..datasets import Dataset
    from ..recipe import Recipe

Command = Callable[..., Any]
FILE = click.Path(dir_okay=False, path_type=Path)
FOLDER = click.Path(file_okay=False, path_type=Path)
COUNT = click.IntRange(1)
ALPHA = click.FloatRange(0.0, 1.0, min_open=True, max_open=True)
LOWER_BOUND = click.FloatRange(0.5, 1.0, min_open=True, max_open=True)


def names_of(kind: str) -> tuple[str, ...]:
    """What can be said where this is asked for: the keys of the package's own tables, read when they are needed."""
    from ..decision.intervals import INTERVALS
    from ..decision.policy import RULES, Stops
    from ..experiments.rivals import RIVALS
    from ..records import FITS, Action, Reason
    from ..reducers import REDUCERS
    from ..store.views import LABELS

    known: dict[str, Iterable[str]] = {"guarantee": RULES, "interval": INTERVALS, "stops": get_args(Stops)}
    known |= {"reducer": REDUCERS, "rival": RIVALS, "fit": FITS, "label": LABELS}
    known |= {"action": [each.value for each in Action], "reason": [each.value for each in Reason]}
    return tuple(known[kind])


class Known(click.ParamType[Any]):
    """A name of a kind, see `names_of`; or `module:Class`, where `own` may be given."""

    name = "name"

    def __init__(self, kind: str, own: bool = False) -> None:
        self.kind, self.own = kind, own

    def get_metavar(self, param: click.Parameter, ctx: click.Context | None = None) -> str:
        """[local|pooled|module:Class]."""
        return f"[{'|'.join([*names_of(self.kind), *(['module:Class'] if self.own else [])])}]"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """The name; what is in no table is a usage error."""
        names = names_of(self.kind)
        if value not in names and not (self.own and ":" in value):
            own = ", or module:Class of your own" if self.own else ""
            self.fail(f"{value!r} is not one of {', '.join(map(repr, names))}{own}.", param, ctx)
        return str(value)


class Naming(click.Option):
    """An option whose help says what can be named, in the place of {reducer} and other kinds."""

    def get_help_record(self, ctx: click.Context) -> tuple[str, str] | None:
        """Its words and its help."""
        self.help = re.sub(r"{(\w+)}", lambda kind: ", ".join(names_of(kind[1])), self.help or "")
        return super().get_help_record(ctx)


class Listed(click.ParamType[Any]):
    """Values with commas between, as a tuple; each is what another type says."""

    name = "list"

    def __init__(self, of: click.ParamType[Any]) -> None:
        self.of = of

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[Any, ...]:
        """'0.5,0.1' -> (0.5, 0.1); a wrong one among them is a usage error."""
        if isinstance(value, tuple):
            return value
        parts = [part.strip() for part in str(value).split(",") if part.strip()]
        if not parts:
            self.fail("expected at least one value, with commas between.", param, ctx)
        return tuple(self.of.convert(part, param, ctx) for part in parts)


def gathered(
    into: str, make: Callable[..., Any], options: Mapping[str, Callable[[Command], Command]]
) -> Callable[[Command], Command]:
    """Options, by the names of their values, which `make` takes; what it makes is handed on as `into`."""

    def decorate(command: Command) -> Command:
        @wraps(command)
        def with_one(**given: Any) -> Any:
            mine = {name: given.pop(name) for name in options}
            return command(**{into: make(**mine)}, **given)

        decorated: Command = with_one
        for option in reversed(list(options.values())):
            decorated = option(decorated)
        return decorated

    return decorate


def given(**options: Any) -> dict[str, Any]:
    """Those that were given."""
    return {name: value for name, value in options.items() if value is not None}


def cell_options(*names: str, product: bool = False) -> Callable[[Command], Command]:
    """`--cell`, or other names of it, and where asked for `--product`; the verb's `store` then says whose rows it means."""

    def with_options(command: Command) -> Command:
        @wraps(command)
        def named(store: str | None, cell_id: str | None, product: str | None = None, **others: Any) -> Any:
            from ..store.records import address

            if store is None and (cell_id or product):
                raise click.UsageError("A cell and its product are known to a store: name it, --store FILE|URL.")
            return command(store=None if store is None else address(store, cell_id, product), **others)

        if product:
            about = "What the cell makes: cells of one product share labels and versions.  [default: as the store says]"
            named = click.option("--product", metavar="NAME", help=about)(named)
        whose = "Whose rows of the store, where it holds several cells; `dengine status` lists them.  [default: cell]"
        return click.option(*(names or ("--cell", "--cell-id")), "cell_id", metavar="NAME", help=whose)(named)

    return with_options


def short_name(name: str) -> str:
    """What to call a recipe in tables and file names: `folder/often.toml` is often, `module:Class` is Class."""
    return Path(name.rpartition(":")[2]).stem


@dataclass(frozen=True)
class RecipeChoice:
    """Which recipe was asked for, if any; settings : those that were given, of a policy or `novelty`."""

    reducer: str | None = None
    recipe: str | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """What to call it in a table."""
        return short_name(self.recipe or self.reducer or "conv")

    def load(self, name: str | None = None) -> Recipe:
        """The recipe, or the one of another name with these settings. SettingError where its reducer cannot be found."""
        from ..recipe import Recipe
        from ..reducers import REDUCERS, reducer_class

        policy = dict(self.settings)
        novelty = policy.pop("novelty", None)
        recipe = Recipe.load(name or self.recipe or self.reducer or "conv").with_policy(**policy)
        recipe = recipe.with_settings(novelty=novelty)
        if recipe.reducer not in REDUCERS:
            reducer_class(recipe.reducer)  # now, and not when a store was made for it
        return recipe

    def if_asked(self) -> Recipe | None:
        """The recipe, where any of it was given; else the store's counts."""
        return self.load() if self.reducer or self.recipe or self.settings else None


# What a policy is by default is the recipe's affair, or the store's.
_ALPHA = "Two-sided error level of the confidence bound, a probability.  [default: the recipe's]"
_LB = "LB, a share of parts: 0.95 lets at most 5 % of the accepted parts be bad.  [default: the recipe's]"
_GUARANTEE = (
    "What keeps to LB: the ball around each part, at one look (local); all accepted parts together (pooled); or a rule of "
    "your own."
)
_STOPS = "Which bad accepted parts stop the system: some, or all; with all, one that no stop follows counts as good."
_AUDITS = "Share of what the model is certain of that is verified all the same; rejects are known by it alone."
_NOVELTY = "Verify a trace so many times less like the learned ones than these are like each other; 0: off."
_SHARE = click.FloatRange(0.0, 1.0, max_open=True)
POLICY = {
    "alpha": click.option("--alpha", type=ALPHA, help=_ALPHA),
    "lower_bound": click.option("--lower-bound", type=LOWER_BOUND, help=_LB),
    "guarantee": click.option("--guarantee", type=Known("guarantee", own=True), help=_GUARANTEE),
    "stops": click.option("--stops", type=Known("stops"), help=_STOPS),
    "audit_rate": click.option("--audit-rate", type=_SHARE, metavar="SHARE", help=_AUDITS),
}
SETTINGS = POLICY | {"novelty": click.option("--novelty", type=click.FloatRange(0.0), metavar="FACTOR", help=_NOVELTY)}
_REDUCER = "{reducer}, or module:Class of your own, looked for in this folder too.  [default: conv]"
RECIPE = {
    "reducer": click.option("--reducer", cls=Naming, metavar="NAME", help=_REDUCER),
    "recipe": click.option("--recipe", metavar="FILE", help="Every setting, from a TOML file."),
}


def _choice(reducer: str | None, recipe: str | None, **settings: Any) -> RecipeChoice:
    if reducer and recipe:
        raise click.UsageError("--reducer and --recipe exclude each other; a recipe names its reducer.")
    return RecipeChoice(reducer, recipe, given(**settings))


policy_options = gathered("settings", given, SETTINGS)
recipe_options = gathered("choice", _choice, RECIPE | SETTINGS)


@dataclass(frozen=True)
class DataChoice:
    """Which data set was asked for; how : what was given of the ways to read it, as `load_dataset` calls them."""

    data: str
    how: Mapping[str, Any]

    def load(self, quiet: bool = False) -> Dataset:
        """The data set; what was left out of it is said on stderr, or not. DataError for what cannot be read."""
        from ..datasets import load_dataset

        data = load_dataset(self.data, **self.how)
        for line in [] if quiet else left_out(data, 3):
            click.echo(line, err=True)
        return data


def left_out(data: Dataset, most: int) -> list[str]:
    """What could not be read, a line each for the first few; none where all could."""
    n = len(data.faults)
    rest = [f"- and {n - most} more"] if n > most else []
    title = f"Left out {n} of {n + len(data)} recordings of {data.name}:"
    return [title, *(f"- {fault}" for fault in data.faults[:most]), *rest] if n else []


_SAMPLES = "Use only the first so many samples of each trace: decides earlier, on less.  [default: all]"
_CHANNEL = "FZ_Base, or several with commas between.  [default: FZ_Base, or the only one]"
_LABEL = (
    "In a folder a regular expression whose group is the label, as in '_(OK|NOK)_'; in a table its column.  "
    "[default: True/False, OK/NOK, ... at the end of a file's name; y or label]"
)
_FIT = "What becomes of traces of another length.  [default: strict where all are alike, else pad]"
_RATE = click.FloatRange(0.0, min_open=True)
_TRIGGER = (
    "When an insertion begins in an .mcap file, or on a robot: contact=5 (newtons), register@NAME (not zero), bit=0 (a "
    "digital output), motion=0.01 (m/s)."
)
_PART = "The array or column of parts' numbers, if any: a part that comes again has one vote.  [default: part]"
_DATA = (
    "The bundled set, insertion; a folder of CSV files, one an insertion, its label in its name; or a wide .csv or "
    ".parquet, .npz or .h5: X (traces, samples) and y (1 success, 0 failure); .mcap by --trigger; or a store's .db."
)
DATA = {
    "samples": click.option("--samples", type=COUNT, help=_SAMPLES),
    "channel": click.option("--channel", metavar="NAMES", help=_CHANNEL),
    "label": click.option("--label", metavar="PATTERN", help=_LABEL),
    "labels": click.option("--labels", metavar="FILE", help="For a folder, a CSV file of file names and labels."),
    "fit": click.option("--fit", type=Known("fit"), help=_FIT),
    "rate_hz": click.option("--rate", "rate_hz", type=_RATE, metavar="HZ", help="Instead of what timestamps tell."),
    "trigger": click.option("--trigger", metavar="TEXT", help=_TRIGGER),
    "topic": click.option("--topic", metavar="NAME", help="Of the wrench in an .mcap file.  [default: the only one]"),
    "part": click.option("--part", metavar="KEY", help=_PART),
}


def data_options(default: str | None = "insertion", argument: bool = False) -> Callable[[Command], Command]:
    """`--data`, or DATA, and how it is read, handed on as one `DataChoice`, `source`."""
    metavar, shown = "NAME|FILE|FOLDER", {"default": default, "show_default": True}
    option = click.option("--data", metavar=metavar, help=_DATA, **({"required": True} if default is None else shown))
    named = click.argument("data", metavar=metavar) if argument else option
    return gathered("source", lambda data, **how: DataChoice(data, given(**how)), {"data": named} | DATA)


def n_jobs_option(default: int, text: str) -> Callable[[Command], Command]:
    """`--n-jobs`, processes as joblib counts them."""

    def checked(context: click.Context, option: click.Parameter, n_jobs: int) -> int:
        if n_jobs == 0:
            raise click.BadParameter("expected 1 or more, or -1 for one a core, got 0.")
        return n_jobs

    return click.option("--n-jobs", type=int, default=default, show_default=True, callback=checked, help=text)


def must_have_mujoco() -> None:
    """SettingError where the simulated cell cannot run; asked before anything is made or begun."""
    if find_spec("mujoco") is None:
        raise SettingError('Expected MuJoCo for the simulated cell, it is not installed: pip install "dengine[sim]".')


@dataclass(frozen=True)
class OutFolder:
    """Where a verb's CSV and pictures go; force : replace the files that are there; files : those written so far."""

    path: Path
    force: bool = False
    files: list[Path] = field(default_factory=list)

    def table(self, frame: pd.DataFrame, name: str) -> None:
        """Write a table as CSV."""
        from ..experiments.tables import write_csv

        self.files.append(write_csv(frame, self.path / name, self.force))

    def picture(self, figure: Any, name: str) -> None:
        """Write a picture."""
        from ..experiments.figures import save

        self.files.append(save(figure, self.path / name, force=self.force))


@contextmanager
def written(out: OutFolder | None, write: Callable[[OutFolder], None]) -> Iterator[list[Path]]:
    """Gives the files that were written, and their manifest; a refusal is raised once what was computed has been shown."""
    from ..files import write_manifest

    refusal: DengineError | None = None
    files: list[Path] = []
    try:
        if out is not None:
            write(out)
            files = [*out.files, write_manifest(out.path, out.files, out.force)]
    except DengineError as error:
        refusal = error
    yield files
    if refusal is not None:
        raise refusal


_OUT = "Folder for the CSV and the pictures; made if need be."
_KEEP = "Finished replays are kept here, and not played again: an interrupted run goes on, other costs come at once."
_SCENARIO = "What changes while the simulated cell runs: nominal (nothing), wear, variant or bias_jump."
_SEED = "An integer; the same seed, the same run."
json_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON document and nothing else.")
force_option = click.option("--force", is_flag=True, help="Replace the files that are there; a store never is.")
out_option = gathered(
    "out",
    lambda out, force: None if out is None else OutFolder(out, force),
    {"out": click.option("--out", type=FOLDER, help=_OUT), "force": force_option},
)
out_file_option = click.option("--out", type=FILE, help="A picture, .png, .pdf or .svg, drawn into this file.")
keep_option = click.option("--keep", type=FOLDER, metavar="FOLDER", help=_KEEP)
seed_option = click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help=_SEED)
scenario_option = click.option("--scenario", default="nominal", show_default=True, help=_SCENARIO)
store_argument = click.argument("store", metavar="STORE")


def example(command: str) -> str:
    """The end of a verb's help."""
    return f"\b\nExample:\n  {command}"
