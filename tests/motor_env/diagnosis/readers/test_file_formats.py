"""Recordings in each format: read right, whatever lies beside the table; damaged, endless or enormous, a sentence."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hostile import archive_of, damaged, members_of, odd_places, refused, refused_or_same
from recording_bytes import bytes_of
from recording_csv import csv_text
from scipy.io import savemat

from motor_env import ColumnChoice, Recording, cli, read_recording
from motor_env.diagnosis.readers import array_parser, text_numbers as pieces

EXAMPLES = Path(__file__).parents[4] / "examples"
MISSING = "the extra files is not installed"
TIME = np.round(np.linspace(0.0, 0.0399, 400), 6)
CURRENT = np.round(3.0 * np.exp(-TIME / 0.01) + 0.1, 6)  # openpyxl writes 16 digits
VOLTAGE = np.where(TIME > 0.005, 12.0, 0.0)
COLUMNS: dict[str, Any] = {"time_s": TIME, "current_a": CURRENT, "voltage_v": VOLTAGE}
ROWS = [list(COLUMNS), *(list(row) for row in zip(*COLUMNS.values(), strict=True))]
MATLAB_73 = b"MATLAB 7.3 MAT-file".ljust(512)


def check_same(path: Path, *columns: str) -> list[str]:
    """As it was; what the reader remarks."""
    found = read_recording(path, [ColumnChoice.parse(column) for column in columns])
    np.testing.assert_array_equal([found.current_a, found.voltage_v], [CURRENT, VOLTAGE])
    np.testing.assert_allclose(found.time_s, TIME, atol=1e-12)
    return list(found.columns)


@pytest.mark.parametrize(
    ("kind", "count"),
    [("csv", 60), ("npz", 60), ("npy", 60), ("mat", 3), ("parquet", 3), ("h5", 3), ("xlsx", 3)],
)
def test_mutated_files_are_read_or_refused(kind: str, count: int, tmp_path: Path) -> None:
    """Each is read to finite columns of one length, or refused in one line."""
    content, rng, path = (
        bytes_of(kind, COLUMNS),
        np.random.default_rng([1, len(kind)]),
        tmp_path / f"a.{kind}",
    )

    def same(recording: Recording) -> None:
        arrays = [a for a in (recording.current_a, recording.voltage_v) if a is not None]
        assert {len(a) for a in arrays} == {len(recording.time_s)}
        assert all(np.isfinite(a).all() for a in (recording.time_s, *arrays))
        if kind in ("npz", "mat", "xlsx"):  # their checksums tell every change; the others have none
            np.testing.assert_allclose(arrays, [CURRENT, VOLTAGE], rtol=1e-15, strict=True)

    for _ in range(count):
        path.write_bytes(damaged(content, rng, most=3))
        refused_or_same(lambda: read_recording(path), path, same)


def workbook(path: Path, **sheets: list[list[Any]]) -> None:
    book = pytest.importorskip("openpyxl", reason=MISSING).Workbook()
    book.remove(book.active)
    for name, rows in sheets.items():
        sheet = book.create_sheet(name)
        for row in rows:
            sheet.append(row)
    book.save(path)


def hdf5(path: Path) -> Any:
    """Columns as MATLAB lays them, open for more."""
    file = pytest.importorskip("h5py", reason=MISSING).File(path, "w", userblock_size=512)
    for n, (name, values) in enumerate(COLUMNS.items()):
        file[f"data/{name}"] = values if n == 0 else values.reshape((1, -1) if n == 1 else (-1, 1))
    return file


def of_matlab(path: Path) -> None:
    path.write_bytes(MATLAB_73 + path.read_bytes()[512:])


def member_of_workbook(change: Callable[[dict[str, bytes]], dict[str, bytes]]) -> Callable[[Path], None]:
    def make(path: Path) -> None:
        workbook(path, data=ROWS)
        members = members_of(path.read_bytes())
        path.write_bytes(archive_of(members | change(members), zipfile.ZIP_DEFLATED))

    return make


SHEET = "xl/worksheets/sheet1.xml"


def far_row(members: dict[str, bytes]) -> dict[str, bytes]:
    return {SHEET: members[SHEET].replace(b'<row r="401"', b'<row r="99999999"')}


def lzma_archive(path: Path) -> None:
    data = bytearray(archive_of({"time_s.npy": bytes_of("npy", COLUMNS)}, zipfile.ZIP_LZMA))
    data[60:200] = bytes(140)
    path.write_bytes(data)


def large_matrix(path: Path) -> None:
    zeros = np.zeros((array_parser.MOST_NUMBERS // 1000 + 1, 1000), dtype=np.uint8)
    savemat(path, {"zeros": zeros}, do_compression=True)


def large_set(path: Path) -> None:
    with hdf5(path) as file:
        file.create_dataset("zeros", (array_parser.MOST_NUMBERS,), "f8", chunks=True)
    of_matlab(path)


def text(content: str) -> Callable[[Path], object]:
    return lambda path: path.write_text(content)


HEAD = "time_s,current_a\n" + "".join(f"{n},{n % 3}\n" for n in range(30))
SHORT = COLUMNS | {"voltage_v": VOLTAGE[:-1]}


@pytest.mark.parametrize(
    ("name", "make", "sentence"),
    [
        ("a.csv", text(""), "is empty"),
        ("a.csv", text("time_s,current_a\n0,0\n"), "at least 20 samples, got 1"),
        ("a.csv", text(f"{HEAD}30,inf\n"), "line 32: the column current_a must hold finite numbers, got 'inf'"),
        ("a.csv", text(f"{HEAD}30,1e999\n"), "line 32: the column current_a must hold finite numbers"),
        ("a.csv", text(f"{HEAD}30,1_0\n"), "line 32: the column current_a must hold numbers, got '1_0'"),
        ("a.csv", text(f"{HEAD}30\n"), "line 32: the column current_a has no value"),
        ("a.csv", text(f"{HEAD}5,0\n"), "line 32: the column time_s must rise, got 5 after 29"),
        ("a.csv", text("\0" * 300), "is not"),
        ("a.csv", text("1," * 5_000 + "\n"), "at most 1000 can be read"),
        ("a.npz", lzma_archive, "is not a NumPy file"),
        ("a.npz", lambda path: np.savez(path, **SHORT), "voltage_v has 399 values where the others have 400"),
        ("a.mat", lambda path: savemat(path, SHORT), "voltage_v has 399 values where the others have 400"),
        ("a.mat", large_matrix, "unpacks to"),
        ("a.mat", large_set, "unpacks to"),
        ("a.xlsx", lambda path: workbook(path, data=ROWS[:20]), "no sheet holds 20 rows of numbers"),
        ("a.xlsx", lambda path: workbook(path, data=[*ROWS[:200], [0.0199, "#REF!", 12.0], *ROWS[201:]]),
         "line 201: the column current_a must hold numbers, got '#REF!'"),
        ("a.xlsx", member_of_workbook(lambda _: {"xl/media/a.bin": bytes(8 * array_parser.MOST_NUMBERS + 8)}),
         "unpacks to"),
        ("a.xlsx", member_of_workbook(far_row),
         "at most 1,048,576 rows"),
    ],
)  # fmt: skip
def test_bombs_and_odd_files_get_a_sentence(
    name: str, make: Callable[[Path], Any], sentence: str, tmp_path: Path
) -> None:
    make(tmp_path / name)
    assert sentence in refused(lambda: read_recording(tmp_path / name), tmp_path / name)


def test_what_is_no_file_or_never_ends_is_not_read(tmp_path: Path) -> None:
    for path in odd_places(tmp_path / "a.csv"):
        assert "is no regular file" in refused(partial(read_recording, path), path)
    for ending in (".csv", ".parquet", ".mat"):
        path = tmp_path / ("n" * 300 + ending)
        assert "cannot be read (file name too long)" in refused(partial(read_recording, path), path)
    if (path := Path("/proc/self/environ")).exists():
        assert "is empty" in refused(lambda: read_recording(path), path)


def test_a_crash_of_the_parser_is_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Some damaged MATLAB files end the process that parses them."""
    crashing = tmp_path / "crashing.py"
    crashing.write_text("import os, signal\nos.kill(os.getpid(), signal.SIGSEGV)\n")
    monkeypatch.setattr(array_parser, "__file__", str(crashing))
    path = tmp_path / "a.mat"
    path.write_bytes(bytes_of("mat", COLUMNS))
    assert "its parser crashed" in refused(lambda: read_recording(path), path)


