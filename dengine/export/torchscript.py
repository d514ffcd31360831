"""One file for the cell controller: the engine's whole decision as TorchScript, with a checksum beside it.

>>> export_torchscript(engine, "model.ts")     # model.ts and model.ts.sha256
>>> load_exported("model.ts").decide(trace)    # checked before it is loaded, ready at the first call

An untrusted `.ts` file is a program: loading it runs what is in it, which can read and write files. Load only what you
made, or what was signed with a key of yours. The C and C++ sources that run an exported file depend on no model, so they
come by a verb of their own:

    dengine export --cpp cell_cpp
    cmake -S cell_cpp -B build/cpp -DCMAKE_PREFIX_PATH="$(python -c 'import torch; print(torch.utils.cmake_prefix_path)')"
"""

import copy
import io
import json
import os
import shutil
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from .. import __version__
from ..decision.members import SAFE_MODES
from ..decision.scripting import script
from ..engine.decide import as_part
from ..errors import ExportError, instead
from ..folds import part_hash
from ..records import ACTIONS, REASONS, Action, Reason, TraceSpec, as_success
from ..traces import as_trace, as_traces
from .bundle import METADATA, KeyFile, checked_bytes, describe, metadata_of, prepared, write_export
from .decision import METHODS

WARM_UP = 3
TOLERANCE = 1e-4  # of a scaled embedding: another processor may add in another order


def export_sources(folder: str | os.PathLike[str]) -> Path:
    """Write the sources into a new or an empty folder, and return it; ExportError for one that cannot be written."""
    target = Path(folder)
    with instead(ExportError, f"Cannot write {target}", OSError, do="choose a folder that is writable"):
        if target.exists() and (not target.is_dir() or any(target.iterdir())):
            raise ExportError(
                f"Expected a new or an empty folder for the sources, {target} holds something; name another folder."
            )
        shutil.copytree(Path(__file__).parent / "cpp", target, dirs_exist_ok=True)
        (target / "VERSION").write_text(f"{__version__}\n", encoding="utf-8")
    return target


def export_torchscript(
    engine_or_model: Any,
    path: str | os.PathLike[str],
    *,
    trace: TraceSpec | None = None,
    key: KeyFile | None = None,
    force: bool = False,
) -> Path:
    """Write `path` and `path`.sha256: a `DataEngine`'s decision, or a fitted `ModelPrediction`'s (without audits).

    An accepted part of which nothing is known yet stays with the engine: export when none is under way.
    trace : the trace contract, for a `ModelPrediction` whose traces have another rate or limit than `TraceSpec`'s.
    key : a key's file (`make_key`); the signature comes beside the file, as `path`.sig.
    force : replace the file that is there; never a database, a folder or a link.
    Raises ExportError where nothing was trained yet, or the reducer, the interval or the rule cannot be scripted;
    OutputError where `path` cannot be written: what was there is then as it was.
    """
    source, module = prepared(engine_or_model, trace, path, force)
    with instead(ExportError, "The decision does not compile to TorchScript", RuntimeError):
        frozen = torch.jit.freeze(script(module.eval()), preserved_attrs=list(METHODS))
    x = golden_trace(source.trace)
    with torch.inference_mode():
        embedding = copy.deepcopy(frozen).decide(torch.from_numpy(x))[6]  # a copy: it would wait for its label
    golden = {"trace": x.tolist(), "embedding": embedding.tolist()}
    return write_export(path, _content(frozen, describe(source) | {"golden": golden}), force, key, source)


def _content(module: Any, metadata: dict[str, Any]) -> bytes:
    """One file with its description inside, in memory: libtorch ends the whole process where a disk is full."""
    buffer = io.BytesIO()
    torch.jit.save(module, buffer, _extra_files={METADATA: json.dumps(metadata).encode()})
    return buffer.getvalue()


def golden_trace(spec: TraceSpec) -> NDArray[np.float32]:
    """The trace (C, T) that a loader tries itself on, to check that its machine computes the same embedding."""
    x = np.sin(np.arange(spec.channels * spec.samples, dtype=np.float32) / 7.0).reshape(spec.channels, spec.samples)
    return np.asarray(x if spec.limit is None else x * np.float32(0.5 * spec.limit))


class ExportedDecision(NamedTuple):
    """What an exported file says of one trace; fields as in `Decision`, the embedding (K, d)."""

    action: Action
    reason: Reason
    lower: float
    upper: float
    n_success: int
    n_failure: int
    embedding: NDArray[np.float32]


