"""Explain the difference between a fitted piece and a healthy motor: by a fault, none, or something else.

The difference d of the logarithms has a covariance C. It is tested along a fault's direction g by z = g'C^-1 d /
sqrt(g'C^-1 g) and as a whole by d'C^-1 d; with few healthy pieces the quantiles are Student's and Fisher's. Each
possible cause of the drag is a hypothesis of its own.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, reduce
from typing import ClassVar, Literal, NamedTuple

import numpy as np
from scipy import linalg, optimize, special

from motor_env.diagnosis.estimation.starts.start_fit import StartFit
from motor_env.diagnosis.estimation.uncertainty import excess_covariance
from motor_env.diagnosis.verdict.healthy_motor import NORMAL_DOF, Reference, add_normal_spread
from motor_env.diagnosis.verdict.load_hypotheses import LoadHypothesis, possible_loads
from motor_env.motor import identifiable
from motor_env.motor.faults import FaultKind
from motor_env.motor.parameters import FloatArray, Floats

NAMES = ("R", "K", "J", "B")
"""Quantities of a window; B is the drag over the speed."""
EXPONENTS = identifiable.matrix(NAMES)
_HOTTEST_K, _LEAST_FACTOR = 100.0, 0.5  # beyond them no quantity follows the temperature in a straight line
_SEVERITY_PRIOR = 0.30  # scale of the half-Cauchy prior of a severity
_HEALTHY_PRIOR = 0.8
SECOND_PRIOR = 1.0 - _HEALTHY_PRIOR
"""Prior probability of a second fault beside one."""
_OTHER_PRIOR = 0.30  # standard deviation of each logarithm where something else is wrong
_STEP_NODES = np.linspace(-10.0, 10.0, 401)  # standard deviations about the best step
_ALONG = 0.95  # cosine of two directions that are one
_COARSER = 5  # the nodes of each of two steps
_POWER_QUANTILE = 1.645  # 95 of 100
_LARGEST_LOG = 30.0
# Standard deviation of R, L, K, J and B beside a fault, over the fault's step; and the largest step.
_MODEL_ERROR, _FURTHEST = np.array([0.025, 0.02, 0.02, 0.1, 0.1]), math.log(10.0)
_LAG_IN_L = 0.3  # of the step of R's logarithm, by which L may move as well
_R, _L, _VOLTAGE, *_IMITATED = (identifiable.PARAMETERS.index(name) for name in "RLVKJB")
_LEAST = 1e-3  # length of a direction; a fault that shows has about 1
_DIRECTIONS = 4096
_ROUNDING = 1e6 * float(np.finfo(np.float64).eps)  # of the largest: a smaller variance is none
_NOISE_AND_OMNIBUS = 2  # tests beside those of the faults


@dataclass(frozen=True, slots=True)
class FittedWindow:
    """A fitted window of a motor at work.

    Attributes:
        log_values: logarithms of R, K, J and of the drag over the speed, shape (4,).
        log_covariance: shape (4, 4).
        whitened: innovations of current and speed over their standard deviations, shape (n, 2).
    """

    quantity_names: ClassVar[tuple[str, ...]] = NAMES
    exponents: ClassVar[FloatArray] = EXPONENTS
    log_values: FloatArray
    log_covariance: FloatArray
    whitened: FloatArray = field(default_factory=lambda: np.empty((0, 2)))

    @property
    def white_covariance(self) -> FloatArray:
        """Covariance for white residuals: the same."""
        return self.log_covariance


Fitted = StartFit | FittedWindow
"""A fitted piece of a recording: a start, or a window of a motor at work."""


@dataclass(frozen=True, slots=True)
class Difference:
    """Difference between a piece and a healthy one.

    Attributes:
        log_ratios: of the quantities, shape (n,).
        covariance: of the logarithms, shape (n, n).
        exponents: of (R, L, K, J, B, V) in each quantity, shape (n, 6).
        degrees_of_freedom: of the covariance.
        response: derivative by log (R, L, K, J, B, V), shape (n, 6); by default the exponents.
    """

    log_ratios: FloatArray
    covariance: FloatArray
    exponents: FloatArray
    degrees_of_freedom: float
    response: FloatArray | None = None

    @property
    def inverse(self) -> FloatArray:
        """Inverse of the covariance."""
        return _inverse(self.covariance)

    @property
    def squared_distance(self) -> float:
        """Squared Mahalanobis distance."""
        return float(self.log_ratios @ self.inverse @ self.log_ratios)

    def p_value(self, squared: float, dimensions: int) -> float:
        """Return the p-value of a squared distance (Hotelling); 1 for no dimension."""
        if dimensions == 0:
            return 1.0
        return float(special.fdtrc(dimensions, self.degrees_of_freedom, max(squared, 0.0) / dimensions))


@dataclass(frozen=True, slots=True)
class Change:
    """Change of a quantity from the reference.

    Attributes:
        name: the quantity.
        ratio: fitted over reference.
        low, high: 95 % interval of the ratio.
        verdict: `moved` if an alarm finds 1 outside the interval; `undecided` if a doubling would be found in fewer
            than 95 of 100 cases; else `healthy`.
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

    @property
    def excludes_healthy(self) -> bool:
        """Whether the healthy value lies outside of the interval."""
        return not self.low <= 1.0 <= self.high


