"""One door for all that holds labelled traces, `load_dataset`; and what is read from arrays."""

import os
import zipfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from importlib.resources import files
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import DataError, instead, listed
from ..files import is_database, read_archive, read_errors
from ..records import stored_trace_spec
from ..traces import as_trace, spec_of
from . import units
from .bags import is_stream, read_bag
from .clocks import clock_of, rate_of
from .dataset import (
    Asked,
    Collected,
    Dataset,
    Recorded,
    UnlabelledError,
    UnreadableError,
    as_dataset,
    make_dataset,
    must,
    names_of,
    refit,
)
from .labels import in_order, label_of, meanings
from .tables import FORCE, from_frame, hold_many, read_folder, read_tables, recordings_in
from .text import SUFFIXES as TEXTS
from .triggers import Trigger

BUNDLED = {"insertion": "insertion.npz"}
USED = ("X", "y", "scale", "rate_hz", "unit", "cause", "channels")  # arrays, beside that of the parts' numbers
WRITTEN = ("columns", "decimal", "thousands")  # how a text file is written
Files = Mapping[str, Path]
TABLES = (*TEXTS, ".parquet", ".pq")
FORMS = ".npz, .csv, .tsv, .txt, .dat, .parquet or .mcap"


def load_dataset(
    source: Any = "insertion",
    samples: int | None = None,
    part: str = "part",
    *,
    channel: str | Sequence[str] | None = None,
    label: str | None = None,
    labels: str | os.PathLike[str] | None = None,
    fit: str | None = None,
    rate_hz: float | None = None,
    trigger: Trigger | str | None = None,
    topic: str | None = None,
    time: str | None = None,
    unit: str | None = None,
    label_map: Mapping[str, Any] | str | None = None,
    columns: str | Sequence[str] | None = None,
    decimal: str | None = None,
    thousands: str | None = None,
) -> Dataset:
    """A data set from recordings as people have them.

    source : the name of a bundled set; a folder of CSV files, one an insertion, or of tables or archives of one form, which
        are one set; a wide table, a row an insertion, or a long one, a row a sample, as .csv, .parquet or a DataFrame; one
        long recording as .mcap, or a rosbag2 folder of them; an .npz file with X (n, T) or (n, C, T), times the number
        `scale` where one is stored, and y (n,), or with arrays that `channel` and `label` name; the SQLite file of a store,
        for the labelled traces in it; a `Dataset`; a pair (X, y), where X may be a list of traces of any length.
    samples : of each trace, the first so many; with `fit="resample"` the points that the whole is put on.
    part : the name of the array, or column, of parts' numbers, texts or whole numbers; for a folder a column of `labels`.
        Where there is no `part`, every trace is a part of its own. In a long table it tells which rows are one insertion.
    channel : "FZ_Base", or several, "FZ_Base,FX_Base", which give (n, C, T). Not given: FZ_Base, or the only one there is.
    label : for a folder, a regular expression with one group that finds the label in a file's path, or the name of a
        column of the files; not given: True/False, OK/NOK, pass/fail, good/bad, success/failure or i.O./n.i.O. at the
        end of its name but for numbers, or as its folder's; else in a column that is called so. For a table, the name of
        the column; for an .npz file of the array.
    labels : for a folder, a CSV file with a column of file names and one of labels; for a long table of parts; for an .npz
        file a row a trace.
    label_map : what other words mean, "heil=good,Riss=bad", or a dict; "1=good,0=bad" where names end in numbers that
        are labels.  time : the column of times, of a long table or of recordings whose clock its name does not tell.
    fit : what becomes of traces of another length, as in `TraceSpec`. Not given: recordings of one length stay as they
        are (strict); of several lengths, "pad" to their median; where all have the `samples` asked for, "cut".
    rate_hz : instead of what the timestamps tell, which are then not looked at. Without either the rate is unknown, None.
    unit : of the samples; recordings whose header says another one, kN for N, are converted to it.
    trigger : of one long recording, when an insertion begins, a `Trigger` or its text (`as_trigger`).  topic : of its
        wrench, where there are several. Its channels are FX ... MZ, FZ if not given; its `label` is the topic that tells
        them, and its file of `labels` names the insertions by number. Not given, `samples` is two seconds.

    Files of text are .csv, .tsv, .txt or .dat, with commas, blanks, tabs or ; between their cells.
    columns : "time,fx,fz", the names of the columns of text files without a header, or with another one.
    decimal, thousands : the marks in the numbers of text files, "," and "."; not given, the cells of each file tell.

    A recording that cannot be read, or not honestly be fitted, becomes a `Fault` in `faults`, and the others are kept. A
    number that is missing is a NaN, which the engine finds. `spec` is the contract for live traces of the same form.
    Raises DataError where nothing can be read, or the options do not fit what is there.
    """
    chosen = (label, labels, fit, rate_hz, trigger, topic, time, unit)
    written = (names_of(columns), decimal, thousands)
    asked = Asked(samples, part, names_of(channel), *chosen, meanings(label_map), *written)
    what, takes, read = _reader(source, asked)
    options = ("label", "labels", "trigger", "topic", "time", *WRITTEN)
    idle = [name for name in options if getattr(asked, name) not in (None, ()) and name not in takes]
    if idle:
        why = "only text files are written so" if set(WRITTEN) & set(idle) else "it has its labels"
        why = "only a table has columns" if "time" in idle else why
        why = "only one long recording is cut" if {"trigger", "topic"} & set(idle) else why
        raise DataError(f"Expected no {' or '.join(idle)} for {what}: {why}; leave it out.")
    return read()


