"""Starts of a motor with what `simulate` lacks: dry friction, a brush drop, a fan, a rising supply, slow sensors."""

import numpy as np

from motor_env import MotorParameters

# Reaches in: dry friction, a fan and slow sensors, which `simulate` has not, are those of the model that is fitted.
from motor_env.diagnosis.estimation import ekf, parameter_index as index
from motor_env.diagnosis.estimation.record import Record
from motor_env.motor.parameters import FloatArray

Beyond = float | list[float]


def values_of(motor: MotorParameters, **beyond: Beyond) -> FloatArray:
    """Values of a motor; what it has beyond the textbook by the names of `estimation.parameter_index`.

    There the two constants are one: torques, inertia and friction are those over the torque constant, times the other.
    """
    constant = float(motor.back_emf_constant_v_s_per_rad)
    torques = constant / float(motor.torque_constant_n_m_per_a)
    out = np.zeros(index.N_VALUES)
    out[[index.R, index.L, index.K]] = float(motor.resistance_ohm), float(motor.inductance_h), constant
    out[[index.J, index.B]] = float(motor.inertia_kg_m2), float(motor.viscous_friction_n_m_s_per_rad)
    out[[index.NOISE_I, index.NOISE_W]] = 1.0
    out[index.CURVE] = 1.0
    for name, value in beyond.items():
        out[getattr(index, name)] = value
    out[[index.J, index.B, index.COULOMB, index.LOAD, index.SQUARE, index.WALK]] *= torques
    return out


def step_record(time_s: FloatArray, onset_s: float, voltage_v: float) -> Record:
    """A start from rest without readings: a step of the supply."""
    n = len(time_s)
    dt_s, marks = float((time_s[-1] - time_s[0]) / (n - 1)), ekf.REST * np.eye(1, n)[0]
    volts, none = np.full(n, voltage_v), np.full((n, 2), np.nan)
    return Record(dt_s, volts, none, np.ones(2), marks, onset_s=onset_s - float(time_s[0]))


def driven_record(voltage_v: FloatArray, dt_s: float, *, from_rest: bool) -> Record:
    """A motor under a measured voltage, from rest or from its steady state, without readings."""
    n = len(voltage_v)
    marks = (ekf.REST if from_rest else ekf.STEADY) * np.eye(1, n)[0]
    return Record(dt_s, voltage_v, np.full((n, 2), np.nan), np.ones(2), marks)


def step_start(
    motor: MotorParameters, time_s: FloatArray, onset_s: float, voltage_v: float, **beyond: Beyond
) -> FloatArray:
    """Current and speed at the sample times of a start from rest, shape (n_samples, 2)."""
    record = step_record(time_s, onset_s, voltage_v)
    return record.predict(values_of(motor, **beyond), learn=False)[0][:, 2:4]


def driven(
    motor: MotorParameters, voltage_v: FloatArray, dt_s: float, *, from_rest: bool, **beyond: Beyond
) -> FloatArray:
    """Current and speed under a measured voltage, shape (n_samples, 2)."""
    record = driven_record(voltage_v, dt_s, from_rest=from_rest)
    return record.predict(values_of(motor, **beyond), learn=False)[0][:, 2:4]
