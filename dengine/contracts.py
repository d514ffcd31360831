"""How a first trace sets the contract of all that follow, and what is said where it set a wrong one.

A contract holds for an engine's whole life, so not every trace may set it: one that is quarantined is verified, and the
next one is asked; one of a few samples is a caller's bug, unless `TraceSpec` says that it is meant.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from .errors import TraceError
from .records import TraceSpec
from .traces import TraceGate, as_trace, spec_of

LEAST = 10  # samples of a trace that sets a contract: 20 ms at 500 Hz, and a picture of nothing


def as_agreed(trace: Any, spec: TraceSpec | None, may_start_over: bool) -> NDArray[np.float32]:
    """`as_trace`; may_start_over : the contract was set by the first trace, and no label was reported on it yet."""
    try:
        return as_trace(trace, spec)
    except TraceError as error:
        if not may_start_over or spec is None:
            raise
        raise TraceError(
            f"{error} The contract, {spec.channels} x {spec.samples}, was set by the first trace, and nothing was learned "
            "by it yet: if that trace was the wrong one, start over with a new store and DataEngine(trace=TraceSpec(...))."
        ) from error


def first_contract(x: NDArray[np.float32], trace: Any) -> tuple[TraceSpec, bool]:
    """The contract that a first trace (C, T), before it was cast `trace`, would set; and whether it is fit to set it.

    TraceError for one of fewer than LEAST samples.
    """
    spec = spec_of(x, trace)
    if spec.samples < LEAST:
        raise TraceError(
            f"Expected a first trace of {LEAST} samples or more, for it sets the contract of all that follow, got "
            f"{spec.channels} x {spec.samples}; record longer, or pass DataEngine(trace=TraceSpec({spec.samples}, "
            f"channels={spec.channels})) if it is meant."
        )
    return spec, TraceGate(spec)(torch.from_numpy(x))[0] == 0
