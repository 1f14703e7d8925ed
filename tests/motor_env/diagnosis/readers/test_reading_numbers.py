"""What is read, number by number: units, scales, intervals, onsets, noises, borders, cuts at exact samples."""

from __future__ import annotations

import math
import subprocess
import sys
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from motor_env import ColumnChoice, InputError, Recording, read_recording
from motor_env.diagnosis.readers import array_parser
from motor_env.diagnosis.readers.alignment import align
from motor_env.diagnosis.readers.headers import UNITS, understand
from motor_env.diagnosis.readers.noise import (
    PeriodicLine,
    difference_noise,
    line_share,
    outlier_samples,
    over_angle,
    periodic_lines,
    quantisation_bias,
    without_outliers,
)
from motor_env.diagnosis.readers.profiles import Profile, load_profile, save_profile
from motor_env.diagnosis.readers.recording import UnusableError, resampled
from motor_env.diagnosis.readers.regime import changes, gaps_s, operation_evidence, refuse_aliased, slow_rises
from motor_env.diagnosis.readers.start import Circuit, chosen_starts, mean_tail, prepare, split_starts
from motor_env.motor.parameters import FloatArray

RPM = 2.0 * math.pi / 60.0
FACTORS = {
    "time": {
        "s": 1.0, "sec": 1.0, "second": 1.0, "seconds": 1.0, "ms": 1e-3, "millis": 1e-3, "milliseconds": 1e-3,
        "us": 1e-6, "micros": 1e-6, "microseconds": 1e-6, "ns": 1e-9, "min": 60.0,
    },
    "current": {"a": 1.0, "amp": 1.0, "amps": 1.0, "ampere": 1.0, "amperes": 1.0, "ma": 1e-3, "ua": 1e-6},
    "voltage": {"v": 1.0, "volt": 1.0, "volts": 1.0, "mv": 1e-3, "kv": 1e3},
    "speed": {
        "rad/s": 1.0, "rad_s": 1.0, "rad/sec": 1.0, "rpm": RPM, "1/min": RPM, "u/min": RPM, "min-1": RPM,
        "deg/s": math.pi / 180.0, "deg_s": math.pi / 180.0, "°/s": math.pi / 180.0,
    },
    "duty": {"1": 1.0, "%": 0.01, "percent": 0.01},
}  # fmt: skip
NAMES = {"time": "t", "current": "current", "voltage": "voltage", "speed": "speed", "duty": "duty"}


@pytest.mark.parametrize("quantity", list(FACTORS))
def test_each_unit_has_its_factor(quantity: str) -> None:
    assert set(UNITS[quantity]) == set(FACTORS[quantity])
    for unit, factor in FACTORS[quantity].items():
        for header in (f"{NAMES[quantity]} [{unit}]", f"{NAMES[quantity]} ({unit.upper()})"):
            meaning = understand(header)
            assert meaning.quantity == quantity, header
            assert meaning.factor == pytest.approx(factor, rel=1e-12), header


@pytest.mark.parametrize(
    ("header", "quantity", "factor", "unit"),
    [
        ("I / mA", "current", 1e-3, "mA"),
        ("U/kV", "voltage", 1e3, "kV"),
        ("motor_current_ma", "current", 1e-3, "ma"),
        ("rpm", "speed", RPM, "rpm"),
        ("time_s", "time", 1.0, "s"),
        ("t_us", "time", 1e-6, "us"),
        ("speed_rad_s", "speed", 1.0, "rad_s"),
        ("Speed in deg/s", "speed", math.pi / 180.0, "deg/s"),
        ("CH2 (V)", "voltage", 1.0, "V"),
        ("duty", "duty", 1.0, ""),
        ("temperature", None, 1.0, ""),
        ("t [µs]", "time", 1e-6, "µs"),
        ("Current in V", None, 1.0, "V"),
        ("ms", "time", 1e-3, "ms"),
        ("sample", None, 1.0, "sequence"),
        ("duration min", None, 1.0, ""),
        ("T_case", None, 1.0, ""),
        ("v", "voltage", 1.0, ""),
        ("tacho [V]", None, 1.0, "V"),
        ("Current sense [mV]", None, 1e-3, "mV"),
        ("Gyro x [deg/s]", None, math.pi / 180.0, "deg/s"),
        ("Current setpoint [A]", None, 1.0, "A"),
        ("Target speed [rpm]", None, RPM, "rpm"),
        ("Commanded voltage [V]", "voltage", 1.0, "V"),
        ("U_shunt [A]", "current", 1.0, "A"),  # a letter counts less than a unit
        ("Motor current left [A]", "current", 1.0, "A"),
    ],
)
def test_a_header_says_quantity_and_unit(header: str, quantity: str | None, factor: float, unit: str) -> None:
    found = understand(header)
    assert (found.quantity, found.unit) == (quantity, unit)
    assert found.factor == pytest.approx(factor)


def table(path: Path, header: str, columns: list[FloatArray], preamble: str = "") -> Path:
    rows = "\n".join(",".join(f"{value:.9g}" for value in row) for row in zip(*columns, strict=True))
    path.write_text(f"{preamble}{header}\n{rows}\n")
    return path


PLACES = np.arange(40.0)
WAVE = 1.5 + np.sin(PLACES)
BACK = WAVE[::-1]


def test_columns_become_si(tmp_path: Path) -> None:
    path = table(
        tmp_path / "a.csv",
        "t (ms),I [mA],U (kV),n [1/min],duty (%)",
        [2.0 * PLACES + 5.0, 1e3 * WAVE, 1e-3 * BACK, 60.0 * BACK, 50.0 + PLACES],
    )
    read = read_recording(path)
    np.testing.assert_allclose(read.time_s, 5e-3 + 2e-3 * PLACES)
    assert read.dt_s == pytest.approx(2e-3)
    np.testing.assert_allclose(read.current_a, WAVE)
    np.testing.assert_allclose(read.voltage_v, BACK)  # type: ignore[arg-type]  # it has one
    np.testing.assert_allclose(read.speed_rad_s, 2.0 * math.pi * BACK)  # type: ignore[arg-type]
    np.testing.assert_allclose(read.duty, 0.5 + 0.01 * PLACES)  # type: ignore[arg-type]
    assert f"40 samples at 500 Hz, current {WAVE.min():.4g} to {WAVE.max():.4g} A" in read.columns[-1]


