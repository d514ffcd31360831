"""Options that several subcommands share, their types, and the records that these receive for them.

Options that belong together reach a subcommand as one argument: `RecipeChoice` (which recipe, with
which settings), `DataChoice` (which data set, read how), a store's address, or an `Out`.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import wraps
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import click

from ..errors import SettingError, StoreError, as_options
from .output import Out, as_json, json_option, progress_bar

if TYPE_CHECKING:
    from ..datasets import Dataset, Description
    from ..experiments.replay import Contender
    from ..recipe import Recipe
    from ..records import TraceSpec

Command = Callable[..., Any]
Option = Callable[[Command], Command]
Options = Mapping[str, Any]  # the values of options, by name
Values = dict[str, Any]  # the same, to be changed
FILE = click.Path(dir_okay=False, path_type=Path)
FOLDER = click.Path(file_okay=False, path_type=Path)
COUNT = click.IntRange(1)
ALPHA = click.FloatRange(0.0, 1.0, min_open=True, max_open=True)
LOWER_BOUND = click.FloatRange(0.5, 1.0, min_open=True, max_open=True)
# What may be given instead of a name.
OWN_RULE = "module:Class"
OWN_RECIPE = "FILE.toml|module:Class"


def example_epilog(example: str) -> str:
    """Return the end of a help text: a line "Example:", and below it the command `example`.

    The control character at its start keeps click from joining the two lines.
    """
    return f"\b\nExample:\n  {example}"


def verb(example: str) -> Callable[[Command], click.Command]:
    """Return a decorator that makes a function a subcommand, a `click.Command`.

    It adds the flag `--json`, which the function does not get as an argument (see `as_json`). The
    help is the function's docstring, the options, and at the end the command line `example`.
    """
    return lambda command: click.command(epilog=example_epilog(example))(json_option(command))


def names_of(kind: str) -> tuple[str, ...]:
    """Return the names that an option of this kind accepts, such as "wilson" for an interval.

    They are in the order in which their modules list them. The modules that define them are
    imported only when this is called.

    Parameters
    ----------
    kind : str
        guarantee (the decision rule), interval, stops (which bad accepted parts stop the system),
        recipe (a named set of all settings), method (a recipe or a baseline, a published method for
        comparison), fit (what is done with live traces of another length), label, action or reason
        (of a decision). Any other kind is a KeyError.
    """
    from ..decision.intervals import INTERVALS
    from ..decision.policy import RULES, Stops
    from ..experiments.baselines import BASELINES
    from ..recipe import RECIPES
    from ..records import FITS, Action, Reason
    from ..store.views import LABELS

    names: dict[str, Iterable[str]] = {
        "guarantee": RULES,
        "interval": INTERVALS,
        "stops": get_args(Stops),
        "recipe": RECIPES,
        "method": [*RECIPES, *BASELINES],
        "fit": FITS,
        "label": LABELS,
        "action": [action.value for action in Action],
        "reason": [reason.value for reason in Reason],
    }
    return tuple(names[kind])


class NameChoice(click.ParamType[Any]):
    """The type of an option that takes one of the names of a kind, see `names_of`.

    Parameters
    ----------
    kind : str
    custom : str, default ""
        How the user's own object may be given instead, for the help. Such a value has a dot, colon
        or slash in it. "" accepts the names only.
    """

    name = "name"

    def __init__(self, kind: str, custom: str = "") -> None:
        self.kind = kind
        self.custom = custom

    def get_metavar(self, param: click.Parameter, ctx: click.Context | None = None) -> str:
        return f"[{'|'.join(filter(None, [*names_of(self.kind), self.custom]))}]"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Return the value if it is one of the names; fail with a usage error for any other value.

        If the option takes an object of the user's own, a value with a dot, colon or slash is
        returned unchecked.
        """
        names = names_of(self.kind)
        if value not in names and not (self.custom and {".", ":", "/"} & set(value)):
            custom = f", or {self.custom} of your own" if self.custom else ""
            self.fail(f"{value!r} is not one of {', '.join(map(repr, names))}{custom}.", param, ctx)
        return str(value)


