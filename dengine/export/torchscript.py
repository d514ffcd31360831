"""Export to TorchScript: one file for the cell controller, with a checksum beside it.
`export_torchscript` writes it, and `load_exported` reads it and returns an `ExportedModel`, which
decides and learns in Python as the controller does. `export_sources` writes the C and C++ sources
that run it.

    >>> export_torchscript(engine, "model.ts")     # model.ts and model.ts.sha256
    >>> load_exported("model.ts").decide(trace)    # checked before it is loaded, ready at once

An untrusted `.ts` file is a program: loading it runs what is in it, which can read and write files.
Load only what you made yourself, or what was signed with a key of yours. The C and C++ sources that
run an exported file depend on no model, so they are written by an option of their own:

    dengine export --cpp cell_cpp
    torch_cmake="$(python -c 'import torch; print(torch.utils.cmake_prefix_path)')"
    cmake -S cell_cpp -B build/cpp -DCMAKE_PREFIX_PATH="$torch_cmake"
"""

import copy
import io
import json
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
from ..files import FilePath, new_folder
from ..folds import part_hash
from ..model.neighbours import is_close
from ..records import (
    ACTIONS,
    REASONS,
    Action,
    PartNumber,
    Reason,
    TraceArray,
    TraceSpec,
    as_success,
)
from ..traces import LARGEST, as_trace
from .bundle import (
    METADATA,
    Metadata,
    describe,
    metadata_of,
    prepare_export,
    read_checked,
    write_export,
)

WARM_UP = 3
TOLERANCE = 1e-4  # of a scaled embedding: another processor may add in another order


def export_sources(folder: FilePath) -> Path:
    """Write the C and C++ sources that run an exported file, and a file VERSION, into a folder.

    VERSION holds the version of dengine. The folder is made, with its parents, if it is missing.

    Parameters
    ----------
    folder : path-like
        A new or an empty folder.

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    OutputError
        If the folder is not empty or cannot be written.
    """
    with new_folder(folder) as target:
        shutil.copytree(Path(__file__).parent / "cpp", target, dirs_exist_ok=True)
        (target / "VERSION").write_text(f"{__version__}\n", encoding="utf-8")
    return target


def export_torchscript(
    engine_or_model: Any,
    path: FilePath,
    *,
    trace: TraceSpec | None = None,
    key: FilePath | None = None,
    force: bool = False,
) -> Path:
    """Write the decision of an engine, or of a model, as TorchScript, with its checksum beside it.

    The file does not know of a part that the engine accepted and whose outcome is not known yet, so
    it never learns this outcome. Export when no part is under way; this is not checked. The export
    of an engine is recorded in the log of its store, before the file is written. Up to eight
    labelled traces are read from the store, to compare embeddings; a damaged trace (not as it was
    stored) is left out, which is logged in the store, too.

    Parameters
    ----------
    engine_or_model : DataEngine or ModelPrediction
        A model, which must be fitted, exports without audits (random checks of parts about which
        the model is certain) and without force limits (an operator's limits of the signal).
    path : path-like
        The checksum is written beside it, as PATH.sha256.
    trace : TraceSpec, optional
        What the traces look like. Needed for a `ModelPrediction` whose traces have another sampling
        rate or sensor limit than the defaults of `TraceSpec`. Its shape must be that of the model's
        traces. None: the engine's `TraceSpec`, or the shape of the model's traces.
    key : path-like, optional
        File of a key (`make_key`); the signature is written beside the file, as PATH.sig.
    force : bool, default False
        Whether to replace an existing file; never a database, a folder or a link. Without a key,
        the signature of a replaced file is removed.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    ExportError
        If nothing was trained yet, for a baseline (a model that was handed in to the engine), if
        `trace` has another shape than the model's traces, if the reducer (which maps traces to
        points), the confidence interval or the decision rule cannot be compiled, if the compiled
        decision and the reducer map one of up to eight labelled traces to different points, if the
        embedding of a test trace is not finite (as for traces of one sample), if the rule is stale,
        because an update of it failed, if the store was changed from outside (its rows do not fit
        their checksums), and if the key cannot be read or has fewer than 16 bytes.
    SettingError
        If the engine's force limits do not fit `trace`.
    OutputError
        If a file exists, without `force`, or cannot be written.
    StoreError, OSError
        As in `prepare_export` and `write_export`.
    """
    source, module = prepare_export(engine_or_model, trace, path, force)
    with instead(ExportError, "The decision does not compile to TorchScript", RuntimeError):
        # Not frozen: a frozen file decides no faster, and takes seconds to load.
        compiled = script(module.eval())
    x = golden_trace(source.trace)
    with torch.inference_mode():
        # A copy decides, or the golden trace would be the pending decision of the file.
        embedding = copy.deepcopy(compiled).decide(torch.from_numpy(x))[6]
    metadata = describe(source) | {"golden": golden_answer(x, embedding.numpy())}
    return write_export(path, _content(compiled, metadata), force, key, source)


