"""`to_jsonable` makes of a record what `--json` of the command line and the HTTP service answer."""

import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from typing import Any

from .errors import without_password


def to_jsonable(value: Any) -> Any:
    """Return a value in a form that `json` can encode, with the passwords of database URLs masked.

    Dataclasses and mappings become dicts with text keys, arrays and tuples become lists, NumPy's
    numbers become Python's, and NaN and infinities become None. Any other object, a set or a class
    for example, becomes the text that `str` gives. All of this is done at any depth; `value` is not
    changed. Passwords are masked in all texts but keys. A dataclass field whose `metadata` has the
    key "apart" is left out (large arrays have it). A field with the key "flat" is replaced by the
    fields of its value, which must be a dataclass or a mapping: another value raises TypeError or
    ValueError.
    """
    # Floats first: a server's responses consist mostly of them.
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, str):
        return without_password(value)
    if isinstance(value, int) or value is None:
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
    if hasattr(type(value), "tolist"):  # NumPy; not one of its classes
        return to_jsonable(value.tolist())
    return without_password(str(value))


@cache
def _shown_fields(record_type: type) -> tuple[tuple[str, bool], ...]:
    """Return a dataclass's fields that are not "apart": each name, and whether it is "flat"."""
    shown = (field for field in fields(record_type) if "apart" not in field.metadata)
    return tuple((field.name, "flat" in field.metadata) for field in shown)
