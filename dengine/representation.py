"""How records are shown: as HTML in a notebook, and as values that `json` takes. Records and
replays, the command line and the HTTP service use these functions.

`to_html` is the `_repr_html_` of every record that prints itself. `to_jsonable` makes what
`--json` of the command line and the HTTP service answer.
"""

import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from html import escape
from typing import Any

from .errors import without_password


def to_html(record: Any) -> str:
    """Return the `repr` of a record as an HTML table, for its `_repr_html_`.

    The text before the first ": " is the heading; each part behind it, between ", ", is a row. The
    texts in its attribute `sentences`, if it has one, are paragraphs below the table. All is
    escaped.
    """
    title, _, parts = repr(record).strip("<>").partition(": ")
    left = "style='text-align: left'"
    rows = "".join(f"<tr><td {left}>{escape(part)}</td></tr>" for part in parts.split(", "))
    sentences = getattr(record, "sentences", ())
    paragraphs = "".join(f"<p>{escape(sentence)}</p>" for sentence in sentences)
    return f"<table><tr><th {left}>{escape(title)}</th></tr>{rows}</table>{paragraphs}"


def to_jsonable(value: Any) -> Any:
    """Return a value as `json` takes it, without the passwords of database URLs.

    Dataclasses become objects, arrays lists, paths, keys and other objects text, NaN and infinities
    None. A dataclass field with "flat" in its metadata gives its own fields in its place; one with
    "apart" is left out.
    """
    # Floats first: a server's responses consist mostly of them.
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, str):
        return without_password(value)
    if isinstance(value, bool | int) or value is None:
        return value
    if isinstance(value, list | tuple):
        return [to_jsonable(item) for item in value]
    if is_dataclass(value) and not isinstance(value, type):
        result: dict[str, Any] = {}
        for name, is_flat in _shown_fields(type(value)):
            item = to_jsonable(getattr(value, name))
            result |= item if is_flat else {name: item}
        return result
    if isinstance(value, Mapping):
        return {str(key): to_jsonable(item) for key, item in value.items()}
    if hasattr(value, "tolist"):  # NumPy
        return to_jsonable(value.tolist())
    return without_password(str(value))


@cache
def _shown_fields(record_type: type) -> tuple[tuple[str, bool], ...]:
    """Return a dataclass's fields that are not "apart": each name, and whether it is "flat"."""
    shown = (field for field in fields(record_type) if "apart" not in field.metadata)
    return tuple((field.name, "flat" in field.metadata) for field in shown)