@pytest.mark.parametrize(
    ("choice", "factor", "offset"),
    [
        ("current=CH:mA", 1e-3, 0.0),
        ("current=CH*10", 10.0, 0.0),
        ("current=CH/4", 0.25, 0.0),
        ("current=CH*2.5-0.05", 2.5, -0.05),
        ("current=CH*-1e1+.5", -10.0, 0.5),
        ("current=2:mV*10", 1e-2, 0.0),
        ("current=ch:A+1", 1.0, 1.0),
    ],
)
def test_scales_and_offsets_of_a_named_column(
    choice: str, factor: float, offset: float, tmp_path: Path
) -> None:
    path = table(tmp_path / "a.csv", "time_s,CH", [1e-3 * PLACES, WAVE])
    read = read_recording(path, [ColumnChoice.parse(choice)])
    np.testing.assert_allclose(read.current_a, factor * WAVE + offset)


@pytest.mark.parametrize(
    ("setting", "dt_s"),
    [
        *((f"Sample Rate,{rate} {unit}", 1.0 / (rate * factor)) for rate, unit, factor in (
            (2500, "", 1.0), (2500, "Hz", 1.0), (2500, "Sa/s", 1.0), (2.5, "kHz", 1e3), (2.5, "kSa/s", 1e3),
            (0.5, "MHz", 1e6), (0.5, "MSa/s", 1e6))),
        *((f"Sample Interval,{step}{unit}", step * factor) for step, unit, factor in (
            (0.004, "", 1.0), (0.004, "s", 1.0), (4, "ms", 1e-3), (40, "us", 1e-6), (40, "µs", 1e-6),
            (400, "ns", 1e-9))),
        ("#CLOCK=0.002S", 0.002),
        ("Sampling period: 3 ms", 0.003),
        ("XIncrement,5e-4", 5e-4),
    ],
)  # fmt: skip
def test_intervals_as_instruments_say_them(setting: str, dt_s: float, tmp_path: Path) -> None:
    path = table(tmp_path / "a.csv", "current (A),voltage (V)", [WAVE, 12.0 * BACK], f"{setting}\n")
    read = read_recording(path)
    assert read.dt_s == pytest.approx(dt_s, rel=1e-9)
    assert read.time_s[0] == 0.0


def test_a_count_of_samples_begins_where_the_settings_say(tmp_path: Path) -> None:
    preamble = "XStart,-0.25\nXIncrement,0.01\n"
    path = table(tmp_path / "a.csv", "sample,current (A)", [PLACES + 3.0, WAVE], preamble)
    np.testing.assert_allclose(read_recording(path).time_s, -0.25 + 0.01 * (PLACES + 3.0))
    path = table(tmp_path / "b.csv", "current (A)", [WAVE], "Sample Rate,100\nRecord Length,41\n")
    with pytest.raises(InputError, match="holds 40 rows and says that there are 41"):
        read_recording(path)
    skips = np.where(PLACES < 20, PLACES, PLACES + 1)
    path = table(tmp_path / "c.csv", "sample,current (A)", [skips, WAVE], preamble)
    with pytest.raises(InputError, match="line 24: the column sample must count by one, got 21 after 19"):
        read_recording(path)


def test_twenty_one_whole_numbers_are_counts(tmp_path: Path) -> None:
    for different, is_count in ((20, False), (21, True)):
        path = table(tmp_path / "a.csv", "time_s,current", [1e-3 * PLACES, PLACES % different])
        no_unit = pytest.raises(InputError, match="holds whole numbers, and no unit is stated")
        with no_unit if is_count else nullcontext():
            assert read_recording(path).current_a.max() == 19.0


def test_borders_of_what_is_a_recording(tmp_path: Path) -> None:
    def read(time: FloatArray, current: FloatArray, voltage: FloatArray = BACK) -> Recording:
        np.savez(tmp_path / "a.npz", time_s=time, current_a=current, voltage_v=voltage[: len(time)])
        return read_recording(tmp_path / "a.npz")

    assert len(read(1e-3 * PLACES[:20], WAVE[:20]).time_s) == 20
    with pytest.raises(InputError, match="at least 20 samples, got 19"):
        read(1e-3 * PLACES[:19], WAVE[:19])
    for step, is_read in ((1.1e-10, True), (0.9e-10, False), (0.99e4, True), (1.01e4, False)):
        with nullcontext() if is_read else pytest.raises(InputError, match="are no recording of a motor"):
            assert read(step * PLACES, WAVE).dt_s == pytest.approx(step)
    for size, is_read in ((0.99e9 / 2.5, True), (1.01e9 / 2.4, False), (1.1e-12, True), (0.39e-12, False)):
        with nullcontext() if is_read else pytest.raises(InputError, match="is no reading of a motor"):
            np.testing.assert_allclose(read(PLACES, WAVE, size * BACK).voltage_v, size * BACK)  # type: ignore[arg-type]
    largest = WAVE / WAVE.max()
    np.testing.assert_allclose(read(PLACES, 999.0 * largest).current_a, 999.0 * largest)
    with pytest.raises(InputError, match="reaches 1001 A, which is no reading"):
        read(PLACES, -1001.0 * largest)
    late = read(1.01e7 + PLACES, WAVE)
    assert late.time_s[0] == 0.0
    assert "time counts from 10100000 s" in late.columns
    assert read(0.99e7 + PLACES, WAVE).time_s[0] == 0.99e7
    for gap, count in ((99.0, 40), (101.0, 25)):
        time = PLACES + np.where(PLACES >= 25, gap - 1.0, 0.0)
        found = read(time, WAVE)
        assert found.time_s[-1] == pytest.approx(time[count - 1])
        assert any("a gap of 101 s: only 0 to 24 s is read" in note for note in found.columns) is (
            count == 25
        )


