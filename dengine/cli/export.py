"""`dengine export`: an engine's decision for a controller, with what the controller needs beside it."""

from pathlib import Path
from typing import Any

import click

from . import options
from .options import FILE, FOLDER, verb
from .output import size, tell

EXPORTERS = ("torchscript", "onnx")
FORMAT = "torchscript decides, audits and learns in the cell; onnx only decides."
KEY = "Sign the file with this key, as --make-key writes it; the signature comes beside it, as FILE.sig."
NEW_KEY = "First write a new secret key to this new file, which only you can read; and sign with it."
SIGNED = "Signed with %s: %s.sig. Give the key to whoever loads the file, and it is checked first."
UNSIGNED = "Whoever loads such a file runs what is in it: load only your own, or sign them with --key."
CPP = "Write into this new folder the C and C++ sources that run an exported file, of any store."


@verb("dengine export engine.db --out model.ts")
@options.a_store(click.argument("store", metavar="[STORE]", required=False))
@click.option("--out", type=FILE, help="The file to write; its checksum comes beside it, as FILE.sha256.")
@click.option("--format", "form", type=click.Choice(EXPORTERS), default=EXPORTERS[0], show_default=True, help=FORMAT)
@click.option("--key", type=click.Path(exists=True, dir_okay=False, path_type=Path), help=KEY)
@click.option("--make-key", "new_key", type=FILE, help=NEW_KEY)
@click.option("--cpp", type=FOLDER, help=CPP)
@options.allow_import_option
@options.force_option
def export(
    store: str | None,
    out: Path | None,
    form: str,
    key: Path | None,
    new_key: Path | None,
    cpp: Path | None,
    allow_import: bool,
    force: bool,
) -> None:
    """Write an engine's decision to a file for the controller.

    STORE is the file or URL that the engine remembers in, as given to `dengine train` or `dengine run`. --make-key and
    --cpp need neither STORE nor --out. Who has the key can check an exported file, and sign one as well.
    """
    if (store is None) is not (out is None) or not (store or new_key or cpp):
        raise click.UsageError("Expected STORE and --out FILE, or without both --make-key FILE or --cpp FOLDER.")
    if key and new_key:
        raise click.UsageError("--key and --make-key exclude each other; a new key signs too.")
    from ..engine.engine import DataEngine
    from ..export import export_onnx, export_sources, export_torchscript, make_key

    made: dict[str, Any] = {}
    said = []
    if new_key is not None:
        made["key"] = key = make_key(new_key)
        said.append(f"Wrote {key}, readable by you alone. Keep it as secret as a password.")
    if cpp is not None:
        made["cpp"] = export_sources(cpp)
        said.append(f"Wrote {cpp}; build it as {cpp / 'CMakeLists.txt'} says.")
    if store is not None and out is not None:
        with DataEngine.open(store, reading=True, allow_import=allow_import) as engine:  # the cell may run meanwhile
            {"torchscript": export_torchscript, "onnx": export_onnx}[form](engine, out, key=key, force=force)
            version, references = engine.version, len(engine.model.index)
        n_bytes = out.stat().st_size
        made |= {"store": store, "out": out, "format": form, "version": version, "references": references}
        made |= {"bytes": n_bytes, "signed": key is not None}
        what = f"version {version} with {references} labelled references"
        said.append(f"Wrote {out} ({size(n_bytes)}) and {out.name}.sha256: {what}.")
        said.append(UNSIGNED if key is None else SIGNED % (key, out.name))
    tell(made, *said)
