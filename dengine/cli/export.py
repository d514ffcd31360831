"""`dengine export` and what a controller needs beside it, and `dengine import-labels`: out to the cell, and back."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import click

from .options import cell_options, example, force_option, json_option
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
@click.option(
    "--key",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    help="Sign the file with this key, as dengine make-key writes it; the signature comes beside it, as FILE.sig.",
)
@force_option
@json_option
def export(store: str, out: Path, form: str, key: Path | None, force: bool, as_json: bool) -> None:
    """Write an engine's decision to a file for the controller.

    STORE is the file or URL that the engine remembers in, as given to `dengine train` or `dengine run`.
    """
    from ..engine.engine import DataEngine
    from ..export import export_onnx, export_torchscript

    write = {"torchscript": export_torchscript, "onnx": export_onnx}[form]
    with DataEngine.open(store, reading=True) as engine:  # the cell may run meanwhile
        path = write(engine, out, key=key, force=force)
        version, references = engine.version, len(engine.model.index)
    n_bytes = path.stat().st_size
    if as_json:
        about = {"format": form, "version": version, "references": references, "bytes": n_bytes, "signed": key is not None}
        write_json({"verb": "export", "store": store, "out": str(path)} | about)
        return
    show(f"Wrote {path} ({size(n_bytes)}) and {path.name}.sha256: version {version} with {references} labelled references.")
    show(
        f"Signed with {key}: {path.name}.sig. Give the key to whoever loads the file, and it is checked first."
        if key
        else "Whoever loads such a file runs what is in it: load only your own, or sign them with --key."
    )


@click.command("import-labels", epilog=example("dengine import-labels cell.csv --store engine.db"))
@click.argument("journal", metavar="JOURNAL", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option("--store", required=True, metavar="FILE|URL", help="The store that the cell's model was exported from.")
@click.option("--any-model", is_flag=True, help="Take a journal of a model that the store does not know as its export.")
@cell_options()
@json_option
def import_labels(journal: Path, store: str, any_model: bool, as_json: bool) -> None:
    """Take a cell program's labels back into the store.

    JOURNAL is the CSV file that the program wrote, of this version or an
    earlier one. Each line counts once, however often it is imported.
    """
    from ..export.cell_journal import import_journal

    report = import_journal(store, journal, any_model=any_model)
    if as_json:
        write_json({"verb": "import-labels", "store": store, "journal": str(journal)} | asdict(report))
        return
    show(imported_line(report, store))


@click.command("export-cpp", epilog=example("dengine export-cpp --out cell_cpp"))
@click.option(
    "--out",
    required=True,
    type=click.Path(file_okay=False, path_type=Path),
    help="The folder to write; new, or empty.",
)
@json_option
def export_cpp(out: Path, as_json: bool) -> None:
    """Write the C and C++ sources that run an exported file.

    A library with a C interface, dengine.h, and a program that answers lines. They
    are the same for every model; how to build them is in their CMakeLists.txt.
    """
    from ..export import export_sources

    path = export_sources(out)
    if as_json:
        write_json({"verb": "export-cpp", "out": str(path)})
        return
    show(f"Wrote {path}; build it as {path / 'CMakeLists.txt'} says.")


@click.command("make-key", epilog=example("dengine make-key cell.key"))
@click.argument("file", metavar="FILE", type=click.Path(dir_okay=False, path_type=Path))
@json_option
def make_key(file: Path, as_json: bool) -> None:
    """Write a new secret key to a file that only you can read.

    FILE must not be there yet. dengine export --key signs with it, and whoever
    loads the exported file checks with it; who has it can sign as well.
    """
    from ..export import make_key

    path = make_key(file)
    if as_json:
        write_json({"verb": "make-key", "file": str(path)})
        return
    show(f"Wrote {path}, readable by you alone. Keep it as secret as a password.")