def test_arrays_of_the_most_frequent_length_are_the_recording(tmp_path: Path) -> None:
    """A longer one that names no quantity, such as a spectrum, is left out, and that is said."""
    np.savez(tmp_path / "a.npz", time_s=PLACES, current_a=WAVE, spectrum=np.ones(99))
    read = read_recording(tmp_path / "a.npz")
    np.testing.assert_allclose(read.current_a, WAVE)
    assert "left out, for their lengths: spectrum" in read.columns


def test_a_column_that_seldom_holds_a_number_is_none_of_the_table(tmp_path: Path) -> None:
    """More than half of its cells have to."""
    for each, is_read in ((10, False), (3, False), (1, True)):
        rows = [
            f"{t:.3f},{i:.4f},{n if n % each == 0 else 'ok'}"
            for n, (t, i) in enumerate(zip(PLACES, WAVE, strict=True))
        ]
        (tmp_path / "a.csv").write_text("\n".join(["time_s,current_a,speed_rad_s", *rows]))
        read = read_recording(tmp_path / "a.csv")
        np.testing.assert_allclose(read.current_a, WAVE, atol=1e-4)
        assert (read.speed_rad_s is not None) is is_read


@pytest.mark.parametrize(
    ("cell", "kind"), [("inf", "finite numbers"), ("1e999", "finite numbers"), ("1_0", "numbers")]
)
def test_a_cell_that_is_no_finite_number_is_named(cell: str, kind: str, tmp_path: Path) -> None:
    rows = [f"{t:.3f},{i:.4f}" for t, i in zip(PLACES, WAVE, strict=True)]
    rows[20] = f"20.000,{cell}"
    (tmp_path / "a.csv").write_text("\n".join(["time_s,current_a", *rows]))
    with pytest.raises(InputError, match=f"line 22: the column current_a must hold {kind}, got '{cell}'"):
        read_recording(tmp_path / "a.csv")


def test_uneven_times_are_evened_from_a_fiftieth_of_an_interval_on() -> None:
    columns = {"current": WAVE}
    for off, is_kept in ((0.0199, True), (0.0201, False)):
        time = PLACES.copy()
        time[10] += off
        even, values, note = resampled(time, columns)
        np.testing.assert_allclose(even, PLACES)
        assert (values is columns, note == ()) == (is_kept, is_kept)
        expected = WAVE if is_kept else np.interp(PLACES, time, WAVE)
        np.testing.assert_array_equal(values["current"], expected)


def noisy(
    onset: int = 200, n: int = 1000, *, noise: float = 0.02, offset: float = 0.1, sign: float = 1.0
) -> Recording:
    rng = np.random.default_rng(1)
    since = np.maximum(np.arange(n) - onset + 1.0, 0.0)
    current = 5.0 * (np.exp(-since / 300.0) - np.exp(-since / 3.0)) + 0.05 * (since > 0.0)
    shown = sign * current + offset + noise * rng.standard_normal(n)
    return Recording(Path("start"), 1e-4 * np.arange(float(n)) - 0.01, shown)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_start_is_aligned_to_the_sample(sign: float) -> None:
    recording = noisy(sign=sign)
    found = align(recording)
    assert (found.onset_index, found.sign) == (200, sign)
    assert found.onset_s == pytest.approx(0.01 - 0.5e-4)
    # Two samples before the onset may belong to it.
    quiet = recording.current_a[:198]
    assert found.n_quiet == 198
    assert found.offset_a == pytest.approx(quiet.mean())
    assert found.noise_a == pytest.approx(quiet.std(ddof=1))
    steps = np.abs(np.diff(recording.current_a))
    assert found.quantum_a == pytest.approx(steps[steps > 0.0].min())
    assert found.defects == ()
    assert not found.rectified
    start = prepare(recording, 12.0)
    assert (start.level_v, start.voltage_known, start.from_rest) == (12.0, True, True)
    np.testing.assert_allclose(start.current_a, sign * recording.current_a)
    assert start.alignment.offset_a == pytest.approx(sign * quiet.mean())
    assert len(start.shortened(50).time_s) == 250
    early = align(replace(recording, time_s=recording.time_s[:800], current_a=recording.current_a[200:]))
    assert (early.onset_index, early.n_quiet, early.offset_a) == (0, 0, 0.0)


def still(*pieces: tuple[int, float]) -> Recording:
    """Levels of so many samples, nearly without noise."""
    current = np.concatenate([np.full(n, level) for n, level in pieces])
    current = current + 1e-6 * np.random.default_rng(4).standard_normal(len(current))
    return Recording(Path("x"), 1e-3 * np.arange(float(len(current))), current)


@pytest.mark.parametrize(
    ("before", "onset"),
    [
        (((5, 0.0795), (50, 0.0)), 2055),  # a bump below 0.08 of the peak is no start
        (((5, 0.0805), (50, 0.0)), 2000),
        (((2, 0.5), (50, 0.0)), 2052),  # nor is one of two samples
        (((3, 0.5), (50, 0.0)), 2000),
        (((7, 0.00505),), 2000),  # its foot reaches down to 0.005 of the peak
        (((7, 0.00495),), 2007),
    ],
)
def test_borders_of_an_onset(before: tuple[tuple[int, float], ...], onset: int) -> None:
    assert align(still((2000, 0.0), *before, (40_000, 1.0))).onset_index == onset


@pytest.mark.parametrize(("odd", "onset"), [(0.5995, 2000), (0.6005, 0)])
def test_the_level_before_a_start_is_believed_where_it_is_quiet(odd: float, onset: int) -> None:
    """It moves by less than a tenth of the whole; else the sensor's zero is believed."""
    pieces = ((3, 0.5), (2, odd), (1995, 0.5), (40_000, 1.5))
    assert align(still(*pieces)).onset_index == onset


