"""What an experiment can tell about a motor before it is made: bounds, correlations, and directions that stay open.

All quantities are relative: a coordinate is the logarithm of a factor, so a standard deviation of 0.01 is 1 %, and an
open direction is a product of powers. With current alone, K by a, J by a^2 and B by a^2 leave every sample as it is
(structural identifiability: Bellman & Astrom 1970); bounds are those of Cramer-Rao (Rao 1945; Cramer 1946).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike

from motor_env.inference.fit import Prior, inverse_information
from motor_env.inference.parametrisation import QUANTITIES, Coordinates
from motor_env.inference.sensitivities import jacobian
from motor_env.motor.parameters import FloatArray, Floats, MotorParameters, SensorParameters, require
from motor_env.simulation.simulate import Timing

MOTOR_QUANTITIES = tuple(name for name in QUANTITIES if name != "supply")

# d' of a change by a factor of e: a direction below it counts as unidentifiable.
_UNSEEN = 0.01
_CORRELATED = 0.9


@dataclass(frozen=True, slots=True)
class Experiment:
    """A planned measurement: the voltage on the motor, and what is read.

    Attributes:
        voltage_v: voltage held in each interval, shape (n_samples,).
        dt_s: sampling interval.
        sensor: channels and noise.
        load_torque_n_m: known load, scalar or shape (n_samples,).
        first_sample: samples before this one are not looked at; late enough, only the steady state is.

    Raises:
        ValueError: a channel is believed to have no noise, or no sample is left.
    """

    voltage_v: FloatArray
    dt_s: float
    sensor: SensorParameters
    load_torque_n_m: Floats = 0.0
    first_sample: int = 0

    def __post_init__(self) -> None:
        std = self.sensor.noise_std
        require(bool((std > 0.0).all()), f"noise of each channel must be > 0, got {std}")
        n_samples = len(self.voltage_v)
        require(
            0 <= self.first_sample < n_samples,
            f"first_sample must be in 0 .. {n_samples - 1}, got {self.first_sample}",
        )

    @classmethod
    def start(
        cls, timing: Timing, sensor: SensorParameters, voltage_v: float = 12.0, load_torque_n_m: float = 0.0
    ) -> Self:
        """A step of the supply at time 0, the load from then on."""
        driven = timing.step(1.0)
        return cls(voltage_v * driven, timing.dt_s, sensor, load_torque_n_m * driven)

    def slopes(self, parameters: MotorParameters, names: tuple[str, ...]) -> FloatArray:
        """Change of the samples, in units of the noise, for the logarithm of each quantity, (n_values, n_names)."""
        coordinates = Coordinates.from_names(parameters, names)
        _, slopes = jacobian(
            coordinates, self.voltage_v, self.sensor, self.dt_s, load_torque_n_m=self.load_torque_n_m
        )
        white = slopes[:, self.first_sample :] / self.sensor.noise_std[:, None, None]
        return np.ascontiguousarray(np.moveaxis(white, 0, 1)).reshape(-1, len(names))


def cramer_rao_bound(
    parameters: MotorParameters,
    experiment: Experiment,
    free: tuple[str, ...] = ("resistance", "friction"),
    prior_std: ArrayLike = np.inf,
) -> FloatArray:
    """Smallest covariance of unbiased estimates of the free quantities' relative values (Rao 1945; Cramer 1946).

    Args:
        parameters: the motor.
        experiment: what drives it and what is read.
        free: quantities that are not known, of `QUANTITIES`; all others are.
        prior_std: relative standard deviation known beforehand of each, infinite for none; with one it is the Bayesian
            bound of van Trees (1968), linearised at the motor.

    Returns:
        Covariance of relative errors, shape (n_free, n_free): sqrt of its diagonal is 0.01 for 1 %.

    Raises:
        ValueError: the samples leave a direction open.
    """
    slopes = experiment.slopes(parameters, free)
    information = slopes.T @ slopes + Prior.from_std(np.broadcast_to(prior_std, len(free))).precision
    return inverse_information(information, free)


class Identifiability(NamedTuple):
    """What can be told about each quantity.

    Attributes:
        names: the free quantities.
        std: smallest relative standard deviation of an unbiased estimate; infinite where a direction that stays open
            moves the quantity.
        correlation: of the estimates, shape (n, n); NaN beside an open quantity.
        open_directions: exponents of products of powers that the noise hides, shape (n_open, n), in reduced form: the
            first quantity that a direction moves has the exponent 1, and the other directions leave it alone.
    """

    names: tuple[str, ...]
    std: FloatArray
    correlation: FloatArray
    open_directions: FloatArray

    def correlated_pairs(self, at_least: float = _CORRELATED) -> list[tuple[str, str, float]]:
        """Pairs whose estimates' correlation is at least so large in magnitude, the strongest first."""
        pairs = [
            (self.names[i], self.names[j], float(self.correlation[i, j]))
            for i in range(len(self.names))
            for j in range(i)
            if abs(self.correlation[i, j]) >= at_least
        ]
        return sorted(pairs, key=lambda pair: -abs(pair[2]))

    def sentences(self) -> list[str]:
        """The report in words."""
        lines = [
            f"{name}: not identifiable" if np.isinf(std) else f"{name}: known to {100.0 * std:.2g} %"
            for name, std in zip(self.names, self.std, strict=True)
        ]
        for direction in self.open_directions:
            moved = [
                f"{name} by a" + ("" if abs(exponent - 1.0) < 0.005 else f"^{exponent:.3g}")
                for name, exponent in zip(self.names, direction, strict=True)
                if exponent != 0.0
            ]
            lines.append(f"{', '.join(moved)} changes no sample, for any a")
        lines += [
            f"{one} and {other} are hard to tell apart: correlation {correlation:.3f}"
            for one, other, correlation in self.correlated_pairs()
        ]
        return lines


