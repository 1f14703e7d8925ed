"""Diagnose the sensors of a recording before its motor."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from motor_env.diagnosis.estimation import parameter_index as places
from motor_env.diagnosis.readers.alignment import align
from motor_env.diagnosis.readers.recording import Recording, UnusableError
from motor_env.diagnosis.readers.start import Circuit
from motor_env.diagnosis.verdict.channels import ChannelRecord, find_failure, sensor_judgement
from motor_env.diagnosis.verdict.judgement import Judgement
from motor_env.motor.data_sheet import Motor
from motor_env.motor.faults import FaultKind
from motor_env.motor.parameters import FloatArray

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
    """Judge a recording with a failed sensor; None if none failed, or the voltage is not known.

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
        # A column that never moves, as it did not where the motor was learned.
        record = record._replace(speed_rad_s=None)
    physical = physical_values(motor)
    physical[places.R] += 0.0 if circuit is None else circuit.shunt_ohm
    failure = find_failure(record._replace(at_work=at_work, is_taught=motor.healthy is not None), physical)
    return None if failure is None else failure.on(recording)


def physical_values(motor: Motor) -> FloatArray:
    """Return a healthy motor's values in the order of `estimation.parameter_index`, shape (N_VALUES,)."""
    if motor.healthy is not None and motor.healthy.windows is not None:
        physical = motor.healthy.windows.physical.copy()
        learned = dict(zip(motor.healthy.quantities, motor.healthy.values.tolist(), strict=True))
        places_of = {"R": places.R, "K": places.K, "J": places.J}
        for name in learned.keys() & places_of:
            physical[places_of[name]] = learned[name]
        return physical
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


def _record_channels(recording: Recording, level_v: float | None) -> ChannelRecord | None:
    """Return the channels, with a step for a voltage that was not recorded; None if its level is unknown too."""
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
    """Return the motor with the column that has the other sign in all its healthy starts: it is wired so."""
    failures = [diagnose_sensors(recording, motor, voltage_v) for recording in healthy]
    kinds = {None if failure is None else failure.fault_kind for failure in failures}
    column = next((name for kind, name in _POLARITY_COLUMNS.items() if kinds == {FaultKind(kind)}), None)
    if column is None or motor.healthy is None or motor.healthy.starts is None:
        return motor
    return replace(
        motor, healthy=replace(motor.healthy, starts=replace(motor.healthy.starts, turned=(column,)))
    )


def _has_learned_speed(motor: Motor) -> bool:
    """Whether the healthy pieces were recorded with the speed, so that K is known."""
    return motor.healthy is not None and not {"K", "K/V"}.isdisjoint(motor.healthy.quantities)


def _turn_signs(recording: Recording, names: Sequence[str]) -> Recording:
    """Return the recording with the sign of some columns changed."""
    changed: dict[str, Any] = {
        name: None if getattr(recording, name) is None else -getattr(recording, name) for name in names
    }
    return replace(recording, **changed)


def _starts_backwards(recording: Recording, direction: int) -> bool:
    """Whether a current without voltage and speed has the other sign than that of the healthy starts."""
    if any(column is not None for column in (recording.voltage_v, recording.duty, recording.speed_rad_s)):
        return False
    with suppress(UnusableError):
        return align(recording).sign * direction < 0.0
    return False


def _onset_index(recording: Recording) -> int | None:
    """Return the index where the current, or else the speed, begins to move."""
    for column in (recording.current_a, recording.speed_rad_s):
        if column is not None:
            try:
                return align(replace(recording, current_a=column)).onset_index
            except UnusableError:
                continue
    return None
