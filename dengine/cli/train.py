"""`dengine train`: recorded, labelled traces into a store, and a model from them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import click

from . import options
from .options import DataChoice, RecipeChoice, short_name
from .output import Asked, EndAskedError, end_interrupted, imported_line, interruptible, progress, show, write_json

if TYPE_CHECKING:
    from ..datasets import Dataset
    from ..datasets.importing import ImportReport
    from ..recipe import Recipe
    from ..records import RetrainReport

WITHIN = "At most so many, each within the recipe's seconds and going on from the last; umap and pca need but one."


@click.command(epilog=options.example("dengine train --data insertion --store engine.db --reducer conv"))
@options.data_options(None)
@click.option("--store", required=True, metavar="FILE|URL", help="Where the engine remembers; made if need be.")
@options.cell_options(product=True)
@options.recipe_options
@click.option("--seed", type=click.IntRange(0), help="An integer, of a new store's engine.  [default: 0]")
@click.option("--retrains", type=options.COUNT, default=10, show_default=True, help=WITHIN)
@options.json_option
def train(choice: RecipeChoice, source: DataChoice, store: str, seed: int | None, retrains: int, as_json: bool) -> None:
    """Import labelled traces into a store and train on them.

    Each trace counts once, however often its file is imported. A bad trace (not finite, constant) is kept, but never
    trained on. A store that has been used keeps its own recipe and seed. Ctrl-C keeps what was imported; the same
    command goes on from there.
    """
    from ..datasets.importing import form_in
    from ..experiments.tables import retrain_line

    before = form_in(store, source.data)  # of what the store has, where no other form was asked for
    dataset = replace(source, how=before | source.how).load(quiet=as_json)
    recipe = choice.if_asked()
    with interruptible() as asked:
        imported = _import(dataset, store, recipe, seed, as_json, asked)
        trained = _train(store, retrains, as_json, asked)
    if as_json:
        about = {"verb": "train", "store": store, "interrupted": trained.interrupted, "faults": dataset.faults}
        write_json(about | {"import": imported, "retrains": trained.reports})
    else:
        last = trained.reports[-1].version
        answers = f"Version {last} of {trained.reducer} answers. {retrain_line(trained.reports)}"
        kind = "a used store" if imported.resumed else "a new store"
        lines = (
            answers if last else "No version answers yet: every part is verified.",
            f"{store} holds {trained.labels} labels.",
        )
        show(imported_line(imported, f"{store}, {kind}"), *lines)
    if trained.interrupted:
        end_interrupted(f"Interrupted after {len(trained.reports)} of at most {retrains} retrains; they are in {store}.")
    if not trained.reports[-1].accepted:
        raise click.ClickException(f"The last retrain was {trained.reports[-1].reason}.")


@dataclass(frozen=True)
class Trained:
    """What came of the retrains, and the labels that the store holds now."""

    reports: list[RetrainReport]
    reducer: str
    labels: int
    interrupted: bool


def _import(
    dataset: Dataset, store: str, recipe: Recipe | None, seed: int | None, quiet: bool, asked: Asked
) -> ImportReport:
    from ..datasets.importing import import_labelled

    done = 0

    def count(n: int) -> None:
        nonlocal done
        done += n
        advance(n)
        if asked() and done < len(dataset):
            raise EndAskedError

    try:
        with progress(f"importing {dataset.name}", len(dataset), quiet) as advance:
            return import_labelled(store, dataset, recipe, seed, count)
    except EndAskedError:
        end_interrupted(
            f"Interrupted: {done} of {len(dataset)} traces are in {store}; the same command goes on from there."
        )


def _train(store: str, retrains: int, quiet: bool, asked: Asked) -> Trained:
    from ..datasets.importing import train_until_done
    from ..engine.engine import DataEngine
    from ..store.base import UNHURRIED

    reports: list[RetrainReport] = []

    def count(report: RetrainReport) -> None:
        reports.append(report)
        advance(1)
        if asked() and len(reports) < retrains:
            raise EndAskedError

    interrupted = False
    with DataEngine.open(store, wait=UNHURRIED) as engine:
        try:
            with progress("training", retrains, quiet) as advance:
                train_until_done(engine, retrains, count)
        except EndAskedError:
            interrupted = True
        return Trained(reports, short_name(engine.recipe.name), engine.store.status()["labels"], interrupted)