def test_parquet_is_parsed_in_a_process_of_its_own(tmp_path: Path) -> None:
    """A line of JSON with names and shapes, then the values; a damaged file ends it with 1 and a sentence."""
    pa, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    path = tmp_path / "a.parquet"
    parquet.write_table(pa.table({"t": [0.0, 0.5], "i": [1, 2], "name": ["a", "b"]}), path)
    command = [sys.executable, array_parser.__file__, "Parquet", str(path)]
    head, _, body = subprocess.run(command, capture_output=True, check=True).stdout.partition(b"\n")
    assert head == b'[1, [["t", [2]], ["i", [2]]]]'
    assert np.frombuffer(body).tolist() == [0.0, 0.5, 1.0, 2.0]
    path.write_bytes(b"PAR1")
    done = subprocess.run(command, capture_output=True, check=False)
    assert (done.returncode, done.stdout, done.stderr.count(b"\n") <= 1) == (1, b"", True)


def test_odd_names_cost_no_verdict(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "cap[").mkdir()
    odd = Path(os.fsdecode(os.fsencode(tmp_path / "cap[") + b"/\x1b[31mb]$_$\xff.csv"))
    names, empty = [odd, tmp_path / ("n" * 240 + ".csv")], tmp_path / "bom.csv"
    for name in names:
        name.write_bytes((EXAMPLES / "startup_capture.csv").read_bytes())
    empty.write_bytes(b"\xef\xbb\xbf")
    options = ["--motor", str(EXAMPLES / "motor.toml"), "--out", str(tmp_path / "out")]
    assert cli.main(["diagnose", *map(str, names), str(empty), *options]) == 2
    printed = capsys.readouterr()
    assert printed.out.count("bearing +") == len(list((tmp_path / "out").iterdir())) == len(names)
    assert "\x1b" not in printed.out + printed.err
    assert "holds no table of numbers" in printed.err
    assert cli.main(["diagnose", str(odd), *options[:2], "--json"]) == 1
    assert [entry["verdict"] for entry in json.loads(capsys.readouterr().out)] == ["bearing"]


