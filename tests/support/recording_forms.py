"""The forms of recordings that are read: the tests try each, and the documentation lists them.

`python -m tests.support.recording_forms` writes the lists into the page.
"""

from collections.abc import Callable, Mapping
from datetime import UTC, datetime, timedelta
from pathlib import Path

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "recording_forms.md"
BEGIN = "<!-- {}: written by tests/support/recording_forms.py -->"
END = "<!-- end of {} -->"
STEP = 0.004  # seconds: 250 Hz

# A delimiter's name -> what stands between the cells.
DELIMITERS = {
    "comma": ",",
    "semicolon": ";",
    "tab": "\t",
    "bar": "|",
    "blank": " ",
    "several blanks": "   ",
}
SUFFIXES = (".csv", ".tsv", ".txt", ".dat", ".lvm")

# 1043.5 in a number format -> how it writes a number.
NUMBERS: Mapping[str, Callable[[float], str]] = {
    "1043.50": lambda x: f"{x:.2f}",
    "1043,50": lambda x: f"{x:.2f}".replace(".", ","),
    "1,043.50": lambda x: f"{x:,.2f}",
    "1.043,50": lambda x: f"{x:,.2f}".translate(str.maketrans(",.", ".,")),
    "1 043,50": lambda x: f"{x:,.2f}".translate(str.maketrans(",.", " ,")),
    "1\u202f043,50": lambda x: f"{x:,.2f}".translate(str.maketrans(",.", "\u202f,")),
    "1 043.50": lambda x: f"{x:,.2f}".replace(",", " "),
    "1'043.50": lambda x: f"{x:,.2f}".replace(",", "'"),
    "1’043,50": lambda x: f"{x:,.2f}".translate(str.maketrans(",.", "’,")),
    "1.0435E+03": lambda x: f"{x:.4E}",
    "1,0435e+03": lambda x: f"{x:.4e}".replace(".", ","),
    "+1043.50": lambda x: f"{x:+.2f}",
    "−1043,50": lambda x: f"{x:.2f}".translate(str.maketrans("-.", "−,")),
}

# What a column of seconds is called.
CLOCK_NAMES = (
    *(
        "time",
        "Time",
        "TIME",
        "timestamp",
        "Timestamp",
        "TimeStamp",
        "timestamps",
        "time_stamp",
        "%time",
        "# time",
    ),
    *(
        "__time",
        "Time.1",
        "elapsed",
        "elapsed_time",
        "Elapsed Time (s)",
        "Relative Time",
        "relative_time",
        "runtime",
    ),
    *(
        "System Time",
        "Sample Time",
        "X_Value",
        "Time_s",
        "t",
        "t_s",
        "t [s]",
        "t/s",
        "t_rel",
        "Time/s",
        "time(s)",
    ),
    *(
        "log_time",
        "receive_time",
        "header.stamp",
        "field.header.stamp",
        "stamp",
        "rosbagTimestamp",
        "ros_time",
    ),
    *(
        "sec",
        "seconds",
        "epoch",
        "clock",
        "date_time",
        "DateTime",
        "Date",
        "Date/Time",
        "Zeit",
        "Zeit/s",
        "Uhrzeit",
    ),
    *(
        "Messzeit",
        "Zeitstempel",
        "Temps",
        "heure",
        "tiempo",
        "hora",
        "Tempo",
        "tijd",
        "czas",
        "時間",
        "时间",
        "시간",
    ),
)
# What a column of other units is called -> the seconds of one.
CLOCK_UNITS = {
    **dict.fromkeys(
        (
            "time_ms",
            "Time (ms)",
            "t [ms]",
            "t/ms",
            "Millis",
            "millis",
            "ms",
            "timeMs",
            "Zeit in ms",
        ),
        1e-3,
    ),
    **dict.fromkeys(("time [us]", "timestamp_us", "t [µs]", "micros", "Time(us)"), 1e-6),
    **dict.fromkeys(("time_ns", "epoch_ns", "Zeit(0.001 us)"), 1e-9),
    "Zeit(0.001 ms)": 1e-6,
    "Zeit [0,1 ms]": 1e-4,
    "time [min]": 60.0,
}

START = datetime(2026, 3, 1, 6, 0, 0, tzinfo=UTC)


def _at(i: int) -> datetime:
    return START + timedelta(seconds=STEP * i)


def _trimmed(i: int) -> str:
    return f"{_at(i):%Y-%m-%dT%H:%M:%S.%f}".rstrip("0").rstrip(".")


