"""Compile modules to TorchScript (`script`), and copy stored arrays back into modules (`restore`,
`arrays_with_prefix`). The reducers, the model, the store's history and the export use these
helpers.
"""

import threading
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from ..errors import StoreError
from .code import remember_code

_SCRIPTING = threading.Lock()


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
