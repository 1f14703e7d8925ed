"""A fitted piece against a healthy motor: what explains the difference, a fault, none, or something else.

The difference d of the logarithms of a piece's quantities to those of a healthy one has a covariance C. Along a fault's
direction g it is tested by z = g'C^-1 d / sqrt(g'C^-1 g), as a whole by d'C^-1 d; with few healthy pieces the
quantiles are Student's and Fisher's. Nobody may have told of a load: there is a hypothesis for each idea of the drag.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import ClassVar, Literal, NamedTuple

import numpy as np
from scipy import linalg, optimize, special

from motor_env.diagnosis.healthy_motor import NORMAL_DOF, Reference, add_normal_spread
from motor_env.diagnosis.load_hypotheses import LoadHypothesis, possible_loads
from motor_env.fitting.starts.identified import Identified
from motor_env.fitting.uncertainty import beyond
from motor_env.motor import identifiable as quantities
from motor_env.motor.faults import FaultKind
from motor_env.motor.parameters import FloatArray

NAMES = ("R", "K", "J", "B")
"""What a window tells; B is the drag over the speed."""
EXPONENTS = quantities.matrix(NAMES)
_HOTTEST_K = 100.0
# Of a quantity when it gets warmer or colder: far from the model it follows no straight line.
_LEAST_FACTOR = 0.5
_SEVERITY_PRIOR = 0.30  # scale of the half-Cauchy prior: a large severity is no surprise
_HEALTHY_PRIOR = 0.8
_OTHER_PRIOR = 0.30  # standard deviation of each logarithm where something else is wrong
_STEP_NODES = np.linspace(-10.0, 10.0, 401)  # standard deviations about the best step
_POWER_QUANTILE = 1.645  # 95 of 100
_LARGEST_LOG = 30.0
# Standard deviation of each parameter beside a fault, over the square of the fault's step; no wear goes further.
_MODEL_ERROR, _FURTHEST = 0.04, math.log(10.0)
_LAG_IN_L = 0.3  # of the step of R's logarithm, by which L may move as well
_R, _L, _VOLTAGE, *_IMITATED = (quantities.PARAMETERS.index(name) for name in "RLVKJB")
_LEAST = 1e-3  # length of a direction; a fault that shows has about 1
_DIRECTIONS = 4096
_ROUNDING = 1e6 * float(np.finfo(np.float64).eps)  # of the largest: a smaller variance is none
_NOISE_AND_OMNIBUS = 2  # tests beside those of the faults


@dataclass(frozen=True, slots=True)
class FittedWindow:
    """A fitted window: logarithms of R, K, J and of the drag over the speed, shape (4,), their covariance, innovations.

    The innovations of current and speed are over their standard deviations, shape (n, 2); none of a short piece.
    """

    quantity_names: ClassVar[tuple[str, ...]] = NAMES
    exponents: ClassVar[FloatArray] = EXPONENTS
    log_values: FloatArray
    log_covariance: FloatArray
    whitened: FloatArray = field(default_factory=lambda: np.empty((0, 2)))

    @property
    def white_covariance(self) -> FloatArray:
        """The covariance, which is that of white residuals."""
        return self.log_covariance


Fitted = Identified | FittedWindow
"""A fitted piece of a recording: a start, or a window of a motor at work."""


@dataclass(frozen=True, slots=True)
class Difference:
    """How far a piece lies from a healthy one.

    Attributes:
        log_ratios: of the quantities, shape (n,).
        covariance: of the logarithms, everything that is uncertain included, shape (n, n).
        exponents: of (R, L, K, J, B, V) in each quantity, shape (n, 6).
        degrees_of_freedom: of the covariance.
        response: how the quantities move with the logarithms of (R, L, K, J, B, V); the exponents unless given.
    """

    log_ratios: FloatArray
    covariance: FloatArray
    exponents: FloatArray
    degrees_of_freedom: float
    response: FloatArray | None = None

    @property
    def inverse(self) -> FloatArray:
        """Inverse of the covariance."""
        return np.asarray(np.linalg.inv(self.covariance), dtype=np.float64)

    @property
    def squared_distance(self) -> float:
        """Squared Mahalanobis distance."""
        return float(self.log_ratios @ self.inverse @ self.log_ratios)

    def p_value(self, squared: float, dimensions: int) -> float:
        """Probability of a squared distance at least as large (Hotelling); 1 for no dimension."""
        if dimensions == 0:
            return 1.0
        return float(special.fdtrc(dimensions, self.degrees_of_freedom, max(squared, 0.0) / dimensions))


@dataclass(frozen=True, slots=True)
class Change:
    """How far a quantity lies from the reference.

    Attributes:
        name: the quantity.
        ratio: fitted over reference.
        low, high: interval of the ratio, 95 %, the reference's uncertainty included.
        verdict: `moved` where there is an alarm and 1 lies outside the interval at the wanted rate of false alarms;
            `undecided` where a doubling would not be found in 95 of 100 cases; else `healthy`.
    """

    name: str
    ratio: float
    low: float
    high: float
    verdict: Literal["healthy", "moved", "undecided"]

    @property
    def significant(self) -> bool:
        """Whether the quantity has moved."""
        return self.verdict == "moved"


@dataclass(frozen=True, slots=True)
class Explanation:
    """A fault as an explanation of a difference.

    Attributes:
        kind: the fault.
        z: how far it stands out, in standard deviations.
        step: of the logarithms along the fault's direction.
        step_sd: its standard deviation.
        p_left_over: probability of a rest at least as large as the one that it leaves unexplained.
        direction: how the quantities move with one unit of the step, shape (n,).
        covariance: of what is beside the fault, shape (n, n).
    """

    kind: FaultKind
    z: float
    step: float
    step_sd: float
    p_left_over: float
    direction: FloatArray
    covariance: FloatArray

    @property
    def severity(self) -> float:
        """Severity of the fault."""
        return severity_of(self.kind, self.step)


def alarm_share(rate: float, exponents: FloatArray) -> float:
    """Rate of false alarms of one test: those of the faults, of the noise and of the whole share it (Bonferroni)."""
    return rate / (len(quantities.nameable_kinds(exponents)) + _NOISE_AND_OMNIBUS)


@lru_cache(maxsize=16)
def _directions(dimensions: int) -> FloatArray:
    """Directions that are evenly spread, the same each time, shape (n, dimensions)."""
    drawn = np.random.default_rng(1958).standard_normal((_DIRECTIONS, dimensions))
    return np.asarray(drawn / np.linalg.norm(drawn, axis=1, keepdims=True), dtype=np.float64)


def joint_share(rate: float, covariance: FloatArray, exponents: FloatArray, freedom: float) -> float:
    """Rate of one test at which those of the faults and of the whole together alarm at a rate.

    While the motor is healthy the difference is a Student vector of the covariance: whitened, an evenly spread
    direction times a length that does not depend on it. In each direction the tests alarm beyond a length, and the
    probability of that is Fisher's.
    """
    n, root = len(covariance), np.linalg.inv(np.linalg.cholesky(covariance))
    axes = [
        root @ quantities.visible_direction(kind, exponents) for kind in quantities.nameable_kinds(exponents)
    ]
    along = np.max(_directions(n) @ np.transpose([axis / np.linalg.norm(axis) for axis in axes]), axis=1)

    def excess(log_share: float) -> float:
        share = math.exp(log_share)
        limit = -float(special.stdtrit(freedom, share)) / np.maximum(along, 1e-9)
        # The quantile of the inverse: exact for small shares, where 1 - share is not.
        least = np.minimum(limit, math.sqrt(n / float(special.fdtri(freedom, n, share))))
        return math.log(float(np.mean(special.fdtrc(n, freedom, least**2 / n))) / rate)

    return math.exp(
        float(optimize.brentq(excess, math.log(rate / (len(axes) + 2.0)), math.log(rate), xtol=1e-3))
    )


def covariance_with_fault(difference: Difference, kind: FaultKind, step: float) -> FloatArray:
    """Covariance of what a fault leaves: beside its step each parameter may move by a share of it.

    No motor is quite the model's, and the further a fault takes it, the less it is. A lag of sensor or supply that
    no term says is fitted as L, in proportion to R.
    """
    parameters = difference.exponents[:, :_VOLTAGE]
    variances = np.full(_VOLTAGE, _MODEL_ERROR * min(abs(step), _FURTHEST) ** 2) ** 2
    variances[_L] += (_LAG_IN_L * step * quantities.fault_direction(kind)[_R]) ** 2
    return np.asarray(difference.covariance + parameters * variances @ parameters.T, dtype=np.float64)


def project(difference: Difference, direction: FloatArray) -> tuple[float, float, float]:
    """A difference along a direction: z, the step, and its standard deviation."""
    inverse = difference.inverse
    information = float(direction @ inverse @ direction)
    step = float(direction @ inverse @ difference.log_ratios) / information
    return step * math.sqrt(information), step, 1.0 / math.sqrt(information)


def residual_p_value(difference: Difference, moved: FloatArray, covariance: FloatArray) -> float:
    """Probability of a rest at least as large as what is left where a fault has moved the quantities."""
    rest = difference.log_ratios - moved
    return difference.p_value(float(rest @ np.linalg.solve(covariance, rest)), len(rest) - 1)


def explain(difference: Difference, kinds: tuple[FaultKind, ...] | None = None) -> list[Explanation]:
    """Each of some faults that show as an explanation; by default of those that the quantities can name."""
    response = difference.exponents if difference.response is None else difference.response
    explanations = []
    for kind in quantities.nameable_kinds(difference.exponents) if kinds is None else kinds:
        direction = quantities.visible_direction(kind, response)
        if np.linalg.norm(direction) >= _LEAST:
            z, step, step_sd = project(difference, direction)
            covariance = covariance_with_fault(difference, kind, step)
            rest = residual_p_value(difference, step * direction, covariance)
            explanations.append(Explanation(kind, z, step, step_sd, rest, direction, covariance))
    return explanations


def is_separable(difference: Difference, kind: FaultKind) -> bool:
    """Whether a fault shows where no magnet, inertia or load imitates it.

    Shorted turns move K too; a warm winding hides their R, and where L is not told, K alone is left of them.
    """
    direction = quantities.visible_direction(kind, difference.exponents)
    winding = ~difference.exponents[:, _IMITATED].any(axis=1)
    if not direction[winding].any() or not direction[~winding].any():
        return True
    part = np.linalg.solve(difference.covariance[np.ix_(winding, winding)], direction[winding])
    z = part @ difference.log_ratios[winding] / math.sqrt(part @ direction[winding])
    return bool(z > _POWER_QUANTILE)


def smallest_changes(difference: Difference, limit: float) -> dict[str, float]:
    """Severity of each fault that is found in 95 of 100 cases, for a limit in standard deviations."""
    return {
        str(fault.kind): severity_of(fault.kind, (limit + _POWER_QUANTILE) * fault.step_sd)
        for fault in explain(difference)
    }


def severity_of(kind: FaultKind, step: float) -> float:
    """Severity of a step of the logarithm along the fault's direction, cut beyond any motor."""
    return float(kind.severity(min(max(step, -_LARGEST_LOG), _LARGEST_LOG)))


