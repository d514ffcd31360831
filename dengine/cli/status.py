"""`dengine status`: what a store holds."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import click

from .options import example, json_option
from .output import show, write_json

if TYPE_CHECKING:
    from ..records import RetrainReport


@click.command(epilog=example("dengine status engine.db"))
@click.argument("store")
@json_option
def status(store: str, as_json: bool) -> None:
    """Say what a store holds: decisions, labels, versions, retrains."""
    from ..recipe import Recipe

    settings, counts, retrains = _read(store)
    worst = max((r.seconds for r in retrains), default=None)
    recipe = Recipe.from_toml(settings["recipe"])
    if as_json:
        listed = [asdict(r) for r in retrains]
        write_json(
            {"verb": "status", "store": store} | counts | {"settings": settings, "worst_retrain_s": worst, "all": listed}
        )
        return
    show(_table(store, [*_settings_rows(recipe, settings), *_count_rows(counts), *_retrain_rows(retrains, recipe.budget)]))


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
    table.add_column(style="bold")
    table.add_column(overflow="fold")
    for row in rows:
        table.add_row(*row)
    return table


def _settings_rows(recipe: Any, settings: dict[str, str]) -> Iterator[tuple[str, str]]:
    policy = recipe.policy
    yield "reducer", f"{recipe.reducer}, seed {settings.get('seed', '0')}"
    yield (
        "policy",
        f"alpha {policy.alpha:g}, LB {100 * policy.lower_bound:g} %, {policy.interval}, audits {policy.audit_rate:g}",
    )


def _count_rows(counts: dict[str, Any]) -> Iterator[tuple[str, str]]:
    yield "cell", counts["cell_id"]
    yield "decisions", f"{counts['decisions']}: {_listed(counts['actions'])}"
    yield "reasons", _listed(counts["reasons"])
    yield "quarantined", str(counts["quarantined"])
    yield "labels", f"{counts['labels']}: {_listed(counts['sources'])}"
    yield "first, last", " to ".join(_when(counts[key]) for key in ("first_time", "last_time"))
    if counts["write_failures"]:
        yield "write failures", str(counts["write_failures"])


def _retrain_rows(retrains: list[RetrainReport], budget: float) -> Iterator[tuple[str, str]]:
    dropped = [r for r in retrains if not r.accepted]
    answering = max((r.version for r in retrains if r.accepted), default=None)
    yield "version", "none yet: every part is verified" if answering is None else str(answering)
    yield "retrains", f"{len(retrains)}, {len(dropped)} dropped"
    if dropped:
        yield "last drop", dropped[-1].reason
    if retrains:
        last, worst = retrains[-1], max(retrains, key=lambda r: r.seconds)
        yield "last retrain", f"{last.seconds:.3f} s on {last.n_traces} traces, {last.n_steps} steps"
        yield "worst retrain", f"{worst.seconds:.3f} s (version {worst.version}); budget {budget:g} s"


def _listed(counts: dict[str, int]) -> str:
    return ", ".join(f"{n} {name}" for name, n in counts.items() if n) or "none"


def _when(seconds: float | None) -> str:
    return "-" if seconds is None else datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
