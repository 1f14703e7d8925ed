"""A verdict on a recording: fitted quantities against a reference, with every uncertainty in the balance.

The fit gives the logarithms y of what the recording can tell, with a covariance that knows of the model's error; the
reference gives where a healthy motor lies, with the covariance of its tolerances, the temperature and the supply, or
of the spread between healthy starts. Their difference d = y - y_ref has the sum C of both covariances. Then

- one-sided tests along the direction of each fault, z = g'C^-1 d / sqrt(g'C^-1 g), and an omnibus test d'C^-1 d, share
  the rate of false alarms among them (Bonferroni); with few healthy starts the quantiles are Student's and Fisher's;
- after an alarm the fault that explains most is named, unless what it leaves unexplained is itself significant (other);
- the confidence is the posterior probability of the verdict, with a half-normal prior on the severity.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np
from scipy import stats

from motor_env import quantities
from motor_env.alignment import UnusableError
from motor_env.commutation import ripple_quantities
from motor_env.consistency import Consistency, check_consistency
from motor_env.faults import FaultKind
from motor_env.identification import EXTENSIONS, NUISANCES, Identified, identify, identify_best
from motor_env.kalman import FilterResult, KalmanFilter, run_filter
from motor_env.motion import rise_of_supply
from motor_env.motor_file import MotorFile, StartReference
from motor_env.parameters import FloatArray, SensorParameters
from motor_env.recordings import Recording
from motor_env.starts import Circuit, Start, prepare

DEFAULT_FALSE_ALARM_RATE = 0.01
START_SPREAD_PRIOR = 0.02
START_PRIOR_WEIGHT = 4.0
NOISE_SPREAD_PRIOR = 0.10
SHEET_NOISE_SD = 0.10
_SEVERITY_PRIOR = 0.30
_OTHER_PRIOR = 0.30
_HEALTHY_PRIOR = 0.8
_CONSISTENT_NIS = 1.2
_POWER_QUANTILE = 1.645
_FILTER_TUNING = 3
_POOR_FIT = 0.75
_DOUBLED = 1.0
_LARGEST_LOG = 30.0
_FEWEST_FOR_WHITENESS = 40
_ANOTHER_ORDER = math.log(1.5)
_NORMAL_DOF = 1e6


class Verdict(StrEnum):
    """What is said of a recording."""

    HEALTHY = "healthy"
    BEARING = "bearing"
    WINDING = "winding"
    NOISE = "noise"
    OTHER = "other"
    NO_REFERENCE = "no_reference"
    UNUSABLE = "unusable"

    @property
    def is_fault(self) -> bool:
        """Whether it calls for action."""
        return self in _FAULTS


_FAULTS = frozenset({Verdict.BEARING, Verdict.WINDING, Verdict.NOISE, Verdict.OTHER})
_VERDICT_OF = {
    FaultKind.BEARING: Verdict.BEARING,
    FaultKind.WINDING_CONTACT: Verdict.WINDING,
    FaultKind.WINDING_SHORT: Verdict.WINDING,
}


@dataclass(frozen=True, slots=True)
class Reference:
    """Where a healthy motor lies, for the quantities that one kind of recording can tell.

    Attributes:
        source: in words, for the user.
        names: the quantities.
        log_values: logarithms of the quantities of a healthy motor, shape (n,).
        log_covariance: covariance of the next healthy start about them, the fit's own error left out, shape (n, n).
        degrees_of_freedom: of that covariance.
        log_noise: logarithm of the noise of the current, or None where unknown.
        log_noise_sd: its standard deviation from start to start.
        model: extensions to fit with, or None to choose by evidence.
        includes_fit_error: the covariance was estimated from fits, and holds their errors already.
    """

    source: str
    names: tuple[str, ...]
    log_values: FloatArray
    log_covariance: FloatArray
    degrees_of_freedom: float = _NORMAL_DOF
    log_noise: float | None = None
    log_noise_sd: float = SHEET_NOISE_SD
    model: tuple[str, ...] | None = None
    includes_fit_error: bool = False


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
class FilterCheck:
    """What the Kalman filter makes of the recording, with the fitted motor as its belief.

    Attributes:
        result: of `run_filter`, over the samples from the start on.
        sensor_noise_a: standard deviation of the sensor's noise in its belief.
        model_error_a: standard deviation of the model's error, a slow disturbance of the current.
        mean_nis: mean normalised innovation squared; 1 a channel is consistent.
        sensor_only_nis: the same for a filter that knows of the sensor's noise alone.
        consistency: mean, size and whiteness of the innovations of that filter; None where there are too few.
    """

    result: FilterResult
    sensor_noise_a: float
    model_error_a: float
    mean_nis: float
    sensor_only_nis: float
    consistency: Consistency | None = None


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


def reference_from_motor(motor: MotorFile, *, has_voltage: bool, has_speed: bool) -> Reference | None:
    """Reference from a data sheet or a commissioned motor; None where it does not speak of the same quantities."""
    names = quantities.names(has_voltage=has_voltage, has_speed=has_speed)
    if motor.reference is not None:
        return _from_starts(motor.reference, names, motor.name)
    if not has_voltage:
        return None
    exponents = quantities.matrix(has_voltage=has_voltage, has_speed=has_speed)
    voltage = motor.nominal_voltage_v or 1.0
    # V is held at what the recording says; its tolerance scales the current, so it acts like R, L, ... per volt.
    covariance = quantities.tolerance_covariance(motor.tolerance)
    supply = motor.tolerance.supply
    per_volt = quantities.matrix(has_voltage=False, has_speed=has_speed)[:, -1]
    return Reference(
        source=f"data sheet {motor.name}"
        if motor.kind == "data_sheet"
        else f"{motor.kind} motor {motor.name}",
        names=names,
        log_values=exponents @ quantities.logarithms(motor.parameters, voltage),
        log_covariance=exponents @ covariance @ exponents.T + supply**2 * np.outer(per_volt, per_volt),
        log_noise=None if motor.current_noise_a is None else math.log(motor.current_noise_a),
    )


def _from_starts(starts: StartReference, names: tuple[str, ...], motor: str) -> Reference | None:
    if starts.quantities != names:
        return None
    return Reference(
        source=f"{starts.starts} healthy starts of {motor}",
        names=names,
        log_values=np.log(starts.values),
        log_covariance=starts.log_covariance,
        degrees_of_freedom=starts.degrees_of_freedom,
        log_noise=starts.log_noise,
        log_noise_sd=starts.log_noise_sd,
        model=starts.model,
        includes_fit_error=True,
    )


def learn_reference(fits: list[Identified]) -> StartReference:
    """What healthy starts of one motor teach about its next start.

    The spread between few starts is hardly known. A prior stands in: an inverse-Wishart whose mean is 2 % (1 sd) on
    every quantity, worth 4 starts (Gelman et al. 2013, ch. 3.6). The next start then follows a multivariate Student t
    with n - 1 + 4 degrees of freedom and the scale (1 + 1/n) S, never the sample's own sigma.

    Args:
        fits: healthy starts, fitted with the same model, one or more.
    """
    logs = np.array([fit.log_values for fit in fits])
    n, p = logs.shape
    centre = logs.mean(axis=0)
    scatter = (logs - centre).T @ (logs - centre)
    # The fit's own error is white between starts; it is the least that the next start will differ by.
    fit_error = np.mean([_white_error(fit) for fit in fits], axis=0)
    prior = np.eye(p) * START_SPREAD_PRIOR**2 + fit_error
    freedom = n - 1 + START_PRIOR_WEIGHT
    covariance = (scatter + START_PRIOR_WEIGHT * prior) / freedom * (1.0 + 1.0 / n)
    noise = np.log([max(fit.noise_a, 1e-12) for fit in fits])
    ripples = [ripple_quantities(fit) for fit in fits]
    ripple = np.log([pair for pair in ripples if pair is not None])
    has_ripple = len(ripple) == n
    return StartReference(
        starts=n,
        degrees_of_freedom=freedom,
        quantities=fits[0].quantity_names,
        values=np.exp(centre),
        log_covariance=covariance,
        log_noise=float(noise.mean()),
        log_noise_sd=_next_sd(noise, NOISE_SPREAD_PRIOR),
        model=fits[0].model,
        model_low=tuple(min(fit.fitted_extension[name][0] for fit in fits) for name in fits[0].model),
        model_high=tuple(max(fit.fitted_extension[name][0] for fit in fits) for name in fits[0].model),
        sampling_rate_hz=1.0 / float(np.mean([fit.start.dt_s for fit in fits])),
        duration_s=min(float(fit.start.time_s[-1]) - fit.onset_s for fit in fits),
        quiet_s=max(min(fit.onset_s - float(fit.start.time_s[0]) for fit in fits), 0.0),
        ripple_hz=float(np.exp(ripple[:, 0].mean())) if has_ripple else None,
        ripple_constant_v_s=float(np.exp(ripple[:, 1].mean())) if has_ripple else None,
        ripple_log_sd=max(_next_sd(row, START_SPREAD_PRIOR) for row in ripple.T) if has_ripple else None,
    )


def _next_sd(values: FloatArray, prior_sd: float) -> float:
    """Scale of the next value's Student t, from values that scatter and a prior worth 4 of them."""
    n = len(values)
    scatter = float(np.sum((values - values.mean()) ** 2))
    freedom = n - 1 + START_PRIOR_WEIGHT
    return math.sqrt((scatter + START_PRIOR_WEIGHT * prior_sd**2) / freedom * (1.0 + 1.0 / n))


