"""Finished replays on disk, by what they are: an interrupted grid goes on where it was.

    kept = KeptReplays("out/kept", data)
    replay = kept.get(task) or ...            # the very same, but for the times of that run
    kept.put(task, replay)

A file's name is a hash of all that its decisions depend on: the traces and labels, every setting, the seed, dengine's own
source, and the versions of the libraries that compute. Nothing is unpickled. A file that cannot be read is a replay that is
not there.
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
import zipfile
import zlib
from dataclasses import asdict, dataclass, fields
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from inspect import getsourcefile
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np

from ..datasets import Dataset
from ..records import RetrainReport
from .contenders import Contender, parts_of
from .replay import Replay

# What of a replay is no array, beside its recipe.
ABOUT = ("name", "dataset", "seed", "confirm", "seconds", "encoder_steps", "encoder_seconds", "slice_max_s")
LIBRARIES = ("numpy", "scipy", "torch", "scikit-learn", "umap-learn", "numba", "aeon", "mapie", "river")
DAMAGED = (  # what reading a damaged file ends in, by where the damage is
    OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile, zlib.error, RuntimeError
)  # fmt: skip


@dataclass(frozen=True)
class Task:
    """One replay to be played: who, which shuffle, how many cycles, and what is known of accepted parts."""

    contender: Contender
    seed: int
    cycles: int | None = None
    shuffle: bool = True
    confirm: bool = False

    @property
    def description(self) -> str:
        """All that its decisions depend on beside the data."""
        own = {"seed": self.seed, "cycles": self.cycles, "shuffle": self.shuffle, "confirm": self.confirm}
        return f"{self.contender.description}\n{json.dumps(own)}"


class KeptReplays:
    """A folder of finished replays of one data set; made if need be."""

    def __init__(self, folder: str | os.PathLike[str], data: Dataset) -> None:
        self.folder = Path(folder)
        self.folder.mkdir(parents=True, exist_ok=True)
        self._of_data = _digest_of(data)
        self._own: dict[Any, str] = {}  # read once: a file that changes while a grid is played is not what was imported

    def path(self, task: Task) -> Path:
        """Where the replay of a task is kept."""
        said = f"{self._of_data}\n{_digest_of_source()}\n{self._own_source(task.contender)}\n{task.description}"
        return self.folder / f"{hashlib.sha256(said.encode()).hexdigest()[:32]}.npz"

    def get(self, task: Task) -> Replay | None:
        """The replay, under the contender's present name; None where it is not there, or damaged."""
        path = self.path(task)
        try:
            with np.load(path, allow_pickle=False) as file:
                return _replay_of({name: file[name] for name in file.files}, task.contender)
        except DAMAGED:
            return None

    def _own_source(self, contender: Contender) -> str:
        """The text of the files that a reducer and its parts stand in: what it does changes with them."""
        from ..reducers import reducer_class

        own = contender.recipe.reducer
        parts = [reducer_class(own)] if isinstance(own, str) else parts_of(own)
        self._own |= {part: _source_of(part) for part in parts if part not in self._own}
        return "".join(self._own[part] for part in parts)

    def put(self, task: Task, replay: Replay) -> None:
        """Keep a finished replay: the whole file or none, whatever happens meanwhile."""
        partial = self.folder / f".{uuid4().hex}.partial"
        try:
            with partial.open("xb") as file:
                np.savez_compressed(file, **_arrays_of(replay))
            partial.replace(self.path(task))
        finally:
            partial.unlink(missing_ok=True)


def _arrays_of(replay: Replay) -> dict[str, Any]:
    values = {f.name: getattr(replay, f.name) for f in fields(replay)}
    arrays = {name: value for name, value in values.items() if isinstance(value, np.ndarray)}
    about = {name: values[name] for name in ABOUT} | {"retrains": [asdict(each) for each in replay.retrains]}
    return {**arrays, "about": np.array(json.dumps(about))}


def _replay_of(arrays: dict[str, Any], contender: Contender) -> Replay:
    about = json.loads(str(arrays.pop("about")))
    retrains = tuple(RetrainReport(**each) for each in about.pop("retrains"))
    named = about | {"name": contender.name, "recipe": contender.recipe}
    return Replay(**arrays, **named, retrains=retrains)


def _digest_of(data: Dataset) -> str:
    digest = hashlib.sha256(f"{data.name} {data.X.shape} {data.rate_hz}".encode())
    for array in (data.X, data.y, data.part):
        digest.update(b"none" if array is None else np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


@cache
def _digest_of_source() -> str:
    digest = hashlib.sha256(f"{sys.version_info[:2]} {[_version_of(name) for name in LIBRARIES]}".encode())
    for path in sorted(Path(__file__).parents[1].rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def _version_of(library: str) -> str:
    try:
        return version(library)
    except PackageNotFoundError:
        return ""


def _source_of(part: Any) -> str:
    try:
        return Path(getsourcefile(part) or "").read_text(encoding="utf-8")
    except (OSError, TypeError, UnicodeDecodeError):
        return ""  # typed at a prompt, or compiled
