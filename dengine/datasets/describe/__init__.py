"""Propose what recordings are, by looking at some of them: the only place that infers anything.

A value stands where a rule proves it, with its evidence as a comment; otherwise it is `?`, with the
candidates. `load_dataset` then reads exactly what the description says.
"""

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ...errors import DataError, listed
from ..description import FOLDER_FILE, UNKNOWN, Description
from ..read.files import natural_key, read_file
from ..read.frames import read_frame
from ..table import Table
from .bags import describe_bag
from .layout import Material, describe_material

# The format of files with each suffix; `.gz` may stand behind it.
SUFFIXES = {
    **dict.fromkeys((".csv", ".tsv", ".txt", ".dat", ".asc", ".lvm", ".log", ".prn"), "text"),
    ".json": "json",
    ".jsonl": "jsonl",
    ".ndjson": "jsonl",
    ".parquet": "parquet",
    ".pq": "parquet",
    ".npz": "npz",
    ".ts": "ts",
    ".mcap": "mcap",
    ".db3": "mcap",
}
PAGES = (
    "readme",
    "license",
    "licence",
    "notes",
    "changelog",
)  # texts that describe, by their stems


def describe(source: Any, stated: Mapping[str, Any] | None = None) -> Description:
    """Propose a description of recordings.

    Parameters
    ----------
    source : path or DataFrame
        A folder, a file or a table of recordings.
    stated : mapping, optional
        Keys that are known, like `{"label.column": "verdict"}`; the others follow from them.

    Returns
    -------
    Description
        With `?` where no rule proves a value. `open_keys` lists these, and `notes` has the evidence
        and the candidates by key.

    Raises
    ------
    DataError
        If there is no file, or none that holds samples.
    """
    stated = dict(stated or {})
    if hasattr(source, "columns"):
        material = Material("frame", Path(), ["table"], [], tables=[[read_frame(source, "table")]])
        return describe_material(material, stated)
    root = Path(source)
    if not root.exists():
        raise DataError(f"Expected a file or a folder of recordings, got {root}, which is none.")
    base = root if root.is_dir() else root.parent
    groups = group_files(root)
    if "files" in stated:
        patterns = [stated["files"]] if isinstance(stated["files"], str) else stated["files"]
        chosen = {path.relative_to(base).as_posix() for p in patterns for path in base.glob(p)}
        groups = {key: [n for n in names if n in chosen] for key, names in groups.items()}
        groups = {key: names for key, names in groups.items() if names}
    if not groups:
        wanted = f"files of recordings, {', '.join(SUFFIXES)}"
        raise DataError(
            f"Expected {wanted}, found none in {root}; see recordings that are not read."
        )
    notes: dict[str, str] = {}
    largest = max(groups, key=lambda key: len(groups[key]))
    others = [name for key, names in groups.items() if key != largest for name in names]
    rivals = [key for key, names in groups.items() if len(names) > 1 and key != largest]
    if rivals and "files" not in stated:
        counts = ", ".join(f"{pattern_of(groups[k])} ({len(groups[k])} files)" for k in groups)
        notes["files"] = f"one of: {counts}"
        return Description(files=(UNKNOWN,), notes=notes)
    names = groups[largest]
    kind = SUFFIXES.get(largest, "text")
    kind = stated.get("format", kind)
    stated.setdefault("files", root.name if root.is_file() else pattern_of(names))
    if kind == "mcap":
        return describe_bag([base / name for name in names], stated)
    material = Material(kind, base, names, [] if root.is_file() else others)
    return describe_material(material, stated)


def group_files(root: Path) -> dict[str, list[str]]:
    """Return the files of a folder by their suffix, each as seen from it, in their natural order.

    Left out are hidden files, descriptions, pages that describe, and files of other suffixes, unless
    all are.
    """
    if root.is_file():
        return {suffix_of(root.name): [root.name]}
    names = [
        path.relative_to(root).as_posix()
        for path in root.rglob("*")
        if path.is_file() and not any(part.startswith(".") for part in path.relative_to(root).parts)
    ]
    names = [n for n in names if n.rpartition("/")[2] != FOLDER_FILE and not n.endswith(".toml")]
    names = [n for n in names if Path(n).stem.lower() not in PAGES]
    known = [name for name in names if suffix_of(name) in SUFFIXES]
    groups: dict[str, list[str]] = {}
    for name in sorted(known, key=natural_key):
        groups.setdefault(suffix_of(name), []).append(name)
    return groups


def suffix_of(name: str) -> str:
    """Return the suffix of a file in lower case, without `.gz` behind it."""
    return Path(name.lower().removesuffix(".gz")).suffix


def pattern_of(names: Sequence[str]) -> str:
    """Return the pattern of files of one suffix."""
    endings = Counter(
        "".join(Path(name).suffixes[-2:] if name.lower().endswith(".gz") else Path(name).suffix)
        for name in names
    )
    ending = endings.most_common(1)[0][0]
    is_deep = any("/" in name for name in names)
    pattern = f"**/*{ending}" if is_deep else f"*{ending}"
    return pattern if len(names) > 1 else names[0]


__all__ = ["Table", "describe", "listed", "read_file"]
