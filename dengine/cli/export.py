"""`dengine export` and `dengine import-labels`: a decision out to the cell, and the cell's labels back."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import click

from .options import example, json_option
from .output import show, write_json


@click.command(epilog=example("dengine export engine.db --out model.ts"))
@click.argument("store")
@click.option(
    "--out", required=True, type=click.Path(dir_okay=False, path_type=Path), help="The file; its .sha256 beside it."
)
@click.option(
    "--format",
    "form",
    type=click.Choice(["torchscript", "onnx"]),
    default="torchscript",
    show_default=True,
    help="onnx carries no audits and learns nothing in the cell.",
)
@json_option
def export(store: str, out: Path, form: str, as_json: bool) -> None:
    """Write the whole decision of a store's engine to one file for the cell controller."""
    from ..engine import DataEngine
    from ..export import export_onnx, export_torchscript

    write = {"torchscript": export_torchscript, "onnx": export_onnx}[form]
    with DataEngine.open(store) as engine:
        path = write(engine, out)
        version, references = engine.version, len(engine.model.index)
    size = path.stat().st_size
    if as_json:
        about = {"format": form, "version": version, "references": references, "bytes": size}
        write_json({"verb": "export", "store": store, "out": str(path)} | about)
        return
    show(f"Wrote {path}, {size / 1e3:.0f} kB, and {path.name}.sha256: version {version} with {references} references.")


@click.command("import-labels", epilog=example("dengine import-labels cell.csv --store engine.db"))
@click.argument("journal", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option("--store", required=True, metavar="FILE|URL", help="The store that the cell's model was exported from.")
@json_option
def import_labels(journal: Path, store: str, as_json: bool) -> None:
    """Take the labels that a cell program learned back into the store. Each line counts once."""
    from ..importing import import_journal

    report = import_journal(store, journal)
    if as_json:
        write_json({"verb": "import-labels", "store": store, "journal": str(journal)} | asdict(report))
        return
    show(
        f"Imported {report.imported} labels into {store}, {report.quarantined} more into quarantine; "
        f"{report.known} were known from an earlier import."
    )
