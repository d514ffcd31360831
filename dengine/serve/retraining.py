"""The process in which a served engine retrains: another one, so that no decision waits for Python's lock.

torch passes every tensor of a model through shared memory of its own: a hundred of them take Python's lock for tens of
milliseconds, in which nothing is answered; an executor of the standard library would. Here they are plain bytes.
"""

from __future__ import annotations

import io
import multiprocessing
import os
import pickle
import queue
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Executor, Future
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

LARGE = 1 << 16  # bytes that are sent by themselves
NICE = 10  # decisions first, where cores are scarce
ENDED = "The retraining process has ended."


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
    for each in (file.getbuffer(), *(buffer.raw() for buffer in large)):
        connection.send_bytes(each)


def receive(connection: Connection) -> Any:
    """Receive what `send` sent. EOFError where the other side has ended."""
    sizes, main = connection.recv(), connection.recv_bytes()
    large = [bytearray(size) for size in sizes]  # arrays are made of them that can be written to
    for each in large:
        connection.recv_bytes_into(each)
    return pickle.loads(main, buffers=large)


T = TypeVar("T")


class RetrainingProcess(Executor):
    """An executor of one process, started anew and not forked: this one has threads, and a fork would have their locks.

    It ends with this process, also when this one is killed.
    """

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, other = context.Pipe()
        self._process = context.Process(target=_work, args=(other,), name="dengine-retraining", daemon=True)
        resource_tracker.ensure_running()  # its own start would let signals through again
        # What is started here never hears the signals to the whole group, nor while it begins: its parent ends it in time.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGTERM))
        try:
            self._process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        other.close()
        self._jobs: queue.SimpleQueue[tuple[Future[Any], Any] | None] = queue.SimpleQueue()
        self._ended = False
        self._thread = threading.Thread(target=self._run, name="dengine-retraining", daemon=True)
        self._thread.start()

    def submit(self, fn: Callable[..., T], /, *args: Any, **kwargs: Any) -> Future[T]:
        """Call a function there, after what was submitted before; BrokenExecutor where the process has ended."""
        if self._ended:
            raise BrokenExecutor(ENDED)
        future: Future[T] = Future()
        self._jobs.put((future, (fn, args, kwargs)))
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the process, whatever it is at: a retrain that was worth waiting for, its engine has waited for."""
        self._ended = True
        self._jobs.put(None)
        self._process.kill()
        self._process.join()
        self._thread.join()  # it finds the other end closed
        self._connection.close()

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            future, call = job
            if not future.set_running_or_notify_cancel():
                continue
            try:
                send(self._connection, call)
                result, error = receive(self._connection)
            except (EOFError, OSError):
                self._ended = True
                future.set_exception(BrokenExecutor(ENDED))
            except Exception as failure:  # it cannot be pickled
                future.set_exception(failure)
            else:
                future.set_result(result) if error is None else future.set_exception(error)


@contextmanager
def retraining_process() -> Iterator[Executor]:
    """A `RetrainingProcess`, ready for its first retrain soon."""
    with RetrainingProcess() as process:
        process.submit(_warm)
        yield process


def _work(connection: Connection) -> None:
    """In that process: answer calls, one after the other, until the other side ends."""
    with suppress(AttributeError, OSError):  # there is none on Windows
        os.nice(NICE)
    threading.Thread(target=_end_with_parent, name="dengine-parent", daemon=True).start()
    while True:
        try:
            fn, args, kwargs = receive(connection)
        except EOFError:
            return
        try:
            send(connection, (fn(*args, **kwargs), None))
        except Exception as error:  # raised where it was asked for
            send(connection, (None, RuntimeError(f"{type(error).__name__}: {error}")))


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


def _warm() -> None:
    """Import what a retrain needs, before the first one."""