class ExportedModel:
    """An exported decision in Python. `metadata` is what the file says of itself."""

    def __init__(self, module: Any, metadata: dict[str, Any]) -> None:
        self.module = module
        self.metadata = metadata
        self.trace = TraceSpec(**metadata["trace"])

    def decide(self, trace: ArrayLike, part: str | int | None = None) -> ExportedDecision:
        """Decide on one trace, (T,) or (C, T), of the part with this number; TraceError for a wrong shape.

        Where the file says `stops` "all", this confirms a part that was accepted before it and of which nothing was heard.
        """
        x = torch.from_numpy(as_trace(trace, self.trace))
        with torch.inference_mode():
            action, reason, lower, upper, n_success, n_failure, z = self.module.decide(x, _hash_of(part))
        return ExportedDecision(ACTIONS[action], REASONS[reason], lower, upper, n_success, n_failure, z.numpy())

    def decide_many(self, X: ArrayLike) -> list[ExportedDecision]:
        """Decide on each trace of (n, T) or (n, C, T), one after the other."""
        return [self.decide(x) for x in as_traces(X, self.trace)]

    def learn(self, trace: ArrayLike, success: bool, part: str | int | None = None) -> int:
        """Tell what became of a part after its `decide` and before the next; returns how many references are held.

        The trace becomes a reference, and the rule is told. A faulty trace is not learned from.
        """
        with torch.inference_mode():
            x = torch.from_numpy(as_trace(trace, self.trace))
            held: int = self.module.learn(x, as_success(success), _hash_of(part))
        self.metadata["references"] = held
        return held

    def stop(self, trace: ArrayLike, part: str | int | None = None) -> int:
        """Tell that an accepted part was bad and stopped the system; as `learn`."""
        return self.learn(trace, False, part)

    @property
    def safe_mode(self) -> str:
        """Why everything is verified at present, in words; "" where it is not."""
        return SAFE_MODES[self.module.safe_mode()]

    def save(self, path: str | os.PathLike[str], *, key: KeyFile | None = None, force: bool = False) -> Path:
        """Write all that was learned, and what waits for its label, to a file of the same kind, with its checksum.

        key, force : as of `export_torchscript`.
        """
        now = {"references": self.module.n_references(), "references_sha256": None}  # the sum is that of the first export
        return write_export(path, _content(self.module, self.metadata | now), force, key)


def _hash_of(part: Any) -> int:
    number = as_part(part)
    return 0 if number is None else part_hash(number)


def load_exported(path: str | os.PathLike[str], *, key: KeyFile | None = None) -> ExportedModel:
    """Check, load, warm up. Uses one torch thread, steadier by far at these sizes.

    key : the key's file that it was signed with; it is checked before torch sees a byte. None: no signature is asked for.
    Raises ExportError, before anything is loaded, for a file that is missing, damaged, truncated, foreign or newer, or that
    was not signed with the key, and after loading where this machine does not reproduce the golden embedding.
    """
    target = Path(path)
    content = checked_bytes(target, key)
    metadata = metadata_of(content, target)
    torch.set_num_threads(1)
    with instead(ExportError, f"{target} has its checksum but is no loadable TorchScript", RuntimeError):
        module = torch.jit.load(io.BytesIO(content), map_location="cpu").eval()  # type: ignore[no-untyped-call]
    said = f"{target} is not a dengine export: its description does not fit its module"
    with instead(ExportError, said, AttributeError, KeyError, TypeError, ValueError):
        # A copy runs the same compiled code, and this module must not learn of the golden trace.
        _check_golden(ExportedModel(copy.deepcopy(module), dict(metadata)), target)
        return ExportedModel(module, metadata)


def _check_golden(model: ExportedModel, path: Path) -> None:
    golden = model.metadata["golden"]
    trace, expected = np.array(golden["trace"], dtype=np.float32), np.array(golden["embedding"], dtype=np.float32)
    for _ in range(WARM_UP):
        found = model.decide(trace).embedding
        model.learn(trace, True)
        model.stop(trace)
    if found.shape != expected.shape or not np.allclose(found, expected, atol=TOLERANCE, rtol=TOLERANCE):
        raise ExportError(f"{path} loads, but this machine does not reproduce its golden embedding; export it anew here.")