def _factor(log: float) -> float:
    """The factor of a logarithm; beyond any motor it is cut, so that what is not told at all stays a number."""
    return math.exp(min(max(log, -_LARGEST_LOG), _LARGEST_LOG))


def compare(
    names: tuple[str, ...],
    difference: FloatArray,
    covariance: FloatArray,
    freedom: float,
    limit: float,
    *,
    is_alarm: bool,
) -> tuple[Change, ...]:
    """How far quantities lie from their reference.

    Args:
        names: the quantities.
        difference: of their logarithms, shape (n,).
        covariance: of the difference, shape (n, n).
        freedom: degrees of freedom of the covariance.
        limit: standard deviations beyond which a difference is significant.
        is_alarm: without an alarm no quantity has moved.
    """
    half = -float(special.stdtrit(freedom, 0.025))
    changes = []
    for name, d, s in zip(names, difference, np.sqrt(np.diag(covariance)), strict=True):
        verdict: Literal["healthy", "moved", "undecided"] = "healthy"
        if is_alarm and abs(d) > limit * s:
            verdict = "moved"
        elif (limit + _POWER_QUANTILE) * s > math.log(2.0):
            verdict = "undecided"
        changes.append(Change(name, _factor(d), _factor(d - half * s), _factor(d + half * s), verdict))
    return tuple(changes)


