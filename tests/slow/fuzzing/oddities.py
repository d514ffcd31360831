"""What stands in the place of a trace, a label, an id, a setting or a word of a command; and content that is damaged."""

from __future__ import annotations

import random
from contextlib import suppress
from typing import Any

import numpy as np

SAMPLES = 40
ODD = [
    *(None, True, False, 0, 1, -1, 2, 100, 255, 2**31, 2**63, 2**70, -(2**64), 10**400, 0.0, 1.0, 0.5, -0.0, 1e308, 1e-320),
    *(
        float("nan"),
        float("inf"),
        -float("inf"),
        1j,
        "",
        "x",
        "NG",
        "0",
        "1",
        "True",
        "nan",
        "\0",
        "\ud800",
        "é" * 300,
        "a\nb",
    ),
    *("x" * 10_000, b"", b"\0", b"1", [], [0], [[1]], (), {}, {"a": 1}, {1}, object(), int, len, range(3), slice(1)),
    *(np.nan, np.int8(1), np.uint64(2**63), np.float16("inf"), np.bool_(True), np.array(1), np.array([]), np.array([1])),
    *(np.array("a"), np.array([None]), np.zeros((2, 2)), np.ma.masked, np.datetime64("nat"), np.timedelta64(1)),
]
SHAPES = [
    (),
    (0,),
    (1,),
    (3,),
    (SAMPLES - 1,),
    (SAMPLES,),
    (SAMPLES,),
    (1, SAMPLES),
    (SAMPLES, 1),
    (2, SAMPLES),
    (1, 1, SAMPLES),
]
DTYPES = ["f2", "f4", "f8", "g", "i1", "u8", "?", "c8", "M8[s]", "S3", "U2", "O", ">f4", ">i8"]
TOML = [
    *(
        "0",
        "1",
        "-1",
        "true",
        "nan",
        "inf",
        "1e400",
        "9" * 400,
        "9" * 5000,
        '""',
        '"x"',
        '"none"',
        "[]",
        "[[1]]",
        "{}",
        "{a=1}",
    ),
    *(
        "1979-05-27",
        "07:32:00",
        "[" * 300,
        '"a:b"',
        '"\\u0000"',
        "0.05",
        "0.9",
        "'''",
        "0x7fffffffffffffffffff",
        "\x80",
        "\0",
    ),
]
WORDS = [
    *(
        "",
        "x",
        "-1",
        "0",
        "nan",
        "inf",
        "1e400",
        "1.5",
        "-",
        "--",
        "--out",
        "--json",
        "\ud800",
        "é",
        "a b",
        ",",
        ",,",
        "a,b",
        ".",
        "/",
    ),
    *("..", "/dev/null", "missing/file", "x" * 300, "%s", "{}", "a:b", ":", "http://x", "sqlite://", "none", "=", "*"),
]


def spoilt(rng: random.Random, content: bytes) -> bytes:
    """The content with bytes changed, cut, doubled, moved or zeroed."""
    out = bytearray(content)
    for _ in range(rng.choice((1, 1, 1, 2, 8, 64))):
        at, size = rng.randrange(len(out) + 1), rng.choice((1, 1, 2, 8, 100))
        match rng.randrange(6):
            case 0 | 1 if at < len(out):
                out[at] = rng.randrange(256)
            case 2:
                del out[at:]
            case 3:
                del out[at : at + size]
            case 4:
                out[at:at] = rng.randbytes(size)
            case _:
                out[at : at + size] = bytes(len(out[at : at + size]))
    return bytes(out)


def odd_trace(rng: random.Random) -> Any:
    """Something in the place of a trace."""
    if rng.random() < 0.3:
        return rng.choice(ODD)
    shape, dtype = rng.choice(SHAPES), rng.choice(DTYPES)
    values = np.random.default_rng(rng.randrange(2**32)).normal(size=shape) * 10.0 ** rng.randint(-3, 3)
    with np.errstate(all="ignore"), suppress(TypeError, ValueError):
        array = np.array(values if dtype[-1] in "fgdO" or dtype[1:2] in "248" else np.abs(values)).astype(dtype)
        if array.size and array.dtype.kind == "f" and rng.random() < 0.5:
            array.flat[rng.randrange(array.size)] = rng.choice((np.nan, np.inf, -np.inf, 1e30, 0.0))
        return array if rng.random() < 0.7 else array.tolist()
    return values