def _white_error(fit: Identified) -> FloatArray:
    """Covariance of the fit from its white noise alone: what differs from one start to the next of one motor."""
    left = float(np.var(fit.residual_a[fit.start.alignment.onset_index :]))
    return fit.log_covariance * min(fit.noise_a**2 / max(left, 1e-300), 1.0)


def fit_healthy(
    recordings: list[Recording],
    *,
    voltage_v: float | None = None,
    constant: float | None = None,
    circuit: Circuit | None = None,
) -> list[Identified]:
    """Fit healthy starts with one common model: the one that the evidence prefers in most of them.

    All are fitted twice, the second time from the median of the first fits, so that no start is left in an optimum
    of its own, and an ambiguous inductance is the same in all.

    Raises:
        UnusableError: a recording cannot be judged.
    """
    starts = [prepare(recording, voltage_v, circuit) for recording in recordings]
    chosen = [identify_best(start, NUISANCES, constant=constant).model for start in starts[:3]]
    model = tuple(
        name for name in NUISANCES if sum(name in candidate for candidate in chosen) > 0.5 * len(chosen)
    )
    first = [identify(start, model, constant=constant) for start in starts]
    if len({fit.quantity_names for fit in first}) > 1:
        return first
    middle = np.exp(np.median([fit.log_values for fit in first], axis=0))
    typical = dict(zip(first[0].quantity_names, middle.tolist(), strict=True))
    return [identify(start, model, constant=constant, typical=typical) for start in starts]