class CommaList(click.ParamType[Any]):
    """The type of an option that takes values with commas between: "0.5,0.1" -> (0.5, 0.1).

    Parameters
    ----------
    item_type : click.ParamType
        Converts each value.
    """

    name = "list"

    def __init__(self, item_type: click.ParamType[Any]) -> None:
        self.item_type = item_type

    def get_metavar(self, param: click.Parameter, ctx: click.Context) -> str:
        if isinstance(self.item_type, NameChoice):
            return f"{self.item_type.get_metavar(param, ctx)},..."
        return "LIST"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[Any, ...]:
        """Return the converted values as a tuple; a usage error if there is none or one is wrong.

        White space around an item is removed, and empty items are left out; an item that comes
        twice is kept twice. A tuple, such as a default, is returned as it is.
        """
        if isinstance(value, tuple):
            return value
        items = [item.strip() for item in value.split(",") if item.strip()]
        if not items:
            self.fail("expected at least one value, with commas between.", param, ctx)
        return tuple(self.item_type.convert(item, param, ctx) for item in items)


def bundle_options(into: str, make: Callable[..., Any], options: Mapping[str, Option]) -> Option:
    """Return a decorator that adds options and hands them to the subcommand as one argument.

    The subcommand's other arguments, passed by name, reach it unchanged. The help lists the options
    in their order in `options`. What `make` raises is raised before the subcommand begins. Options
    that were not given and have no default are left out; False, 0 and "" were given.

    Parameters
    ----------
    into : str
        Name of the subcommand's argument.
    make : callable
        Takes the options' values by their names, and returns that argument.
    options : mapping of str to option
        The decorator that adds each option, by the name of the option's value.
    """

    def decorate(command: Command) -> Command:
        """Return the command with the options, and with one argument `into` in their place."""

        @wraps(command)
        def bundled(**values: Any) -> Any:
            taken = {name: values.pop(name) for name in options}
            given = {name: value for name, value in taken.items() if value is not None}
            return command(**{into: make(**given)}, **values)

        decorated: Command = bundled
        for option in reversed(list(options.values())):
            decorated = option(decorated)
        return decorated

    return decorate


def _address(
    store: str | None = None, cell_id: str | None = None, product: str | None = None
) -> str | None:
    """Return a store's address: its file or URL, or a `CellAddress` that also names a robot cell.

    It is a `CellAddress` if a robot cell or a product (the kind of part that several cells make) is
    given; it has the file or URL and both names. If only a product is given, the cell is named
    "cell". The address is None without a store; a cell or product is a usage error then.
    """
    from ..store.records import address

    if store is not None:
        return address(store, cell_id, product)
    if cell_id or product:
        raise click.UsageError(
            "--cell-id and --product need a store; give one with --store FILE|URL."
        )
    return None


_CELL_ID = "The cell, if the store holds several; `dengine status` lists them.  [default: cell]"


def existing_store(store: Option) -> Option:
    """Return a decorator that adds the option `store` and `--cell` to a subcommand.

    The subcommand gets both as one address, its argument `store`.

    Parameters
    ----------
    store : option
        The argument or option that takes the store's file or URL.
    """
    cell = click.option("--cell", "--cell-id", "cell_id", metavar="NAME", help=_CELL_ID)
    return bundle_options("store", _address, {"store": store, "cell_id": cell})


store_argument = existing_store(click.argument("store"))


def store_option(text: str, *names: str, required: bool = False) -> Option:
    """Return a decorator that adds `--store`, `--cell-id` and `--product` to a subcommand.

    The subcommand gets them as one address, its argument `store`: the file or URL, with the names
    of a robot cell and of its product (the kind of part that several cells make) if one is given.
    Whether the store exists is not checked. The address is None without `--store`. A cell or
    product without `--store` is a usage error.

    Parameters
    ----------
    text : str
        Help of `--store`.
    *names : str
        Further names of `--cell-id`.
    required : bool, default False
        Whether `--store` must be given.
    """
    return bundle_options(
        "store",
        _address,
        {
            "store": click.option("--store", required=required, metavar="FILE|URL", help=text),
            "cell_id": click.option(*names, "--cell-id", "cell_id", metavar="NAME", help=_CELL_ID),
            "product": click.option(
                "--product",
                metavar="NAME",
                help=(
                    "What the cell makes: cells of one product share labels and versions.  "
                    "[default: as the store says]"
                ),
            ),
        },
    )


