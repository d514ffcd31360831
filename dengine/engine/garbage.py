"""Two blocks that keep Python's garbage collector away from decisions."""

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def frozen_objects() -> Iterator[None]:
    """Let Python's garbage collector ignore, until the block ends, all objects that exist now.

    A collection would go through 420,000 objects of imported libraries in 250 ms and free nothing.
    No collection is run when the block begins. The whole process is affected, and the end of the
    block unfreezes what other code froze, too: use it only if no other code in the process calls
    `gc.freeze`.
    """
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


@contextmanager
def uncollected() -> Iterator[None]:
    """Switch Python's garbage collector off in the block, then on again if it was on before.

    The whole process is affected.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()
