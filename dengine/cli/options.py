"""Options that several verbs share, and the records that verbs get of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import wraps
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import click

from ..errors import SettingError, as_options
from .output import Out, as_json, json_option

if TYPE_CHECKING:
    from ..datasets import Dataset
    from ..experiments.replay import Contender
    from ..recipe import Recipe
    from ..records import TraceSpec

Command = Callable[..., Any]
Option = Callable[[Command], Command]
FILE = click.Path(dir_okay=False, path_type=Path)
FOLDER = click.Path(file_okay=False, path_type=Path)
COUNT = click.IntRange(1)
ALPHA = click.FloatRange(0.0, 1.0, min_open=True, max_open=True)
LOWER_BOUND = click.FloatRange(0.5, 1.0, min_open=True, max_open=True)
RULE, OWN = "module:Class", "FILE.toml|module:Class"


def ends_in(example: str) -> str:
    """The end of a help."""
    return f"\b\nExample:\n  {example}"


def verb(example: str) -> Callable[[Command], click.Command]:
    """A command that speaks JSON, and whose help ends in an example."""
    return lambda command: click.command(epilog=ends_in(example))(json_option(command))


def names_of(kind: str) -> tuple[str, ...]:
    """What can be said where this is asked for: the keys of the package's own tables, read when they are needed."""
    from ..decision.intervals import INTERVALS
    from ..decision.policy import RULES, Stops
    from ..experiments.baselines import BASELINES
    from ..recipe import RECIPES
    from ..records import FITS, Action, Reason
    from ..store.views import LABELS

    known: dict[str, Iterable[str]] = {"guarantee": RULES, "interval": INTERVALS, "stops": get_args(Stops)}
    known |= {"recipe": RECIPES, "baseline": BASELINES, "method": [*RECIPES, *BASELINES], "fit": FITS, "label": LABELS}
    known |= {"action": [each.value for each in Action], "reason": [each.value for each in Reason]}
    return tuple(known[kind])


class Known(click.ParamType[Any]):
    """A name of a kind, see `names_of`; own : what else may be given, which has a dot, colon or slash in it."""

    name = "name"

    def __init__(self, kind: str, own: str = "") -> None:
        self.kind, self.own = kind, own

    def get_metavar(self, param: click.Parameter, ctx: click.Context | None = None) -> str:
        return f"[{'|'.join(filter(None, [*names_of(self.kind), self.own]))}]"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """The name; what is in no table is a usage error."""
        names = names_of(self.kind)
        if value not in names and not (self.own and {".", ":", "/"} & set(value)):
            own = f", or {self.own} of your own" if self.own else ""
            self.fail(f"{value!r} is not one of {', '.join(map(repr, names))}{own}.", param, ctx)
        return str(value)


class Listed(click.ParamType[Any]):
    """Values with commas between, as a tuple; each is what another type says."""

    name = "list"

    def __init__(self, of: click.ParamType[Any]) -> None:
        self.of = of

    def get_metavar(self, param: click.Parameter, ctx: click.Context) -> str:
        return f"{self.of.get_metavar(param, ctx)},..." if isinstance(self.of, Known) else "LIST"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[Any, ...]:
        """'0.5,0.1' -> (0.5, 0.1); a wrong one among them is a usage error."""
        if isinstance(value, tuple):
            return value
        parts = [part.strip() for part in str(value).split(",") if part.strip()]
        if not parts:
            self.fail("expected at least one value, with commas between.", param, ctx)
        return tuple(self.of.convert(part, param, ctx) for part in parts)


def gathered(into: str, make: Callable[..., Any], options: Mapping[str, Option]) -> Option:
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


def _address(store: str | None, cell_id: str | None, product: str | None = None) -> str | None:
    from ..store.records import address

    if store is None and (cell_id or product):
        raise click.UsageError("A cell and its product are known to a store: name it, --store FILE|URL.")
    return None if store is None else address(store, cell_id, product)


_WHOSE = "Whose rows of the store, where it holds several cells; `dengine status` lists them.  [default: cell]"
_PRODUCT = "What the cell makes: cells of one product share labels and versions.  [default: as the store says]"


def a_store(store: Option) -> Option:
    """A store that is there, and whose rows of it are meant."""
    whose = click.option("--cell", "--cell-id", "cell_id", metavar="NAME", help=_WHOSE)
    return gathered("store", _address, {"store": store, "cell_id": whose})


