"""Whether a fitted start looks like that of a motor: a wrong unit, scale or rate gives values that no motor has."""

from __future__ import annotations

import math

import numpy as np

from motor_env.fitting.identify import Operation
from motor_env.fitting.starts.identified import Identified
from motor_env.recordings.start import mean_tail

_USUAL = {
    "R": (5e-3, 1e3, "ohm"),
    "L": (1e-7, 1.0, "H"),
    "K": (1e-4, 20.0, "V s/rad"),
    "L/R": (2e-6, 0.2, "s"),
    "R J/K^2": (5e-4, 30.0, "s"),
    "current": (1e-3, 5e3, "A"),
    "sampling rate": (20.0, 5e7, "Hz"),
}
"""Least and largest value (of the current: its peak) of brushed DC motors from pagers to traction, with a margin."""

POOR_FIT = 0.75  # R2 of a start that no motor explains
_TOLD = 0.3  # standard error of a logarithm, above which a quantity is not told
_UNTOLD = 1.0
_RUN_UP, _STANDING = 2.0, 0.8  # time constants, after which a current has fallen to 14 %; share of its peak
NOT_TURNING = (
    "the current does not show that a motor turns: the recording ends too early, the rotor is blocked, or this is no"
    " motor (a resistor, a coil)"
)


def shows_turning(fit: Identified) -> bool:
    """Whether the start tells K^2/J, or with the speed K, to a factor of e: a resistor and a coil have none."""
    pull = next(n for n, name in enumerate(fit.quantity_names) if name.startswith("K"))
    return float(fit.log_covariance[pull, pull]) < _UNTOLD**2


def is_blocked(fit: Identified, time_constant_s: float) -> bool:
    """Whether the current has hardly fallen when a healthy motor has run up, and shows no turning motor.

    Args:
        fit: of a start.
        time_constant_s: mechanical time constant of the healthy motor.
    """
    if shows_turning(fit) or fit.start.alignment.saturation or fit.r2_current < POOR_FIT:
        return False
    lasts, current = float(fit.start.time_s[-1]) - fit.onset_s, fit.states[:, 0]
    return lasts > _RUN_UP * time_constant_s and mean_tail(current) > _STANDING * float(current.max())


def implausible(fit: Identified | Operation) -> list[str]:
    """A sentence for each value that lies outside what motors have; none for a quantity that is hardly told."""
    if isinstance(fit, Identified):
        current, dt_s = fit.start.current_a, fit.start.dt_s
        errors = dict(zip(fit.quantity_names, np.sqrt(np.diag(fit.log_covariance)).tolist(), strict=True))
        logs = dict(zip(fit.quantity_names, fit.log_values.tolist(), strict=True))
    else:
        current, dt_s = fit.record.readings[:, 0], fit.record.dt_s
        errors = {one.name: one.log_sd for one in fit.quantities if one.value > 0.0}
        logs = {one.name: math.log(one.value) for one in fit.quantities if one.name in errors}

    def log_of(letters: str) -> float:
        """Logarithm of a quantity, whatever it is divided by; NaN where it is not told."""
        name = next((one for one in logs if one.split("/")[0] == letters), "")
        return logs[name] if errors.get(name, math.inf) < _TOLD else math.nan

    pull = log_of("K^2") if "K" not in logs and "K/V" not in logs else 2.0 * log_of("K") - log_of("J")
    seen = {
        "current": float(np.nanmax(np.abs(current))) or math.nan,  # 0 where only the speed was recorded
        "sampling rate": 1.0 / dt_s,
        "L/R": math.exp(log_of("L") - log_of("R")),
        "R J/K^2": math.exp(log_of("R") - pull),
    } | {name: math.exp(log_of(name)) for name in ("R", "L", "K") if name in logs}
    sentences = [] if isinstance(fit, Operation) or shows_turning(fit) else [NOT_TURNING]
    for name, value in seen.items():
        low, high, unit = _USUAL[name]
        if value < low or value > high:
            usual = f"{low:g} to {high:g} {unit}"
            sentences.append(
                f"{name} of {value:.3g} {unit} lies outside what motors have ({usual}): check units, scale and rate of"
                " the recording"
            )
    return sentences
