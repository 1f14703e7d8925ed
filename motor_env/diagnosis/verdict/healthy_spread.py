"""Predict the next healthy start or window of a motor from healthy ones."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from motor_env.diagnosis.estimation.starts.start_fit import StartFit, ripple_quantities
from motor_env.diagnosis.estimation.starts.start_identification import NUISANCES, identify, identify_best
from motor_env.diagnosis.estimation.uncertainty import excess_covariance
from motor_env.diagnosis.readers.start import Start
from motor_env.diagnosis.verdict.decision import alarm_limits, decide
from motor_env.diagnosis.verdict.healthy_motor import Reference, reference_of
from motor_env.diagnosis.verdict.hypotheses import Fitted, form_hypotheses, smallest_detectable
from motor_env.motor.data_sheet import Motor
from motor_env.motor.healthy import Healthy, Starts
from motor_env.motor.parameters import FloatArray

START_SPREAD = 0.02
"""Prior standard deviation of a logarithm from start to start."""
RECORD_SPREAD = np.array([0.01, 0.005, 0.01, 0.05])
"""Standard deviation of the logarithms of R, K, J and B between records of a motor at work, of any length: model error
is constant within a record."""
PRIOR_WEIGHT = 4.0
_FEW_BESIDE = 4  # times as many windows of the usual condition
_NOISE_SPREAD = 0.10
_DISAGREE = 0.5  # standard deviation of a logarithm between healthy starts
_SAME_MOTOR, _ODD = 0.1, 5.0  # standard deviation of a logarithm between starts; multiple of an outlier


def fit_healthy(starts: Sequence[Start], *, constant: float | None = None) -> list[StartFit]:
    """Fit healthy starts with one model, which the evidence prefers in most of them.

    A second fit begins at the median of the first ones, to leave local optima.

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
    """Return mean, covariance and degrees of freedom of the next healthy piece's Student t.

    The covariance has an inverse-Wishart prior worth 4 pieces (Gelman et al. 2013, ch. 3.6): n - 1 + 4 degrees of
    freedom, scale (1 + 1/n) S.

    Args:
        logs: of the pieces, shape (n, p).
        prior: expected covariance, shape (p, p).
    """
    n, centre = len(logs), logs.mean(axis=0)
    scatter, freedom = (logs - centre).T @ (logs - centre), n - 1 + PRIOR_WEIGHT
    return centre, (scatter + PRIOR_WEIGHT * prior) / freedom * (1.0 + 1.0 / n), freedom


def predictive_sd(values: FloatArray, prior_sd: float) -> float:
    """Return the scale of the predictive Student t of the next value; `values` has shape (n,)."""
    return math.sqrt(predictive_t(values[:, None], np.eye(1) * prior_sd**2)[1][0, 0])


def next_piece(
    fits: Sequence[Fitted], prior_sd: float, borrowed: FloatArray | None = None
) -> tuple[FloatArray, FloatArray, float]:
    """Return mean, covariance and degrees of freedom of the next healthy piece's logarithms.

    The independent errors of the fits are the least scatter.

    Args:
        fits: healthy pieces with the same quantities.
        prior_sd: prior standard deviation of each logarithm from piece to piece.
        borrowed: covariance of other pieces, used if larger.
    """
    logs = np.array([fit.log_values for fit in fits])
    error = np.mean([fit.white_covariance for fit in fits], axis=0)
    prior = np.eye(logs.shape[1]) * prior_sd**2 + error
    return predictive_t(logs, prior if borrowed is None else prior + excess_covariance(prior, borrowed))


def next_window(
    fits: Sequence[Fitted], *, steady: bool, usual: Sequence[Fitted] = ()
) -> tuple[FloatArray, FloatArray, float]:
    """Return mean, covariance and degrees of freedom of log R, K, J and B in another record's window.

    Args:
        fits: healthy windows.
        steady: without a spread from record to record.
        usual: healthy windows of the usual condition, if `fits` are few of another one.
    """
    borrowed = next_window(usual, steady=True)[1] if usual else None
    centre, covariance, freedom = next_piece(fits, 0.0, borrowed)
    return centre, covariance if steady else covariance + np.diag(np.square(RECORD_SPREAD)), freedom


