"""What healthy starts of one motor teach about its next start."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from motor_env.diagnosis.decision import alarm_limits, decide
from motor_env.diagnosis.healthy_motor import Reference, reference_of
from motor_env.diagnosis.hypotheses import Fitted, form_hypotheses, smallest_detectable
from motor_env.fitting.starts.choice import NUISANCES, identify_best
from motor_env.fitting.starts.commutation import ripple_quantities
from motor_env.fitting.starts.identified import Identified
from motor_env.fitting.starts.identify import identify
from motor_env.fitting.uncertainty import beyond
from motor_env.motor.data_sheet import Motor
from motor_env.motor.healthy import Healthy, Starts
from motor_env.motor.parameters import FloatArray
from motor_env.recordings.start import Start

START_SPREAD = 0.02
"""Standard deviation of a logarithm from start to start, as believed before any is seen."""
RECORD_SPREAD = np.array([0.01, 0.005, 0.01, 0.05])
"""Standard deviation of the logarithms of R, K, J and B from one record of a motor at work to the next, however long
each lasts: the error of the model is much the same in all windows of a record."""
PRIOR_WEIGHT = 4.0
_FEW_BESIDE = 4  # times as many are of the usual drive
_NOISE_SPREAD = 0.10
_DISAGREE = 0.5  # standard deviation of a logarithm between healthy starts
_SAME_MOTOR, _ODD = 0.1, 5.0  # standard deviation of a logarithm from start to start, and how many are odd


def fit_healthy(starts: Sequence[Start], *, constant: float | None = None) -> list[Identified]:
    """Fit healthy starts with one common model: the one that the evidence prefers in most of them.

    All are fitted twice, the second time from the median of the first fits, so that no start is left in an optimum
    of its own, and an ambiguous inductance is the same in all.

    Raises:
        UnusableError: the current of one flows against its voltage.
    """
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


def predictive_t(logs: FloatArray, prior: FloatArray) -> tuple[FloatArray, FloatArray, float]:
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


def predictive_sd(values: FloatArray, prior_sd: float) -> float:
    """Scale of the next value's Student t, from values that scatter."""
    return math.sqrt(predictive_t(values[:, None], np.eye(1) * prior_sd**2)[1][0, 0])


def next_piece(
    fits: Sequence[Fitted], prior_sd: float, lent: FloatArray | None = None
) -> tuple[FloatArray, FloatArray, float]:
    """Mean, covariance and degrees of freedom of the next healthy piece's logarithms.

    The fit's own error is white between pieces; it is the least that the next one will differ by.

    Args:
        fits: healthy pieces with the same quantities.
        prior_sd: of each logarithm from piece to piece, as believed before any is seen.
        lent: covariance of other pieces that is believed where it is larger.
    """
    logs = np.array([fit.log_values for fit in fits])
    error = np.mean([fit.white_covariance for fit in fits], axis=0)
    prior = np.eye(logs.shape[1]) * prior_sd**2 + error
    return predictive_t(logs, prior if lent is None else prior + beyond(prior, lent))


def next_window(
    fits: Sequence[Fitted], *, steady: bool, usual: Sequence[Fitted] = ()
) -> tuple[FloatArray, FloatArray, float]:
    """Mean, covariance and degrees of freedom of the logarithms of R, K, J and B of a healthy window of another record.

    Args:
        fits: healthy windows.
        steady: nothing but a fault moves the motor, from record to record either.
        usual: healthy windows of the usual drive, if these are few of another one. They scatter no less, as far as is
            known: loads come and go.
    """
    lent = next_window(usual, steady=True)[1] if usual else None
    centre, covariance, freedom = next_piece(fits, 0.0, lent)
    return centre, covariance if steady else covariance + np.diag(np.square(RECORD_SPREAD)), freedom


def usual_condition_windows(few: Sequence[int], drives: Sequence[Sequence[int]]) -> Sequence[int]:
    """Windows of the usual drive, if those of another one are few beside them; none otherwise."""
    usual = max(drives, key=len)
    return usual if len(usual) >= _FEW_BESIDE * len(few) else ()


def learn_without(healthy: Healthy, fits: Sequence[Fitted], number: int) -> Healthy:
    """What all healthy pieces but one teach, fitted with the same model; of windows those that are driven alike."""
    drives = () if healthy.windows is None else healthy.windows.drives
    alike = next((drive.pieces for drive in drives if number in drive.pieces), range(len(fits)))
    others = [fits[n] for n in alike if n != number]
    usual = [fits[n] for n in usual_condition_windows(alike, [drive.pieces for drive in drives] or [alike])]
    if healthy.windows is None:
        centre, covariance, freedom = next_piece(others, START_SPREAD)
    else:
        centre, covariance, freedom = next_window(others, steady=not healthy.temperature_k, usual=usual)
    return replace(
        healthy,
        pieces=len(others),
        degrees_of_freedom=freedom,
        values=np.exp(centre),
        log_covariance=covariance,
    )