store_argument = a_store(click.argument("store", metavar="STORE"))


def store_option(text: str, *cell: str, required: bool = False) -> Option:
    """`--store`, which may be made, with its cell's id, by `--cell-id` and other names, and product."""
    options: dict[str, Option] = {
        "store": click.option("--store", required=required, metavar="FILE|URL", help=text),
        "cell_id": click.option(*cell, "--cell-id", "cell_id", metavar="NAME", help=_WHOSE),
        "product": click.option("--product", metavar="NAME", help=_PRODUCT),
    }
    return gathered("store", _address, options)


def short_name(name: str) -> str:
    """What to call a recipe in tables and file names: `folder/often.toml` is often, `module:Class` is Class."""
    return Path(name.rpartition(":")[2]).stem


@dataclass(frozen=True)
class RecipeChoice:
    """Which recipe was asked for, if any; settings : those that were given, of a policy or `novelty`."""

    asked: str | None
    settings: Mapping[str, Any]

    def load(self, base: Any = "conv") -> Recipe:
        """The recipe with these settings, or `base` with them. SettingError where its reducer cannot be found."""
        from ..recipe import Recipe
        from ..reducers import REDUCERS, reducer_class

        policy = {name: value for name, value in self.settings.items() if name != "novelty"}
        recipe = Recipe.load(self.asked or base).with_policy(**policy)
        recipe = recipe.with_settings(novelty=self.settings.get("novelty"))
        if recipe.reducer not in REDUCERS:
            reducer_class(recipe.reducer)  # now, and not when a store was made for it
        return recipe

    def if_asked(self) -> Recipe | None:
        """The recipe, where any of it was given; else the store's counts."""
        return self.load() if self.asked or self.settings else None

    def contender(self) -> Contender:
        """Who plays by it: dengine, or the baseline of that name in the same loop."""
        from ..experiments.replay import Contender

        if self.asked in names_of("baseline"):
            baseline = Contender.load(self.asked)
            return replace(baseline, recipe=RecipeChoice(None, self.settings).load(baseline.recipe))
        return Contender(short_name(self.asked or "conv"), self.load())


# What a policy is by default is the recipe's affair, or the store's.
_ALPHA = "Two-sided error level of the confidence bound, a probability.  [default: the recipe's]"
_LB = "LB, a share of parts: 0.95 lets at most 5 % of the accepted parts be bad.  [default: the recipe's]"
_GUARANTEE = (
    "What keeps to LB: the ball around each part, at one look (local); all its members together (pooled); or a rule of "
    "your own. With cost, what is expected to be cheaper than a check passes, by --prices."
)
_PRICES = "Of a check, a bad part accepted and a good one rejected, in one unit, under cost.  [default: 5,120,47.5]"
_STOPS = "Which bad accepted parts stop the system: some, or all; with all, one that no stop follows counts as good."
_AUDITS = "Share of what the model is certain of that is verified all the same; rejects are known by it alone."
_NOVELTY = "Verify a trace so many times less like the learned ones than these are like each other; 0: off."
_WINDOWS = "Verify what leaves limits between two times, in s; LOW or HIGH may be empty; :reject rejects; '' for none."
_WINDOW = "START:END:LOW:HIGH[:reject][:channel=FZ][:along=Z]"
_SHARE = click.FloatRange(0.0, 1.0, max_open=True)
_windows: Callable[..., Any] = lambda context, option, said: tuple(filter(None, said)) if said else None  # noqa: E731
POLICY = {
    "alpha": click.option("--alpha", type=ALPHA, help=_ALPHA),
    "lower_bound": click.option("--lower-bound", type=LOWER_BOUND, help=_LB),
    "guarantee": click.option("--guarantee", type=Known("guarantee", RULE), help=_GUARANTEE),
    "stops": click.option("--stops", type=Known("stops"), help=_STOPS),
    "audit_rate": click.option("--audit-rate", type=_SHARE, metavar="SHARE", help=_AUDITS),
    "prices": click.option("--prices", type=Listed(click.FloatRange(0.0)), help=_PRICES),
    "windows": click.option("--window", "windows", metavar=_WINDOW, multiple=True, callback=_windows, help=_WINDOWS),
}
SETTINGS = POLICY | {"novelty": click.option("--novelty", type=click.FloatRange(0.0), metavar="FACTOR", help=_NOVELTY)}
_REDUCER = "Every setting: by a reducer's name, from a TOML file, or with a reducer of your own.  [default: conv]"
RECIPE = {"asked": click.option("--reducer", "--recipe", "asked", type=Known("recipe", OWN), help=_REDUCER)}


