"""Files of strangers: damaged, endless, enormous, oddly named. Each is read right, or refused in a sentence."""

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
from hostile import archive_of, damaged, odd_places, refused, refused_or_same
from recording_bytes import bytes_of
from scipy.io import savemat

from motor_env import InputError, Recording, cli, read_recording
from motor_env.diagnosis.readers import array_parser, tables, text_numbers as pieces
from motor_env.diagnosis.readers.start import chosen_starts, split_starts
from motor_env.motor.parameters import FloatArray

EXAMPLES = Path(__file__).parents[4] / "examples"
TIME = np.linspace(0.0, 0.0399, 400)
CURRENT: FloatArray = 3.0 * np.exp(-TIME / 0.01) + 0.1
VOLTAGE = np.where(TIME > 0.005, 12.0, 0.0)


COLUMNS: dict[str, Any] = {"time_s": TIME, "current_a": CURRENT, "voltage_v": VOLTAGE}


@pytest.mark.parametrize(
    ("kind", "count"),
    [("csv", 60), ("npz", 60), ("npy", 60), ("mat", 3), ("parquet", 3), ("h5", 3), ("xlsx", 3)],
)
def test_mutated_files_are_read_or_refused(kind: str, count: int, tmp_path: Path) -> None:
    """Each is read to finite columns of one length, or refused in one line."""
    content, rng = bytes_of(kind, COLUMNS), np.random.default_rng([1, len(kind)])
    path = tmp_path / f"a.{kind}"

    def same(recording: Recording) -> None:
        arrays = [a for a in (recording.current_a, recording.voltage_v) if a is not None]
        assert {len(a) for a in arrays} == {len(recording.time_s)}
        assert all(np.isfinite(a).all() for a in (recording.time_s, *arrays))
        if kind in ("npz", "mat", "xlsx"):  # their checksums tell every change; the others have none
            assert recording.voltage_v is not None
            np.testing.assert_allclose(arrays, [CURRENT, VOLTAGE], rtol=1e-15, strict=True)

    for _ in range(count):
        path.write_bytes(damaged(content, rng, most=3))
        refused_or_same(lambda: read_recording(path), path, same)


def test_a_signalling_nan_is_a_missing_sample(tmp_path: Path) -> None:
    """Whatever arithmetic says of it: damage can make one of a number."""
    current = 3.0 * np.random.default_rng(1).random(1000)
    current.view(np.uint64)[500] = 0x7FF0_0000_0000_0001
    np.save(tmp_path / "a.npy", np.stack([1e-3 * np.arange(1000.0), current], axis=1))
    found = read_recording(tmp_path / "a.npy").current_a
    assert found[500] == pytest.approx(np.mean(current[[499, 501]]))