@dataclass(frozen=True, slots=True)
class Explanation:
    """Fault as an explanation of a difference.

    Attributes:
        kind: the fault.
        z: step over its standard deviation.
        step: of the logarithms along the fault's direction.
        step_sd: its standard deviation.
        p_left_over: p-value of what it leaves unexplained.
        direction: change of the quantities per unit of the step, shape (n,).
        covariance: of what is not the fault, shape (n, n).
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
    """Share a rate among the tests of the faults, the noise and the whole (Bonferroni)."""
    return rate / (len(identifiable.nameable_kinds(exponents)) + _NOISE_AND_OMNIBUS)


@lru_cache(maxsize=16)
def _directions(dimensions: int) -> FloatArray:
    """Draw isotropic unit vectors, always the same, shape (n, dimensions)."""
    drawn = np.random.default_rng(1958).standard_normal((_DIRECTIONS, dimensions))
    return np.asarray(drawn / np.linalg.norm(drawn, axis=1, keepdims=True), dtype=np.float64)


def joint_share(rate: float, covariance: FloatArray, exponents: FloatArray, freedom: float) -> float:
    """Find the rate of one test at which all tests of faults and of the whole together alarm at `rate`.

    The whitened difference of a healthy motor has an isotropic direction and an independent length. Fisher's
    distribution gives the probability of a length beyond the nearest limit in each direction.
    """
    n, root = len(covariance), np.linalg.inv(np.linalg.cholesky(covariance))
    axes = [
        root @ identifiable.visible_direction(kind, exponents)
        for kind in identifiable.nameable_kinds(exponents)
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


def faulty_covariance(difference: Difference, kinds: Sequence[FaultKind], steps: FloatArray) -> FloatArray:
    """Return the covariance in the presence of faults, shape (n, n).

    The model error of each parameter grows with the step: what a dry friction brakes is fitted as inertia, too, and
    hardly as resistance. An unmodelled lag is fitted as L, in proportion to R.
    """
    parameters, variances = difference.exponents[:, :_VOLTAGE], np.zeros(_VOLTAGE)
    for kind, step in zip(kinds, steps, strict=True):
        variances += np.square(_MODEL_ERROR * min(abs(step), _FURTHEST))
        variances[_L] += (_LAG_IN_L * step * identifiable.fault_direction(kind)[_R]) ** 2
    return np.asarray(difference.covariance + parameters * variances @ parameters.T, dtype=np.float64)


def residual_p_value(difference: Difference, moved: FloatArray, covariance: FloatArray, n: int = 1) -> float:
    """Return the p-value of what n faults leave unexplained."""
    rest = difference.log_ratios - moved
    return difference.p_value(float(rest @ np.linalg.solve(covariance, rest)), len(rest) - n)


def explain(difference: Difference, kinds: tuple[FaultKind, ...] | None = None) -> list[Explanation]:
    """Explain a difference by each visible fault, by default by each that the quantities can name."""
    response = difference.exponents if difference.response is None else difference.response
    every = identifiable.nameable_kinds(difference.exponents) if kinds is None else kinds
    visible = (k for k in every if np.linalg.norm(identifiable.visible_direction(k, response)) >= _LEAST)
    return [fault for kind in visible for fault in explain_by(difference, (kind,))]


def explain_by(difference: Difference, kinds: Sequence[FaultKind]) -> list[Explanation]:
    """Explain a difference by faults at once, each with its z beside the others; empty if they are not told apart."""
    response = difference.exponents if difference.response is None else difference.response
    directions = np.column_stack([identifiable.visible_direction(kind, response) for kind in kinds])
    steps, sds = fit_steps(directions, difference.inverse, difference.log_ratios)
    if not np.isfinite(sds).all():
        return []
    covariance = faulty_covariance(difference, kinds, steps)
    p_left_over = residual_p_value(difference, directions @ steps, covariance, len(kinds))
    faults = []
    for n, kind in enumerate(kinds):
        others = [k for k in range(len(kinds)) if k != n]
        beside = faulty_covariance(difference, [kinds[k] for k in others], steps[others])
        own, sds = fit_steps(directions, _inverse(beside), difference.log_ratios)
        step, sd = float(own[n]), float(sds[n])
        faults.append(Explanation(kind, step / sd, step, sd, p_left_over, directions[:, n], covariance))
    return faults


def _inverse(matrix: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.inv(matrix), dtype=np.float64)


def fit_steps(directions: FloatArray, inverse: FloatArray, logs: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return steps along one or two directions, and their standard deviations: infinite if they are not told apart."""
    information = directions.T @ inverse @ directions
    if np.linalg.det(information) <= (1.0 - _ALONG**2) * np.prod(np.diag(information)):
        return np.zeros(len(information)), np.full(len(information), np.inf)
    spread = _inverse(information)
    return spread @ directions.T @ inverse @ logs, np.sqrt(np.diag(spread))


