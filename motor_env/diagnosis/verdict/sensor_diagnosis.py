"""Diagnose the sensors of a recording before its motor.

The healthy motor is simulated under the recorded voltage: it gives size and course of each channel. Any two of three
channels give the third by V = R i + L di/dt + K w. The limits are wider than any wear.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import permutations
from typing import Any, Literal, NamedTuple

import numpy as np

from motor_env.diagnosis.estimation import ekf, parameter_index as index
from motor_env.diagnosis.estimation.record import Record
from motor_env.diagnosis.estimation.starts.start_identification import (
    COUPLINGS_PER_S,
    identify,
    likelihood_gain,
)
from motor_env.diagnosis.readers.alignment import align, clipped_run
from motor_env.diagnosis.readers.noise import difference_noise
from motor_env.diagnosis.readers.recording import Recording, UnusableError
from motor_env.diagnosis.readers.start import Circuit
from motor_env.diagnosis.verdict.judgement import Judgement, Verdict
from motor_env.diagnosis.verdict.scaling_errors import READ_SO
from motor_env.motor.data_sheet import Motor
from motor_env.motor.faults import FaultKind
from motor_env.motor.parameters import FloatArray

_HELD = 1e9  # times the inertia: the rotor stays where it is


class ChannelRecord(NamedTuple):
    """Channels of a record.

    Attributes:
        dt_s: sampling interval.
        voltage_v: shape (n,).
        current_a, speed_rad_s: shape (n,); None without a column.
        has_sign: whether the sign of the voltage is known.
        at_work: whether it is a log; the quiet part of a start gives its offset.
        is_taught: whether the healthy motor was learned from recordings, so that signs and ranges are known.
    """

    dt_s: float
    voltage_v: FloatArray
    current_a: FloatArray | None
    speed_rad_s: FloatArray | None
    has_sign: bool = True
    at_work: bool = True
    is_taught: bool = True

    def from_sample(self, first: int) -> ChannelRecord:
        """Return the record from a sample on."""
        current, speed = (
            None if each is None else each[first:] for each in (self.current_a, self.speed_rad_s)
        )
        return self._replace(voltage_v=self.voltage_v[first:], current_a=current, speed_rad_s=speed)


def free_run(
    physical: FloatArray, voltage_v: FloatArray, dt_s: float, *, from_rest: bool = False
) -> tuple[FloatArray, FloatArray]:
    """Simulate current and speed under a voltage, all of shape (n,), from the steady state or from rest."""
    values = physical.copy()
    values[[index.NOISE_I, index.NOISE_W]], values[index.NOISE_V : index.WALK + 1] = 1.0, 0.0
    n = len(voltage_v)
    marks = np.append(ekf.REST if from_rest else ekf.STEADY, np.zeros(n - 1))
    table = Record(dt_s, voltage_v, np.zeros((n, 2)), np.zeros(2), marks).predict(values, learn=False)[0]
    return table[:, 2], table[:, 3]


def held_current(physical: FloatArray, voltage_v: FloatArray, dt_s: float) -> FloatArray:
    """Simulate the current of a held rotor without brush drop, shape (n,)."""
    values = physical.copy()
    values[index.J], values[index.DROP] = _HELD * physical[index.J], 0.0
    return free_run(values, voltage_v, dt_s, from_rest=True)[0]


def rms(values: FloatArray) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def correlation(first: FloatArray | None, second: FloatArray | None, *, about: float | None = None) -> float:
    """Correlate two channels about their means or a value; 0 if one is constant or missing."""
    if first is None or second is None:
        return 0.0
    a, b = (each - (each.mean() if about is None else about) for each in (first, second))
    product = rms(a) * rms(b)
    return float(np.mean(a * b)) / product if product > 0.0 else 0.0


_NOTHING = 0.05  # of the healthy motor's size: a smaller channel is dead ...
_A_SCALE = 0.7  # ... unless so much of its variance follows the motor: then it has another unit
# Correlations, from the same motion to the opposite one.
_ALIKE, _LOW_CORRELATION, _AGAINST, _OPPOSITE = 0.8, 0.3, -0.2, -0.6
_SAME_SIZE = 2.0
_FEWEST, _SHORTEST = 20, 0.05  # equal samples at the end, and their share of the record
_MOVES, _NOISE_BEFORE = 0.2, 200  # of a channel's range; samples
_ON = 0.1  # of the largest voltage
_ABOVE, _MOSTLY = 1.1, 0.5  # what the motor shows over the top of a clipped channel; share of the samples
_OFFSET_AT_REST, _OFFSET = 0.05, 0.15  # of the current of a rotor that is held
_BLOCK_S = 0.02  # of samples that are averaged: L/R is shorter
_CLEARLY, _CERTAIN = 0.95, 40.0  # of the error (rms), and -2 log likelihood, by one more unknown
_STANDS, _TURNS_BACK = 0.02, 0.1  # of the largest voltage and speed; share of the samples


def describe_coupling(per_s: float) -> str:
    """Describe a current behind a capacitor, with its time constant if it is that of a probe."""
    about = f" of about {1.0 / per_s:.2g} s" if COUPLINGS_PER_S[0] < per_s < COUPLINGS_PER_S[1] else ""
    return f"the current is AC-coupled: a high pass{about} takes its level away: set the probe to DC"


def sensor_judgement(kind: str, why: str) -> Judgement:
    """Judge a piece by its failed sensor alone."""
    fault = FaultKind(kind)
    return Judgement(Verdict.SENSOR, (why, fault.finding), fault_kind=fault, kind_probability=1.0)


def find_failure(record: ChannelRecord, physical: FloatArray) -> Judgement | None:
    """Find the failed sensor of a record, given the motor's approximate physical values; None without one."""
    current, speed = free_run(physical, record.voltage_v, record.dt_s, from_rest=not record.at_work)
    if not (np.isfinite(current).all() and np.isfinite(speed).all()):
        return None
    expected = record._replace(current_a=current, speed_rad_s=speed)
    if not record.has_sign:  # assume the recorded direction
        pair = (record.current_a, current) if record.speed_rad_s is None else (record.speed_rad_s, speed)
        turned = -1.0 if correlation(*pair, about=0.0) < 0.0 else 1.0
        volts = turned * record.voltage_v
        record, expected = (
            record._replace(voltage_v=volts),
            ChannelRecord(record.dt_s, volts, turned * current, turned * speed),
        )
    checks = [_check_swapped, _check_dead, _check_stuck]
    checks += [_check_contradiction, _check_clipped] if record.at_work or record.is_taught else []
    checks += [_check_coupled, _check_offset] if record.at_work else []
    failures = (check(record, expected, physical) for check in checks)
    return next(filter(None, failures), None)