def test_a_crash_of_the_parser_is_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Some damaged MATLAB files end the process that parses them."""
    crashing = tmp_path / "crashing.py"
    crashing.write_text("import os, signal\nos.kill(os.getpid(), signal.SIGSEGV)\n")
    monkeypatch.setattr(array_parser, "__file__", str(crashing))
    path = tmp_path / "a.mat"
    path.write_bytes(bytes_of("mat", COLUMNS))
    assert "its parser crashed" in refused(lambda: read_recording(path), path)


def test_a_smaller_limit_of_memory_is_kept(tmp_path: Path) -> None:
    """A user's own limit cannot be raised by the parser's."""
    path = tmp_path / "a.mat"
    path.write_bytes(bytes_of("mat", COLUMNS))
    code = (
        "import resource\nfrom motor_env import read_recording\n"
        "resource.setrlimit(resource.RLIMIT_DATA, (10**9, 10**9))\n"
        f"read_recording({str(path)!r})"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_odd_names_cost_no_verdict(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capture = (EXAMPLES / "startup_capture.csv").read_bytes()
    folder = tmp_path / "cap["
    folder.mkdir()
    odd = Path(os.fsdecode(os.fsencode(folder) + b"/\x1b[31mb]$_$\xff.csv"))
    names = [odd, tmp_path / ("n" * 240 + ".csv")]
    for name in names:
        name.write_bytes(capture)
    empty, commas = tmp_path / "bom.csv", tmp_path / "commas.csv"
    empty.write_bytes(b"\xef\xbb\xbf")
    commas.write_bytes(b"," * 5_000_000)
    batch = [str(name) for name in (*names, empty, commas)]
    options = ["--motor", str(EXAMPLES / "motor.toml"), "--out", str(tmp_path / "out")]
    assert cli.main(["diagnose", *batch, *options]) == 2
    printed = capsys.readouterr()
    assert printed.out.count("bearing +") == len(names)
    assert "\x1b" not in printed.out + printed.err
    assert printed.err.count("holds no table of numbers") == 2
    assert len(list((tmp_path / "out").iterdir())) == len(names)
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


def test_noise_after_a_short_inrush_is_no_start() -> None:
    """A healthy start without a voltage, recorded long after its inrush is over."""
    time_s = np.linspace(0.0, 20.0, 200_000, endpoint=False)
    since = np.maximum(time_s - 0.05, 0.0)
    current: FloatArray = 5.0 * (np.exp(-since / 0.004) - np.exp(-since / 0.0005)) + 0.1 * (time_s > 0.05)
    noise: FloatArray = 0.05 * np.random.default_rng(3).standard_normal(len(time_s))
    assert len(split_starts(Recording(Path("long"), time_s, current + noise))) == 1


def test_a_sine_is_not_a_thousand_starts() -> None:
    time_s = np.linspace(0.0, 20.0, 200_000, endpoint=False)
    sine = Recording(Path("sine"), time_s, np.sin(2.0 * np.pi * 12.0 * time_s))
    with pytest.raises(InputError, match="at most 200 starts"):
        chosen_starts(sine)
    assert len(chosen_starts(sine, 3)) == 1


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


def test_a_member_of_an_archive_that_is_no_array_is_left_out(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    np.savez(path, **COLUMNS)
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("notes.txt", "of a motor")
    np.testing.assert_array_equal(read_recording(path).current_a, CURRENT)


@pytest.mark.parametrize("kind", ["npz", "mat"])
def test_a_voltage_one_sample_short_is_not_lost_in_silence(kind: str, tmp_path: Path) -> None:
    columns, path = COLUMNS | {"voltage_v": VOLTAGE[:-1]}, tmp_path / f"a.{kind}"
    if kind == "npz":
        np.savez(path, **columns)
    else:
        savemat(path, columns)
    sentence = refused(lambda: read_recording(path), path)
    assert "voltage_v has 399 values where the others have 400" in sentence


def lzma_archive(path: Path) -> None:
    data = bytearray(archive_of({"time_s.npy": bytes_of("npy", COLUMNS)}, zipfile.ZIP_LZMA))
    data[60:200] = bytes(140)
    path.write_bytes(data)


def large_matrix(path: Path) -> None:
    zeros = np.zeros((array_parser.MOST_NUMBERS // 1000 + 1, 1000), dtype=np.uint8)
    savemat(path, {"zeros": zeros}, do_compression=True)


def written(values: FloatArray, current: FloatArray) -> Callable[[Path], None]:
    return lambda path: np.savez(path, time_s=values, current_a=current)


@pytest.mark.parametrize(
    ("name", "make", "sentence"),
    [
        ("a.npz", lzma_archive, "is not a NumPy file"),
        ("a.mat", large_matrix, "unpacks to"),
        ("a.npz", written(TIME * 1e-310, CURRENT), "are no recording of a motor"),
        ("a.npz", written(TIME, CURRENT * 1e-300), "is no reading of a motor"),
        ("a.npz", written(TIME, CURRENT * 1e300), "is no reading of a motor"),
        ("a.csv", lambda path: path.write_text("1," * 5_000 + "\n"), "at most 1000 can be read"),
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


def test_an_archive_that_unpacks_to_too_much_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.npz"
    path.write_bytes(bytes_of("npz", {"current_a": np.zeros(9_999)}))
    monkeypatch.setattr(array_parser.check_count, "__defaults__", (9_999,))
    assert "unpacks to 10,015 numbers; at most 9,999 are read" in refused(lambda: read_recording(path), path)


def test_a_file_larger_than_what_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.csv"
    path.write_bytes(bytes_of("csv", COLUMNS))
    monkeypatch.setattr(tables._content, "__defaults__", (10_000,))
    assert "is larger than" in refused(lambda: read_recording(path), path)


def test_plain_rows_are_parsed_at_once_and_like_cell_by_cell(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain, slow = tmp_path / "plain.csv", tmp_path / "slow.csv"
    plain.write_bytes(bytes_of("csv", COLUMNS))
    slow.write_text(plain.read_text().replace("\n", "\n \n"))
    expected = read_recording(slow)
    monkeypatch.setattr(pieces, "_numbers_cell_by_cell", None)
    found = read_recording(plain)
    np.testing.assert_array_equal(found.current_a, expected.current_a)
    np.testing.assert_array_equal(found.current_a, CURRENT)
