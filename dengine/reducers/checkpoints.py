"""Checkpoints of a network: weights of one copy of it, from which all copies in a reducer start.
`save_checkpoint` writes one; `TorchReducer(checkpoint=...)` reads it with `load_checkpoint`. A
checkpoint holds tensors alone, so that loading it runs no code.
"""

import re
from io import BytesIO
from pathlib import Path

import torch
from torch import Tensor

from ..errors import SettingError, expect, instead
from ..files import write_output
from .encoder import Members

SEPARATE = re.compile(r"^(networks\.networks\.)\d+\.")  # names of parameters in `encoder.Separate`


def save_checkpoint(members: Members, path: str | Path) -> None:
    """Write the weights of `members`, a single copy of a network, to a file.

    An existing file is replaced, but no database, folder or link. The file is written as a whole or
    not at all. Buffers, such as the statistics of batch normalisation, are written as well. Raises
    SettingError if `members` holds more than one copy, OutputError if the file cannot be written.
    """
    expect(members.count == 1, "a single copy of the network", members.count)
    content = BytesIO()  # torch's own writer aborts the process on a full disk
    torch.save(members.state_dict(), content)
    write_output(path, content.getvalue(), force=True)


def load_checkpoint(members: Members, path: str | Path) -> None:
    """Copy the weights in a file into every copy of the network in `members`, in place.

    The file is a checkpoint, which `save_checkpoint` wrote. Buffers, such as the statistics of
    batch normalisation, are copied as well.

    Raises
    ------
    SettingError
        If the file cannot be read, holds anything but dense tensors, has other names or shapes than
        the network, or has values that are not finite. `members` is then unchanged.
    """
    weights = read_tensors(path)
    state = members.state_dict()
    names = {name: SEPARATE.sub(r"\g<1>0.", name) for name in state}  # in the checkpoint
    shapes = {
        names[name]: shape_of_member(name, value, members.count) for name, value in state.items()
    }
    fits = {name: value.shape for name, value in weights.items()} == shapes
    is_finite = all(value.isfinite().all() for value in weights.values())
    expect(
        fits and is_finite,
        "finite weights of this network, for traces of this many channels",
        f"others in {path}",
        "train it and write them with save_checkpoint",
    )
    for name, value in state.items():
        weight = weights[names[name]]
        value.view(-1, *weight.shape).copy_(weight)  # the same weights for each copy


def read_tensors(path: str | Path) -> dict[str, Tensor]:
    """Return the dict of tensors that `torch.save` wrote to a file, without running code of it.

    The tensors are on the CPU, need no gradient, and have their names as keys. Raises SettingError
    if the file cannot be read, or holds anything but a dict of dense tensors of types that NumPy
    has.
    """
    with instead(SettingError, f"The checkpoint {path} cannot be read", OSError):
        content = Path(path).read_bytes()
    try:
        weights = torch.load(BytesIO(content), map_location="cpu", weights_only=True)
        # NumPy refuses what does not hold each of its numbers, such as a sparse tensor.
        return {name: torch.from_numpy(value.detach().numpy()) for name, value in weights.items()}
    except Exception:  # a damaged file raises many types, one of which advises to run its code
        raise SettingError(
            f"Expected a checkpoint of named dense tensors alone, {path} is none; write one with "
            "save_checkpoint."
        ) from None


def shape_of_member(name: str, value: Tensor, count: int) -> torch.Size:
    """Return the shape that a tensor of a `Members` of `count` copies has in a checkpoint.

    A checkpoint holds one copy. `name` is the tensor's name in the `state_dict`. The copies lie
    along the first axis, whose length is therefore divided by `count`. A tensor without axes, and
    one of a network that is a module of its own (`Separate`), keep their shape.
    """
    if value.dim() == 0 or SEPARATE.match(name):
        return value.shape
    return torch.Size([value.shape[0] // count, *value.shape[1:]])
