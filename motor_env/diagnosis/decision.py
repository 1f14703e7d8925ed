"""The decision on a fitted recording: its quantities against a reference, with every uncertainty in the balance.

The fit gives the logarithms y of what the recording can tell, with a covariance that knows of the model's error; the
reference gives where a healthy motor lies, with the covariance of its tolerances, the temperature and the supply, or
of the spread between healthy starts. Their difference d = y - y_ref has the sum C of both covariances. Then

- one-sided tests along the direction of each fault, z = g'C^-1 d / sqrt(g'C^-1 g), and an omnibus test d'C^-1 d, share
  the rate of false alarms among them (Bonferroni); with few healthy starts the quantiles are Student's and Fisher's;
- after an alarm the most probable fault is named, unless what it leaves unexplained is itself significant or "other"
  is more probable still;
- the confidence is the posterior probability of the verdict, with a half-Cauchy prior on the severity.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np
from scipy import stats

from motor_env.diagnosis.filter_check import FilterCheck
from motor_env.diagnosis.healthy_motor import NORMAL_DOF, Reference, white_error
from motor_env.identification.identify import Identified
from motor_env.motor import identifiable as quantities
from motor_env.motor.faults import FaultKind, motor_kinds
from motor_env.motor.parameters import FloatArray
from motor_env.recordings.recording import Recording

DEFAULT_FALSE_ALARM_RATE = 0.01
_SEVERITY_PRIOR = 0.30
_STEP_NODES = np.linspace(-10.0, 10.0, 401)  # standard deviations about the best step
_OTHER_PRIOR = 0.30
_HEALTHY_PRIOR = 0.8
_POWER_QUANTILE = 1.645
_DOUBLED = 1.0
_LARGEST_LOG = 30.0


class Verdict(StrEnum):
    """What is said of a recording."""

    HEALTHY = "healthy"
    BEARING = "bearing"
    WINDING = "winding"
    MAGNET = "magnet"
    NOISE = "noise"
    OTHER = "other"
    NO_REFERENCE = "no_reference"
    UNUSABLE = "unusable"

    @property
    def is_fault(self) -> bool:
        """Whether it calls for action."""
        return self not in (Verdict.HEALTHY, Verdict.NO_REFERENCE, Verdict.UNUSABLE)

    @classmethod
    def _missing_(cls, value: object) -> Verdict | None:
        """The word of a fault kind that was registered from outside the package."""
        if value not in {kind.verdict for kind in FaultKind}:
            return None
        word = str.__new__(cls, value)
        word._name_, word._value_ = str(value).upper(), str(value)
        return _REGISTERED.setdefault(str(value), word)


_REGISTERED: dict[str, Verdict] = {}


@dataclass(frozen=True, slots=True)
class Change:
    """How far a quantity lies from the reference.

    Attributes:
        name: the quantity.
        ratio: fitted over reference.
        low, high: interval of the ratio, 95 %, the reference's uncertainty included.
        significant: whether 1 lies outside the interval at the wanted rate of false alarms.
    """

    name: str
    ratio: float
    low: float
    high: float
    significant: bool


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """The verdict on one recording, and what it rests on."""

    recording: Recording
    verdict: Verdict
    reasons: tuple[str, ...]
    severity: float | None = None
    severity_low: float | None = None
    severity_high: float | None = None
    confidence: float | None = None
    fault_kind: FaultKind | None = None
    identified: Identified | None = None
    reference: Reference | None = None
    changes: tuple[Change, ...] = ()
    smallest_changes: dict[str, float] = field(default_factory=dict)
    filter_check: FilterCheck | None = None

    @property
    def warning(self) -> str:
        """That the recording is not consistent with the fitted model, in one sentence; empty where it is."""
        if self.filter_check is None or self.filter_check.consistency is None:
            return ""
        return self.filter_check.consistency.warning


@dataclass(frozen=True, slots=True)
class _Candidate:
    """A fault as an explanation of the difference."""

    kind: FaultKind
    z: float
    step: float
    step_sd: float
    left_over: float


def _candidates(
    difference: FloatArray, inverse: FloatArray, exponents: FloatArray, kinds: tuple[FaultKind, ...]
) -> list[_Candidate]:
    total = float(difference @ inverse @ difference)
    found = []
    for kind in kinds:
        direction = quantities.visible_direction(kind, exponents)
        information = float(direction @ inverse @ direction)
        step = float(direction @ inverse @ difference) / information
        z = step * math.sqrt(information)
        found.append(_Candidate(kind, z, step, 1.0 / math.sqrt(information), total - z * z))
    return found


def significance_limit(rate: float, exponents: FloatArray, freedom: float) -> float:
    """Standard deviations that are significant: the rate is shared among the faults, "other" and the noise."""
    return float(stats.t.isf(rate / (len(quantities.nameable_kinds(exponents)) + 2), freedom))


def smallest_changes(covariance: FloatArray, exponents: FloatArray, limit: float) -> dict[str, float]:
    """Severity of each fault that is found in 95 of 100 cases, for a limit in standard deviations."""
    inverse = np.asarray(np.linalg.inv(covariance), dtype=np.float64)
    none = np.zeros(len(covariance))
    return {
        str(c.kind): _severity(c.kind, (limit + _POWER_QUANTILE) * c.step_sd)
        for c in _candidates(none, inverse, exponents, quantities.nameable_kinds(exponents))
    }


def _severity(kind: FaultKind, step: float) -> float:
    """Severity of a step of the logarithm along the fault's direction, cut beyond any motor."""
    return float(kind.severity(min(max(step, -_LARGEST_LOG), _LARGEST_LOG)))