def diagnose(
    recording: Recording,
    motor: MotorFile | None = None,
    learned: StartReference | None = None,
    *,
    voltage_v: float | None = None,
    false_alarm_rate: float = DEFAULT_FALSE_ALARM_RATE,
    circuit: Circuit | None = None,
) -> Diagnosis:
    """Fit, filter, compare, decide.

    Args:
        recording: as read.
        motor: data sheet, identified or commissioned motor.
        learned: what healthy recordings taught; it comes before the motor.
        voltage_v: level of the supply where the recording has none; the motor's nominal voltage otherwise.
        false_alarm_rate: per healthy recording.
        circuit: what is known of the measuring circuit.
    """
    if voltage_v is None and motor is not None and motor.reference is None:
        voltage_v = motor.nominal_voltage_v
    constant = None if motor is None else float(np.mean(motor.parameters.torque_constant_n_m_per_a))
    try:
        start = prepare(recording, voltage_v, circuit)
        reference = _reference(start, motor, learned)
        typical = None
        if reference is not None:
            typical = dict(zip(reference.names, np.exp(reference.log_values).tolist(), strict=True))
        if _clipped(start):
            fit = identify(start, constant=constant)
        elif reference is None:
            fit = identify_best(start, EXTENSIONS, constant=constant)
        elif reference.model is None:
            fit = identify_best(start, NUISANCES, constant=constant, typical=typical)
        else:
            fit = identify(start, reference.model, constant=constant, typical=typical)
    except UnusableError as error:
        return Diagnosis(recording, Verdict.UNUSABLE, (str(error),))
    check = filter_check(fit)
    trouble = _trouble(fit)
    if trouble:
        return Diagnosis(recording, Verdict.UNUSABLE, (trouble,), identified=fit, filter_check=check)
    if reference is None:
        given = motor is not None or learned is not None
        reason = (
            f"this recording tells {', '.join(fit.quantity_names)}, and the reference speaks of other quantities"
            if given
            else "there is nothing to compare with: give a motor file or healthy recordings"
        )
        return Diagnosis(recording, Verdict.NO_REFERENCE, (reason,), identified=fit, filter_check=check)
    found = _decide(recording, fit, reference, check, false_alarm_rate)
    starts = learned or (None if motor is None else motor.reference)
    return found if starts is None else _with_ripple(found, fit, starts, false_alarm_rate)


