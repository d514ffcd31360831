"""`dengine train`: recorded, labelled traces into a store, and a model from them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING

import click

from . import options
from .options import DataChoice, RecipeChoice, short_name
from .output import Asked, EndAskedError, end_interrupted, imported_line, interruptible, progress, show, write_json

if TYPE_CHECKING:
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
    from ..datasets.importing import form_in, import_labelled, train_until_done
    from ..engine.engine import DataEngine
    from ..experiments.tables import retrain_line
    from ..store.base import UNHURRIED

    before = form_in(store, source.data)  # of what the store has, where no other form was asked for
    data = replace(source, how={**before, **source.how}).load(quiet=as_json)
    reports: list[RetrainReport] = []
    recipe, interrupted = choice.if_asked(), False

    def trained(report: RetrainReport) -> None:
        reports.append(report)
        count(1)

    with interruptible() as asked:
        try:
            with _steps(f"importing {data.name}", len(data), as_json, asked) as count:
                imported = import_labelled(store, data, recipe, seed, count)
        except EndAskedError as end:
            there = f"{end.args[0]} of {len(data)} traces are in {store}"
            end_interrupted(f"Interrupted: {there}; the same command goes on from there.")
        with DataEngine.open(store, wait=UNHURRIED) as engine:
            try:
                with _steps("training", retrains, as_json, asked) as count:
                    train_until_done(engine, retrains, trained)
            except EndAskedError:
                interrupted = True
            name, labels = short_name(engine.recipe.name), engine.store.status()["labels"]
    if as_json:
        about = {"verb": "train", "store": store, "interrupted": interrupted, "faults": data.faults}
        write_json(about | {"import": imported, "retrains": reports})
    else:
        version, kind = reports[-1].version, "a used store" if imported.resumed else "a new store"
        answers = f"Version {version} of {name} answers. {retrain_line(reports)}"
        answers = answers if version else "No version answers yet: every part is verified."
        show(imported_line(imported, f"{store}, {kind}"), answers, f"{store} holds {labels} labels.")
    if interrupted:
        end_interrupted(f"Interrupted after {len(reports)} of at most {retrains} retrains; they are in {store}.")
    if not reports[-1].accepted:
        raise click.ClickException(f"The last retrain was {reports[-1].reason}.")


@contextmanager
def _steps(title: str, total: int, quiet: bool, asked: Asked) -> Iterator[Callable[[int], None]]:
    """A bar whose every step ends the work with EndAskedError(steps done) where Ctrl-C asked for it before the last."""
    done = 0
    with progress(title, total, quiet) as advance:

        def count(n: int) -> None:
            nonlocal done
            done += n
            advance(n)
            if asked() and done < total:
                raise EndAskedError(done)

        yield count
