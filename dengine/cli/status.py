"""`dengine status`: what a store holds, and what can be said of the parts that went on without a check."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..wording import without_password
from .doing import Doing, doing_record, doing_table, drawn
from .naming import cell_options
from .options import example, json_option, out_file_option
from .output import certificate_record, duration, show, when, write_json
from .watching import redraw

if TYPE_CHECKING:
    from ..decision.certificate import Certificate
    from ..recipe import Recipe
    from ..records import RetrainReport
    from ..store.base import Event, Evidence, Store

RECENT = 200  # labels
GUARANTEES = {
    "local": "local: of the ball around each part, at one look",
    "pooled": "pooled: of all accepted parts together, however often one looks",
}
STOPS = {
    "some": "of some bad parts: silence after an accept says nothing",
    "all": "of all bad parts: an accepted part that no stop follows counts as good",
}
SHADOW = "all of what it is certain of: the shadow mode, in which it only says what it would have done"


@click.command(epilog=example("dengine status engine.db --last 500"))
@click.argument("store", metavar="STORE")
@cell_options()
@click.option(
    "--last", type=click.IntRange(1), default=500, show_default=True, help="The newest so many decisions, looked at apart."
)
@click.option(
    "--watch",
    type=click.FloatRange(0.1),
    is_flag=False,
    flag_value=5.0,
    metavar="[SECONDS]",
    help="Show it again every so many seconds, 5 if none are given, until Ctrl-C; after STORE.",
)
@out_file_option
@json_option
def status(store: str, last: int, watch: float | None, out: Path | None, as_json: bool) -> None:
    """Say how an engine is doing, and what its store holds.

    STORE is the file or URL that the engine remembers in, as given to `dengine train` or `dengine run`. The interval of bad
    accepted parts is of one look; what is certified holds however often one looks.
    """
    if watch is not None and as_json:
        raise click.UsageError("--watch and --json exclude each other.")
    if watch is not None:
        redraw(lambda: _screen(store, last, out), watch)
        return
    held = _read(store, last, out)
    if as_json:
        files = [] if out is None else [out]
        write_json({"verb": "status", "store": store} | _record(held) | doing_record(held.doing) | {"files": files})
        return
    show(*_tables(store, held), *([] if out is None else [f"Wrote {out}"]))


def _screen(store: str, last: int, out: Path | None) -> list[Any]:
    return _tables(store, _read(store, last, out))


def _tables(store: str, held: Held) -> list[Any]:
    groups = (_settings_rows(held), _count_rows(held), _promise_rows(held), _retrain_rows(held.retrains), _event_rows(held))
    return [doing_table(held.doing, store), _table("What it is", [row for rows in groups for row in rows])]


@dataclass(frozen=True)
class Held:
    """What was read of a store.

    counts : `Store.status`.  novel, recent : traces that were novel among those that the newest labels tell of, and how
        many they tell of: verified, audited and accepted parts.  mode : the newest event of the safe mode, if any.
    doing : over the newest decisions, and since its birth.
    """

    settings: dict[str, str]
    recipe: Recipe
    counts: dict[str, Any]
    retrains: list[RetrainReport]
    certificate: Certificate
    novel: int
    recent: int
    mode: Event | None
    doing: Doing

    @property
    def shadow(self) -> bool:
        """Whether every part is verified, by the user's will."""
        return self.recipe.policy.audit_rate == 1.0

    @property
    def safe_mode(self) -> str:
        """Why everything is verified; "" where it is not."""
        return "" if self.mode is None or self.mode.text.startswith("ended") else self.mode.text


def _read(store: str, last: int, out: Path | None) -> Held:
    from ..errors import StoreError
    from ..store.base import open_store

    opened = open_store(store, must_exist=True)
    try:
        settings = opened.settings()
        if "recipe" not in settings:
            raise StoreError(f"Expected a store that an engine has used, {store} is empty.")
        held = _held(opened, settings, last)
        if out is not None:
            drawn(opened, held.recipe, last, out)
        return held
    finally:
        opened.close()


def _held(store: Store, settings: dict[str, str], last: int) -> Held:
    from ..decision.certificate import certificate_of
    from ..recipe import Recipe
    from ..standing import standing, watch

    recipe, counts = Recipe.from_toml(settings["recipe"]), store.status()
    newest = _newest(store, counts["labels"])
    modes = [event for event in store.events() if event.kind == "safe mode"]
    return Held(
        settings=settings,
        recipe=recipe,
        counts=counts,
        retrains=store.retrains(),
        certificate=certificate_of(store.outcomes(int(settings.get("policy_since", 0))), recipe.policy),
        novel=int(newest.novel.sum()),
        recent=len(newest.seq) + int(newest.silent.sum()),
        mode=modes[-1] if modes else None,
        doing=Doing(standing(store, recipe, last), watch(store, recipe), recipe.policy.alpha, last),
    )


def _newest(store: Store, labels: int) -> Evidence:
    """What became of the decisions with the newest labels, RECENT at most."""
    from ..store.records import Evidence
    from ..store.shared import is_shared

    known = store.evidence_since(0 if is_shared(store) else labels - RECENT)  # numbered from 1, or over a whole product
    return Evidence(*(getattr(known, field.name)[-RECENT:] for field in fields(known)))