# A form of times, as its third row says it -> how it writes a row's.
TIMES: Mapping[str, Callable[[int], str]] = {
    "0.008 (s)": lambda i: f"{STEP * i:.3f}",
    "8 (ms)": lambda i: str(round(1e3 * STEP * i)),
    "8000 (µs)": lambda i: str(round(1e6 * STEP * i)),
    "8000000 (ns)": lambda i: str(round(1e9 * STEP * i)),
    "1772344800.008 (s since 1970)": lambda i: f"{_at(i).timestamp():.3f}",
    "1772344800008 (ms)": lambda i: str(round(_at(i).timestamp() * 1e3)),
    "1772344800008.00 (ms)": lambda i: f"{_at(i).timestamp() * 1e3:.2f}",
    "1772344800008000 (µs)": lambda i: str(round(_at(i).timestamp() * 1e6)),
    "1772344800008000000 (ns)": lambda i: f"{1772344800000 + 4 * i}000000",
    "134168184000080000 (FILETIME: 100 ns since 1601)": lambda i: str(
        134168184000000000 + 40000 * i
    ),
    "639079416000080000 (.NET ticks: 100 ns since year 1)": lambda i: str(
        639079416000000000 + 40000 * i
    ),
    "2026-03-01T06:00:00.008Z": lambda i: f"{_trimmed(i)}Z",
    "2026-03-01T06:00:00.008+01:00": lambda i: f"{_at(i):%Y-%m-%dT%H:%M:%S.%f}+01:00",
    "2026-03-01T06:00:00.008+01": lambda i: f"{_trimmed(i)}+01",
    "2026-03-01 06:00:00,008": lambda i: f"{_at(i):%Y-%m-%d %H:%M:%S},{4 * i % 1000:03d}",
    "2026-03-01 06:00:00.008 UTC": lambda i: f"{_at(i):%Y-%m-%d %H:%M:%S.%f} UTC",
    "20260301T060000.008Z": lambda i: f"{_at(i):%Y%m%dT%H%M%S.%f}Z",
    "2026/03/01 06:00:00.008": lambda i: f"{_at(i):%Y/%m/%d %H:%M:%S.%f}",
    "01.03.2026 06:00:00,008": lambda i: f"{_at(i):%d.%m.%Y %H:%M:%S},{4 * i % 1000:03d}",
    "01.03.26 06:00:00.008": lambda i: f"{_at(i):%d.%m.%y %H:%M:%S.%f}",
    "01-Mar-26 06:00:00.008": lambda i: f"{_at(i):%d-%b-%y %H:%M:%S.%f}",
    "Mar 1 2026 06:00:00.008": lambda i: f"{_at(i):%b 1 %Y %H:%M:%S.%f}",
    "3/1/2026 6:00:00.008 AM": lambda i: f"{_at(i):3/1/2026 6:%M:%S.%f} AM",
    "06:00:00.008": lambda i: f"{_at(i):%H:%M:%S.%f}",
    "06:00:00,008": lambda i: f"{_at(i):%H:%M:%S},{4 * i % 1000:03d}",
    "00:00.008": lambda i: f"{_at(i):%M:%S}.{4 * i % 1000:03d}",
    "46082.25000009 (Excel's days)": lambda i: f"{46082.25 + STEP * i / 86400:.12f}",
}
# How a header says a unit, of a channel FZ in kN; `` over it stands for a row of units below the
# header.
UNITS = ("FZ [kN]", "FZ (kN)", "FZ_kN", "FZ/kN", "FZ in kN", "FZ kN", "a row of units")