def _factor(log: float) -> float:
    """The factor of a logarithm; beyond any motor it is cut, so that what is not told at all stays a number."""
    return math.exp(min(max(log, -_LARGEST_LOG), _LARGEST_LOG))


def decide(
    recording: Recording, fit: Identified, reference: Reference, check: FilterCheck, rate: float
) -> Diagnosis:
    """The diagnosis of a fit against a reference, at a rate of false alarms per healthy recording."""
    difference = fit.log_values - reference.log_values
    covariance = _covariance(fit, reference)
    inverse = np.asarray(np.linalg.inv(covariance), dtype=np.float64)
    which = {"has_voltage": fit.start.voltage_known, "has_speed": fit.start.speed_rad_s is not None}
    exponents = quantities.matrix(**which)
    freedom, n = reference.degrees_of_freedom, len(difference)
    kinds = quantities.nameable_kinds(exponents)
    share = rate / (len(kinds) + 2)
    limit = significance_limit(rate, exponents, freedom)
    candidates = _candidates(difference, inverse, exponents, kinds)
    omnibus = _fisher(float(difference @ inverse @ difference), n, freedom)
    noise_z = 0.0
    if reference.log_noise is not None and not _noise_is_hidden(fit, reference):
        noise_z = (math.log(max(fit.noise_a, 1e-12)) - reference.log_noise) / reference.log_noise_sd
    changes = compare(fit.quantity_names, difference, covariance, freedom, limit)
    probability = _posterior(difference, covariance, exponents, freedom, candidates)
    base = Diagnosis(
        recording,
        Verdict.HEALTHY,
        (f"no quantity has moved further than {reference.source} and the fit's own error allow",),
        severity=0.0,
        confidence=probability["healthy"],
        identified=fit,
        reference=reference,
        changes=changes,
        filter_check=check,
        smallest_changes=smallest_changes(covariance, exponents, limit),
    )
    significant = [c for c in candidates if c.z > limit]

    def explains(candidate: _Candidate) -> bool:
        return candidate.z > limit and _fisher(candidate.left_over, n - 1, freedom) > rate

    explaining = [c for c in significant if explains(c)]
    best = max(explaining, key=lambda c: probability[c.kind], default=None)
    if best is not None and probability[best.kind] >= probability["other"]:
        return _called(base, best, float(stats.t.isf(0.025, freedom)), probability)
    if significant or omnibus < share:
        unnamed = tuple(kind for kind in motor_kinds() if kind not in kinds)
        alike = filter(explains, _candidates(difference, inverse, exponents, unnamed))
        return replace(
            base,
            verdict=Verdict.OTHER,
            reasons=(*_other_reasons(changes, reference), *map(_alike_reason, alike)),
            severity=None,
            confidence=probability["other"],
        )
    unseen = _unseen_fault(base.smallest_changes)
    if unseen is not None:
        return replace(base, verdict=Verdict.UNUSABLE, reasons=(unseen,), severity=None, confidence=None)
    if noise_z > limit:
        ratio = math.exp(noise_z * reference.log_noise_sd)
        return replace(
            base,
            verdict=Verdict.NOISE,
            reasons=(
                f"the parameters are as expected, but the current's noise is {ratio:.2f} times the reference's",
            ),
            severity=ratio**2 - 1.0,
            confidence=float(stats.t.cdf(noise_z, freedom)),
        )
    return base


