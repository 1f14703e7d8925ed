"""Monitor a motor at work: each window gives a verdict and updates the statistics of an alarm.

Each window gives a normal score along each fault direction, for an e-detector (Shin, Ramdas & Rinaldo 2023). exp(d u -
d^2 / 2) is an e-value of a shift d if the score u is at most standard normal. The Shiryaev-Roberts sum M <- (M + 1) e,
and any mixture of such sums, grows by at most 1 a window on average. So it passes a threshold A after at least A
windows on average, if the fitted tails hold.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy.special import gammainc, ndtri, stdtr, stdtrit

from motor_env.common.errors import InputError
from motor_env.diagnosis.operation.windows import WARMTH, WindowJudge
from motor_env.diagnosis.readers.recording import Recording
from motor_env.diagnosis.verdict.healthy_spread import PRIOR_WEIGHT
from motor_env.diagnosis.verdict.hypotheses import EXPONENTS, NAMES, FittedWindow
from motor_env.diagnosis.verdict.judgement import Judgement
from motor_env.motor import identifiable
from motor_env.motor.healthy import Healthy, ScoreCalibration
from motor_env.motor.parameters import FloatArray

_P = len(NAMES)
_FARTHER = (0.005, 0.1)  # least and largest probability of a healthy drift beyond the allowed bias
_LEAST_EXCESS = 1e-3  # of the kurtosis
_NAMED_WEIGHT = 4.0  # of a fault with a name, over that of any other change


def fault_directions() -> tuple[FloatArray, FloatArray]:
    """Return unit vectors of the faults in log R, K, J and B, shape (n, 4), and their weights, shape (n,).

    They are those of the named faults, and each quantity up and down.
    """
    named = [
        identifiable.visible_direction(kind, EXPONENTS) for kind in identifiable.nameable_kinds(EXPONENTS)
    ]
    rows = np.array([*named, *np.eye(_P), *-np.eye(_P)])
    unit = rows / np.linalg.norm(rows, axis=1, keepdims=True)
    first = [n for n, row in enumerate(unit) if not np.isclose(unit[:n], row).all(axis=1).any()]
    weights = np.where(np.array(first) < len(named), _NAMED_WEIGHT, 1.0)
    return unit[first], weights / weights.sum()


def learn_calibration(
    logs: FloatArray, errors: FloatArray, prior_sd: FloatArray, *, temperature_k: float
) -> ScoreCalibration:
    """Learn the scatter of healthy windows, and the healthy drift.

    The degrees of freedom f match the kurtosis 3 + 6 / (f - 4), raised by one standard error.

    Args:
        logs: of R, K, J and B over the healthy ones, shape (n, 4).
        errors: their covariances by the fits, shape (n, 4, 4).
        prior_sd: standard deviation of the drift of each logarithm, shape (4,).
        temperature_k: standard deviation of the temperature.
    """
    deviations, count = logs - logs.mean(axis=0), len(logs)
    white = np.linalg.solve(np.linalg.cholesky(errors), deviations[..., None])[..., 0]
    white -= white.mean(axis=0)
    scatter = white.T @ white
    isotropic = max(float(np.trace(scatter)) / _P / (count - 1), 1e-12) * np.eye(_P)
    covariance = (scatter + PRIOR_WEIGHT * isotropic) / (count - 1 + PRIOR_WEIGHT)
    unit = np.linalg.solve(np.linalg.cholesky(covariance), white.T)
    kurtosis = float(np.mean(unit**4) / np.mean(unit**2) ** 2) + math.sqrt(24.0 / unit.size)
    drift = np.diag(np.square(prior_sd)) + temperature_k**2 * np.outer(WARMTH, WARMTH)
    return ScoreCalibration(
        windows=count,
        covariance=covariance,
        degrees_of_freedom=4.0 + 6.0 / max(kurtosis - 3.0, _LEAST_EXCESS),
        drift_covariance=drift + np.cov(deviations.T) / count,
    )


def uncompared_calibration(log_covariance: FloatArray, freedom: float, windows: int) -> ScoreCalibration:
    """Return the calibration of a motor without compared windows: all spread counts as drift."""
    return ScoreCalibration(max(windows, 2), np.eye(_P), max(freedom, 2.0), log_covariance)


def normal_scores(
    calibration: ScoreCalibration,
    logs: FloatArray,
    error: FloatArray,
    directions: FloatArray,
    windows_between_alarms: float,
) -> FloatArray:
    """Score a window along directions, shape (n,): at most standard normal while healthy.

    Each is the linear discriminant of a fault against scatter and drift; healthy drift is a bias bound, not noise.
    With few windows it has a t distribution of fewer degrees and a larger scale (Hotelling).

    Args:
        calibration: of the healthy windows.
        logs: of the window's R, K, J and B over the healthy ones, shape (4,).
        error: their covariance by the fit, shape (4, 4).
        directions: unit vectors, shape (n, 4).
        windows_between_alarms: sets the quantile of the drift.
    """
    root = np.linalg.cholesky(error)
    spread, drift = root @ calibration.covariance @ root.T, calibration.drift_covariance
    slopes = np.linalg.solve(spread + drift, directions.T)
    slopes /= np.sqrt(np.einsum("pd,pq,qd->d", slopes, spread, slopes))
    probability = min(max(1.0 / windows_between_alarms, _FARTHER[0]), _FARTHER[1])
    allowed = -float(stdtrit(calibration.windows - 1, probability))
    bias = allowed * np.sqrt(np.einsum("pd,pq,qd->d", slopes, drift, slopes))
    learned_freedom = calibration.windows + PRIOR_WEIGHT - 1.0
    reduced_freedom = max(learned_freedom - _P + 1.0, 1.0)
    freedom = min(reduced_freedom, calibration.degrees_of_freedom)
    tails = stdtr(freedom, (bias - logs @ slopes) / math.sqrt(learned_freedom / reduced_freedom))
    scores: FloatArray = -ndtri(tails)
    return np.where(np.isnan(scores), 0.0, scores)


YEAR_S = 365.25 * 86_400.0
EFFECT_SIZES = np.array([1.2, 2.4])
"""Shifts to detect, in standard deviations of a window."""
THRESHOLDS = 4.0 ** np.arange(1, 13)
"""Mean windows between false alarms at which healthy windows are cross-checked."""
_LARGEST_SCORE, _LARGEST_SUM = 10.0, 1e100
_OVERSHOOT = 0.5
"""Share of the threshold, for the overshoot at an alarm: scores of any law alarm at most twice as often as asked."""
_ONGOING = 2.0  # score of a window up to which an alarm goes on
_UNLIKELY = 0.01
_NONE_SEEN = 3.0  # upper 95 % bound of a Poisson mean without an event


def updated_sums(sums: FloatArray, scores: FloatArray) -> FloatArray:
    """Update Shiryaev-Roberts sums with the scores of a window.

    Args:
        sums: for each direction and effect size, shape (n, n_sizes); 0 at the begin.
        scores: normal scores along each direction, shape (n,).
    """
    u = np.minimum(scores, _LARGEST_SCORE)[:, None]
    new: FloatArray = (sums + 1.0) * np.exp(EFFECT_SIZES * u - 0.5 * EFFECT_SIZES**2)
    return np.minimum(new, _LARGEST_SUM)


def is_alarm(sums: FloatArray, weights: FloatArray, windows: float) -> bool:
    """Whether the mixture of the sums alarms, at one false alarm in `windows` windows."""
    return bool(weights @ sums.mean(axis=1) >= _OVERSHOOT * windows)


def checked_calibration(
    logs: FloatArray, errors: FloatArray, prior_sd: FloatArray, *, temperature_k: float
) -> ScoreCalibration:
    """Learn a calibration, and check its tails on the healthy windows by leave-one-out.

    The tails hold if the number of alarms at each of THRESHOLDS is plausible (Poisson). Arguments:
    `learn_calibration`.
    """
    (directions, weights), count = fault_directions(), len(logs)
    others = [np.flatnonzero(np.arange(count) != n) for n in range(count)]
    each = [
        learn_calibration(logs[rows], errors[rows], prior_sd, temperature_k=temperature_k) for rows in others
    ]
    deviations = [logs[n] - logs[rows].mean(axis=0) for n, rows in enumerate(others)]
    holds = True
    for threshold in THRESHOLDS.tolist():
        sums, alarms = np.zeros((len(directions), len(EFFECT_SIZES))), 0
        for n, calibration in enumerate(each):
            sums = updated_sums(
                sums, normal_scores(calibration, deviations[n], errors[n], directions, threshold)
            )
            if is_alarm(sums, weights, threshold):
                sums, alarms = np.zeros_like(sums), alarms + 1
        holds &= bool(gammainc(alarms, count / threshold) >= _UNLIKELY)  # of so many or more
    return replace(learn_calibration(logs, errors, prior_sd, temperature_k=temperature_k), tails_hold=holds)


class SequentialMonitor:
    """Accumulate evidence against a healthy motor, window by window.

    Args:
        judge: of the windows.
        healthy: statistics of healthy windows.
        false_alarms_per_year: of a motor that always runs.
        state: of an earlier monitor, see `state_dict`.

    Attributes:
        windows: wanted mean number of windows between false alarms.
        alarm_active: whether the last alarm goes on.

    Raises:
        InputError: the state is of another motor.
    """

    def __init__(
        self,
        judge: WindowJudge,
        healthy: Healthy,
        *,
        false_alarms_per_year: float,
        state: dict[str, list[float]] | None = None,
    ) -> None:
        self.judge, self.alarm_active = judge, False
        # At most every other window alarms.
        self.windows = max(YEAR_S / false_alarms_per_year / judge.windows.window_s, 2.0)
        self._calibration = judge.windows.calibration or uncompared_calibration(
            healthy.log_covariance, healthy.degrees_of_freedom, healthy.pieces
        )
        self._directions, self._weights = fault_directions()
        self._sums: FloatArray = np.zeros((len(self._directions), len(EFFECT_SIZES)))
        if state:
            self._load_state_dict(state)

    def diagnose(self, window: Recording) -> Judgement:
        """Judge a window and update the evidence; the verdict is a fault during an alarm.

        A window under an unknown operating condition is judged by itself and is no evidence.

        Raises:
            UnusableError: outside the commissioned regime.
        """
        place, distance = self.judge.condition_of(window)
        reference = self.judge.under(place).reference

        def update(fit: FittedWindow) -> bool:
            return self.update(fit.log_values - reference.log_values, fit.log_covariance)

        is_known = distance <= 1.0
        self.alarm_active &= is_known
        judgements, _ = self.judge.judge(window, 1.0 / self.windows, update if is_known else None)
        return judgements[0]

    def update(self, logs: FloatArray, error: FloatArray) -> bool:
        """Add a window to the evidence; return whether an alarm is active.

        Args:
            logs: of its R, K, J and B over the healthy ones, shape (4,).
            error: their covariance, shape (4, 4).
        """
        scores = normal_scores(self._calibration, logs, error, self._directions, self.windows)
        self._sums = updated_sums(self._sums, scores)
        if is_alarm(self._sums, self._weights, self.windows):
            self._sums, self.alarm_active = np.zeros_like(self._sums), True
        elif scores.max() < _ONGOING:
            self.alarm_active = False
        return self.alarm_active

    def describe_false_alarm_rate(self) -> str:
        """Describe the rate of false alarms, and whether it is supported."""
        window_s, calibration = self.judge.windows.window_s, self.judge.windows.calibration
        words = f"{self._calibration.windows} healthy windows of {window_s:g} s"
        rate = f"one false alarm in {_time(self.windows * window_s)}"
        if calibration is None:
            return f"{words}, which were not compared with each other: commission the motor anew for a checked rate"
        if calibration.tails_hold:
            return f"{words}: {rate} if the fitted tails hold, as they do on these windows"
        needed = math.ceil(_NONE_SEEN * self.windows)
        return (
            f"{words} do not follow the fitted tails: {rate} is not supported;"
            f" {needed} windows without a false alarm would support it"
        )

    @property
    def state_dict(self) -> dict[str, list[float]]:
        """State for a later monitor."""
        return {"sums": self._sums.ravel().tolist(), "alarm": [float(self.alarm_active)]}

    def _load_state_dict(self, state: dict[str, list[float]]) -> None:
        sizes = {name: len(row) for name, row in self.state_dict.items()}
        if not 0.0 <= min(map(min, state.values())) <= max(map(max, state.values())) <= _LARGEST_SUM:
            raise InputError(
                f"the memory of the state must lie in 0 .. {_LARGEST_SUM:g}; give another --state"
            )
        if {name: len(row) for name, row in state.items()} != sizes:
            raise InputError("the memory of the state is not that of this motor; give another --state")
        self._sums = np.array(state["sums"]).reshape(self._sums.shape)
        self.alarm_active = bool(state["alarm"][0])


def _time(seconds: float) -> str:
    sizes = {"year": YEAR_S, "day": 86_400.0, "hour": 3600.0, "minute": 60.0}
    unit = next((unit for unit, size in sizes.items() if seconds >= size), "minute")
    number = f"{seconds / sizes[unit]:.3g}"
    return f"{number} {unit}" + "s" * (number != "1")