def _channels(
    record: ChannelRecord, expected: ChannelRecord
) -> Iterator[tuple[str, str, FloatArray, FloatArray]]:
    """Yield name, unit, readings and expected values of each channel that has a column."""
    channels = (
        ("current", "A", record.current_a, expected.current_a),
        ("speed", "rad/s", record.speed_rad_s, expected.speed_rad_s),
    )
    for name, unit, measured, healthy in channels:
        if measured is not None and healthy is not None:
            yield name, unit, measured, healthy


def _predict_from_others(
    record: ChannelRecord, physical: FloatArray
) -> tuple[FloatArray | None, FloatArray | None]:
    """Predict current and speed, each from the voltage and the other, for any load."""
    if record.current_a is None or record.speed_rad_s is None:
        return None, None
    ohm, constant = float(physical[index.R]), float(physical[index.K])
    current = held_current(physical, record.voltage_v - constant * record.speed_rad_s, record.dt_s)
    return current, (record.voltage_v - ohm * record.current_a) / constant


def _smallest_step(values: FloatArray) -> float:
    """Return the smallest step; infinite if there is none."""
    steps = np.abs(np.diff(values))
    return float(np.min(steps, where=steps > 0.0, initial=np.inf))


def _is_turning(record: ChannelRecord, expected: ChannelRecord, physical: FloatArray) -> bool | None:
    """Whether the current is that of a turning motor; False for a held rotor, None for neither."""
    if record.current_a is None or expected.current_a is None:
        return None
    blocked = held_current(physical, record.voltage_v, record.dt_s)
    error, error_held = rms(record.current_a - expected.current_a), rms(record.current_a - blocked)
    if error < _MOSTLY * error_held and correlation(record.current_a, expected.current_a) > _ALIKE:
        return True
    return False if error_held < error else None


