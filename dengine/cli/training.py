"""`dengine train`: recorded, labelled traces into a store, and a model from them."""

from __future__ import annotations

import click

from .options import RecipeChoice, data_options, example, json_option, read, recipe_options
from .output import progress, show, write_json

RETRAINS = 10


@click.command(epilog=example("dengine train --data insertion --store engine.db --reducer conv"))
@data_options(None)
@click.option("--store", required=True, metavar="FILE|URL", help="Made where it does not exist.")
@recipe_options
@click.option("--seed", type=click.IntRange(0), help="Of a new store's engine.  [default: 0]")
@click.option(
    "--retrains",
    type=click.IntRange(1),
    default=RETRAINS,
    show_default=True,
    help="At most, each within the budget and going on from the last; one is enough for umap and pca.",
)
@json_option
def train(
    choice: RecipeChoice, data: str, samples: int | None, store: str, seed: int | None, retrains: int, as_json: bool
) -> None:
    """Import labelled traces into a store and train an engine on it.

    Each trace counts once, however often its file is imported. A bad trace (not finite, constant) is kept, but never
    trained on. A store that has been used keeps its own recipe and seed.
    """
    from ..engine import DataEngine
    from ..experiments.tables import retrain_line
    from ..importing import import_labelled, train_until_done

    dataset = read(data, samples)
    recipe = choice.load() if choice.asked else None
    with progress(f"importing {dataset.name}", len(dataset), as_json) as advance:
        imported = import_labelled(store, dataset, recipe, seed, advance)
    with DataEngine.open(store) as engine, progress("training", retrains, as_json) as advance:
        reports = train_until_done(engine, retrains, lambda report: advance(1))
        status, answering = engine.store.status(), engine.recipe
    if as_json:
        write_json({"verb": "train", "store": store, "import": imported, "retrains": reports})
    else:
        resumed = "a used store" if imported.resumed else "a new store"
        show(
            f"Imported {imported.imported} traces into {resumed}, {imported.quarantined} more into quarantine; "
            f"{imported.known} were known from an earlier import.",
            f"Version {reports[-1].version} of {answering.reducer} answers. {retrain_line(reports)}",
            f"{store} holds {status['labels']} labels.",
        )
    if not reports[-1].accepted:
        raise click.ClickException(f"The last retrain was {reports[-1].reason}.")
