"""Starts of the paper's motor as they are measured, and the problem of their fit at the truth."""

import numpy as np
from started_motor import Beyond, step_start

from motor_env import PAPER_MOTOR
from motor_env.diagnosis.estimation.problem import Problem

# Reaches in: starts are aligned by hand, their onset known.
from motor_env.diagnosis.estimation.starts.start_prior import start_prior
from motor_env.diagnosis.readers.alignment import Alignment
from motor_env.diagnosis.readers.start import Start
from motor_env.motor.parameters import FloatArray

MOTOR = PAPER_MOTOR.scaled(torque_constant_n_m_per_a=0.02352 / 0.0235)
DT_S, QUIET = 2e-4, 40
TIME_S: FloatArray = (np.arange(500.0) - QUIET) * DT_S
ONSET_S = 0.4 * DT_S
QUANTITIES = {
    "R": 2.18,
    "L": 0.238e-3,
    "K": 0.02352,
    "J": 1.07e-6,
    "B": 12e-7,
    "K^2/J": 0.02352**2 / 1.07e-6,
    "B/J": 12e-7 / 1.07e-6,
}


def start(
    *,
    noise_a: float = 0.01,
    seed: int = 1,
    speed: bool = False,
    quiet: bool = True,
    level_known: bool = True,
    offset_a: float = 0.02,
    onset_s: float = ONSET_S,
    **beyond: Beyond,
) -> Start:
    """A start of the paper's motor at 12 V, its onset between two samples, white noise, an offset of the sensor.

    What it has beyond the textbook is named as in `motor_env.diagnosis.estimation.parameter_index`.
    """
    first = 0 if quiet else QUIET
    time_s = TIME_S[first:]
    states = step_start(MOTOR, time_s, onset_s, 12.0, **beyond)
    rng = np.random.default_rng(seed)
    current = states[:, 0] + offset_a + noise_a * rng.standard_normal(len(time_s))
    turned = states[:, 1] + 2.0 * rng.standard_normal(len(time_s)) if speed else None
    begin = QUIET - first + 1
    alignment = Alignment(begin, float(time_s[begin]), begin - 2 if quiet else 0, 1.0, offset_a, noise_a)
    level = 12.0 if level_known else 1.0
    return Start(time_s, current, turned, None, level, level_known, alignment)


def problem_of(
    measured: Start,
    model: tuple[str, ...] = (),
    constant: float | None = 0.02352,
    typical: dict[str, float] | None = None,
) -> Problem:
    return start_prior(measured, constant, typical).problem(model)


def truth(problem: Problem, measured: Start, **extras: float) -> FloatArray:
    """The unknowns of the motor that was simulated; what it has beyond the textbook by the names of the terms."""
    values = QUANTITIES | extras | {"onset": ONSET_S - measured.alignment.onset_s, "offset_current": 0.0}
    ratios = [(values[term.name] / term.unit, term.is_log) for term in problem.free]
    return np.array([np.log(ratio) if is_log else ratio for ratio, is_log in ratios])


def place(problem: Problem, name: str) -> int:
    return problem.names.index(name)


def left_of(problem: Problem, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Residuals of the samples, shape (n_samples, n_channels), and of the beliefs, shape (n_unknowns,)."""
    residuals = problem.residuals(theta)
    n = len(problem.free)
    return residuals[:-n].reshape(-1, int(problem.record.recorded.sum())), residuals[-n:]