def _content(module: Any, metadata: Metadata) -> bytes:
    """Return the bytes of a TorchScript file with this compiled module and description, as JSON.

    They are made in memory because libtorch ends the whole process if a disk is full.
    """
    buffer = io.BytesIO()
    torch.jit.save(module, buffer, _extra_files={METADATA: json.dumps(metadata).encode()})
    return buffer.getvalue()


def golden_trace(spec: TraceSpec) -> TraceArray:
    """Return the trace, float32 (C, T), on which a loader checks the embedding of its machine.

    It is a sine that runs on from channel to channel, always the same for the same `spec`. Its
    amplitude is half of the sensor's limit, or 1 without a limit or if half of it is too large for
    a sample (`LARGEST`). Of a single sample, or a limit that float32 has no half of, it is faulty.
    """
    amplitude = 1.0
    if spec.limit is not None and spec.limit <= 2.0 * LARGEST:
        amplitude = 0.5 * spec.limit
    x = np.sin(np.arange(spec.channels * spec.samples, dtype=np.float32) / 7.0)
    return np.asarray(x * np.float32(amplitude)).reshape(spec.channels, spec.samples)


def golden_answer(trace: TraceArray, embedding: NDArray[np.float32]) -> Metadata:
    """Return the golden trace with its embedding (K, d), as a dict for JSON.

    Raises ExportError if the embedding is not finite, because no loader could compare it.
    """
    if not np.isfinite(embedding).all():
        raise ExportError(
            f"The embedding of a test trace, a sine of {trace.shape[0]} x {trace.shape[1]} samples "
            "below the limit, is not finite, so no machine could check the file; give traces two "
            "or more samples, and a limit that they can stay below."
        )
    return {"trace": trace.tolist(), "embedding": embedding.tolist()}


class ExportedDecision(NamedTuple):
    """What an exported file decides on one trace.

    Attributes
    ----------
    action, reason, lower, upper, n_success, n_failure
        Like those of `Decision`: what to do and why, the bound of the success probability, and the
        good and bad labels within the radius; the bound is (0, 1) without a prediction.
    embedding : array of float32, shape (K, d)
        A point in each embedding space; NaN for a faulty trace.
    """

    action: Action
    reason: Reason
    lower: float
    upper: float
    n_success: int
    n_failure: int
    embedding: NDArray[np.float32]


class ExportedModel:
    """An exported decision that runs in Python; `load_exported` makes one.

    Attributes
    ----------
    module : torch.jit.ScriptModule
        A compiled `DecisionModule`.
    metadata : dict
        The file's description of itself.
    trace : TraceSpec
        What its traces must be.
    """

    def __init__(self, module: Any, metadata: Metadata) -> None:
        self.module = module
        self.metadata = metadata
        self.trace = TraceSpec(**metadata["trace"])

    def decide(self, trace: ArrayLike, part: PartNumber = None) -> ExportedDecision:
        """Decide on one trace, which becomes the pending decision, whose outcome `learn` reports.

        If the part before it was accepted and nothing was reported about it, its wait for an
        outcome ends first. If the file's description (`metadata`) says `stops` "all" (every bad
        accepted part is reported), it is learned as good and becomes a reference (a labelled point
        with which later traces are compared). If it says "some", the part is counted as unreported.
        A VERIFY or REJECT that is still pending is discarded. A faulty trace (NaN, infinite,
        constant, too large or at the sensor's limit) gets VERIFY, and no decision is pending then.

        Parameters
        ----------
        trace : array, shape (T,) or (C, T)
            Another T is cut, padded or resampled, or refused, as `TraceSpec.fit` says.
        part : str or int, optional
            Number by which you name the part. The part's own references do not count; without a
            number, those of equal traces do not.

        Returns
        -------
        ExportedDecision
            Action (VERIFY asks for the slow check), reason, both bounds of the success probability,
            numbers of good and bad labels nearby, and embedding.

        Raises
        ------
        TraceError
            For a wrong shape, a T that is refused, values that are no real numbers, or a part that
            is neither a whole number nor a text of 1 to 200 printable characters.
        """
        x = torch.from_numpy(as_trace(trace, self.trace))
        with torch.inference_mode():
            action, reason, lower, upper, n_success, n_failure, z = self.module.decide(
                x, _part_hash(part)
            )
        return ExportedDecision(
            ACTIONS[action], REASONS[reason], lower, upper, n_success, n_failure, z.numpy()
        )

    def learn(self, trace: ArrayLike, success: bool, part: PartNumber = None) -> int:
        """Learn the outcome of a part, after its `decide` and before the next.

        The trace becomes a reference, a labelled point with which later traces are compared (the
        oldest is dropped if there is no room), the decision rule is updated, and
        `metadata["references"]` becomes the new number of references. The file on the disk is not
        changed; see `save`. A faulty trace (NaN, infinite, constant, too large or at the sensor's
        limit) is ignored. If the trace and the part are those of the pending decision (the last, if
        its outcome is not known yet), nothing is pending afterwards; otherwise the model first
        decides on the trace, and the earlier decision stays pending.

        Parameters
        ----------
        trace : array, shape (T,) or (C, T)
            Another T is cut, padded or resampled, or refused, as `TraceSpec.fit` says.
        success : bool
            The label: whether the part is good.
        part : str or int, optional
            Number by which you name the part, the same as in `decide`.

        Returns
        -------
        int
            Number of references afterwards.

        Raises
        ------
        TraceError
            For a wrong shape, a T that is refused, values that are no real numbers, or a part that
            is neither a whole number nor a text of 1 to 200 printable characters.
        ReportError
            For a label that is not True, False, 1 or 0.
        """
        with torch.inference_mode():
            x = torch.from_numpy(as_trace(trace, self.trace))
            n_references: int = self.module.learn(x, as_success(success), _part_hash(part))
        self.metadata["references"] = n_references
        return n_references

    def stop(self, trace: ArrayLike, part: PartNumber = None) -> int:
        """Learn that an accepted part was bad and stopped the line: `learn` with the label bad.

        Whether it was accepted is not checked. Returns the number of references, and raises
        TraceError like `learn`.
        """
        return self.learn(trace, False, part)

    @property
    def safe_mode(self) -> str:
        """Why the safe mode began, in words (`SAFE_MODES`); "" outside of a safe mode."""
        return SAFE_MODES[self.module.safe_mode()]

    def save(self, path: FilePath, *, key: FilePath | None = None, force: bool = False) -> Path:
        """Write the model with all that it learned, and the pending decision, to a file.

        Parameters, checksum and signature are as in `export_torchscript`; no store records it.
        Returns the file, which `load_exported` reads; its description lacks the checksum of the
        references. Raises OutputError if it must not or cannot be written, ExportError if the key
        cannot be read.
        """
        # The sum of the references is that of the first export.
        changes = {"references": self.module.n_references(), "references_sha256": None}
        return write_export(path, _content(self.module, self.metadata | changes), force, key)


