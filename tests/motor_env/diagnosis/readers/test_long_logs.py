"""Logs too long for memory: read in pieces, neighbours averaged, the liveliest stretches identified."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recording_csv import write_csv

from motor_env import ColumnChoice, InputError, Recording, read_recording

# Reaches in: which stretches of a long log are fitted is pinned without the fit.
from motor_env.diagnosis.estimation.preprocessing import from_recordings
from motor_env.diagnosis.readers import array_parser, tables, text_numbers as pieces

ROWS, RATE_HZ = 5_000, 1_000.0


def write_log(
    path: Path, rows: int = ROWS, header: str = "time_s,current_a,voltage_v,speed_rad_s"
) -> np.ndarray:
    rng = np.random.default_rng(4)
    values = rng.normal(size=(rows, 4)).round(4)
    values[:, 0] = np.arange(rows) / RATE_HZ
    write_csv(path, dict(zip(header.split(","), values.T, strict=True)), form=".4f")
    return values


@pytest.fixture
def small_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tables, "LARGEST_WHOLE_BYTES", 1_000)
    monkeypatch.setattr(pieces, "_PIECE_BYTES", 7_001)


@pytest.mark.usefixtures("small_pieces")
def test_pieces_hold_what_the_whole_holds(tmp_path: Path) -> None:
    values = write_log(tmp_path / "a.csv")
    read = read_recording(tmp_path / "a.csv")
    assert read.averaged == 1
    columns = (read.time_s, read.current_a, read.voltage_v, read.speed_rad_s)
    np.testing.assert_allclose(columns, values.T, rtol=1e-15)  # type: ignore[arg-type]  # it has all of them


@pytest.mark.usefixtures("small_pieces")
def test_neighbours_are_averaged_on_their_own_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    values = write_log(tmp_path / "a.csv")
    monkeypatch.setattr(pieces, "MOST_ROWS", 1_000)
    read = read_recording(tmp_path / "a.csv")
    n = len(read.time_s)
    assert read.averaged in (5, 6)
    means = values[: n * read.averaged].reshape(n, read.averaged, 4).mean(axis=1)
    np.testing.assert_allclose(read.time_s, means[:, 0])
    assert read.speed_rad_s is not None
    np.testing.assert_allclose(read.speed_rad_s, means[:, 3])
    assert any("averaged into one" in note for note in read.columns)
    sampled = read_recording(tmp_path / "a.csv", [ColumnChoice.sampled(RATE_HZ)])
    np.testing.assert_allclose(sampled.time_s, read.time_s)
    # A file that counts its samples, from the seventh on, says above them how far apart they are.
    values[:, 0] = np.arange(7.0, ROWS + 7.0)
    write_csv(tmp_path / "b.csv", dict(zip(("sample", "current (A)"), values.T[:2], strict=True)), form=".4f")
    (tmp_path / "b.csv").write_text(f"XIncrement,0.002\n{(tmp_path / 'b.csv').read_text()}")
    counted = read_recording(tmp_path / "b.csv")
    assert counted.averaged > 1
    middles = np.arange(len(counted.time_s)) * counted.averaged + 0.5 * (counted.averaged - 1)
    np.testing.assert_allclose(counted.time_s, 0.002 * (7.0 + middles))


@pytest.mark.usefixtures("small_pieces")
def test_a_bad_cell_far_down_is_named_by_its_line(tmp_path: Path) -> None:
    write_log(tmp_path / "a.csv")
    lines = (tmp_path / "a.csv").read_text().splitlines()
    lines[4_000] = "4.000,oops,1,1"
    (tmp_path / "a.csv").write_text("\n".join(lines) + "\n")
    with pytest.raises(InputError, match="line 4001: the column current_a must hold numbers, got 'oops'"):
        read_recording(tmp_path / "a.csv")


@pytest.mark.usefixtures("small_pieces")
def test_a_cut_off_last_line_is_left_out(tmp_path: Path) -> None:
    write_log(tmp_path / "a.csv")
    text = (tmp_path / "a.csv").read_text()
    (tmp_path / "a.csv").write_text(text[:-15])
    read = read_recording(tmp_path / "a.csv")
    assert len(read.time_s) == ROWS - 1
    assert any("cut off" in note for note in read.columns)


@pytest.mark.usefixtures("small_pieces")
def test_lines_that_end_with_returns_alone_are_not_read_in_pieces(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    write_log(path)
    lines = path.read_text().splitlines()
    path.write_text("\n".join(["logger 7", *lines]) + "\n", newline="\r\n")
    assert len(read_recording(path).time_s) == ROWS
    path.write_text("\r".join(["logger 7\nroom 4", *lines, "\n"]), newline="")
    with pytest.raises(InputError, match="is no text with lines; only plain text may be so large"):
        read_recording(path)


def test_rows_of_parquet_are_averaged_while_they_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pa, pq = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    values = np.arange(10_000.0)
    pq.write_table(pa.table({"x": values}), tmp_path / "a.parquet", row_group_size=700)
    monkeypatch.setattr(array_parser, "_MOST_ROWS", 2_000)
    monkeypatch.setattr(array_parser, "_BATCH_ROWS", 333)
    arrays, averaged = array_parser.parse_parquet(str(tmp_path / "a.parquet"))
    assert averaged == 5
    np.testing.assert_allclose(arrays["x"], values.reshape(-1, 5).mean(axis=1))
    monkeypatch.setattr(array_parser, "_MOST_READ", 9_999)
    with pytest.raises(ValueError, match="unpacks to 10,000 numbers"):
        array_parser.parse_parquet(str(tmp_path / "a.parquet"))


def test_the_liveliest_stretches_of_a_long_record_are_used() -> None:
    n = 100_000
    voltage = np.zeros(n)
    busy = (np.arange(n) % 10_000 > 6_000) & (np.arange(n) % 10_000 < 8_000)
    voltage[busy] = np.random.default_rng(1).choice([-1.0, 1.0], int(busy.sum()))
    recording = Recording(Path("x"), np.arange(n) / 1e3, np.roll(voltage, 1), voltage, voltage * 2.0)
    record = from_recordings([recording], most=10_000)
    assert record.share == pytest.approx(0.1)
    assert record.averaged == 1  # neighbours differ: their means would tell nothing
    smooth = replace(recording, current_a=np.sin(np.arange(n) / 1e3) + 0.01 * voltage)
    assert from_recordings([smooth], most=10_000).averaged == 10


@pytest.mark.long
def test_memory_does_not_grow_with_the_file(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    block = "0.1234,0.5678,1.2345\n" * 100_000
    with path.open("w") as file:
        file.write("current_a,voltage_v,speed_rad_s\n")
        for _ in range(90):
            file.write(block)
    code = (
        "import re, sys;"
        "from motor_env.diagnosis.readers.tables import read_table; from pathlib import Path;"
        "table = read_table(Path(sys.argv[1]));"
        # Not ru_maxrss: that of a child begins with its parent's.
        "peak = re.search(r'VmHWM:\\s+(\\d+)', Path('/proc/self/status').read_text())[1];"
        "print(len(table.values), table.averaged, peak)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(path)], capture_output=True, check=True, env=os.environ
    )
    rows, averaged, peak_kb = map(int, done.stdout.split())
    assert (rows, averaged) == (3_000_000, 3)
    assert peak_kb < 600_000
