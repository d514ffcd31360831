"""Detects code that was changed after TorchScript compiled it: torch compiles each class once.
`remember_code` notes the code of a module when `scripting.script` compiles it, and
`is_code_changed` says later whether it is another. The model then decides in Python, and the export
refuses.

A notebook cell that is run again defines another class, which is compiled. But if a method, a
function that it calls or a constant of a module is replaced, the class stays the same, and torch
goes on with the code of before.
"""

import sys
from collections.abc import Collection, Iterator
from inspect import getclosurevars
from types import FunctionType, ModuleType
from typing import Any
from weakref import WeakKeyDictionary

from torch import nn

LIBRARIES = {*sys.stdlib_module_names, "dengine", "numpy", "scipy", "sklearn", "torch"} - {
    "__main__"
}
PLAIN = bool, int, float, complex, str, bytes, tuple, list, dict, set, frozenset, type(None)

# Classes and functions that were compiled, and the code that they had then.
_COMPILED: WeakKeyDictionary[Any, list[Any]] = WeakKeyDictionary()


def remember_code(module: nn.Module) -> None:
    """Note the present code of a module, and of all modules in it, as compiled.

    It is kept for the process, in `_COMPILED`. Classes and functions that were noted before keep
    their first note; those of `LIBRARIES` are not noted.
    """
    for unit in _user_code(module):
        _COMPILED.setdefault(unit, _code_of(unit))


def is_code_changed(module: nn.Module) -> bool:
    """Return whether a module, or one in it, has other code now than `remember_code` noted.

    False for code that was never noted.
    """
    return any(
        unit in _COMPILED and _COMPILED[unit] != _code_of(unit) for unit in _user_code(module)
    )


def _user_code(module: nn.Module) -> Iterator[Any]:
    """Yield the class of a module and of each submodule, and the functions among their attributes.

    Classes and functions of `LIBRARIES` are left out; a class may come more than once.
    """
    for submodule in module.modules():
        functions = [value for value in vars(submodule).values() if isinstance(value, FunctionType)]
        yield from (unit for unit in (type(submodule), *functions) if not _is_of_library(unit))


def _is_of_library(value: Any) -> bool:
    """Return whether a module, class or function belongs to a package in `LIBRARIES`."""
    attribute = "__name__" if isinstance(value, ModuleType) else "__module__"
    return str(getattr(value, attribute, None)).partition(".")[0] in LIBRARIES


def _code_of(unit: Any) -> list[Any]:
    """Return a list by which `==` tells whether a function, or any method of a class, has changed.

    For each function it holds the byte code, the defaults and the values that the code names; for a
    class also its plain attributes. Base classes that belong to `LIBRARIES` are left out.
    """
    if isinstance(unit, FunctionType):
        return [_note(unit), *_named_values(unit)]
    notes: list[Any] = []
    for base in unit.__mro__:
        for name, member in sorted(vars(base).items()) if not _is_of_library(base) else ():
            is_property = isinstance(member, property)
            for value in (member.fget, member.fset) if is_property else (member,):
                value = getattr(value, "__func__", value)  # of a class method, say
                named = _named_values(value) if isinstance(value, FunctionType) else []
                notes.append((name, _note(value), named))
    return notes


def _named_values(function: FunctionType) -> list[Any]:
    """Return the name of each global and closure variable that a function reads, with its `_note`.

    They are compared later, to see whether a variable has changed. If one of them has no value, the
    list is empty: then no variable of this function is compared.
    """
    try:
        variables = getclosurevars(function)
    except ValueError:  # a variable has no value yet, or was deleted
        return []
    values = {**variables.globals, **variables.nonlocals}
    return [(name, _note(value, variables.unbound)) for name, value in sorted(values.items())]


def _note(value: Any, names: Collection[str] = ()) -> Any:
    """Return the part of a value that is compared later, to see whether the value has changed.

    For a function it is the code with its defaults, for a constant its text, and for a module the
    notes of its variables among `names`. For any other value, and for functions and modules of
    `LIBRARIES`, it is None: a change of these is not noticed.
    """
    if isinstance(value, FunctionType) and not _is_of_library(value):
        return value.__code__, repr(value.__defaults__)
    if isinstance(value, ModuleType) and not _is_of_library(value):
        return [(name, _note(vars(value).get(name))) for name in sorted(names)]
    return repr(value) if isinstance(value, PLAIN) else None
