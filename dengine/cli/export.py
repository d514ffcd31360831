"""`dengine export` and `dengine import-labels`: a decision out to the cell, and the cell's labels back."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import click

from .naming import cell_options
from .options import example, force_option, json_option
from .output import imported_line, show, size, write_json


@click.command(epilog=example("dengine export engine.db --out model.ts"))
@click.argument("store", metavar="STORE")
@cell_options()
@click.option(
    "--out",
    required=True,
    type=click.Path(dir_okay=False, path_type=Path),
    help="The file to write; its checksum comes beside it, as FILE.sha256.",
)
@click.option(
    "--format",
    "form",
    type=click.Choice(["torchscript", "onnx"]),
    default="torchscript",
    show_default=True,
    help="torchscript decides, audits and learns in the cell; onnx only decides.",
)
@force_option
@json_option
def export(store: str, out: Path, form: str, force: bool, as_json: bool) -> None:
    """Write an engine's decision to a file for the controller.

    STORE is the file or URL that the engine remembers in, as given to `dengine train` or `dengine run`.
    """
    from ..engine import DataEngine
    from ..export import export_onnx, export_torchscript

    write = {"torchscript": export_torchscript, "onnx": export_onnx}[form]
    with DataEngine.open(store, reading=True) as engine:  # the cell may run meanwhile
        path = write(engine, out, force=force)
        version, references = engine.version, len(engine.model.index)
    n_bytes = path.stat().st_size
    if as_json:
        about = {"format": form, "version": version, "references": references, "bytes": n_bytes}
        write_json({"verb": "export", "store": store, "out": str(path)} | about)
        return
    show(f"Wrote {path} ({size(n_bytes)}) and {path.name}.sha256: version {version} with {references} labelled references.")


@click.command("import-labels", epilog=example("dengine import-labels cell.csv --store engine.db"))
@click.argument("journal", metavar="JOURNAL", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option("--store", required=True, metavar="FILE|URL", help="The store that the cell's model was exported from.")
@cell_options()
@json_option
def import_labels(journal: Path, store: str, as_json: bool) -> None:
    """Take a cell program's labels back into the store.

    JOURNAL is the CSV file that the program wrote, of this version or an
    earlier one. Each line counts once, however often it is imported.
    """
    from ..importing import import_journal

    report = import_journal(store, journal)
    if as_json:
        write_json({"verb": "import-labels", "store": store, "journal": str(journal)} | asdict(report))
        return
    show(imported_line(report, store))