def usual_condition_windows(pieces: Sequence[int], conditions: Sequence[Sequence[int]]) -> Sequence[int]:
    """Return the windows of the usual condition if those of another one are few, else none."""
    usual = max(conditions, key=len)
    return usual if len(usual) >= _FEW_BESIDE * len(pieces) else ()


def learn_without(healthy: Healthy, fits: Sequence[Fitted], number: int) -> Healthy:
    """Learn from all healthy pieces but one; of windows from those under the same condition."""
    conditions = () if healthy.windows is None else healthy.windows.drives
    same_condition = next(
        (condition.pieces for condition in conditions if number in condition.pieces), range(len(fits))
    )
    others = [fits[n] for n in same_condition if n != number]
    usual = [
        fits[n]
        for n in usual_condition_windows(
            same_condition, [condition.pieces for condition in conditions] or [same_condition]
        )
    ]
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


def learn_starts(fits: Sequence[StartFit]) -> Healthy:
    """Learn the distribution of the next start from healthy starts, fitted with the same model."""
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


def explain_disagreement(fits: Sequence[StartFit]) -> str | None:
    """Explain which quantity differs too much between healthy starts; None if they agree."""
    logs = np.array([fit.log_values for fit in fits])
    for name, column in zip(fits[0].quantity_names, logs.T, strict=True):
        if name[0] in "RKJ" and float(np.std(column)) > _DISAGREE:
            low, high = np.exp(column.min()), np.exp(column.max())
            return f"their {name} lies between {low:.3g} and {high:.3g}: are they starts of one motor, from rest?"
    return None


def explain_outlier(fits: Sequence[StartFit], number: int) -> str | None:
    """Explain why a healthy start is an outlier; None if it agrees with the others."""
    others = np.array([fit.log_values for n, fit in enumerate(fits) if n != number])
    if len(others) < 2:
        return None
    middle = np.median(others, axis=0)
    scatter = np.median(np.abs(others - middle), axis=0)
    deviation = fits[number].log_values - middle
    sd = np.sqrt(np.diag(fits[number].log_covariance) + scatter**2 + _SAME_MOTOR**2)
    worst = int(np.argmax(np.abs(deviation) / sd))
    if abs(deviation[worst]) <= _ODD * sd[worst]:
        return None
    name = fits[number].quantity_names[worst]
    return f"its {name} is {math.exp(deviation[worst]):.3g} times that of the others"


def detectable_changes(
    motor: Motor, fits: Sequence[Fitted], temperature_c: float | None, rate: float
) -> tuple[dict[str, float], dict[str, int]]:
    """Return the smallest changes that the next piece shows under every condition, by kind of fault.

    Also return the number of pieces that, judged by the others, leave each quantity undecided.
    """
    healthy = motor.healthy
    assert healthy is not None  # noqa: S101  # it was just learned
    conditions = () if healthy.windows is None else healthy.windows.drives
    learned = [(fits[condition.pieces[0]], healthy.under(condition)) for condition in conditions] or [
        (fits[0], healthy)
    ]
    smallest: dict[str, float] = {}
    for fit, healthy_there in learned:
        reference = _reference(replace(motor, healthy=healthy_there), fit, temperature_c)
        hypotheses = form_hypotheses(fit, reference, rate)
        limits = alarm_limits(hypotheses, rate, tests_noise=reference.log_noise is not None)
        for kind, severity in smallest_detectable(hypotheses, reference.own_friction, limits.z).items():
            smallest[kind] = max(severity, smallest.get(kind, 0.0))
    count = len(fits) if len(fits) > 1 else 0
    others = [replace(motor, healthy=learn_without(healthy, fits, n)) for n in range(count)]
    judged = [decide(fits[n], _reference(others[n], fits[n], temperature_c), rate) for n in range(count)]
    changes = [change for judgement in judged for change in judgement.changes]
    undecided = Counter(change.name for change in changes if change.verdict == "undecided")
    return smallest, dict(undecided)


def _reference(motor: Motor, fit: Fitted, temperature_c: float | None) -> Reference:
    reference = reference_of(
        motor, fit.quantity_names, are_starts=isinstance(fit, StartFit), temperature_c=temperature_c
    )
    assert reference is not None  # noqa: S101  # it was learned from these quantities
    return reference
