"""`Dataset`, labelled traces of one shape in memory, and `make_dataset`, which makes one of arrays.

A `Fault` says why a recording was left out.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import DataError, TraceError, expect, instead, listed
from ..records import Ints, TraceArray, TraceSpec
from ..traces import as_traces

if TYPE_CHECKING:
    import pandas as pd

LEAST_RATE_HZ = 1.0  # of anything that a cell samples
MOST_RATE_HZ = 1e6
Texts = NDArray[np.str_]
Names = tuple[str, ...]
Progress = Callable[[int], None]  # called with the number of files or traces that are done
OWN = "dengine"  # key of the metadata by which a table of ours is known
expect_data = partial(expect, error=DataError)


def unit_text(units: Sequence[str]) -> str:
    """Return the units of channels as a text: "kN, mm", or a single "N" if all are equal.

    It is "" if there are no units.
    """
    return ", ".join(units if len({*units}) > 1 else units[:1])


def expect_all(wanted: Mapping[str, Any]) -> None:
    """Raise DataError for the first of several conditions that is not met.

    wanted : whether each condition is met, by what the message says was expected.
    """
    for what, is_met in wanted.items():
        if not is_met:
            raise DataError(f"Expected {what}.")


@dataclass(frozen=True, slots=True)
class Fault:
    """Why a recording was left out.

    source : str
        The file, as seen from the folder, with the row or part if the file has several.
    line : int
        Line of the file, from 1; 0 if the fault is not of one line.
    message : str
        What was expected, and what came.
    column : str
        Column of the table; "" if the fault is not of one column.
    """

    source: str
    line: int
    message: str
    column: str = ""

    def __str__(self) -> str:
        """Return "SOURCE, line 3, column Fz: MESSAGE", without a line or column that is not set."""
        line = f", line {self.line}" if self.line else ""
        column = f", column {self.column}" if self.column else ""
        return f"{self.source}{line}{column}: {self.message}"


Faults = list[Fault]


@dataclass(frozen=True, slots=True, repr=False)
class Dataset:
    """Labelled traces, in the order of their recording.

    Parameters
    ----------
    X : array of float32, shape (n, T) or (n, C, T)
    y : array of int8, shape (n,)
        1 for success, 0 for failure.
    name : str
        For people.
    rate_hz : float, optional
        Sampling rate in hertz. None: unknown.
    unit : str, default ""
        Unit of the samples, one for all channels or "kN, mm", one for each; "" if it is unknown.
    limit : float, optional
        Range of the sensor, in this unit. None: unknown.
    cause : array of str, shape (n,), optional
        Why a part failed.
    part : array of str, shape (n,), optional
        Number of the part of each trace. None: each trace is of another part.
    faults : tuple of Fault
        What could not be read and was left out.
    channels : tuple of str
        Names of the channels, if they have any.
    notes : tuple of str
        What users should know about the files, in sentences.
    source : array of str, shape (n,), optional
        The file or row of each trace.
    fit : str, default "strict"
        What happens to live traces of another length, as in `TraceSpec`.
    lengths : array of int64, shape (n,), optional
        Samples of each recording, as recorded.
    unlabelled : int
        Recordings that were left out because their part was not checked yet.
    ordered : bool, default True
        Whether the order of the traces can be that of the recording. False if all parts of one
        label come first.
    """

    X: TraceArray
    y: NDArray[np.int8]
    name: str = "data"
    rate_hz: float | None = None
    unit: str = ""
    limit: float | None = None
    cause: Texts | None = None
    part: Texts | None = None
    faults: tuple[Fault, ...] = ()
    channels: Names = ()
    source: Texts | None = None
    fit: str = "strict"
    lengths: Ints | None = None
    notes: Names = ()
    unlabelled: int = 0
    ordered: bool = True

    def __len__(self) -> int:
        """Return the number of traces; recordings that were left out do not count."""
        return len(self.y)

    def __repr__(self) -> str:
        """Return a short text: name, number and shape of the traces, good ones, and faults."""
        shape = " x ".join(map(str, self.X.shape[1:]))
        return (
            f"<Dataset {self.name}: {len(self)} traces, {shape} samples, {self.y.sum()} good, "
            f"{len(self.faults)} left out>"
        )

    @property
    def cube(self) -> TraceArray:
        """The traces, float32 of shape (n, C, T) also for a single channel; not a copy of `X`."""
        return self.X if self.X.ndim == 3 else self.X[:, None]

    @property
    def spec(self) -> TraceSpec:
        """The `TraceSpec` of live traces of the same shape, for `DataEngine(trace=data.spec)`.

        It has the shape, rate and unit of the traces, `limit` (the range of the sensor), `fit`
        (what is done with traces of another length), and as `columns` the names of the channels.
        Live traces are those that a robot cell records now. A rate or a unit that is unknown is
        None. Raises SettingError if a field of the data set has a value that no trace can have, for
        example if two channels have the same name.
        """
        _, channels, samples = self.cube.shape
        return TraceSpec(
            samples, self.rate_hz, channels, self.unit, self.limit, self.fit, self.channels
        )

    def to_frame(self) -> "pd.DataFrame":
        """Return a DataFrame with a row for each trace.

        Its columns are `label`, `part` and `cause` if known, and one for each sample of each
        channel: `FZ_0`, `FZ_1`, ... Without channel names they are `x_0`, `x_1`, ... or, if there
        are several channels, `x0_0`, `x0_1`, ... Its metadata (`attrs`, under "dengine") has the
        fields `channels`, `rate_hz`, `unit`, `limit` (the range of the sensor) and `fit` (what is
        done with live traces of another length), the number of channels and the names of the
        columns of samples. So `load_dataset` reads what
        `data.to_frame().to_parquet("data.parquet")` writes, without a description, also if columns
        were added or moved. All other fields are lost. The frame may share its memory with X.
        """
        import pandas as pd

        _, channels, samples = self.cube.shape
        stems = self.channels or (["x"] if channels == 1 else [f"x{c}" for c in range(channels)])
        names = [f"{stem}_{i}" for stem in stems for i in range(samples)]
        frame = pd.DataFrame(self.X.reshape(len(self), -1), columns=names)
        for name, values in (("cause", self.cause), ("part", self.part), ("label", self.y)):
            if values is not None:
                frame.insert(0, name, values)
        about = {
            name: getattr(self, name) for name in ("channels", "rate_hz", "unit", "limit", "fit")
        }
        frame.attrs[OWN] = {**about, "n_channels": channels, "columns": names}
        return frame

    def select(self, channels: Names) -> "Dataset":
        """Return a data set of the channels with these names, in this order.

        Its X is a copy, for one channel of shape (n, T). `channels` and `unit` become those of the
        selected channels; all other fields stay. Raises DataError for an unknown name, for no name,
        and if the channels of the data set have no names, and SettingError if its property `spec`
        (what an engine expects of such traces) does. A name that comes twice is accepted, but
        `spec` of the result then raises SettingError.
        """
        names = ", ".join(self.channels) or "none, its channels have no names"
        expect_data(
            set() < {*channels} <= {*self.channels},
            f"channels of {self.name}, {names}",
            [*channels],
        )
        places = [self.channels.index(name) for name in channels]
        X = np.ascontiguousarray(self.cube[:, places])
        return replace(
            self,
            X=X if len(places) > 1 else X[:, 0],
            channels=channels,
            unit=unit_text([self.spec.units[place] for place in places]),
        )

    def cut(self, samples: int) -> "Dataset":
        """Return a data set with only the first `samples` samples of each trace.

        The field `fit` says what is done with live traces of another length. If it is "pad" and the
        traces become shorter, it becomes "cut" in the result; all other fields stay, also
        `lengths`, the lengths of the recordings. Its X may share its memory with that of this data
        set. Raises DataError if `samples` is below 1, if the traces are shorter, or if `fit` is
        "resample" and they would become shorter: their first samples are not those of the
        recordings.
        """
        most = self.X.shape[-1]
        least = most if self.fit == "resample" else 1
        expect_data(
            least <= samples <= most,
            f"{least} to {most} samples of {self.name}",
            samples,
            "resampled traces stay whole",
        )
        return replace(
            self,
            X=np.ascontiguousarray(self.X[..., :samples]),
            fit="cut" if samples < most and self.fit == "pad" else self.fit,
        )


def make_dataset(
    X: ArrayLike,
    y: ArrayLike,
    *,
    rate_hz: float | None = None,
    channels: Sequence[str] = (),
    part: Any = None,
    cause: Any = None,
    **about: Any,
) -> Dataset:
    """Check arrays and make a `Dataset` of them.

    Parameters
    ----------
    X : array, shape (n, T) or (n, C, T)
    y : array, shape (n,)
        1 for success, 0 for failure.
    rate_hz, channels, part, cause
        As in `Dataset`: the rate of the samples, the names of the channels, and for each trace the
        number of its part and why the part failed. Part numbers may be integers, and become texts.
        `cause` is not converted.
    **about
        Other fields of `Dataset`, which are not checked.

    Returns
    -------
    Dataset
        Its X is float32, of shape (n, T) if there is one channel, and may share its memory with the
        given X. Its y is int8, and its `part` are texts.

    Raises
    ------
    DataError
        If X has no trace, another shape, more channels than samples, or values that are no real
        numbers; if y, part, cause or the names of the channels do not fit X; if a label is neither
        1 nor 0, or a part's number neither a text nor an integer; if `part` becomes an array of
        dtype object, even one of texts, like a column of pandas; or if the rate is not between
        1 Hz and 1 MHz, both included. NaN and infinities in X pass, and so do equal names.
    TypeError
        If `about` has a name that is no other field of `Dataset`.
    """
    try:
        cube = as_traces(X)
    except TraceError as error:
        raise DataError(str(error)) from error
    with instead(DataError, "Expected a label and a part for each trace", ValueError):
        y = np.asarray(y)
        parts = None if part is None else np.asarray(part)
    n, n_channels, samples = cube.shape
    words = sorted({*map(str, y.ravel().tolist())})
    expect_all(
        {
            f"X (n, T) or (n, C, T) with n labels, got {(np.shape(X), y.shape)}": y.shape == (n,),
            "at least one trace": n,
            f"X (n, channels, samples), got {cube.shape}; transpose it": n_channels <= samples,
            f"labels 1 (success) and 0 (failure), got {listed(words)}": np.isin(y, (0, 1)).all(),
            f"a rate of 1 Hz to 1 MHz, got {rate_hz}": (
                rate_hz is None or LEAST_RATE_HZ <= rate_hz <= MOST_RATE_HZ
            ),
            f"a name for each of {n_channels} channels": len(channels) in (0, n_channels),
            f"{n} parts' numbers, texts or integers": (
                parts is None or (parts.shape == y.shape and parts.dtype.kind in "iuUS")
            ),
            "a cause for each trace": cause is None or np.shape(cause) == y.shape,
        }
    )
    return Dataset(
        cube[:, 0] if n_channels == 1 else cube,
        y.astype(np.int8),
        rate_hz=rate_hz,
        channels=tuple(channels),
        part=None if parts is None else parts.astype(np.str_),
        cause=cause,
        **about,
    )
