"""`load_dataset`, which reads formats of dengine as they are, other recordings by a description."""

import json
import shlex
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import DataError, instead
from ..files import FilePath, is_database, read_archive, read_errors
from ..records import stored_trace_spec
from .dataset import OWN, Dataset, Progress, expect_data, make_dataset, unit_text
from .describe import describe
from .description import FOLDER_FILE, Description, Stated
from .read.files import as_source
from .read.recordings import read_recordings

BUNDLED = {"insertion": "insertion.npz"}


def load_dataset(
    source: Any = "insertion",
    description: Description | Stated | FilePath | None = None,
    *,
    channels: str | Sequence[str] | None = None,
    samples: int | None = None,
    progress: Progress | None = None,
) -> Dataset:
    """Read a data set: one in a format of dengine, or recordings with their description.

    Recordings are files or tables with the samples of parts; a description says how they are read.

    Parameters
    ----------
    source : str, path, Dataset, DataFrame or pair (X, y), default "insertion"
        The name of a set that comes with dengine, or recordings: a folder, a file or a DataFrame.
        No description is needed for a `Dataset`; arrays X (n, T) or (n, C, T) and y (n,); an .npz
        file with X, y of 1 and 0, and perhaps scale, rate_hz, unit, cause (why a part failed),
        channels and part; a table that `Dataset.to_frame` made, or its Parquet file; the SQLite
        file of an engine's store, of which the labelled traces of the robot cell named "cell" and
        of the other cells that make the same product are read (a damaged trace is left out, which
        is noted in the store's log). Such a file or table is read by a description all the same if
        a description is given, or saved beside the file.
    description : Description, dict or path, optional
        How the recordings are read; DataError beside a `Dataset`, a pair or the name of a set that
        comes with dengine. None: the description that was saved, as `recordings.toml` in the folder
        or `FILE.toml` beside the file.
    channels : str or sequence of str, optional
        The channels to read, "FZ_Base" or "FZ_Base,FX_Base", among those that the description or
        the data set names. None: all channels of the data set, or those in `[channels]` of the
        description.
    samples : int, optional
        Number of samples of each trace: the rest is cut off at the end. None: as the description
        states, or as the data set is.
    progress : callable, optional
        Called with 1 after each file that is read by a description; once for a ROS bag or a table.

    Returns
    -------
    Dataset
        A recording that does not follow the description is left out, and one of its `faults` says
        why. A cell without a value is a NaN in the trace; an engine has the part of such a trace
        checked. `spec` is the `TraceSpec` for an engine whose traces have this shape.

    Raises
    ------
    DataError
        If the description is missing or has a key whose value is `?` (the message says what to
        type), if the source or a channel does not exist, if no recording is left, if `samples` is
        below 1, or if the traces are shorter than `samples`, or longer and resampled (the field
        `fit` of the data set is "resample"), since these are not cut. Also if none of the files can
        be read, a file that lists the labels cannot be read, the rows of a store contradict its
        ledger (the chain of hashes over them), or the traces and labels do not fit together
        (`make_dataset`), like those of a table of `Dataset.to_frame` that was changed.
    SettingError
        If `windows.trigger` of the description, which cuts long recordings, is malformed, or if
        `channels` is given for a data set of which `Dataset.spec` cannot be made.
    ValueError
        If the index of a DataFrame that a description describes is named like one of its columns.
    StoreError
        If the store in a SQLite file cannot be opened or read, has no cell named "cell", or has
        traces of several shapes.
    Exception
        What pandas raises for a damaged Parquet file of a table of `Dataset.to_frame`.
    """
    stated = channels.split(",") if isinstance(channels, str) else channels or ()
    names = tuple(map(str.strip, stated))
    read = own_reader(source) if description is None else None
    if read is not None:
        data = read()
        if names:
            data = data.select(names)
    else:
        place = as_source(source)
        about = description_of(place, description)
        if names:
            about = about.with_channels(names)
        data = read_recordings(place, about, progress)
    return data if samples is None else data.cut(samples)


def saved_description(source: FilePath) -> Path:
    """Return the path at which the description of a folder or a file is saved.

    It is `recordings.toml` in the folder, or `FILE.toml` beside the file, also for a source that
    does not exist. There need not be a file at it.
    """
    path = Path(source)
    return path / FOLDER_FILE if path.is_dir() else path.with_name(f"{path.name}.toml")