def is_separable(difference: Difference, kind: FaultKind, beside: FaultKind | None = None) -> bool:
    """Whether R and L alone confirm a fault: they do not move with magnet, inertia or load.

    Shorted turns move K too, as a weak magnet does; a warm winding hides their R, and so does a contact beside them.
    """
    kinds = (kind,) if beside is None else (kind, beside)
    directions = np.column_stack([identifiable.visible_direction(k, difference.exponents) for k in kinds])
    winding = ~difference.exponents[:, _IMITATED].any(axis=1)
    if not directions[winding, 0].any() or not directions[~winding, 0].any():
        return True
    inverse = _inverse(difference.covariance[np.ix_(winding, winding)])
    shown = directions[winding][:, directions[winding].any(axis=0)]
    steps, sds = fit_steps(shown, inverse, difference.log_ratios[winding])
    return bool(steps[0] > _POWER_QUANTILE * sds[0])


def smallest_changes(difference: Difference, limit: float) -> dict[str, float]:
    """Return the severity of each fault that is found in 95 of 100 cases, by a limit in standard deviations."""
    return {
        str(fault.kind): severity_of(fault.kind, (limit + _POWER_QUANTILE) * fault.step_sd)
        for fault in explain(difference)
    }


def severity_of(kind: FaultKind, step: float) -> float:
    """Convert a step of the logarithm along the fault's direction to a severity, clipped to a number."""
    return float(kind.severity(min(max(step, -_LARGEST_LOG), _LARGEST_LOG)))


def _factor(log: float) -> float:
    """Convert a logarithm to a factor, clipped to a number."""
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
    """Find the change of each quantity.

    Args:
        names: the quantities.
        difference: of the logarithms, shape (n,).
        covariance: shape (n, n).
        freedom: degrees of freedom of the covariance.
        limit: of significance, in standard deviations.
        is_alarm: whether quantities may have moved.
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
    """Return the log density of Student's t at rows, on the axes of a covariance that may be singular."""
    n = len(covariance)
    sizes, axes = linalg.eigh(covariance)
    present = sizes > _ROUNDING * np.max(np.abs(sizes))
    constant = (
        special.gammaln(0.5 * (freedom + n))
        - special.gammaln(0.5 * freedom)
        - 0.5 * n * math.log(freedom * math.pi)
        - 0.5 * float(np.sum(np.log(sizes[present])))
    )
    squared = np.square(points @ (axes[:, present] / np.sqrt(sizes[present]))).sum(axis=-1)
    return np.asarray(constant - 0.5 * (freedom + n) * np.log(1.0 + squared / freedom))


def probabilities(
    difference: Difference, faults: list[Explanation], pairs: Mapping[str, list[Explanation]] | None = None
) -> dict[str, float]:
    """Return the posterior probabilities of `healthy`, of each fault by its kind, of pairs, and of `other`.

    Beforehand a faulty motor has a second fault as often as any motor has a fault.
    """
    log_ratios, covariance, n = difference.log_ratios, difference.covariance, len(difference.log_ratios)
    # Degrees of freedom are rounded down: towards wider tails.
    freedom = max(int(min(difference.degrees_of_freedom, NORMAL_DOF)), 1)
    logs: dict[str, float] = {"healthy": float(_log_density(log_ratios, covariance, freedom))}
    logs |= {fault.kind: _log_evidence(log_ratios, (fault,), freedom) for fault in faults}
    logs["other"] = float(_log_density(log_ratios, covariance + _OTHER_PRIOR**2 * np.eye(n), freedom))
    healthy, faulty = math.log(_HEALTHY_PRIOR), math.log((1.0 - _HEALTHY_PRIOR) / (len(logs) - 1))
    logs = {name: log + (healthy if name == "healthy" else faulty) for name, log in logs.items()}
    for name, pair in (pairs or {}).items():
        logs[name] = _log_evidence(log_ratios, pair, freedom) + faulty + math.log(SECOND_PRIOR)
    total = float(np.logaddexp.reduce(list(logs.values())))
    return {name: math.exp(log - total) for name, log in logs.items()}


