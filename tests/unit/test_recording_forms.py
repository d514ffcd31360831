"""Every form of a recording gives the values that were measured, or an error that says what to
state.
"""

import itertools
import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from dengine import Dataset, load_dataset
from dengine.datasets import units
from dengine.datasets.clocks import seconds_of
from dengine.errors import DataError
from tests.support import recording_forms
from tests.support.command_line import dengine, document
from tests.support.recording_forms import (
    CLOCK_NAMES,
    CLOCK_UNITS,
    DELIMITERS,
    NUMBERS,
    STEP,
    SUFFIXES,
    TIMES,
    UNITS,
)

N = 120
VALUES = np.round(np.linspace(-400.0, 2600.0, N) + 90.0 * np.sin(np.arange(N)), 1)


def write(
    path: Path,
    header: Sequence[str],
    *columns: Sequence[str],
    delimiter: str = ",",
    above: Sequence[str] = (),
) -> Path:
    """Texts as a file, in quotes where the delimiter is in them."""
    path.parent.mkdir(parents=True, exist_ok=True)
    marked = delimiter.strip() or delimiter[:1]
    quoted = [
        [f'"{cell}"' if marked in cell else cell for cell in row]
        for row in zip(*columns, strict=True)
    ]
    rows = [delimiter.join(row) for row in quoted]
    path.write_text("\n".join([*above, delimiter.join(header), *rows]) + "\n", "utf-8")
    return path


def times(n: int = N, step: float = STEP, form: str = "{:.3f}") -> list[str]:
    return [form.format(step * i) for i in range(n)]


def texts(values: Sequence[float] = VALUES, form: str = "{:.1f}") -> list[str]:
    return [form.format(value) for value in values]


def english(values: Sequence[float]) -> list[str]:
    return texts(values, "{:,.0f}")


def german(cells: Sequence[str]) -> list[str]:
    return [cell.translate(str.maketrans(",.", ".,")) for cell in cells]


@pytest.mark.parametrize("form", NUMBERS)
@pytest.mark.parametrize("delimiter", DELIMITERS)
def test_numbers_are_read_as_they_were_written(form: str, delimiter: str, tmp_path: Path) -> None:
    mark = DELIMITERS[delimiter]
    cells = [[NUMBERS[form](x) for x in xs] for xs in (STEP * 1000 * np.arange(1, N + 1), VALUES)]
    write(tmp_path / "a_OK.csv", ["t/ms", "Kraft"], *cells, delimiter=mark)
    data = load_dataset(tmp_path)
    np.testing.assert_allclose(data.X[0], VALUES, rtol=1e-4)
    assert (data.rate_hz, data.channels, data.faults) == (250.0, ("Kraft",), ())


WHOLE = np.r_[np.arange(20, 2600, 30), 998.0, 1001.0]  # newtons
DECIDED: dict[
    str, tuple[list[list[str]], str]
] = {  # cells of a clock and of whole newtons, and the delimiter
    "German thousands, by the clock": ([german(times(len(WHOLE))), german(english(WHOLE))], ";"),
    "German thousands in tabs": ([german(times(len(WHOLE))), german(english(WHOLE))], "\t"),
    "English thousands, by the clock": ([times(len(WHOLE)), english(WHOLE)], ";"),
    "English thousands in quotes": ([times(len(WHOLE)), english(WHOLE)], ","),
    "German thousands, by smaller ones": (
        [[str(4 * i) for i in range(len(WHOLE))], german(english(WHOLE))],
        ";",
    ),
    "Swiss thousands": (
        [times(len(WHOLE)), [cell.replace(",", "'") for cell in english(WHOLE)]],
        ",",
    ),
}


@pytest.mark.parametrize("form", DECIDED)
def test_a_mark_of_thousands_is_no_decimal_one(form: str, tmp_path: Path) -> None:
    (clock, force), delimiter = DECIDED[form]
    write(
        tmp_path / "a_OK.csv",
        ["t" if "." in clock[1] or "," in clock[1] else "t [ms]", "F"],
        clock,
        force,
        delimiter=delimiter,
    )
    data = load_dataset(tmp_path)
    np.testing.assert_array_equal(data.X[0], WHOLE)
    assert data.rate_hz == 250.0


def test_millions_prove_which_mark_groups_thousands(tmp_path: Path) -> None:
    write(tmp_path / "a_OK.csv", ["F"], ["1,043", "1,043,500"], delimiter=";")
    write(tmp_path / "b_OK.csv", ["F"], ["1.043", "1.043.500"], delimiter=";")
    assert load_dataset(tmp_path, channel="F").X.tolist() == [[1043.0, 1043500.0]] * 2


def test_a_file_that_does_not_tell_its_decimal_mark_is_refused_until_somebody_states_it(
    tmp_path: Path,
) -> None:
    cells = ["1.043", "1.102", "2.250", "2.375"] * 5
    for name in ("a_OK.csv", "b_NOK.csv"):
        write(tmp_path / "a" / name, ["Kraft"], cells, delimiter=";")
    refused = dengine("data", tmp_path / "a")
    assert refused.exit_code == 1
    refusal = "1.043 in column Kraft may be 1.043 or 1043; say which, --decimal . or --thousands ."
    assert refusal in refused.stderr
    for words, first in (
        (("--decimal", "."), 1.043),
        (("--decimal", ","), 1043.0),
        (("--thousands", "."), 1043.0),
    ):
        assert document("data", tmp_path / "a", *words)["survey"]["traces"] == 2
        data = load_dataset(tmp_path / "a", **{words[0].strip("-"): words[1]})
        assert data.X[0, 0] == np.float32(first)
    write(
        tmp_path / "a" / "c_OK.csv", ["Kraft"], german(texts(VALUES[:20], "{:.2f}")), delimiter=";"
    )
    decided = load_dataset(tmp_path / "a")  # by the only one that tells
    assert decided.X[:2, 0].tolist() == [1043.0, 1043.0]
    with pytest.raises(DataError, match=r"decimal mark, '.' or ','"):
        load_dataset(tmp_path / "a", decimal=";")
    with pytest.raises(
        DataError, match=r"Expected no decimal for .*, which has none; leave it out"
    ):
        load_dataset((np.zeros((2, 3)), [0, 1]), decimal=",")


def test_points_between_commas_or_blanks_are_decimal(tmp_path: Path) -> None:
    cells = texts(np.linspace(1.0, 9.0, 30), "{:.3f}")
    for i, delimiter in enumerate(", "):
        write(tmp_path / f"{i}_OK.txt", ["a", "FZ_Base"], cells, cells, delimiter=delimiter)
    assert load_dataset(tmp_path).X[:, 0].tolist() == [1.0, 1.0]


def test_a_number_in_another_format_than_its_files_is_a_fault_with_its_line(tmp_path: Path) -> None:
    odd = german(texts())
    odd[7] = "12.5"
    for name, cells in (("a_OK.csv", german(texts())), ("b_OK.csv", odd)):
        write(tmp_path / name, ["Zeit", "Kraft"], german(times()), cells, delimiter=";")
    data = load_dataset(tmp_path)
    assert [(f.source, f.line) for f in data.faults] == [("b_OK.csv", 9)]
    refusal = (
        "Expected a number in column Kraft with ',' before decimals, as the file has, got '12.5'"
    )
    assert refusal in data.faults[0].message


def test_a_column_that_contradicts_the_files_decimal_mark_is_named(tmp_path: Path) -> None:
    write(
        tmp_path / "a_OK.csv",
        ["t", "Kraft"],
        times(len(WHOLE)),
        german(english(WHOLE)),
        delimiter=";",
    )
    with pytest.raises(
        DataError, match=r"Kraft has '.' before thousands, other columns have it before decimals"
    ):
        load_dataset(tmp_path)


@pytest.mark.parametrize("name", [*CLOCK_NAMES, *CLOCK_UNITS])
def test_a_clock_is_known_by_its_name_and_unit(name: str, tmp_path: Path) -> None:
    scale = CLOCK_UNITS.get(name, 1.0)
    step = 0.5 if scale == 60.0 else STEP  # a clock in minutes is a slow one
    cells = [f"{step * i / scale:.6f}" for i in range(N)]
    write(tmp_path / "a_OK.csv", [f'"{name}"' if "," in name else name, "Kraft"], cells, texts())
    data = load_dataset(tmp_path)
    assert (data.channels, data.rate_hz) == (("Kraft",), 1 / step)
    assert load_dataset(pd_pair(tmp_path)).rate_hz == 1 / step


def pd_pair(folder: Path) -> tuple[list[pd.DataFrame], list[int]]:
    return [pd.read_csv(path) for path in folder.iterdir()], [1]


@pytest.mark.parametrize("form", TIMES)
def test_times_are_read_in_all_forms_and_a_long_table_is_sorted_by_them(
    form: str, tmp_path: Path
) -> None:
    cells = [TIMES[form](i) for i in range(N)]
    order = np.random.default_rng(0).permutation(N)
    write(tmp_path / "cell" / "a_OK.csv", ["Time", "FZ"], cells, texts(), delimiter=";")
    data = load_dataset(tmp_path / "cell")
    np.testing.assert_array_equal(data.X[0], VALUES.astype(np.float32))
    assert data.rate_hz == pytest.approx(250.0, rel=1e-3)
    rows = [[cells[i], "S1", "OK", texts()[i]] for i in order]
    write(
        tmp_path / "long.csv",
        ["Time", "part", "label", "FZ"],
        *zip(*rows, strict=True),
        delimiter=";",
    )
    for stated in ({}, {"rate_hz": 250}):
        table = load_dataset(tmp_path / "long.csv", time="Time", **stated)
        np.testing.assert_array_equal(table.X, data.X)


def test_a_clock_without_a_name_is_known_by_its_values(tmp_path: Path) -> None:
    index = pd.date_range("2026-03-01 06:00", periods=N, freq="4ms")
    frames = {
        "stamps": pd.DataFrame({"FZ": VALUES}, index=index),
        "seconds": pd.DataFrame({"FZ": VALUES}, index=np.arange(N) * STEP),
        "since 1970": pd.DataFrame({"ros": 1.7e9 + np.arange(N) * STEP, "FZ": VALUES}),
    }
    for name, frame in frames.items():
        folder = tmp_path / name
        folder.mkdir()
        frame.to_csv(folder / "a_OK.csv", index=name != "since 1970")
        data = load_dataset(folder)
        assert (data.channels, data.rate_hz) == (("FZ",), 250.0), name
        assert "by its values" in data.reading["clock"]
    both = [frames["stamps"], frames["seconds"] + 1]
    assert load_dataset((both, [1, 0])).rates.tolist() == [250.0, 250.0]