def test_a_rectifier_leaves_a_fifth_of_zeros_before_the_start() -> None:
    for zeros, is_rectified in ((40, False), (41, True)):
        given = noisy(offset=0.0)
        given.current_a[:200] = np.where(
            np.arange(200) % 200 < zeros, 0.0, np.maximum(given.current_a[:200], 1e-3)
        )
        given.current_a[200:] = np.abs(given.current_a[200:])
        found = align(given)
        assert found.onset_index == 200
        assert found.rectified is is_rectified


@pytest.mark.parametrize(
    ("drop", "run", "is_clipped"), [(0.05, 9, True), (0.04, 9, False), (0.05, 5, True), (0.05, 4, False)]
)
def test_a_clipped_top_falls_by_more_than_four_and_a_half_steps(
    drop: float, run: int, is_clipped: bool
) -> None:
    """Of 0.01; and five samples or more stand there."""
    rise = np.concatenate([np.zeros(100), 0.7 + 0.01 * np.arange(30.0)])
    current = np.concatenate([rise, np.full(run, 1.0), np.full(60, 1.0 - drop)])
    found = align(Recording(Path("x"), 1e-3 * np.arange(float(len(current))), np.round(current, 2)))
    assert bool(found.saturation) is is_clipped
    assert (found.saturation in found.defects) is is_clipped


def test_fifteen_samples_follow_a_start() -> None:
    for count, is_enough in ((15, True), (14, False)):
        short = noisy(n=200 + count)
        assert align(short).onset_index == 200
        too_few = pytest.raises(UnusableError, match="only 14 samples follow the start; at least 15")
        with nullcontext() if is_enough else too_few:
            assert prepare(short).level_v == 1.0


def test_a_peak_within_six_noises_is_no_start() -> None:
    """Second differences tell the noise; the current is a step."""
    rng = np.random.default_rng(2)
    noise = rng.standard_normal(2000)
    step = (np.arange(2000) >= 1000).astype(float)
    size = 2.5
    for _ in range(40):  # the peak lies 6 noises above the level before it
        current = noise + size * step
        peak = (current - np.median(current[:40])).max()
        size += 6.0 * difference_noise(current) - peak
    for more, is_start in ((-0.02, False), (0.02, True)):
        recording = Recording(Path("x"), 1e-3 * np.arange(2000.0), noise + (size + more) * step)
        no_start = pytest.raises(UnusableError, match="the current never rises above its noise")
        with nullcontext() if is_start else no_start:
            assert align(recording).onset_index > 0


def stepped(quantum: float, *, noise: float = 0.0, top: float | None = None) -> Recording:
    given = noisy(noise=noise, offset=0.0)
    current = given.current_a if top is None else np.minimum(given.current_a, top)
    return replace(given, current_a=quantum * np.round(current / quantum))


def test_steps_clipping_and_rectifiers_are_told() -> None:
    span = float(np.ptp(stepped(1e-4).current_a))
    for share, is_said in ((0.0049, False), (0.0052, True)):
        found = align(stepped(share * span))
        assert any("quantisation" in words for words in found.defects) is is_said
        assert found.quantum_a == pytest.approx(share * span)
    for share, is_added in ((0.0019, False), (0.0021, True)):
        given = stepped(share * span)
        given.current_a[50] = given.current_a[3] + share * span  # one step before the start
        least = share * span / math.sqrt(12.0) if is_added else float(np.std(given.current_a[:198], ddof=1))
        assert align(given).noise_a == pytest.approx(least)
    clipped = align(stepped(0.005, top=3.0))
    run = int((stepped(0.005, top=3.0).current_a == 3.0).sum())
    assert clipped.saturation == f"saturation: {run} samples in a row stand at 3 A"
    given = noisy(offset=0.0)
    halved = replace(given, current_a=np.maximum(given.current_a, 0.0))
    found = align(halved)
    assert found.rectified
    assert found.offset_a == 0.0
    assert found.noise_a == pytest.approx(
        math.sqrt(2.0 * np.mean(halved.current_a[: found.onset_index - 2] ** 2))
    )
    assert "rectification: no current lies below 0" in found.defects


def test_the_noise_of_second_differences() -> None:
    """Whose values are the quantiles of a normal distribution: the estimate is its standard deviation."""
    rng = np.random.default_rng(3)
    quantiles = stats.norm.ppf((np.arange(100_000) + 0.5) / 100_000)
    values = np.cumsum(np.cumsum(rng.permutation(quantiles)))
    for scale in (1.0, 30.0):
        assert difference_noise(scale * values) == pytest.approx(scale / math.sqrt(6.0), rel=1e-3)
    second = np.array([0.0, 0.0, 0.0, 0.0, 8.0, -8.0, 0.0, 0.0])
    rare = np.cumsum(np.cumsum(second))
    assert difference_noise(rare) == pytest.approx(0.5 * np.std(second[2:]) / math.sqrt(6.0))
    assert difference_noise(np.arange(4.0) ** 2) == 0.0
    assert difference_noise(np.array([0.0, 1.0, 0.0, 1.0, 0.0])) > 0.0


def test_a_wild_sample_stands_out_of_neighbours_that_agree() -> None:
    """By a twentieth of the current's range, ten noises, five times as far as its neighbours differ."""
    base = np.where(np.arange(2000) < 1100, 0.0, 1.0)
    level = float(np.percentile(np.abs(base - np.median(base)), 99))
    for size, is_wild in ((0.0499, False), (0.0501, True)):
        current = base.copy()
        current[500] += size * level
        assert outlier_samples(current) == ((500,) if is_wild else ())
    for apart, is_wild in ((0.199, True), (0.201, False)):
        current = base.copy()
        current[500], current[501] = 1.0, apart
        assert (500 in outlier_samples(current)) is is_wild
    noise = 0.05 * np.random.default_rng(4).standard_normal(2000)
    second = np.diff(base + noise, n=2)
    spread = 1.4826 * float(np.median(np.abs(second - np.median(second)))) / math.sqrt(6.0)
    around = np.median((base + noise)[[498, 499, 501, 502]])
    for size, is_wild in ((9.8, False), (10.2, True)):
        current = base + noise
        current[[498, 499, 501, 502]] = around
        current[500] = around + size * spread
        assert (500 in outlier_samples(current)) is is_wild
    spikes = base.copy()
    spikes[[100, 200]] = 1.0
    assert outlier_samples(spikes) == (100, 200)  # one in a thousand
    spikes[300] = 1.0
    assert outlier_samples(spikes) == ()
    assert outlier_samples(spikes[80:129]) == ()  # 49 samples are too few
    mended = without_outliers(np.array([1.0, 9.0, 3.0]), [1])
    assert mended.tolist() == [1.0, 2.0, 3.0]


