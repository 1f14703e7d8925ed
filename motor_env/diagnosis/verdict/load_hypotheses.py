"""Compute the effect of a fault on the textbook fit of a loaded start.

The textbook takes any load for viscous friction. Find the loaded motor whose start has this textbook fit; then fit the
start of that motor with a fault.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from motor_env.diagnosis.estimation import parameter_index as index
from motor_env.diagnosis.estimation.starts.start_fit import StartFit
from motor_env.diagnosis.readers.start import mean_tail
from motor_env.motor import identifiable
from motor_env.motor.parameters import FloatArray

LOADS = {"constant": "a constant load", "fan": "a load that grows with the square of the speed"}
"""Loads by name, and in words."""
_OF_THE_DRAG = 0.95  # the load's share: the rest stays viscous
_STEP = 0.01
_ROUNDS = 4
_FARTHEST = 3.0  # logarithm of a factor on a parameter
_FRICTION = identifiable.PARAMETERS.index("B")


@dataclass(frozen=True, slots=True)
class LoadHypothesis:
    """Hypothesis of the drag of a start.

    Attributes:
        name: of `LOADS`; None for viscous friction.
        response: derivatives of the start's log quantities by log R, L, K, J, drag and V, shape (n, 6).
        own_friction: the motor's own share of the drag.
    """

    name: str | None
    response: FloatArray
    own_friction: float

    @property
    def warmth(self) -> FloatArray:
        """Change of the logarithms per kelvin, shape (n,); none of a load."""
        return identifiable.warmth_direction(self.response, self.own_friction)


def possible_loads(fit: StartFit, own: float | None) -> list[LoadHypothesis]:
    """Return the hypotheses, viscous friction first; `own` is the motor's share of the drag, None if unknown.

    Dry friction looks like a constant load, and is the motor's own.
    """
    owns = {"constant": (1.0, 0.0), "fan": (0.0,)} if own is None else dict.fromkeys(LOADS, (own,))
    inverse = _textbook_inverse(fit)
    responses = {load: _response(fit, load, inverse) for load in LOADS}
    return [
        LoadHypothesis(None, fit.exponents, own or 1.0),
        *(
            LoadHypothesis(load, response, share)
            for load, response in responses.items()
            if response is not None
            for share in owns[load]
        ),
    ]


def _response(fit: StartFit, load: str, inverse: FloatArray) -> FloatArray | None:
    """Return the response of a `LoadHypothesis`; None if no motor with that load looks like this start.

    A faulty bearing adds a torque independent of the speed. `inverse` is `_textbook_inverse`.
    """
    free, textbook, motor = _free_parameters(fit), _simulate(fit, np.zeros(5)), np.zeros(5)
    for _ in range(_ROUNDS):
        apart = _simulate(fit, motor, load) - textbook
        if not np.isfinite(apart).all():
            return None
        motor[free] -= inverse @ apart
        if np.abs(motor).max() >= _FARTHEST:
            return None
    healthy = _simulate(fit, motor, load)
    moved = [_simulate(fit, motor + step, load) for step in _STEP * np.eye(5)[:_FRICTION]]
    moved.append(_simulate(fit, motor, load, added=_STEP))
    textbooks = inverse @ (np.stack(moved, axis=1) - healthy[:, None]) / _STEP
    return np.column_stack([fit.exponents[:, free] @ textbooks, fit.exponents[:, -1]])


def _textbook_inverse(fit: StartFit) -> FloatArray:
    """Return the slopes of free log parameters by samples of `_simulate`, shape (n_free, n_samples)."""
    textbook = _simulate(fit, np.zeros(5))
    columns = [(_simulate(fit, _STEP * np.eye(5)[n]) - textbook) / _STEP for n in _free_parameters(fit)]
    later = (_simulate(fit, np.zeros(5), late=_STEP) - textbook) / _STEP
    slopes = np.stack([*columns, later], axis=1)
    # Ridge: a prior of 1 (sd) on each logarithm and on the delay in samples holds what the start hardly determines.
    inverse = np.linalg.solve(slopes.T @ slopes + np.eye(slopes.shape[1]), slopes.T)[:-1]
    return np.asarray(inverse, dtype=np.float64)


def _free_parameters(fit: StartFit) -> list[int]:
    """Return which of R, L, K, J and B are free: K only with a speed."""
    has_speed = fit.start.speed_rad_s is not None
    return [n for n, name in enumerate(identifiable.PARAMETERS[:-1]) if name != "K" or has_speed]


def _simulate(
    fit: StartFit,
    logs: FloatArray,
    load: str | None = None,
    *,
    added: float = 0.0,
    late: float = 0.0,
) -> FloatArray:
    """Simulate current and recorded speed, each over the fit's residual.

    Args:
        fit: the start.
        logs: of factors on R, L, K, J and B of the fit, shape (5,).
        load: of `LOADS`; None for the textbook.
        added: friction torque of a bearing, over the drag.
        late: delay in samples.
    """
    p, speed = fit.physical, abs(mean_tail(fit.states[:, 1]))
    drag = p[index.B] * speed
    p[[index.R, index.L, index.K, index.J, index.B]] *= np.exp(logs)
    if load is not None:
        carried = _OF_THE_DRAG * p[index.B] * speed
        p[index.B] *= 1.0 - _OF_THE_DRAG
        constant, fan = (carried, 0.0) if load == "constant" else (0.0, carried)
        p[index.COULOMB], p[index.SQUARE] = constant + added * drag, fan / speed**2
    if fit.start.voltage_v is None:
        p[index.ONSET] += late * fit.start.dt_s
    else:
        p[index.DELAY] += late
    states = fit.solution.problem.record.predict(p, learn=False)[0][:, 2:4]
    channels = [states[:, 0] / np.std(fit.residual_a)]
    if fit.start.speed_rad_s is not None:
        channels.append(states[:, 1] / np.std(fit.start.speed_rad_s) / np.sqrt(fit.misfit[1]))
    return np.concatenate(channels)
