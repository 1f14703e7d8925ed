"""From a residual to the faults that explain it: which, how large, and what cannot be told apart or seen at all.

Each hypothesis is a product of powers of the motor's quantities: a bearing is friction by a factor exp(a), a short is
R, L, K by exp(-a), exp(-2a), exp(-a). Its only unknown a is fitted by maximum likelihood to what the nominal motor
leaves over, whitened for the tolerances (S + J P J'; signatures: Willsky & Jones 1976, isolation by them: Basseville &
Nikiforov 1993, ch. 7); its standard deviation is the Cramer-Rao bound (Rao 1945; Cramer 1946). The hypothesis that
explains most is not enough of a verdict: all that the residual does not rule out belong to it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import norm

from motor_env.inference.identifiability import (
    FAULT_DIRECTIONS,
    MOTOR_QUANTITIES,
    Experiment,
    identifiability,
)
from motor_env.inference.parametrisation import QUANTITIES, Coordinates
from motor_env.inference.whitening import MarginalWhitener
from motor_env.motor.parameters import FloatArray, MotorParameters, require
from motor_env.simulation.recipes import FACTORS, Spread
from motor_env.simulation.simulate import simulate_states

HYPOTHESES: dict[str, dict[str, float]] = {
    **{str(kind): direction for kind, direction in FAULT_DIRECTIONS.items()},
    "magnet": {"constants": -1.0},
}
"""Powers of exp(a) on the quantities: the fault kinds, and a magnet that has lost flux."""

LARGE_CHANGE = 0.5
"""A change of this size (a = log 1.5) that would stay below three standard deviations is called hidden."""

_SEEN = 3.0
_PRIOR_SD = 0.3  # half-normal prior on a, for the probabilities
_PRIOR_HEALTHY = 0.5
_STEPS = 30
_LONGEST_STEP = 0.3
_TRIFLE = 0.02  # powers below are no part of an explanation


class Change(NamedTuple):
    """How far a quantity has moved: its factor, and an interval of it."""

    quantity: str
    factor: float
    low: float
    high: float

    def words(self) -> str:
        """As "resistance up 5.1 % (4.0 to 6.2 %)"."""
        up = self.factor >= 1.0
        ends = (self.low, self.high) if up else (self.high, self.low)
        sign = 100.0 if up else -100.0
        size, near, far = (
            f"{float(f'{sign * (value - 1.0):.2g}'):g}"
            for value in (self.factor, *ends)  # two digits
        )
        return f"{self.quantity} {'up' if up else 'down'} {size} % ({near} to {far} %)"


class Explanation(NamedTuple):
    """A hypothesis that the residual does not rule out.

    Attributes:
        name: of the hypothesis.
        changes: what it does to the quantities, with intervals.
        standard_deviations: z, how far it stands out of the noise.
        probability: posterior, among health and all hypotheses that can be seen.
        same_as: other changes with exactly the same residual: no experiment of this kind tells them apart.
    """

    name: str
    changes: tuple[Change, ...]
    standard_deviations: float
    probability: float
    same_as: tuple[tuple[Change, ...], ...] = ()

    def words(self) -> str:
        """The explanation in words, and what it cannot be told from."""
        said = [", ".join(change.words() for change in changes) for changes in (self.changes, *self.same_as)]
        return f"{self.name}: " + "; or ".join(said)


class Isolation(NamedTuple):
    """What a residual says.

    Attributes:
        explanations: the verdict, most likely first; empty where the motor passes for healthy.
        is_explained: whether the best explanation (or health) leaves no more than noise.
        probability_healthy: posterior of health.
        hidden: why each hypothesis that cannot be seen here cannot.
    """

    explanations: tuple[Explanation, ...]
    is_explained: bool
    probability_healthy: float
    hidden: dict[str, str]

    @property
    def verdict(self) -> tuple[str, ...]:
        """Names of the faults, any of which it may be."""
        return tuple(explanation.name for explanation in self.explanations)

    def sentences(self) -> list[str]:
        """The verdict in words."""
        lines = [" or ".join(self.verdict) or "healthy", *(one.words() for one in self.explanations)]
        if not self.is_explained:
            lines.append("what is left over is more than noise: something else is going on")
        return lines + [f"{name}: not identifiable, {reason}" for name, reason in self.hidden.items()]


@dataclass(frozen=True, slots=True)
class Isolator:
    """Explains residuals of one motor in one experiment (Willsky & Jones 1976). Make one with `Isolator.of`.

    Attributes:
        coordinates: logarithms of factors on the motor's quantities and the supply.
        experiment: what drives it and what is read.
        directions: of the hypotheses that can be seen, powers of each quantity, shape (n_quantities,).
        tolerances: standard deviation of each coordinate in healthy motors, shape (n_quantities,).
        hidden: why each other hypothesis cannot be seen.
        open_directions: changes of several quantities that no sample shows, shape (n_open, n_quantities).
        false_alarm_rate: of healthy motors, at most.
        level: probability, at least, that the verdict names the true hypothesis; of the intervals too.
    """

    coordinates: Coordinates
    experiment: Experiment
    directions: dict[str, FloatArray]
    tolerances: FloatArray
    hidden: dict[str, str] = field(default_factory=dict)
    open_directions: FloatArray = field(default_factory=lambda: np.zeros((0, len(QUANTITIES))))
    false_alarm_rate: float = 0.01
    level: float = 0.95

    @classmethod
    def of(
        cls,
        parameters: MotorParameters,
        experiment: Experiment,
        spread: Spread | None = None,
        *,
        hypotheses: Mapping[str, Mapping[str, float]] = HYPOTHESES,
        false_alarm_rate: float = 0.01,
        level: float = 0.95,
    ) -> Self:
        """For a nominal motor with tolerances (none by default).

        Raises:
            ValueError: a rate that is none, or a hypothesis about a quantity that does not exist.
        """
        for name, value in (("false_alarm_rate", false_alarm_rate), ("level", level)):
            require(0.0 < value < 1.0, f"{name} must lie between 0 and 1, got {value:g}")
        unknown = {quantity for powers in hypotheses.values() for quantity in powers} - set(QUANTITIES)
        require(not unknown, f"hypotheses must be about {', '.join(QUANTITIES)}, got {', '.join(unknown)}")
        given = spread or Spread()
        tolerances = np.array([getattr(given, name) if name in FACTORS else 0.0 for name in QUANTITIES])
        slopes = experiment.slopes(parameters, QUANTITIES)
        whitener = _whitener(slopes, tolerances)
        directions, hidden = {}, {}
        for name, powers in hypotheses.items():
            direction = np.array([powers.get(quantity, 0.0) for quantity in QUANTITIES])
            separation = np.linalg.norm(_white(whitener, slopes @ direction)) * np.log1p(LARGE_CHANGE)
            if separation >= _SEEN:
                directions[name] = direction
            else:
                hidden[name] = (
                    f"a change of {100.0 * LARGE_CHANGE:.0f} % would move the residual by {separation:.2g} standard "
                    "deviations only: no sample that is looked at depends on it enough"
                )
        require(bool(directions), "nothing can be seen in this experiment: " + "; ".join(hidden.values()))
        known = identifiability(parameters, experiment, MOTOR_QUANTITIES).open_directions
        known = np.where(np.abs(known) < _TRIFLE, 0.0, known)
        known = known[(known != 0.0).sum(axis=1) > 1]  # a quantity that no sample shows stands for no other
        open_directions = np.zeros((len(known), len(QUANTITIES)))
        open_directions[:, [QUANTITIES.index(name) for name in MOTOR_QUANTITIES]] = known
        coordinates = Coordinates.from_names(parameters, QUANTITIES)
        return cls(
            coordinates, experiment, directions, tolerances, hidden, open_directions, false_alarm_rate, level
        )

    def isolate(self, measurements: ArrayLike) -> Isolation:
        """Explain one transient.

        Alarms where the best hypothesis stands out further than the false-alarm rate, shared among all, allows
        (Bonferroni). Then every hypothesis is named whose likelihood is not too far below the best one's: whatever the
        distance of two hypotheses, the true one lies x^2 / 2 below the other with a probability of norm.sf(x) at most.

        Args:
            measurements: shape (n_channels, n_samples), of the experiment.
        """
        measured = np.asarray(measurements, dtype=np.float64)
        shape = (len(self.experiment.sensor.channels), len(self.experiment.voltage_v))
        require(measured.shape == shape, f"measurements must have shape {shape}, got {measured.shape}")
        nominal = self._at(measured, np.zeros(len(QUANTITIES)))
        fits = {name: self._fit(measured, direction) for name, direction in self.directions.items()}
        gains = {name: (nominal.deviance - fit.deviance) * (fit.size > 0.0) for name, fit in fits.items()}
        best = max(gains, key=lambda name: gains[name])
        count = len(fits)
        evidence = {
            name: np.exp(0.5 * (gains[name] - gains[best]))
            * (fit.std * np.sqrt(2.0 * np.pi) * 2.0 * norm.pdf(fit.size / _PRIOR_SD) / _PRIOR_SD)
            * ((1.0 - _PRIOR_HEALTHY) / count * (fit.size > 0.0))
            for name, fit in fits.items()
        }
        healthy = _PRIOR_HEALTHY * np.exp(-0.5 * gains[best])
        total = healthy + sum(evidence.values())
        alarm = np.sqrt(max(gains[best], 0.0)) > norm.isf(self.false_alarm_rate / count)
        cut = norm.isf((1.0 - self.level) / max(count - 1, 1)) ** 2
        named = [name for name in fits if alarm and gains[name] > max(0.0, gains[best] - cut)]
        explanations = [
            self._explanation(name, fits[name], np.sqrt(gains[name]), evidence[name] / total)
            for name in named
        ]
        chi2, n_values = fits[best].chi2 if alarm else nominal.chi2, len(nominal.left)
        return Isolation(
            tuple(sorted(explanations, key=lambda one: -one.probability)),
            bool(chi2 - n_values < norm.isf(1e-3) * np.sqrt(2.0 * n_values)),
            float(healthy / total),
            dict(self.hidden),
        )

    def _at(self, measured: FloatArray, values: FloatArray) -> _Point:
        """What a motor at the coordinates leaves over, white for the tolerances as they act on that motor."""
        motor, supply = self.coordinates.motors(values)
        driven = self.experiment
        voltage = supply * driven.voltage_v
        states = simulate_states(motor, voltage, driven.dt_s, load_torque_n_m=driven.load_torque_n_m)
        residual = (measured - driven.sensor.observation @ states.T) / driven.sensor.noise_std[:, None]
        slopes = replace(driven, voltage_v=voltage).slopes(motor, QUANTITIES)
        whitener = _whitener(slopes, self.tolerances)
        left = _white(whitener, residual[:, driven.first_sample :].T.ravel())
        return _Point(left, slopes, whitener)

    def _fit(self, measured: FloatArray, direction: FloatArray) -> _Fitted:
        """Most likely size of a hypothesis: Gauss-Newton in its one coordinate, the steps held short."""
        size = 0.0
        point = self._at(measured, size * direction)
        for _ in range(_STEPS):
            signature = _white(point.whitener, point.slopes @ direction)
            information = float(signature @ signature)
            step = float(np.clip(signature @ point.left / information, -_LONGEST_STEP, _LONGEST_STEP))
            size += step
            point = self._at(measured, size * direction)
            if abs(step) < 1e-3 / np.sqrt(information):
                break
        return _Fitted(size, 1.0 / np.sqrt(information), point.chi2, point.deviance)

    def _explanation(self, name: str, fit: _Fitted, z: float, probability: float) -> Explanation:
        direction = self.directions[name]
        same_as = []
        for hidden in self.open_directions:
            for shared in np.flatnonzero(direction * hidden):
                other = direction - direction[shared] / hidden[shared] * hidden
                same_as.append(self._changes(fit, np.where(np.abs(other) < 1e-9, 0.0, other)))
        return Explanation(name, self._changes(fit, direction), z, float(probability), tuple(same_as))

    def _changes(self, fit: _Fitted, direction: FloatArray) -> tuple[Change, ...]:
        half = float(norm.isf(0.5 * (1.0 - self.level))) * fit.std
        answer = []
        for quantity, power in zip(QUANTITIES, direction, strict=True):
            ends = sorted(float(np.exp(power * size)) for size in (fit.size - half, fit.size + half))
            if power:
                answer.append(Change(quantity, float(np.exp(power * fit.size)), ends[0], ends[1]))
        return tuple(answer)


class _Point(NamedTuple):
    left: FloatArray
    slopes: FloatArray
    whitener: MarginalWhitener

    @property
    def chi2(self) -> float:
        return float(self.left @ self.left)

    @property
    def deviance(self) -> float:
        """Minus twice the log-likelihood: what the tolerances leave unknown counts too."""
        return self.chi2 + 2.0 * float(np.log(self.whitener.scale).sum())


class _Fitted(NamedTuple):
    size: float
    std: float
    chi2: float
    deviance: float


def _whitener(slopes: FloatArray, tolerances: FloatArray) -> MarginalWhitener:
    return MarginalWhitener.from_slopes((slopes * tolerances)[:, tolerances > 0.0])


def _white(whitener: MarginalWhitener, values: FloatArray) -> FloatArray:
    return whitener.whiten(values[:, None])[:, 0]