def short_name(name: str) -> str:
    """Return a recipe's name for tables and files: folder/often.toml -> often, m:Class -> Class.

    A plain name, like conv, is returned as it is.
    """
    return Path(name.rpartition(":")[2]).stem


@dataclass(frozen=True)
class RecipeChoice:
    """The recipe that the user asked for.

    Parameters
    ----------
    name : str or None
        As given to `--reducer`; None if it was not given.
    settings : mapping
        The settings of a policy, and `novelty` (the margin of the novelty gate), that were given
        beside it, by name.
    """

    name: str | None
    settings: Options

    def load_if_given(self, store: str | None) -> Recipe | None:
        """Return the recipe if a name or a setting was given; None means the store's own recipe.

        A recipe is all settings of an engine. It is the named one (conv if no name was given) with
        the settings that were given. But if `store` was used before, and the name is that of its
        reducer or was not given, it is the store's recipe with the settings that were given: the
        others stay as stored. A store that is missing or cannot be opened is taken for new. Raises
        SettingError if a recipe or its reducer is not found or cannot be read, also the stored
        recipe, and if a setting is out of range.
        """
        from ..recipe import Recipe
        from ..store.opening import open_store

        if not (self.name or self.settings):
            return None
        recipe = self.make_contender().recipe
        texts: Mapping[str, str] = {}
        if store:
            with suppress(StoreError), open_store(store, must_exist=True) as opened:
                texts = opened.settings.read()
        if "recipe" in texts:
            stored = Recipe.from_store(texts)
            if self.name in (None, stored.reducer):
                recipe = self._with_settings(stored)
        return recipe

    def _with_settings(self, recipe: Recipe) -> Recipe:
        """Return a recipe with the settings that were given; SettingError for one out of range."""
        policy = dict(self.settings)
        novelty = policy.pop("novelty", None)
        return recipe.with_policy(**policy).with_settings(novelty=novelty)

    def make_contender(self) -> Contender:
        """Return the `Contender` that a replay runs: a recipe or a baseline, with its name.

        A recipe is all settings of an engine, and a baseline a published method, for comparison. A
        replay lets one of them decide on recorded parts. The result is what `Contender.load`
        returns for the name (conv if none was given), with the settings that were given. Its name
        is shortened: folder/often.toml becomes often, and module:Class Class.

        Raises
        ------
        SettingError
            The recipe or its reducer (it maps traces to points) is not found or cannot be read, or
            a setting is out of range. This is checked here, before a store is created; a reducer of
            the user's own, given as module:Class, is imported for that, but a decision rule of the
            user's own is not.
        """
        from ..experiments.replay import Contender
        from ..reducers import REDUCERS, reducer_class

        name = self.name or "conv"
        contender = Contender.load(name)
        recipe = self._with_settings(contender.recipe)
        if recipe.reducer not in REDUCERS:
            reducer_class(recipe.reducer)
        return replace(contender, name=short_name(name), recipe=recipe)


