"""Labelled traces: the bundled set by name, files by path.

>>> load_dataset("insertion")                          # 1503 simulated insertions, shipped with the package
>>> load_dataset("recorded.npz", samples=400)          # X (n, T) or (n, C, T), y (n,)
"""

from __future__ import annotations

import zipfile
from dataclasses import dataclass, replace
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import DataError

BUNDLED = {"insertion": "insertion.npz"}


@dataclass(frozen=True, slots=True)
class Dataset:
    """Labelled traces in the order they were recorded.

    X : (n, T) or (n, C, T) float32.  y : (n,) int8, 1 = success, 0 = failure.
    name, rate_hz, unit : for people.  cause : (n,) why a part failed, where that is known.
    part : (n,) the number of the part that each trace was recorded on; None: every trace is a part of its own.
    """

    X: NDArray[np.float32]
    y: NDArray[np.int8]
    name: str = "data"
    rate_hz: float = 500.0
    unit: str = "N"
    cause: NDArray[np.str_] | None = None
    part: NDArray[np.str_] | None = None

    def __len__(self) -> int:
        return len(self.y)

    def cut(self, samples: int) -> Dataset:
        """The first `samples` samples of every trace: an earlier, harder moment to decide at."""
        have = self.X.shape[-1]
        if not 1 <= samples <= have:
            raise DataError(f"Expected 1 to {have} samples of {self.name}, got {samples}.")
        return replace(self, X=np.ascontiguousarray(self.X[..., :samples]))


def load_dataset(source: Any = "insertion", samples: int | None = None, part: str = "part") -> Dataset:
    """A data set from a name, a path to an .npz file, a `Dataset`, or a pair (X, y).

    A file holds `X` (n, T) or (n, C, T), any real dtype, times the number `scale` where one is stored, and `y` (n,).
    part : the name of the array of parts' numbers in a file, texts or whole numbers. Where there is no `part`, every trace
        is a part of its own.
    Raises DataError for what cannot be read or does not fit together.
    """
    data = _load(source, part)
    return data if samples is None else data.cut(samples)


def _load(source: Any, part: str) -> Dataset:
    if isinstance(source, Dataset):
        return source
    if isinstance(source, tuple):
        return make_dataset(*source)
    if str(source) in BUNDLED:
        with as_file(files("dengine") / "data" / BUNDLED[str(source)]) as path:
            return _read(path, str(source), part)
    path = Path(source)
    if not path.is_file():
        raise DataError(f"Expected a data set among {', '.join(BUNDLED)}, or an .npz file; {source} is neither.")
    return _read(path, path.stem, part)


def _read(path: Path, name: str, part: str) -> Dataset:
    try:
        with np.load(path, allow_pickle=False) as file:
            if not {"X", "y"} <= set(file.files):
                raise DataError(f"Expected arrays X and y in {path}, found {', '.join(file.files) or 'none'}.")
            X = file["X"].astype(np.float32)
            X *= np.float32(file["scale"]) if "scale" in file.files else np.float32(1.0)
            if part != "part" and part not in file.files:
                raise DataError(f"Expected an array {part} in {path}, found {', '.join(file.files)}.")
            parts = file[part] if part in file.files else None
            extra = {key: file[key] for key in ("rate_hz", "unit", "cause") if key in file.files}
            y = file["y"]
    except (OSError, ValueError, zipfile.BadZipFile, EOFError) as error:
        if isinstance(error, DataError):
            raise
        said = "it holds something else" if "pickle" in str(error) else error  # NumPy advises to load pickles: never
        raise DataError(f"Cannot read {path} as an .npz file of plain arrays: {said}.") from error
    rate, unit = float(extra.get("rate_hz", 500.0)), str(extra.get("unit", "N"))
    return make_dataset(X, y, name=name, rate_hz=rate, unit=unit, cause=extra.get("cause"), part=parts)


def make_dataset(X: ArrayLike, y: ArrayLike, **about: Any) -> Dataset:
    """A `Dataset` from arrays; DataError where they do not fit together."""
    X, y = np.asarray(X, dtype=np.float32), np.asarray(y)
    if X.ndim not in (2, 3) or y.shape != (len(X),):
        raise DataError(f"Expected X (n, T) or (n, C, T) with n labels, got X {X.shape} and y {y.shape}.")
    if not len(y):
        raise DataError("Expected at least one trace, got none.")
    if not np.isin(y, (0, 1)).all():
        raise DataError(f"Expected labels 1 (success) and 0 (failure), got {np.unique(y)[:5]}.")
    part = about.pop("part", None)
    if part is not None:
        part = np.asarray(part)
        if part.shape != y.shape or part.dtype.kind not in "iuUS":
            raise DataError(f"Expected {len(y)} parts' numbers, texts or integers, got {part.shape} of {part.dtype}.")
        part = part.astype(np.str_)
    return Dataset(X, y.astype(np.int8), part=part, **about)