def identifiability(
    parameters: MotorParameters,
    experiment: Experiment,
    free: tuple[str, ...] = MOTOR_QUANTITIES,
    prior_std: ArrayLike = np.inf,
) -> Identifiability:
    """Bounds (Rao 1945), correlations and open directions (Bellman & Astrom 1970) of the free quantities.

    Args:
        parameters: the motor around which the response is linearised.
        experiment: what drives it and what is read.
        free: quantities that are not known, of `QUANTITIES`; all others are.
        prior_std: relative standard deviation known beforehand of each, infinite for none.
    """
    slopes = experiment.slopes(parameters, free)
    precision = Prior.from_std(np.broadcast_to(prior_std, len(free))).precision
    rows = np.concatenate([slopes, np.sqrt(precision)])  # the precision is diagonal
    _, singular, directions = np.linalg.svd(rows, full_matrices=False)
    seen = singular > _UNSEEN
    open_directions = _reduced(directions[~seen])
    inverse = directions[seen].T / np.square(singular[seen]) @ directions[seen]
    std = np.sqrt(np.diag(inverse))
    std[(open_directions != 0.0).any(axis=0)] = np.inf
    known = np.isfinite(std)
    correlation = np.full_like(inverse, np.nan)
    correlation[np.ix_(known, known)] = inverse[np.ix_(known, known)] / np.outer(std[known], std[known])
    return Identifiability(tuple(free), std, correlation, open_directions)


def _reduced(directions: FloatArray) -> FloatArray:
    """Reduced row echelon form of a basis of open directions; exponents within the slopes' error of 0 become 0."""
    basis = directions / np.abs(directions).max(axis=1, keepdims=True, initial=1e-300)
    row = 0
    for column in range(basis.shape[1]):
        if row == len(basis):
            break
        pivot = row + int(np.abs(basis[row:, column]).argmax())
        if abs(basis[pivot, column]) < 1e-3 * np.abs(basis).max():
            continue
        basis[[row, pivot]] = basis[[pivot, row]]
        basis[row] /= basis[row, column]
        others = np.arange(len(basis)) != row
        basis[others] -= np.outer(basis[others, column], basis[row])
        row += 1
    reduced: FloatArray = np.round(basis, 3) + 0.0
    return reduced