def test_a_bug_on_one_file_costs_no_verdict(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    # Reaches in: a bug is patched in for the reader that the command calls for each file.
    from motor_env.diagnosis import file_verdicts

    calls = iter([TypeError("a bug"), None])

    def sometimes(path: Path, columns: Any) -> Recording:
        if (error := next(calls)) is not None:
            raise error
        return read_recording(path, columns)

    monkeypatch.setattr(file_verdicts, "read_recording", sometimes)
    capture, motor = str(EXAMPLES / "startup_capture.csv"), str(EXAMPLES / "motor.toml")
    assert cli.main(["diagnose", capture, capture, "--motor", motor]) == 70
    printed = capsys.readouterr()
    assert "bearing +" in printed.out
    assert "Traceback" in printed.err


@pytest.mark.parametrize("prefix", ["", "data."])
def test_structs_of_two_runs_are_not_merged(prefix: str, tmp_path: Path) -> None:
    """Each keeps its whole name where a short one is there twice."""
    runs: dict[str, Any] = {f"run{n}": {"time_s": TIME, "current_a": n * CURRENT} for n in (1, 2)}
    runs |= {"inputs": {"voltage_v": VOLTAGE}}
    savemat(tmp_path / "a.mat", {"data": runs} if prefix else runs)
    read = array_parser.parse_matlab((tmp_path / "a.mat").read_bytes())
    twice = [f"{prefix}run{n}.{name}" for n in (1, 2) for name in ("time_s", "current_a")]
    assert sorted(read) == sorted([*twice, "voltage_v"])
    np.testing.assert_allclose(read[f"{prefix}run2.current_a"], 2.0 * CURRENT)


def test_plain_rows_are_parsed_at_once_and_like_cell_by_cell(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain, slow = tmp_path / "plain.csv", tmp_path / "slow.csv"
    plain.write_text(csv_text(COLUMNS))
    slow.write_text(csv_text(COLUMNS).replace("\n", "\n \n"))
    check_same(slow)
    monkeypatch.setattr(pieces, "_numbers_cell_by_cell", None)
    check_same(plain)


@pytest.mark.parametrize(
    ("below", "told"),
    [
        ([[None], [None, "mean", 1.25]], "'mean', '1.25'"),
        ([["end"]], "'end'"),
        ([[None], [None, None, None, None, "by me"]], "'by me'"),
    ],
)
def test_the_first_sheet_with_rows_of_numbers_is_read_and_stray_cells_are_told(
    tmp_path: Path, below: list[list[Any]], told: str
) -> None:
    path = tmp_path / "a.xlsx"
    notes: list[list[Any]] = [["motor", "of\nthe pump"], ["poles", 4], [None, None]]
    workbook(path, notes=notes, data=[*notes, *ROWS, [None], [None]], later=[[1.0, 2.0]] * 500)
    assert "numbers begin in line 5" in check_same(path)
    workbook(path, data=[*ROWS[:9], [*ROWS[9], None, "seen"], *ROWS[10:], *below])
    assert f"ignored, for they stand apart: {told}, 'seen'" in check_same(path)


def test_channels_of_tdms_with_a_time_or_as_a_waveform(tmp_path: Path) -> None:
    nptdms = pytest.importorskip("nptdms", reason=MISSING)
    step = {"wf_increment": 1e-4, "wf_start_offset": 0.0}
    time = nptdms.ChannelObject("run", "Time", TIME)
    volts = nptdms.ChannelObject("run", "Voltage", VOLTAGE, step | {"unit_string": "V"})
    current = nptdms.ChannelObject("run", "Current", 1e3 * CURRENT, step | {"unit_string": "mA"})
    for channels in ([volts, current], [time, volts, current]):
        with nptdms.TdmsWriter(str(tmp_path / "a.tdms")) as writer:
            writer.write_segment(channels)
        found = read_recording(tmp_path / "a.tdms")
        np.testing.assert_allclose(found.current_a, CURRENT, rtol=1e-9)
        np.testing.assert_allclose([found.voltage_v, found.time_s], [VOLTAGE, TIME], atol=1e-9)  # type: ignore[arg-type]


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
    of_matlab(path)
    assert sorted(array_parser.parse_hdf5(path.read_bytes())) == sorted(COLUMNS)
    check_same(path)
    with hdf5(path) as file:
        file["more/current_a"] = 2.0 * CURRENT
    of_matlab(path)
    check_same(path, "current=data.current_a")
    path.rename(path.with_suffix(".h5"))
    check_same(path.with_suffix(".h5"), "current=data.current_a")


@pytest.mark.parametrize(
    ("name", "content", "library"),
    [("a.xlsx", archive_of({}), "openpyxl"), ("a.mat", MATLAB_73, "h5py"), ("a.h5", b"\x89HDF", "h5py")],
)
def test_without_the_extra_it_is_named(
    name: str, content: bytes, library: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    monkeypatch.setitem(sys.modules, library, None)
    sentence = refused(lambda: read_recording(path), path, named=library)
    assert sentence.endswith("pip install 'motor-env[files]'")
