"""Options that several verbs share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

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
        return Path(self.recipe).stem if self.recipe else self.reducer or "conv"

    @property
    def asked(self) -> bool:
        """Whether any of it was given."""
        return any(value is not None for value in (self.reducer, self.recipe, self.alpha, self.lower_bound))

    def load(self, name: str | None = None) -> Recipe:
        """The recipe, or the one of another name with this policy."""
        from ..recipe import Recipe

        policy = {"alpha": self.alpha, "lower_bound": self.lower_bound}
        given = {key: value for key, value in policy.items() if value is not None}
        return Recipe.load(name or self.recipe or self.reducer or "conv").with_policy(**given)


def policy_options(command: Command) -> Command:
    """`--alpha` and `--lower-bound`."""
    for option in (
        click.option(
            "--lower-bound",
            type=click.FloatRange(0.5, 1.0, min_open=True, max_open=True),
            help="The paper's LB: accept where the bound is above it.  [default: the recipe's]",
        ),
        click.option(
            "--alpha",
            type=click.FloatRange(0.0, 1.0, min_open=True, max_open=True),
            help="Two-sided error level of the confidence bound.  [default: the recipe's]",
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
    with_reducer = click.option("--reducer", metavar="NAME", help="conv, umap, pca, ...  [default: conv]")
    return with_reducer(with_recipe(policy_options(chosen)))


def data_options(default: str | None = "insertion") -> Callable[[Command], Command]:
    """`--data` and `--samples`, handed on as two; `read` makes a data set of them."""

    def decorate(command: Command) -> Command:
        command = click.option("--samples", type=click.IntRange(1), help="Cut traces to so many samples: earlier, harder.")(
            command
        )
        shown: dict[str, Any] = {"required": True} if default is None else {"default": default, "show_default": True}
        return click.option("--data", metavar="NAME|FILE", help="Bundled set, or an .npz file with X and y.", **shown)(
            command
        )

    return decorate


def read(data: str, samples: int | None) -> Dataset:
    """The data set that the options name."""
    from ..datasets import load_dataset

    return load_dataset(data, samples)


json_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON document and nothing else.")
out_option = click.option(
    "--out", type=click.Path(file_okay=False, path_type=Path), help="Folder for the CSV and the pictures."
)
seed_option = click.option(
    "--seed", type=click.IntRange(0), default=0, show_default=True, help="The same seed, the same run."
)


def example(command: str) -> str:
    """The end of a verb's help."""
    return f"\b\nExample:\n  {command}"