def _log_density(points: FloatArray, covariance: FloatArray, freedom: int) -> FloatArray:
    """Log density of Student's t with a covariance, shape (n, n), at rows of n, on the axes that it has."""
    n = len(covariance)
    sizes, axes = linalg.eigh(covariance)
    seen = sizes > _ROUNDING * np.max(np.abs(sizes))
    constant = (
        special.gammaln(0.5 * (freedom + n))
        - special.gammaln(0.5 * freedom)
        - 0.5 * n * math.log(freedom * math.pi)
        - 0.5 * float(np.sum(np.log(sizes[seen])))
    )
    squared = np.square(points @ (axes[:, seen] / np.sqrt(sizes[seen]))).sum(axis=-1)
    return np.asarray(constant - 0.5 * (freedom + n) * np.log(1.0 + squared / freedom))


def probabilities(difference: Difference, faults: list[Explanation]) -> dict[str, float]:
    """Posterior probabilities of `healthy`, of each fault by its kind, and of `other`."""
    log_ratios, covariance, n = difference.log_ratios, difference.covariance, len(difference.log_ratios)
    # Degrees of freedom are rounded down: towards wider tails.
    freedom = max(int(min(difference.degrees_of_freedom, NORMAL_DOF)), 1)
    logs: dict[str, float] = {"healthy": float(_log_density(log_ratios, covariance, freedom))}
    for fault in faults:
        steps = max(fault.step, 0.0) + fault.step_sd * _STEP_NODES
        steps = steps[steps >= 0.0]
        prior = math.log(2.0 / (math.pi * _SEVERITY_PRIOR)) - np.log1p((steps / _SEVERITY_PRIOR) ** 2)
        along = _log_density(log_ratios - steps[:, None] * fault.direction, fault.covariance, freedom)
        width = math.log(fault.step_sd * (_STEP_NODES[1] - _STEP_NODES[0]))
        logs[fault.kind] = width + float(np.logaddexp.reduce(along + prior))
    logs["other"] = float(_log_density(log_ratios, covariance + _OTHER_PRIOR**2 * np.eye(n), freedom))
    faulty = math.log((1.0 - _HEALTHY_PRIOR) / (len(logs) - 1))
    logs = {
        name: log + (math.log(_HEALTHY_PRIOR) if name == "healthy" else faulty) for name, log in logs.items()
    }
    total = float(np.logaddexp.reduce(list(logs.values())))
    return {name: math.exp(log - total) for name, log in logs.items()}


