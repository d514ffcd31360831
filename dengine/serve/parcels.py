"""What goes from one process to another: pickled without copying what is large, and without a file for each tensor.

torch passes every tensor of a model through shared memory of its own: a hundred of them take Python's lock for tens of
milliseconds, in which nothing is answered. Here they are plain bytes, and large arrays are written from where they lie.
"""

from __future__ import annotations

import io
import pickle
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
import torch
from torch import Tensor

LARGE = 1 << 16  # bytes that are sent by themselves


class _Pickler(pickle.Pickler):
    """Pickles tensors as their storage's bytes; those that share a storage share it on the other side."""

    def __init__(self, file: io.BytesIO, buffer_callback: Callable[[pickle.PickleBuffer], bool]) -> None:
        super().__init__(file, 5, buffer_callback=buffer_callback)
        self._storages: dict[tuple[int, int], torch.UntypedStorage] = {}  # one object for each, which pickling knows again

    def reducer_override(self, obj: Any) -> Any:
        """How to make one object anew, as `object.__reduce_ex__` says it; NotImplemented for all but tensors."""
        if type(obj) is Tensor and obj.layout is torch.strided and obj.device.type == "cpu" and not obj.requires_grad:
            own = obj.untyped_storage()
            storage = self._storages.setdefault((own.data_ptr(), own.nbytes()), own)
            return _tensor, (storage, obj.dtype, obj.storage_offset(), tuple(obj.shape), obj.stride())
        if type(obj) is torch.UntypedStorage:
            return _storage, (torch.empty(0, dtype=torch.uint8).set_(obj).numpy(),)
        return NotImplemented


def _tensor(
    storage: torch.UntypedStorage, dtype: torch.dtype, offset: int, shape: tuple[int, ...], stride: tuple[int, ...]
) -> Tensor:
    return torch.empty(0, dtype=dtype).set_(storage, offset, shape, stride)


def _storage(raw: np.ndarray[Any, np.dtype[np.uint8]]) -> torch.UntypedStorage:
    return torch.from_numpy(raw).clone().untyped_storage()  # a copy lies as torch wants it, so that it computes alike


def send(connection: Connection, what: Any) -> None:
    """Send an object; it must not change until this returns."""
    file, large = io.BytesIO(), list[pickle.PickleBuffer]()

    def small(buffer: pickle.PickleBuffer) -> bool:
        if buffer.raw().nbytes < LARGE:
            return True
        large.append(buffer)
        return False

    _Pickler(file, small).dump(what)
    connection.send([buffer.raw().nbytes for buffer in large])
    connection.send_bytes(file.getbuffer())
    for buffer in large:
        connection.send_bytes(buffer.raw())


def receive(connection: Connection) -> Any:
    """Receive what `send` sent. EOFError where the other side has ended."""
    sizes, main = connection.recv(), connection.recv_bytes()
    large = [bytearray(size) for size in sizes]  # arrays are made of them that can be written to
    for each in large:
        connection.recv_bytes_into(each)
    return pickle.loads(main, buffers=large)