def _reader(source: Any, asked: Asked) -> tuple[str, Sequence[str], Callable[[], Dataset]]:
    """What a source is called, which of the options about labels and triggers say something to it, and what reads it."""
    if isinstance(source, Dataset):
        return "a Dataset", (), partial(refit, source, asked)
    if isinstance(source, tuple) and len(source) == 2:
        return "a pair (X, y)", (), partial(_from_pair, *source, asked)
    if hasattr(source, "columns"):
        return "a DataFrame", ("label", "labels", "time"), partial(from_frame, source, asked)
    if not isinstance(source, str | os.PathLike):
        got = type(source).__name__
        raise DataError(f"Expected a name, a path, a Dataset, a DataFrame or a pair (X, y), got {got}.")
    if str(source) in BUNDLED:
        path = Path(str(files("dengine"))) / "data" / BUNDLED[str(source)]
        return "a bundled set", (), partial(_read_npz, {path.name: path}, str(source), asked)
    takes, read = _reader_of_files(Path(source), asked)
    return str(source), takes, read


def _reader_of_files(path: Path, asked: Asked) -> tuple[Sequence[str], Callable[[], Dataset]]:
    """What reads a file, or a folder: a bag, recordings of an insertion each, or tables or archives of many."""
    name = path.resolve().name if path.is_dir() else path.stem
    if is_stream(path):
        return ("label", "labels", "trigger", "topic"), partial(read_bag, path, name, asked)
    named = {path.name: path}
    if path.is_dir() and not hold_many(named := recordings_in(path, asked), asked):
        return ("label", "labels", "time", *WRITTEN), partial(read_folder, path, named, name, asked)
    if len(named) == 1:
        path = next(iter(named.values()))
        name, named = path.stem, {path.name: path}
    if not path.exists() or not all(each.is_file() for each in named.values()):
        known = f"a data set among {', '.join(BUNDLED)}, a file {FORMS}, a store"
        raise DataError(f"Expected {known}, or a folder of CSV files, got {path}.")
    if path.is_file() and is_database(path):
        return (), partial(_read_store, path, name, asked)
    kinds = {each.suffix.lower() in TABLES: each for each in named.values()}
    if len(kinds) > 1:
        raise DataError(f"Expected tables or .npz files in {path}, got {kinds[True].name} and {kinds[False].name}.")
    if True in kinds:
        return ("label", "labels", "time", *WRITTEN), partial(read_tables, named, name, asked)
    if path.is_dir() or path.suffix.lower() == ".npz" or zipfile.is_zipfile(path):
        return ("label", "labels"), partial(_read_npz, named, name, asked)
    raise DataError(f"Expected a file {FORMS}, got {path}; save it as one of these.")


def _read_store(path: Path, name: str, asked: Asked) -> Dataset:
    """Every labelled trace of a store, in the order of the labels, as they count now, without bad and forgotten ones."""
    from ..store.opening import opening

    with opening(path, must_exist=True) as store:
        if said := store.database.check_integrity(0, since=0):
            raise DataError(f"Expected {path} as its ledger has it, {said}; see `dengine verify`, and restore a copy.")
        held, spec = store.labelled(), stored_trace_spec(store.settings())
    store.close()
    if spec is None or not len(held.labels):
        raise DataError(f"Expected a store with labelled traces, {path} has none; record some first, as in shadow mode.")
    about: dict[str, Any] = {"rate_hz": spec.rate_hz, "unit": spec.unit, "channels": tuple(spec.columns), "fit": spec.fit}
    X = held.traces[:, 0] if spec.channels == 1 else held.traces
    again = len(np.unique(held.hashes)) < len(held.hashes)
    part = held.hashes.astype(np.str_) if again else None  # as they count: a part that came again has one vote
    return refit(make_dataset(X, held.labels, part=part, name=name, **about), asked)