def _part_hash(part: Any) -> int:
    """Return the hash of a part's number, 0 for None; 7 and "7" have the same hash.

    Raises TraceError for anything but None, a whole number, and a text of 1 to 200 printable
    characters.
    """
    number = as_part(part)
    return 0 if number is None else part_hash(number)


def load_exported(path: FilePath, *, key: FilePath | None = None) -> ExportedModel:
    """Check an exported file, load it and warm it up.

    Once checksum, signature and description are checked, the calling thread is limited to one torch
    thread for good, also if the loading fails: with a single thread the times of decisions vary far
    less.

    Parameters
    ----------
    path : path-like
    key : path-like, optional
        File of the key that it was signed with; the signature is checked before torch sees a byte.
        None: no signature is asked for.

    Returns
    -------
    ExportedModel

    Raises
    ------
    ExportError
        Before anything is loaded: for a file that is missing, damaged, truncated, no export or of
        another schema (version of its description), or that was not signed with the key, and for a
        key that cannot be read or has fewer than 16 bytes. Afterwards: if it is no TorchScript, if
        its description does not fit its module, or if this machine does not compute the embedding
        that the file holds for a test trace, up to 0.0001 times (1 + the absolute value) of each
        coordinate. Errors inside the module, torch.jit.Error or RuntimeError, are raised as they
        are.
    """
    target = Path(path)
    content = read_checked(target, key)
    metadata = metadata_of(content, target)
    torch.set_num_threads(1)
    with instead(
        ExportError, f"{target} has its checksum but is no loadable TorchScript", RuntimeError
    ):
        module = torch.jit.load(io.BytesIO(content), map_location="cpu").eval()  # type: ignore[no-untyped-call]
    with instead(
        ExportError,
        f"{target} is not a dengine export: its description does not fit its module",
        AttributeError,
        KeyError,
        TypeError,
        ValueError,
    ):
        # A copy runs the same compiled code; the module itself must not learn the golden trace.
        _check_golden(ExportedModel(copy.deepcopy(module), dict(metadata)), target)
        return ExportedModel(module, metadata)


def _check_golden(model: ExportedModel, path: Path) -> None:
    """Warm a model up on the test trace in its file; raise ExportError for another embedding.

    The test trace and its expected embedding are the entry "golden" of the file's description
    (`metadata`). A coordinate may differ by 0.0001 times (1 + its absolute value). Three times the
    model decides on the trace, learns it as good and learns it as bad. The last embedding is
    compared. This changes the model and its `metadata`, so pass a copy. `path` is named in the
    error.
    """
    golden = model.metadata["golden"]
    trace = np.array(golden["trace"], dtype=np.float32)
    expected = np.array(golden["embedding"], dtype=np.float32)
    for _ in range(WARM_UP):
        embedding = model.decide(trace).embedding
        model.learn(trace, True)
        model.stop(trace)
    if embedding.shape != expected.shape or not is_close(embedding, expected, TOLERANCE):
        raise ExportError(
            f"{path} loads, but this machine does not reproduce its golden embedding; export it "
            "anew here."
        )