def learn_starts(fits: Sequence[Identified]) -> Healthy:
    """What healthy starts of one motor teach about its next start, with a prior of 2 % (1 sd) on every quantity.

    Args:
        fits: healthy starts, fitted with the same model, one or more.
    """
    centre, covariance, freedom = next_piece(fits, START_SPREAD)
    noise = np.log([max(fit.noise_a, 1e-12) for fit in fits])
    ripple = np.log([pair for pair in map(ripple_quantities, fits) if pair is not None])
    has_ripple = len(ripple) == len(fits)
    signs = {fit.start.alignment.sign for fit in fits}
    starts = Starts(
        log_noise=float(noise.mean()),
        log_noise_sd=predictive_sd(noise, _NOISE_SPREAD),
        model=fits[0].model,
        model_low=tuple(min(fit.fitted_extension[name][0] for fit in fits) for name in fits[0].model),
        model_high=tuple(max(fit.fitted_extension[name][0] for fit in fits) for name in fits[0].model),
        sampling_rate_hz=1.0 / float(np.mean([fit.start.dt_s for fit in fits])),
        duration_s=min(float(fit.start.time_s[-1]) - fit.onset_s for fit in fits),
        quiet_s=max(min(fit.onset_s - float(fit.start.time_s[0]) for fit in fits), 0.0),
        ripple_hz=float(np.exp(ripple[:, 0].mean())) if has_ripple else None,
        ripple_constant_v_s=float(np.exp(ripple[:, 1].mean())) if has_ripple else None,
        ripple_log_sd=max(predictive_sd(row, START_SPREAD) for row in ripple.T) if has_ripple else None,
        direction=0 if len(signs) > 1 else 1 if signs == {1.0} else -1,
    )
    return Healthy(len(fits), freedom, fits[0].quantity_names, np.exp(centre), covariance, starts=starts)


def explain_disagreement(fits: Sequence[Identified]) -> str | None:
    """Which quantity differs so much between healthy starts that they teach nothing; None where they agree."""
    logs = np.array([fit.log_values for fit in fits])
    for name, column in zip(fits[0].quantity_names, logs.T, strict=True):
        if name[0] in "RKJ" and float(np.std(column)) > _DISAGREE:
            low, high = np.exp(column.min()), np.exp(column.max())
            return f"their {name} lies between {low:.3g} and {high:.3g}: are they starts of one motor, from rest?"
    return None


def explain_outlier(fits: Sequence[Identified], number: int) -> str | None:
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


def detectable_changes(
    motor: Motor, fits: Sequence[Fitted], temperature_c: float | None, rate: float
) -> tuple[dict[str, float], dict[str, int]]:
    """Smallest changes that the next piece shows; and how many pieces, judged by the others, leave what undecided.

    Of a motor that was driven in several ways they are the smallest that show in each of them.
    """
    healthy = motor.healthy
    assert healthy is not None  # noqa: S101  # it was just learned
    drives = () if healthy.windows is None else healthy.windows.drives
    taught = [(fits[drive.pieces[0]], healthy.under(drive)) for drive in drives] or [(fits[0], healthy)]
    smallest: dict[str, float] = {}
    for fit, some in taught:
        reference = _reference(replace(motor, healthy=some), fit, temperature_c)
        hypotheses = form_hypotheses(fit, reference, rate)
        limits = alarm_limits(hypotheses, rate, tests_noise=reference.log_noise is not None)
        for kind, severity in smallest_detectable(hypotheses, reference.own_friction, limits.z).items():
            smallest[kind] = max(severity, smallest.get(kind, 0.0))
    count = len(fits) if len(fits) > 1 else 0
    others = [replace(motor, healthy=learn_without(healthy, fits, n)) for n in range(count)]
    judged = [decide(fits[n], _reference(others[n], fits[n], temperature_c), rate) for n in range(count)]
    changes = [change for one in judged for change in one.changes]
    undecided = Counter(change.name for change in changes if change.verdict == "undecided")
    return smallest, dict(undecided)


def _reference(motor: Motor, fit: Fitted, temperature_c: float | None) -> Reference:
    found = reference_of(
        motor, fit.quantity_names, are_starts=isinstance(fit, Identified), temperature_c=temperature_c
    )
    assert found is not None  # noqa: S101  # it was learned from these quantities
    return found