def _check_dead(record: ChannelRecord, expected: ChannelRecord, physical: FloatArray) -> Judgement | None:
    """Find a channel without a signal, if another one shows that the motor turns, or is missing."""
    for name, unit, measured, healthy in _channels(record, expected):
        if rms(measured) >= _NOTHING * rms(healthy) or correlation(measured, healthy) ** 2 >= _A_SCALE:
            continue
        why = f"the {name} is {rms(measured):.3g} {unit} effective where the healthy motor shows {rms(healthy):.3g}"
        if name == "current":
            turns = abs(correlation(record.speed_rad_s, expected.speed_rad_s, about=0.0)) > _ALIKE
            is_dead = turns or (record.speed_rad_s is None and record.is_taught)
            return sensor_judgement("current_dead", f"{why} {unit}") if is_dead else None
        turning = _is_turning(record, expected, physical)
        if turning or record.current_a is None:
            return sensor_judgement("speed_dead", f"{why} {unit}")
        if turning is None:
            neither = "and the current is neither that of this motor nor that of a held rotor"
            return Judgement(Verdict.UNUSABLE, (f"{why} {unit}, {neither}",))
    return None


def _check_stuck(record: ChannelRecord, expected: ChannelRecord, physical: FloatArray) -> Judgement | None:
    """Find a channel that ends in equal values while the motor moves, or that loses its noise."""
    on = np.abs(record.voltage_v) > _ON * np.max(np.abs(record.voltage_v))
    for name, _, measured, healthy in _channels(record, expected):
        others = np.flatnonzero(measured != measured[-1])
        first = int(others[-1]) + 1 if len(others) else 0
        powered = healthy[first:][on[first:]]
        if len(measured) - first < max(_FEWEST, _SHORTEST * len(measured)) or len(powered) < _FEWEST:
            continue
        is_none = abs(float(measured[-1])) < _NOTHING * rms(healthy)
        if is_none and not _motor_runs_on(name, first, record, expected, physical):
            continue
        quantum, before = _smallest_step(measured[:first]), measured[max(first - _NOISE_BEFORE, 0) : first]
        is_noisy = len(before) > _FEWEST and difference_noise(before) > quantum
        is_moving = np.ptp(powered) > max(_MOVES * np.ptp(healthy), 3.0 * min(quantum, np.ptp(measured)))
        if is_moving or is_noisy:
            count = len(measured) - first
            words = f"the {name} reads {measured[-1]:.4g} for its last {count} samples, while the motor runs"
            return sensor_judgement(f"{name}_stuck", words)
    return None


def _motor_runs_on(
    name: str, first: int, record: ChannelRecord, expected: ChannelRecord, physical: FloatArray
) -> bool:
    """Whether the other channel shows that the motor moves from a sample on."""
    if name == "speed":
        return bool(_is_turning(record.from_sample(first), expected.from_sample(first), physical))
    speed = record.speed_rad_s
    return speed is not None and bool(np.ptp(speed[first:]) > _MOVES * np.ptp(speed))


def explain_coupling(record: ChannelRecord | Recording) -> str | None:
    """Explain that the current of a log is AC-coupled; None where nothing says so."""
    rate, gain = _coupling(record)
    return describe_coupling(rate) if gain > _CERTAIN else None


def _check_coupled(record: ChannelRecord, expected: ChannelRecord, physical: FloatArray) -> Judgement | None:
    """Find a current behind a capacitor."""
    reason = explain_coupling(record)
    return None if reason is None else Judgement(Verdict.UNUSABLE, (reason,))


