"""A simulated start and its judgement, and fits altered by hand, for the tests of judgements."""

import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from motor_env import (
    PAPER_MOTOR,
    Diagnosis,
    Fault,
    Recording,
    Scenario,
    SensorParameters,
    Timing,
    diagnose,
    load_motor,
    simulate,
)

# Reaches in: fits are altered by hand.
from motor_env.diagnosis.estimation.starts.start_fit import StartFit
from motor_env.diagnosis.verdict.decision import decide
from motor_env.diagnosis.verdict.healthy_motor import Reference
from motor_env.diagnosis.verdict.hypotheses import Difference
from motor_env.diagnosis.verdict.judgement import Judgement
from motor_env.motor.identifiable import matrix, names
from motor_env.motor.parameters import FloatArray

EXAMPLES = Path(__file__).parents[2] / "examples"
SHEET = load_motor(EXAMPLES / "motor.toml")
CURRENT = names(has_voltage=True, has_speed=False)
EXPONENTS = matrix(CURRENT)
RATE = 0.01


def start(*faults: Fault) -> Recording:
    """One start with quiet time before it."""
    sensor = SensorParameters(current_noise_a=0.02)
    scenario = Scenario(PAPER_MOTOR, faults, sensor=sensor, timing=Timing(duration_s=0.2, quiet_s=0.03))
    made = simulate(scenario, 3, [0])
    return Recording(
        Path("start.csv"), made.time_s, made.measurements[0, 0], made.voltage_v[0], columns=("read so",)
    )


@cache
def judged() -> Diagnosis:
    """A healthy start against the data sheet."""
    return diagnose(start(), SHEET)


def fitted() -> tuple[Judgement, StartFit, Reference]:
    found = judged().decisive
    assert found.identified is not None
    assert found.reference is not None
    return found, found.identified, found.reference


def of_one(**changed: Any) -> Diagnosis:
    """The diagnosis of this recording, if its judgement were another."""
    return replace(judged(), pieces=(replace(judged().decisive, **changed),))


def moved(*off: float, noise: float = 0.0, **changed: Any) -> Judgement:
    """The decision on this fit, if the healthy motor lay so far from it, in logarithms."""
    _, fit, reference = fitted()
    given = {
        "log_values": fit.log_values - np.array(off),
        "includes_fit_error": True,
        "own_friction": 1.0,
        "is_bare": False,
    }
    given |= {"log_noise": math.log(fit.noise_a) - noise}
    return decide(fit, replace(reference, **given | changed), RATE)


def spread(n: int, seed: int = 3) -> FloatArray:
    root = np.tril(np.random.default_rng(seed).normal(0.0, 0.02, (n, n))) + 0.05 * np.eye(n)
    return np.asarray(root @ root.T)


def difference(ratios: FloatArray, covariance: FloatArray, freedom: float = 9.0) -> Difference:
    return Difference(ratios, covariance, EXPONENTS, freedom)


def fits(*logs: list[float], **changed: Any) -> list[StartFit]:
    _, fit, _ = fitted()
    return [replace(fit, log_values=fit.log_values + np.array(each), **changed) for each in logs]


SCATTER = ([0.0, 0.1, 0.02, 0.0], [0.03, 0.0, 0.0, 0.1], [0.0, -0.1, 0.01, 0.05])