def description_of(
    source: Any, description: Any = None, stated: Stated | None = None, propose: bool = False
) -> Description:
    """Return a description of recordings: the given one, the saved one, or a proposal.

    A description says how recordings are read. A given Description or mapping is returned also with
    `?` in it. Only keys and types are checked (see `check_description`), and nothing is saved. A
    saved one without a channel counts as one with `?`.

    Parameters
    ----------
    source : path or DataFrame
        The recordings. They are looked at only if there is no description, or one with `?` in it.
    description : Description, mapping or path, optional
        None: the description that was saved, as `recordings.toml` in the folder or `FILE.toml`
        beside the file.
    stated : mapping, optional
        Values of keys like `label.column`. They replace those in a description file, and a proposal
        keeps them. Not used if `description` is a Description or a mapping.
    propose : bool
        Whether a proposal is returned if no description was saved, or one with `?` in it. If not,
        DataError is raised then; but if `stated` answers each `?` of a saved one, the proposal is
        returned if it has no `?`. A proposal keeps the saved values that are no defaults.

    Raises
    ------
    DataError
        If no description was saved, or one with `?` in it (the message says what to type), none is
        given for a DataFrame (even with `propose`), the source does not exist, a stated key is
        unknown or its value of the wrong type, or a description cannot be read or proposed. Without
        `propose`, too, a proposal is made for the message, and its errors come first.
    SettingError
        If a proposal is made, and the `windows.trigger` that is stated or saved, the condition at
        which long recordings are cut, is malformed.
    """
    if isinstance(description, Description):
        return description
    if isinstance(description, Mapping):
        return Description.from_dict(description)
    if description is None:
        source = as_source(source)
        expect_data(
            isinstance(source, Path),
            "a description of the table, like the one that describe(table) proposes",
            None,
        )
        path = saved_description(source)
    else:
        path = Path(description)
    given = stated or {}
    about = Description()
    if description is not None or path.is_file():
        saved = Description.load(path)
        about = saved.with_values(given)
        if not saved.open_keys:
            return about
    # What an answer to a ? leads to, like a rate, is not in the file.
    proposal = describe(source, {**about.to_dict(), **given})
    if propose or not (about.open_keys or proposal.open_keys):
        return proposal
    expect_data(isinstance(source, str | Path), "a description without ?", [*proposal.open_keys])
    raise DataError(missing_text(source, path, proposal))


def missing_text(source: Path, path: Path, proposal: Description) -> str:
    """Return the error message if there is no description at `path`, or one with `?` in it.

    A description says how the recordings at `source` are read. The message lists the keys of the
    proposed one whose value is `?`, so that the user must state it, with the notes on them, and has
    the commands that show and save the proposal.
    """
    command = f"dengine data {shlex.quote(str(source))}"
    if path != saved_description(source):
        command += f" --description {shlex.quote(str(path))}"
    found, force = ("one with ?", " --force") if path.is_file() else ("none", "")
    keys = proposal.open_keys
    state = " --set KEY=VALUE" if keys else ""
    questions = "".join(f"\n  {key}: {proposal.notes.get(key, '')}" for key in keys)
    return (
        f"Expected the description {path}, found {found}. Look at the proposal with `{command}`, "
        f"and write it with `{command} --save{force}{state}`.{questions and ' Still open:'}"
        f"{questions}"
    )


def own_reader(source: Any) -> Callable[[], Dataset] | None:
    """Return a function that reads a source in a format of dengine; None if it needs a description.

    The formats are a `Dataset`, which the function returns itself, a tuple (X, y), the name of a
    set that comes with dengine, even if a file or folder has this name, a table of
    `Dataset.to_frame` or its Parquet file, an .npz file with X and labels y of 1 and 0, and a
    SQLite file, which must be the store of an engine. The function takes no arguments and raises
    the errors of `load_dataset`. A folder needs a description, which says how its files are read,
    and so does a file beside which a description was saved, whatever the file holds. Raises
    DataError for a source of an unknown type, for a path that does not exist, for a file that
    cannot be opened, for a damaged .npz or Parquet file, for an .npz file whose y holds Python
    objects or needs too much memory, and for a Parquet file without pyarrow.
    """
    if isinstance(source, Dataset):
        return lambda: source
    if isinstance(source, tuple) and len(source) == 2:
        return lambda: make_dataset(*source)
    if hasattr(source, "columns"):
        return partial(_from_own_frame, source) if OWN in source.attrs else None
    if name := BUNDLED.get(str(source)):
        source = files("dengine") / "data" / name
    path = as_source(source)
    if path.is_file() and not saved_description(path).is_file():
        is_own, read = OWN_FILES.get(path.suffix.lower(), (is_database, _read_store))
        with instead(DataError, f"Cannot read {path}", OSError):
            return partial(read, path) if is_own(path) else None
    return None


def _is_own_archive(path: Path) -> bool:
    """Return whether a file is an .npz archive with an array X, and numbers y that are all 1 or 0.

    Raises DataError for an .npz file that is damaged or cannot be opened, or whose y holds Python
    objects or needs too much memory (`read_archive`); of its arrays only y is read.
    """
    arrays, names = read_archive(path, ("y",))
    labels = arrays.get("y", np.array("none"))
    return "X" in names and labels.dtype.kind in "iufb" and bool(np.isin(labels, (0, 1)).all())