def _coupling(record: ChannelRecord | Recording) -> tuple[float, float]:
    """Fit the charge that a current lacks over a time constant s: V = K w + R (i + charge / s), for any load.

    Return 1/s, and the fall of -2 log likelihood by it; 0 where it is that of no probe.
    """
    if record.voltage_v is None or record.current_a is None or record.speed_rad_s is None:
        return 0.0, 0.0
    n, block = len(record.voltage_v), max(round(_BLOCK_S / record.dt_s), 1)
    if n < _FEWEST * block:
        return 0.0, 0.0
    charge = record.dt_s * np.cumsum(record.current_a - record.current_a.mean())
    channels = (record.speed_rad_s, np.ones(n), np.arange(n), record.current_a, charge, record.voltage_v)
    *shown, volts = np.column_stack(channels)[: n // block * block].reshape(-1, block, 6).mean(axis=1).T
    fits = [np.linalg.lstsq(np.column_stack(some), volts)[0] for some in (shown, shown[:-1])]
    left, direct = (rms(volts - np.column_stack(shown[: len(fit)]) @ fit) for fit in fits)
    rate = float(fits[0][4] / fits[0][3]) if fits[0][3] else 0.0
    is_one = COUPLINGS_PER_S[0] < rate < COUPLINGS_PER_S[1] and 0.0 < left < _CLEARLY * direct
    return (rate, 2.0 * len(volts) * float(np.log(direct / left))) if is_one else (0.0, 0.0)


def _check_swapped(record: ChannelRecord, expected: ChannelRecord, physical: FloatArray) -> Judgement | None:
    """Find another order of the columns that alone matches the healthy motor."""
    if (
        record.current_a is None
        or record.speed_rad_s is None
        or not record.has_sign
        or _matches_motor(record, expected)
    ):
        return None
    names, columns = ("voltage", "current", "speed"), (record.voltage_v, record.current_a, record.speed_rad_s)
    for order in list(permutations(range(3)))[1:]:
        volts, amps, speed = (columns[n] for n in order)
        read = ChannelRecord(record.dt_s, volts, amps, speed)
        if _matches_motor(read, ChannelRecord(record.dt_s, volts, *free_run(physical, volts, record.dt_s))):
            moved = " and ".join(name for n, name in enumerate(names) if order[n] != n)
            return sensor_judgement("swapped", f"{moved} {READ_SO}")
    return None


def _matches_motor(record: ChannelRecord, expected: ChannelRecord) -> bool:
    """Whether all channels move as expected, and about as far."""
    return all(
        correlation(measured, healthy) > _ALIKE and _has_similar_size(measured, healthy)
        for _, _, measured, healthy in _channels(record, expected)
    )


def _has_similar_size(measured: FloatArray, healthy: FloatArray) -> bool:
    return 1.0 / _SAME_SIZE < rms(measured) / max(rms(healthy), 1e-300) < _SAME_SIZE


def _check_contradiction(
    record: ChannelRecord, expected: ChannelRecord, physical: FloatArray
) -> Judgement | None:
    """Find a channel that contradicts the others: reversed, or of another quantity."""
    by_speed, by_current = _predict_from_others(record, physical)
    current = correlation(record.current_a, expected.current_a)
    speed = correlation(record.speed_rad_s, expected.speed_rad_s, about=0.0)
    is_pair = by_speed is None  # voltage, and one of the others
    by_both = correlation(record.current_a, by_speed)
    current_at_most, current_agreed = (
        max(current, by_both),
        correlation(expected.current_a, by_speed) > _ALIKE,
    )
    speed_at_most = max(
        correlation(record.speed_rad_s, expected.speed_rad_s), correlation(record.speed_rad_s, by_current)
    )
    speed_agreed = correlation(expected.speed_rad_s, by_current) > _ALIKE
    # The noise of a coarse channel, such as a speed by few edges, bounds its correlation.
    lowest_correlation = {
        name: _LOW_CORRELATION * _highest_correlation(measured, healthy)
        for name, _, measured, healthy in _channels(record, expected)
    }
    # A speed in another unit is no evidence on the current, and vice versa.
    sizes = {
        name: _has_similar_size(measured, healthy)
        for name, _, measured, healthy in _channels(record, expected)
    }
    against = (current_agreed and current_at_most < _AGAINST) or (by_both < _OPPOSITE and current < -_AGAINST)
    contradictions = {
        ("voltage_polarity", "current and speed both go against the voltage of the healthy motor"): (
            speed < -_ALIKE and current < _AGAINST
        ),
        ("speed_polarity", "the speed goes against the voltage, and the current does not"): speed < -_ALIKE,
        ("current_polarity", "the current goes against the voltage of the healthy motor"): (
            is_pair and record.has_sign and current < -_ALIKE
        ),
        ("current_polarity", "the current goes against voltage and speed"): speed > _ALIKE and against,
        ("swapped", "the current is not that of the motor that has this voltage and speed"): (
            speed > _ALIKE
            and sizes["speed"]
            and current_agreed
            and current_at_most < lowest_correlation["current"]
        ),
        ("swapped", "the speed is not that of the motor that has this voltage and current"): (
            current > _ALIKE
            and sizes["current"]
            and speed_agreed
            and speed_at_most < lowest_correlation["speed"]
        ),
    }
    return next(
        (sensor_judgement(kind, words) for (kind, words), is_shown in contradictions.items() if is_shown),
        None,
    )


def _highest_correlation(measured: FloatArray, healthy: FloatArray) -> float:
    """Return the correlation of the healthy values with themselves plus the noise of a channel."""
    return float(np.std(healthy) / max(np.hypot(np.std(healthy), difference_noise(measured)), 1e-300))


def _check_clipped(record: ChannelRecord, expected: ChannelRecord, physical: FloatArray) -> Judgement | None:
    """Find a channel that saturates where the motor goes beyond, and follows it elsewhere."""
    by_speed, _ = _predict_from_others(record, physical)
    for name, unit, measured, free in _channels(record, expected):
        healthy = free if name == "speed" or by_speed is None else by_speed
        top = float(np.max(np.abs(measured)))
        flat = np.abs(np.abs(measured) - top) <= 1e-9 * top
        if top == 0.0 or flat.mean() > _MOSTLY or not clipped_run(measured, _smallest_step(measured)):
            continue
        # An encoder of few edges repeats its largest value, too, but not wherever the motor goes beyond.
        above = np.abs(healthy) > _ABOVE * top
        both = np.count_nonzero(above & flat)
        is_more = bool(both > _MOSTLY * max(np.count_nonzero(flat), np.count_nonzero(above)))
        # A controlled quantity is constant in the healthy motor, too.
        is_more = is_more and float(np.ptp(np.abs(healthy[flat]))) > (_ABOVE - 1.0) * top
        limited = np.clip(healthy, -top, top)
        if (
            is_more
            and correlation(measured, limited) > _ALIKE
            and rms(measured - limited) < _MOSTLY * rms(measured)
        ):
            largest = float(np.max(np.abs(healthy)))
            words = f"{int(flat.sum())} samples of the {name} stand at {top:.4g} {unit}"
            return sensor_judgement(
                f"{name}_clipped", f"{words}, where the healthy motor reaches {largest:.3g} {unit}"
            )
    return None


def _check_offset(record: ChannelRecord, expected: ChannelRecord, physical: FloatArray) -> Judgement | None:
    """Find a constant offset of the current: at rest, or of a motor that reverses."""
    current, speed = record.current_a, record.speed_rad_s
    if current is None or speed is None or correlation(record.current_a, expected.current_a) < _ALIKE:
        return None
    sizes = [np.abs(each) / np.max(np.abs(each)) for each in (record.voltage_v, speed)]
    rests = (sizes[0] < _STANDS) & (sizes[1] < _STANDS)
    rests[1:] &= rests[:-1].copy()  # a current may be that of the voltage before
    turning = [float(np.mean((sign * speed > 0.0) & (sizes[1] > _ON))) for sign in (-1.0, 1.0)]
    known = float(physical[index.OFFSET_I])
    by_speed = np.asarray(_predict_from_others(record, physical)[0]) - known
    if np.count_nonzero(rests) >= _FEWEST:
        # A controller may apply a small voltage at standstill. A speed in another unit is not at rest.
        standing_current_a = record.voltage_v / physical[index.R]
        offset = min(
            (float(np.mean((current - each)[rests])) for each in (by_speed, standing_current_a)), key=abs
        )
        limit = _OFFSET_AT_REST
    elif min(turning) > _TURNS_BACK:
        shapes = np.stack([np.ones(len(current)), by_speed, speed, np.sign(speed)], axis=1)
        offset, limit = float(np.linalg.lstsq(shapes, current, rcond=None)[0][0]), _OFFSET
    else:
        return None
    # A missing offset is no failure: that of the healthy fit may not be the sensor's. Scale a current in mA to A.
    offset = min(offset, offset - known, key=abs) / max(rms(current) / rms(by_speed), 1.0)
    if abs(offset) < limit * float(np.max(np.abs(record.voltage_v)) / physical[index.R]):
        return None
    return sensor_judgement(
        "current_offset", f"the current is off by {offset:.3g} A at every voltage and speed"
    )


_LIKE_COUPLED = (
    "a probe that is AC-coupled (a high pass of about {:.2g} s) shows this: set it to DC, and record again"
)
_LEAST_GAIN_BY_SHEET, _LEAST_GAIN = -6.0, 6.0  # -2 log likelihood
_OWN_DRAG = 0.1  # of the drag of a motor in its machine: it keeps more than that without its load


def check_coupling(
    judgement: Judgement, constant: float | None = None, part: Recording | None = None
) -> Judgement:
    """Judge a piece that no fault explains, and whose friction fell alone, or beside its resistance: none lowers it.

    Over the time constant s an AC coupling lowers B/J by 1/s. A machine may have lost its load, so there a start must
    tell the coupling. A data sheet is of a motor that has none to lose, and no motor loses nearly all of its drag:
    there the recording need only allow it.
    """
    fit, reference = judgement.identified, judgement.reference
    moved = {change.name[0] for change in judgement.changes if change.significant}
    down = next((c for c in judgement.changes if c.name[0] == "B" and c.high < 1.0), None)
    if reference is None or down is None:
        return judgement
    is_gone = judgement.verdict is Verdict.HEALTHY and down.ratio < _OWN_DRAG  # too little to be told
    if not is_gone and (judgement.verdict is not Verdict.OTHER or "B" not in moved or moved & set("KJ")):
        return judgement
    usual, gain = {name.removesuffix("/V"): value for name, value in reference.values.items()}, 0.0
    rate = (usual["B/J"] if "B/J" in usual else usual["B"] / usual["J"]) * (1.0 - down.ratio)
    if fit is not None:
        direct = replace(fit.start, current_a=fit.start.current_a + rate * fit.start.charge_a_s)
        gain = likelihood_gain(fit, identify(direct, fit.model, constant=constant, typical=reference.values))
    elif part is not None:
        gain = _coupling(part)[1]
    may_lose_load = reference.is_taught and down.ratio > _OWN_DRAG
    if gain < (_LEAST_GAIN if may_lose_load else _LEAST_GAIN_BY_SHEET):
        return replace(judgement, reasons=(*judgement.reasons, _LIKE_COUPLED.format(1.0 / rate)))
    why = f"{down.name} is down by {1.0 - down.ratio:.0%}, and no fault lowers friction"
    unusable = judgement.as_other(why, _LIKE_COUPLED.format(1.0 / rate))
    return replace(unusable, verdict=Verdict.UNUSABLE, confidence=None)


_BACKWARDS = "the current has the other sign than in all healthy starts: it is reversed, or the motor started backwards"

_POLARITY_COLUMNS: dict[str, Literal["current_a", "speed_rad_s", "voltage_v"]] = {
    "current_polarity": "current_a",
    "speed_polarity": "speed_rad_s",
    "voltage_polarity": "voltage_v",
}


def diagnose_sensors(
    recording: Recording,
    motor: Motor,
    voltage_v: float | None = None,
    circuit: Circuit | None = None,
    *,
    at_work: bool = False,
) -> Judgement | None:
    """Judge a recording by a failed sensor; None without one, or without a voltage.

    Args:
        recording: one start, or a log.
        motor: the healthy motor.
        voltage_v: level of the supply where it was not recorded.
        circuit: the measuring circuit.
        at_work: whether it is a log.
    """
    starts = None if motor.healthy is None else motor.healthy.starts
    if starts is not None and starts.direction and _starts_backwards(recording, starts.direction):
        return sensor_judgement("current_polarity", _BACKWARDS).on(recording)
    recording = recording if starts is None else _turn_signs(recording, starts.turned)
    record = _record_channels(recording, motor.nominal_voltage_v if voltage_v is None else voltage_v)
    if record is None:
        return None
    speed = record.speed_rad_s
    if not (at_work or _has_learned_speed(motor)) and speed is not None and not np.ptp(speed):
        # The column never moves, nor did it when the motor was learned.
        record = record._replace(speed_rad_s=None)
    physical = physical_values(motor)
    physical[index.R] += 0.0 if circuit is None else circuit.shunt_ohm
    failure = find_failure(record._replace(at_work=at_work, is_taught=motor.healthy is not None), physical)
    return None if failure is None else failure.on(recording)


def physical_values(motor: Motor) -> FloatArray:
    """Return a healthy motor's values in the order of `estimation.parameter_index`, shape (N_VALUES,)."""
    if motor.healthy is not None and motor.healthy.windows is not None:
        physical = motor.healthy.windows.physical.copy()
        learned = dict(zip(motor.healthy.quantities, motor.healthy.values.tolist(), strict=True))
        index_of = {"R": index.R, "K": index.K, "J": index.J}
        for name in learned.keys() & index_of:
            physical[index_of[name]] = learned[name]
        return physical
    known, values = motor.parameters, np.zeros(index.N_VALUES)
    constant = np.sqrt(known.back_emf_constant_v_s_per_rad * np.asarray(known.torque_constant_n_m_per_a))
    values[[index.R, index.L, index.K, index.J, index.B, index.COULOMB, index.DROP]] = (
        known.resistance_ohm,
        known.inductance_h,
        constant,
        known.inertia_kg_m2,
        known.viscous_friction_n_m_s_per_rad,
        motor.coulomb_friction_n_m,
        motor.brush_drop_v,
    )
    return values


def _record_channels(recording: Recording, level_v: float | None) -> ChannelRecord | None:
    """Return the channels, with a step of the supply if the voltage was not recorded; None without its level."""
    voltage, has_sign = recording.voltage_v, True
    if voltage is None and recording.duty is not None and level_v is not None:
        voltage = level_v * recording.duty
    if voltage is None:
        onset = _onset_index(recording)
        if onset is None or level_v is None:
            return None
        voltage, has_sign = np.where(np.arange(len(recording.time_s)) >= onset, level_v, 0.0), False
    if not np.any(voltage):
        return None
    return ChannelRecord(recording.dt_s, voltage, recording.current_a, recording.speed_rad_s, has_sign)


def learn_signs(motor: Motor, healthy: Sequence[Recording], voltage_v: float | None) -> Motor:
    """Return the motor with the column that has the other sign in all its healthy starts."""
    failures = [diagnose_sensors(recording, motor, voltage_v) for recording in healthy]
    kinds = {None if failure is None else failure.fault_kind for failure in failures}
    column = next((name for kind, name in _POLARITY_COLUMNS.items() if kinds == {FaultKind(kind)}), None)
    if column is None or motor.healthy is None or motor.healthy.starts is None:
        return motor
    return replace(
        motor, healthy=replace(motor.healthy, starts=replace(motor.healthy.starts, turned=(column,)))
    )


def _has_learned_speed(motor: Motor) -> bool:
    """Whether the healthy pieces were recorded with the speed."""
    return motor.healthy is not None and not {"K", "K/V"}.isdisjoint(motor.healthy.quantities)


def _turn_signs(recording: Recording, names: Sequence[str]) -> Recording:
    """Return the recording with the sign of some columns changed."""
    changed: dict[str, Any] = {
        name: None if getattr(recording, name) is None else -getattr(recording, name) for name in names
    }
    return replace(recording, **changed)


def _starts_backwards(recording: Recording, direction: int) -> bool:
    """Whether a lone current has the other sign than that of the healthy starts."""
    if any(column is not None for column in (recording.voltage_v, recording.duty, recording.speed_rad_s)):
        return False
    with suppress(UnusableError):
        return align(recording).sign * direction < 0.0
    return False


def _onset_index(recording: Recording) -> int | None:
    """Return the sample at which the current, else the speed, begins to move."""
    for column in (recording.current_a, recording.speed_rad_s):
        if column is not None:
            try:
                return align(replace(recording, current_a=column)).onset_index
            except UnusableError:
                continue
    return None
