"""Writes the reference page of descriptions from the fields of `Description` and its docstrings."""

from __future__ import annotations

import inspect
import re
from dataclasses import MISSING, fields, is_dataclass
from typing import Any, get_args

from dengine.datasets.description import SECTIONS, Description

MARK = "<!-- every key of a description -->"
TITLES = {"check": "[check]"}
SENTENCES = re.compile(r"^(\w+)\n((?:    .+\n?)+)", re.MULTILINE)  # of each key in a docstring


def on_page_markdown(markdown: str, **others: Any) -> str:
    """Return a page of MkDocs with all keys in the place of the mark."""
    return markdown.replace(MARK, keys()) if MARK in markdown else markdown


def keys() -> str:
    """Return a section for the keys at the top, and one for each section of the file."""
    text = ["## At the top\n", table(Description)]
    types = {about.name: about.type for about in fields(Description)}
    for name in SECTIONS:
        # The section itself, or what a list or mapping holds; the texts of [ignored] have no keys.
        for section in filter(is_dataclass, (types[name], *get_args(types[name]))):
            words = (section.__doc__ or "").split("\n")[0].partition(":")[0]
            text += [f"\n## [{TITLES.get(name, name)}]\n", f"{words}.\n", table(section)]
    return "\n".join(text)


def table(section: type) -> str:
    """Return the keys of a section with their defaults and their sentences."""
    doc = inspect.getdoc(section) or ""
    sentences = {name: " ".join(text.split()) for name, text in SENTENCES.findall(doc)}
    rows = [
        f"| `{f.name}` | {default(f.default)} | {sentences[f.name]} |"
        for f in fields(section)  # type: ignore[arg-type]
        if f.compare and not (section is Description and f.name in SECTIONS)
    ]
    return "\n".join(["| key | default | what it says |", "| --- | --- | --- |", *rows])


def default(value: Any) -> str:
    """Return a default as a cell of Markdown."""
    if value in (MISSING, "", ()):
        return ""
    if isinstance(value, tuple):
        return ", ".join(f"`{item}`" for item in value)
    return f"`{str(value).lower() if isinstance(value, bool) else value}`"
