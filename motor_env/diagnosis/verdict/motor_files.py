"""Motor files of fits of starts, of logs and of their windows, and what these leave undetermined."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from motor_env.common.errors import InputError
from motor_env.diagnosis.estimation import parameter_index as places
from motor_env.diagnosis.estimation.operation_fit import OperationFit as Operation
from motor_env.diagnosis.estimation.starts.start_fit import StartFit as Identified
from motor_env.diagnosis.estimation.starts.start_prior import hides_inductance
from motor_env.motor.data_sheet import Motor, assumptions
from motor_env.motor.healthy import Healthy
from motor_env.motor.parameters import FloatArray, MotorParameters

_DIFFERENT = 2.0  # standard errors
_UNDETERMINED = 0.5  # standard deviation of a logarithm
_SMALL = 1e-3


def to_motor(
    fits: Sequence[Identified],
    name: str,
    *,
    healthy: Healthy | None = None,
    constant: float | None = None,
) -> Motor:
    """Return the motor of fits of its starts: the geometric mean of their parameters.

    With the statistics of `healthy` starts it is a commissioned motor. `constant` is the torque constant in N m/A that
    the user gave because the speed was not recorded.
    """
    start = fits[0].start
    mean = {
        field: float(np.exp(np.mean([math.log(max(getattr(fit.parameters, field), 1e-300)) for fit in fits])))
        for field in MotorParameters.__dataclass_fields__
    }
    known = fits[0].quantity_names if constant is None else ("K",)
    return Motor(
        name=name,
        kind="identified" if healthy is None else "commissioned",
        parameters=MotorParameters(**mean),
        nominal_voltage_v=float(np.mean([fit.start.level_v for fit in fits])),
        current_noise_a=float(np.exp(np.mean([math.log(max(fit.noise_a, 1e-12)) for fit in fits]))),
        coulomb_friction_n_m=_mean_if_significant(fits, "coulomb"),
        brush_drop_v=_mean_if_significant(fits, "brush_drop"),
        healthy=healthy,
        notes=()
        if start.voltage_known and start.speed_rad_s is not None
        else tuple(describe_undetermined(fits[0])),
        assumed=assumptions(known, has_voltage=start.voltage_known),
    )


def _mean_if_significant(fits: Sequence[Identified], name: str) -> float:
    """Return the mean of an extension over fits; 0 if it is within two standard errors of 0."""
    each = [fit.fitted_extension.get(name, (0.0, 0.0)) for fit in fits]
    mean, error = np.mean(each, axis=0)[0], float(np.linalg.norm([e for _, e in each])) / len(each)
    return float(mean) if mean > _DIFFERENT * error else 0.0


def describe_undetermined(fit: Identified) -> list[str]:
    """Describe in sentences what this recording leaves undetermined."""
    deviations = np.sqrt(np.diag(fit.log_covariance))
    limits = {
        "the voltage is unknown: everything is per volt, the supply counts as 1 V": not fit.start.voltage_known,
        "the current alone tells K^2/J and B/J, not K, J and B (K down looks like J and B up): K is assumed": (
            fit.start.speed_rad_s is None
        ),
        "all but B/J count a brush drop in: brushes that take 5 % of the supply make them 5 % larger": (
            "brush_drop" not in fit.model
        ),
        "J counts the loss of a gear in: one that takes 10 % of the torque makes it 11 % larger, K^2/J smaller": True,
        "a supply that rises slowly, a lag of the sensor and L look alike: L is hardly told": hides_inductance(
            fit.model
        ),
    }
    return [sentence for sentence, holds in limits.items() if holds] + [
        f"{name} is not told by this recording (its standard error is {100 * s:.0f} %)"
        for name, s in zip(fit.quantity_names, deviations, strict=True)
        if s > _UNDETERMINED
    ]


def motor_of_log(fit: Operation, name: str) -> Motor:
    """Return the motor that was identified at work.

    Raises:
        InputError: current and speed were not both recorded, so R, K, J and B are not all determined.
    """
    if not fit.record.seen.all():
        raise InputError("a motor file needs current and speed: the parameters are not known one by one")
    values = fit.solution.values
    return replace(
        _motor_of(values, name),
        nominal_voltage_v=fit.record.peaks[0],
        current_noise_a=float(values[places.NOISE_I]),
        speed_noise_rad_s=float(values[places.NOISE_W]),
        notes=fit.notes,
    )


def motor_of_windows(healthy: Healthy, name: str) -> Motor:
    """Return the motor that was commissioned on windows."""
    windows = healthy.windows
    assert windows is not None  # noqa: S101  # it was learned from them
    motor = _motor_of(windows.physical, name)
    volts = 1.0 if windows.peaks is None else windows.peaks[0]
    drag = float(windows.physical[places.B]) * windows.speed_rad_s
    return replace(
        motor,
        kind="commissioned",
        healthy=healthy,
        coulomb_friction_n_m=_unless_small(motor.coulomb_friction_n_m, drag),
        brush_drop_v=_unless_small(motor.brush_drop_v, volts),
    )


def _unless_small(value: float, beside: float) -> float:
    """Return 0 for a negligible value: a bounded fit leaves a little of what is not there."""
    return value if value > _SMALL * beside else 0.0


def _motor_of(values: FloatArray, name: str) -> Motor:
    """Return the motor of a fit's physical values, shape (places.N_VALUES,)."""
    return Motor(
        name=name,
        kind="identified",
        parameters=MotorParameters(
            resistance_ohm=float(values[places.R]),
            inductance_h=float(values[places.L]),
            back_emf_constant_v_s_per_rad=float(values[places.K]),
            torque_constant_n_m_per_a=float(values[places.K]),
            inertia_kg_m2=float(values[places.J]),
            viscous_friction_n_m_s_per_rad=float(values[places.B]),
        ),
        coulomb_friction_n_m=float(values[places.COULOMB]),
        brush_drop_v=float(values[places.DROP]),
    )