def test_what_steps_hide_of_a_level() -> None:
    """Widrow & Kollar: the bias falls with the noise before rounding, here 0.4 of a step."""
    quantum = 0.1
    before = 0.4 * quantum
    expected = quantum / math.sqrt(12.0) * math.exp(-2.0 * (math.pi * 0.4) ** 2)
    assert quantisation_bias(
        np.empty(0), math.hypot(before, quantum / math.sqrt(12.0)), quantum
    ) == pytest.approx(expected)
    rng = np.random.default_rng(5)
    quiet = quantum * np.round((0.033 + before * rng.standard_normal(50_000)) / quantum)
    assert quantisation_bias(quiet, 9.0, quantum) == pytest.approx(expected, rel=0.05)
    assert quantisation_bias(np.zeros(9), 9.0, quantum) == pytest.approx(quantum / math.sqrt(12.0))
    assert quantisation_bias(np.array([0.0, 0.21, 0.0, 0.21]), 9.0, quantum) == 0.0


def test_lines_of_the_spectrum_have_their_frequency_and_amplitude() -> None:
    time_s = 1e-4 * np.arange(1000.0)
    line = PeriodicLine(1234.5, 0.3, -0.4)
    assert line.amplitude_a == pytest.approx(0.5)
    ripple = line.current_a(time_s)
    np.testing.assert_allclose(
        ripple, 0.3 * np.cos(2469.0 * math.pi * time_s) - 0.4 * np.sin(2469.0 * math.pi * time_s)
    )
    noise = 0.01 * np.random.default_rng(6).standard_normal(1000)
    second = PeriodicLine(3210.0, 0.1, 0.0).current_a(time_s)
    one, two, *rest = periodic_lines(ripple + second + noise + 3.0, time_s)
    assert (one.frequency_hz, two.frequency_hz) == pytest.approx((1234.5, 3210.0), abs=1.0)
    assert (one.amplitude_a, two.amplitude_a) == pytest.approx((0.5, 0.1), abs=0.005)
    assert (one.cosine_a, one.sine_a) == pytest.approx((0.3, -0.4), abs=0.02)
    assert rest == []
    assert line_share(ripple + 3.0, time_s) == pytest.approx(1.0, abs=0.01)
    assert line_share(ripple + 0.25 * math.sqrt(2.0) * noise / 0.01, time_s) == pytest.approx(0.5, abs=0.06)
    slow = PeriodicLine(600.0, 0.5, 0.0).current_a(time_s)  # below a sixteenth of the sampling rate
    assert periodic_lines(slow + noise, time_s) == ()
    assert len(periodic_lines(PeriodicLine(640.0, 0.5, 0.0).current_a(time_s) + noise, time_s)) == 1
    (fast,) = periodic_lines(PeriodicLine(4_995.0, 0.5, 0.2).current_a(time_s) + noise, time_s)
    assert fast.frequency_hz == pytest.approx(4_995.0, abs=1.0)  # no alias beyond half of the sampling rate
    assert line_share(ripple[:63], time_s[:63]) == 0.0
    assert line_share(ripple[:64], time_s[:64]) > 0.5


def test_values_over_the_angle_that_the_motor_turns() -> None:
    """A speed that rises in a straight line: the angle is its square."""
    time_s = np.linspace(0.0, 1.0, 401)
    found = over_angle(np.sin(20.0 * time_s**2), time_s, np.where(time_s < 0.9, time_s, time_s))
    assert found is not None
    even, values = found
    last = np.mean(time_s[-20:])
    assert even[-1] == pytest.approx(0.5 / last, rel=1e-6)
    np.testing.assert_allclose(values, np.sin(40.0 * even * last), atol=2e-3)
    assert over_angle(time_s, time_s, np.zeros(401)) is None
    assert over_angle(time_s, time_s, -np.ones(401)) is None


def driven(
    voltage: FloatArray,
    *,
    current: FloatArray | None = None,
    dt_s: float = 1e-3,
    speed: FloatArray | None = None,
) -> Recording:
    shown = 0.1 * voltage if current is None else current
    return Recording(Path("x"), dt_s * np.arange(float(len(voltage))), shown, voltage, speed)


def off_on(*lengths: int) -> FloatArray:
    return np.concatenate([np.full(n, 12.0 * (k % 2)) for k, n in enumerate(lengths)])


@pytest.mark.parametrize(
    "voltage",
    [off_on(100, 900), off_on(100, 5, 4, 900), off_on(100, 900, 900, 900, 900, 900), np.full(500, 12.0)],
    ids=["start", "bouncing switch", "three starts", "always on"],
)
def test_starts_stay_starts(voltage: FloatArray) -> None:
    assert operation_evidence(driven(voltage)) is None


def waves(period: float, low: float, high: float, *, n: int = 6000) -> FloatArray:
    """A voltage that goes up and down between two shares of 12 V without a jump; the period in samples."""
    phase = 2.0 * np.pi * np.arange(n) / period
    return np.asarray(12.0 * (0.5 * (low + high) - 0.5 * (high - low) * np.cos(phase)))


