"""`dengine explain`: why one decision came out as it did."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from .naming import cell_options
from .options import example, json_option, out_file_option
from .output import show, when, write_json

if TYPE_CHECKING:
    from ..envelope import Envelope, Excess
    from ..explaining import Explanation, Neighbour

MOST = 5  # excesses that are named


@click.command(epilog=example("dengine explain engine.db last --out why.png"))
@click.argument("store", metavar="STORE")
@cell_options()
@click.argument("decision", metavar="DECISION")
@click.option(
    "--neighbours", type=click.IntRange(0), default=10, show_default=True, help="Nearest references that are shown."
)
@out_file_option
@json_option
def explain(store: str, decision: str, neighbours: int, out: Path | None, as_json: bool) -> None:
    """Say why a decision came out as it did.

    DECISION is its id, as `dengine history STORE` lists it, or the word last. Counts, bound and action are shown as they
    were recorded; neighbours are found again by the version that answered where the store keeps it, and it says by which.
    The picture shows the trace with its neighbours and with the band that 95 % of the known successes lie in.
    """
    from ..errors import ReportError
    from ..history import history
    from ..reviewing import explain_stored
    from ..store.base import open_store

    opened = open_store(store, must_exist=True)
    try:
        if decision == "last":
            newest = next(history(opened, last=1), None)
            if newest is None:
                raise ReportError(f"Expected a decision in {store}, there is none yet; let an engine decide first.")
            decision = newest.id
        found = explain_stored(opened, decision, neighbours)
    finally:
        opened.close()
    files = [] if out is None else [_drawn(found, out)]
    if as_json:
        write_json({"verb": "explain", "store": store} | found.record() | {"files": files})
        return
    show(*_tables(found), *(f"Wrote {path}" for path in files))


def _drawn(found: Explanation, out: Path) -> Path:
    from ..experiments.explained_picture import explained_picture
    from ..experiments.look import save

    return save(explained_picture(found), out)


def _tables(found: Explanation) -> Iterator[Any]:
    from rich.table import Table

    past = found.decision
    table = Table(title=f"{past.id}: {past.action.value}, {past.reason.value}", show_header=False, title_justify="left")
    table.add_column(style="bold", no_wrap=True)
    table.add_column(overflow="fold")
    for row in _rows(found):
        table.add_row(*row)
    yield table
    if found.neighbours:
        yield _neighbour_table(found)


def _rows(found: Explanation) -> Iterator[tuple[str, str]]:
    past = found.decision
    yield "decided", f"{when(past.time)}, by " + (f"version {past.model_version}" if past.model_version else "no model")
    if past.part is not None:
        yield "part", past.part
    for i, sentence in enumerate(found.said):
        yield "" if i else "why", sentence
    for i, note in enumerate(found.notes):
        yield "" if i else "found again", note
    yield from _envelope_rows(found.envelope, found)


def _envelope_rows(band: Envelope | None, found: Explanation) -> Iterator[tuple[str, str]]:
    if band is None:
        yield "envelope", "too few successes of this shape are known yet"
        return
    usual = f"of 95 % of them fewer than {100 * band.usual:.0f} % do"
    yield "envelope", f"{100 * band.outside:.0f} % of its samples leave the band of {band.n:,} successes; {usual}"
    if band.not_finite:
        yield "", f"{band.not_finite} samples are NaN or infinite"
    farthest = sorted(band.excesses, key=lambda each: -each.widths)
    for i, each in enumerate(farthest[:MOST]):
        yield "" if i else "leaves it", _excess(each, found)
    if len(farthest) > MOST:
        yield "", f"and {len(farthest) - MOST} times less far"


def _excess(each: Excess, found: Explanation) -> str:
    spec = found.spec
    name = spec.columns[each.channel] if spec.columns else f"channel {each.channel + 1}"
    where = f"{name}, " if spec.channels > 1 else ""
    side = "above" if each.above else "below"
    if each.first == each.last:
        return f"{where}at {each.from_s:.3f} s (sample {each.first}) {side}, by {each.widths:.1f} band widths"
    times = f"{each.from_s:.3f} to {each.to_s:.3f} s (samples {each.first} to {each.last})"
    return f"{where}{times} {side}, by up to {each.widths:.1f} band widths"


def _neighbour_table(found: Explanation) -> Any:
    from rich.table import Table

    title = f"Nearest references of version {found.neighbours_version}; the ball's radius is {found.radius:.3g}"
    table = Table(title=title, title_justify="left")
    cells = [_neighbour_cells(each) for each in found.neighbours]
    for name in cells[0]:
        table.add_column(
            name,
            justify="right" if name in ("distance", "fold") else "left",
            overflow="fold",
            min_width=18 if name == "decision" else None,
        )
    for row in cells:
        table.add_row(*row.values())
    return table


def _neighbour_cells(each: Neighbour) -> dict[str, str]:
    source = "" if each.source is None else f", {each.source.value}"
    return {
        "decision": each.decision_id or "not known any more",
        "part": each.part or "-",
        "label": f"{'good' if each.success else 'bad'}{source}",
        "distance": f"{each.distance:.3f}",
        "fold": str(each.space),
        "ball": "inside" if each.inside else "outside",
    }