# Where a name has its label -> names of good recordings, and of bad ones.
LABEL_FORMS: Mapping[str, tuple[list[str], list[str]]] = {
    "a word at the end of the name": (
        [
            "insertion_0001_True.csv",
            "OK.csv",
            "a-PASS.CSV",
            "sub/x good.csv",
            "success.csv",
            "0001_yes.csv",
            "7_gut.csv",
        ],
        [
            "insertion_0001_False.csv",
            "NOK.csv",
            "a-FAIL.CSV",
            "x_bad.csv",
            "x.failure.csv",
            "0001_no.csv",
            "7_schlecht.csv",
        ],
    ),
    "a word, and numbers behind it": (
        [
            "part_0001_OK_0.csv",
            "OK_0001.csv",
            "pass-0.csv",
            "x_true_2026-03-01.csv",
            "x_good_v0.csv",
            "OK1.csv",
            "IO_7.csv",
        ],
        [
            "part_0001_NOK_1.csv",
            "NOK_0001.csv",
            "fail-1.csv",
            "x_false_1_1.csv",
            "x_bad_run1.csv",
            "NOK1.csv",
            "NIO_7.csv",
        ],
    ),
    "i.O. and n.i.O., as Germans write them": (
        ["7_i.O..csv", "7_i.O.csv", "7_iO.csv", "7_IO.csv", "7_i_O.csv", "i.O._7.csv", "io/7.csv"],
        [
            "7_n.i.O..csv",
            "7_n.i.O.csv",
            "7_niO.csv",
            "7_NIO.csv",
            "7_n_i_O.csv",
            "7_nicht i.O..csv",
            "n.i.O./7.csv",
        ],
    ),
    "a word after a not": (
        ["run_7_not_failed.csv", "run_7_NotFailed.csv"],
        [
            "run_7_not-OK.csv",
            "run_7_not_ok.csv",
            "NOTOK.csv",
            "nok/7.csv",
            "runNotOk.csv",
            "run_7_n.ok.csv",
            "not ok/7.csv",
        ],
    ),
    "other separators and capitals": (
        [
            "part7OK.csv",
            "partOk.csv",
            "part(ok).csv",
            "part=pass.csv",
            "part.7.ok.csv",
            "part [OK] 7.csv",
            "part+true.csv",
        ],
        [
            "part7NOK.csv",
            "partNok.csv",
            "part(ng).csv",
            "part=fail.csv",
            "part.7.nok.csv",
            "part [NG] 7.csv",
            "part+false.csv",
        ],
    ),
    "a word after newtons or another N": (
        [
            "7_Kraft50N_OK.csv",
            "7_test_50N_ok.csv",
            "7_press 50 N OK.csv",
            "7_lane_N_ok.csv",
            "7_X0.5mN_OK.csv",
            "7_sensor-N-OK.csv",
            "05_mN_ok.csv",
            "05_kN.ok.csv",
            "50N.ok.csv",
            "press 50 N i.O..csv",
            "50N_IO_7.csv",
            "50N_OK/7.csv",
        ],
        [
            "7_Kraft50N_NOK.csv",
            "press 50 N n.i.O..csv",
            "05_mN_nok.csv",
            "lane_N_n.ok.csv",
            "50N_NIO_7.csv",
        ],
    ),
    "the folder's name": (
        ["good/0.csv", "ok/monday/7.csv", "OK/run_0.csv", "part_003_OK/run_0.csv"],
        ["NOK/1.csv", "fail/run 7.csv", "cell/nok/b/3.csv", "part_003_NOK/run_1.csv"],
    ),
    "copies": (
        ["run_7_true (2).csv", "run_7_true(1).csv", "run_7_true - Copy.csv"],
        ["run_7_NOK - Kopie (3).csv", "1/x_nok.csv", "run_7_false copy.csv"],
    ),
}
# The label of a part that was not checked yet, and names that say so.
NOT_CHECKED = (
    *("", "nan", "NaN", "None", "-", "n/a", " ", "NULL", "?", "pending", "Unknown", "offen"),
    *("open", "todo", "TBD", "in progress", "pendiente", "en attente", "not checked", "untested"),
)
NOT_CHECKED_NAMES = (
    *("7_pending.csv", "pending/7.csv", "7_in_progress.csv", "part_7_offen_2.csv", "7 TBD (2).csv"),
    *("part_7_not-checked.csv", "runUnknown.csv", "7_OK_pending.csv"),
)


def in_code(words: Mapping[str, object] | tuple[str, ...]) -> str:
    return ", ".join(f"`{word}`".replace("|", "\\|") for word in words)


def tables() -> dict[str, str]:
    """The page's lists by their names, in Markdown."""
    rows = {
        "Files": f"{in_code(SUFFIXES)}, other text that most files are, all also as `.gz`",
        "Between cells": ", ".join(DELIMITERS),
        "1043.5 is written as": in_code(NUMBERS),
        "A clock in seconds is called": in_code(CLOCK_NAMES),
        "A clock in another unit": in_code(CLOCK_UNITS),
        "A time is written as": in_code(TIMES),
        "The unit kN of a channel": in_code(UNITS),
    }
    lines = [
        "| what | forms that are read |",
        "| --- | --- |",
        *(f"| {name} | {forms} |" for name, forms in rows.items()),
    ]
    label_rows = [
        f"| {form} | {in_code(tuple(good))} | {in_code(tuple(bad))} |"
        for form, (good, bad) in LABEL_FORMS.items()
    ]
    empty = ", ".join(f"`{word}`" for word in NOT_CHECKED if word.strip())
    head = ["| the label is | good | bad |", "| --- | --- | --- |"]
    labels = [
        *head,
        *label_rows,
        "",
        f"A recording with an empty label, or {empty}, is counted as unlabelled and left out. So is"
        f" one whose name says so, as in {in_code(NOT_CHECKED_NAMES)}.",
    ]
    return {"recordings": "\n".join(lines), "labels": "\n".join(labels)}


def page(text: str) -> str:
    """A page with its lists as they are now."""
    for name, table in tables().items():
        begin = BEGIN.format(name)
        end = END.format(name)
        before, _, rest = text.partition(begin)
        text = f"{before}{begin}\n\n{table}\n\n{end}{rest.partition(end)[2]}"
    return text


if __name__ == "__main__":
    PAGE.write_text(page(PAGE.read_text("utf-8")), "utf-8")