# No option of a policy has a default here: the recipe, or the store, has it.
POLICY = {
    "alpha": click.option(
        "--alpha",
        type=ALPHA,
        help=(
            "Two-sided error level of the confidence bound, a probability.  [default: the recipe's]"
        ),
    ),
    "lower_bound": click.option(
        "--lower-bound",
        type=LOWER_BOUND,
        help=(
            "LB, a share of parts: 0.95 tolerates 5 % of bad parts among the accepted parts.  "
            "[default: the recipe's]"
        ),
    ),
    "guarantee": click.option(
        "--guarantee",
        type=NameChoice("guarantee", OWN_RULE),
        help=(
            "local: LB applies to the neighbourhood of each part. pooled: it applies to all "
            "parts together that reach the rule's threshold. cost: accept if that should cost "
            "less than a check, by --prices. Or a rule of your own."
        ),
    ),
    "stops": click.option(
        "--stops",
        type=NameChoice("stops"),
        help=(
            "Which bad accepted parts stop the system: some, or all. With all, an "
            "accepted part that no stop follows counts as good."
        ),
    ),
    "audit_rate": click.option(
        "--audit-rate",
        type=click.FloatRange(0.0, 1.0, max_open=True),
        metavar="SHARE",
        help=(
            "Share of the parts that the model is certain of and that are verified all "
            "the same; without audits nothing is known of rejected parts."
        ),
    ),
    "prices": click.option(
        "--prices",
        type=CommaList(click.FloatRange(0.0)),
        help=(
            "The prices of a check, of a bad accepted part and of a good rejected part, in "
            "one unit, like 0.5,200,5. Without --guarantee they imply --guarantee cost and "
            "--audit-rate 0.05.  [default: 5,120,47.5]"
        ),
    ),
    "force_limits": click.option(
        "--force-limit",
        "force_limits",
        metavar="START:END:LOW:HIGH[:reject][:channel=FZ][:along=Z]",
        multiple=True,
        # None where the option was not given; an empty tuple removes all limits of a recipe.
        callback=lambda _, option, values: tuple(filter(None, values)) if values else None,
        help=(
            "Verify a part whose force leaves limits between two times, in seconds. LOW "
            "or HIGH may be empty; :reject rejects the part; '' removes all limits."
        ),
    ),
}
SETTINGS = POLICY | {
    "novelty": click.option(
        "--novelty",
        type=click.FloatRange(0.0),
        metavar="FACTOR",
        help=(
            "Margin of the novelty test, which verifies traces unlike the learned ones: with "
            "a larger margin more traces pass; 0: off."
        ),
    )
}
RECIPE = {
    "name": click.option(
        "--reducer",
        "--recipe",
        "name",
        type=NameChoice("recipe", OWN_RECIPE),
        help=(
            "All settings: by a reducer's name, from a TOML file, or with a reducer of "
            "your own.  [default: conv]"
        ),
    )
}


policy_options = bundle_options("settings", dict, SETTINGS)
recipe_options = bundle_options(
    "choice", lambda name=None, **given: RecipeChoice(name, given), RECIPE | SETTINGS
)


@dataclass(frozen=True)
class DataChoice:
    """The data set that the user asked for.

    Parameters
    ----------
    data : str
        A name, file or folder, as `load_dataset` takes it.
    description : Path or None
        The file of its description; None: the one that was saved.
    stated : mapping
        Keys of the description that were stated, like `label.column`.
    options : mapping
        `channel` and `samples`, and the options of live traces, those that were given.
    """

    data: str
    description: Path | None
    stated: Options
    options: Options

    @property
    def path(self) -> Path:
        """Where the description is saved: the file that was given, else the default beside or in
        the data (`saved_description`). It need not exist.
        """
        from ..datasets.loading import saved_description

        return self.description or saved_description(self.data)

    def describe(self, *, propose: bool = False) -> Description | None:
        """Return the description with the stated keys; None for a source that needs none.

        A description says how recordings are read. A bundled set (data that come with dengine), the
        file of a store, and a file of traces and labels that dengine reads by itself (such as an
        .npz file with X and y) need none, unless a key is stated, or a description is given, or one
        is saved beside the file. A progress bar is shown while the description is read or proposed.
        Nothing is saved.

        Parameters
        ----------
        propose : bool
            If no description is given or saved, or one with `?` in it that is not stated: True
            proposes one, in which `?` marks what is open; False raises DataError, whose message
            says what to type.

        Raises
        ------
        DataError
            If the description cannot be read or proposed, or a stated key is unknown or its value
            has the wrong type. If the source does not exist or is damaged, or is a bundled set and
            a key is stated; but if a description without `?` is given, the source is not looked at.
        SettingError
            If one is proposed, and a stated `windows.trigger` (where a part begins) is malformed.
        """
        from ..datasets.loading import description_of, own_reader

        if not self.stated and not self.description and own_reader(self.data) is not None:
            return None
        with progress_bar(f"describing {self.data}", None):
            return description_of(self.data, self.description, self.stated, propose)

    def load(self, description: Description | None = None, quiet: bool = False) -> Dataset:
        """Load the data set, with a progress bar, and return it.

        It has only the channels and samples that the options `--channels` and `--samples` ask for.
        Its `notes`, and the first three recordings that were left out, are printed to stderr, but
        not with `--json` or if `quiet`. `description` says how recordings are read; None takes the
        one that `describe` returns. A damaged trace of a store is left out, and an event in the
        store's log says so.

        Raises
        ------
        DataError
            If the data set cannot be read, a channel does not exist, or the traces are shorter than
            `--samples`, or longer and resampled, so that they cannot be cut. Also if a description
            is needed and none is saved, if a value in it is `?` (not known yet), or if a stated key
            is unknown or its value has the wrong type.
        SettingError
            If `windows.trigger` of the description (where a part begins) is malformed, or
            `--channels` is given for a data set of which `Dataset.spec` cannot be made.
        StoreError
            If the data set is a store that cannot be opened or read.
        Exception
            What pandas raises for a damaged Parquet file of a table of `Dataset.to_frame`.
        """
        from ..datasets import load_dataset
        from ..datasets.read.files import as_source, find_files

        description = description or self.describe()
        n_files = len(find_files(as_source(self.data), description)) if description else 1
        with progress_bar(f"reading {self.data}", n_files) as advance:
            data = load_dataset(
                self.data,
                description,
                channels=self.options.get("channels"),
                samples=self.options.get("samples"),
                progress=advance,
            )
        if not (quiet or as_json()):
            for line in (*map(as_options, data.notes), *fault_lines(data, 3)):
                click.echo(line, err=True)
        return data