policy_options = gathered("settings", given, SETTINGS)
recipe_options = gathered("choice", lambda asked, **settings: RecipeChoice(asked, given(**settings)), RECIPE | SETTINGS)


@dataclass(frozen=True)
class DataChoice:
    """Which data set was asked for; how : what was given of the ways to read it, as `load_dataset` calls them."""

    data: str
    how: Mapping[str, Any]

    def load(self) -> Dataset:
        """The data set; what was left out of it is said on stderr. DataError for what cannot be read."""
        from ..datasets import load_dataset

        data = load_dataset(self.data, **self.how)
        for line in [] if as_json() else (*map(as_options, data.notes), *left_out(data, 3)):
            click.echo(line, err=True)
        return data


def left_out(data: Dataset, most: int) -> list[str]:
    """What could not be read, a line each for the first few; none where all could."""
    n = len(data.faults)
    rest = [f"- and {n - most} more"] if n > most else []
    title = f"Left out {n} of {n + len(data) + data.unlabelled} recordings of {data.name}:"
    return [title, *(f"- {as_options(str(fault))}" for fault in data.faults[:most]), *rest] if n else []


_SAMPLES = "Of a trace: of recordings only the first so many, which decides earlier, on less.  [default: all]"
_CHANNELS = "FZ_Base, or several with commas between.  [default: FZ_Base, or the only one]"
_LABEL = (
    "In a folder a regular expression whose group is the label, as in '_(OK|NOK)_', or a column of its files; in a table "
    "its column, of .npz its array.  [default: True/False, OK/NOK, ... at the end of a file's name; y or label]"
)
_LABELS = "A CSV file of labels: of a folder's files, of a long table's parts, or of an .npz file's traces in their order."
_LABEL_MAP = "What other words mean, as in 'heil=good,Riss=bad'; 1=good,0=bad where a file's name ends in the label."
_TIME = (
    "The column of times: of a long table, a row a sample, whose --part tells the insertions, it needs both; or of "
    "recordings."
)
_HERTZ = "Samples a second.  [default: what timestamps tell; live: 500]"
_UNIT = "Of the samples; those whose own unit is another, kN for N, are converted.  [default: the header's, else N]"
_COLUMNS = "The names of the columns of text files without a header, as in time,fx,fz."
_DECIMAL = "The decimal mark in text files, . or ,  [default: as each file's cells tell]"
_THOUSANDS = "What groups thousands in text files, as the point in 1.043,5.  [default: as each file's cells tell]"
_FIT = "What becomes of traces of another length.  [default: strict where all are alike, else pad; live: strict]"
_NAMES = Listed(click.STRING)
_RATE = click.FloatRange(0.0, min_open=True)
_TRIGGER = (
    "When an insertion begins in an .mcap file, or on a robot: contact=5 (newtons), register@NAME (not zero), bit=0 (a "
    "digital output), motion=0.01 (m/s)."
)
_PART = "The array or column of parts' numbers, if any: a part that comes again has one vote.  [default: part]"
_DATA = (
    "The bundled set, insertion; a folder of CSV files, one an insertion, its label in its name; a .csv or .parquet, wide "
    "or long; .npz: X (traces, samples) and y (1 success, 0 failure); .mcap by --trigger; or a store's .db."
)
TRACE = {
    "samples": click.option("--samples", type=COUNT, help=_SAMPLES),
    "rate_hz": click.option("--rate-hz", type=_RATE, metavar="HZ", help=_HERTZ),
    "unit": click.option("--unit", metavar="TEXT", help=_UNIT),
    "channel": click.option("--channels", "--channel", "channel", type=_NAMES, metavar="NAMES", help=_CHANNELS),
    "fit": click.option("--fit", type=Known("fit"), help=_FIT),
}
DATA = TRACE | {
    "label": click.option("--label", metavar="PATTERN", help=_LABEL),
    "labels": click.option("--labels", metavar="FILE", help=_LABELS),
    "label_map": click.option("--label-map", metavar="WORDS", help=_LABEL_MAP),
    "columns": click.option("--columns", type=_NAMES, metavar="NAMES", help=_COLUMNS),
    "decimal": click.option("--decimal", metavar="MARK", help=_DECIMAL),
    "thousands": click.option("--thousands", metavar="MARK", help=_THOUSANDS),
    "time": click.option("--time", metavar="COLUMN", help=_TIME),
    "trigger": click.option("--trigger", metavar="TEXT", help=_TRIGGER),
    "topic": click.option("--topic", metavar="NAME", help="Of the wrench in an .mcap file.  [default: the only one]"),
    "part": click.option("--part", metavar="KEY", help=_PART),
}


