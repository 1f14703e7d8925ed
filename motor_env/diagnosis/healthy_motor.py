"""Distribution of a healthy motor's parameters: from its data sheet, or from healthy starts of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri, stdtrit

from motor_env.identification.commutation import ripple_quantities
from motor_env.identification.identify import Identified, identify
from motor_env.identification.model_choice import NUISANCES, identify_best
from motor_env.motor import identifiable as quantities
from motor_env.motor.data_sheet import MotorFile, StartReference
from motor_env.motor.parameters import FloatArray
from motor_env.recordings.recording import Recording
from motor_env.recordings.start import Circuit, prepare

START_SPREAD_PRIOR = 0.02
PRIOR_WEIGHT = 4.0
NOISE_SPREAD_PRIOR = 0.10
SHEET_NOISE_SD = 0.10
NORMAL_DOF = 1e6
MEASURED_TEMPERATURE_K = 4.0
"""How far a winding may be off a measured temperature, one standard deviation."""
_DISAGREE = 0.5  # standard deviation of a logarithm between healthy starts
_SAME_MOTOR, _ODD = 0.1, 5.0  # standard deviation of a logarithm from start to start, and how many are odd


@dataclass(frozen=True, slots=True)
class Reference:
    """Distribution of a healthy motor's quantities, as far as one kind of recording can tell them.

    Attributes:
        source: in words, for the user.
        names: the quantities.
        log_values: logarithms of the quantities of a healthy motor, shape (n,).
        log_covariance: covariance of the next healthy start about them, equally warm, the fit's own error left out,
            shape (n, n).
        degrees_of_freedom: of that covariance.
        log_noise: logarithm of the noise of the current, or None where unknown.
        log_noise_sd: its standard deviation from start to start.
        model: extensions to fit with, or None to choose by evidence.
        includes_fit_error: the covariance was estimated from fits, and holds their errors already.
        temperature_k: standard deviation of the temperature; 0 where the covariance holds it.
        warmer_k: how much warmer the motor is than the values say.
        own_friction: share of the drag that is the motor's own friction; None where a load was not told.
    """

    source: str
    names: tuple[str, ...]
    log_values: FloatArray
    log_covariance: FloatArray
    degrees_of_freedom: float = NORMAL_DOF
    log_noise: float | None = None
    log_noise_sd: float = SHEET_NOISE_SD
    model: tuple[str, ...] | None = None
    includes_fit_error: bool = False
    temperature_k: float = 0.0
    warmer_k: float = 0.0
    own_friction: float | None = None

    @property
    def values(self) -> dict[str, float]:
        """The quantities of a healthy motor by name."""
        return dict(zip(self.names, np.exp(self.log_values).tolist(), strict=True))


def warmer(covariance: FloatArray, warmth: FloatArray, rate: float, freedom: float) -> FloatArray:
    """A covariance of Student's t with the known normal spread of the temperature added.

    The quantile of a sum of t and normal lies below the root of the sum of their squared quantiles. So the normal part
    counts in the ratio of the two quantiles, at the share of one test.

    Args:
        covariance: at one temperature, shape (n, n).
        warmth: how the quantities move for one standard deviation of the temperature, shape (n,).
        rate: of one test.
        freedom: degrees of freedom of the covariance.
    """
    ratio = float(ndtri(rate) / stdtrit(freedom, rate))
    return np.asarray(covariance + np.outer(ratio * warmth, ratio * warmth), dtype=np.float64)


def beyond(healthy: FloatArray, error: FloatArray) -> FloatArray:
    """What the own error of a fit is beyond the spread of the healthy ones, which holds theirs, shape (n, n)."""
    root = np.linalg.cholesky(healthy)
    inverse = np.linalg.inv(root)
    sizes, axes = np.linalg.eigh(inverse @ error @ inverse.T)
    more = root @ axes * np.sqrt(np.maximum(sizes - 1.0, 0.0))
    return np.asarray(more @ more.T, dtype=np.float64)


def reference_from_motor(
    motor: MotorFile, *, has_voltage: bool, has_speed: bool, temperature_c: float | None = None
) -> Reference | None:
    """Reference from a data sheet or a commissioned motor; None where it does not speak of the same quantities."""
    names = quantities.names(has_voltage=has_voltage, has_speed=has_speed)
    if motor.reference is not None:
        return reference_from_starts(motor.reference, names, motor.name, temperature_c)
    if not has_voltage:
        return None
    exponents = quantities.matrix(names)
    voltage = motor.nominal_voltage_v or 1.0
    # V is held at what the recording says; its tolerance scales the current, so it acts like R, L, ... per volt.
    covariance = quantities.tolerance_covariance(motor.tolerance)
    supply = motor.tolerance.supply
    per_volt = quantities.matrix(quantities.names(has_voltage=False, has_speed=has_speed))[:, -1]
    return Reference(
        source=f"data sheet {motor.name}"
        if motor.kind == "data_sheet"
        else f"{motor.kind} motor {motor.name}",
        names=names,
        log_values=exponents @ quantities.logarithms(motor.parameters, voltage),
        log_covariance=exponents @ covariance @ exponents.T + supply**2 * np.outer(per_volt, per_volt),
        log_noise=None if motor.current_noise_a is None else math.log(motor.current_noise_a),
        own_friction=1.0,
    )


def reference_from_starts(
    starts: StartReference, names: tuple[str, ...], motor: str, temperature_c: float | None = None
) -> Reference | None:
    """Reference from healthy starts of a motor; None where these quantities do not follow from them.

    Where both temperatures are known the healthy motor is taken at this one, with what is left unknown of it.
    """
    # Each wanted quantity as powers of the known ones: K^2/J of K and J, where the healthy starts had a speed.
    known, wanted = quantities.matrix(starts.quantities), quantities.matrix(names)
    powers = wanted @ np.linalg.pinv(known)
    if not np.allclose(powers @ known, wanted):
        return None
    spread_k, warmer_k = starts.temperature_k, 0.0
    if temperature_c is not None and starts.temperature_c is not None:
        spread_k, warmer_k = min(spread_k, MEASURED_TEMPERATURE_K), temperature_c - starts.temperature_c
    return Reference(
        source=f"{starts.starts} healthy starts of {motor}",
        names=names,
        log_values=powers @ np.log(starts.values),
        log_covariance=powers @ starts.log_covariance @ powers.T,
        degrees_of_freedom=starts.degrees_of_freedom,
        log_noise=starts.log_noise,
        log_noise_sd=starts.log_noise_sd,
        model=starts.model,
        includes_fit_error=True,
        temperature_k=spread_k,
        warmer_k=warmer_k,
        own_friction=starts.own_friction,
    )


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


def learn_reference(fits: list[Identified]) -> StartReference:
    """What healthy starts of one motor teach about its next start, with a prior of 2 % (1 sd) on every quantity.

    Args:
        fits: healthy starts, fitted with the same model, one or more.
    """
    logs = np.array([fit.log_values for fit in fits])
    n, p = logs.shape
    # The fit's own error is white between starts; it is the least that the next start will differ by.
    fit_error = np.mean([white_error(fit) for fit in fits], axis=0)
    centre, covariance, freedom = the_next(logs, np.eye(p) * START_SPREAD_PRIOR**2 + fit_error)
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


def the_next(logs: FloatArray, prior: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Mean, covariance and degrees of freedom of the next healthy one, of several.

    The spread between few is hardly known. A prior stands in: an inverse-Wishart, worth 4 of them (Gelman et al. 2013,
    ch. 3.6). The next one then follows a multivariate Student t with n - 1 + 4 degrees of freedom and the scale
    (1 + 1/n) S, never the sample's own sigma.

    Args:
        logs: of those seen, shape (n, p).
        prior: covariance that is believed beforehand, shape (p, p).
    """
    n, centre = len(logs), logs.mean(axis=0)
    scatter, freedom = (logs - centre).T @ (logs - centre), n - 1 + PRIOR_WEIGHT
    return centre, (scatter + PRIOR_WEIGHT * prior) / freedom * (1.0 + 1.0 / n), freedom


