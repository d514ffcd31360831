"""`dengine status`: what a store holds."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import click

from .options import example, json_option
from .output import duration, show, write_json

if TYPE_CHECKING:
    from ..recipe import Recipe
    from ..records import RetrainReport


@click.command(epilog=example("dengine status engine.db"))
@click.argument("store", metavar="STORE")
@json_option
def status(store: str, as_json: bool) -> None:
    """Say what a store holds and what its engine decides by.

    STORE is the file or URL that the engine remembers in, as given to `dengine train` or `dengine run`.
    """
    settings, counts, retrains = _read(store)
    worst = max((r.seconds for r in retrains), default=None)
    if as_json:
        listed = [asdict(r) for r in retrains]
        write_json(
            {"verb": "status", "store": store} | counts | {"settings": settings, "worst_retrain_s": worst, "all": listed}
        )
        return
    show(_table(store, [*_settings_rows(settings), *_count_rows(counts), *_retrain_rows(retrains)]))


def _read(store: str) -> tuple[dict[str, str], dict[str, Any], list[RetrainReport]]:
    from ..errors import StoreError
    from ..store.base import open_store

    opened = open_store(store, must_exist=True)
    try:
        settings = opened.settings()
        if "recipe" not in settings:
            raise StoreError(f"Expected a store that an engine has used, {store} is empty.")
        return settings, opened.status(), opened.retrains()
    finally:
        opened.close()


def _table(store: str, rows: list[tuple[str, str]]) -> Any:
    from rich.table import Table

    table = Table(title=store, show_header=False, title_justify="left")
    table.add_column(style="bold", no_wrap=True)
    table.add_column(overflow="fold")
    for row in rows:
        table.add_row(*row)
    return table


def _settings_rows(settings: dict[str, str]) -> Iterator[tuple[str, str]]:
    from ..recipe import Recipe

    recipe, seed = Recipe.from_toml(settings["recipe"]), settings.get("seed", "0")
    # Of a model that was handed in, reducer and numbers of the recipe have no effect: to show them would be a lie.
    handed_in = settings.get("model")
    yield from _own_rows(recipe, seed) if handed_in is None else [("model", f"{handed_in}, decides by its own rule")]
    yield "audits", f"{100 * recipe.policy.audit_rate:g} % of what it is certain of"
    yield (
        "retrain",
        (f"every {recipe.retrain_every} new labels, within {duration(recipe.budget)}, on the newest {recipe.window:,}"),
    )
    yield "trace", _contract(settings.get("trace"))


def _own_rows(recipe: Recipe, seed: str) -> Iterator[tuple[str, str]]:
    policy = recipe.policy
    yield "reducer", f"{recipe.name}, seed {seed}"
    yield "policy", f"alpha {policy.alpha:g}, LB {100 * policy.lower_bound:g} %, {policy.interval} interval"
    yield "rule", policy.guarantee
    yield "neighbours", _neighbours(recipe)


def _neighbours(recipe: Recipe) -> str:
    if recipe.fraction is None:
        return f"within a radius of {recipe.radius:g}, in the unit of the scaled embedding"
    judged = "" if recipe.reject_fraction is None else f"; a rejection is judged by {100 * recipe.reject_fraction:g} %"
    return f"the nearest {100 * recipe.fraction:g} % of the references{judged}"


def _contract(trace: str | None) -> str:
    from ..records import TraceSpec

    if trace is None:
        return "none yet: the first trace sets it"
    spec = TraceSpec(**json.loads(trace))
    channels = "" if spec.channels == 1 else f"{spec.channels} channels of "
    limit = "" if spec.limit is None else f", sensor limit {spec.limit:g} {spec.unit}"
    seconds = duration(spec.samples / spec.rate_hz)
    return f"{channels}{spec.samples} samples at {spec.rate_hz:g} Hz ({seconds}), in {spec.unit}{limit}"


def _count_rows(counts: dict[str, Any]) -> Iterator[tuple[str, str]]:
    yield "cell", counts["cell_id"]
    yield "decisions", f"{counts['decisions']}: {_listed(counts['actions'])}"
    yield "reasons", _listed(counts["reasons"])
    yield "quarantined", str(counts["quarantined"])
    yield "labels", f"{counts['labels']}: {_listed(counts['sources'])}"
    yield "first, last", " to ".join(_when(counts[key]) for key in ("first_time", "last_time"))
    if counts["write_failures"]:
        yield "write failures", str(counts["write_failures"])


def _retrain_rows(retrains: list[RetrainReport]) -> Iterator[tuple[str, str]]:
    dropped = [r for r in retrains if not r.accepted]
    answering = max((r.version for r in retrains if r.accepted), default=None)
    yield "version", "none yet: every part is verified" if answering is None else str(answering)
    yield "retrains", f"{len(retrains)}, {len(dropped)} dropped"
    if dropped:
        yield "last drop", dropped[-1].reason
    if retrains:
        last, worst = retrains[-1], max(retrains, key=lambda r: r.seconds)
        yield "last retrain", f"{duration(last.seconds)} on {last.n_traces} traces, {last.n_steps} steps"
        yield "worst retrain", f"{duration(worst.seconds)}, to version {worst.version}"


def _listed(counts: dict[str, int]) -> str:
    return ", ".join(f"{n} {name}" for name, n in counts.items() if n) or "none"


def _when(seconds: float | None) -> str:
    return "-" if seconds is None else datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
