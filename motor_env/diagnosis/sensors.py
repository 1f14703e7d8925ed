"""Sensors before motors: a channel that carries nothing, or that contradicts the others, tells nothing of the motor.

The healthy motor runs freely under the recorded voltage: so large is what each channel must show, and so it must move.
Of three channels any two tell the third by V = R i + L di/dt + K w. The limits are wide: no wear moves a motor so far.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

from motor_env.diagnosis.misreading import READ_SO
from motor_env.diagnosis.verdict import Judgement, Verdict
from motor_env.fitting import kernel, places
from motor_env.fitting.record import Record
from motor_env.motor.data_sheet import Motor
from motor_env.motor.faults import FaultKind
from motor_env.motor.parameters import FloatArray
from motor_env.recordings.alignment import align
from motor_env.recordings.defects import UnusableError
from motor_env.recordings.noise import difference_noise
from motor_env.recordings.recording import Recording
from motor_env.recordings.start import Circuit

_NOTHING = 0.05  # of what the healthy motor shows: a channel of less is dead ...
_A_SCALE = 0.7  # ... unless so much of its variance follows the motor: then it has another unit
_ALIKE, _APART, _AGAINST, _OPPOSITE = 0.8, 0.3, -0.2, -0.6  # correlations, from the same motion to the opposite one
_SAME_SIZE = 2.0
_FEWEST, _SHORTEST = 20, 0.05  # equal samples at the end, and their share of the record
_MOVES, _NOISE_BEFORE = 0.2, 200  # of a channel's range; samples
_ON = 0.1  # of the largest voltage
_FLAT, _ABOVE = 5, 1.1  # equal samples in a row at the top; what the motor shows there, over the top
_OFFSET_AT_REST, _OFFSET = 0.05, 0.15  # of the current of a rotor that is held
_STANDS, _TURNS_BACK = 0.02, 0.1  # of the largest voltage and speed; share of the samples


class Seen(NamedTuple):
    """What was recorded, side by side.

    Attributes:
        dt_s: sampling interval.
        voltage_v: shape (n,).
        current_a, speed_rad_s: shape (n,); None for a channel without a column.
        has_sign: whether the sign of the voltage is known.
        at_work: whether it is a log. The offset of a start is no failure: the quiet part before it tells it.
        is_taught: whether recordings have taught the healthy motor. A data sheet says nothing of the sensors of a
            start: which sign is forwards, and how far a range goes.
    """

    dt_s: float
    voltage_v: FloatArray
    current_a: FloatArray | None
    speed_rad_s: FloatArray | None
    has_sign: bool = True
    at_work: bool = True
    is_taught: bool = True


class Failure(NamedTuple):
    """A sensor that failed: its kind, and what shows it."""

    kind: FaultKind
    why: str


def free_run(
    physical: FloatArray, voltage_v: FloatArray, dt_s: float, *, from_rest: bool = False
) -> tuple[FloatArray, FloatArray]:
    """Current and speed of a motor of these physical values under a voltage, from its steady state or from rest."""
    values = physical.copy()
    values[[places.NOISE_I, places.NOISE_W]], values[[places.NOISE_V, places.WALK]] = 1.0, 0.0
    n = len(voltage_v)
    marks = np.append(kernel.REST if from_rest else kernel.STEADY, np.zeros(n - 1))
    table = Record(dt_s, voltage_v, np.zeros((n, 2)), np.zeros(2), marks).predict(values, learn=False)[0]
    return table[:, 2], table[:, 3]


def failure_in(seen: Seen, physical: FloatArray) -> Failure | None:
    """The sensor that failed in a record of a motor that is nearly that of these physical values; None for none."""
    current, speed = free_run(physical, seen.voltage_v, seen.dt_s, from_rest=not seen.at_work)
    if not seen.has_sign:  # the motor is taken to turn as it is read to do
        shown = seen.current_a if seen.speed_rad_s is None else seen.speed_rad_s
        turned = np.sign(_likeness(shown, current if seen.speed_rad_s is None else speed, about=0.0)) or 1.0
        current, speed = turned * current, turned * speed
        seen = seen._replace(voltage_v=turned * seen.voltage_v)
    expected = Seen(seen.dt_s, seen.voltage_v, current, speed)
    checks = [_dead, _stuck, _swapped]
    checks += [_contradicting, _clipped] if seen.at_work or seen.is_taught else []
    checks += [_offset] if seen.at_work else []
    for check in checks:
        found = check(seen, expected, physical)
        if found is not None:
            return found
    return None


def _size(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _likeness(one: FloatArray | None, other: FloatArray | None, *, about: float | None = None) -> float:
    """Correlation, about the means unless given; 0 where one of them does not move or is not there."""
    if one is None or other is None:
        return 0.0
    a, b = (each - (each.mean() if about is None else about) for each in (one, other))
    product = _size(a) * _size(b)
    return float(np.mean(a * b)) / product if product > 0.0 else 0.0


def _by_the_others(seen: Seen, physical: FloatArray) -> tuple[FloatArray | None, FloatArray | None]:
    """Current and speed, each by the voltage and the other one, whatever the load is."""
    if seen.current_a is None or seen.speed_rad_s is None:
        return None, None
    ohm, constant = float(physical[places.R]), float(physical[places.K])
    kept = float(np.exp(-seen.dt_s * ohm / max(float(physical[places.L]), 1e-12)))
    current = lfilter([1.0 - kept], [1.0, -kept], (seen.voltage_v - constant * seen.speed_rad_s) / ohm)
    return current, (seen.voltage_v - ohm * seen.current_a) / constant


def _is_nothing(shown: FloatArray, expected: FloatArray) -> bool:
    most = _NOTHING * _size(expected)
    return _size(shown) < most and _likeness(shown, expected) ** 2 < _A_SCALE


def _turns(seen: Seen, expected: Seen, physical: FloatArray) -> bool:
    """Whether the current is more like that of the motor that turns than like that of a rotor that is held."""
    if seen.current_a is None or expected.current_a is None:
        return False
    held = physical.copy()
    held[places.K] *= 1e-6
    blocked, _ = free_run(held, seen.voltage_v, seen.dt_s)
    turning = _size(seen.current_a - expected.current_a)
    return turning < 0.5 * _size(seen.current_a - blocked) and _likeness(*_currents(seen, expected)) > _APART


def _currents(seen: Seen, expected: Seen) -> tuple[FloatArray | None, FloatArray | None]:
    return seen.current_a, expected.current_a


def _speeds(seen: Seen, expected: Seen) -> tuple[FloatArray | None, FloatArray | None]:
    return seen.speed_rad_s, expected.speed_rad_s


def _dead(seen: Seen, expected: Seen, physical: FloatArray) -> Failure | None:
    """A channel that shows nothing while another shows that the motor turns, or no other is there."""
    current, healthy_a = _currents(seen, expected)
    speed, healthy_rad_s = _speeds(seen, expected)
    if current is not None and healthy_a is not None and _is_nothing(current, healthy_a):
        if (speed is None and seen.is_taught) or abs(_likeness(speed, healthy_rad_s, about=0.0)) > _ALIKE:
            return Failure(
                FaultKind("current_dead"), _in_words("current", "A", _size(current), _size(healthy_a))
            )
    elif speed is not None and healthy_rad_s is not None and _is_nothing(speed, healthy_rad_s):
        if current is None or _turns(seen, expected, physical):
            return Failure(
                FaultKind("speed_dead"), _in_words("speed", "rad/s", _size(speed), _size(healthy_rad_s))
            )
    return None


def _in_words(name: str, unit: str, shown: float, expected: float) -> str:
    return f"the {name} is {shown:.3g} {unit} effective where the healthy motor shows {expected:.3g} {unit}"


def _stuck(seen: Seen, expected: Seen, physical: FloatArray) -> Failure | None:
    """A channel that ends in equal values while the motor moves, or the noise that it had is gone."""
    on = np.abs(seen.voltage_v) > _ON * np.max(np.abs(seen.voltage_v))
    for name, shown, healthy in (
        ("current", *_currents(seen, expected)),
        ("speed", *_speeds(seen, expected)),
    ):
        if shown is None or healthy is None:
            continue
        others = np.flatnonzero(shown != shown[-1])
        first = int(others[-1]) + 1 if len(others) else 0
        run = slice(first, len(shown))
        powered = healthy[run][on[run]]
        if len(shown) - first < max(_FEWEST, _SHORTEST * len(shown)) or len(powered) < _FEWEST:
            continue
        if abs(float(shown[-1])) < _NOTHING * _size(healthy):
            # A rotor that stands shows no speed, and an open circuit no current.
            other = seen.speed_rad_s if name == "current" else None
            is_seen = other is not None and np.ptp(other[run]) > _MOVES * np.ptp(other)
            if not is_seen and not (name == "speed" and _turns(*_from(first, seen, expected), physical)):
                continue
        steps = np.abs(np.diff(shown[:first]))
        quantum = float(np.min(steps[steps > 0.0], initial=np.inf))
        before = shown[max(first - _NOISE_BEFORE, 0) : first]
        is_noisy = len(before) > _FEWEST and difference_noise(before) > quantum
        is_moving = np.ptp(powered) > max(_MOVES * np.ptp(healthy), 3.0 * min(quantum, np.ptp(shown)))
        if is_moving or is_noisy:
            return Failure(
                FaultKind(f"{name}_stuck"),
                f"the {name} reads {shown[-1]:.4g} for its last {len(shown) - first} samples, while the motor runs",
            )
    return None


def _from(first: int, *records: Seen) -> list[Seen]:
    """Records from a sample on."""
    return [
        Seen(one.dt_s, *(None if part is None else part[first:] for part in one[1:4]))  # type: ignore[arg-type]
        for one in records
    ]


def _swapped(seen: Seen, expected: Seen, physical: FloatArray) -> Failure | None:
    """Columns in another order, in which they are those of the healthy motor, as they are not as read."""
    if (
        seen.current_a is None
        or seen.speed_rad_s is None
        or not seen.has_sign
        or _is_this_motor(seen, expected)
    ):
        return None
    names = ("voltage", "current", "speed")
    columns = (seen.voltage_v, seen.current_a, seen.speed_rad_s)
    for order in list(permutations(range(3)))[1:]:
        volts, amps, speed = (columns[n] for n in order)
        read = Seen(seen.dt_s, volts, amps, speed)
        if _is_this_motor(read, Seen(seen.dt_s, volts, *free_run(physical, volts, seen.dt_s))):
            moved = " and ".join(name for n, name in enumerate(names) if order[n] != n)
            return Failure(FaultKind("swapped"), f"{moved} {READ_SO}")
    return None


def _is_this_motor(seen: Seen, expected: Seen) -> bool:
    return all(
        shown is not None
        and healthy is not None
        and _likeness(shown, healthy) > _ALIKE
        and 1.0 / _SAME_SIZE < _size(shown) / max(_size(healthy), 1e-300) < _SAME_SIZE
        for shown, healthy in (_currents(seen, expected), _speeds(seen, expected))
    )


def _contradicting(seen: Seen, expected: Seen, physical: FloatArray) -> Failure | None:
    """A channel against which the other ones agree: it is reversed, or that of another motor."""
    by_speed, by_current = _by_the_others(seen, physical)
    current, speed = _likeness(*_currents(seen, expected)), _likeness(*_speeds(seen, expected), about=0.0)
    has_both = by_speed is not None
    if speed < -_ALIKE:
        if seen.current_a is not None and current < _AGAINST:
            return Failure(
                FaultKind("voltage_polarity"), "current and speed both go against the voltage of the healthy motor"
            )
        return Failure(FaultKind("speed_polarity"), "the speed goes against the voltage, and the current does not")
    if not has_both:
        if seen.current_a is not None and seen.has_sign and current < -_ALIKE:
            return Failure(FaultKind("current_polarity"), "the current goes against the voltage of the healthy motor")
        return None
    if speed > _ALIKE:
        by_both = _likeness(seen.current_a, by_speed)
        likest, agree = max(current, by_both), _likeness(expected.current_a, by_speed) > _ALIKE
        if (agree and likest < _AGAINST) or (by_both < _OPPOSITE and current < -_AGAINST):
            return Failure(FaultKind("current_polarity"), "the current goes against voltage and speed")
        if agree and likest < _APART:
            return Failure(FaultKind("swapped"), "the current is not that of the motor that has this voltage and speed")
    if current > _ALIKE and _likeness(expected.speed_rad_s, by_current) > _ALIKE:
        likest = max(_likeness(*_speeds(seen, expected)), _likeness(seen.speed_rad_s, by_current))
        if likest < _APART:
            return Failure(FaultKind("swapped"), "the speed is not that of the motor that has this voltage and current")
    return None


def _clipped(seen: Seen, expected: Seen, physical: FloatArray) -> Failure | None:
    """A channel that stands at its largest value where the motor shows more, and follows the motor elsewhere."""
    by_speed, _ = _by_the_others(seen, physical)
    for name, unit, shown, healthy in (
        ("current", "A", seen.current_a, expected.current_a if by_speed is None else by_speed),
        ("speed", "rad/s", *_speeds(seen, expected)),
    ):
        if shown is None or healthy is None:
            continue
        top = float(np.max(np.abs(shown)))
        flat = np.abs(np.abs(shown) - top) <= 1e-9 * top
        runs = np.diff(np.flatnonzero(np.diff(np.concatenate([[0], flat.astype(np.int8), [0]]))))[::2]
        if top == 0.0 or runs.max() < _FLAT or flat.mean() > 0.5:
            continue
        is_more = float(np.mean(np.abs(healthy[flat]) > _ABOVE * top)) > 0.5
        limited = np.clip(healthy, -top, top)
        if is_more and _likeness(shown, limited) > _ALIKE and _size(shown - limited) < 0.5 * _size(shown):
            return Failure(
                FaultKind(f"{name}_clipped"),
                f"{int(flat.sum())} samples of the {name} stand at {top:.4g} {unit}, where the healthy motor reaches"
                f" {float(np.max(np.abs(healthy))):.3g} {unit}",
            )
    return None


def _offset(seen: Seen, expected: Seen, physical: FloatArray) -> Failure | None:
    """A current that is off by the same amount at every voltage and speed: seen at rest, or by a motor that reverses."""
    current, speed = seen.current_a, seen.speed_rad_s
    if current is None or speed is None or _likeness(*_currents(seen, expected)) < _ALIKE:
        return None
    sizes = [np.abs(each) / np.max(np.abs(each)) for each in (seen.voltage_v, speed)]
    rests = (sizes[0] < _STANDS) & (sizes[1] < _STANDS)
    backwards = float(np.mean((speed < 0.0) & (sizes[1] > _ON)))
    if np.count_nonzero(rests) >= _FEWEST:
        off, most = float(np.mean(current[rests])), _OFFSET_AT_REST
    elif _TURNS_BACK < backwards < 1.0 - _TURNS_BACK:
        by_speed, _ = _by_the_others(seen, physical)
        shapes = np.stack([np.ones(len(current)), np.asarray(by_speed), speed, np.sign(speed)], axis=1)
        off, most = float(np.linalg.lstsq(shapes, current, rcond=None)[0][0]), _OFFSET
    else:
        return None
    off -= float(physical[places.OFFSET_I])
    if abs(off) < most * float(np.max(np.abs(seen.voltage_v)) / physical[places.R]):
        return None
    return Failure(FaultKind("current_offset"), f"the current is off by {off:.3g} A at every voltage and speed")


def failed_sensor(
    recording: Recording,
    motor: Motor,
    voltage_v: float | None = None,
    circuit: Circuit | None = None,
    *,
    at_work: bool = False,
) -> Judgement | None:
    """The judgement on a recording of which a sensor failed; None where none did, or nothing tells.

    Args:
        recording: one start, or a log.
        motor: the healthy one.
        voltage_v: level of the supply where it was not recorded.
        circuit: what is known of the measuring circuit.
        at_work: whether it is a log.
    """
    starts = None if motor.healthy is None else motor.healthy.starts
    for name in () if starts is None else starts.turned:
        column = getattr(recording, name)
        recording = replace(recording, **{name: None if column is None else -column})
    seen = _seen_in(recording, motor.nominal_voltage_v if voltage_v is None else voltage_v)
    if seen is None:
        return None
    physical = physical_of(motor)
    physical[places.R] += 0.0 if circuit is None else circuit.shunt_ohm
    found = failure_in(seen._replace(at_work=at_work, is_taught=motor.healthy is not None), physical)
    return None if found is None else judgement_of(found).on(recording)


def physical_of(motor: Motor) -> FloatArray:
    """Values of a healthy motor in the order of `motor_env.fitting.places`."""
    if motor.healthy is not None and motor.healthy.windows is not None:
        from motor_env.diagnosis.running.windows import judge_of

        return judge_of(motor.healthy, motor.name).physical()
    known, values = motor.parameters, np.zeros(places.N_VALUES)
    constant = np.sqrt(known.back_emf_constant_v_s_per_rad * np.asarray(known.torque_constant_n_m_per_a))
    values[[places.R, places.L, places.K, places.J, places.B, places.COULOMB, places.DROP]] = (
        known.resistance_ohm,
        known.inductance_h,
        constant,
        known.inertia_kg_m2,
        known.viscous_friction_n_m_s_per_rad,
        motor.coulomb_friction_n_m,
        motor.brush_drop_v,
    )
    return values


def judgement_of(found: Failure) -> Judgement:
    """What is said of a piece of which a sensor failed: nothing of its motor."""
    return Judgement(
        Verdict.SENSOR, (found.why, found.kind.finding), fault_kind=found.kind, kind_probability=1.0
    )


def _seen_in(recording: Recording, level_v: float | None) -> Seen | None:
    """What was recorded, with the step of a supply whose voltage was not; None where it is not known at all."""
    voltage, has_sign = recording.voltage_v, True
    if voltage is None and recording.duty is not None and level_v is not None:
        voltage = level_v * recording.duty
    if voltage is None:
        onset = _onset(recording)
        if onset is None or level_v is None:
            return None
        voltage, has_sign = np.where(np.arange(len(recording.time_s)) >= onset, level_v, 0.0), False
    if not np.any(voltage):
        return None
    return Seen(recording.dt_s, voltage, recording.current_a, recording.speed_rad_s, has_sign)


def _onset(recording: Recording) -> int | None:
    """Where the current, or else the speed, begins to move."""
    for column in (recording.current_a, recording.speed_rad_s):
        if column is not None:
            try:
                return align(replace(recording, current_a=column)).onset_index
            except UnusableError:
                continue
    return None