def severity_density(steps: Floats) -> FloatArray:
    """Return the prior density of a fault's step (half-Cauchy)."""
    return np.asarray(2.0 / (math.pi * _SEVERITY_PRIOR) / (1.0 + np.square(steps / _SEVERITY_PRIOR)))


def _log_evidence(log_ratios: FloatArray, faults: Sequence[Explanation], freedom: int) -> float:
    """Integrate the density of a difference over the severities of faults."""
    nodes, axes, weights = _STEP_NODES[:: _COARSER ** (len(faults) - 1)], [], []
    for fault in faults:
        steps = max(fault.step, 0.0) + fault.step_sd * nodes
        axes.append(steps[steps >= 0.0])
        weights.append(np.log(severity_density(axes[-1])) + math.log(fault.step_sd * (nodes[1] - nodes[0])))
    moved = sum(
        steps[..., None] * fault.direction
        for steps, fault in zip(np.meshgrid(*axes, indexing="ij"), faults, strict=True)
    )
    along = _log_density((log_ratios - moved).reshape(-1, len(log_ratios)), faults[0].covariance, freedom)
    return float(np.logaddexp.reduce(along + reduce(np.add.outer, weights).ravel()))


class Hypothesis(NamedTuple):
    """Difference of a piece from its reference under one hypothesis of its load, and its possible faults."""

    load: LoadHypothesis
    difference: Difference
    faults: list[Explanation]

    def is_alarm(self, limit: float, share: float) -> bool:
        """Whether a fault or the whole difference is significant."""
        d = self.difference
        p_value = d.p_value(d.squared_distance, len(d.log_ratios))
        return any(fault.z > limit for fault in self.faults) or p_value < share


def form_hypotheses(fit: Fitted, reference: Reference, rate: float) -> list[Hypothesis]:
    """Compare a fit with a reference without a load, and under each possible load.

    Only a start has several: the fit of a motor at work has terms for loads.
    """
    rows, same_warmth = shared_rows(fit, reference), covariance_at_one_temperature(fit, reference)
    exponents, freedom, hypotheses = fit.exponents[rows], reference.degrees_of_freedom, []
    share = alarm_share(rate, exponents)
    if isinstance(fit, StartFit):
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
    """Linearise the effect of the temperature on log ratios, shape (n,)."""
    if temperature_k == 0.0:
        return ratios
    kelvin, _ = estimate_warming(ratios, spread, warmth, temperature_k)
    warm = np.maximum(warmth * min(max(kelvin, -_HOTTEST_K), _HOTTEST_K), _LEAST_FACTOR - 1.0)
    return np.asarray(ratios + warm - np.log1p(warm), dtype=np.float64)


def estimate_warming(
    ratios: FloatArray, spread: FloatArray, warmth: FloatArray, temperature_k: float
) -> tuple[float, float]:
    """Estimate the warming of a motor in kelvin: posterior mean and standard deviation."""
    slope = np.linalg.solve(spread, warmth)
    precision = float(slope @ warmth) + temperature_k**-2
    return float(slope @ ratios) / precision, 1.0 / math.sqrt(precision)


def shared_rows(fit: Fitted, reference: Reference) -> list[int]:
    """Return the rows of the fit's quantities that the reference has."""
    return [fit.quantity_names.index(name) for name in reference.names]


def smallest_detectable(hypotheses: list[Hypothesis], own: float | None, limit: float) -> dict[str, float]:
    """Return the smallest severity of each fault that is found in 95 of 100 cases under every hypothesis.

    `own` is the motor's share of the drag, if known: the unit of a bearing fault.
    """
    smallest: dict[str, float] = {}
    for hypothesis in hypotheses:
        for kind, severity in smallest_changes(hypothesis.difference, limit).items():
            smallest[kind] = max(severity, smallest.get(kind, 0.0))
    return {kind: severity / severity_unit(kind, own) for kind, severity in smallest.items()}


def severity_unit(kind: str, own: float | None) -> float:
    """Return the unit of a severity: of a bearing fault the motor's own friction, if known."""
    return own if own is not None and kind == FaultKind.BEARING else 1.0


def covariance_at_one_temperature(fit: Fitted, reference: Reference) -> FloatArray:
    """Return the covariance of the difference from a healthy motor at the same temperature, shape (n, n).

    Healthy pieces include such a fit's error; the excess error of a shorter or noisier piece is added.
    """
    healthy, rows = reference.log_covariance, shared_rows(fit, reference)
    own = fit.white_covariance if reference.includes_fit_error else fit.log_covariance
    error = own[np.ix_(rows, rows)]
    added = excess_covariance(healthy, error) if reference.includes_fit_error else error
    return np.asarray((healthy + added) * reference.excess, dtype=np.float64)
