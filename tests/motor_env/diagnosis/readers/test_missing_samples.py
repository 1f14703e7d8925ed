"""Samples that are missing: lines that are not there, empty cells, clocks that change their rate."""

from pathlib import Path

import numpy as np
import pytest

from motor_env import InputError, Recording, read_recording
from motor_env.diagnosis.readers.alignment import align
from motor_env.diagnosis.readers.recording import cut, resampled

PLACES = np.arange(40.0)
WAVE = 1.5 + np.sin(PLACES)


@pytest.mark.parametrize("gone", [[10, 11, 12], [19, 20], list(range(5, 40, 10)), [1, 38]])
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


def test_what_looks_like_holes_and_is_none() -> None:
    """Times that were rounded, that jitter, and those of a clock that drifts; a clock that jitters may have holes."""
    rounded = np.round(PLACES * 4.0 / 3.0)
    even, values, _ = resampled(rounded, {"current": WAVE})
    assert len(even) == 40
    assert np.isfinite(values["current"]).all()
    jitter = np.random.default_rng(1).uniform(-0.3, 0.3, 40)
    assert np.isfinite(resampled(PLACES + jitter, {"current": WAVE})[1]["current"]).all()
    some = np.delete(PLACES + jitter, range(20, 25))
    even, values, _ = resampled(some, {"time": some})
    inside = (even > some[19]) & (even < some[20])
    np.testing.assert_array_equal(np.isnan(values["time"]), inside)
    drifting = PLACES + 0.004 * PLACES**2
    assert np.isfinite(resampled(drifting, {"current": WAVE})[1]["current"]).all()


def test_the_interval_of_before_counts_for_a_stream_that_changes_its_rate() -> None:
    columns = {"current": WAVE}
    assert resampled(1.25 * PLACES, columns)[1] is columns
    assert resampled(1.25 * PLACES, columns, 1.1)[1] is columns
    even, values, _ = resampled(1.25 * PLACES, columns, 1.0)
    np.testing.assert_allclose(np.diff(even), 1.0)
    known = np.flatnonzero(np.isfinite(values["current"]))
    assert (np.diff(known) > 1).all()
    time = np.append(PLACES, 39.0 + 1.3 * np.arange(1.0, 60.0))
    even, _, _ = resampled(time, {"current": time}, 1.0)
    np.testing.assert_allclose(np.diff(even), 1.0)


def test_empty_cells_and_nan_are_missing_samples(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    rows = [[f"{value:.6f}" for value in (0.01 * n, 5.0, rng.random(), 7.0 + n)] for n in range(40)]
    rows[4][1], rows[5][2], rows[6][3], rows[8] = "", "nan", " NaN ", ["nan"] * 4
    path = tmp_path / "a.csv"
    path.write_text("\n".join(["time_s,voltage_v,current_a,speed_rad_s", *map(",".join, rows)]))
    found = read_recording(path)
    assert found.missing is not None
    assert [np.flatnonzero(lost).tolist() for lost in found.missing.T] == [[4, 8], [5, 8], [6, 8]]
    assert found.voltage_v is not None
    assert found.speed_rad_s is not None
    assert all(np.isfinite(values).all() for values in (found.voltage_v, found.current_a, found.speed_rad_s))
    assert found.speed_rad_s[6] == pytest.approx(13.0)
    assert any("current is column 3 (current_a), 2 of 40 values missing" in note for note in found.columns)
    assert cut(found, slice(5, 9)).missing is not None


def test_a_line_without_a_time_is_missing_wherever_it_stands(tmp_path: Path) -> None:
    rows = [f"{0.01 * n},{value}" for n, value in enumerate(WAVE)]
    for n in (0, 1, 7, 39):
        rows[n] = "nan,5.0"
    path = tmp_path / "a.csv"
    path.write_text("\n".join(["time_s,current_a", *rows, ""]))
    found = read_recording(path)
    np.testing.assert_allclose(found.time_s, 0.01 * PLACES, atol=1e-12)
    assert found.missing is not None
    assert np.flatnonzero(found.missing[:, 1]).tolist() == [0, 1, 7, 39]
    path.write_text("\n".join(["time_s,current_a", *(f"{n},nan" for n in range(40)), ""]))
    with pytest.raises(InputError, match=r"the current \(column 2 \(current_a\)\) has no value"):
        read_recording(path)


def test_blank_lines_and_short_ones_are_no_missing_samples(tmp_path: Path) -> None:
    rows = [f"{0.01 * n:.2f};{value};{value}" for n, value in enumerate(WAVE)]
    rows[5] = "0.05;;1"
    path = tmp_path / "a.csv"
    path.write_text("\n".join(["time_s;current_a;speed_rad_s", *rows[:20], "", *rows[20:], ""]))
    found = read_recording(path)
    assert len(found.time_s) == 40
    assert found.missing is not None
    assert found.missing.sum() == 1
    path.write_text("\n".join(["time_s;current_a;speed_rad_s", *rows[:20], "0.2;1", *rows[21:], ""]))
    with pytest.raises(InputError, match="line 22: the column speed_rad_s has no value"):
        read_recording(path)


def test_counts_stay_counts_where_one_is_missing(tmp_path: Path) -> None:
    current = np.round(100.0 * np.abs(np.random.default_rng(2).standard_normal(200)))
    rows = [f"{0.01 * n:.2f},{'' if n == 50 else int(value)}" for n, value in enumerate(current)]
    path = tmp_path / "a.csv"
    path.write_text("\n".join(["time_s,current", *rows]))
    with pytest.raises(InputError, match="holds whole numbers, and no unit is stated"):
        read_recording(path)


def test_what_fills_a_hole_is_no_step_of_the_converter() -> None:
    """Halfway between two of its steps lies none of its readings."""
    current = np.round(4.0 * np.exp(-np.arange(400.0) / 80.0) / 0.05) * 0.05
    current = np.append(np.zeros(100), current)
    holed = current.copy()
    holed[np.flatnonzero(np.diff(current[100:]) < 0.0)[::3] + 100] = np.nan
    filled = Recording(Path("x"), 1e-3 * np.arange(500.0), holed)
    assert np.unique(np.abs(np.diff(filled.current_a)).round(6))[1] < 0.03
    assert align(filled).quantum_a == pytest.approx(0.05)


def test_a_column_without_a_value_is_filled_with_zeros() -> None:
    found = Recording(Path("x"), PLACES, WAVE, speed_rad_s=np.full(40, np.nan))
    assert found.speed_rad_s is not None
    assert not found.speed_rad_s.any()
    assert found.missing is not None
    assert found.missing[:, 2].all()
    assert Recording(Path("x"), PLACES, WAVE).missing is None