class Hypothesis(NamedTuple):
    """A piece against its reference, for one idea of what its drag is; `faults` are what may explain it."""

    load: LoadHypothesis
    difference: Difference
    faults: list[Explanation]

    def is_alarm(self, limit: float, share: float) -> bool:
        """Whether a fault or the whole stands out."""
        d = self.difference
        p_value = d.p_value(d.squared_distance, len(d.log_ratios))
        return any(fault.z > limit for fault in self.faults) or p_value < share


def form_hypotheses(fit: Fitted, reference: Reference, rate: float) -> list[Hypothesis]:
    """A fit against a reference at a rate of false alarms: without a load, and as it looks under each load.

    Only a start is looked at under loads: the fit of a motor at work has terms for them.
    """
    rows, same_warmth = shared_rows(fit, reference), covariance_at_one_temperature(fit, reference)
    exponents, freedom, hypotheses = fit.exponents[rows], reference.degrees_of_freedom, []
    share = alarm_share(rate, exponents)
    if isinstance(fit, Identified):
        loads = possible_loads(fit, reference.own_friction)
    else:
        loads = [LoadHypothesis(None, fit.exponents, reference.own_friction or 1.0)]
    for each in loads:
        load = replace(each, response=each.response[rows])
        ratios = fit.log_values[rows] - reference.log_values - reference.warmer_k * load.warmth
        straight = _linearise_warming(ratios, same_warmth, load.warmth, reference.temperature_k)
        warmer = reference.temperature_k**2 * np.outer(load.warmth, load.warmth)
        covariance = add_normal_spread(same_warmth, warmer, share, freedom)
        difference = Difference(straight, covariance, exponents, freedom, load.response)
        hypotheses.append(Hypothesis(load, difference, explain(difference)))
    return hypotheses