def fault_lines(data: Dataset, most: int) -> Iterator[str]:
    """Yield lines that list the faults of a data set, with the reasons.

    A fault is a recording or file that could not be read as its description says, or a recording
    that repeats another one. The first line counts the faults and all recordings, those without a
    label included. At most `most` faults are named, in their order, and a last line counts the
    other faults. Without faults there is no line.
    """
    n_faults = len(data.faults)
    if not n_faults:
        return
    n_recordings = n_faults + len(data) + data.unlabelled
    yield f"Left out {n_faults} of {n_recordings} recordings of {data.name}:"
    for fault in data.faults[:most]:
        yield f"- {as_options(str(fault))}"
    if n_faults > most:
        yield f"- and {n_faults - most} more"


CHOICE = {
    "samples": click.option(
        "--samples",
        type=COUNT,
        help="Use only this many samples from the start of each trace, which decides earlier.",
    ),
    "channels": click.option(
        "--channels",
        "--channel",
        type=CommaList(click.STRING),
        metavar="NAMES",
        help="FZ_Base, or several with commas between.  [default: those that are described]",
    ),
}
LIVE = {
    "rate_hz": click.option(
        "--rate-hz",
        type=click.FloatRange(0.0, min_open=True),
        metavar="HZ",
        help="Samples per second of live traces.",
    ),
    "unit": click.option("--unit", help="Unit of live traces, one for all channels or kN,mm."),
    "fit": click.option(
        "--fit",
        type=NameChoice("fit"),
        help="What to do with live traces of another length.  [default: strict]",
    ),
}
TRACE = CHOICE | LIVE
TRIGGER = {
    "trigger": click.option(
        "--trigger",
        help=(
            "When an insertion begins on a robot: contact=5 (newtons), register@NAME "
            "(not zero), bit=0 (a digital output), motion=0.01 (m/s)."
        ),
    )
}
DATA = CHOICE | {
    "description": click.option(
        "--description",
        type=FILE,
        help=(
            "What the recordings are.  [default: recordings.toml in a folder, FILE.toml "
            "beside a file]"
        ),
    ),
    "stated": click.option(
        "--set",
        "stated",
        metavar="KEY=VALUE",
        multiple=True,
        help=(
            "State a key of the description for this command, like label.column=verdict; "
            "the value is TOML, or a text. `dengine data` shows the keys."
        ),
    ),
}


