"""Names and classes that are imported when they are first used, so that looking at a package costs nothing."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import Any

from .errors import SettingError
from .wording import shortened


def lazy_names(package: str, where: Mapping[str, Sequence[str]]) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """A package's `__getattr__` and `__dir__` (PEP 562). where : module, relative to the package -> names in it."""
    module_of = {name: module for module, names in where.items() for name in names}

    def __getattr__(name: str) -> Any:  # noqa: N807  # the name that Python looks for
        if name not in module_of:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(import_module(f".{module_of[name]}", package), name)
        setattr(sys.modules[package], name, value)  # found once, plain from then on
        return value

    def __dir__() -> list[str]:  # noqa: N807
        return sorted({name for name in vars(sys.modules[package]) if name.startswith("__")} | {*module_of})

    return __getattr__, __dir__


def find_class(where: str) -> type:
    """The class that `module:Class` names; SettingError where there is none."""
    module, _, name = where.partition(":")
    try:
        found = getattr(import_module(module), name)
    except Exception as error:  # whatever a module of the user's raises while it is imported
        raise SettingError(
            f"Expected module:Class of something that can be imported here, got {shortened(where)}: {error}."
        ) from error
    if not isinstance(found, type):
        raise SettingError(f"Expected module:Class, {shortened(where)} is a {type(found).__name__} and no class.")
    return found