def _read_npz(named: Files, name: str, asked: Asked) -> Dataset:
    """`X`, `y`, and what is known beside them: `scale`, `rate_hz`, `unit`, `cause`, `channels`, and the parts' numbers.

    Where there is no `X`, the channels are arrays (n, T) by their names. Several archives are of one form, or of other
    arrays each. Where only another axis is as long as the labels, it is the one of the parts.
    """
    label = asked.label or "y"
    found, have = _archives(named, asked)
    if asked.labels is not None:
        found[label] = np.array(in_order(asked.labels, asked.part))
    own = () if "X" in found else asked.channels
    if not {label, *(own or ("X",))} <= set(found):
        raise DataError(f"Expected {_wanted_arrays(named, asked)}")
    if asked.part != "part" and asked.part not in found:
        raise DataError(f"Expected an array {asked.part} in {', '.join(named)}, found {listed(have)}.")
    with read_errors(name, "an .npz file of plain arrays"):
        arrays = [_by_part(found[each], found[label]) for each in own or ("X",)]
        X = np.stack(arrays, axis=1) if len(own) > 1 else arrays[0]
        if "scale" in found:
            X = X.astype(np.float32) * found["scale"].astype(np.float32)
        about: dict[str, Any] = {"part": found.get(asked.part), "cause": found.get("cause")}
        rate = found.get("rate_hz")
        about |= {"unit": str(found.get("unit", "N")), "rate_hz": None if rate is None else float(rate)}
        if len(own) == 1 and X.ndim == 3:  # one array of several channels names none of them
            own, asked = (), replace(asked, channels=())
        about["channels"] = own or tuple(map(str, found.get("channels", ())))
        return refit(_checked(X, found[label], asked, name, **about), asked)


def _archives(named: Files, asked: Asked, every: bool = False) -> tuple[dict[str, NDArray[Any]], list[str]]:
    """The arrays of archives, and the names of all: of one form, one after the other, or as one, where none is in two."""
    label = asked.label or "y"
    wanted = None if every else (*USED, asked.part, label, *asked.channels)
    try:
        read = [read_archive(path, wanted) for path in named.values()]
    except DataError as error:
        if "Object arrays" not in str(error):
            raise
        raise DataError(f"{str(error).partition(':')[0]}: {_of_objects(next(iter(named.values())), asked)}") from error
    found, have = dict[str, NDArray[Any]](), list[str]()
    for source, (stored, names) in zip(named, read, strict=True):
        arrays = {key: _by_part(x, stored.get(label)) for key, x in stored.items()}
        if set(have).isdisjoint(names):
            found, have = found | arrays, have + names
            continue
        for key in () if every else sorted({*found, *arrays}):
            one, other = (each.get(key, np.array("none")) for each in (found, arrays))
            if one.ndim == other.ndim > 0 and one.shape[1:] == other.shape[1:] and key != "channels":
                found[key] = np.concatenate([one, other])
            elif not np.array_equal(one, other):
                forms = f"{one.shape or one} and {other.shape or other}"
                raise DataError(f"Expected {key} alike in {next(iter(named))} and {source}, got {forms}.")
    return found, have


def _of_objects(path: Path, asked: Asked) -> str:
    """How a file of Python objects, as traces of several lengths, becomes a table; who reads objects runs what they say."""
    _, have = read_archive(path, ())
    X = next((name for name in (*asked.channels, "X") if name in have), have[0])
    y = next((name for name in (asked.label, "y") if name in have), have[-1])
    do = f"d = np.load({str(path)!r}, allow_pickle=True); frame = pd.DataFrame([*d[{X!r}]]).assign(y=d[{y!r}].astype(str))"
    do = f"import numpy as np, pandas as pd; {do}; frame.to_csv({str(path.with_suffix('.csv'))!r}, index=False)"
    return f'Python objects, which can run code when they are read. If you trust it, make a table of it: python -c "{do}".'


def _by_part(x: NDArray[Any], told: NDArray[Any] | None) -> NDArray[Any]:
    """(n, ...), by the only axis that is as long as n labels; of (n, T, C), more samples than channels, (n, C, T)."""
    if told is None or told.ndim != 1 or x.ndim < 2:
        return x
    if len(x) != len(told) and x.shape.count(len(told)) == 1:
        x = np.moveaxis(x, x.shape.index(len(told)), 0)
    return x.swapaxes(1, 2) if x.ndim == 3 and x.shape[1] > x.shape[2] else x