def parse_stated(items: Iterable[str]) -> Values:
    """Return the values of `--set KEY=VALUE` by their keys, which stay texts like `label.column`.

    A value is read as TOML; if it is true, false or not valid TOML, it is the text itself. Only the
    first `=` of an item divides it, and white space around the key is removed. If a key comes
    twice, its last value counts. Whether there is such a key is not checked. Raises
    click.UsageError for an item without `=`, and for a text in brackets or braces that is not valid
    TOML.
    """
    stated = Values()
    for item in items:
        name, mark, text = item.partition("=")
        if not mark:
            raise click.UsageError(f"Expected --set KEY=VALUE, got {item!r}.")
        value: Any = text
        try:
            value = tomllib.loads(f"value = {text}")["value"]
        except tomllib.TOMLDecodeError:
            if text[:1] + text[-1:] in ("[]", "{}"):
                raise click.UsageError(
                    f"Expected TOML in --set {item}: texts in double quotes, and all of it in "
                    'single ones, as in --set \'label.bad=["crack", "burr"]\'.'
                ) from None
        # True and false may be words of labels; a key of type boolean takes the text, too.
        stated[name.strip()] = text if isinstance(value, bool) else value
    return stated


def data_options(
    default: str | None = "insertion", argument: bool = False, live: bool = False
) -> Option:
    """Return a decorator that adds `--data`, and the options that say how it is read.

    The subcommand gets them as one `DataChoice`, its argument `source`. These options are
    `--samples`, `--channels`, `--description` and `--set`.

    Parameters
    ----------
    default : str or None, default "insertion"
        Default of `--data`. None makes `--data` required.
    argument : bool, default False
        The data set is the subcommand's argument DATA, required, instead of an option; `default` is
        not used.
    live : bool, default False
        Whether to add the options of live traces, those that a robot cell records now: `--rate-hz`,
        `--unit`, `--fit` and `--trigger`.
    """
    metavar = "NAME|FILE|FOLDER"
    if argument:
        data = click.argument("data", metavar=metavar)
    else:
        need: Values = {"required": True} if default is None else {"default": default}
        data = click.option(
            "--data",
            metavar=metavar,
            help=(
                "The bundled set, insertion; a folder or file of recordings with its "
                "description (see `dengine data`); an .npz file with X (traces, samples) and "
                "y (1 success, 0 failure); or a store's .db."
            ),
            **need,
        )
    more = LIVE | TRIGGER if live else {}
    return bundle_options(
        "source",
        lambda data, stated, description=None, **given: DataChoice(
            data, description, parse_stated(stated), given
        ),
        {"data": data} | DATA | more,
    )


def recorder_settings(options: Options) -> tuple[Values, TraceSpec]:
    """Return the settings of an `RtdeRecorder`, by its argument names, and its `TraceSpec`.

    An `RtdeRecorder` records traces of a Universal Robots controller; a `TraceSpec` says what
    shape, rate and unit traces have. Both come from the values of `--samples`, `--channels`,
    `--rate-hz`, `--unit` and `--fit` in `options`, under samples, channels, rate_hz, unit and fit,
    as far as they were given; other options are ignored. The settings are samples, rate_hz and
    channels, and those that were not given are left out. The `TraceSpec` has the recorder's
    defaults for them (see `spec_of_recording`), and also the unit and the fit (what is done with
    traces of another length). Without `--unit` the unit of a force is N, and any other is unknown.
    Raises SettingError for values that no trace can have.
    """
    from ..cells.ur.recorder import spec_of_recording

    names = ("samples", "rate_hz", "channels")
    settings = {name: options[name] for name in names if name in options}
    form = {name: options[name] for name in ("unit", "fit") if name in options}
    return settings, replace(spec_of_recording(**settings), **form)