def _linearise_warming(
    ratios: FloatArray, spread: FloatArray, warmth: FloatArray, temperature_k: float
) -> FloatArray:
    """Logarithms that move in proportion to the temperature: the factors do, their logarithms a little less."""
    if temperature_k == 0.0:
        return ratios
    kelvin, _ = estimate_warming(ratios, spread, warmth, temperature_k)
    warm = np.maximum(warmth * min(max(kelvin, -_HOTTEST_K), _HOTTEST_K), _LEAST_FACTOR - 1.0)
    return np.asarray(ratios + warm - np.log1p(warm), dtype=np.float64)


def estimate_warming(
    ratios: FloatArray, spread: FloatArray, warmth: FloatArray, temperature_k: float
) -> tuple[float, float]:
    """How much warmer a motor seems, by the posterior mean and its standard deviation."""
    slope = np.linalg.solve(spread, warmth)
    precision = float(slope @ warmth) + temperature_k**-2
    return float(slope @ ratios) / precision, 1.0 / math.sqrt(precision)


def shared_rows(fit: Fitted, reference: Reference) -> list[int]:
    """Rows of the fit's quantities of which the reference speaks."""
    return [fit.quantity_names.index(name) for name in reference.names]


def smallest_detectable(hypotheses: list[Hypothesis], own: float | None, limit: float) -> dict[str, float]:
    """Smallest severity of each fault that is found in 95 of 100 cases, whatever the drag is.

    Where the motor's `own` share of the drag is known, a bearing fault is one of its own friction.
    """
    smallest: dict[str, float] = {}
    for hypothesis in hypotheses:
        for kind, severity in smallest_changes(hypothesis.difference, limit).items():
            smallest[kind] = max(severity, smallest.get(kind, 0.0))
    return {kind: severity / severity_unit(kind, own) for kind, severity in smallest.items()}


def severity_unit(kind: str, own: float | None) -> float:
    """What a severity that shows in the whole drag is divided by: that of a bearing fault is of its own friction."""
    return own if own is not None and kind == FaultKind.BEARING else 1.0


def covariance_at_one_temperature(fit: Fitted, reference: Reference) -> FloatArray:
    """Covariance of the difference between this piece and a healthy motor that is as warm.

    Healthy pieces hold errors of fits like this one. Where this one tells less than they did, being shorter or
    noisier, what its own error is beyond theirs is added.
    """
    healthy, rows = reference.log_covariance, shared_rows(fit, reference)
    own = fit.white_covariance if reference.includes_fit_error else fit.log_covariance
    error = own[np.ix_(rows, rows)]
    added = beyond(healthy, error) if reference.includes_fit_error else error
    return np.asarray((healthy + added) * reference.excess, dtype=np.float64)