def _wanted_arrays(named: Files, asked: Asked) -> str:
    """What is missing in archives, and which of their arrays could be it: of two dimensions, and of one as long as one."""
    found, have = _archives(named, asked, every=True)
    traces = [name for name, x in found.items() if x.ndim in (2, 3) and len(x)]
    single = [name for name, x in found.items() if x.ndim == 1 and traces and len(x) in found[traces[0]].shape]
    told = f"label={min(single, key=lambda name: len(set(found[name].tolist())))!r}" if single else ""
    shapes = ", ".join(f"{name} {found[name].shape}" for name in have) or "none"
    channel = "" if "X" in have else f"channel={traces[0]!r} and " if traces else ""
    for beside in sorted(next(iter(named.values())).parent.glob("*.csv")):
        with suppress(DataError):
            if not told and traces and len(in_order(beside, asked.part)) in found[traces[0]].shape:
                told = f"labels={str(beside)!r}, in the order of the traces"
    return f"arrays X and y in {listed(named)}{f', or their names, as in {channel}{told}' if told else ''}; found {shapes}."


def _from_pair(X: Any, y: Any, asked: Asked) -> Dataset:
    """Traces in memory and their labels: one array, or a list of arrays, Series or DataFrames of any length."""
    if isinstance(X, list | tuple) or (isinstance(X, np.ndarray) and X.dtype.kind == "O" and X.ndim == 1):
        traces = list(X)
        if traces and not all(np.isscalar(each) for each in traces):
            return _from_list(traces, list(y), asked)
    return refit(_checked(X, y, asked), asked)


def _checked(X: Any, y: Any, asked: Asked, name: str = "data", **about: Any) -> Dataset:
    """A data set of the traces that have a label; words become 1 and 0, and what has no label yet is counted."""
    found, words = Collected(name, ()), asked.words

    def meant(word: Any) -> float:
        try:
            return label_of(word, words)
        except UnlabelledError:
            return np.nan
        except UnreadableError:
            found.unknown[str(word)] += 1
            return 0

    with instead(DataError, "Expected a label for each trace, 1 (success) or 0 (failure)", ValueError, TypeError):
        given = np.asarray(y)
        in_words = given.dtype.kind in "OUS" or words
        labels = np.array([meant(word) for word in given.tolist()]) if in_words else given
    found.must_mean_something()
    fits = labels.dtype.kind == "f" and labels.shape == np.shape(X)[:1]
    empty = np.isnan(labels) if fits else np.zeros(1, dtype=bool)
    if not empty.any():
        return make_dataset(X, labels, name=name, **about)
    n, left = int(empty.sum()), ~empty
    must(not empty.all(), f"labelled traces in {name}", f"{n} that have no label yet")
    about |= {key: np.asarray(about[key])[left] for key in ("part", "cause") if about.get(key) is not None}
    about["notes"] = (f"{n} of {len(labels)} traces of {name} have no label yet: they are left out.",)
    return make_dataset(np.asarray(X)[left], labels[left], name=name, unlabelled=n, **about)


def _with_index(frame: Any) -> Any:
    """A DataFrame whose index may be its clock, as a column."""
    return frame.reset_index() if frame.index.dtype.kind in "fMm" else frame


def _from_list(traces: list[Any], labels: list[Any], asked: Asked) -> Dataset:
    must(len(traces) == len(labels), f"a label for each of {len(traces)} traces", len(labels))
    has_force = any(FORCE in getattr(trace, "columns", ()) for trace in traces)
    found = Collected("data", asked.channels or ((FORCE,) if has_force else ()))

    def recorded(number: int, trace: Any, word: Any) -> Recorded:
        have = list(map(str, getattr(trace, "columns", ())))
        timed = hasattr(trace, "iloc") and trace.ndim == 2 and not asked.rate_hz
        for name in (name for name in found.channels if have and name not in have):
            raise UnreadableError(f"Expected a column {name}, got {listed(have)}")
        picked = trace[list(found.channels)] if have and found.channels else trace
        x, label = as_trace(picked, None), label_of(word, asked.words)
        if found.read and len(x) != len(found.read[0].trace):
            raise UnreadableError(f"Expected {len(found.read[0].trace)} channel(s), as the first has, got {len(x)}")
        found.channels = found.channels or spec_of(x, picked).columns
        clock = clock_of(_with_index(trace), asked.time) if timed else None
        rate = None if clock is None else rate_of(clock, trace.index)
        told = tuple(units.split(name)[1] for name in found.channels)
        return Recorded(x, label, f"trace {number}", rate_hz=rate, units=told)

    for row in zip(count(1), traces, labels, strict=False):
        found.take("data", partial(recorded, *row), row[0])
    return as_dataset(found, asked)
