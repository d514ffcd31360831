"""The C and C++ sources that run an exported file: a library with a C interface, and a program.

    dengine export-cpp --out cell_cpp
    cmake -S cell_cpp -B build/cpp -DCMAKE_PREFIX_PATH="$(python -c 'import torch; print(torch.utils.cmake_prefix_path)')"

They depend on no model, so they come by a verb of their own and not with each export.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from .. import __version__
from ..errors import ExportError

SOURCES = Path(__file__).parent / "cpp"


def export_sources(folder: str | os.PathLike[str]) -> Path:
    """Write the sources into a new or an empty folder, and return it.

    ExportError where the folder holds anything, or cannot be written.
    """
    target = Path(folder)
    try:
        if target.exists() and (not target.is_dir() or any(target.iterdir())):
            raise ExportError(f"Expected a new or an empty folder for the sources, {target} holds something; name another.")
        shutil.copytree(SOURCES, target, dirs_exist_ok=True, ignore=shutil.ignore_patterns("__pycache__"))
        (target / "VERSION").write_text(f"{__version__}\n", encoding="utf-8")
    except OSError as error:
        raise ExportError(f"Cannot write {target}: {error}; choose a folder that is writable.") from error
    return target