def _with_ripple(found: Diagnosis, fit: Identified, starts: StartReference, rate: float) -> Diagnosis:
    """What the commutation ripple says of speed and K, beside the verdict: it takes no part in it."""
    ripple = ripple_quantities(fit)
    if ripple is None or not (starts.ripple_hz and starts.ripple_constant_v_s and starts.ripple_log_sd):
        return found
    logs = np.log(ripple) - np.log([starts.ripple_hz, starts.ripple_constant_v_s])
    if abs(float(logs[0])) > _ANOTHER_ORDER:
        return found  # another of the ripple's orders is the strongest now: nothing to compare
    freedom = starts.degrees_of_freedom
    limit = float(stats.t.isf(rate / (len(quantities.FAULT_DIRECTIONS) + 2), freedom))
    names = ("speed", "K" if fit.start.voltage_known else "K/V")
    changes = _changes(names, logs, np.eye(2) * starts.ripple_log_sd**2, freedom, limit)
    moved = [c for c in changes if c.significant]
    reasons = found.reasons
    if moved and found.verdict.is_fault:
        words = " and ".join(
            f"{c.name} {'up' if c.ratio > 1.0 else 'down'} by {abs(c.ratio - 1.0):.0%}" for c in moved
        )
        reasons = (*reasons, f"the commutation ripple of {ripple[0]:.4g} Hz shows {words}")
    return replace(found, changes=(*found.changes, *changes), reasons=reasons)


def _reference(start: Start, motor: MotorFile | None, learned: StartReference | None) -> Reference | None:
    """What there is to compare a start with."""
    which = {"has_voltage": start.voltage_known, "has_speed": start.speed_rad_s is not None}
    if learned is not None:
        return _from_starts(learned, quantities.names(**which), "this motor")
    return None if motor is None else reference_from_motor(motor, **which)


def _clipped(start: Start) -> str | None:
    """The sentence on saturation, where there is some."""
    return next((defect for defect in start.alignment.defects if defect.startswith("saturation")), None)


def _trouble(fit: Identified) -> str | None:
    """Why a fit cannot carry a verdict."""
    clipped = _clipped(fit.start)
    if clipped:
        return f"the recording is clipped, {clipped}"
    if fit.r2_current < _POOR_FIT:
        return (
            f"no motor model explains the current (R2 {fit.r2_current:.2f}; at least {_POOR_FIT} is needed)"
        )
    if fit.r2_speed is not None and fit.r2_speed < _POOR_FIT:
        return f"no motor model explains the speed (R2 {fit.r2_speed:.2f}; at least {_POOR_FIT} is needed)"
    worst = float(np.sqrt(np.diag(fit.log_covariance)).min())
    if worst > 1.0:
        return "the recording is too short or too noisy: no quantity is known to a factor of e"
    return None


