"""What hypothesis draws here: odd values of every kind, arrays, and files with damaged bytes.

DENGINE_FUZZ=20000 python -m pytest tests/slow/fuzzing --hypothesis-seed=1
"""

import os
from collections.abc import Callable
from typing import Any

import numpy as np
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

ASKED = os.environ.get("DENGINE_FUZZ", "")
SAMPLES = 40
OBJECTS = [object(), int, len, range(3), slice(1), np.ma.masked, "\ud800", 10**400]

plain = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=300)
nested = st.recursive(
    plain, lambda item: st.lists(item, max_size=4) | st.dictionaries(st.text(max_size=5), item)
)
SHAPES = ", 0, 1, 39, 40, 1 40, 40 1, 2 40, 1 1 40"
shapes = st.sampled_from([tuple(map(int, shape.split())) for shape in SHAPES.split(",")])
arrays = hnp.arrays(hnp.scalar_dtypes() | st.sampled_from([np.dtype("S3"), np.dtype("U2")]), shapes)
anything = nested | st.binary(max_size=9) | st.complex_numbers() | st.sampled_from(OBJECTS) | arrays
objects = arrays.map(lambda array: array.astype(object))
traces = arrays | arrays.map(np.ndarray.tolist) | objects | anything


def tries(share: float = 1.0) -> Callable[[Any], Any]:
    """How often a test is tried: DENGINE_FUZZ times its share; without it 100 times, the same ones
    each time.
    """
    return settings(
        max_examples=max(5, int(share * int(ASKED or 100))),
        derandomize=not ASKED,
        deadline=None,
        database=None,
        suppress_health_check=list(HealthCheck),
        phases=(Phase.generate, Phase.shrink),
    )


@st.composite
def spoilt(draw, content):
    """The content with bytes changed, cut, put in, or zeroed."""
    out = bytearray(content)
    for _ in range(draw(st.sampled_from([1, 1, 1, 2, 8]))):
        at = draw(st.integers(0, len(out)))
        end = at + draw(st.sampled_from([0, 1, 1, 2, 8, 100, len(out)]))
        out[at:end] = draw(st.binary(max_size=8) | st.just(bytes(end - at)))
    return bytes(out)
