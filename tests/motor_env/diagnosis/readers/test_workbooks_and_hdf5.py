"""Workbooks of Excel and files of MATLAB 7.3: their numbers are those of the same recording as text."""

import datetime as dt
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hostile import archive_of, members_of, refused
from recording_csv import csv_text

from motor_env import ColumnChoice, read_recording
from motor_env.diagnosis.readers import array_parser

MISSING = "the extra files is not installed"
TIME = np.round(np.linspace(0.0, 0.0399, 400), 6)
COLUMNS: dict[str, Any] = {
    "time_s": TIME,
    "current_a": np.round(3.0 * np.exp(-TIME / 0.01) + 0.1, 6),  # openpyxl writes 16 digits
    "voltage_v": np.where(TIME > 0.005, 12.0, 0.0),
}
ROWS = [list(COLUMNS), *(list(row) for row in zip(*COLUMNS.values(), strict=True))]


def workbook(path: Path, **sheets: list[list[Any]]) -> None:
    book = pytest.importorskip("openpyxl", reason=MISSING).Workbook()
    book.remove(book.active)
    for name, rows in sheets.items():
        sheet = book.create_sheet(name)
        for row in rows:
            sheet.append(row)
    book.save(path)


def check_same(path: Path, *columns: str) -> list[str]:
    """As in the text; what the reader remarks."""
    plain = path.with_name("plain.csv")
    plain.write_text(csv_text(COLUMNS))
    found = read_recording(path, [ColumnChoice.parse(column) for column in columns])
    wanted = read_recording(plain)
    for name in ("time_s", "current_a", "voltage_v"):
        np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name))
    return list(found.columns)


def test_the_first_sheet_with_rows_of_numbers_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a.xlsx"
    notes: list[list[Any]] = [["motor", "of\nthe pump"], ["poles", 4], [None, None]]
    workbook(path, notes=notes, data=[*notes, *ROWS, [None], [None]], later=[[1.0, 2.0]] * 500)
    assert "numbers begin in line 5" in check_same(path)


@pytest.mark.parametrize(
    ("below", "told"),
    [
        ([[None], [None, None, 5.5]], "'5.5'"),
        ([[None], [None, "mean", 1.25]], "'mean', '1.25'"),
        ([["end"]], "'end'"),
        ([[None], [None, None, None, None, "by me"]], "'by me'"),
    ],
)
def test_a_stray_cell_below_or_beside_a_table_is_ignored_and_told(
    tmp_path: Path, below: list[list[Any]], told: str
) -> None:
    path = tmp_path / "a.xlsx"
    workbook(path, data=[*ROWS, *below])
    assert f"ignored, for they stand apart: {told}" in check_same(path)
    workbook(path, data=[*ROWS[:9], [*ROWS[9], None, "seen"], *ROWS[10:], *below])
    assert f"ignored, for they stand apart: {told}, 'seen'" in check_same(path)


def test_channels_of_tdms_with_a_time_or_as_a_waveform(tmp_path: Path) -> None:
    nptdms = pytest.importorskip("nptdms", reason=MISSING)
    step = {"wf_increment": 1e-4, "wf_start_offset": 0.0}
    times = {"time_s": nptdms.ChannelObject("run", "Time", TIME)}
    volts = nptdms.ChannelObject("run", "Voltage", COLUMNS["voltage_v"], step | {"unit_string": "V"})
    current = nptdms.ChannelObject("run", "Current", 1e3 * COLUMNS["current_a"], step | {"unit_string": "mA"})
    for channels in ([volts, current], [*times.values(), volts, current]):
        with nptdms.TdmsWriter(str(tmp_path / "a.tdms")) as writer:
            writer.write_segment(channels)
        found = read_recording(tmp_path / "a.tdms")
        np.testing.assert_allclose(found.current_a, COLUMNS["current_a"], rtol=1e-9)
        np.testing.assert_array_equal(found.voltage_v, COLUMNS["voltage_v"])
        np.testing.assert_allclose(found.time_s, TIME, atol=1e-9)


def test_a_clock_and_text_in_a_sheet(tmp_path: Path) -> None:
    path, begin = tmp_path / "a.xlsx", dt.datetime(2026, 1, 31, 12)  # noqa: DTZ001  # a sheet knows no zone
    times = [begin + dt.timedelta(seconds=0.5 * n) for n in range(400)]
    rows = [[time, row[1], "on"] for time, row in zip(times, ROWS[1:], strict=True)]
    workbook(path, data=[["when", "current_a", "lamp, red"], *rows])
    found = read_recording(path)
    np.testing.assert_allclose(found.time_s, 0.5 * np.arange(400), atol=1e-6)
    np.testing.assert_array_equal(found.current_a, COLUMNS["current_a"])