def filter_check(fit: Identified) -> FilterCheck:
    """Run the Kalman filter with the fitted motor as its belief.

    The residual is split in white noise and a slow model error; the error enters as process noise of the current, so
    that its stationary variance is what was found (first-order Gauss-Markov; Gelb 1974, ch. 3.8).
    """
    start = fit.start
    begin = int(np.searchsorted(start.time_s, fit.onset_s, side="right"))  # the first sample that is driven
    if start.voltage_v is not None:
        begin = 0
    shown = fit.expected[:, 0] - start.ripple_a - fit.offset_a
    visible = start.counted
    if fit.extension.dead_zone_a > 0.0:  # the filter begins where the sensor does, and skips what it hides
        visible = visible & (shown > 0.5 * fit.extension.dead_zone_a)
        begin += int(np.argmax(visible[begin:]))
    left = fit.residual_a[begin + 1 :]
    noise = max(fit.noise_a, 1e-9 * float(np.ptp(start.current_a)))
    slow = math.sqrt(max(float(np.var(left)) - noise**2, 0.0))
    decay_s = max(float(np.mean(fit.parameters.mechanical_time_constant_s)), start.dt_s)
    voltage = np.array([start.level_v]) if start.voltage_v is None else start.voltage_v[begin:]
    if start.voltage_v is None:
        voltage = voltage * rise_of_supply(fit.extension, start.time_s[begin:], fit.onset_s)
    else:
        voltage = 0.5 * (voltage[1:] + voltage[:-1])
    sensor = SensorParameters(current_noise_a=noise)
    seen = np.where(visible, start.current_a - start.ripple_a - fit.offset_a, np.nan)
    measured = seen[None, begin + 1 :]
    state = np.array([shown[begin], fit.expected[begin, 1]])
    motor = fit.parameters.scaled(
        resistance_ohm=1.0 + start.circuit.shunt_ohm / fit.parameters.resistance_ohm
    )

    def run(process: float) -> FilterResult:
        belief = KalmanFilter.from_parameters(
            motor,
            sensor,
            start.dt_s,
            process_noise_std=(process, process * abs(state[1]) / max(abs(state[0]), 1e-9)),
            initial_state=state,
            initial_std=(max(slow, noise), 0.0),
        )
        return run_filter(belief, measured, voltage)

    alone = run(0.0)
    process = slow * math.sqrt(2.0 * start.dt_s / decay_s)
    result = run(process)
    for _ in range(_FILTER_TUNING):
        if _mean_nis(result) < _CONSISTENT_NIS:
            break
        process *= math.sqrt(_mean_nis(result))
        result = run(process)
    return FilterCheck(
        result=result,
        sensor_noise_a=noise,
        model_error_a=slow,
        mean_nis=_mean_nis(result),
        sensor_only_nis=_mean_nis(alone),
        consistency=check_consistency(alone.whitened) if measured.size > _FEWEST_FOR_WHITENESS else None,
    )


def _mean_nis(result: FilterResult) -> float:
    """Mean normalised innovation squared of the measured samples of the current."""
    return float(np.nanmean(np.square(result.whitened)))


@dataclass(frozen=True, slots=True)
class _Candidate:
    """A fault as an explanation of the difference."""

    kind: FaultKind
    z: float
    step: float
    step_sd: float
    left_over: float


def _candidates(difference: FloatArray, inverse: FloatArray, exponents: FloatArray) -> list[_Candidate]:
    total = float(difference @ inverse @ difference)
    found = []
    for kind in quantities.FAULT_DIRECTIONS:
        direction = exponents @ quantities.fault_direction(kind)
        information = float(direction @ inverse @ direction)
        step = float(direction @ inverse @ difference) / information
        z = step * math.sqrt(information)
        found.append(_Candidate(kind, z, step, 1.0 / math.sqrt(information), total - z * z))
    return found


def smallest_changes(covariance: FloatArray, exponents: FloatArray, limit: float) -> dict[str, float]:
    """Severity of each fault that is found in 95 of 100 cases, for a limit in standard deviations."""
    inverse = np.asarray(np.linalg.inv(covariance), dtype=np.float64)
    none = np.zeros(len(covariance))
    return {
        str(c.kind): _severity(c.kind, (limit + _POWER_QUANTILE) * c.step_sd)
        for c in _candidates(none, inverse, exponents)
    }


def _severity(kind: FaultKind, step: float) -> float:
    """Severity of a step of the logarithm along the fault's direction."""
    return 1.0 - _factor(-step) if kind is FaultKind.WINDING_SHORT else _factor(step) - 1.0


def _factor(log: float) -> float:
    """The factor of a logarithm; beyond any motor it is cut, so that what is not told at all stays a number."""
    return math.exp(min(max(log, -_LARGEST_LOG), _LARGEST_LOG))


