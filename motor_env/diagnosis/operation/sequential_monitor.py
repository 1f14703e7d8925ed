"""The sequential monitor of a motor at work: one window in, one verdict, one update of a few statistics, one alarm.

Each window gives a normal score along each direction of a fault. An e-detector (Shin, Ramdas & Rinaldo 2023) adds them
up: exp(d u - d^2 / 2) is an e-value of a shift d if the score u is standard normal or less. Its Shiryaev-Roberts sum
M <- (M + 1) e grows by at most 1 a window on average, and so does a mixture of such sums, whatever depends on what. It
passes a threshold A no earlier than after A windows on average. The rate holds as far as the fitted tails do.
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
    """Return unit vectors along which faults move the logarithms of R, K, J and B, and their weights, which sum to 1.

    Those of the faults with a name, and up and down each quantity; each once. Shapes (n, 4) and (n,).
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
    """Learn how healthy windows scatter, and how far a healthy motor may drift.

    Of Student's t with f degrees of freedom the kurtosis is 3 + 6 / (f - 4). It is taken one standard error larger than
    it is.

    Args:
        logs: of R, K, J and B over the healthy ones, shape (n, 4).
        errors: their covariances as the fits believe them, shape (n, 4, 4).
        prior_sd: how far each logarithm may drift for no known reason, shape (4,); 0 where only a fault moves it.
        temperature_k: how much warmer or colder the motor may be, one standard deviation.
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
    """Return the calibration of a motor whose windows were not compared: their spread counts as a drift."""
    return ScoreCalibration(max(windows, 2), np.eye(_P), max(freedom, 2.0), log_covariance)


def normal_scores(
    calibration: ScoreCalibration,
    logs: FloatArray,
    error: FloatArray,
    directions: FloatArray,
    windows_between_alarms: float,
) -> FloatArray:
    """Score a window along directions, shape (n,): standard normal or less while the motor is healthy.

    Each is the linear combination of R, K, J and B that tells that fault best from scatter and drift. With few windows
    to learn from, a distance by a sample's inverse covariance is that of a t with fewer degrees and a larger scale
    (Hotelling).

    Args:
        calibration: of the healthy windows.
        logs: of the window's R, K, J and B over the healthy ones, shape (4,).
        error: their covariance as the fit believes it, shape (4, 4).
        directions: unit vectors, shape (n, 4).
        windows_between_alarms: the more, the farther a healthy motor may drift.
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
"""Shifts that are looked for, in standard deviations of a window."""
THRESHOLDS = 4.0 ** np.arange(1, 13)
"""Windows from one false alarm to the next at which healthy windows are judged by one another."""
_LARGEST_SCORE, _LARGEST_SUM = 10.0, 1e100
_OVERSHOOT = 0.5
"""Share of the threshold: at an alarm the sums are beyond it. Normal scores alarm after 1.2 times as many windows as is
asked (by simulation); for any others false alarms are twice as many at most."""
_ONGOING = 2.0  # score of a window up to which an alarm goes on
_UNLIKELY = 0.01
_NONE_SEEN = 3.0  # events that may be due where none was seen, with 95 % confidence


def updated_sums(sums: FloatArray, scores: FloatArray) -> FloatArray:
    """Update Shiryaev-Roberts sums with the scores of a window.

    Args:
        sums: for each direction and size of an effect, shape (n, n_sizes); 0 at the begin.
        scores: normal scores along each direction, shape (n,).
    """
    u = np.minimum(scores, _LARGEST_SCORE)[:, None]
    new: FloatArray = (sums + 1.0) * np.exp(EFFECT_SIZES * u - 0.5 * EFFECT_SIZES**2)
    return np.minimum(new, _LARGEST_SUM)


def is_alarm(sums: FloatArray, weights: FloatArray, windows: float) -> bool:
    """Say whether the mixture of the sums is an alarm, at one false alarm in so many windows."""
    return bool(weights @ sums.mean(axis=1) >= _OVERSHOOT * windows)


def checked_calibration(
    logs: FloatArray, errors: FloatArray, prior_sd: FloatArray, *, temperature_k: float
) -> ScoreCalibration:
    """Learn a calibration, and check its tails on the healthy windows, each judged by what the others teach.

    The tails hold if these windows alarm no more often than they should, by Poisson's distribution at each of
    THRESHOLDS. For the arguments see `learn_calibration`.
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
    """Evidence against one healthy motor, window by window.

    Args:
        judge: of the windows.
        healthy: what healthy windows have taught.
        false_alarms_per_year: of a motor that always runs.
        state: of an earlier monitor, see `state_dict`.

    Attributes:
        windows: mean number of windows from one false alarm to the next that is asked for.
        alarm_active: whether the last alarm still goes on.

    Raises:
        InputError: the state is that of another motor.
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
        """Judge a window, and update the evidence by it; its verdict is a fault while there is an alarm.

        A window under an operating condition that was not commissioned is judged by itself, and is no evidence.

        Raises:
            UnusableError: it is outside the commissioned regime.
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
        """Add a window to the evidence; return whether there is an alarm, or one goes on.

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
        """Say what holds of the rate of false alarms."""
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
        """All that a later monitor needs to go on."""
        return {"sums": self._sums.ravel().tolist(), "alarm": [float(self.alarm_active)]}

    def _load_state_dict(self, state: dict[str, list[float]]) -> None:
        sizes = {name: len(row) for name, row in self.state_dict.items()}
        if {name: len(row) for name, row in state.items()} != sizes or min(map(min, state.values())) < 0.0:
            raise InputError("the memory of the state is not that of this motor; give another --state")
        self._sums = np.array(state["sums"]).reshape(self._sums.shape)
        self.alarm_active = bool(state["alarm"][0])


def _time(seconds: float) -> str:
    """A time in the largest unit that it fills."""
    sizes = {"year": YEAR_S, "day": 86_400.0, "hour": 3600.0, "minute": 60.0}
    unit = next((unit for unit, size in sizes.items() if seconds >= size), "minute")
    number = f"{seconds / sizes[unit]:.3g}"
    return f"{number} {unit}" + "s" * (number != "1")