@pytest.mark.parametrize(
    ("voltage", "dt_s", "rises"),
    [
        (waves(600.0, 0.0, 1.0), 1e-3, 10),
        (waves(600.0, 0.5, 1.0), 1e-3, 10),
        (waves(600.0, 0.79, 1.0), 1e-3, 10),  # by more than a fifth
        (waves(600.0, 0.81, 1.0), 1e-3, 0),
        (waves(100.0, 0.6, 1.0), 1e-4, 0),  # ripple of a rectifier, 100 Hz
        (waves(200.0, 0.6, 1.0), 1e-4, 0),
        # Supplies that take 180 and 96 ms to the top.
        (np.tile(np.append(np.zeros(300), np.minimum(np.arange(300) / 15.0, 12.0)), 3), 1e-3, 3),
        (np.tile(np.append(np.zeros(300), np.minimum(np.arange(300) / 8.0, 12.0)), 3), 1e-3, 0),
    ],
)
def test_slow_rises_of_a_voltage(voltage: FloatArray, dt_s: float, rises: int) -> None:
    """Reaches in: how many there are stands in no result."""
    assert slow_rises(voltage / 12.0, dt_s) == rises


@pytest.mark.parametrize(("n", "is_work"), [(1200, False), (1900, True)])
def test_a_voltage_that_rises_slowly_again_and_again_is_of_a_motor_at_work(n: int, is_work: bool) -> None:
    assert (
        operation_evidence(driven(waves(600.0, 0.0, 1.0, n=n))) == "the voltage takes several levels"
    ) is is_work


def test_of_several_starts_one_that_had_begun_is_left_out() -> None:
    volts = off_on(0, 300, 200, 300, 200, 300)
    recording = driven(volts)
    assert [part.path.name for part in chosen_starts(recording)] == ["x#2", "x#3"]
    assert [part.path.name for part in chosen_starts(recording, 1)] == ["x#1"]
    assert len(chosen_starts(driven(off_on(20, 280, 200, 300)))) == 2  # recorded from before it begins
    assert len(chosen_starts(driven(off_on(0, 300)))) == 1  # the only one
    for share, first in ((0.49, "x#1"), (0.51, "x#2")):  # beyond half it is on
        before = np.full(200, 12.0 * share)
        parts = chosen_starts(driven(np.append(before, off_on(100, 300, 200, 300))))
        assert parts[0].path.name == first


@pytest.mark.parametrize(("last", "count"), [(149, 3), (150, 4)])
def test_of_several_starts_the_last_is_left_out_where_it_ends_too_soon(last: int, count: int) -> None:
    """Half as long under voltage as the others are in the median, 300 samples."""
    volts = off_on(100, 300, 200, 250, 200, 900, 200, last)
    assert len(chosen_starts(driven(volts))) == count
    assert len(chosen_starts(driven(volts), 4)) == 1
    assert len(chosen_starts(driven(off_on(100, 300, 200, last)))) == 2  # which of two is whole, nobody knows


@pytest.mark.parametrize("has_speed", [False, True])
@pytest.mark.parametrize("has_voltage", [False, True])
def test_a_start_has_the_rest_before_it_and_no_braking(has_speed: bool, has_voltage: bool) -> None:
    """The current of a motor that is braked decays, and so does its speed, which may end later."""
    volts, noise = off_on(100, 300, 400, 300), np.random.default_rng(3).uniform(-0.01, 0.01, 1100)
    current, speed = np.where(volts > 0.0, 2.0, 0.0) + noise, np.where(volts > 0.0, 50.0, 0.0)
    current[400:500] -= np.linspace(1.5, 0.1, 100)
    speed[400:650] += np.linspace(50.0, 1.0, 250)
    recording = driven(volts, speed=speed if has_speed else None, current=current)
    parts = chosen_starts(recording if has_voltage else replace(recording, voltage_v=None))
    first = 650 if has_speed else 500
    assert [round(1e3 * part.time_s[0]) for part in parts] == [0, first]
    assert [len(part.time_s) for part in parts] == [400, 1100 - first]
    for size, begin in ((0.021, 501), (0.009, 500)):  # what is beyond twice the noise is no rest
        noise[400:] = np.tile([0.0049, -0.0049], 350)
        noise[500] = size
        shown = driven(volts, current=np.where(volts > 0.0, 2.0, 0.0) + noise - 2.0 * (np.arange(1100) < 500))
        assert round(1e3 * chosen_starts(shown)[1].time_s[0]) == begin