def _is_own_table(path: Path) -> bool:
    """Return whether a file is a Parquet file of a table that `Dataset.to_frame` made.

    Raises DataError if a .parquet file is damaged or cannot be opened, or if pyarrow is not
    installed.
    """
    with read_errors(path, "a Parquet file", "pyarrow", "files"):
        from pyarrow.parquet import read_schema

        metadata = read_schema(path).metadata or {}
        return OWN in json.loads(metadata.get(b"PANDAS_ATTRS", b"{}"))


def _read_own_table(path: Path) -> Dataset:
    """Return the data set of a Parquet file that `_is_own_table` accepts.

    Raises DataError if `make_dataset` refuses its arrays; the errors of pandas pass unchanged.
    """
    import pandas as pd

    return _from_own_frame(pd.read_parquet(path), path.stem)


@instead(DataError, "Expected a table as Dataset.to_frame made it", KeyError, TypeError, ValueError)
def _from_own_frame(frame: Any, name: str = "table") -> Dataset:
    """Return the data set of a DataFrame that `Dataset.to_frame` made; `name` becomes its name.

    The columns of samples are those that `to_frame` wrote; other columns, beside label, part and
    cause (why the part failed), are ignored. Raises DataError if `make_dataset` refuses its arrays,
    if it has no row or lacks a column of samples or `label`, or if samples are no numbers.
    """
    about = {**frame.attrs[OWN]}
    words = frame[frame.columns.intersection(["part", "cause"])].astype(str)
    X = frame[about.pop("columns")].to_numpy(np.float32)
    X = X.reshape(len(X), about.pop("n_channels"), -1)
    about |= {key: words[key].to_numpy(np.str_) for key in words}
    return make_dataset(X, frame["label"], name=name, **about)


def _read_npz(path: Path) -> Dataset:
    """Return the data set of an .npz archive with X and labels y of 1 and 0.

    Of the other arrays scale, rate_hz, unit, cause, channels and part are read if they are there. X
    is multiplied by `scale`. Raises DataError if `read_archive` refuses the file, an array cannot
    be converted, or `make_dataset` refuses the arrays.
    """
    arrays, _ = read_archive(
        path, ("X", "y", "scale", "rate_hz", "unit", "cause", "channels", "part")
    )
    with read_errors(path, "an .npz file of plain arrays"):
        X = arrays["X"] * np.float32(arrays.get("scale", 1.0))
        units, channels = (
            [*map(str, np.atleast_1d(arrays.get(key, ())).tolist())] for key in ("unit", "channels")
        )
        return make_dataset(
            X,
            arrays["y"],
            name=path.stem,
            rate_hz=float(arrays["rate_hz"]) if "rate_hz" in arrays else None,
            unit=unit_text(units),
            channels=channels,
            cause=arrays.get("cause"),
            part=arrays.get("part"),
        )


def _read_store(path: Path) -> Dataset:
    """Return the labelled traces of a store, with corrected labels, the oldest label first.

    They are those of the robot cell named "cell" and of the other cells that make the same product.
    Traces with a fault, which are never used in training, and labels that a person withdrew are
    left out. So is a trace that is missing or not as it was stored; this is noted in the store's
    log or, if that fails, by `logging`. If several traces are of one part, `part` is the hash by
    which the store counts them as one part; otherwise it is None. The store is closed.

    Raises DataError if the store has no labelled traces, if its rows contradict its ledger, the
    chain of hashes over them, or if `make_dataset` refuses the traces. Raises StoreError if the
    store cannot be opened or read, has no such cell, or has traces of different shapes.
    """
    from ..store.opening import opening

    with opening(path, must_exist=True) as store:
        difference = store.database.check_integrity(0, since=0)
        expect_data(
            not difference,
            f"{path} as its ledger has it",
            difference,
            "see `dengine verify`, and restore a copy",
        )
        labelled = store.labels.with_traces()
        spec = stored_trace_spec(store.settings.read())
    store.close()
    if spec is None or not len(labelled.labels):
        raise DataError(
            f"Expected a store with labelled traces, {path} has none; record some first, as in "
            "shadow mode."
        )
    hashes = labelled.hashes
    return make_dataset(
        labelled.traces,
        labelled.labels,
        # As the store counts: a part that came again has one vote.
        part=hashes if len(np.unique(hashes)) < len(hashes) else None,
        name=path.stem,
        rate_hz=spec.rate_hz,
        unit=unit_text(spec.units),
        channels=spec.columns,
        limit=spec.limit,
        fit=spec.fit,
    )


# By suffix: how files of our own are known, and read. Any other one may be a store.
OWN_FILES: dict[str, tuple[Callable[[Path], bool], Callable[[Path], Dataset]]] = {
    ".npz": (_is_own_archive, _read_npz),
    ".parquet": (_is_own_table, _read_own_table),
}
