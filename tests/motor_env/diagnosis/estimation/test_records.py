"""From recordings to one record: averages, missing channels and samples, open circuits, converters' noise."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recorded_motor import plain, values

from motor_env import Recording
from motor_env.diagnosis.estimation import parameter_index as index
from motor_env.diagnosis.estimation.ekf import BEGIN, FOUND, LOST, OPEN
from motor_env.diagnosis.estimation.preprocessing import (
    at_terminals,
    block_means,
    from_recordings,
    liveliest_stretches,
    median_noise,
    missing_blocks,
    open_circuit,
)
from motor_env.diagnosis.estimation.record import Record, with_begins, with_holes

# Reaches in: what an alignment finds is told before any fit.
from motor_env.diagnosis.readers.alignment import align
from motor_env.diagnosis.readers.recording import UnusableError
from motor_env.diagnosis.readers.start import Circuit
from motor_env.motor.parameters import FloatArray

BOTH = np.ones(2)
VALUES = values(COULOMB=0.0, NOISE_I=0.02, NOISE_W=0.5)


def recorded(
    current: FloatArray,
    volts: FloatArray | None = None,
    speed: FloatArray | None = None,
    *,
    dt_s: float = 1e-3,
) -> Recording:
    n = len(current)
    speed = np.linspace(0.0, 1.0, n) if speed is None else speed
    voltage = np.linspace(-1.0, 1.0, n) if volts is None else volts
    return Recording(Path("x"), dt_s * np.arange(float(n)), current, voltage, speed)


@pytest.mark.parametrize(("ripple", "factor", "hold"), [(0.4, 2, "straight"), (1.0, 1, "held")])
def test_neighbours_are_averaged_where_their_means_tell_nearly_all(
    ripple: float, factor: int, hold: str
) -> None:
    """Of noise nothing counts; of a fast ripple a part is lost."""
    phase = np.arange(8_000.0)
    noise = 0.4 * np.random.default_rng(3).standard_normal(8_000)
    current = np.sin(0.05 * phase) + ripple * np.sin(0.7 * phase) + noise
    record = from_recordings([recorded(current)], most=4_000)
    assert (record.averaged, record.share, record.hold) == (factor, 0.5 * factor, hold)
    assert record.dt_s == pytest.approx(1e-3 * factor)


def test_records_hold_the_means_of_their_recordings() -> None:
    current, speed = np.arange(100.0) ** 2, np.arange(100.0)
    one = recorded(current, speed=speed)
    record = from_recordings([one, one], most=100)
    np.testing.assert_allclose(record.readings[:50, 0], 0.5 * (current[0:100:2] + current[1:100:2]))
    np.testing.assert_allclose(record.readings[50:, 1], np.arange(0.5, 100.0, 2.0))
    assert np.flatnonzero(record.begins).tolist() == [0, 50]
    assert (record.averaged, record.dt_s) == pytest.approx((2, 2e-3))
    assert block_means(np.arange(7.0), 3).tolist() == [1.0, 4.0]
    # What was averaged while it was read counts, too: its voltage is no held one.
    again = from_recordings([replace(one, averaged=3)], most=50)
    assert (again.averaged, again.hold) == (6, "straight")


def test_recordings_that_make_no_record_are_refused() -> None:
    one = recorded(np.arange(50.0))
    assert from_recordings([one, recorded(np.arange(50.0), dt_s=1.01e-3)]).dt_s == pytest.approx(1.005e-3)
    with pytest.raises(UnusableError, match="only 39 samples; at least 40 are needed"):
        from_recordings([recorded(np.arange(39.0))])
    with pytest.raises(UnusableError, match="differ in their sampling interval"):
        from_recordings([one, recorded(np.arange(50.0), dt_s=1.05e-3)])
    with pytest.raises(UnusableError, match="different columns"):
        from_recordings([one, replace(one, speed_rad_s=None)])
    with pytest.raises(UnusableError, match="neither the current nor the speed ever changes"):
        from_recordings([replace(one, current_a=np.zeros(50), speed_rad_s=None)])
    with pytest.raises(UnusableError, match="only where the voltage was recorded"):
        from_recordings([replace(one, voltage_v=None)])


def test_what_stands_still_counts_as_not_recorded() -> None:
    one = recorded(np.arange(50.0))
    assert from_recordings([one]).recorded.tolist() == [1.0, 1.0]
    assert from_recordings([replace(one, speed_rad_s=np.full(50, 3.0))]).recorded.tolist() == [1.0, 0.0]
    assert from_recordings([replace(one, current_a=np.zeros(50))]).recorded.tolist() == [0.0, 1.0]


def test_the_voltage_at_the_terminals() -> None:
    one = recorded(np.arange(50.0))
    duty = replace(one, voltage_v=None, duty=np.full(50, 0.25))
    assert at_terminals(duty, 12.0).voltage_v == pytest.approx(np.full(50, 3.0))
    shunted = at_terminals(one, None, Circuit(shunt_ohm=0.5)).voltage_v
    assert shunted == pytest.approx(np.linspace(-1.0, 1.0, 50) - 0.5 * np.arange(50.0))


def test_the_noise_of_a_column() -> None:
    white = np.random.default_rng(5).standard_normal(20_000)
    assert median_noise(0.03 * white + np.linspace(0.0, 2.0, 20_000)) == pytest.approx(0.03, rel=0.02)
    steps = np.repeat(np.arange(40.0), 50)
    assert median_noise(0.1 * steps) == pytest.approx(0.1 / math.sqrt(12.0))
    assert median_noise(steps % 2) == pytest.approx(0.02)  # a switch is no converter's step
    assert median_noise(np.full(50, 3.0)) == pytest.approx(3e-6)
    assert median_noise(np.zeros(50)) == 1e-12


def test_the_liveliest_stretch_of_each_part() -> None:
    volts = np.zeros(1000)
    volts[130:160:2] = volts[700:730:2] = 5.0
    found = liveliest_stretches(recorded(np.zeros(1000), volts), 0.1, count=2)
    assert [len(one.time_s) for one in found] == [50, 50]
    for one, begin, end in zip(found, (130, 700), (160, 730), strict=True):
        first, last = one.time_s[[0, -1]] * 1e3
        assert first < begin
        assert last >= end - 2.5
    assert len(liveliest_stretches(recorded(np.arange(1000.0), volts), 0.1)) == 10


def opened(voltage: FloatArray, current: FloatArray, speed: FloatArray, noise_a: float = 1e-3) -> list[int]:
    rng, n = np.random.default_rng(2), len(voltage)
    shown = np.stack([current + noise_a * rng.standard_normal(n), speed], axis=1)
    return np.flatnonzero(
        open_circuit(voltage + 1e-3 * rng.standard_normal(n), shown, np.eye(1, n)[0])
    ).tolist()


def test_a_speed_that_falls_without_current_is_an_open_circuit() -> None:
    """However the voltage is logged; without a speed, a diode may carry the current on, but no brake."""
    speed = np.concatenate([np.full(100, 200.0), 200.0 * np.exp(-np.arange(100) / 60.0), np.full(20, 200.0)])
    current = np.repeat([0.5, 0.0, 0.5], [100, 100, 20])
    voltage = 0.03 * speed + 2.0 * current
    assert opened(voltage, current, speed) == list(range(100, 200))
    voltage[100:200] = 0.0
    assert opened(voltage, current, speed) == list(range(100, 200))
    for sign, first in ((1.0, 103), (-1.0, 200)):
        current[100:103] = sign * np.array([0.3, 0.2, 0.1])
        assert opened(voltage, current, np.zeros(220)) == list(range(first, 200))


def test_a_circuit_that_closes_at_the_voltage_of_the_motor_is_closed_where_current_flows() -> None:
    after = np.arange(60)
    voltage = np.concatenate([np.full(50, 7.0), 6.0 - 0.02 * after[:50], np.full(60, 5.0)])
    current = np.concatenate([np.full(50, 0.5), np.zeros(50), 0.3 - 0.3 * np.exp(-after / 5.0)])
    found = opened(voltage, current, np.zeros(160))
    assert found[0] == 50
    assert 99 <= found[-1] <= 102


def test_a_motor_that_idles_is_no_open_circuit() -> None:
    """At a small current, and while its voltage steps; where the voltage falls steadily it coasts."""
    voltage, current = np.repeat([12.0, 6.0, 12.0], 100), np.repeat([0.02, 0.01, 0.02], 100)
    current[[100, 101, 200, 201]] = [-3.0, -1.0, 3.0, 1.0]
    assert opened(voltage, current, 30.0 * voltage, 0.02) == []
    voltage = np.repeat([12.0, 8.0, 8.3, -6.0], [40, 12, 12, 40])
    falling = 83.0 - np.minimum(np.arange(24), 12) * 0.3
    speed = np.concatenate([np.full(40, 120.0), falling, np.full(40, -60.0)])
    current = np.repeat([1.0, 0.0, 0.0, -1.0], [40, 12, 12, 40])
    assert opened(voltage, current, speed, 0.01) == []
    voltage[40:64] = np.linspace(8.3, 7.0, 24)
    assert set(range(44, 64)) <= set(opened(voltage, current, speed, 0.01))


def holed(
    n: int, voltage: Sequence[int], current: Sequence[int] = (), speed: Sequence[int] = ()
) -> Recording:
    columns: FloatArray = np.random.default_rng(2).uniform(4.0, 5.0, (3, n))
    columns[0] = np.linspace(3.0, 9.0, n)
    for column, lost in zip(columns, (voltage, current, speed), strict=True):
        column[list(lost)] = np.nan
    return Recording(Path("x"), np.linspace(0.0, 1e-3 * (n - 1), n), columns[1], columns[0], columns[2])


@pytest.mark.parametrize(
    ("voltage", "current", "speed", "begin", "lost", "found"),
    [
        ([20], [], [], [0], [19, 20, 21, 22], [23]),
        ([20, 22], [], [], [0], [*range(19, 25)], [25]),
        ([20, 24], [], [], [0], [*range(19, 27)], [27]),  # one hole follows the other
        ([20], [22, 23], [], [0], [*range(19, 25)], [25]),
        ([20], [], [23, 24], [0], [19, 20, 21, 22], [23, 24, 25]),
        ([], [20, 21], [40], [0], [], []),
        ([59], [], [], [0], [58, 59], []),
        ([], [0, 1], [3], [*range(5)], [], []),
        ([1], [], [], [0, 1, 2, 3], [], [4]),
    ],
)
def test_samples_that_a_hole_makes_unknown(
    voltage: list[int],
    current: list[int],
    speed: list[int],
    begin: list[int],
    lost: list[int],
    found: list[int],
) -> None:
    """An interval that may have held a missing voltage is lost, and then the state is found."""
    marks = from_recordings([holed(60, voltage, current, speed)]).marks
    places = [np.flatnonzero(marks == mark).tolist() for mark in (BEGIN, LOST, FOUND)]
    assert places == [begin, lost, found]


def test_a_recording_begins_once_all_channels_are_read() -> None:
    marks, readings = np.zeros(8), np.zeros((8, 2))
    marks[[0, 5]], readings[[0, 5], 1] = BEGIN, np.nan
    assert np.flatnonzero(with_begins(marks, readings, BOTH)).tolist() == [0, 1, 5, 6]
    assert np.flatnonzero(with_begins(marks, readings, np.array([1.0, 0.0]))).tolist() == [0, 5]
    stretches = from_recordings([holed(120, [], current=[60, 61])]).sample(80)
    assert np.flatnonzero(stretches.marks).tolist() == sorted([*range(0, 80, 8), 41, 42])
    # An open circuit needs no voltage, but a hole does not know of it.
    found = with_holes(np.full(10, OPEN), np.arange(10) == 5, np.zeros((10, 2)), BOTH)
    assert found.tolist() == [OPEN] * 4 + [LOST] * 4 + [FOUND, OPEN]


def test_what_counts() -> None:
    record = from_recordings([holed(60, [20], current=[40], speed=[41])])
    assert (~record.informative[:, 0]).nonzero()[0].tolist() == [19, 20, 21, 22, 23, 40]
    assert (~record.informative[:, 1]).nonzero()[0].tolist() == [19, 20, 21, 22, 23, 41]
    assert record.count == 2 * 60 - 12 - 2
    with pytest.raises(UnusableError, match="only 34 of 60 samples are there"):
        from_recordings([holed(60, [10, 14, 18, 22, 26, 30])])


def worked() -> tuple[Record, FloatArray]:
    volts = np.repeat(np.random.default_rng(3).uniform(-9.0, 9.0, 20), 20)
    return plain(400, volts, "late"), volts


@pytest.mark.parametrize("lag", [0.0, 1e-3])
def test_behind_an_unknown_voltage_the_model_is_as_sure_as_before(lag: float) -> None:
    record, volts = worked()
    lagging = VALUES.copy()
    lagging[index.LAG_I] = lag
    clean = record.predict(lagging, learn=False)[0][:, 2:4]
    readings = clean + np.random.default_rng(8).standard_normal((400, 2)) * [0.02, 0.5]
    steps = np.append(False, np.diff(volts) != 0.0)
    lied = replace(record, readings=readings, voltage_v=np.where(steps, -volts, volts))
    marked = replace(lied, marks=with_holes(record.marks, steps, readings, BOTH))
    assert lied.predict(lagging)[0][:, :2].std() > 5.0
    white = marked.predict(lagging)[0][:, :2]
    told = white[marked.informative & (marked.marks != BEGIN)[:, None]]
    assert told.std() == pytest.approx(1.0, abs=0.1)
    assert np.abs(told).max() < 4.5
    assert not white[~marked.informative].any()


def test_the_free_model_begins_again_behind_a_hole() -> None:
    record, volts = worked()
    clean = record.predict(VALUES, learn=False)[0][:, 2:4]
    hole = (np.arange(400) >= 200) & (np.arange(400) < 260)
    readings = clean + np.random.default_rng(3).standard_normal((400, 2)) * [0.02, 0.5]
    readings[hole] = np.nan
    guessed, marks = np.where(hole, 0.0, volts), with_holes(record.marks, hole, readings, BOTH)
    marked = replace(record, voltage_v=guessed, readings=readings, marks=marks)
    table, logs = marked.predict(VALUES, learn=False)
    # What is lost tells nothing of the noise: of the others each variance counts, with that of the first reading.
    counted = (marked.informative & (marked.marks != BEGIN)[:, None]).sum(axis=0)
    assert logs == pytest.approx(counted @ np.log(2.0 * np.square([0.02, 0.5])))
    assert np.nanmax(np.abs((table[:, 2:4] - readings)[262:] / [0.02, 0.5])) < 5.0
    changes = np.square(np.diff(guessed))
    seen = changes[marked.marks[1:] != LOST].sum() / changes.sum()
    assert marked.visible_step_share == pytest.approx(seen)
    assert 0.5 < seen < 0.95
    assert record.visible_step_share == 1.0


def test_a_mean_is_missing_where_more_than_a_tenth_of_it_is() -> None:
    recording = holed(80, [3, 25, 26], current=[45])
    assert not missing_blocks(recording, 20)[:, 0].any()
    assert np.flatnonzero(missing_blocks(recording, 10)[:, 0]).tolist() == [2]
    assert np.flatnonzero(missing_blocks(recording, 5)[:, 1]).tolist() == [9]
    assert not missing_blocks(replace(recording, missing=None), 7).any()


def test_a_voltage_less_that_of_a_shunt_is_missing_with_the_current() -> None:
    recording = holed(50, [3], current=[7])
    for ohm, lost in ((0.1, [3, 7]), (0.0, [3])):
        missing = at_terminals(recording, circuit=Circuit(shunt_ohm=ohm)).missing
        assert missing is not None
        assert np.flatnonzero(missing[:, 0]).tolist() == lost


def start(
    noise: float = 0.0, peak: float = 60.0, rise: float = 30.0, decay: float = 900.0, level: float = 5.0
) -> FloatArray:
    after = np.arange(6_000.0)
    shape = np.exp(-after / decay) - np.exp(-after / rise)
    current = np.concatenate(
        [np.zeros(1_000), peak * shape / shape.max() + level * (1.0 - np.exp(-after / rise))]
    )
    return current + noise * np.random.default_rng(4).standard_normal(len(current))


def recording(current_a: FloatArray) -> Recording:
    return Recording(Path("coarse"), np.linspace(0.0, (len(current_a) - 1) * 1e-4, len(current_a)), current_a)


@pytest.mark.parametrize("noise", [0.0, 0.1])
@pytest.mark.parametrize("rise", [3.0, 30.0, 200.0])
def test_a_round_peak_in_coarse_steps_is_not_clipped(rise: float, noise: float) -> None:
    """Its top step lasts long, and it is reached fast: a clipped one is also left fast."""
    current = start(noise, rise=rise)
    assert align(recording(np.round(current))).saturation == ""
    clipped = np.round(np.minimum(current, 0.8 * current.max()))
    assert align(recording(clipped)).saturation != ""


@pytest.mark.parametrize("noise", [0.25, 0.3, 0.4, 0.5])
def test_what_the_steps_hide_of_a_steady_current_is_known(noise: float) -> None:
    """Over all places of the current within a step; the offset of the sensor is in another place each time."""
    rng = np.random.default_rng(5)
    sawtooth = 2.0**-0.5 / math.pi  # its first harmonic
    true_bias = sawtooth * math.exp(-2.0 * (math.pi * noise) ** 2)
    told = [
        align(recording(np.round(start() + offset + noise * rng.standard_normal(7_000)))).unseen_level_a
        for offset in rng.uniform(-0.5, 0.5, 20)
    ]
    assert true_bias < np.median(told) < 2.0 * true_bias
    assert min(told) > 0.5 * true_bias
