"""A recorded motor for tests of the fit: its values, records of it, its fit; and straight lines in a fit's place."""

from dataclasses import replace

import numpy as np

# Reaches in: records and unknowns are made by hand, as tests of several rooms need them.
from motor_env.diagnosis.estimation import parameter_index as index
from motor_env.diagnosis.estimation.problem import Problem, Solution
from motor_env.diagnosis.estimation.record import Hold, Record
from motor_env.diagnosis.estimation.terms import Term, terms
from motor_env.motor.parameters import FloatArray

DT_S = 2e-3
MOTOR = {"R": 2.0, "L": 1e-3, "K": 0.03, "J": 4e-6, "B": 2e-6, "COULOMB": 0.002}
NOISE = {"NOISE_I": 2e-3, "NOISE_W": 0.2}


def values(**given: float) -> FloatArray:
    out = np.zeros(index.N_VALUES)
    for name, value in (MOTOR | NOISE | given).items():
        out[getattr(index, name)] = value
    return out


def plain(n: int, voltage: FloatArray | None = None, hold: Hold = "held", dt_s: float = DT_S) -> Record:
    volts = np.arange(float(n)) if voltage is None else voltage
    return Record(dt_s, volts, np.zeros((n, 2)), np.ones(2), np.eye(1, n)[0], hold)


def worked(
    p: FloatArray,
    seed: int = 1,
    n: int = 400,
    *,
    hold: Hold = "held",
    noise: float = 1.0,
    dt_s: float = DT_S,
    lowest: float = -9.0,
) -> Record:
    """A record of this motor under a voltage of several levels, with its noise."""
    rng = np.random.default_rng(seed)
    each = round(40 * DT_S / dt_s)
    record = plain(n, np.repeat(rng.uniform(lowest, 9.0, -(-n // each)), each)[:n], hold, dt_s)
    clean = record.predict(p, learn=False)[0][:, 2:4]
    shown = clean + noise * rng.standard_normal((n, 2)) * p[[index.NOISE_I, index.NOISE_W]]
    return replace(record, readings=shown)


def solution(
    record: Record, names: list[str], known: FloatArray, theta: FloatArray | None = None
) -> Solution:
    """The fit of these terms, or the model at given unknowns."""
    every = terms(record, known)
    problem = Problem(record, known, tuple(every[name] for name in names))
    if theta is None:
        return problem.solve(np.zeros(len(names)))
    residuals = problem.residuals(theta)
    return Solution(problem, theta, problem.misfit(float(residuals @ residuals)))


LOGS = ["R", "K", "J"]


class Line:
    """In the place of a problem: residuals that are straight lines in the unknowns."""

    def __init__(self, design: FloatArray, target: FloatArray, names: tuple[str, ...]) -> None:
        self.design, self.target, self.names = design, target, names
        n = len(target)
        self.record = plain(n).only(current=True, speed=False)
        self.count = n
        self.available_terms: dict[str, Term] = {}
        self.free = [Term(name, place, 1.0, -5.0, 5.0, is_log=True) for place, name in enumerate(names)]

    def residuals(self, theta: FloatArray) -> FloatArray:
        return self.design @ theta - self.target

    def jacobian(self, _: FloatArray, __: FloatArray, chosen: list[int]) -> FloatArray:
        return np.asarray(self.design[:, chosen])

    def secants(self, _: FloatArray, chosen: list[int], __: FloatArray) -> FloatArray:
        return np.asarray(self.design[:, chosen])

    def values(self, _: FloatArray) -> FloatArray:
        return values()


def least_squares(line: Line) -> FloatArray:
    return np.asarray(np.linalg.lstsq(line.design, line.target, rcond=None)[0], dtype=np.float64)
