"""Options that several verbs share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..errors import SettingError

if TYPE_CHECKING:
    from ..datasets import Dataset
    from ..recipe import Recipe

Command = Callable[..., Any]


@dataclass(frozen=True)
class RecipeChoice:
    """Which recipe was asked for, if any; None leaves a setting to the recipe, or to the store."""

    reducer: str | None
    recipe: str | None
    alpha: float | None
    lower_bound: float | None

    @property
    def name(self) -> str:
        """What to call it in a table."""
        return short_name(self.recipe or self.reducer or "conv")

    @property
    def asked(self) -> bool:
        """Whether any of it was given."""
        return any(value is not None for value in (self.reducer, self.recipe, self.alpha, self.lower_bound))

    def load(self, name: str | None = None) -> Recipe:
        """The recipe, or the one of another name with this policy. SettingError where its reducer cannot be found."""
        from ..recipe import Recipe
        from ..reducers import REDUCERS, reducer_class

        policy = {"alpha": self.alpha, "lower_bound": self.lower_bound}
        given = {key: value for key, value in policy.items() if value is not None}
        recipe = Recipe.load(name or self.recipe or self.reducer or "conv").with_policy(**given)
        if recipe.reducer not in REDUCERS:
            reducer_class(recipe.reducer)  # now, and not when a store was made for it
        return recipe


def short_name(name: str) -> str:
    """What to call a recipe in tables and file names: `folder/often.toml` is often, `module:Class` is Class."""
    return Path(name.rpartition(":")[2]).stem


def policy_options(command: Command) -> Command:
    """`--alpha` and `--lower-bound`."""
    for option in (
        click.option(
            "--lower-bound",
            type=click.FloatRange(0.5, 1.0, min_open=True, max_open=True),
            help="LB, a share of parts: 0.95 lets at most 5 % of the accepted parts be bad.  [default: the recipe's]",
        ),
        click.option(
            "--alpha",
            type=click.FloatRange(0.0, 1.0, min_open=True, max_open=True),
            help="Two-sided error level of the confidence bound, a probability.  [default: the recipe's]",
        ),
    ):
        command = option(command)
    return command


def recipe_options(command: Command) -> Command:
    """`--reducer` or `--recipe`, `--alpha` and `--lower-bound`, handed on as one `RecipeChoice`."""

    @wraps(command)
    def chosen(
        reducer: str | None, recipe: str | None, alpha: float | None, lower_bound: float | None, **others: Any
    ) -> Any:
        if reducer and recipe:
            raise click.UsageError("--reducer and --recipe exclude each other; a recipe names its reducer.")
        return command(choice=RecipeChoice(reducer, recipe, alpha, lower_bound), **others)

    with_recipe = click.option("--recipe", metavar="FILE", help="Every setting, from a TOML file.")
    with_reducer = click.option(
        "--reducer",
        metavar="NAME",
        help="conv, umap, pca, rocket, or module:Class of your own, looked for in this folder too.  [default: conv]",
    )
    return with_reducer(with_recipe(policy_options(chosen)))


def data_options(default: str | None = "insertion") -> Callable[[Command], Command]:
    """`--data` and `--samples`, handed on as two; `read` makes a data set of them."""

    def decorate(command: Command) -> Command:
        command = click.option(
            "--samples",
            type=click.IntRange(1),
            help="Use only the first so many samples of each trace: decides earlier, on less.  [default: all]",
        )(command)
        shown: dict[str, Any] = {"required": True} if default is None else {"default": default, "show_default": True}
        return click.option(
            "--data",
            metavar="NAME|FILE",
            help="The bundled set, insertion, or an .npz file: X (traces, samples) and y (1 success, 0 failure).",
            **shown,
        )(command)

    return decorate


def read(data: str, samples: int | None) -> Dataset:
    """The data set that the options name."""
    from ..datasets import load_dataset

    return load_dataset(data, samples)


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


json_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON document and nothing else.")
out_option = click.option(
    "--out", type=click.Path(file_okay=False, path_type=Path), help="Folder for the CSV and the pictures; made if need be."
)
seed_option = click.option(
    "--seed", type=click.IntRange(0), default=0, show_default=True, help="An integer; the same seed, the same run."
)
scenario_option = click.option(
    "--scenario",
    default="nominal",
    show_default=True,
    help="What changes while the simulated cell runs: nominal (nothing), wear, variant or bias_jump.",
)


def example(command: str) -> str:
    """The end of a verb's help."""
    return f"\b\nExample:\n  {command}"