def trace_spec_from(options: Options) -> TraceSpec | None:
    """Return the `TraceSpec` of live traces that the options in `TRACE` state, None without them.

    It says what shape, rate and unit the traces have that a robot cell records. If `--channels` is
    one whole number, this is the number of channels; otherwise it has their names. Without it there
    is one channel.

    Parameters
    ----------
    options : mapping
        Values of the options that were given, by the names in `TRACE`. Other names are ignored.

    Returns
    -------
    trace_spec : TraceSpec or None
        None if no option was given: then the first trace sets it.

    Raises
    ------
    click.UsageError
        Options were given without `--samples`.
    SettingError
        For values that no trace can have, see `TraceSpec`.
    """
    from ..records import TraceSpec

    settings = {name: options[name] for name in TRACE if name in options}
    if not settings:
        return None
    if "samples" not in settings:
        raise click.UsageError(
            "Live traces need --samples too; without these options the first trace sets all."
        )
    names = settings.pop("channels", ())
    # `--channels 3` is a number of channels, not the name of one.
    if len(names) == 1 and names[0].isdecimal():
        return TraceSpec(**settings, channels=int(names[0]))
    return TraceSpec(**settings, channels=len(names) or 1, columns=names)


def n_jobs_option(default: int, text: str) -> Option:
    """Return a decorator that adds `--n-jobs`, a number of processes as joblib counts them.

    `default` is its default, and `text` its help. The value 0 is turned into -1, one process for
    each core.
    """
    return click.option(
        "--n-jobs",
        default=default,
        callback=lambda _, option, n_jobs: n_jobs or -1,
        help=text,
    )


def require_modules(purpose: str, extra: str, *modules: str) -> None:
    """Raise SettingError if one of the modules is not installed; nothing is imported.

    The message names the missing modules and the command that installs them.

    Parameters
    ----------
    purpose : str
        What they are needed for, for the message.
    extra : str
        Extra of dengine that installs them.
    *modules : str
        Names of the modules, without dots: for a name with a dot its package would be imported.
    """
    if missing := ", ".join(name for name in modules if find_spec(name) is None):
        raise SettingError(
            f'Expected {missing} for {purpose}, not installed: pip install "dengine[{extra}]".'
        )


allow_import_option = click.option(
    "--allow-import",
    is_flag=True,
    help=(
        "Import your own reducer and rule, module:Class, that STORE names. Only for "
        "a store that you trust."
    ),
)
verify_all_option = click.option(
    "--shadow",
    is_flag=True,
    help="Verify every part; what the model would have done is only recorded.",
)
force_option = click.option(
    "--force", is_flag=True, help="Replace files that exist; a store is never replaced."
)


def out_option(
    *names: str,
    kind: click.Path = FOLDER,
    text: str = "Folder for the CSV and the pictures; created if it is missing.",
) -> Option:
    """Return a decorator that adds `--out` and `--force`.

    The subcommand gets both as its argument `out`, an `Out`; it is None without `--out`. `names`
    are the files that the subcommand will write into the folder `--out`; the name "" is `--out`
    itself. Before the subcommand begins, OutputError is raised if one of them must not be written,
    for example because it exists and there is no `--force`, so that no work is lost. Files that are
    not named are only checked when they are written. `kind` is the type of the path, and `text` the
    help of `--out`.
    """

    def make_out(force: bool, out: Path | None = None) -> Out | None:
        """Return the `Out`, None without `--out`; OutputError if one of the files `names` must not
        be written. Nothing is created.
        """
        from ..files import check_output

        if out is None:
            return None
        for name in names:
            check_output(out / name, force)
        return Out(out, force)

    return bundle_options(
        "out", make_out, {"out": click.option("--out", type=kind, help=text), "force": force_option}
    )


picture_option = out_option(
    "", kind=FILE, text="Draw a picture into this file, .png, .pdf or .svg."
)
seed_option = click.option(
    "--seed",
    type=click.IntRange(0),
    default=0,
    help="An integer; the same seed gives the same run.",
)
new_seed_option = click.option(
    "--seed", type=click.IntRange(0), help="An integer; seed of a new store's engine.  [default: 0]"
)
check_option = click.option(
    "--check-seconds",
    type=click.FloatRange(0.0, 3600.0, min_open=True),
    default=5.0,
    metavar="S",
    help="How long a verification takes in your cell; every figure of time saved uses it.",
)
scenario_option = click.option(
    "--scenario",
    default="nominal",
    help="What changes in the simulated cell: nominal (nothing), wear, variant or bias_jump.",
)
