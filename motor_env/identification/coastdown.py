"""Friction from a coast-down: the motor without voltage, its speed falling by friction alone.

J dw/dt = -B w - Tc. The speed tells B/J and Tc/J; Coulomb friction is kept where the evidence is strong.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from motor_env.identification.model_choice import STRONG_EVIDENCE
from motor_env.motor.parameters import FloatArray
from motor_env.recordings.defects import UnusableError
from motor_env.recordings.recording import Recording

_FEWEST = 20
_HIGH, _LOW = 0.97, 0.03


@dataclass(frozen=True, slots=True)
class CoastDown:
    """Friction of a coast-down.

    Attributes:
        viscous_per_s: B/J.
        coulomb_rad_s2: Tc/J; 0 where the evidence does not ask for it.
        r2_viscous: share of the speed's variance that viscous friction alone explains.
        r2: the same for the model that was chosen.
        evidence: drop of the Bayesian information criterion by Coulomb friction.
    """

    viscous_per_s: float
    coulomb_rad_s2: float
    r2_viscous: float
    r2: float
    evidence: float


def fit_coastdown(recording: Recording) -> CoastDown:
    """Fit the fall of the speed, from 97 to 3 % of where it begins.

    Raises:
        UnusableError: no speed in the recording, or none that falls to rest.
    """
    speed = recording.speed_rad_s
    if speed is None:
        raise UnusableError("a coast-down needs the speed")
    top = float(np.median(speed[: max(len(speed) // 50, 5)]))
    begin = int(np.argmax(speed < _HIGH * top)) if top > 0.0 else 0
    falls = np.flatnonzero(speed[begin:] < _LOW * top)
    end = begin + int(falls[0]) if len(falls) else len(speed)
    if top <= 0.0 or end - begin < _FEWEST or float(speed[end - 1]) > 0.5 * top:
        raise UnusableError("the speed does not fall to rest")
    time, fall = recording.time_s[begin:end] - recording.time_s[begin], speed[begin:end]
    length = float(time[-1])

    def residual(unknowns: FloatArray) -> FloatArray:
        start, rate, coulomb = (*unknowns, 0.0)[:3]
        rate = max(rate, 1e-9 / length)
        out: FloatArray = (start + coulomb / rate) * np.exp(-rate * time) - coulomb / rate - fall
        return out

    viscous = least_squares(residual, [fall[0], 2.0 / length], x_scale="jac")
    both = least_squares(
        residual,
        [fall[0], 0.2 / length, 0.9 * fall[0] / length],
        bounds=([-np.inf, 0.0, 0.0], np.inf),
        x_scale="jac",
    )
    variance = float(np.sum((fall - fall.mean()) ** 2))
    # The samples that the residual's correlation leaves independent (first-order: (1 - rho) / (1 + rho)).
    left = both.fun - both.fun.mean()
    rho = float(np.clip(np.sum(left[1:] * left[:-1]) / max(np.sum(left**2), 1e-300), 0.0, 0.999))
    independent = len(fall) * (1.0 - rho) / (1.0 + rho)
    gain = independent * math.log(viscous.cost / max(both.cost, 1e-300)) - math.log(max(independent, 2.0))
    best = viscous if gain < STRONG_EVIDENCE else both
    _, rate, coulomb = (*best.x, 0.0)[:3]
    r2_viscous, r2 = (1.0 - 2.0 * float(fit.cost) / variance for fit in (viscous, best))
    return CoastDown(float(rate), float(coulomb), r2_viscous, r2, gain)