def _next_sd(values: FloatArray, prior_sd: float) -> float:
    """Scale of the next value's Student t, from values that scatter."""
    return math.sqrt(the_next(values[:, None], np.eye(1) * prior_sd**2)[1][0, 0])


def white_error(fit: Identified) -> FloatArray:
    """Covariance of the fit from its white noise alone: what differs from one start to the next of one motor."""
    left = float(np.var(fit.residual_a[fit.start.alignment.onset_index :]))
    return fit.log_covariance * min(fit.noise_a**2 / max(left, 1e-300), 1.0)


def disagreement(fits: Sequence[Identified]) -> str | None:
    """Which quantity differs so much between healthy starts that they teach nothing; None where they agree."""
    logs = np.array([fit.log_values for fit in fits])
    for name, column in zip(fits[0].quantity_names, logs.T, strict=True):
        if name[0] in "RKJ" and float(np.std(column)) > _DISAGREE:
            low, high = np.exp(column.min()), np.exp(column.max())
            return f"their {name} lies between {low:.3g} and {high:.3g}: are they starts of one motor, from rest?"
    return None


def odd_one_out(fits: Sequence[Identified], number: int) -> str | None:
    """Why one of the healthy starts is of another motor than the others; None where it agrees with them."""
    others = np.array([fit.log_values for n, fit in enumerate(fits) if n != number])
    if len(others) < 2:
        return None
    middle = np.median(others, axis=0)
    scatter = np.median(np.abs(others - middle), axis=0)
    off = fits[number].log_values - middle
    sd = np.sqrt(np.diag(fits[number].log_covariance) + scatter**2 + _SAME_MOTOR**2)
    worst = int(np.argmax(np.abs(off) / sd))
    if abs(off[worst]) <= _ODD * sd[worst]:
        return None
    name = fits[number].quantity_names[worst]
    return f"its {name} is {math.exp(off[worst]):.3g} times that of the others"