def data_options(default: str | None = "insertion", argument: bool = False) -> Option:
    """`--data`, or DATA, and how it is read, handed on as one `DataChoice`, `source`."""
    metavar, shown = "NAME|FILE|FOLDER", {"default": default, "show_default": True}
    option = click.option("--data", metavar=metavar, help=_DATA, **({"required": True} if default is None else shown))
    named = click.argument("data", metavar=metavar) if argument else option
    return gathered("source", lambda data, **how: DataChoice(data, given(**how)), {"data": named} | DATA)


def recorded_as(how: Mapping[str, Any]) -> dict[str, Any]:
    """What a robot's recorder is told of TRACE, under its names."""
    names = {"samples": "samples", "rate_hz": "rate_hz", "channel": "channels"}
    return {name: how[option] for option, name in names.items() if option in how}


def trace_of(how: Mapping[str, Any]) -> TraceSpec | None:
    """The contract of live traces by those of TRACE that were given; None: the first trace sets it."""
    from ..records import TraceSpec

    asked = {name: how[name] for name in TRACE if name in how}
    names = asked.pop("channel", ())
    n = int(names[0]) if len(names) == 1 and names[0].isdecimal() else len(names) or 1
    if (asked or names) and "samples" not in asked:
        raise click.UsageError("--samples, too, is needed for a contract of traces; without it the first one sets it all.")
    return TraceSpec(**asked, channels=n, columns=names if names != (str(n),) else ()) if asked else None


def n_jobs_option(default: int, text: str) -> Option:
    """`--n-jobs`, processes as joblib counts them; 0, which it does not know, is one a core too."""
    one_a_core = lambda context, option, n_jobs: n_jobs or -1  # noqa: E731
    return click.option("--n-jobs", type=int, default=default, show_default=True, callback=one_a_core, help=text)


def must_have(what: str, extra: str, *needed: str) -> None:
    """SettingError where a module is missing; asked before anything is made or begun."""
    if missing := ", ".join(name for name in needed if find_spec(name) is None):
        raise SettingError(f'Expected {missing} for {what}, not installed: pip install "dengine[{extra}]".')


_SCENARIO = "What changes while the simulated cell runs: nominal (nothing), wear, variant or bias_jump."
_SEED = "An integer; the same seed, the same run."
_NEW_SEED = "An integer, of a new store's engine.  [default: 0]"
_ALLOW = "Import the reducer and the rule of one's own, module:Class, that STORE names: only of a store that you trust."
allow_import_option = click.option("--allow-import", is_flag=True, help=_ALLOW)
force_option = click.option("--force", is_flag=True, help="Replace the files that are there; a store never is.")


def _out_option(kind: click.Path, text: str) -> Option:
    options = {"out": click.option("--out", type=kind, help=text), "force": force_option}
    return gathered("out", lambda out, force: None if out is None else Out(out, force), options)


out_option = _out_option(FOLDER, "Folder for the CSV and the pictures; made if need be.")
picture_option = _out_option(FILE, "A picture, .png, .pdf or .svg, drawn into this file.")
seed_option = click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help=_SEED)
new_seed_option = click.option("--seed", type=click.IntRange(0), help=_NEW_SEED)
_CHECK = click.FloatRange(0.0, 3600.0, min_open=True)
_CHECKED = "That a verification takes in your cell, for every figure of time saved."
check_option = click.option("--check-seconds", type=_CHECK, default=5.0, show_default=True, metavar="S", help=_CHECKED)
scenario_option = click.option("--scenario", default="nominal", show_default=True, help=_SCENARIO)
