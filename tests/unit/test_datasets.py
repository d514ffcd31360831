"""Labelled traces: files, arrays, names, and what is wrong with them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dengine import load_dataset
from dengine.datasets import describe, make_dataset
from dengine.datasets.units import conversion
from dengine.errors import DataError


@pytest.fixture
def saved(tmp_path):
    def save(**arrays) -> Path:
        path = tmp_path / "recorded.npz"
        np.savez(path, **arrays)
        return path

    return save


def test_quantised_traces_are_scaled_back(saved):
    X = np.arange(12, dtype=np.int16).reshape(3, 4)
    path = saved(X=X, y=[1, 0, 1], scale=0.25, rate_hz=200.0, unit="mN", cause=["", "rim", ""])
    loaded = load_dataset(path)
    np.testing.assert_array_equal(loaded.X, X / 4)
    assert (loaded.rate_hz, loaded.unit, loaded.cause[1]) == (200.0, "mN", "rim")


def test_cut_keeps_the_first_samples_of_every_channel(make_data):
    data = make_data(10, samples=80, channels=3)
    np.testing.assert_array_equal(load_dataset(data, samples=30).X, data.X[..., :30])
    for samples in (0, 81):
        with pytest.raises(DataError, match="Expected 1 to 80 samples"):
            data.cut(samples)


@pytest.mark.parametrize(
    ("shape", "y", "message"),
    [
        ((3, 4), [0, 1], r"got \(\(3, 4\), \(2,\)\)"),
        (4, [0, 1, 0, 1], "Expected traces"),
        ((2, 4), [0, 2], "Expected labels 1 .success. and 0"),
        ((2, 4), [0, np.nan], "Expected labels"),
        ((0, 4), [], "at least one trace"),
    ],
)
def test_parts_that_do_not_fit_together_are_named(shape, y, message):
    with pytest.raises(DataError, match=message):
        make_dataset(np.zeros(shape), y)


@pytest.mark.parametrize("content", [b"", b"not a zip", b"PK\x03\x04 broken", None])
def test_a_damaged_file_or_one_of_objects_is_a_data_error(saved, tmp_path, content):
    path = saved(X=np.array([[None]], dtype=object), y=[1])  # never unpickled
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(DataError, match="Cannot read"):
        load_dataset(path)


def test_an_archive_without_traces_is_refused_or_asked_for(saved):
    assert "layout" in describe(saved(a=5, b=2.0)).open_keys
    with pytest.raises(DataError, match=r"recorded.npz: Expected arrays, got none"):
        describe(saved())


@pytest.mark.parametrize("source", [(1, 2), None, "insertion", "x" * 300, "a\0b"])
def test_what_is_no_file_folder_or_table_is_refused(source):
    match = r"a file, a folder or a DataFrame.* take no description, and no key"
    with pytest.raises(DataError, match=match):
        describe(source)
    with pytest.raises(DataError, match=match):
        load_dataset(source, {"files": "*.csv"})


def test_selected_channels_are_some_and_keep_their_units(make_data):
    data = replace(make_data(4, samples=8, channels=3), channels=("a", "b", "c"))
    for unit, selected in {"": "", "N, N, mm": "mm, N", ", , mm": "mm, ", "N, mm, N": "N"}.items():
        assert replace(data, unit=unit).select(("c", "a")).unit == selected
    with pytest.raises(DataError, match=r"Expected channels of .*, a, b, c, got \[\]"):
        data.select(())


@pytest.mark.parametrize("channels", [1, 2])
def test_a_frame_of_a_data_set_writes_parquet_that_loads_as_it_also_with_columns_added_and_moved(
    make_data, channels, tmp_path
):
    parts = np.array([f"P{i // 2}" for i in range(8)])
    names = ("FX", "FZ")[:channels]
    data = replace(make_data(8, samples=30, channels=channels), part=parts, channels=names)
    frame = data.to_frame().sort_index(axis=1)
    frame["temperature"] = 21.5
    frame.to_parquet(tmp_path / "data.parquet")
    loaded = load_dataset(tmp_path / "data.parquet", channels=names)
    for name in ("X", "y", "part"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(data, name))


def test_a_unit_that_is_called_like_a_quantity_is_no_unit_of_it():
    assert conversion("[kN]", "N") == 1000.0
    assert conversion("kraft", "kraft") == 1.0
    for unit, wanted in (("force", "N"), ("N", "length"), ("N", "mm")):
        assert conversion(unit, wanted) is None