def _covariance(fit: Identified, reference: Reference) -> FloatArray:
    """Covariance of the difference between this start and a healthy motor.

    Healthy starts hold errors of fits like this one. Where this start tells less than they did, being shorter or
    noisier, what its own error is beyond theirs is added.
    """
    healthy = reference.log_covariance
    if not reference.includes_fit_error:
        return healthy + fit.log_covariance
    root = np.linalg.cholesky(healthy)
    inverse = np.linalg.inv(root)
    sizes, axes = np.linalg.eigh(inverse @ white_error(fit) @ inverse.T)
    beyond = root @ axes * np.sqrt(np.maximum(sizes - 1.0, 0.0))
    covariance: FloatArray = healthy + beyond @ beyond.T
    return covariance


def _unseen_fault(smallest: dict[str, float]) -> str | None:
    """Why a recording cannot be called healthy: a doubled friction or resistance would not show in it."""
    for kind, quantity in ((FaultKind.BEARING, "friction"), (FaultKind.WINDING_CONTACT, "resistance")):
        if smallest[str(kind)] > _DOUBLED:
            return (
                f"the recording is too coarse, too noisy or too short to tell the {quantity}: only a rise of"
                f" {smallest[str(kind)]:.0%} would show"
            )
    return None


def _called(base: Diagnosis, best: _Candidate, quantile: float, probability: dict[str, float]) -> Diagnosis:
    """The diagnosis with a known fault in it."""
    verdict, half = Verdict(best.kind.verdict), quantile * best.step_sd
    return replace(
        base,
        verdict=verdict,
        reasons=(
            best.kind.finding,
            "compared with " + ("nothing" if base.reference is None else base.reference.source),
        ),
        severity=_severity(best.kind, best.step),
        severity_low=_severity(best.kind, best.step - half),
        severity_high=_severity(best.kind, best.step + half),
        confidence=sum(probability.get(kind, 0.0) for kind in motor_kinds() if kind.verdict == verdict),
        fault_kind=best.kind,
    )


def _noise_is_hidden(fit: Identified, reference: Reference) -> bool:
    """Coarse steps, a rectifier, a dead zone and a converter's ripple change the noise seen: it tells nothing.

    Healthy starts were recorded with the same sensor, and hold the same.
    """
    if reference.includes_fit_error:
        return False
    alignment = fit.start.alignment
    coarse = alignment.quantum_a > math.exp(reference.log_noise or 0.0)
    hides = alignment.rectified or fit.extension.dead_zone_a > 0.0
    return coarse or hides or bool(fit.start.lines)


