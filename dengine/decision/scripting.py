"""Compile modules to TorchScript (`script`), find all tensors of a module (`tensor_attributes`,
`plain_tensors`), and copy stored values back into modules (`restore`, `restore_plain_tensors`,
`arrays_with_prefix`). The reducers, the model, the store's history and the export use these
helpers.
"""

import threading
import warnings
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from ..errors import StoreError
from .code import remember_code

_SCRIPTING = threading.Lock()
# Attributes in which torch keeps parameters, submodules and hooks; scripting adds the last.
INTERNAL = {*vars(nn.Module()), "__overloads__"} - {"training"}


def script(module: nn.Module) -> Any:
    """Compile a module with `torch.jit.script`, without its deprecation notice.

    TorchScript works in the supported range of PyTorch. The call waits while another thread
    compiles: where two parse at once, Python's parser raises "AST constructor recursion depth
    mismatch".

    Parameters
    ----------
    module : nn.Module
        The module to compile. Its code is remembered, so that `code.is_code_changed` notices a
        later change.

    Returns
    -------
    torch.jit.ScriptModule
        It shares the tensors of `module`.

    Raises
    ------
    RuntimeError
        If TorchScript cannot compile it.
    """
    with _SCRIPTING, warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=r".*torch\.jit\..* is deprecated.*")
        scripted = torch.jit.script(module)
    remember_code(module)
    return scripted


def reason_of(error: Exception) -> str:
    """Return the type of an error and the line of its message that says what is wrong.

    That is the first line, and of an error inside TorchScript, which begins with a trace, the last.
    """
    lines = str(error).strip().splitlines() or [""]
    return f"{type(error).__name__}: {lines[-isinstance(error, torch.jit.Error)]}"


def tensor_attributes(module: nn.Module) -> Iterator[tuple[str, Any]]:
    """Yield every attribute that holds tensors, of a module and its submodules, as (name, value).

    These are parameters, buffers, and plain attributes: tensors, and lists, tuples and dicts with
    tensors in them. What is shared comes under each of its names.
    """
    for path, submodule in module.named_modules(remove_duplicate=False):
        prefix = f"{path}." if path else ""
        for name, parameter in submodule.named_parameters(recurse=False, remove_duplicate=False):
            yield prefix + name, parameter
        for name, buffer in submodule.named_buffers(recurse=False, remove_duplicate=False):
            yield prefix + name, buffer
        for name, value in list(vars(submodule).items()):
            if name not in INTERNAL and next(tensors_in(name, value), None) is not None:
                yield prefix + name, value


def tensors_in(name: str, value: Any) -> Iterator[tuple[str, Tensor]]:
    """Yield each tensor in a value as (name, tensor); those of a list are "NAME.0" and so on."""
    if isinstance(value, Tensor):
        yield name, value
    elif isinstance(value, list | tuple | dict):
        items = value.items() if isinstance(value, dict) else enumerate(value)
        for key, item in items:
            yield from tensors_in(f"{name}.{key}", item)


def plain_tensors(module: nn.Module) -> dict[str, Tensor]:
    """Return the tensors of a module that `module.state_dict()` leaves out, by name.

    These are buffers that are not persistent, and plain attributes, see `tensor_attributes`.
    """
    tensors: dict[str, Tensor] = {}
    known = {id(tensor) for tensor in module.state_dict(keep_vars=True).values()}
    for attribute, value in tensor_attributes(module):
        tensors |= {
            n: tensor for n, tensor in tensors_in(attribute, value) if id(tensor) not in known
        }
    return tensors


@torch.no_grad()
def restore_plain_tensors(module: nn.Module, tensors: Mapping[str, Tensor]) -> None:
    """Copy tensors, in place, into those of `plain_tensors(module)` with their name and shape.

    What the module has already is not written, since an expanded tensor cannot be written to.
    """
    for name, target in plain_tensors(module).items():
        source = tensors.get(name, target)
        if source.shape == target.shape and not torch.equal(source, target):
            target.copy_(source)


def arrays_with_prefix(state: Mapping[str, NDArray[Any]], prefix: str) -> dict[str, NDArray[Any]]:
    """Return the arrays of a state whose names begin with `prefix`, by the rest of their names."""
    return {
        name.removeprefix(prefix): array for name, array in state.items() if name.startswith(prefix)
    }


def restore(module: nn.Module, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Copy arrays, in place, into the parameters and buffers of a module.

    Parameters
    ----------
    module : nn.Module
        The module to write to.
    arrays : mapping of str to array
        One array for each name in `module.state_dict()`; they are cast to the tensors' dtypes.

    Raises
    ------
    StoreError
        If the names or shapes are not those of the module; nothing is written then.
    """
    tensors = module.state_dict()  # shares its tensors with the module
    shapes = {name: tuple(tensor.shape) for name, tensor in tensors.items()}
    if {name: array.shape for name, array in arrays.items()} != shapes:
        raise incompatible_model_error(f"{type(module).__name__} has other sizes")
    for name, array in arrays.items():
        tensors[name].copy_(torch.from_numpy(np.array(array)))


def incompatible_model_error(defect: str) -> StoreError:
    """Return the error for a stored model of another reducer, or of another version of dengine.

    `defect` ends the phrase "a model whose ...", for example "encoder has other sizes".
    """
    actual = f"one whose {defect}; its labels are whole"
    do = (
        "pass the reducer of the store, or learn from them anew, by "
        "`dengine train --data OLD.db --store NEW.db`"
    )
    return StoreError(
        f"Expected a model of this reducer and of this version of dengine, got {actual}: {do}."
    )
