"""`dengine export`: an engine's decision for a controller, with what the controller needs beside it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from . import options
from .options import FILE, FOLDER
from .output import show, size, write_json

EXPORTERS = ("torchscript", "onnx")
FORMAT = "torchscript decides, audits and learns in the cell; onnx only decides."
KEY = "Sign the file with this key, as --make-key writes it; the signature comes beside it, as FILE.sig."
NEW_KEY = "First write a new secret key to this new file, which only you can read; and sign with it."
CPP = "Write into this new folder the C and C++ sources that run an exported file, of any store."


@click.command(epilog=options.example("dengine export engine.db --out model.ts"))
@click.argument("store", metavar="[STORE]", required=False)
@options.cell_options()
@click.option("--out", type=FILE, help="The file to write; its checksum comes beside it, as FILE.sha256.")
@click.option("--format", "form", type=click.Choice(EXPORTERS), default=EXPORTERS[0], show_default=True, help=FORMAT)
@click.option("--key", type=click.Path(exists=True, dir_okay=False, path_type=Path), help=KEY)
@click.option("--make-key", "new_key", type=FILE, help=NEW_KEY)
@click.option("--cpp", type=FOLDER, help=CPP)
@options.force_option
@options.json_option
def export(
    store: str | None,
    out: Path | None,
    form: str,
    key: Path | None,
    new_key: Path | None,
    cpp: Path | None,
    force: bool,
    as_json: bool,
) -> None:
    """Write an engine's decision to a file for the controller.

    STORE is the file or URL that the engine remembers in, as given to `dengine train` or `dengine run`. --make-key and
    --cpp need neither STORE nor --out. Who has the key can check an exported file, and sign one as well.
    """
    if (store is None) is not (out is None) or not (store or new_key or cpp):
        raise click.UsageError("Expected STORE and --out FILE, or without both --make-key FILE or --cpp FOLDER.")
    if key and new_key:
        raise click.UsageError("--key and --make-key exclude each other; a new key signs too.")
    from ..export import export_sources, make_key

    made: dict[str, Any] = {"verb": "export"}
    said = []
    if new_key is not None:
        made["key"] = key = make_key(new_key)
        said.append(f"Wrote {key}, readable by you alone. Keep it as secret as a password.")
    if cpp is not None:
        made["cpp"] = export_sources(cpp)
        said.append(f"Wrote {cpp}; build it as {cpp / 'CMakeLists.txt'} says.")
    if store is not None and out is not None:
        record, lines = _exported(store, out, form, key, force)
        made |= record
        said += lines
    if as_json:
        write_json(made)
        return
    show(*said)


def _exported(store: str, out: Path, form: str, key: Path | None, force: bool) -> tuple[dict[str, Any], list[str]]:
    """Write the file; what was written, as JSON has it and in words."""
    from ..engine.engine import DataEngine
    from ..export import export_onnx, export_torchscript

    write = {"torchscript": export_torchscript, "onnx": export_onnx}[form]
    with DataEngine.open(store, reading=True) as engine:  # the cell may run meanwhile
        path = write(engine, out, key=key, force=force)
        version, references = engine.version, len(engine.model.index)
    n_bytes = path.stat().st_size
    record = {"store": store, "out": path, "format": form, "version": version, "references": references}
    return record | {"bytes": n_bytes, "signed": key is not None}, [
        f"Wrote {path} ({size(n_bytes)}) and {path.name}.sha256: version {version} with {references} labelled references.",
        f"Signed with {key}: {path.name}.sig. Give the key to whoever loads the file, and it is checked first."
        if key
        else "Whoever loads such a file runs what is in it: load only your own, or sign them with --key.",
    ]
