"""Detects code that was changed after TorchScript compiled it: torch compiles each class once.

A notebook cell that is run again defines another class, which is compiled. But if a method, a
helper's method, a function or a constant of a module is replaced, the class stays the same, and
torch answers with the code of before. `scripting.script` remembers what it compiled; the model then
answers in Python, and the export refuses.
"""

import sys
from collections.abc import Iterator
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
    """Note the present code of a module, and of all modules in it, as compiled."""
    for unit in _user_code(module):
        _COMPILED.setdefault(unit, _code_text(unit))


def is_code_changed(module: nn.Module) -> bool:
    """Return whether a module, or one in it, has other code than was compiled in this process."""
    return any(
        unit in _COMPILED and _COMPILED[unit] != _code_text(unit) for unit in _user_code(module)
    )


def _user_code(module: nn.Module) -> Iterator[Any]:
    """Yield the classes and functions of a module that are not a library's."""
    for submodule in module.modules():
        functions = [value for value in vars(submodule).values() if isinstance(value, FunctionType)]
        for unit in (type(submodule), *functions):
            if not _is_of_library(unit):
                yield unit


def _is_of_library(value: Any) -> bool:
    """Return whether a module, class or function belongs to `LIBRARIES`."""
    attribute = "__name__" if isinstance(value, ModuleType) else "__module__"
    name = getattr(value, attribute, None)
    return str(name).partition(".")[0] in LIBRARIES


def _code_text(unit: Any) -> str:
    """Return a text that changes whenever code or constants that the unit refers to change."""
    return repr(_describe(unit, set(), set()))


def _describe(value: Any, names: set[str], seen: set[int]) -> Any:
    """Return all code that a value refers to, and the constants in it, as nested tuples and lists.

    `names` are those that the referring code mentions: of a module only these count. `seen` holds
    the ids of values that were described already, and grows.
    """
    if isinstance(value, staticmethod | classmethod):
        return _describe(value.__func__, names, seen)
    if isinstance(value, property):
        return _describe(value.fget, names, seen)
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


def _describe_function(function: FunctionType, seen: set[int]) -> Any:
    """Return instructions, defaults, and a description of all that a function refers to."""
    mentioned = set(_names(function.__code__))
    namespace = function.__globals__
    values = {name: namespace[name] for name in mentioned & namespace.keys()}
    cells = function.__closure__ or ()
    for name, cell in zip(function.__code__.co_freevars, cells, strict=True):
        values[name] = cell.cell_contents
    referred = [(name, _describe(values[name], mentioned, seen)) for name in sorted(values)]
    return _instructions(function.__code__), repr(function.__defaults__), referred


def _names(code: CodeType) -> Iterator[str]:
    """Yield the names that code mentions, nested functions included."""
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)


def _instructions(code: CodeType) -> Any:
    """Return bytecode, names and constants of code, nested functions included."""
    constants = [
        _instructions(constant) if isinstance(constant, CodeType) else repr(constant)
        for constant in code.co_consts
    ]
    return code.co_code, code.co_names, constants