def _fisher(squared: float, n: int, freedom: float) -> float:
    """Probability of a squared Mahalanobis distance at least as large (Hotelling); 1 for no dimension."""
    if n == 0:
        return 1.0
    return float(stats.f.sf(max(squared, 0.0) / n, n, freedom))


def compare(
    names: tuple[str, ...], difference: FloatArray, covariance: FloatArray, freedom: float, limit: float
) -> tuple[Change, ...]:
    """How far quantities lie from their reference.

    Args:
        names: the quantities.
        difference: of their logarithms, shape (n,).
        covariance: of the difference, shape (n, n).
        freedom: degrees of freedom of the covariance.
        limit: standard deviations beyond which a difference is significant.
    """
    half = float(stats.t.isf(0.025, freedom))
    sigma = np.sqrt(np.diag(covariance))
    return tuple(
        Change(name, _factor(d), _factor(d - half * s), _factor(d + half * s), bool(abs(d) > limit * s))
        for name, d, s in zip(names, difference, sigma, strict=True)
    )


def _whole(freedom: float) -> int:
    """Degrees of freedom rounded down: towards wider tails."""
    return max(int(min(freedom, NORMAL_DOF)), 1)


def _posterior(
    difference: FloatArray,
    covariance: FloatArray,
    exponents: FloatArray,
    freedom: float,
    candidates: list[_Candidate],
) -> dict[str, float]:
    """Probabilities of healthy, each fault and other; severities half-Cauchy, so that a large one is no surprise."""
    n = len(difference)
    zero = np.zeros(n)
    density = stats.multivariate_t(loc=zero, shape=covariance, df=_whole(freedom))
    logs: dict[str, float] = {"healthy": float(density.logpdf(difference))}
    for candidate in candidates:
        direction = quantities.visible_direction(candidate.kind, exponents)
        steps = max(candidate.step, 0.0) + candidate.step_sd * _STEP_NODES
        steps = steps[steps >= 0.0]
        prior = stats.halfcauchy.logpdf(steps, scale=_SEVERITY_PRIOR)
        along = density.logpdf(difference - steps[:, None] * direction)
        width = math.log(candidate.step_sd * (_STEP_NODES[1] - _STEP_NODES[0]))
        logs[candidate.kind] = width + float(np.logaddexp.reduce(along + prior))
    wide = covariance + _OTHER_PRIOR**2 * np.eye(n)
    logs["other"] = float(stats.multivariate_t(loc=zero, shape=wide, df=_whole(freedom)).logpdf(difference))
    others = math.log((1.0 - _HEALTHY_PRIOR) / (len(logs) - 1))
    logs = {
        name: value + (math.log(_HEALTHY_PRIOR) if name == "healthy" else others)
        for name, value in logs.items()
    }
    total = float(np.logaddexp.reduce(list(logs.values())))
    return {name: math.exp(value - total) for name, value in logs.items()}


def _alike_reason(candidate: _Candidate) -> str:
    """A fault that explains the difference, and cannot be named because a coupled load would look the same."""
    return (
        f"it may be {candidate.kind} by {_severity(candidate.kind, candidate.step):.0%} ({candidate.kind.finding}),"
        " or a coupled load: a recording of the speed tells which"
    )


def _other_reasons(changes: tuple[Change, ...], reference: Reference) -> tuple[str, ...]:
    moved = [c for c in changes if c.significant] or sorted(
        changes, key=lambda c: abs(math.log(c.ratio)) / math.log(c.high / c.low), reverse=True
    )[:1]
    words = [
        f"{c.name} is {'up' if c.ratio > 1.0 else 'down'} by {abs(c.ratio - 1.0):.0%}"
        f" ({c.low - 1.0:+.0%} to {c.high - 1.0:+.0%})"
        for c in moved
    ]
    hint = (
        "; K down looks the same as J and B up in the current alone"
        if any(c.name.startswith("K^2") for c in moved)
        else ""
    )
    return ("; ".join(words) + hint, f"no single known fault explains this, compared with {reference.source}")
