"""What a fault looks like where a load makes the drag: the textbook fit of a start takes any load for viscous friction.

The motor with that load which the textbook would fit like this start is found first. A fault of it moves current and
speed, and the textbook's parameters follow them.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from motor_env.identification.identify import FIT_SAMPLES, Identified
from motor_env.identification.residuals import started
from motor_env.motor import identifiable as quantities
from motor_env.motor.faults import FaultKind
from motor_env.motor.parameters import FloatArray, MotorParameters
from motor_env.recordings.start import mean_tail

LOADS = {"constant": "a constant load", "fan": "a load that grows with the square of the speed"}
"""Loads by name, and in words."""
_OF_THE_DRAG = 0.95  # the load's share: the rest stays viscous
_STEP = 0.01
_ROUNDS = 4
_FARTHEST = 3.0  # logarithm of a factor on a parameter
_LEAST = 1e-3  # length of a direction; a fault that shows has about 1
_FRICTION = quantities.PARAMETERS.index("B")


def directions(fit: Identified, kinds: Iterable[FaultKind], load: str) -> dict[FaultKind, FloatArray]:
    """How the logarithms of a start's quantities move with one unit of each fault's logarithm, under one of LOADS.

    A faulty bearing adds a friction torque that does not depend on the speed, as a share of the whole drag. None are
    returned where no motor with that load looks like this start, and none that would not show.
    """
    free = [n for n, name in enumerate(quantities.PARAMETERS[:-1]) if name != "K" or _has_speed(fit)]
    textbook = _run(fit, np.zeros(5))
    columns = [(_run(fit, _STEP * np.eye(5)[n]) - textbook) / _STEP for n in free]
    later = (_run(fit, np.zeros(5), late_s=_STEP * fit.start.dt_s) - textbook) / _STEP
    slopes = np.stack([*columns, later], axis=1)
    # What the start hardly tells, such as L at a slow rate, stays: each logarithm, and a sample of delay, by 1 (1 sd).
    inverse = np.linalg.solve(slopes.T @ slopes + np.eye(slopes.shape[1]), slopes.T)[:-1]
    motor = np.zeros(5)
    for _ in range(_ROUNDS):
        motor[free] -= inverse @ (_run(fit, motor, load) - textbook)
        if not np.abs(motor).max() < _FARTHEST:
            return {}
    healthy = _run(fit, motor, load)
    found = {}
    for kind in kinds:
        step = _STEP * quantities.fault_direction(kind)[:5]
        added = np.expm1(step[_FRICTION])
        step[_FRICTION] = 0.0
        moved = inverse @ (_run(fit, motor + step, load, added=float(added)) - healthy) / _STEP
        direction: FloatArray = fit.exponents[:, free] @ moved
        if np.linalg.norm(direction) > _LEAST:
            found[kind] = direction
    return found


def _has_speed(fit: Identified) -> bool:
    return fit.start.speed_rad_s is not None


def _run(
    fit: Identified, logs: FloatArray, load: str | None = None, *, added: float = 0.0, late_s: float = 0.0
) -> FloatArray:
    """Current, and speed where it was recorded, each over what the fit leaves of it.

    Args:
        fit: the start.
        logs: of factors on R, L, K, J and B of the fit, shape (5,).
        load: what makes the drag; None for the textbook.
        added: friction torque of a bearing, over the drag.
        late_s: how much later it starts.
    """
    p, start = fit.parameters, fit.start.shortened(FIT_SAMPLES)
    speed = abs(mean_tail(fit.states[:, 1]))
    drag = float(p.viscous_friction_n_m_s_per_rad * speed)
    r, inductance, k, j, b = np.exp(logs)
    viscous, extension = p.viscous_friction_n_m_s_per_rad * b, fit.extension
    if load is not None:
        viscous *= 1.0 - _OF_THE_DRAG
        carried = _OF_THE_DRAG * float(b) * drag
        torque, fan = (carried, 0.0) if load == "constant" else (0.0, carried)
        extension = replace(
            extension,
            coulomb_friction_n_m=torque + added * drag,
            fan_n_m_s2_per_rad2=fan / speed**2,
        )
    motor = MotorParameters(
        p.resistance_ohm * r + start.circuit.shunt_ohm,
        p.inductance_h * inductance,
        p.back_emf_constant_v_s_per_rad * k,
        p.torque_constant_n_m_per_a * k,
        p.inertia_kg_m2 * j,
        viscous,
    )
    states = started(start, motor, extension, fit.onset_s + late_s)
    channels = [states[:, 0] / np.std(fit.residual_a)]
    if start.speed_rad_s is not None:
        channels.append(states[:, 1] / np.std(start.speed_rad_s) / np.sqrt(fit.misfit[1]))
    return np.concatenate(channels)
