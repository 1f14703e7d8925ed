"""Tables of recordings: columns and their units, samples that are missing, logs too long for memory."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hostile import Poison, refused
from recording_csv import csv_text, write_csv

from motor_env import ColumnChoice, InputError, Recording, read_recording
from motor_env.diagnosis.readers import array_parser, tables, text_numbers as pieces
from motor_env.diagnosis.readers.headers import UNITS, understand
from motor_env.diagnosis.readers.profiles import Profile, load_profile, save_profile
from motor_env.diagnosis.readers.recording import cut, describe_reading, resampled
from motor_env.diagnosis.readers.start import Circuit
from motor_env.motor.parameters import FloatArray

RPM, DEGREES = 2.0 * math.pi / 60.0, math.pi / 180.0
FACTORS = {
    "time": {
        "s": 1.0, "sec": 1.0, "second": 1.0, "seconds": 1.0, "ms": 1e-3, "millis": 1e-3, "milliseconds": 1e-3,
        "us": 1e-6, "micros": 1e-6, "microseconds": 1e-6, "ns": 1e-9, "min": 60.0,
    },
    "current": {"a": 1.0, "amp": 1.0, "amps": 1.0, "ampere": 1.0, "amperes": 1.0, "ma": 1e-3, "ua": 1e-6},
    "voltage": {"v": 1.0, "volt": 1.0, "volts": 1.0, "mv": 1e-3, "kv": 1e3},
    "speed": {
        "rad/s": 1.0, "rad_s": 1.0, "rad/sec": 1.0, "rpm": RPM, "1/min": RPM, "u/min": RPM, "min-1": RPM,
        "deg/s": DEGREES, "deg_s": DEGREES, "°/s": DEGREES,
    },
    "duty": {"1": 1.0, "%": 0.01, "percent": 0.01},
}  # fmt: skip


@pytest.mark.parametrize("quantity", list(FACTORS))
def test_each_unit_has_its_factor(quantity: str) -> None:
    assert set(UNITS[quantity]) == set(FACTORS[quantity])
    name = "t" if quantity == "time" else quantity
    for unit, factor in FACTORS[quantity].items():
        for header in (f"{name} [{unit}]", f"{name} ({unit.upper()})"):
            meaning = understand(header)
            assert meaning.quantity == quantity, header
            assert meaning.factor == pytest.approx(factor, rel=1e-12), header


@pytest.mark.parametrize(
    ("header", "quantity", "factor", "unit"),
    [
        ("I / mA", "current", 1e-3, "mA"),
        ("motor_current_ma", "current", 1e-3, "ma"),
        ("time_s", "time", 1.0, "s"),
        ("CH2 (V)", "voltage", 1.0, "V"),
        ("t [µs]", "time", 1e-6, "µs"),
        ("duty", "duty", 1.0, ""),
        ("Commanded voltage [V]", "voltage", 1.0, "V"),
        ("U_shunt [A]", "current", 1.0, "A"),  # a letter counts less than a unit
        ("T_case", None, 1.0, ""),
        ("sample", None, 1.0, "sequence"),
        ("duration min", None, 1.0, ""),
        ("Current in V", None, 1.0, "V"),
        ("Current setpoint [A]", None, 1.0, "A"),
        ("Gyro x [deg/s]", None, DEGREES, "deg/s"),
    ],
)
def test_a_header_says_quantity_and_unit(header: str, quantity: str | None, factor: float, unit: str) -> None:
    found = understand(header)
    assert (found.quantity, found.unit) == (quantity, unit)
    assert found.factor == pytest.approx(factor)


PLACES = np.arange(40.0)
WAVE = 1.5 + np.sin(PLACES)
BACK = WAVE[::-1]
TIME = 1e-3 * PLACES


def table(path: Path, header: str, *columns: FloatArray, above: str = "") -> Path:
    path.write_text(above + csv_text(dict(zip(header.split(","), columns, strict=True)), form=".9g"))
    return path


def chosen(path: Path, *options: str) -> Recording:
    return read_recording(path, [ColumnChoice.parse(option) for option in options])


def test_columns_become_si(tmp_path: Path) -> None:
    header = "t (ms),I [mA],U (kV),n [1/min],duty (%)"
    columns = (2.0 * PLACES + 5.0, 1e3 * WAVE, 1e-3 * BACK, 60.0 * BACK, 50.0 + PLACES)
    read = read_recording(table(tmp_path / "a.csv", header, *columns))
    found = (read.time_s, read.current_a, read.voltage_v, read.speed_rad_s, read.duty)
    expected = (5e-3 + 2e-3 * PLACES, WAVE, BACK, 2.0 * math.pi * BACK, 0.5 + 0.01 * PLACES)
    np.testing.assert_allclose(found, expected)  # type: ignore[arg-type]  # it has all of them
    assert read.dt_s == pytest.approx(2e-3)
    assert f"40 samples at 500 Hz, current {WAVE.min():.4g} to {WAVE.max():.4g} A" in read.columns[-1]


@pytest.mark.parametrize(
    ("choice", "factor", "offset"),
    [
        ("current=CH:mA", 1e-3, 0.0),
        ("current=CH*10", 10.0, 0.0),
        ("current=CH*-2.5e1-0.05", -25.0, -0.05),
        ("current=2:mV*10", 1e-2, 0.0),
    ],
)
def test_scales_and_offsets_of_a_named_column(
    choice: str, factor: float, offset: float, tmp_path: Path
) -> None:
    read = chosen(table(tmp_path / "a.csv", "time_s,CH", TIME, WAVE), choice)
    np.testing.assert_allclose(read.current_a, factor * WAVE + offset)


@pytest.mark.parametrize(
    ("option", "sentence"),
    [
        ("current=CH9", "there is no column CH9"),
        ("voltage=current_a*12", "the column current_a is missing, found 'time_s', 'current_a'"),
    ],
)
def test_a_choice_that_leaves_no_current_is_refused(option: str, sentence: str, tmp_path: Path) -> None:
    path = table(tmp_path / "a.csv", "time_s,current_a", TIME, WAVE)
    assert sentence in refused(lambda: chosen(path, option), path)


@pytest.mark.parametrize("option", ["bench", "current=CH2/0", "current=CH2/-0e5"])
def test_what_is_no_choice_of_a_column_is_named(option: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--column must read QUANTITY=COLUMN"):
        ColumnChoice.parse(option)
    (tmp_path / "p.toml").write_text(f'column = ["{option}"]')
    with pytest.raises(InputError, match=r"p\.toml: --column must read QUANTITY=COLUMN"):
        load_profile(tmp_path / "p.toml")


@pytest.mark.parametrize(
    ("setting", "dt_s"),
    [
        ("Sample Rate,2500", 1 / 2500),
        ("Sample Rate,0.5 MSa/s", 2e-6),
        ("Sample Interval,4ms", 0.004),
        ("Sample Interval,40µs", 4e-5),
        ("Sample Interval,400ns", 4e-7),
        ("#CLOCK=0.002S", 0.002),
        ("Sampling period: 3 ms", 0.003),
        ("XIncrement,5e-4", 5e-4),
    ],
)
def test_intervals_as_instruments_say_them(setting: str, dt_s: float, tmp_path: Path) -> None:
    path = table(tmp_path / "a.csv", "current (A),voltage (V)", WAVE, 12.0 * BACK, above=f"{setting}\n")
    read = read_recording(path)
    assert (float(read.time_s[0]), read.dt_s) == pytest.approx((0.0, dt_s), rel=1e-9)


def test_a_count_of_samples_begins_where_the_settings_say(tmp_path: Path) -> None:
    above, path = "XStart,-0.25\nXIncrement,0.01\n", tmp_path / "a.csv"
    table(path, "sample,current (A)", PLACES + 3.0, WAVE, above=above)
    np.testing.assert_allclose(read_recording(path).time_s, -0.25 + 0.01 * (PLACES + 3.0))
    table(path, "sample,current (A)", np.where(PLACES < 20, PLACES, PLACES + 1), WAVE, above=above)
    with pytest.raises(InputError, match="line 24: the column sample must count by one, got 21 after 19"):
        read_recording(path)
    table(path, "current (A)", WAVE, above="Sample Rate,100\nRecord Length,41\n")
    with pytest.raises(InputError, match="holds 40 rows and says that there are 41"):
        read_recording(path)


@pytest.mark.parametrize(
    ("time", "current", "words"),
    [
        (PLACES[:19], WAVE[:19], "at least 20 samples, got 19"),
        (1e-11 * PLACES, WAVE, "are no recording of a motor"),
        (1e5 * PLACES, WAVE, "are no recording of a motor"),
        (TIME, 1e-300 * WAVE, "is no reading of a motor"),
        (TIME, -2e3 * WAVE, "A, which is no reading"),
    ],
)
def test_what_is_no_recording_of_a_motor_is_refused(
    time: FloatArray, current: FloatArray, words: str, tmp_path: Path
) -> None:
    np.savez(tmp_path / "a.npz", time_s=time, current_a=current)
    assert words in refused(lambda: read_recording(tmp_path / "a.npz"), tmp_path / "a.npz")


SPEED = 100.0 * TIME
SCOPE = csv_text({"X-axis": TIME, "CH1": WAVE}, form=".6f").split("\n", 1)
TEXTS = {
    "semicolons, decimal commas and units": csv_text(
        {"Zeit (ms)": 1e3 * TIME, "Strom (mA)": 1e3 * WAVE, "Drehzahl (rpm)": SPEED / RPM},
        form=".4f", mark=";", decimal=",",
    ),
    "a scope with a preamble and a row of units":
        f"Model,X1\nDate,today\nTime Base,1 ms\n\n{SCOPE[0]}\ns,A\n{SCOPE[1]}",
    "a scope with its settings beside the data": "\n".join(
        (f"Setting {n},{n}," if n < 15 else ",,") + f"Points,{row}" for n, row in enumerate(SCOPE[1].splitlines())
    ),
    "tabs, micro signs and old code pages":
        csv_text({"Time [µs]": 1e6 * TIME, "Current [mA]": 1e3 * WAVE}, form=".4f", mark="\t"),
}  # fmt: skip


@pytest.mark.parametrize("name", TEXTS)
def test_text(name: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_bytes(TEXTS[name].encode("cp1252" if "code pages" in name else "utf-8"))
    found = read_recording(tmp_path / "a.csv")
    np.testing.assert_allclose([found.time_s, found.current_a], [TIME, WAVE], atol=1e-4)
    if found.speed_rad_s is not None:
        np.testing.assert_allclose(found.speed_rad_s, SPEED, atol=1e-3)


def test_a_pickle_in_a_numpy_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.npy"
    held: list[object] = [{}, Poison(tmp_path / "mark")]
    for one in held:
        np.save(path, np.array([one], dtype=object), allow_pickle=True)
        assert "is not a NumPy file that can be read" in refused(lambda: read_recording(path), path)
    assert not (tmp_path / "mark").exists()


def test_files_that_were_read_in_different_ways_are_told_apart() -> None:
    files = [(Path(f"{n}.csv"), (f"current is column {n // 2}", f"{n} samples")) for n in range(9)]
    assert describe_reading(files[:2]) == ["  read: current is column 0"]
    first, *_, last = describe_reading(files)
    assert (first, last) == (
        "  read: 0.csv and 1 more: current is column 0",
        "  read: other files in 2 more ways",
    )


def test_what_contradicts_the_header_is_warned_of(tmp_path: Path) -> None:
    clamp = np.rint(300.0 * WAVE)
    columns = {"time_s": TIME, "CLAMP (mV)": clamp, "T_case": 20.0 + PLACES % 2}
    path = write_csv(tmp_path / "a.csv", columns, form=".6g")
    (sentence,) = chosen(path, "current=CLAMP:A").warnings
    assert "the header of column CLAMP (mV) says mV, and --column says A" in sentence
    assert f"gives a current of {clamp.max():.4g} A" in sentence
    assert chosen(path, "current=CLAMP*10").warnings == ()
    assert "not used: T_case" in chosen(path, "current=CLAMP*10").columns
    path.write_text(path.read_text(encoding="utf-8").replace(" (mV)", ""), encoding="utf-8")
    assert "whole numbers, as a converter's counts" in chosen(path, "current=CLAMP:A").warnings[0]
    assert chosen(path, "current=CLAMP:mA").warnings == ()


def test_a_profile_is_kept_and_what_is_said_counts_more(tmp_path: Path) -> None:
    kept = Profile(("current=CH1:mA", "voltage=none"), 5e3, 12.0, 0.25, 1e-4)
    (tmp_path / "log.csv").write_text("time_s,current_a\n")
    with pytest.raises(InputError, match=r"log\.csv: "):
        save_profile(kept, tmp_path / "log.csv")
    for _ in range(2):
        save_profile(kept, tmp_path / "p.toml")
        assert load_profile(tmp_path / "p.toml") == kept
    over = Profile(("current=CH2*10",), voltage=24.0).over(kept)
    assert over == Profile(("voltage=none", "current=CH2*10"), 5e3, 24.0, 0.25, 1e-4)
    options = kept.options
    assert (options["voltage_v"], options["circuit"]) == (12.0, Circuit(0.25, 1e-4))
    assert [choice.quantity for choice in options["columns"]] == ["current", "voltage", "time"]
    assert options["columns"][2].sampling_rate_hz == 5e3
    assert Profile().options == {"voltage_v": None, "columns": [], "circuit": Circuit(0.0, 0.0)}


@pytest.mark.parametrize("gone", [[10, 11, 12], list(range(5, 40, 10)), [1, 38]])
def test_samples_that_a_clock_left_out_are_missing(gone: list[int]) -> None:
    time = np.delete(PLACES, gone)
    even, values, notes = resampled(0.5 * time, {"current": WAVE[time.astype(int)]})
    np.testing.assert_allclose(even, 0.5 * PLACES)
    np.testing.assert_array_equal(values["current"], np.where(np.isin(PLACES, gone), np.nan, WAVE))
    assert notes == (
        f"{40 - len(gone)} samples, most of them 0.5 s apart: what lies between others counts as missing",
    )


@pytest.mark.parametrize(
    ("steps", "places"),
    [
        ([1.0] * 8 + [1.4] * 3 + [1.0] * 8, [*range(9), 11, *range(13, 21)]),
        ([1.0] * 8 + [7.04] * 3 + [1.0] * 8, [*range(9), 15, 22, *range(29, 38)]),
        ([1.0] * 8 + [0.5] * 4 + [1.0] * 8, [*range(9), 10, *range(12, 19)]),
        ([1.0] * 8 + [0.1] + [1.0] * 8, [*range(9), *range(10, 17)]),
    ],
)
def test_intervals_of_another_length_have_a_hole_in_them(steps: list[float], places: list[int]) -> None:
    """And no sample is further from its time than an interval."""
    time = np.append(0.0, np.cumsum(steps))
    even, values, _ = resampled(time, {"time": time, "speed": np.ones(len(time))})
    there = np.flatnonzero(np.isfinite(values["speed"]))
    np.testing.assert_allclose(np.diff(even), 1.0)
    assert there.tolist() == places
    assert np.abs(values["time"] - even)[there].max() <= 1.0
    alike = np.diff(there) == 1
    np.testing.assert_allclose(np.diff(values["time"][there])[alike], 1.0)


JITTER = np.random.default_rng(1).uniform(-0.3, 0.3, 40)


@pytest.mark.parametrize(
    "time", [np.round(PLACES * 4.0 / 3.0), PLACES + JITTER, PLACES + 0.004 * PLACES**2], ids=str
)
def test_times_that_were_rounded_that_jitter_or_drift_have_no_holes(time: np.ndarray) -> None:
    even, values, _ = resampled(time, {"current": np.interp(time, PLACES, WAVE)})
    np.testing.assert_allclose(values["current"], np.interp(even, time, np.interp(time, PLACES, WAVE)))


def written(path: Path, header: str, rows: list[str]) -> Path:
    path.write_text("\n".join([header, *rows, ""]))
    return path


def lost(recording: Recording) -> list[list[int]]:
    """Samples that are missing of voltage, current and speed."""
    assert recording.missing is not None
    return [np.flatnonzero(channel).tolist() for channel in recording.missing.T]


def test_empty_cells_and_nan_are_missing_samples(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    cells = [[f"{value:.6f}" for value in (0.01 * n, 5.0, rng.random(), 7.0 + n)] for n in range(40)]
    cells[4][1], cells[5][2], cells[6][3], cells[8] = "", "nan", " NaN ", ["nan"] * 4
    rows = [",".join(row) for row in cells]
    found = read_recording(written(tmp_path / "a.csv", "time_s,voltage_v,current_a,speed_rad_s", rows))
    assert lost(found) == [[4, 8], [5, 8], [6, 8]]
    shown = np.array([found.voltage_v, found.current_a, found.speed_rad_s])
    assert np.isfinite(shown).all()
    assert shown[2, 6] == pytest.approx(13.0)
    assert any("current is column 3 (current_a), 2 of 40 values missing" in note for note in found.columns)
    assert cut(found, slice(5, 9)).missing is not None


def test_a_line_without_a_time_is_missing_wherever_it_stands(tmp_path: Path) -> None:
    rows = ["nan,5.0" if n in (0, 1, 7, 39) else f"{0.01 * n},{value}" for n, value in enumerate(WAVE)]
    found = read_recording(written(tmp_path / "a.csv", "time_s,current_a", rows))
    np.testing.assert_allclose(found.time_s, 0.01 * PLACES, atol=1e-12)
    assert lost(found)[1] == [0, 1, 7, 39]
    path = written(tmp_path / "a.csv", "time_s,current_a", [f"{n},nan" for n in range(40)])
    with pytest.raises(InputError, match=r"the current \(column 2 \(current_a\)\) has no value"):
        read_recording(path)


def test_blank_lines_and_short_ones_are_no_missing_samples(tmp_path: Path) -> None:
    rows = [f"{0.01 * n:.2f};{value};{value}" for n, value in enumerate(WAVE)]
    rows[5], header = "0.05;;1", "time_s;current_a;speed_rad_s"
    found = read_recording(written(tmp_path / "a.csv", header, [*rows[:20], "", *rows[20:]]))
    assert len(found.time_s) == 40
    assert lost(found)[1:] == [[5], []]
    path = written(tmp_path / "a.csv", header, [*rows[:20], "0.2;1", *rows[21:]])
    with pytest.raises(InputError, match="line 22: the column speed_rad_s has no value"):
        read_recording(path)


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
def test_a_cut_off_last_line_is_left_out(tmp_path: Path) -> None:
    write_log(tmp_path / "a.csv")
    text = (tmp_path / "a.csv").read_text()
    (tmp_path / "a.csv").write_text(text[:-15])
    read = read_recording(tmp_path / "a.csv")
    assert len(read.time_s) == ROWS - 1
    assert any("cut off" in note for note in read.columns)


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
