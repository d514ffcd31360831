"""The subcommand `dengine export`: writes an engine's decision to a file for a controller, its
checksum and signature, and the C++ sources that run such a file.
"""

from pathlib import Path

import click

from . import options
from .options import FILE, FOLDER, verb
from .output import Record, format_size, print_result


@verb("dengine export engine.db --out model.ts")
@options.existing_store(click.argument("store", required=False))
@click.option(
    "--out", type=FILE, help="The file to write; its checksum is written beside it, as FILE.sha256."
)
@click.option(
    "--format",
    "form",
    type=click.Choice(["torchscript", "onnx"]),
    help="torchscript decides, audits and learns in the cell; onnx only decides.  [default: onnx "
    "for a FILE.onnx, else torchscript]",
)
@click.option(
    "--key",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    help=(
        "Sign the file with this key, as --make-key writes it; the signature is "
        "written beside it, as FILE.sig."
    ),
)
@click.option(
    "--make-key",
    "new_key",
    type=FILE,
    help=(
        "First write a new secret key to this new file, which only you can read, and sign with it."
    ),
)
@click.option(
    "--cpp",
    type=FOLDER,
    help=(
        "Write into this new folder the C and C++ sources that run an exported file of any store."
    ),
)
@options.allow_import_option
@options.force_option
def export(
    store: str | None,
    out: Path | None,
    form: str | None,
    key: Path | None,
    new_key: Path | None,
    cpp: Path | None,
    allow_import: bool,
    force: bool,
) -> None:
    """Write an engine's decision to a file for the controller.

    FILE, the --out, holds the whole decision: the model, its references (the labelled traces that
    it compares with) and the rule. FILE.sha256, the checksum, is written beside it, and with a key
    also FILE.sig, the signature. If any of these three exists, --force is needed; without a key,
    --force removes an old FILE.sig. An existing key is never replaced. --cpp writes the C and C++
    sources that run such a file.

    STORE is the engine's store (its database), as given to `dengine train` or `dengine run`; the
    robot cell may run meanwhile, and an event in the store's log records the export. But the
    exported file never learns the outcome of a part that was accepted and whose outcome is not
    known yet. Before the first retrain there is nothing to export, and the exit code is 1. It is 1,
    too, for a model that you handed in, for an interval other than wilson and binomial, and for a
    reducer or rule that runs in Python only, like umap-learn or a scikit-learn transformer. For
    onnx it is also 1 if the engine audits (checks some parts of which the model is certain), is in
    shadow mode (checks every part), has force limits (limits of the force that an operator set),
    has another guarantee (rule of its decisions) than local, or stops all (every bad accepted part
    stops the line), or has a part among its references more than once. STORE needs --out, and --out
    needs STORE; --make-key and --cpp need neither.

    If --make-key is given together with STORE and --out, the new key also signs FILE; so --key and
    --make-key exclude each other. Whoever has the key can check an exported file, and can also sign
    one. The output names the files, the version (the number of the trained model) and how many
    references it has. The key comes first, then the sources, then FILE; if one of them fails, what
    was written before stays.
    """
    if (store is None) is not (out is None) or not (store or new_key or cpp):
        raise click.UsageError(
            "Expected STORE and --out FILE, or without both --make-key FILE or --cpp FOLDER."
        )
    if key and new_key:
        raise click.UsageError("--key and --make-key exclude each other; a new key signs too.")
    from ..engine.engine import DataEngine
    from ..export import export_onnx, export_sources, export_torchscript, make_key

    record: Record = {}
    lines = []
    if new_key is not None:
        key = make_key(new_key)
        record["key"] = key
        lines.append(f"Wrote {key}, readable by you alone. Keep it as secret as a password.")
    if cpp is not None:
        record["cpp"] = export_sources(cpp)
        lines.append(f"Wrote {cpp}; build it as {cpp / 'CMakeLists.txt'} says.")
    if store is not None and out is not None:
        form = form or ("onnx" if out.suffix == ".onnx" else "torchscript")
        exporter = export_onnx if form == "onnx" else export_torchscript
        # Read-only: the cell may run meanwhile.
        with DataEngine.open(store, reading=True, allow_import=allow_import) as engine:
            exporter(engine, out, key=key, force=force)
            version = engine.version
            n_references = len(engine.model.index)
        n_bytes = out.stat().st_size
        record |= {
            "store": store,
            "out": out,
            "format": form,
            "version": version,
            "references": n_references,
            "bytes": n_bytes,
            "signed": key is not None,
        }
        lines += [
            f"Wrote {out} ({format_size(n_bytes)}) and {out.name}.sha256: version {version} with "
            f"{n_references} labelled references.",
            "Loading such a file runs the code in it: load only your own files, or sign them with "
            "--key."
            if key is None
            else f"Signed with {key}: {out.name}.sig. Give the key to whoever loads the file, and "
            "the signature is checked before loading.",
        ]
    print_result(record, *lines)