def _decide(
    recording: Recording, fit: Identified, reference: Reference, check: FilterCheck, rate: float
) -> Diagnosis:
    difference = fit.log_values - reference.log_values
    covariance = reference.log_covariance + (0.0 if reference.includes_fit_error else fit.log_covariance)
    inverse = np.asarray(np.linalg.inv(covariance), dtype=np.float64)
    which = {"has_voltage": fit.start.voltage_known, "has_speed": fit.start.speed_rad_s is not None}
    exponents = quantities.matrix(**which)
    freedom, n = reference.degrees_of_freedom, len(difference)
    share = rate / (len(quantities.FAULT_DIRECTIONS) + 2)
    limit = float(stats.t.isf(share, freedom))
    candidates = _candidates(difference, inverse, exponents)
    omnibus = _fisher(float(difference @ inverse @ difference), n, freedom)
    noise_z = 0.0
    if reference.log_noise is not None and not _noise_is_hidden(fit, reference):
        noise_z = (math.log(max(fit.noise_a, 1e-12)) - reference.log_noise) / reference.log_noise_sd
    changes = _changes(fit.quantity_names, difference, covariance, freedom, limit)
    probability = _posterior(difference, covariance, exponents, freedom)
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
    explaining = [c for c in significant if _fisher(c.left_over, n - 1, freedom) > rate]
    if explaining:
        best = max(explaining, key=lambda c: c.z)
        return _called(base, best, float(stats.t.isf(0.025, freedom)), probability)
    if significant or omnibus < share:
        return replace(
            base,
            verdict=Verdict.OTHER,
            reasons=_other_reasons(changes, reference),
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
    verdict, half = _VERDICT_OF[best.kind], quantile * best.step_sd
    return replace(
        base,
        verdict=verdict,
        reasons=_fault_reasons(best.kind, base.reference),
        severity=_severity(best.kind, best.step),
        severity_low=_severity(best.kind, best.step - half),
        severity_high=_severity(best.kind, best.step + half),
        confidence=sum(probability[kind] for kind, word in _VERDICT_OF.items() if word is verdict),
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
    return coarse or hides or any(defect.startswith("PWM") for defect in fit.defects)


def _fisher(squared: float, n: int, freedom: float) -> float:
    """Probability of a squared Mahalanobis distance at least as large (Hotelling); 1 for no dimension."""
    if n == 0:
        return 1.0
    return float(stats.f.sf(max(squared, 0.0) / n, n, freedom))


def _changes(
    names: tuple[str, ...], difference: FloatArray, covariance: FloatArray, freedom: float, limit: float
) -> tuple[Change, ...]:
    half = float(stats.t.isf(0.025, freedom))
    sigma = np.sqrt(np.diag(covariance))
    return tuple(
        Change(name, _factor(d), _factor(d - half * s), _factor(d + half * s), bool(abs(d) > limit * s))
        for name, d, s in zip(names, difference, sigma, strict=True)
    )


def _whole(freedom: float) -> int:
    """Degrees of freedom rounded down: towards wider tails."""
    return max(int(min(freedom, _NORMAL_DOF)), 1)


def _posterior(
    difference: FloatArray, covariance: FloatArray, exponents: FloatArray, freedom: float
) -> dict[str, float]:
    """Probabilities of healthy, each fault and other; severities half-normal."""
    n = len(difference)
    zero = np.zeros(n)
    density = stats.multivariate_t(loc=zero, shape=covariance, df=_whole(freedom))
    steps = np.linspace(0.0, 4.0 * _SEVERITY_PRIOR, 241)
    weights = stats.halfnorm.pdf(steps, scale=_SEVERITY_PRIOR)
    weights /= weights.sum()
    logs: dict[str, float] = {"healthy": float(density.logpdf(difference))}
    for kind in quantities.FAULT_DIRECTIONS:
        direction = exponents @ quantities.fault_direction(kind)
        along = density.logpdf(difference - steps[:, None] * direction)
        logs[kind] = float(np.logaddexp.reduce(along + np.log(weights)))
    wide = covariance + _OTHER_PRIOR**2 * np.eye(n)
    logs["other"] = float(stats.multivariate_t(loc=zero, shape=wide, df=_whole(freedom)).logpdf(difference))
    others = math.log((1.0 - _HEALTHY_PRIOR) / (len(logs) - 1))
    logs = {
        name: value + (math.log(_HEALTHY_PRIOR) if name == "healthy" else others)
        for name, value in logs.items()
    }
    total = float(np.logaddexp.reduce(list(logs.values())))
    return {name: math.exp(value - total) for name, value in logs.items()}


def _fault_reasons(kind: FaultKind, reference: Reference | None) -> tuple[str, ...]:
    sentence = {
        FaultKind.BEARING: "friction is up and nothing else moved: look at the bearings, the lubricant and the load",
        FaultKind.WINDING_CONTACT: "resistance is up and nothing else moved: look at brushes, commutator and"
        " connections, and at the winding's temperature",
        FaultKind.WINDING_SHORT: "resistance, inductance and flux are down together: look for shorted turns",
    }[kind]
    return (sentence, "compared with " + ("nothing" if reference is None else reference.source))


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