def test_borders_of_a_motor_at_work() -> None:
    start = off_on(1000, 9000)
    for reversed_, is_work in ((50, False), (51, True)):
        volts = start.copy()
        volts[2000 : 2000 + reversed_] = -12.0
        assert (operation_evidence(driven(volts)) == "the voltage reverses") is is_work
    for between, is_work in ((1000, False), (1004, True)):  # a tenth of the time, in three changes or more
        volts = start.copy()
        for k in range(4):
            volts[2000 + 2000 * k : 2000 + 2000 * k + between // 4] = 5.0
        assert (operation_evidence(driven(volts)) == "the voltage takes several levels") is is_work
    once = start.copy()
    once[1000:4000] = 5.0
    assert operation_evidence(driven(once)) is None  # two changes: off to 5 V, 5 V to 12 V
    once[3000:4000] = 8.0
    assert operation_evidence(driven(once)) == "the voltage takes several levels"
    for level, is_between in ((0.79, True), (0.81, False), (0.11, True), (0.09, False)):
        volts = start.copy()
        for k in range(4):
            volts[2000 + 2000 * k : 3000 + 2000 * k] = 12.0 * level
        said = operation_evidence(driven(volts))
        assert (said == "the voltage takes several levels") is is_between
    for pause, is_work in ((99, True), (101, False)):
        volts = np.tile(off_on(pause, 300), 6)
        speed = np.tile(np.concatenate([np.zeros(pause), np.ones(300)]), 6)
        assert (
            operation_evidence(driven(volts, speed=speed))
            == "the voltage is switched faster than a motor stops"
        ) is is_work
    assert operation_evidence(driven(np.zeros(100))) is None
    assert operation_evidence(replace(driven(start), voltage_v=None)) is None
    assert (
        operation_evidence(replace(driven(start), voltage_v=None, duty=np.tile([0.5, -0.5], 5000)))
        == "the voltage reverses"
    )


def test_the_largest_voltage_leaves_one_sample_in_a_thousand_out() -> None:
    """A tenth of it counts as off: behind spikes of 120 V a voltage of 12 V is none."""
    for spikes, is_work in ((8, True), (15, False)):
        volts = np.tile(np.repeat([12.0, -12.0], 500), 10)
        volts[100 : 100 + spikes] = 120.0
        assert (operation_evidence(driven(volts)) == "the voltage reverses") is is_work


def test_a_motor_that_still_turns_when_it_is_switched_on_is_at_work() -> None:
    """By its speed, a tenth of the largest; else by inrushes of three quarters of the largest."""
    volts = off_on(100, 400, 200, 400, 200, 400)
    for left, is_work in ((0.099, False), (0.101, True)):
        speed = np.where(volts > 0.0, 100.0, 100.0 * left)
        assert (operation_evidence(driven(volts, speed=speed)) is not None) is is_work
    for share, is_work in ((0.76, False), (0.74, True)):
        current = np.where(volts > 0.0, 1.0, 0.0)
        for first, size in ((100, 8.0), (700, 8.0 * share), (1300, 8.0 * share)):
            current[first : first + 5] = size
        for offset in (0.0, 4.0):  # of the sensor
            assert (operation_evidence(driven(volts, current=current + offset)) is not None) is is_work
    short = off_on(100, 400, 19, 400, 19, 400)  # a contact that bounces
    assert operation_evidence(driven(short, speed=np.full(len(short), 100.0))) is None
    longer = off_on(100, 400, 21, 400, 21, 400)
    assert (
        operation_evidence(driven(longer, speed=np.full(len(longer), 100.0)))
        == "the voltage comes back before the motor stands"
    )


def test_a_motor_that_turns_when_the_recording_begins_is_at_work() -> None:
    """By the median of its first three speeds, a tenth of the largest, and a tenth of the largest voltage."""
    volts, speed = np.full(2000, 12.0), np.full(2000, -100.0)
    for turning, begun, is_work in (
        (9.9, 12.0, False),
        (10.1, 12.0, True),
        (10.1, 1.21, True),
        (10.1, 1.19, False),
    ):
        volts[0], speed[:3] = begun, [0.0, turning, turning]
        assert (operation_evidence(driven(volts, speed=speed)) == "the motor turns already") is is_work
    assert operation_evidence(driven(volts)) is None  # nobody knows
    by_duty = replace(driven(volts, speed=np.full(2000, 100.0)), voltage_v=None, duty=volts / 12.0)
    assert operation_evidence(by_duty) is None  # a log needs its voltage
    assert operation_evidence(driven(np.full(2, 12.0), speed=np.full(2, 9.0))) == "the motor turns already"


def test_levels_and_gaps_by_hand() -> None:
    assert changes(np.array([0.0, 0.0, 0.0, 0.5, 0.5, 0.5, 0.8, 0.0, 0.0, 0.0, 0.09])) == 2
    assert changes(np.array([0.0, 0.11, 0.11, 0.0])) == 1
    off = np.array([1, 1, 0, 0, 1, 1, 1, 0, 1, 0, 1], dtype=bool)
    assert gaps_s(off, 0.5).tolist() == [1.5, 0.5]
    assert gaps_s(np.zeros(5, dtype=bool), 0.5).tolist() == []


def test_eight_jumps_of_the_voltage_must_show_in_the_current() -> None:
    noise, more = np.random.default_rng(7).standard_normal(400), [20] * 7
    refusal = pytest.raises(UnusableError, match="does not follow the voltage")
    for lengths, is_refused in (
        ([*more, 260], False),
        ([*more, 20, 240], True),
        # Two samples before and behind a jump tell what the current does there.
        ([1, *more, 259], False),
        ([2, *more, 258], True),
        ([*more, 258, 2], False),
        ([*more, 257, 3], True),
    ):
        with refusal if is_refused else nullcontext():
            refuse_aliased(off_on(*lengths), noise)
    volts, noise = off_on(*([20] * 500)), np.random.default_rng(7).standard_normal(10_000)
    # Of a hundred samples two lie between the levels.
    for off_level, is_refused in ((200, True), (201, False)):
        volts[10 : 10 + 20 * off_level : 20] = 6.0
        with refusal if is_refused else nullcontext():
            refuse_aliased(volts, noise)


@pytest.mark.parametrize("later", [0, 1, 2, None])
def test_the_current_may_answer_a_jump_in_any_of_three_samples_or_until_the_next(later: int | None) -> None:
    """It answers by one rise, and at the jumps is as ever; or it rises so slowly that only its end tells."""
    volts, current = off_on(*([20] * 40)), np.random.default_rng(5).standard_normal(800)
    for n, jump in enumerate(range(20, 800, 20)):
        sign = 1.0 if n % 2 == 0 else -1.0
        if later == 0:
            current[jump - 3 : jump] -= 10.0 * sign
        elif later is not None:
            current[jump + later : jump + 8] += 10.0 * sign
        else:
            current[jump + 3 : jump + 20] += sign * np.linspace(0.0, 4.0, 17)
            current[jump + 20 :] += sign * 4.0
    refuse_aliased(volts, current)


def test_starts_are_cut_where_the_motor_is_switched_off() -> None:
    volts = off_on(150, 300, 200, 300, 250, 300)
    parts = split_starts(driven(volts))
    spans = [(round(part.time_s[0] * 1e3), round(part.time_s[-1] * 1e3)) for part in parts]
    assert spans == [(0, 449), (450, 949), (950, 1499)]
    assert [part.path.name for part in parts] == ["x#1", "x#2", "x#3"]
    assert parts[1].columns == ("start 2 of 3 in the file",)
    current = np.where(volts > 0.0, 0.5, 0.0)
    for first in (150, 650, 1200):
        current[first : first + 60] = 5.0 * np.exp(-np.arange(60.0) / 20.0) + 0.5
    alone = split_starts(replace(driven(volts, current=current), voltage_v=None))
    spans = [(round(part.time_s[0] * 1e3), round(part.time_s[-1] * 1e3)) for part in alone]
    assert spans == [(0, 449), (450, 949), (950, 1499)]
    assert split_starts(driven(off_on(150, 300)))[0].path.name == "x"
    (second,) = chosen_starts(driven(volts), 2)
    assert second.path.name == "x#2"


def test_starts_backwards_are_cut_as_well() -> None:
    """A supply of either sign rises from rest."""
    parts = split_starts(driven(-off_on(150, 300, 200, 300)))
    spans = [(round(part.time_s[0] * 1e3), round(part.time_s[-1] * 1e3)) for part in parts]
    assert spans == [(0, 449), (450, 949)]


def test_a_wild_voltage_hides_no_start() -> None:
    volts = off_on(150, 500, 200, 500)
    volts[300] = 100.0
    assert len(split_starts(driven(volts, current=0.1 * off_on(150, 500, 200, 500)))) == 2


def test_starts_of_four_samples_are_cut() -> None:
    """Between them there is no stretch in which the current's level could change."""
    current = np.tile([0.0, 0.0, 0.0, 1.0], 10)
    found = split_starts(replace(driven(current, dt_s=0.01), voltage_v=None))
    assert [len(part.time_s) for part in found] == [4] * 10


@pytest.mark.parametrize(("rest", "count"), [(0.049, 2), (0.051, 1)])
def test_a_start_with_a_voltage_rises_from_a_twentieth(rest: float, count: int) -> None:
    volts = off_on(150, 300, 200, 300)
    volts[450:650] = 12.0 * rest
    assert len(split_starts(driven(volts))) == count


@pytest.mark.parametrize(("pause", "count"), [(20, 2), (19, 1)])
def test_a_pause_of_twenty_milliseconds_is_a_rest(pause: int, count: int) -> None:
    assert len(split_starts(driven(off_on(150, 300, pause, 300)))) == count


@pytest.mark.parametrize(("rest", "peak", "count"), [(0.24, 0.51, 2), (0.26, 0.51, 1), (0.24, 0.49, 1)])
def test_a_start_without_a_voltage_rises_from_a_quarter_beyond_half(
    rest: float, peak: float, count: int
) -> None:
    current = np.concatenate(
        [np.zeros(100), np.ones(100), np.full(200, rest), np.full(100, peak), np.full(100, rest)]
    )
    assert len(split_starts(replace(driven(current), current_a=current, voltage_v=None))) == count


def test_the_supply_of_a_start() -> None:
    given = noisy()
    n = len(given.time_s)
    step = np.where(np.arange(n) >= 200, 9.0, 0.0)
    found = prepare(replace(given, voltage_v=step))
    assert (found.level_v, found.voltage_v, found.voltage_known) == (9.0, None, True)
    rng = np.random.default_rng(8)
    measured = step + 0.01 * rng.standard_normal(n)
    found = prepare(replace(given, voltage_v=measured))
    assert found.voltage_v is not None
    assert found.level_v == pytest.approx(np.median(measured[-250:]))
    assert found.from_rest
    for first, from_rest in ((0.04, True), (0.06, False)):
        running = measured.copy()
        running[0] = first * float(np.abs(measured).max())
        start = prepare(replace(given, voltage_v=running))
        assert start.from_rest is from_rest
        assert (start.alignment.n_quiet > 0) is from_rest
    for change in (0.03, 0.3):  # of a voltage that is on before the recording begins
        going = 9.0 + change * step + 0.01 * rng.standard_normal(n)
        begun = pytest.raises(UnusableError, match=r"the voltage is \S+ V in the first sample already")
        with begun if change < 0.05 else nullcontext():
            assert not prepare(replace(given, voltage_v=going)).from_rest
    duty = prepare(replace(given, duty=step / 9.0 * 0.5), 24.0)
    assert (duty.level_v, duty.voltage_known) == (12.0, True)
    unknown = prepare(given)
    assert (unknown.level_v, unknown.voltage_known) == (1.0, False)
    with pytest.raises(UnusableError, match="the voltage is 0 at the end"):
        prepare(replace(given, voltage_v=9.0 - step))
    with pytest.raises(UnusableError, match="a shunt in series"):
        prepare(given, None, Circuit(shunt_ohm=0.1))
    assert prepare(given, 12.0, Circuit(shunt_ohm=0.1)).circuit.shunt_ohm == 0.1
    assert mean_tail(np.arange(100.0)) == 94.5
    assert mean_tail(np.arange(5.0)) == 4.0
    backwards = prepare(replace(given, speed_rad_s=-np.arange(float(n))))
    assert backwards.speed_rad_s is not None
    assert backwards.speed_rad_s[-1] == n - 1.0


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


def test_parquet_is_parsed_in_a_process_of_its_own(tmp_path: Path) -> None:
    """A line of JSON with names and shapes, then the values; a damaged file ends it with 1 and a sentence."""
    pa, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    path = tmp_path / "a.parquet"
    parquet.write_table(pa.table({"t": [0.0, 0.5], "i": [1, 2], "name": ["a", "b"]}), path)
    command = [sys.executable, array_parser.__file__, "Parquet", str(path)]
    done = subprocess.run(command, capture_output=True, check=True)
    head, _, body = done.stdout.partition(b"\n")
    assert head == b'[1, [["t", [2]], ["i", [2]]]]'
    assert np.frombuffer(body).tolist() == [0.0, 0.5, 1.0, 2.0]
    path.write_bytes(b"PAR1")
    done = subprocess.run(command, capture_output=True, check=False)
    assert (done.returncode, done.stdout) == (1, b"")
    assert done.stderr.count(b"\n") <= 1
    array_parser.check_count(50_000_000)
    with pytest.raises(ValueError, match="unpacks to 50,000,001 numbers; at most 50,000,000 are read"):
        array_parser.check_count(50_000_001)


def test_a_profile_with_a_column_that_is_no_choice_is_named(tmp_path: Path) -> None:
    path = tmp_path / "p.toml"
    path.write_text('column = ["bench"]')
    with pytest.raises(InputError, match=r"p\.toml: --column must read QUANTITY=COLUMN.*got 'bench'"):
        load_profile(path)
