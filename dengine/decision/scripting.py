"""Compile modules to TorchScript (`script`), find the tensors of a module (`attributes_of`,
`has_tensor`), store those of all its submodules (`register_tensors`, `module_state`), and copy
stored values back into it (`restore`, `arrays_with_prefix`). The reducers, the model, the store's
history and the export use these helpers.
"""

import threading
import warnings
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from ..errors import VersionError
from ..records import Arrays, State

_SCRIPTING = threading.Lock()
# Attributes in which torch keeps parameters, submodules and hooks; scripting adds the last.
INTERNAL = {*vars(nn.Module()), "__overloads__"} - {"training"}


def script(module: nn.Module) -> Any:
    """Compile a module with `torch.jit.script`, without its deprecation notice.

    Only one thread compiles at a time; another one waits. If two parse at once, Python's parser
    raises "AST constructor recursion depth mismatch".

    Parameters
    ----------
    module : nn.Module
        The module to compile. TorchScript keeps the first code of a class: a method that is
        replaced afterwards is not compiled again.

    Returns
    -------
    torch.jit.ScriptModule
        It shares the tensors of `module`.

    Raises
    ------
    RuntimeError, torch.jit.frontend.FrontendError
        If TorchScript cannot compile it, because of its types or of its syntax.
    OSError
        If its source text cannot be found.
    """
    with _SCRIPTING, warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=r".*torch\.jit\..* is deprecated.*")
        return torch.jit.script(module)


def reason_of(error: Exception) -> str:
    """Return the type of an error and the line of its message that says what is wrong.

    That is the first line; for an error inside TorchScript, whose message begins with a traceback,
    the last one.
    """
    lines = str(error).strip().splitlines() or [""]
    return f"{type(error).__name__}: {lines[-isinstance(error, torch.jit.Error)]}"


def attributes_of(module: nn.Module) -> dict[str, Any]:
    """Return parameters, buffers and plain attributes of one module by name, without submodules.

    Plain attributes are those of the object itself, `training` among them, except the ones in which
    torch keeps parameters, submodules and hooks.
    """
    plain = {name: value for name, value in vars(module).items() if name not in INTERNAL}
    plain |= module.named_parameters(recurse=False, remove_duplicate=False)
    plain |= module.named_buffers(recurse=False, remove_duplicate=False)
    return plain


def has_tensor(value: Any) -> bool:
    """Return whether a value is a tensor, or a list, tuple or dict with one in it at any depth."""
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list | tuple):
        return any(map(has_tensor, value))
    return isinstance(value, Tensor)


def register_tensors(module: nn.Module) -> None:
    """Make the plain tensors of a module part of its `state_dict`, as persistent buffers.

    These are attributes that hold a tensor, and buffers that are not persistent, also of its
    submodules. A tensor that is not contiguous is replaced by a copy, also if it is a persistent
    buffer already, since an expanded view, in which several numbers share memory, cannot be written
    to. Parameters and tensors in a list, tuple or dict stay as they are, and so does a tensor whose
    name is an attribute of the class of its module. Modules are changed in place.
    """
    for submodule in module.modules():
        for name, value in attributes_of(submodule).items():
            if (
                isinstance(value, Tensor)
                and not isinstance(value, nn.Parameter)
                and not hasattr(type(submodule), name)
            ):
                vars(submodule).pop(name, None)
                submodule.register_buffer(name, value.contiguous())


def module_state(module: nn.Module, prefix: str) -> State:
    """Return copies of a module's parameters and buffers as arrays, by `prefix` and their name."""
    return {
        f"{prefix}{name}": tensor.numpy().copy() for name, tensor in module.state_dict().items()
    }


def arrays_with_prefix(state: Arrays, prefix: str) -> State:
    """Return the arrays of a state whose names begin with `prefix`, by the rest of their names.

    The arrays are not copied. Without such a name the result is empty.
    """
    return {
        name.removeprefix(prefix): array for name, array in state.items() if name.startswith(prefix)
    }


def restore(module: nn.Module, arrays: Arrays) -> None:
    """Copy arrays, in place, into the parameters and buffers of a module.

    Parameters
    ----------
    module : nn.Module
        The module that is changed.
    arrays : mapping of str to array
        One array for each name in `module.state_dict()`; they are cast to the tensors' dtypes.

    Raises
    ------
    StoreError
        If the names or shapes are not those of the module; nothing is written then. The values are
        not checked.
    """
    tensors = module.state_dict()  # shares its tensors with the module
    shapes = {name: tuple(tensor.shape) for name, tensor in tensors.items()}
    if {name: array.shape for name, array in arrays.items()} != shapes:
        raise incompatible_model_error(f"{type(module).__name__} has other sizes")
    for name, array in arrays.items():
        tensors[name].copy_(torch.from_numpy(np.array(array)))


def incompatible_model_error(defect: str) -> VersionError:
    """Return the error for a stored model of another reducer, or of another version of dengine.

    `defect` ends the phrase "got one whose ...", for example "encoder has other sizes".
    """
    return VersionError(
        "Expected a model of this reducer and of this version of dengine, got one whose "
        f"{defect}; its labels are whole: pass the reducer of the store, or learn from them anew, "
        "by `dengine train --data OLD.db --store NEW.db`."
    )
