"""Find scaling errors of columns that resemble faults: a unit, a probe's scale, a clock.

A column that is g times too large multiplies each quantity by a power of g, by V = R i + L di/dt + K w and
J dw/dt = K i - B w.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from motor_env.diagnosis.estimation.starts.start_fit import NOT_TURNING
from motor_env.diagnosis.verdict.hypotheses import Difference, Explanation, fit_steps, residual_p_value
from motor_env.diagnosis.verdict.judgement import Judgement, Verdict
from motor_env.motor.faults import FaultKind
from motor_env.motor.identifiable import PARAMETERS, fault_direction

POWERS = {
    "current": {"R": -1.0, "L": -1.0, "J": 1.0, "B": 1.0},
    "voltage": {"R": 1.0, "L": 1.0, "K": 1.0, "J": 1.0, "B": 1.0},
    "speed": {"K": -1.0, "J": -2.0, "B": -2.0},
    "time": {"L": 1.0, "J": 1.0},
}
_UNITS = {
    "current": {1e3: "in mA, and was read in A", 1e-3: "in kA, and was read in A"},
    "voltage": {1e3: "in mV, and was read in V", 1e-3: "in kV, and was read in V"},
    "speed": {
        30.0 / math.pi: "in rpm, and was read in rad/s",
        0.03 / math.pi: "in thousands of rpm, and was read in rad/s",
        180.0 / math.pi: "in degrees a second, and was read in rad/s",
        0.5 / math.pi: "in turns a second, and was read in rad/s",
    },
    "time": {
        1e3: "in ms, and was read in s",
        1e6: "in microseconds, and was read in s",
        1 / 60.0: "in minutes, and was read in s",
    },
}
_SCALES = {
    "current": "the scale of its probe or shunt",
    "voltage": "the scale of its probe or divider",
    "speed": "pulses a turn, gear and unit",
    "time": "the sampling rate",
}
_BRUSHES = ", and at the brushes, whose drop may act alike"
_MOST_OF_BRUSHES = 1.5  # factor of the voltage: they take a third of it
_ROUND = (2.0, 10.0, 100.0, 1e3)
_NEAR, _SURE = 0.05, 3.0  # of a factor, and its standard errors, within which it is a unit's
_FAR, _NOT_NEAR = math.log(3.0), math.log(1.5)
_MOST = {"B": math.log(10.0), "R": math.log(10.0)}
"""Logarithm of the largest plausible wear; `_FAR` for anything else."""
BEYOND_WEAR = (
    "so large a change is no wear: is this the right motor? It is another motor or load, or no motor at all, or"
    " columns, units or a rate were read wrongly"
)
EXPLAINED = "all of it is explained"
READ_SO = "seem to be swapped: read so, the recording is that of this motor"
SWAPPED = f"voltage and current {READ_SO}"


class ScalingError(NamedTuple):
    """Wrong scale of a column that explains a difference; `gain` is None for a unit or the clock."""

    column: str
    words: str
    gain: Explanation | None


def describe_scaling_errors(scales: Sequence[ScalingError]) -> str:
    """Describe the wrong scales that would explain a difference; empty without any."""
    words = sorted(f"the {scale.column} is {scale.words}" for scale in scales)
    return f"{EXPLAINED} if {', or if '.join(words)}" if words else ""


def find_scaling_errors(
    difference: Difference, names: tuple[str, ...], limit: float, rate: float
) -> list[ScalingError]:
    """Find the columns whose wrong scale would explain a difference.

    Args:
        difference: of the logarithms to a healthy motor, shape (n,).
        names: of the quantities.
        limit: standard deviations beyond which a factor is significant.
        rate: p-value below which too much is left unexplained.
    """
    missing = {"voltage"} if any("V" in name for name in names) else set()
    missing |= set() if {"K", "K/V"} & set(names) else {"speed"}
    sd, errors = np.sqrt(np.diag(difference.covariance)), []
    for column in sorted(POWERS.keys() - missing):  # a set's order changes from run to run
        direction = difference.exponents @ [POWERS[column].get(parameter, 0.0) for parameter in PARAMETERS]
        if not direction.any():  # a voltage, where nothing of it is compared
            continue
        fitted = fit_steps(direction[:, None], difference.inverse, difference.log_ratios)
        step, step_sd = (float(each[0]) for each in fitted)
        # A reading's scale is exact: nothing else moves with it.
        p_left_over = residual_p_value(difference, step * direction, difference.covariance)
        if abs(step) <= limit * step_sd or p_left_over <= rate:
            continue
        # One quantity alone moves by faults and loads as well: only a known factor, and no other near it, counts.
        is_shared = np.count_nonzero(np.abs(step * direction) > limit * sd) > 1
        near = max(_NEAR, _SURE * step_sd) if is_shared else _NEAR
        word = _describe_factor(column, step, near, only_known=not is_shared)
        gain, turned = None, math.copysign(1.0, step)
        if column != "time" and word not in _UNITS[column].values():
            kind = FaultKind(f"{column}_gain")
            gain = Explanation(
                kind,
                abs(step) / step_sd,
                abs(step),
                step_sd,
                p_left_over,
                turned * direction,
                difference.covariance,
            )
        errors += [ScalingError(column, word, gain)] if word else []
    return errors


def _describe_factor(column: str, step: float, near: float, *, only_known: bool) -> str:
    """Describe the factor e^step of a column; empty if only known factors count and it is none."""
    for factor, unit in _UNITS[column].items():
        if abs(step - math.log(factor)) < near:
            return unit
    size = min(_ROUND, key=lambda factor: abs(abs(step) - math.log(factor)))
    if abs(abs(step) - math.log(size)) > near:
        if only_known:
            return ""
        size = math.exp(abs(step))
    brushes = _BRUSHES if column == "voltage" and 0.0 < step < math.log(_MOST_OF_BRUSHES) else ""
    return f"{size:.3g} times too {'large' if step > 0.0 else 'small'} (look at {_SCALES[column]}{brushes})"


def is_far_from_healthy(judgement: Judgement) -> bool:
    """Whether a window is so far from the healthy motor, its initial value, that the fit may not have converged."""
    return judgement.verdict.is_fault and any(
        abs(math.log(change.ratio)) > (_FAR if change.name == "B" else _NOT_NEAR)
        for change in judgement.changes
    )


def is_unlike_motor(judgement: Judgement) -> bool:
    """Whether a piece cannot be judged, or is not of this motor."""
    odd = {NOT_TURNING, BEYOND_WEAR} & set(judgement.reasons)
    return judgement.verdict is Verdict.UNUSABLE or bool(odd)


def limit_to_wear(judgement: Judgement) -> Judgement:
    """Limit a judgement to plausible wear; beyond it, name no fault."""
    kind, interval = judgement.fault_kind, judgement.severity_interval
    if kind is not None and interval is not None:
        moved = list(zip(PARAMETERS, float(kind.log_size(interval[0])) * fault_direction(kind), strict=True))
    else:
        moved = [
            (change.name[0], min(math.log(change.low), math.log(change.high), key=abs))
            for change in judgement.changes
            if change.significant
        ]
    is_beyond = any(abs(log) > _MOST.get(letter, _FAR) for letter, log in moved)
    if not is_beyond:
        return judgement
    is_said = any(reason.startswith(EXPLAINED) for reason in judgement.reasons)
    return judgement.as_other(*judgement.reasons, *(() if is_said else (BEYOND_WEAR,)))
