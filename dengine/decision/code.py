"""Whether a user's code is still what TorchScript compiled: torch compiles each class once in a process.

A notebook cell that is run again defines another class, which is compiled. But where a method, a
helper's method, a function or a constant of a module is replaced, the class stays the same, and
torch answers with the code of before.
"""

import sys
from collections.abc import Iterator
from types import CodeType, FunctionType, ModuleType
from typing import Any
from weakref import WeakKeyDictionary

from torch import nn

LIBRARIES = {*sys.stdlib_module_names, "dengine", "numpy", "scipy", "sklearn", "torch"} - {"__main__"}
PLAIN = bool, int, float, complex, str, bytes, tuple, list, dict, set, frozenset, type(None)

_COMPILED: WeakKeyDictionary[Any, str] = WeakKeyDictionary()  # what classes and functions referred to, compiled


def remember_code(module: nn.Module) -> None:
    """Note the code of a module, and of all in it, as compiled."""
    for unit in _user_code(module):
        _COMPILED.setdefault(unit, _code_of(unit))


def is_code_changed(module: nn.Module) -> bool:
    """Return whether the code of a module, or of one in it, is another than was compiled in this process."""
    return any(unit in _COMPILED and _COMPILED[unit] != _code_of(unit) for unit in _user_code(module))


def _user_code(module: nn.Module) -> Iterator[Any]:
    """The user's classes and functions that a module is made of."""
    for part in module.modules():
        for unit in (type(part), *(value for value in vars(part).values() if isinstance(value, FunctionType))):
            if not _is_of_library(unit):
                yield unit


def _is_of_library(value: Any) -> bool:
    name = value.__name__ if isinstance(value, ModuleType) else getattr(value, "__module__", None)
    return str(name).partition(".")[0] in LIBRARIES


def _code_of(unit: Any) -> str:
    return repr(_described(unit, set(), set()))


def _described(value: Any, names: set[str], seen: set[int]) -> Any:
    """All code that a value refers to, and the constants in it; names : that the code which refers to it mentions."""
    if isinstance(value, staticmethod | classmethod):
        return _described(value.__func__, names, seen)
    if isinstance(value, property):
        return _described(value.fget, names, seen)
    if isinstance(value, PLAIN):
        return repr(value)
    if not isinstance(value, FunctionType | type | ModuleType) or _is_of_library(value) or id(value) in seen:
        return getattr(value, "__qualname__", type(value).__qualname__)
    seen.add(id(value))
    if isinstance(value, ModuleType):
        return [(name, _described(vars(value)[name], names, seen)) for name in sorted(names & vars(value).keys())]
    if isinstance(value, type):
        classes = [each for each in value.__mro__ if not _is_of_library(each)]
        members = [(name, member) for each in classes for name, member in sorted(vars(each).items())]
        return [
            (name, _described(member, names, seen))
            for name, member in members
            if name not in ("__dict__", "__weakref__", "__module__", "__doc__", "__annotations__")
        ]
    mentioned = set(_names(value.__code__))
    known = {name: value.__globals__[name] for name in mentioned & value.__globals__.keys()}
    for name, cell in zip(value.__code__.co_freevars, value.__closure__ or (), strict=True):
        known[name] = cell.cell_contents
    referred = [(name, _described(known[name], mentioned, seen)) for name in sorted(known)]
    return _instructions(value.__code__), repr(value.__defaults__), referred


def _names(code: CodeType) -> Iterator[str]:
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)


def _instructions(code: CodeType) -> Any:
    constants = [_instructions(each) if isinstance(each, CodeType) else repr(each) for each in code.co_consts]
    return code.co_code, code.co_names, constants