def _record(held: Held) -> dict[str, Any]:
    """As JSON has it."""
    counts, policy = held.counts, held.recipe.policy
    novel = {"decisions": counts["reasons"]["novel"], "share": _share(counts["reasons"]["novel"], counts["decisions"])}
    novel |= {"recent": held.novel, "recent_decisions": held.recent, "recent_share": _share(held.novel, held.recent)}
    mode = {"on": held.safe_mode != "", "reason": held.safe_mode, "since": held.mode.time if held.mode else None}
    worst = max((r.seconds for r in held.retrains), default=None)
    return counts | {
        "guarantee": policy.guarantee,
        "stops": policy.stops,
        "certificate": certificate_record(held.certificate),
        "novel": novel,
        "safe_mode": mode,
        "shadow": held.shadow,
        "settings": held.settings,
        "worst_retrain_s": worst,
        "all": [asdict(r) for r in held.retrains],
    }


def _share(some: int, of: int) -> float | None:
    return some / of if of else None


def _table(store: str, rows: list[tuple[str, str]]) -> Any:
    from rich.table import Table

    table = Table(title=without_password(store), show_header=False, title_justify="left")
    table.add_column(style="bold", no_wrap=True)
    table.add_column(overflow="fold")
    for row in rows:
        table.add_row(*map(without_password, row))
    return table


def _settings_rows(held: Held) -> Iterator[tuple[str, str]]:
    settings, recipe, seed = held.settings, held.recipe, held.settings.get("seed", "0")
    # Of a model that was handed in, reducer and numbers of the recipe have no effect: to show them would be a lie.
    handed_in = settings.get("model")
    yield from _own_rows(recipe, seed) if handed_in is None else [("model", f"{handed_in}, decides by its own rule")]
    yield "stops known", STOPS[recipe.policy.stops]
    yield "audits", SHADOW if held.shadow else f"{100 * recipe.policy.audit_rate:g} % of what it is certain of"
    yield (
        "retrain",
        (f"every {recipe.retrain_every} new labels, within {duration(recipe.budget)}, on the newest {recipe.window:,}"),
    )
    yield "trace", _contract(settings)


def _own_rows(recipe: Recipe, seed: str) -> Iterator[tuple[str, str]]:
    policy = recipe.policy
    yield "reducer", f"{recipe.name}, seed {seed}"
    yield "policy", f"alpha {policy.alpha:g}, LB {100 * policy.lower_bound:g} %, {policy.interval} interval"
    yield "guarantee", GUARANTEES.get(policy.guarantee, policy.guarantee)
    yield "neighbours", _neighbours(recipe)
    yield "novelty", "off" if not recipe.novelty else f"verified beyond {recipe.novelty:g} times the usual distance"


def _neighbours(recipe: Recipe) -> str:
    if recipe.fraction is None:
        return f"within a radius of {recipe.radius:g}, in the unit of the scaled embedding"
    judged = "" if recipe.reject_fraction is None else f"; a rejection is judged by {100 * recipe.reject_fraction:g} %"
    return f"the nearest {100 * recipe.fraction:g} % of the references{judged}"


def _contract(settings: dict[str, str]) -> str:
    from ..settings import trace_in

    spec = trace_in(settings)
    if spec is None:
        return "none yet: the first trace sets it"
    channels = "" if spec.channels == 1 else f"{spec.channels} channels of "
    limit = "" if spec.limit is None else f", sensor limit {spec.limit:g} {spec.unit}"
    seconds = duration(spec.samples / spec.rate_hz)
    return f"{channels}{spec.samples} samples at {spec.rate_hz:g} Hz ({seconds}), in {spec.unit}{limit}"


def _count_rows(held: Held) -> Iterator[tuple[str, str]]:
    counts = held.counts
    yield "cell", counts["cell_id"]
    if "product" in counts:
        yield "product", f"{counts['product']}: labels and versions are shared with its other cells"
    yield "decisions", f"{counts['decisions']}: {_listed(counts['actions'])}"
    yield "reasons", _listed(counts["reasons"])
    yield "quarantined", str(counts["quarantined"])
    yield "labels", f"{counts['labels']}: {_listed(counts['sources'])}"
    if counts["corrected"] or counts["forgotten"]:
        yield "put right", f"{counts['corrected']} labels corrected, {counts['forgotten']} more forgotten"
    yield "first, last", " to ".join(when(counts[key]) for key in ("first_time", "last_time"))
    if counts["write_failures"]:
        yield "write failures", str(counts["write_failures"])


def _promise_rows(held: Held) -> Iterator[tuple[str, str]]:
    novel, decisions = held.counts["reasons"]["novel"], held.counts["decisions"]
    recent = f"; of the newest {held.recent:,} that labels tell of, {held.novel:,}{_percent(held.novel, held.recent)}"
    yield "novel", f"{novel:,} of {decisions:,} decisions{_percent(novel, decisions)}{recent}"
    yield "safe mode", _mode(held)
    yield "accepted", f"{held.certificate.sentence} {held.certificate.advice}"
    yield "rejected", held.certificate.sentence_on_rejects


def _percent(some: int, of: int) -> str:
    return f" ({100 * some / of:.1f} %)" if of else ""


def _mode(held: Held) -> str:
    if held.mode is None:
        return "off"
    since = when(held.mode.time)
    return f"on since {since}, every part is verified: {held.safe_mode}" if held.safe_mode else f"off, ended {since}"


def _event_rows(held: Held) -> Iterator[tuple[str, str]]:
    for i, event in enumerate(reversed(held.counts["events"])):
        yield "newest events" if i == 0 else "", f"{when(event['time'])} {event['kind']}: {event['text']}"


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