def test_the_two_columns_of_a_ros_stamp_are_one_clock(tmp_path: Path) -> None:
    nanos = [int(i * 4e6 + 900_000_000) for i in range(N)]
    stamp = [[str(1_700_000_000 + n // 10**9) for n in nanos], [str(n % 10**9) for n in nanos]]
    write(tmp_path / "a_OK.csv", ["header.stamp.secs", "header.stamp.nsecs", "z"], *stamp, texts())
    data = load_dataset(tmp_path)
    assert (data.channels, data.rate_hz) == (("z",), 250.0)


def test_a_date_beside_the_time_of_day_is_not_the_clock(tmp_path: Path) -> None:
    day = ["01.03.2026"] * N
    write(
        tmp_path / "a_OK.csv",
        ["Datum", "Uhrzeit", "FZ"],
        day,
        [TIMES["06:00:00,008"](i) for i in range(N)],
        texts(),
        delimiter=";",
    )
    assert load_dataset(tmp_path).rate_hz == 250.0


def test_without_a_clock_the_rate_is_unknown_and_a_column_that_rises_is_offered(
    tmp_path: Path,
) -> None:
    for i, name in enumerate(("a_OK.csv", "b_NOK.csv")):
        cells = (times(form="{:.4f}", step=0.02), texts(VALUES + i))
        write(tmp_path / name, ["Weg", "Kraft"], *cells)
    words = ("data", tmp_path, "--channel", "Kraft")
    shown = dengine(*words).stdout
    assert "500" not in shown
    assert re.search(r"rate +│ unknown", shown)
    assert "The rate is unknown" in " ".join(shown.split())
    assert "column Weg rises steadily: --time Weg if it is one" in shown
    assert document(*words)["survey"]["rate_hz"] is None
    assert document(*words, "--time", "Weg")["survey"]["rate_hz"] == 50.0
    assert document(*words, "--rate-hz", "250")["survey"]["rate_hz"] == 250.0
    trained = dengine(
        "train",
        "--data",
        tmp_path,
        "--channel",
        "Kraft",
        "--store",
        tmp_path / "a.db",
        "--reducer",
        "pca",
    )
    assert "The rate is unknown" in trained.stderr
    assert "unknown rate" in repr(load_dataset(tmp_path, channel="Kraft"))


def test_a_clock_is_named_in_any_case_and_without_its_unit(tmp_path: Path) -> None:
    write(tmp_path / "folder" / "a_OK.csv", ["Takt [s]", "F"], times(), texts())
    long = write(
        tmp_path / "long.csv",
        ["part", "Takt", "F", "label"],
        ["1"] * N,
        times(),
        texts(),
        ["OK"] * N,
    )
    for time in ("Takt", "TAKT", "takt [s]"):
        assert load_dataset(tmp_path / "folder", time=time).rate_hz == 250.0
        assert load_dataset(long, time=time, channel="F").rate_hz == 250.0
    with pytest.raises(DataError, match="Expected a column Uhr of times"):
        load_dataset(tmp_path / "folder", time="Uhr", channel="F")


def test_a_count_of_samples_is_no_clock(tmp_path: Path) -> None:
    pd.DataFrame({"FZ": VALUES}).to_csv(tmp_path / "a_OK.csv")
    data = load_dataset(tmp_path)
    assert (data.channels, data.rate_hz) == (("FZ",), None)


def test_lost_messages_are_found_by_any_clock(tmp_path: Path) -> None:
    stamps = [str(1_700_000_000_000_000_000 + 4_000_000 * i) for i in range(N)]
    for name, kept in (
        ("a_OK.csv", range(N)),
        ("b_OK.csv", [i for i in range(N) if not 40 <= i < 60]),
    ):
        write(
            tmp_path / name,
            ["%time", "field.wrench.force.z"],
            [stamps[i] for i in kept],
            [texts()[i] for i in kept],
        )
    data = load_dataset(tmp_path)
    assert [(f.source, f.line) for f in data.faults] == [("b_OK.csv", 42)]
    assert "Expected a step of 0.004 s in time, got a gap of 0.084 s" in data.faults[0].message


UNBELIEVED = {
    "too fast": ("time [s]", "{:.9f}", 4e-8),
    "too slow": ("time [s]", "{:.3f}", 4.0),
    "a wrong unit": ("time_ms", "{:.3f}", 4000.0),
    "too short": ("time [s]", "{:.9f}", 2e-6),
    "too long": ("time [s]", "{:.3f}", 0.9),
}


@pytest.mark.parametrize("case", UNBELIEVED)
def test_a_rate_or_duration_that_cannot_be_is_refused_until_a_rate_is_stated(
    case: str, tmp_path: Path
) -> None:
    name, form, step = UNBELIEVED[case]
    n = 5000 if case == "too long" else N
    write(tmp_path / "a_OK.csv", [name, "FZ"], times(n, step, form), texts(np.arange(n)))
    refused = dengine("data", tmp_path)
    assert refused.exit_code == 1
    assert re.search(
        r"Expected a clock of 1 Hz to 1 MHz over 1 ms to 1 h, column time.* tells .* Hz over .*--rate-hz",
        refused.stderr,
    )
    assert load_dataset(tmp_path, rate_hz=250).rate_hz == 250.0


def test_a_clock_that_names_no_unit_is_read_by_its_size_and_that_is_said(tmp_path: Path) -> None:
    for form, unit in (
        ("8 (ms)", "milliseconds"),
        ("8000 (µs)", "microseconds"),
        ("46082.25000009 (Excel's days)", "days"),
    ):
        write(tmp_path / "a_OK.csv", ["Time", "FZ"], [TIMES[form](i) for i in range(N)], texts())
        assert f"is read as {unit}" in " ".join(dengine("data", tmp_path).stdout.split()), form


def test_counts_that_float64_would_round_are_subtracted_exactly() -> None:
    counts = [639079416000000001 + 7 * i for i in range(N)]
    for column in (pd.Series(counts), pd.Series(list(map(str, counts)))):
        seconds, wrong, note, form = seconds_of(column, "Ticks")
        np.testing.assert_allclose(seconds, 7e-7 * np.arange(N), rtol=1e-12)
        assert (wrong, note, form) == ([], "", "1e-07 s")


def test_a_count_that_no_epoch_makes_a_date_of_is_refused(tmp_path: Path) -> None:
    cells = [str(50_000_000_000_000_000 + 40_000 * i) for i in range(N)]
    write(tmp_path / "bare" / "a_OK.csv", ["Time", "FZ"], cells, texts())
    with pytest.raises(DataError, match=r"dates from 2000 to 2100 .* 5e\+16 is none"):
        load_dataset(tmp_path / "bare")
    write(tmp_path / "stated" / "a_OK.csv", ["Time (0.1 us)", "FZ"], cells, texts())
    assert load_dataset(tmp_path / "stated").rate_hz == 250.0


def test_a_clock_of_whole_milliseconds_tells_the_rate_that_it_has_on_average(
    tmp_path: Path,
) -> None:
    write(
        tmp_path / "a_OK.csv",
        ["time_ms", "FZ"],
        [str(int(i * 1000 / 300)) for i in range(N)],
        texts(),
    )
    assert load_dataset(tmp_path).rate_hz == pytest.approx(300.0, rel=0.01)


def in_unit(form: str, unit: str) -> tuple[list[str], list[str]]:
    """The header of a file whose FZ is in a unit, and the lines below it."""
    if form == "a row of units":
        return ["time", "FZ"], [f"s;{unit}"]
    return ["time", form.replace("kN", unit)], []


@pytest.mark.parametrize("form", UNITS)
def test_recordings_in_another_unit_are_converted_and_that_is_said(
    form: str, tmp_path: Path
) -> None:
    for i, (unit, scale) in enumerate([("N", 1.0), ("kN", 1e-3), ("N", 1.0), ("mN", 1e3)]):
        header, row = in_unit(form, unit)
        path = write(
            tmp_path / f"{i}_OK.csv",
            header,
            times(),
            texts(VALUES * scale, "{:.6f}"),
            delimiter=";",
        )
        head, *rows = path.read_text().splitlines()
        path.write_text("\n".join([head, *row, *rows]))
    data = load_dataset(tmp_path, channel="FZ")
    np.testing.assert_allclose(data.X, np.tile(VALUES, (4, 1)), rtol=1e-5, atol=1e-3)
    assert (data.unit, data.faults) == ("N", ())
    shown = " ".join(dengine("data", tmp_path, "--channel", "FZ").stdout.split())
    assert "FZ is converted from kN to N, times 1000." in shown
    assert "FZ is converted from mN to N, times 0.001." in shown
    in_kn = load_dataset(tmp_path, channel="FZ", unit="kN")
    np.testing.assert_allclose(in_kn.X * 1000, data.X, rtol=1e-5)
    assert in_kn.unit == "kN"


@pytest.mark.parametrize(
    ("row", "step"),
    [("ms;;;kN", 4), ("[ms];;;[kN]", 4), ("0.001 ms;-;-;kN", 4000), ("Sek.;;;kN", 0.004)],
)
def test_a_row_of_units_is_of_the_clock_too_and_of_a_long_table(
    row: str, step: float, tmp_path: Path
) -> None:
    cells = [f"{step * i:g}" for i in range(N)]
    path = write(
        tmp_path / "long.csv",
        ["Zeit", "part", "label", "FZ"],
        cells,
        ["7"] * N,
        ["OK"] * N,
        texts(),
        delimiter=";",
    )
    head, *rows = path.read_text().splitlines()
    path.write_text("\n".join([head, row, *rows]))
    data = load_dataset(path, time="Zeit")
    assert (data.rate_hz, data.unit, data.notes) == (250.0, "kN", ())


@pytest.mark.parametrize("form", ["hh:mm:ss", "HH:MM:SS.fff", "hh:mm:ss,000", "[hh:mm:ss]", "ms"])
def test_the_form_of_a_time_may_stand_in_a_row_of_units(form: str, tmp_path: Path) -> None:
    cells = times(step=4, form="{:.0f}")
    if form != "ms":
        cells = [TIMES["06:00:00,008"](i) for i in range(N)]
    path = write(tmp_path / "a_OK.csv", ["hora", "fuerza"], cells, texts(), delimiter=";")
    head, *rows = path.read_text().splitlines()
    path.write_text("\n".join([head, f"{form};kgf", *rows]))
    data = load_dataset(tmp_path)
    np.testing.assert_array_equal(data.X[0], VALUES.astype(np.float32))
    assert (data.channels, data.rate_hz, data.unit) == (("fuerza",), 250.0, "kgf")


def test_a_unit_in_another_case_is_the_one_that_it_can_be(tmp_path: Path) -> None:
    for unit, usual in {"KN": "kN", "kn": "kN", "LBF": "lbf", "Mpa": "Mpa", "mn": "mn"}.items():
        assert units.spelling(unit) == usual
    assert units.split("FZ [KN]") == ("FZ", "kN")
    for name, unit, scale in (("a_OK", "N", 1.0), ("b_OK", "N", 1.0), ("c_OK", "KN", 1e-3)):
        cells = texts(VALUES * scale, "{:.6f}")
        write(tmp_path / f"{name}.csv", ["time", f"FZ [{unit}]"], times(), cells)
    data = load_dataset(tmp_path)
    assert (data.unit, data.faults) == ("N", ())
    np.testing.assert_allclose(data.X, np.stack([VALUES] * 3), rtol=1e-6)


def test_the_unit_of_frames_is_that_of_their_columns() -> None:
    frame = pd.DataFrame({"t [ms]": 4 * np.arange(N), "FZ [kN]": VALUES})
    data = load_dataset(([frame, frame * [1, 2]], [1, 0]))
    assert (data.rate_hz, data.unit) == (250.0, "kN")


def test_a_unit_that_nothing_converts_or_that_is_not_told_is_a_fault(tmp_path: Path) -> None:
    for i, unit in enumerate(["kN", "kN", "mm", ""]):
        write(
            tmp_path / f"{i}_OK.csv", ["time", f"FZ [{unit}]" if unit else "FZ"], times(), texts()
        )
    data = load_dataset(tmp_path, channel="FZ")
    assert (data.unit, [f.source for f in data.faults]) == ("kN", ["2_OK.csv", "3_OK.csv"])
    assert [f.message.partition(";")[0] for f in data.faults] == [
        "Expected FZ in kN, as the others are, got mm",
        "Expected FZ in kN, as the others are, got no unit",
    ]
    assert "unit='kN'" in data.faults[1].message
    assert [f.source for f in load_dataset(tmp_path, channel="FZ", unit="kN").faults] == [
        "2_OK.csv"
    ]


def test_each_channels_unit_is_the_headers(tmp_path: Path) -> None:
    write(tmp_path / "a_OK.csv", ["t [s]", "F [kN]", "s [mm]"], times(), texts(), texts())
    assert load_dataset(tmp_path, channel="F,s").unit == "kN, mm"
    assert load_dataset(tmp_path, channel="F").unit == "kN"


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("delimiter", DELIMITERS)
def test_files_of_any_suffix_and_delimiter_are_read(
    suffix: str, delimiter: str, tmp_path: Path
) -> None:
    for i, name in enumerate(("a_OK", "b_NOK")):
        write(
            tmp_path / f"{name}{suffix}",
            ["time", "FZ"],
            times(),
            texts(VALUES + i),
            delimiter=DELIMITERS[delimiter],
        )
    (tmp_path / ("readme.txt" if suffix != ".txt" else "readme.dat")).write_text("of cell 3")
    data = load_dataset(tmp_path)
    np.testing.assert_allclose(data.X, [VALUES, VALUES + 1], rtol=1e-6)
    assert (data.y.tolist(), data.rate_hz, data.faults) == ([1, 0], 250.0, ())
    assert f"Not read, for most files are {suffix}: readme" in data.notes[0]


def test_columns_without_a_header_are_named_as_the_error_advises(tmp_path: Path) -> None:
    for i, name in enumerate(("a_OK.txt", "b_NOK.txt")):
        np.savetxt(tmp_path / name, np.c_[1.7e9 + STEP * np.arange(N), 0 * VALUES, VALUES + i])
    refused = dengine("data", tmp_path)
    assert "line 1: Expected a header, its first line is of numbers" in refused.stderr
    advised = re.search(r"--columns (\S+?);", refused.stderr)[1]
    assert advised == "time,c1,c2"
    record = document("data", tmp_path, "--columns", advised, "--channel", "c2")["survey"]
    assert (record["traces"], record["rate_hz"]) == (2, 250.0)
    data = load_dataset(tmp_path, columns="time,fx,fy", channel="fy")
    np.testing.assert_array_equal(data.X[0], VALUES.astype(np.float32))
    with pytest.raises(DataError, match="Expected 2 columns, got 3"):
        load_dataset(tmp_path, columns="time,fx")


def test_a_header_that_is_a_comment_or_below_a_preamble_is_named_by_its_line(
    tmp_path: Path,
) -> None:
    np.savetxt(tmp_path / "a_OK.txt", np.c_[STEP * np.arange(N), VALUES], header="time FZ")
    assert load_dataset(tmp_path).channels == ("FZ",)
    for name in ("b_OK.txt", "c_NOK.txt"):
        path = tmp_path / "press" / name
        write(
            path,
            ["time", "FX"],
            times(),
            texts(),
            delimiter=";",
            above=["Presse 3", "Teil;7;x", "", "Bediener;K"],
        )
    with pytest.raises(DataError, match=r"b_OK.txt, line 5: Expected a column FZ, got time, FX"):
        load_dataset(tmp_path / "press", channel="FZ")


def uneven(rate_hz: float, seconds: float) -> np.ndarray:
    """A known curve at another rate."""
    t = np.arange(round(seconds * rate_hz)) / rate_hz
    return np.c_[t, 20 * np.sin(3 * t) + 30 * t]


@pytest.mark.parametrize("as_long", [True, False])
def test_recordings_at_several_rates_are_resampled_by_their_own_times(
    as_long: bool, tmp_path: Path
) -> None:
    rates = [228.0, 236.0, 244.0, 250.0, 256.0, 270.0, 280.0]
    for i, rate in enumerate(rates):
        curve = uneven(rate, 2.0 if as_long else 500 / rate)
        pd.DataFrame(curve, columns=["time", "FZ"]).to_csv(tmp_path / f"{i}_OK.csv", index=False)
    refused = load_dataset(tmp_path)
    assert all("--fit resample" in line for line in left_out(refused))
    assert document("data", tmp_path, "--fit", "resample")["survey"]["traces"] == len(rates)
    data = load_dataset(tmp_path, fit="resample")
    assert (len(data), data.fit) == (len(rates), "resample" if as_long else "pad")
    t = np.arange(440) / data.rate_hz
    np.testing.assert_allclose(
        data.X[:, :440], np.tile(20 * np.sin(3 * t) + 30 * t, (len(rates), 1)), atol=0.3
    )
    assert "are put on" in data.notes[0]
    assert data.rates.tolist() == pytest.approx(rates, rel=1e-3)


def test_resampled_recordings_are_imported_once_also_when_others_are_added(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    words = (
        "train",
        "--data",
        tmp_path / "cell",
        "--fit",
        "resample",
        "--store",
        tmp_path / "a.db",
    )
    (tmp_path / "cell").mkdir()
    for first, until in ((0, 30), (30, 30), (30, 34)):
        for i in range(first, until):
            pd.DataFrame(
                uneven(rate := rng.uniform(228, 280), 500 / rate), columns=["time", "FZ"]
            ).assign(FZ=lambda frame: frame["FZ"] + rng.normal(size=len(frame))).to_csv(
                tmp_path / "cell" / f"{i}_{'NOK' if i % 2 else 'OK'}.csv", index=False
            )
        record = document(*words, *(() if first else ("--reducer", "pca")))["import"]
        assert (record["imported"], record["repeated"]) == (until - first, first)


def left_out(data: Dataset) -> list[str]:
    from dengine.cli.options import fault_lines as lines

    return lines(data, 10)[1:]


def test_a_jittered_clock_puts_the_samples_where_they_were_measured(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    steps = rng.uniform(0.5, 1.5, (3, 499)) * np.repeat(
        [1.0, 1.8, 1.0], [200, 99, 200]
    )  # slower in between
    for i, t in enumerate(np.c_[np.zeros(3), np.cumsum(steps, axis=1)]):
        t *= STEP * 499 / t[-1]
        pd.DataFrame({"time": t, "FZ": 30 * np.sin(3 * t)}).to_csv(
            tmp_path / f"{i}_OK.csv", index=False
        )
    data = load_dataset(tmp_path, fit="resample")
    t = np.arange(data.X.shape[1]) / data.rate_hz
    assert t[-1] == pytest.approx(STEP * 499, abs=STEP)
    assert np.abs(data.X - 30 * np.sin(3 * t)).max() < 0.3  # rates within 3 % are one


def test_a_column_twice_is_one_line_that_says_what_to_do(tmp_path: Path) -> None:
    for i, word in enumerate(["", "_OK"]):
        folder = tmp_path / str(i)
        for part in range(10, 14):
            write(
                folder / f"Part_{part}{word}.csv",
                ["Time", "X", "Y", "X"],
                times(),
                times(),
                texts(),
                times(),
                delimiter=";",
            )
    assert "--channel Y" in one_line("data", tmp_path / "0")
    assert "Expected a label for each recording" in one_line(
        "data", tmp_path / "0", "--channel", "Y"
    )
    assert "--channel Y" in one_line("data", tmp_path / "1")
    error = one_line("data", tmp_path / "1", "--channel", "X")
    assert "--columns Time,X_1,Y,X_2, and the channel, --channel X_1 or --channel X_2;" in error
    advised = ("--columns", "Time,X_1,Y,X_2")
    survey = document("data", tmp_path / "1", "--channel", "X_2", *advised)["survey"]
    assert survey["traces"] == 4
    assert "Expected a column X, got Time, X_1" in one_line(
        "data", tmp_path / "1", "--channel", "X", *advised
    )


def test_a_column_twice_is_read_by_the_name_that_the_error_advises(tmp_path: Path) -> None:
    """g26: the advice left the channel as it was, and the first sensor was read in silence."""
    header = ["t [s]", "Force [N]", "Force [N]"]
    write(tmp_path / "a_OK.csv", header, times(), texts(-VALUES), texts())
    columns = "t [s],Force_1 [N],Force_2 [N]"
    with pytest.raises(DataError, match=re.escape(f"columns='{columns}', and the channel")):
        load_dataset(tmp_path, channel="Force")
    data = load_dataset(tmp_path, columns=columns, channel="Force_2 [N]")
    np.testing.assert_array_equal(data.X[0], VALUES.astype(np.float32))
    with pytest.raises(DataError, match="Expected a column Force"):
        load_dataset(tmp_path, columns=columns, channel="Force")
    header = ["t [s]", "Force [N]", "Force [kN]"]
    write(tmp_path / "a_OK.csv", header, times(), texts(), texts(-VALUES))
    with pytest.raises(DataError, match=r"channel='Force \[N\]' or channel='Force \[kN\]'"):
        load_dataset(tmp_path, channel="Force")


def test_a_matrix_without_a_header_is_read_by_the_range_that_the_error_advises(
    tmp_path: Path,
) -> None:
    """g11: the advice named 500 columns, and was cut off in the middle."""
    path = tmp_path / "m.csv"
    path.write_text(
        "\n".join(",".join([*texts(VALUES + i * (-1) ** i), str(i % 2)]) for i in range(4))
    )
    with pytest.raises(DataError, match=rf"columns='c0\.\.c{N - 1},label'"):
        load_dataset(path)
    data = load_dataset(path, columns=f"c0..c{N - 1},label", rate_hz=500)
    np.testing.assert_array_equal(data.X[0], VALUES.astype(np.float32))
    assert data.y.tolist() == [0, 1, 0, 1]


def one_line(*words: object) -> str:
    """What a verb says that ends in one line of error."""
    result = dengine(*words)
    assert result.exit_code == 1
    assert isinstance(result.exception, SystemExit)
    assert len(result.stderr.strip().splitlines()) == 1
    return result.stderr


def test_short_lists_in_cells_are_one_line_that_says_what_to_do(tmp_path: Path) -> None:
    pd.DataFrame({"force": [[1.0, 2.0], [2.0, 3.0]], "label": [1, 0]}).to_parquet(
        tmp_path / "a.parquet"
    )
    assert "column force holds lists; give a trace a row" in one_line(
        "data", tmp_path / "a.parquet"
    )


def test_what_is_not_finite_is_named_by_its_file(tmp_path: Path) -> None:
    for name in ("a_OK.csv", "b_OK.csv"):
        cells = texts()
        cells[5] = "" if name == "b_OK.csv" else cells[5]
        write(tmp_path / name, ["time", "FZ"], times(), cells)
    note = "1 samples are not finite, for cells are empty or hold no number, in 1 of 2 recordings:"
    assert f"{note} b_OK.csv." in " ".join(dengine("data", tmp_path).stdout.split())
    assert f"{note} b_OK.csv." in load_dataset(tmp_path).notes


WRITERS: dict[str, Callable[[Path], object]] = {
    "excel": lambda path: write(
        path,
        ["Zeit [s]", "Kraft [kN]"],
        german(times()),
        german(texts()),
        delimiter=";",
        above=["sep=;"],
    ),
    "lvm": lambda path: write(
        path,
        ["X_Value", "Untitled", "Comment"],
        times(),
        texts(),
        delimiter="\t",
        above=["LabVIEW Measurement", "***End***"],
    ),
    "maXYmos": lambda path: write(
        path,
        ["Time", "X(ABSOLUTE)", "Y"],
        ["s", *german(times())],
        ["mm", *["40,2"] * N],
        ["N", *german(texts())],
        delimiter=";",
        above=[
            "Index;Result information;Process values;Channel-X;Channel-Y;Measuring curve",
            "Line;6;18;27;33;40",
            "Result information;\nTotal result;OK\n",
            "Process values;\nYMAX;2,6;kN\n",
            f"Measuring curve;\nNumber of measuring points;{N}\n",
        ],
    ),
    "ScopeCorder": lambda path: path.write_text(
        "\n".join(
            [
                '"Model Name",DL850E',
                '"TraceName",CH1_LOAD',
                f'"BlockSize",{N}',
                '"VUnit",N',
                '"SampleRate",2.500000E+02',
                '"HUnit",s',
                '"Time",13:08:21.4418',
                ",",
                *(f",{cell}" for cell in texts()),
            ]
        )
    ),
}


@pytest.mark.parametrize("tool", WRITERS)
def test_files_of_tools_are_read_as_they_come(tool: str, tmp_path: Path) -> None:
    WRITERS[tool](tmp_path / "a_OK.csv")
    data = load_dataset(tmp_path, channel="Y" if tool == "maXYmos" else None)
    np.testing.assert_array_equal(data.X[0], VALUES.astype(np.float32))
    assert data.rate_hz == 250.0


def test_the_page_lists_the_forms_that_are_tested() -> None:
    text = recording_forms.PAGE.read_text("utf-8")
    assert recording_forms.page(text) == text, "run python -m tests.support.recording_forms"


@pytest.mark.parametrize(
    ("line", "channels"),
    [
        ("# Force unit: kN", ["Force"]),
        ("Einheit Kraft;kN", ["Kraft"]),
        ("Unit=KN", ["pressed"]),
        ("# Position unit: mm, force unit: kN", ["Position", "Force"]),
        ("# Force unit: [kN]", ["FX", "Weg"]),
    ],
)
def test_a_unit_above_the_header_is_that_of_its_channel(
    line: str, channels: list[str], tmp_path: Path
) -> None:
    force = next(name for name in ("Force", "Kraft", "FX", "pressed") if name in channels)
    for i in range(6):
        is_kn = i in (2, 4)
        values = VALUES / 1000 if is_kn else VALUES
        cells = [texts(values, "{:.4f}") if name == force else texts() for name in channels]
        above = ["# Press 4", line if is_kn else line.replace("kN", "N").replace("KN", "N")]
        write(tmp_path / f"{i}_OK.csv", ["Time [s]", *channels], times(), *cells, above=above)
    data = load_dataset(tmp_path, channel=force)
    np.testing.assert_allclose(data.X, np.tile(VALUES, (6, 1)), rtol=1e-4, atol=1e-3)
    assert data.unit == "N"
    assert f"{force} is converted from kN to N, times 1000 (2 times)." in data.notes


@pytest.mark.parametrize("form", ["lost rows", "two steps"])
def test_a_rate_that_does_not_last_as_long_as_the_clock_is_no_rate(
    form: str, tmp_path: Path
) -> None:
    kept = np.random.default_rng(0).permutation(1000)[:900] if form == "lost rows" else None
    for i in range(3):
        t = np.sort(kept) * STEP if kept is not None else np.r_[:300:4, 300:800] * STEP
        frame = pd.DataFrame({"time": t, "FZ": 20 * np.sin(3 * t)})
        frame.to_csv(tmp_path / f"{i}_OK.csv", index=False)
    refused = dengine("data", tmp_path)
    assert re.search(
        r"Expected \d+ rows at 250 Hz from the first time .*--fit resample", refused.stderr
    )
    data = load_dataset(tmp_path, fit="resample")
    assert data.rate_hz == 250.0
    times_read = t[0] + np.arange(data.X.shape[1]) / 250.0
    assert times_read[-1] == pytest.approx(t[-1])
    assert np.abs(data.X - 20 * np.sin(3 * times_read)).max() < 0.05


def test_a_few_lost_rows_are_noted_and_swapped_rows_are_put_in_order(tmp_path: Path) -> None:
    t = np.delete(np.arange(300), [50, 120, 200]) * STEP
    order = np.r_[:7, 8, 7, 9 : len(t)]
    pd.DataFrame({"time": t, "FZ": np.sin(t)}).iloc[order].to_csv(tmp_path / "a_OK.csv")
    for stated in ({}, {"rate_hz": 250.0}):
        data = load_dataset(tmp_path, channel="FZ", **stated)
        np.testing.assert_allclose(data.X[0], np.sin(t), atol=1e-6)
        assert "Rows are put in the order of their times." in data.notes
    assert "later samples stand too early" in load_dataset(tmp_path, channel="FZ").notes[1]


@pytest.mark.parametrize("odd", ["Init", "(2.87)", "Max"])
def test_words_in_the_first_rows_are_no_header(odd: str, tmp_path: Path) -> None:
    cells = [odd] * 30 + texts()[30:]
    write(tmp_path / "a_OK.csv", ["time", "FZ"], times(), cells)
    write(tmp_path / "b_OK.csv", ["time", "FZ"], times(), texts(), above=["Presse;3"])
    data = load_dataset(tmp_path)
    assert (data.channels, [f.source for f in data.faults]) == (("FZ",), ["a_OK.csv"])
    assert f"Expected a number in column FZ, got '{odd}'" in data.faults[0].message
    assert data.faults[0].line == 2


def test_a_summary_below_samples_without_a_clock_is_no_sample(tmp_path: Path) -> None:
    numbers = [str(i) for i in range(N)]
    write(tmp_path / "a_OK.csv", ["Nr", "F"], [*numbers, "Max", "Min"], [*texts(), "9.9", "1.1"])
    data = load_dataset(tmp_path, channel="F")
    np.testing.assert_array_equal(data.X[0], VALUES.astype(np.float32))
    assert "The last 2 rows have no number in column Nr" in data.notes[0]


@pytest.mark.parametrize(
    "above",
    [
        ["X-Unit;mm", "Y-Unit;kN"],
        ["# Units: ms, mm, kN"],
        ["Einheit Y: kN"],
        ["Channels\t2\t\t", "Y_Unit_Label\tmm\tkN\t"],
        ["Units: mm, kN"],
    ],
)
def test_units_above_the_header_are_those_of_the_columns_they_name(
    above: list[str], tmp_path: Path
) -> None:
    for i in range(3):
        lines = above if i else [line.replace("kN", "N") for line in above]
        cells = [times(), texts(), texts(VALUES / 1000 if i else VALUES, "{:.4f}")]
        write(tmp_path / f"{i}_OK.csv", ["Time [ms]", "X", "Y"], *cells, above=lines)
    data = load_dataset(tmp_path, channel="Y", rate_hz=250, unit="N")
    np.testing.assert_allclose(data.X, np.tile(VALUES, (3, 1)), rtol=1e-3, atol=0.06)


def test_units_in_cells_are_read_and_converted(tmp_path: Path) -> None:
    cells = [f"{v / 1000:.4f} kN" if abs(v) >= 1000 else f"{v:.1f} N" for v in VALUES]
    write(tmp_path / "a_OK.csv", ["time", "FZ"], times(), cells)
    write(tmp_path / "b_OK.csv", ["time", "FZ"], times(), [f"{v / 1000:.4f} kN" for v in VALUES])
    write(tmp_path / "c_OK.csv", ["time", "FZ"], times(), [f"{v:.1f} N" for v in VALUES])
    data = load_dataset(tmp_path)
    np.testing.assert_allclose(data.X, np.tile(VALUES, (3, 1)), rtol=1e-5)
    assert data.unit == "N"
    assert "in the cells of FZ" in data.reading["numbers"]
    for odd in ("5 parsecs", "5N"):
        write(tmp_path / "c_OK.csv", ["time", "FZ"], times(), [odd] * N)
        [fault] = load_dataset(tmp_path).faults
        assert f"got '{odd}'; export plain numbers, without units" in fault.message


def test_lists_in_cells_of_a_text_file_are_named(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text('"",force,label\n0,"[1.5, 2.0, 3.1]",OK\n1,"[1.0, 2.0, 3.0]",NOK\n')
    with pytest.raises(DataError, match="column force holds lists; give a trace a row"):
        load_dataset(path, channel="force", label="label")


def test_a_column_without_a_name_is_not_listed(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text(",heat,force,label\n0,500,1.5,OK\n1,500,2.0,NOK\n")
    with pytest.raises(DataError, match="found heat, force"):
        load_dataset(path)
    path.write_text(",heat,F_0,F_1,label\n7,500,1.5,1.5,OK\n8,500,2.0,1.5,NOK\n")
    assert "Not read: the columns heat." in load_dataset(path).notes


def test_a_date_a_time_and_milliseconds_are_one_clock(tmp_path: Path) -> None:
    clock = [4 * i + 990 for i in range(N)]
    seconds = [f"06:00:{ms // 1000:02d}" for ms in clock]
    header = ["Date", "Time", "Millitm", "F"]
    write(
        tmp_path / "a_OK.csv",
        header,
        ["03/01/2026"] * N,
        seconds,
        [str(ms % 1000) for ms in clock],
        texts(),
    )
    for stated in ({}, {"time": "Millitm"}):
        data = load_dataset(tmp_path, channel="F", **stated)
        np.testing.assert_array_equal(data.X[0], VALUES.astype(np.float32))
        assert data.rate_hz == 250.0


def test_lines_above_samples_without_a_header_are_counted(tmp_path: Path) -> None:
    write(tmp_path / "a_OK.csv", ["0.0", "1.0"], times()[1:], texts()[1:], above=["ready, tare"])
    data = load_dataset(tmp_path, columns="time,F")
    assert data.X.shape[-1] == N
    assert data.reading["rows"] == "1 left out"
    with pytest.raises(DataError, match=r"Expected 1 columns, got 2: 0\.0, 1\.0"):
        load_dataset(tmp_path, columns="F", channel="F")


def test_nan_behind_the_last_number_ends_a_trace_of_an_archive(tmp_path: Path) -> None:
    X = np.arange(6)[:, None] + VALUES
    X[0, 100:] = np.nan
    X[1, 20:] = np.nan
    np.savez(tmp_path / "a.npz", X=X, y=[1, 0, 1, 0, 1, 1], dt=0.004, part=np.arange(6) + 10)
    data = load_dataset(tmp_path / "a.npz")
    assert data.rate_hz == 250.0
    assert np.isfinite(data.X).all()
    assert (data.lengths.tolist(), data.y.tolist()) == ([100, N, N, N, N], [1, 1, 0, 1, 1])
    assert [fault.source for fault in data.faults] == ["trace 2"]
    assert data.part.tolist() == ["10", "12", "13", "14", "15"]
    assert "2 of 6 traces end before their row, by NaN or an array of lengths." in data.notes
    assert load_dataset(tmp_path / "a.npz", samples=90).X.shape == (5, 90)


@pytest.mark.parametrize("form", ["coarse", "equal", "fine"])
def test_a_clock_too_coarse_to_show_lost_rows_is_said_to_be(form: str, tmp_path: Path) -> None:
    cells = {
        "coarse": [f"06:00:{i // 50:02d}" for i in range(N)],
        "equal": ["1.7723e9"] * N,
        "empty": [""] * N,
        "fine": times(),
    }[form]
    write(tmp_path / "a_OK.csv", ["time", "FZ"], cells, texts())
    data = load_dataset(tmp_path, rate_hz=250 if form == "fine" else 50)
    coarse = "column time is too coarse to show lost rows"
    shows = "lost rows would be seen in column time" if form == "fine" else coarse
    assert shows in data.reading["clock"]
    assert not any("contradicts" in note for note in data.notes)


def test_a_stated_rate_that_a_coarse_clock_contradicts_is_noted(tmp_path: Path) -> None:
    cells = [f"06:00:{i // 20:02d}" for i in range(N)]
    write(tmp_path / "a_OK.csv", ["time", "FZ"], cells, texts())
    note = "Column time contradicts the stated rate of 500 Hz: check it."
    assert note in load_dataset(tmp_path, rate_hz=500).notes
    assert note not in load_dataset(tmp_path, rate_hz=20).notes


def test_a_clock_that_is_wrong_is_left_out_by_name(tmp_path: Path) -> None:
    wrong = [f"{i * STEP % 0.1:.3f}" for i in range(N)]
    write(tmp_path / "a_OK.csv", ["time", "FZ"], wrong, texts())
    refused = dengine("data", tmp_path, "--rate-hz", "250")
    assert "--time none with a stated rate (--rate-hz) leaves them as they are" in refused.stderr
    data = load_dataset(tmp_path, rate_hz=250.0, time="none")
    np.testing.assert_array_equal(data.X[0], VALUES.astype(np.float32))


def test_a_channel_is_read_by_the_clock_to_its_left(tmp_path: Path) -> None:
    slow = [*times(30, 4 * STEP), *[""] * (N - 30)]
    way = [*texts(np.arange(30.0)), *[""] * (N - 30)]
    header = ["Time", "Way", "Time", "Force"]
    write(tmp_path / "a_OK.csv", header, slow, way, times(), texts(), delimiter=";")
    force = load_dataset(tmp_path, channel="Force")
    np.testing.assert_array_equal(force.X[0], VALUES.astype(np.float32))
    assert force.rate_hz == 250.0
    data = load_dataset(tmp_path, channel="Way")
    assert (data.X.tolist(), data.rate_hz) == ([list(range(30))], 62.5)
    with pytest.raises(DataError, match="Expected channels beside one clock"):
        load_dataset(tmp_path, channel="Way,Force")


def test_what_labview_writes_above_its_last_header_is_left_out(tmp_path: Path) -> None:
    above = ["LabVIEW Measurement\t", "Separator\tTab", "***End_of_Header***\t", "Delta_X\t0,004"]
    lines = [*above, "***End_of_Header***\t\t", "X_Value\tForce\tComment"]
    cells = german(texts())
    lines += [f"\t{cells[0]}\tlot 12", *(f"\t{cell}" for cell in cells[1:])]
    (tmp_path / "a_OK.txt").write_text("\n".join(lines))
    data = load_dataset(tmp_path, rate_hz=250)
    np.testing.assert_array_equal(data.X[0], VALUES.astype(np.float32))
    assert data.channels == ("Force",)


def test_dates_with_slashes_are_read_so_that_they_do_not_go_back(tmp_path: Path) -> None:
    rows = [
        f"{part},{date} 06:00:00.{4 * i:03d},{value},OK"
        for part, date in ((1, "12/2/2026"), (2, "1/3/2026"))
        for i, value in enumerate(texts(VALUES))
    ]
    path = tmp_path / "a.csv"
    path.write_text("\n".join(["part,time,FZ,label", *rows]))
    data = load_dataset(path, time="time")
    assert data.source.tolist() == ["1", "2"]
    assert data.reading["order"] == "by the dates of their clocks"
    path.write_text(path.read_text().replace("12/2/", "12/13/").replace("1/3/", "11/3/"))
    assert load_dataset(path, time="time").source.tolist() == ["2", "1"]


def test_a_row_of_groups_above_the_header_is_none(tmp_path: Path) -> None:
    above = [";Sensor A;Sensor A;Sensor B", "t [ms];Fx;Fz;Fx"]
    cells = (times(), texts(-VALUES), texts(-VALUES), texts())
    write(tmp_path / "a_OK.csv", ["", "N", "N", "N"], *cells, delimiter=";", above=above)
    assert "Sensor A Fx, Fz, Sensor B Fx" in one_line("data", tmp_path, "--channel", "Fx")
    for columns, channel in ((None, "Sensor B Fx"), ("t,AFx,AFz,BFx", "BFx")):
        data = load_dataset(tmp_path, columns=columns, channel=channel, time="none")
        np.testing.assert_array_equal(data.X[0], VALUES.astype(np.float32))


def test_the_samples_of_a_wide_table_may_be_named_by_their_times(tmp_path: Path) -> None:
    header = ["Serial", "Result", *german(times())]
    rows = [[f"S{i}", "OK" if i % 2 else "NOK", *german(texts(VALUES + i))] for i in range(4)]
    (tmp_path / "w.csv").write_text("\n".join(";".join(row) for row in [header, *rows]))
    data = load_dataset(tmp_path / "w.csv", part="Serial")
    np.testing.assert_allclose(data.X, np.arange(4)[:, None] + VALUES, rtol=1e-6)
    assert (data.y.tolist(), data.rate_hz) == ([0, 1, 0, 1], None)


def test_files_of_other_columns_are_told_how_to_name_their_label(tmp_path: Path) -> None:
    for i in range(6):
        unit, scale = ("N", 1) if i % 2 else ("kN", 1000)
        steps = [str(8 * j // N) for j in range(N)]
        columns = (times(), steps, texts(VALUES / scale, "{:.4f}"), [str(i % 2 + 1)] * N)
        header = ["Time [s]", "Step", f"M [{unit}]", "Status"]
        write(tmp_path / f"screw{i}.csv", header, *columns)
    assert "name its label's column: --label Status" in one_line("data", tmp_path)
    words = {"label": "Status", "label_map": "1=good,2=bad"}
    data = load_dataset(tmp_path, channel="M", unit="N", **words)
    np.testing.assert_allclose(data.X, np.tile(VALUES, (6, 1)), rtol=1e-3, atol=0.06)


@pytest.mark.parametrize("column", ["N° série", "serial", "file"])
def test_serial_numbers_without_leading_zeros_name_recordings(column: str, tmp_path: Path) -> None:
    for i in range(95, 107):
        write(tmp_path / "data" / f"P_{i:06d}.csv", ["time", "FZ"], times(), texts(VALUES + i))
    rows = [f"{i},{'OK' if i % 2 else 'NOK'},{i % 2 + 1}" for i in range(95, 107)]
    listing = tmp_path / "list.csv"
    listing.write_text("\n".join([f"{column},Result,operator", *rows]))
    data = load_dataset(tmp_path / "data", labels=listing)
    assert data.y.tolist() == [i % 2 for i in range(95, 107)]
    assert "list.csv names 95, read as p_000095, without zeros (12 times)." in data.notes
    listing.write_text("\n".join([f"{column},Result", *(f"X{row}" for row in rows)]))
    with pytest.raises(DataError) as error:
        load_dataset(tmp_path / "data", labels=listing)
    assert ("call its columns" in str(error.value)) == (column != "file")


def test_a_list_whose_numbers_a_spreadsheet_has_shortened_is_told_so_at_once(
    tmp_path: Path,
) -> None:
    barcodes = [f"2403110{i:05d}" for i in range(12)]
    for i, barcode in enumerate(barcodes):
        write(tmp_path / "data" / f"{barcode}.csv", ["time", "FZ"], times(), texts(VALUES + i))
    listing = tmp_path / "list.csv"
    rows = [
        f"{barcode};11.03.2024;{'OK' if i % 3 else 'NOK'}" for i, barcode in enumerate(barcodes)
    ]
    for asked in ([], ["--label", "Ergebnis"], ["--label", "Ergebnis", "--part", "Barcode"]):
        command = ("data", tmp_path / "data", "--labels", listing, *asked)
        for number in ("2,40311E+11", "2.4E+11"):
            short = [row.replace(barcodes[i], number) for i, row in enumerate(rows)]
            listing.write_text("\n".join(["Barcode;Datum;Ergebnis", *short]))
            message = one_line(*command)
            assert f"column Barcode of {listing}, got {number}: a spreadsheet" in message
            assert "export the list anew" in message
        listing.write_text("\n".join(["Barcode;Datum;Ergebnis", *rows]))
        options = {"label": "Ergebnis"} if asked else {}
        data = load_dataset(tmp_path / "data", labels=listing, **options)
        assert data.y.tolist() == [int(i % 3 > 0) for i in range(12)]
    listing.write_text("\n".join(["Barcode;Datum;Ergebnis", *rows[1:], "2,4E+11;11.03.2024;NOK"]))
    data = load_dataset(tmp_path / "data", labels=listing)
    assert any("a number that a spreadsheet has shortened" in str(x) for x in data.faults)


@pytest.mark.parametrize("line", ["Datum;02.03.2026", "Result;OK", "Table 1;"])
def test_one_line_above_a_header_with_units_is_no_header(line: str, tmp_path: Path) -> None:
    cells = [times(form="{:.3f}"), texts(VALUES / 1000, "{:.4f}")]
    write(tmp_path / "a_OK.csv", ["Zeit [s]", "Kraft [kN]"], *cells, delimiter=";", above=[line])
    data = load_dataset(tmp_path, channel="Kraft")
    np.testing.assert_allclose(data.X[0], VALUES / 1000, atol=1e-4)
    assert (data.unit, data.rate_hz) == ("kN", 250.0)


def test_columns_of_one_name_are_named_apart_with_their_unit(tmp_path: Path) -> None:
    write(tmp_path / "a_OK.csv", ["Time [s]", "F [kN]", "F [kN]"], times(), texts(), texts(-VALUES))
    with pytest.raises(DataError) as error:
        load_dataset(tmp_path, channel="F [kN]")
    columns = re.search(r"columns='(.*?)'", str(error.value))[1]
    assert columns == "Time [s],F_1 [kN],F_2 [kN]"
    data = load_dataset(tmp_path, channel="F_2", columns=columns)
    np.testing.assert_array_equal(data.X[0], -VALUES.astype(np.float32))
    assert data.unit == "kN"


def test_a_serial_number_of_two_recordings_leaves_the_others_their_labels(tmp_path: Path) -> None:
    for i, name in enumerate(("A10", "A11", "A12", "A13_1", "A13_2")):
        write(tmp_path / "data" / f"{name}_x.csv", ["time", "FZ"], times(), texts(VALUES + i))
    listing = tmp_path / "list.csv"
    rows = ["A10,1,OK", "A11,2,NOK", "A12,3,OK", "A13,4,NOK", "A13,5,OK"]
    listing.write_text("\n".join(["Seriennummer,Nr,Ergebnis", *rows]))
    data = load_dataset(tmp_path / "data", labels=listing, label="Ergebnis")
    assert data.y.tolist() == [1, 0, 1]
    assert {f.source for f in data.faults} == {"A13_1_x.csv", "A13_2_x.csv", "list.csv"}


def test_settings_beside_samples_without_a_header_ask_for_names(tmp_path: Path) -> None:
    settings = ["Record Length", "Interval", "Trigger", *[""] * (N - 3)]
    lines = [f"{a},,{t},{x}," for a, t, x in zip(settings, times(), texts(), strict=True)]
    (tmp_path / "a_OK.csv").write_text("\n".join([lines[0].replace(",,", ",5e2,"), *lines[1:]]))
    with pytest.raises(
        DataError, match=r"its first line is of numbers; .* columns='c0,c1,c2,c3,c4'"
    ):
        load_dataset(tmp_path, channel="c3")


def blocks(head: Sequence[str], *starts: int, n: int = 40, form: str = "{t}\t{x}") -> str:
    """A text of blocks of n rows whose times begin at sample 0, 40, ...; each has a head."""
    lines = []
    for i, start in enumerate(starts):
        lines += [line.format(number=i + 1, start=STEP * start) for line in head]
        rows = zip(times(N)[start:], texts()[n * i : n * (i + 1)], strict=False)
        lines += [form.format(t=t, x=x) for t, x in rows]
    return "\n".join([*lines, ""])


LABVIEW = ["LabVIEW Measurement\t", "Date\t2024/05/13", "***End_of_Header***\t", ""]
SEGMENT = [
    *("", "Channels\t1\t", "Samples\t40\t", "Date\t2024/05/13\t", "X0\t{start:.3E}\t"),
    *("Delta_X\t0.004\t", "***End_of_Header***\t\t", "X_Value\tForce\tComment"),
]


@pytest.mark.parametrize(
    ("above", "head", "form"),
    [
        (LABVIEW, SEGMENT, "{t}\t{x}"),
        (LABVIEW, SEGMENT, "\t{x}"),
        ([], ["# Segment {number}", "Operator;Me", "fs;250", "", "t;Force", "s;N"], "{t};{x}"),
        ([], ["time,Force"], "{t},{x}"),
    ],
)
def test_blocks_under_the_same_header_are_joined_with_a_note(
    above: list[str], head: list[str], form: str, tmp_path: Path
) -> None:
    text = "\n".join(above) + blocks(head, 0, 40, 80, form=form)
    (tmp_path / "a_OK.lvm").write_text(text)
    data = load_dataset(tmp_path, channel="Force")
    np.testing.assert_array_equal(data.X[0], VALUES.astype(np.float32))
    assert data.rate_hz == 250.0
    note = "The file has 3 blocks of 40 rows, each under the same header: they are joined"
    assert note in data.notes[0]
    (tmp_path / "a_OK.lvm").write_text("\n".join(text.splitlines()[:-37]))
    data = load_dataset(tmp_path, channel="Force")
    assert data.X.shape == (1, 83)
    assert "3 blocks of up to 40 rows" in data.notes[0]


def test_lines_left_out_of_blocks_with_stated_columns_are_all_counted(tmp_path: Path) -> None:
    (tmp_path / "a_OK.lvm").write_text("\n".join(LABVIEW) + blocks(SEGMENT, 0, 40, 80))
    for columns in ("t,F", "t,F,Comment"):
        data = load_dataset(tmp_path, columns=columns, time="t", channel="F")
        np.testing.assert_array_equal(data.X[0], VALUES.astype(np.float32))
        assert data.reading["rows"] == "24 left out"  # 3 of the file, 3 times 7 of a segment


@pytest.mark.parametrize("form", ["{t}\t{x}", "\t{x}"])
def test_blocks_whose_clock_starts_again_are_refused_with_their_number(
    form: str, tmp_path: Path
) -> None:
    text = "\n".join(LABVIEW) + blocks(SEGMENT, 0, 0, 0, form=form)
    (tmp_path / "a_OK.lvm").write_text(text)
    wanted = r"got 3 blocks of 40 rows, .* times overlap; .* last one is usually the final measure"
    with pytest.raises(DataError, match=wanted) as caught:
        load_dataset(tmp_path, channel="Force")
    assert "none" not in str(caught.value).partition("line 12")[2]
    data = load_dataset(tmp_path, channel="Force", time="none", rate_hz=250)
    np.testing.assert_array_equal(data.X[0], VALUES.astype(np.float32))


@pytest.mark.parametrize("fit", [None, "pad", "pad-all"])
def test_a_recording_that_is_cut_much_to_the_length_of_the_others_is_named(
    fit: str | None, tmp_path: Path
) -> None:
    for i in range(6):
        write(tmp_path / f"{i}_OK.csv", ["time", "FZ"], times(), texts(VALUES + i))
    write(tmp_path / "6_OK.csv", ["time", "FZ"], times(2 * N), texts([*VALUES, *VALUES]))
    write(tmp_path / "7_OK.csv", ["time", "FZ"], times(N + 10), texts([*VALUES, *VALUES[:10]]))
    data = load_dataset(tmp_path, fit=fit)
    note = f"Of more samples only the first {N} are read: 6_OK.csv ({2 * N})."
    assert (len(data), note in data.notes) == (8, True)


def test_a_pause_between_blocks_is_refused_with_their_number(tmp_path: Path) -> None:
    (tmp_path / "a_OK.csv").write_text(blocks(["time,FZ"], 0, 70, form="{t},{x}"))
    with pytest.raises(DataError, match=r"got a gap of 0\.124 s; it has 2 blocks of 40 rows"):
        load_dataset(tmp_path)


@pytest.mark.parametrize("time", [None, "none"])
def test_blocks_of_different_columns_are_refused(time: str | None, tmp_path: Path) -> None:
    first = blocks(SEGMENT, 0)
    (tmp_path / "a_OK.lvm").write_text("\n".join(LABVIEW) + first + first.replace("Force", "Way"))
    wanted = "got 2 blocks: line 11 has X_Value, Force, Comment, this one X_Value, Way, Comment"
    with pytest.raises(DataError, match=wanted):
        load_dataset(tmp_path, channel="Force", time=time)
    other = blocks(["time,Way"], 40, form="{t},{x}")
    (tmp_path / "a_OK.lvm").write_text(blocks(["time,FZ"], 0, form="{t},{x}") + other)
    with pytest.raises(DataError, match="Expected one header, got another: time, Way"):
        load_dataset(tmp_path, time=time)


def test_a_table_above_that_of_more_columns_is_noted(tmp_path: Path) -> None:
    text = blocks(["time,FZ"], 0, form="{t},{x}") + blocks(
        ["time,FZ,a,b,c"], 40, form="{t},{x},1,2,3"
    )
    (tmp_path / "a_OK.csv").write_text(text)
    note = "Not read: 40 rows of another table, which has the columns time, FZ."
    assert note in load_dataset(tmp_path, channel="FZ").notes


@pytest.mark.parametrize(
    "mark",
    [
        *("//END", "//END                 ", "//END,,", "END", "[END]", "<END>", "#EOF", "Ende"),
        *("*** END OF DATA ***", "End of file", "-- end of records --", "EndOfFile", "Data end"),
    ],
)
def test_rows_below_a_mark_of_the_end_are_left_out_with_a_note(mark: str, tmp_path: Path) -> None:
    rows = [f"{t},{x},1" for t, x in zip(times(), texts(), strict=True)]
    stale = [f"{t},400.0,1" for t in times(50)]
    lines = ["time,FZ,pos", *rows, mark, *stale, "Result,OK", ""]
    for i in range(2):
        lines[1] = f"0.000,{VALUES[0] + i},1"
        (tmp_path / f"{i}.csv").write_text("\n".join(lines).replace("OK", "NOK" if i else "OK"))
    data = load_dataset(tmp_path, channel="FZ")
    np.testing.assert_array_equal(data.X[0], VALUES.astype(np.float32))
    assert data.y.tolist() == [1, 0]
    assert data.reading["rows"] == "52 left out"
    note = "Rows below a line that marks the end, as //END, are left out (2 times)."
    assert note in data.notes


def test_blocks_that_each_end_in_a_mark_of_the_end_are_joined(tmp_path: Path) -> None:
    text = blocks(["//END", "time,FZ"], 0, 40, 80, form="{t},{x}").removeprefix("//END\n")
    (tmp_path / "a_OK.csv").write_text(f"{text}//END\n")
    data = load_dataset(tmp_path)
    np.testing.assert_array_equal(data.X[0], VALUES.astype(np.float32))
    assert "3 blocks of 40 rows" in data.notes[0]


@pytest.mark.parametrize("source", ["Source,CH1", ","])
def test_the_settings_of_an_oscilloscope_beside_its_samples_are_fields(
    source: str, tmp_path: Path
) -> None:
    settings = ["Record Length,1.2e+02", "Sample Interval,4.0e-03", ",", source]
    settings += ["Vertical Units,V", "Horizontal Units,s", "Operator,Me"]
    settings += [","] * (N - len(settings))
    seconds = times(form="{:.12f}")
    for i in range(4):
        rows = zip(settings, seconds, texts(VALUES + i), strict=True)
        path = tmp_path / "scope" / f"ALL000{i}" / f"F000{i}CH1.CSV"
        path.parent.mkdir(parents=True)
        path.write_text("".join(f"{setting},,{t}, {x},\n" for setting, t, x in rows))
    listing = tmp_path / "verdicts.csv"
    listing.write_text("folder;verdict\nALL0000;bad\nall0001/;good\nALL0002;bad\nALL0003;good\n")
    name = "CH1" if "CH1" in source else "Value"
    for channel in (None, name):
        data = load_dataset(tmp_path / "scope", labels=listing, channel=channel)
        np.testing.assert_array_equal(data.X[0], VALUES.astype(np.float32))
        assert (data.channels, data.unit, data.rate_hz) == ((name,), "V", 250.0)
        assert data.y.tolist() == [0, 1, 0, 1]
    words = {"label": "Operator", "label_map": "Me=good"}
    assert load_dataset(tmp_path / "scope", channel=name, **words).y.tolist() == [1] * 4


def test_a_listing_of_folders_that_hold_several_recordings_is_refused(tmp_path: Path) -> None:
    for i in range(4):
        write(tmp_path / "data" / f"P{i // 2}" / f"{i}x.csv", ["time", "FZ"], times(), texts())
    listing = tmp_path / "verdicts.csv"
    listing.write_text("folder;verdict\nP0;bad\nP1;good\n")
    with pytest.raises(DataError, match=r"verdicts\.csv names P0, P1"):
        load_dataset(tmp_path / "data", labels=listing)


def test_files_of_other_channels_beside_those_of_the_stated_one_are_not_read(
    tmp_path: Path,
) -> None:
    for i, channel in itertools.product(range(4), ("CH1", "CH2")):
        values = VALUES + i if channel == "CH1" else -VALUES
        path = tmp_path / "data" / f"ALL{i}" / f"F{i}{channel}.CSV"
        write(path, ["time", channel], times(), texts(values))
    listing = tmp_path / "verdicts.csv"
    listing.write_text("folder;verdict\nALL0;bad\nALL1;good\nALL2;bad\nALL3;good\n")
    data = load_dataset(tmp_path / "data", labels=listing, channel="CH1")
    np.testing.assert_array_equal(data.X[3], (VALUES + 3).astype(np.float32))
    assert data.y.tolist() == [0, 1, 0, 1]
    assert not data.faults
    assert any("Not read, for they have other channels: ALL0/F0CH2.CSV" in n for n in data.notes)
    with pytest.raises(DataError, match="channel to be named, as in channel='CH1'"):
        load_dataset(tmp_path / "data", labels=listing)


def test_a_listing_of_folders_in_the_folder_is_offered(tmp_path: Path) -> None:
    for i in range(4):
        write(tmp_path / f"P{i}" / "curve.dat", ["time", "FZ"], times(), texts(VALUES + i))
    rows = [f"P{i};{('bad', 'good')[i % 2]}" for i in range(4)]
    (tmp_path / "verdicts.csv").write_text("\n".join(["folder;verdict", *rows]))
    assert "verdicts.csv names files: give it, --labels" in one_line("data", tmp_path)


def test_a_word_among_the_values_of_a_signal_is_a_lost_sample(tmp_path: Path) -> None:
    for name, last in (("a_OK", "I/O Timeout"), ("b_OK", "1.0")):
        columns = [["F"] * N, times(), [*texts()[:-1], last], ["Good"] * N]
        write(tmp_path / f"{name}.csv", ["Tag", "Timestamp", "Value", "Status"], *columns)
    data = load_dataset(tmp_path, channel="F")
    assert np.flatnonzero(np.isnan(data.X)).tolist() == [N - 1]
    assert "'I/O Timeout': they are NaN" in data.notes[0]


@pytest.mark.parametrize(
    "line",
    ["Datum;02.03.2026", "Ergebnis;IO", "Zeit;06:11:00", "Bauteil;Stecker 4711", "Table 1;;"],
)
def test_one_line_above_the_header_is_a_field(line: str, tmp_path: Path) -> None:
    """g29, g31, g32: `Datum;02.03.2026` was taken as the header, in silence."""
    header = ["Zeit [ms]", "Kraft [kN]"]
    counts = [str(2 * i) for i in range(N)]
    write(tmp_path / "a_OK.csv", header, counts, german(texts()), delimiter=";", above=[line])
    data = load_dataset(tmp_path, label="_(OK|NOK)")
    assert (data.channels, data.unit, data.rate_hz) == (("Kraft [kN]",), "kN", 500.0)
    np.testing.assert_array_equal(data.X[0], VALUES.astype(np.float32))


@pytest.mark.parametrize(
    ("dates", "order", "expected"),
    [
        (["3/2/2026", "2/3/2026", "9/2/2026"], "day first", "132"),  # 3 weeks, not 7 months
        (["2/3/2026", "3/2/2026", "2/9/2026"], "month first", "132"),
        (["3/2/2026"] * 3, "day or month first", "123"),
    ],
)
def test_all_rows_tell_whether_the_day_is_first(
    dates: list[str], order: str, expected: str, tmp_path: Path
) -> None:
    """g22, g34: 12/02/2026 was read month first, also where that made days months."""
    rows = [
        f"{part},{date} 06:{part:02d}:00.{4 * i:03d},{value},OK"
        for part, date in enumerate(dates, start=1)
        for i, value in enumerate(texts())
    ]
    (tmp_path / "a.csv").write_text("\n".join(["part,time,FZ,label", *rows]))
    data = load_dataset(tmp_path / "a.csv", time="time")
    assert data.reading["clock"] == f"column time (dates, {order})"
    assert "".join(data.source) == expected
    assert any("read month first" in note for note in data.notes) == (order[:6] == "day or")


@pytest.mark.parametrize(
    ("encoding", "channel", "word"),
    [("cp1250", "Siła", "Zły"), ("gb18030", "压力", "不合格"), ("cp932", "荷重", "不良")],
)
def test_a_name_that_another_encoding_has_proposes_it(
    encoding: str, channel: str, word: str, tmp_path: Path
) -> None:
    """g16, g27: `Siła` was no column, for Windows-1252 makes it `Si³a`."""
    for i in range(4):
        cells = ["0.0", "1.5", word if i % 2 else "OK"], ["0.1", "2.5", word if i % 2 else "OK"]
        rows = [["time", channel, "Result"], *cells]
        (tmp_path / f"p_{i}.csv").write_bytes("\n".join(map(",".join, rows)).encode(encoding))
    label_map = {word: "bad"}
    for options in ({"channel": channel}, {"label_map": label_map}):
        with pytest.raises(DataError, match=f"encoding='{encoding}'"):
            load_dataset(tmp_path, **options)
    data = load_dataset(tmp_path, channel=channel, label_map=label_map, encoding=encoding)
    assert data.y.tolist() == [1, 0, 1, 0]


def test_an_error_of_the_encoding_says_which_label_words_in_names_are_unknown(
    tmp_path: Path,
) -> None:
    """g27: the label map was asked for only after the encoding was stated."""
    for i in range(8):
        folder = tmp_path / ("不正常" if i % 2 else "正常")
        folder.mkdir(exist_ok=True)
        rows = [["时间(ms)", "压力(N)"], ["0", "1.5"], ["2", "2.5"]]
        (folder / f"压装{i}.csv").write_bytes("\n".join(map(",".join, rows)).encode("gb18030"))
    with pytest.raises(DataError, match=r"encoding='gb18030'.*label_map='.*不正常=bad"):
        load_dataset(tmp_path, channel="压力")


def test_excels_lock_of_an_open_file_is_no_recording(tmp_path: Path) -> None:
    """g17: ~$a_OK.csv was a recording that cannot be read, in letters that nobody wrote."""
    write(tmp_path / "a_OK.csv", ["t [s]", "FZ"], times(), texts())
    (tmp_path / "~$a_OK.csv").write_bytes(b"\x06Meier" + b" " * 49 + "Meier".encode("utf-16-le"))
    data = load_dataset(tmp_path)
    assert (len(data.X), data.faults) == (1, ())


def test_rows_that_leave_out_their_last_empty_columns_are_padded(tmp_path: Path) -> None:
    """g09: Rigol writes start and increment into its first row alone."""
    rows = [f"{i},{value}," for i, value in enumerate(texts())]
    lines = ["X,CH1,Start,Increment", "Sequence,Volt,-2.0e-01,2.0e-03", *rows]
    (tmp_path / "a_OK.csv").write_text("\n".join(lines))
    data = load_dataset(tmp_path, channel="CH1", rate_hz=500)
    np.testing.assert_array_equal(data.X[0], VALUES.astype(np.float32))


def test_what_a_database_writes_below_a_table_is_no_recording(tmp_path: Path) -> None:
    """g14: `(9000 rows affected)` was counted as a recording that is left out."""
    rows = [
        f"{part},{0.01 * i:.2f},{value},OK" for part in (1, 2) for i, value in enumerate(texts())
    ]
    path = tmp_path / "a.csv"
    path.write_text("\n".join(["part,time,FZ,label", *rows, "(9000 rows affected)"]))
    data = load_dataset(path, time="time")
    assert (len(data.X), data.faults) == (2, ())


def test_blank_rows_of_a_list_are_no_recordings(tmp_path: Path) -> None:
    """g24: `;;` above the sums of a list was called a recording without a name."""
    for i in range(4):
        write(tmp_path / "d" / f"p_{i}.csv", ["t [s]", "FZ"], times(), texts(VALUES + i))
    listing = tmp_path / "list.csv"
    rows = [f"p_{i}.csv;{'OK' if i % 2 else 'NOK'};" for i in range(4)]
    listing.write_text("\n".join(["file;label;remark", *rows, ";;", ";;"]))
    data = load_dataset(tmp_path / "d", labels=listing)
    assert (len(data.X), data.faults) == (4, ())
    assert not any("more than once" in note for note in data.notes)


def test_a_column_without_a_name_is_no_channel_of_a_long_table(tmp_path: Path) -> None:
    """g12: R's row numbers were offered as a channel without a name."""
    rows = [
        f"{N * part + i},{part},{0.01 * i:.2f},{value},OK"
        for part in (1, 2)
        for i, value in enumerate(texts())
    ]
    path = tmp_path / "a.csv"
    path.write_text("\n".join([",part,time,force_N,label", *rows]))
    assert load_dataset(path, time="time").channels == ("force_N",)


def test_a_channel_that_is_not_beside_columns_of_one_name_is_an_error(tmp_path: Path) -> None:
    """g05: a clock for each channel, and a channel that is not there, ended in a traceback."""
    write(tmp_path / "a_OK.csv", ["Time", "Fx", "Time", "Fz"], times(), texts(), times(), texts())
    assert "Expected a column F, got Time, Fx" in one_line("data", tmp_path, "--channel", "F")


def parts_of_two(scale: float = 1.0) -> dict[str, list[float]]:
    """The samples of two parts, by their serial numbers."""
    return {"0000073": (VALUES * scale).tolist(), "0000074": (-VALUES * scale).tolist()}


def test_a_wide_table_is_labelled_by_a_listing_that_names_its_parts(tmp_path: Path) -> None:
    wide = tmp_path / "curves.csv"
    frame = pd.DataFrame(parts_of_two()).T.rename(columns="Y{}".format)
    frame.rename_axis("Serial Number").reset_index().to_csv(wide, index=False)
    listing = tmp_path / "erp.csv"
    listing.write_text("Serial,Result\n74,Fail\n73,Pass\n")
    assert "--part 'Serial Number'" in one_line("data", wide, "--labels", listing)
    data = load_dataset(wide, labels=listing, part="Serial Number")
    assert data.y.tolist() == [1, 0]
    assert data.source.tolist() == ["0000073", "0000074"]
    np.testing.assert_array_equal(data.X[0], VALUES.astype(np.float32))
    listing.write_text("Serial,Result\n73,Pass\n")
    assert len(load_dataset(wide, labels=listing, part="Serial Number").faults) == 1


def test_columns_that_state_units_and_rates_hold_for_their_rows(tmp_path: Path) -> None:
    records = [
        {"sn": sn, "force": [value / scale for value in values], "unit": unit, "ok": True}
        for (sn, values), unit, scale in zip(
            parts_of_two().items(), ("N", "kN"), (1.0, 1000.0), strict=True
        )
    ]
    path = tmp_path / "a.jsonl"
    path.write_text("\n".join(json.dumps(record | {"fs_hz": 250}) for record in records))
    data = load_dataset(path, label="ok")
    np.testing.assert_allclose(data.X, np.float32([VALUES, -VALUES]), rtol=1e-6)
    assert (data.unit, data.rate_hz) == ("N", 250.0)
    long = pd.DataFrame(records).explode("force").rename(columns={"sn": "part", "ok": "label"})
    long["time"] = np.tile(STEP * np.arange(N), 2)
    data = load_dataset(long.reset_index(drop=True).astype({"force": float}), time="time")
    np.testing.assert_allclose(data.X, np.float32([VALUES, -VALUES]), rtol=1e-6)
    long = long.reset_index(drop=True).astype({"force": float})
    long.loc[5, "unit"] = "kN"
    (fault,) = load_dataset(long, time="time").faults
    assert "Expected one unit of a recording, got N, kN in column unit" in str(fault)


def test_json_files_of_one_part_each_are_rows_of_one_table(tmp_path: Path) -> None:
    for sn, values in parts_of_two().items():
        record = {"id": sn, "result": "OK", "force": values, "errors": [{"code": 7}]}
        (tmp_path / f"{sn}.json").write_text(json.dumps(record))
    data = load_dataset(tmp_path, label="result", part="id")
    np.testing.assert_array_equal(data.X, np.float32([VALUES, -VALUES]))


def test_a_part_whose_curve_is_in_pieces_is_refused(tmp_path: Path) -> None:
    """A nutrunner's steps would each have become a part, with the step's result."""
    steps = [{"result": "OK", "torque": VALUES.tolist()}] * 2
    for name in ("1.json", "2.json"):
        (tmp_path / name).write_text(json.dumps({"id": name, "result": "OK", "steps": steps}))
    assert "it is one part in 2 pieces, steps; write one list" in one_line("data", tmp_path)


def test_a_folder_that_states_a_column_states_it_of_the_tables_in_it(tmp_path: Path) -> None:
    for scale, result in enumerate(("PASS", "FAIL", "__HIVE_DEFAULT_PARTITION__"), start=1):
        frame = pd.DataFrame({"force_N": list(parts_of_two(scale).values())})
        folder = tmp_path / "line=3" / f"result={result}"
        folder.mkdir(parents=True)
        frame.to_parquet(folder / "part-0.parquet")
    data = load_dataset(tmp_path)
    assert (data.y.tolist(), data.unlabelled) == ([0, 0, 1, 1], 2)


def test_the_only_signal_of_a_table_is_named_by_its_tag() -> None:
    frame = pd.DataFrame(parts_of_two()).melt(var_name="part", value_name="_value")
    frame["_time"] = np.tile(STEP * np.arange(N), 2)
    frame["_field"] = "force_N"
    data = load_dataset(frame.assign(label="ok"), time="_time", channel="force_N")
    np.testing.assert_array_equal(data.X, np.float32([VALUES, -VALUES]))


def test_titles_may_stand_above_a_table_with_a_column_for_each_part(tmp_path: Path) -> None:
    numbers = [f"D{i}" for i in range(10)]
    verdicts = ["gut"] * 7 + ["Ausschuss"] * 3
    rows = [[str(4 * i), *texts(value + np.arange(10))] for i, value in enumerate(VALUES)]
    head = [["AST40;Program 12"], ["Nummer", *numbers], ["Befund", *verdicts]]
    lines = [";".join(row) for row in [*head, ["Zeit [ms]", *["Moment [Nm]"] * 10], *rows]]
    path = tmp_path / "shift.csv"
    path.write_text("\n".join(lines))
    assert "'Ausschuss' 3 times beside 7 good ones" in one_line("data", path)
    data = load_dataset(path, label_map="Ausschuss=bad", part="Nummer")
    assert data.y.tolist() == [1] * 7 + [0] * 3
    assert data.part.tolist() == numbers
    np.testing.assert_allclose(data.X[9], VALUES + 9, rtol=1e-6)


def test_rates_below_the_row_of_units_are_no_header(tmp_path: Path) -> None:
    lines = ["Temps\tForce", "s\tkN", "250 Hz\t250 Hz"]
    lines += ["\t".join(cells) for cells in zip(times(), texts(), strict=True)]
    (tmp_path / "a_OK.asc").write_text("\n".join(lines))
    data = load_dataset(tmp_path)
    assert (data.channels, data.unit, data.rate_hz) == (("Force",), "kN", 250.0)


def test_zeros_behind_the_length_of_each_trace_are_no_samples(tmp_path: Path) -> None:
    X = np.arange(12)[:, None] + VALUES
    lengths = np.array([N - 30, *[N] * 11])
    X[0, -30:] = 0.0
    y = np.array([0, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 0])
    np.savez(tmp_path / "a.npz", X=X, y=y, n_valid=lengths)
    data = load_dataset(tmp_path / "a.npz")
    assert data.X[0, -1] == np.float32(VALUES[-31])
    assert data.lengths.tolist() == lengths.tolist()
    np.savez(tmp_path / "b.npz", X=X, y=y, count=lengths - 1)  # no length: samples lie behind it
    assert "Not read: the arrays count." in load_dataset(tmp_path / "b.npz").notes


def test_labels_of_which_most_are_bad_are_questioned(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", X=np.arange(12)[:, None] + VALUES, y=np.array([0] * 7 + [1] * 5))
    note = "7 of 12 recordings are bad: check how labels are read."
    assert note in load_dataset(tmp_path / "a.npz").notes
    assert note not in load_dataset(tmp_path / "a.npz", label_map="0=good,1=bad").notes


def test_times_in_the_names_of_columns_tell_the_rate() -> None:
    frame = pd.DataFrame([VALUES, -VALUES]).rename(columns=lambda i: f"F_{4 * int(i)}ms")
    data = load_dataset(frame.assign(label=["OK", "NOK"]))
    assert (data.channels, data.rate_hz, data.X.shape) == (("F",), 250.0, (2, N))


def test_a_mark_of_overflow_is_a_fault(tmp_path: Path) -> None:
    for i in range(6):
        values = VALUES.copy()
        values[50:53] = 1e6 if i == 2 else values[50:53]
        write(tmp_path / f"{i}_OK.csv", ["t [s]", "F [N]"], times(), texts(values))
    (fault,) = load_dataset(tmp_path).faults
    assert (
        str(fault) == "2_OK.csv: Expected measured samples, 3 samples are 1e+06, as of an overflow"
    )


def test_a_row_of_another_file_again_counts_once(tmp_path: Path) -> None:
    rows = [[f"P{i}", "OK", *(VALUES + i).tolist()] for i in range(12)]
    columns = ["part", "label", *(f"F_{i}" for i in range(N))]
    pd.DataFrame(rows[:8], columns=columns).to_parquet(tmp_path / "a.parquet")
    pd.DataFrame(rows[6:], columns=columns).to_parquet(tmp_path / "b.parquet")
    data = load_dataset(tmp_path)
    assert data.part.tolist() == [f"P{i}" for i in range(12)]
    text = (
        "2 rows repeat one of another file, and are left out: b.parquet, line 1, b.parquet, line 2."
    )
    assert text in data.notes


def test_an_empty_clock_of_labview_leaves_the_rate_to_delta_x(tmp_path: Path) -> None:
    head = ["LabVIEW Measurement\t", "***End_of_Header***\t", "Delta_X\t0.004\t0.004"]
    head += ["***End_of_Header***\t\t", "X_Value\tForce\tFeed\tComment"]
    rows = [f"\t{cell}\t0.5" for cell in texts()]
    (tmp_path / "a_OK.lvm").write_text("\n".join([*head, *rows]))
    data = load_dataset(tmp_path, channel="Force")
    np.testing.assert_array_equal(data.X[0], VALUES.astype(np.float32))
    assert data.rate_hz == 250.0


def test_files_in_two_languages_are_read_by_the_columns_that_the_error_names(
    tmp_path: Path,
) -> None:
    languages = {
        "de": (["Gesamtergebnis;{}", "Zeit;Weg;Kraft"], ("IO", "NIO")),
        "en": (["Total result;{}", "Time;Way;Force"], ("OK", "NOK")),
    }
    for language, (head, words) in languages.items():
        for i in range(4):
            lines = [head[0].format(words[i % 2]), "", head[1], "s;mm;N"]
            lines += [f"{t};1.5;{x}" for t, x in zip(times(), texts(VALUES + i), strict=True)]
            (tmp_path / f"{language}{i}.csv").write_text("\n".join(lines))
    error = one_line("data", tmp_path, "--channel", "Kraft")
    assert "4 of 8 files have Way, Force instead" in error
    advice = re.search("--columns (.+), --channel ([^.]+)", error)
    data = load_dataset(tmp_path, columns=advice[1], channel=advice[2])
    assert (data.y.tolist(), data.unit) == ([1, 0] * 4, "N")
    np.testing.assert_array_equal(data.X[3], (VALUES + 3).astype(np.float32))
