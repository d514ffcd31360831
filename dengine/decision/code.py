"""Detects code that was changed after TorchScript compiled it: torch compiles each class once.
`remember_code` notes the code of a module when `scripting.script` compiles it, and
`is_code_changed` says later whether it is another. The model then answers in Python, and the export
refuses.

A notebook cell that is run again defines another class, which is compiled. But if a method, a
helper's method, a function or a constant of a module is replaced, the class stays the same, and
torch answers with the code of before.
"""

import sys
from collections.abc import Iterator
from contextlib import suppress
from types import CodeType, FunctionType, ModuleType
from typing import Any
from weakref import WeakKeyDictionary

from torch import nn

LIBRARIES = {*sys.stdlib_module_names, "dengine", "numpy", "scipy", "sklearn", "torch"} - {
    "__main__"
}
PLAIN = bool, int, float, complex, str, bytes, tuple, list, dict, set, frozenset, type(None)
IGNORED_MEMBERS = ("__dict__", "__weakref__", "__module__", "__doc__", "__annotations__")

# Classes and functions that were compiled, and a text of all the code that they refer to.
_COMPILED: WeakKeyDictionary[Any, str] = WeakKeyDictionary()


def remember_code(module: nn.Module) -> None:
    """Note the present code of a module, and of all modules in it, as compiled.

    Classes and functions that were noted before keep their first note.
    """
    for unit in _user_code(module):
        _COMPILED.setdefault(unit, _code_text(unit))


def is_code_changed(module: nn.Module) -> bool:
    """Return whether a module, or one in it, has other code now than `remember_code` noted.

    False for code that was never noted.
    """
    return any(
        unit in _COMPILED and _COMPILED[unit] != _code_text(unit) for unit in _user_code(module)
    )


def _user_code(module: nn.Module) -> Iterator[Any]:
    """Yield the class of a module and of each submodule, and the functions among their attributes.

    Classes and functions of `LIBRARIES` are left out; a class may come more than once.
    """
    for submodule in module.modules():
        functions = [value for value in vars(submodule).values() if isinstance(value, FunctionType)]
        for unit in (type(submodule), *functions):
            if not _is_of_library(unit):
                yield unit


def _is_of_library(value: Any) -> bool:
    """Return whether a module, class or function belongs to a package in `LIBRARIES`."""
    attribute = "__name__" if isinstance(value, ModuleType) else "__module__"
    name = getattr(value, attribute, None)
    return str(name).partition(".")[0] in LIBRARIES


def _code_text(unit: Any) -> str:
    """Return a text that changes with the code and constants that a class or function refers to."""
    return repr(_describe(unit, set(), set()))


def _describe(value: Any, names: set[str], seen: set[int]) -> Any:
    """Describe all code that a value refers to, and the constants in it, for comparison by `repr`.

    A class gives a list of (name, description) of its members and of its bases' members, a module
    the same of the variables in `names`, a function what `_describe_function` returns, a property a
    list of its getter and its setter, a constant its text. Anything else, a library's code, and
    what was described before give a name only. `names` are the names that the referring code
    mentions. `seen` holds the ids of values that were described already; it is added to.
    """
    if isinstance(value, staticmethod | classmethod):
        return _describe(value.__func__, names, seen)
    if isinstance(value, property):
        return [_describe(function, names, seen) for function in (value.fget, value.fset)]
    if isinstance(value, PLAIN):
        return repr(value)
    is_code = isinstance(value, FunctionType | type | ModuleType)
    if not is_code or _is_of_library(value) or id(value) in seen:
        return getattr(value, "__qualname__", type(value).__qualname__)
    seen.add(id(value))
    if isinstance(value, ModuleType):
        mentioned = sorted(names & vars(value).keys())
        return [(name, _describe(vars(value)[name], names, seen)) for name in mentioned]
    if isinstance(value, type):
        classes = [base for base in value.__mro__ if not _is_of_library(base)]
        members = [pair for base in classes for pair in sorted(vars(base).items())]
        return [
            (name, _describe(member, names, seen))
            for name, member in members
            if name not in IGNORED_MEMBERS
        ]
    return _describe_function(value, seen)


def _describe_function(function: FunctionType, seen: set[int]) -> tuple[Any, str, list[Any]]:
    """Return (instructions, text of the defaults, referred values) of a function.

    The referred values are (name, description) of each global and closure variable that the code
    mentions, by name. Defaults of keyword-only parameters are left out: TorchScript takes none.
    `seen` is added to, as by `_describe`.
    """
    mentioned = set(_names(function.__code__))
    namespace = function.__globals__
    values = {name: namespace[name] for name in mentioned & namespace.keys()}
    cells = function.__closure__ or ()
    for name, cell in zip(function.__code__.co_freevars, cells, strict=True):
        with suppress(ValueError):  # an empty cell: the variable has no value yet, or was deleted
            values[name] = cell.cell_contents
    referred = [(name, _describe(values[name], mentioned, seen)) for name in sorted(values)]
    return _instructions(function.__code__), repr(function.__defaults__), referred


def _names(code: CodeType) -> Iterator[str]:
    """Yield the names of globals and attributes that code mentions, nested functions included."""
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)


def _instructions(code: CodeType) -> tuple[bytes, tuple[str, ...], list[Any]]:
    """Return (bytecode, names, constants) of code, to compare by.

    The constants are texts, and for a nested function again such a triple.
    """
    constants = [
        _instructions(constant) if isinstance(constant, CodeType) else repr(constant)
        for constant in code.co_consts
    ]
    return code.co_code, code.co_names, constants
