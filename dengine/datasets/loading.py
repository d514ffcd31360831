"""`load_dataset`, which reads what is ours as it is, and everything else by a description."""

import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import DataError
from ..files import is_database, read_archive, read_errors
from ..records import stored_trace_spec
from .dataset import OWN, Dataset, expect_data, make_dataset
from .describe import describe
from .description import FOLDER_FILE, Description
from .read.files import find_files
from .read.recordings import read_recordings

BUNDLED = {"insertion": "insertion.npz"}
# Arrays of an archive of ours, beside X and y.
ABOUT = ("scale", "rate_hz", "unit", "cause", "channels", "part")


def load_dataset(
    source: Any = "insertion",
    description: Description | Mapping[str, Any] | str | os.PathLike[str] | None = None,
    *,
    channels: str | Sequence[str] | None = None,
    samples: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> Dataset:
    """Read a data set: what is ours as it is, and recordings exactly by a description.

    Parameters
    ----------
    source : str, path, Dataset, DataFrame or pair (X, y), default "insertion"
        The name of a bundled set; a folder, file or DataFrame of recordings, which a description
        describes. Without one: a `Dataset`; arrays X (n, T) or (n, C, T) and y (n,); an .npz file
        of ours with X, y, and perhaps scale, rate_hz, unit, cause, channels and part; a Parquet
        file that `Dataset.to_frame` made; the SQLite file of a store, for its labelled traces.
    description : Description, dict or path, optional
        None: the one that was saved, `recordings.toml` in a folder, `FILE.toml` beside a file.
    channels : str or sequence of str, optional
        The channels to read, "FZ_Base" or "FZ_Base,FX_Base", among those that the description
        names. None: all that it reads.
    samples : int, optional
        Samples of each trace: of those that the description has, the first so many.
    progress : callable, optional
        Called with 1 after each file.

    Returns
    -------
    Dataset
        A recording that does not follow the description is one of its `faults`. A sample that is
        lost is NaN, which the engine finds. Its `spec` is that of live traces of the same shape.

    Raises
    ------
    DataError
        If there is no description, or an open one, with what to type; or if no recording is left.
    """
    stated = channels.split(",") if isinstance(channels, str) else channels or ()
    names = tuple(map(str.strip, stated))
    expect_data(samples is None or samples >= 1, "1 or more samples", samples)
    read = None if description is not None else own_reader(source)
    if read is not None:
        data = read()
        data = data.select(names) if names else data
    else:
        about = description_of(source, description)
        about = about.with_channels(names) if names else about
        traces = about.traces
        if samples and (samples > traces.samples or traces.lengths == "resample"):
            about = replace(about, traces=replace(traces, samples=samples))
        place = Path(source) if isinstance(source, str | os.PathLike) else source
        data = read_recordings(place, about, progress)
    return data.cut(samples) if samples else data


def saved_description(source: str | os.PathLike[str]) -> Path:
    """Return the path at which the description of a folder or a file is saved."""
    path = Path(source)
    return path / FOLDER_FILE if path.is_dir() else path.with_name(f"{path.name}.toml")


def description_of(source: Any, description: Any) -> Description:
    """Return the description that is stated, or saved; raise DataError without one."""
    if isinstance(description, Description):
        return description
    if isinstance(description, Mapping):
        return Description.from_dict(description)
    if description is not None:
        return Description.load(description)
    if not isinstance(source, str | os.PathLike):
        do = "pass the one that describe(table) proposes"
        raise DataError(f"Expected a description of the {type(source).__name__}; {do}.")
    path = Path(source)
    if not path.exists():
        wanted = f"a data set among {', '.join(BUNDLED)}, a file or a folder"
        raise DataError(f"Expected {wanted}, got {source}, which does not exist.")
    saved = saved_description(path)
    if saved.is_file():
        return Description.load(saved)
    raise DataError(missing_text(path, describe(path)))


def count_files(source: str, description: Description | None) -> int:
    """Return how many files of a source are read."""
    path = Path(source)
    return len(find_files(path, description)) if description is not None and path.exists() else 1


def missing_text(path: Path, proposal: Description) -> str:
    """Return the message for recordings without a description: what is open, and what to type."""
    open_keys = proposal.open_keys
    questions = "".join(f"\n  {key}: {proposal.notes.get(key, '')}" for key in open_keys)
    state = "".join(f" --set {key}=..." for key in open_keys)
    return (
        f"Expected the description {saved_description(path)}, found none. Look at the proposal "
        f"with `dengine data {path}`, and write it with `dengine data {path} --save{state}`."
        f"{questions and ' Still open:'}{questions}"
    )


def own_reader(source: Any) -> Callable[[], Dataset] | None:
    """Return what reads a source without a description; None for a source that needs one.

    Raises DataError for a source of an unknown type.
    """
    if isinstance(source, Dataset):
        return lambda: source
    if isinstance(source, tuple) and len(source) == 2:
        return lambda: make_dataset(*source)
    if hasattr(source, "columns"):
        return partial(_from_own_frame, source, "table") if OWN in source.attrs else None
    if not isinstance(source, str | os.PathLike):
        wanted = "a name, a path, a Dataset, a DataFrame or a pair (X, y)"
        raise DataError(f"Expected {wanted}, got {type(source).__name__}.")
    if str(source) in BUNDLED:
        bundled = Path(str(files("dengine"))) / "data" / BUNDLED[str(source)]
        return partial(_read_npz, bundled, str(source))
    path = Path(source)
    if path.is_file() and not saved_description(path).is_file():
        for is_own, read in OWN_FILES:
            if is_own(path):
                return partial(read, path, path.stem)
    return None


def _is_own_archive(path: Path) -> bool:
    """Return whether a file is an archive with X, and labels y of 1 and 0."""
    if path.suffix.lower() != ".npz":
        return False
    arrays, names = read_archive(path, ("y",))
    labels = arrays.get("y", np.array(["none"]))
    return "X" in names and labels.dtype.kind in "iufb" and bool(np.isin(labels, (0, 1)).all())


def _is_own_table(path: Path) -> bool:
    """Return whether a Parquet file was written of a table that `Dataset.to_frame` made."""
    if path.suffix.lower() != ".parquet":
        return False
    with read_errors(path, "a Parquet file", "pyarrow", "files"):
        from pyarrow.parquet import read_schema

        metadata = read_schema(path).metadata or {}
        return OWN in json.loads(metadata.get(b"PANDAS_ATTRS", b"{}"))


def _read_own_table(path: Path, name: str) -> Dataset:
    """Return the data set of a Parquet file of ours."""
    import pandas as pd

    return _from_own_frame(pd.read_parquet(path), name)


def _from_own_frame(frame: Any, name: str) -> Dataset:
    """Return the data set of a table that `Dataset.to_frame` made."""
    about = dict(frame.attrs[OWN])
    columns = [column for column in frame.columns if column not in ("label", "part", "cause")]
    n_channels = about.pop("n_channels")
    X = frame[columns].to_numpy(np.float32)
    X = X.reshape(len(X), n_channels, -1) if n_channels > 1 else X
    about |= {key: frame[key].to_numpy(str) for key in ("part", "cause") if key in frame}
    about["channels"] = tuple(about["channels"])
    return make_dataset(X, frame["label"].to_numpy(), name=name, **about)


def _read_npz(path: Path, name: str) -> Dataset:
    """Return the data set of an archive with X and labels y of 1 and 0.

    X is multiplied by the number `scale` if there is one.
    """
    arrays, _ = read_archive(path, ("X", "y", *ABOUT))
    X = arrays["X"]
    with read_errors(path, "an .npz file of plain arrays"):
        if "scale" in arrays:
            X = X.astype(np.float32) * arrays["scale"].astype(np.float32)
        about: dict[str, Any] = {key: arrays.get(key) for key in ("cause", "part")}
        about["rate_hz"] = float(arrays["rate_hz"]) if "rate_hz" in arrays else None
        about["unit"] = ", ".join(map(str, np.atleast_1d(arrays.get("unit", "")).tolist()))
        about["channels"] = tuple(map(str, arrays.get("channels", ())))
        return make_dataset(X, arrays["y"], name=name, **about)


def _read_store(path: Path, name: str) -> Dataset:
    """Return the labelled traces of a store, in the order of their labels, corrections applied.

    Quarantined and forgotten ones are left out. Raises DataError if the store contradicts its
    ledger, or has no labelled traces.
    """
    from ..store.opening import opening

    with opening(path, must_exist=True) as store:
        if integrity_error := store.database.check_integrity(0, since=0):
            wanted = f"{path} as its ledger has it"
            do = "see `dengine verify`, and restore a copy"
            raise DataError(f"Expected {wanted}, {integrity_error}; {do}.")
        labelled = store.labelled()
        spec = stored_trace_spec(store.settings())
    store.close()
    if spec is None or not len(labelled.labels):
        do = "record some first, as in shadow mode"
        raise DataError(f"Expected a store with labelled traces, {path} has none; {do}.")
    has_repeats = len(np.unique(labelled.hashes)) < len(labelled.hashes)
    return make_dataset(
        labelled.traces[:, 0] if spec.channels == 1 else labelled.traces,
        labelled.labels,
        # As the store counts: a part that came again has one vote.
        part=labelled.hashes.astype(np.str_) if has_repeats else None,
        name=name,
        rate_hz=spec.rate_hz,
        unit=spec.unit if isinstance(spec.unit, str) else ", ".join(spec.unit or ()),
        channels=tuple(spec.columns),
        limit=spec.limit,
        fit=spec.fit,
    )


OWN_FILES: tuple[tuple[Callable[[Path], bool], Callable[[Path, str], Dataset]], ...] = (
    (is_database, _read_store),
    (_is_own_archive, _read_npz),
    (_is_own_table, _read_own_table),
)