def test_a_cell_that_is_no_number_is_named(tmp_path: Path) -> None:
    path = tmp_path / "a.xlsx"
    workbook(path, data=[*ROWS[:200], [0.0199, "#REF!", 12.0], *ROWS[201:]])
    assert "line 201: the column current_a must hold numbers, got '#REF!'" in refused(
        lambda: read_recording(path), path
    )


def hdf5(path: Path) -> Any:
    file = pytest.importorskip("h5py", reason=MISSING).File(path, "w", userblock_size=512)
    for n, (name, values) in enumerate(COLUMNS.items()):
        file[f"data/{name}"] = values if n == 0 else values.reshape((1, -1) if n == 1 else (-1, 1))
    return file


def test_numbers_of_matlab_are_read_and_nothing_else(tmp_path: Path) -> None:
    """Text, what other files hold and what MATLAB keeps for itself would be columns of other lengths."""
    h5py = pytest.importorskip("h5py", reason=MISSING)
    path, other = tmp_path / "a.mat", tmp_path / "other.h5"
    with h5py.File(other, "w") as file:
        file["speed"] = TIME
    (tmp_path / "raw").write_bytes(TIME.tobytes())
    with hdf5(path) as file:
        file["title"] = np.arange(30, dtype=np.uint16)
        file["title"].attrs["MATLAB_class"] = np.bytes_("char")
        file["none"] = np.zeros(2, dtype=np.uint64)
        file["none"].attrs["MATLAB_empty"] = 1
        file["#refs#/a"] = TIME[:30]
        file["outside"] = h5py.ExternalLink(str(other), "/speed")
        file["inside"] = h5py.SoftLink("/data/current_a")
        file.create_dataset("raw", (400,), "f8", external=[(str(tmp_path / "raw"), 0, 3200)])
        layout = h5py.VirtualLayout((400,), "f8")
        layout[:] = h5py.VirtualSource(str(other), "speed", (400,))
        file.create_virtual_dataset("virtual", layout)
    whole = path.read_bytes()
    path.write_bytes(b"MATLAB 7.3 MAT-file".ljust(512) + whole[512:])
    read = array_parser.parse_hdf5(path.read_bytes())
    assert sorted(read) == ["current_a", "time_s", "voltage_v"]
    check_same(path)
    path.rename(path.with_suffix(".h5"))
    check_same(path.with_suffix(".h5"))


def test_structs_of_two_runs_keep_their_names(tmp_path: Path) -> None:
    path = tmp_path / "a.mat"
    with hdf5(path) as file:
        file["more/current_a"] = 2.0 * COLUMNS["current_a"]
    (path).write_bytes(b"MATLAB 7.3 MAT-file".ljust(512) + path.read_bytes()[512:])
    check_same(path, "current=data.current_a")


def bomb_of_cells(path: Path) -> None:
    workbook(path, data=ROWS)
    members = members_of(path.read_bytes()) | {"xl/media/a.bin": bytes(8 * array_parser.MOST_NUMBERS + 8)}
    path.write_bytes(archive_of(members, zipfile.ZIP_DEFLATED))


def far_row(path: Path) -> None:
    workbook(path, data=ROWS)
    members = members_of(path.read_bytes())
    sheet = members["xl/worksheets/sheet1.xml"].replace(b'<row r="401"', b'<row r="99999999"')
    path.write_bytes(archive_of(members | {"xl/worksheets/sheet1.xml": sheet}))


def no_numbers(path: Path) -> None:
    workbook(path, data=ROWS[:20])


def large_set(path: Path) -> None:
    with hdf5(path) as file:
        file.create_dataset("zeros", (array_parser.MOST_NUMBERS,), "f8", chunks=True)
    path.write_bytes(b"MATLAB 7.3 MAT-file".ljust(512) + path.read_bytes()[512:])


@pytest.mark.parametrize(
    ("name", "make", "sentence"),
    [
        ("a.xlsx", bomb_of_cells, "unpacks to"),
        ("a.xlsx", far_row, "at most 1,048,576 rows"),
        ("a.xlsx", no_numbers, "no sheet holds 20 rows of numbers"),
        ("a.mat", large_set, "unpacks to"),
    ],
)
def test_what_is_too_much_or_nothing_is_a_sentence(
    name: str, make: Any, sentence: str, tmp_path: Path
) -> None:
    make(tmp_path / name)
    assert sentence in refused(lambda: read_recording(tmp_path / name), tmp_path / name)


@pytest.mark.parametrize(
    ("name", "content", "library"),
    [
        ("a.xlsx", archive_of({}), "openpyxl"),
        ("a.mat", b"MATLAB 7.3 MAT-file", "h5py"),
        ("a.h5", b"\x89HDF", "h5py"),
    ],
)
def test_without_the_extra_it_is_named(
    name: str, content: bytes, library: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    monkeypatch.setitem(sys.modules, library, None)
    sentence = refused(lambda: read_recording(path), path, named=library)
    assert sentence.endswith("pip install 'motor-env[files]'")
