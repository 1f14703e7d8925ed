"""Whether a fitted start looks like that of a motor: a wrong unit, scale or rate gives values that no motor has."""

from __future__ import annotations

import numpy as np

from motor_env.fitting.starts.identified import Identified

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

_TOLD = 0.3  # standard error of a logarithm, above which a quantity is not told
_UNTOLD = 1.0
NOT_TURNING = (
    "the current does not show that a motor turns: the recording ends too early, the rotor is blocked, or this is no"
    " motor (a resistor, a coil)"
)


def shows_turning(fit: Identified) -> bool:
    """Whether the start tells K^2/J, or with the speed K, to a factor of e: a resistor and a coil have none."""
    pull = next(n for n, name in enumerate(fit.quantity_names) if name.startswith("K"))
    return float(fit.log_covariance[pull, pull]) < _UNTOLD**2


def implausible(fit: Identified) -> list[str]:
    """A sentence for each value that lies outside what motors have; none for a quantity that the start hardly tells."""
    logs = dict(zip(fit.quantity_names, fit.log_values.tolist(), strict=True))
    errors = dict(zip(fit.quantity_names, np.sqrt(np.diag(fit.log_covariance)).tolist(), strict=True))

    def first(letters: str) -> str:
        return next((name for name in logs if name.split("/")[0] == letters), "")

    resistance, inductance, constant, squared = first("R"), first("L"), first("K"), first("K^2")
    seen = {"current": float(np.max(np.abs(fit.start.current_a))), "sampling rate": 1.0 / fit.start.dt_s}
    if errors[resistance] < _TOLD:
        if errors[inductance] < _TOLD:
            seen["L/R"] = float(np.exp(logs[inductance] - logs[resistance]))
        pull = logs[squared] if squared else 2.0 * logs[constant] - logs[first("J")]
        if errors[squared or constant] < _TOLD:
            seen["R J/K^2"] = float(np.exp(logs[resistance] - pull))
    seen |= {
        name: float(np.exp(logs[name])) for name in ("R", "L", "K") if name in logs and errors[name] < _TOLD
    }
    sentences = [] if shows_turning(fit) else [NOT_TURNING]
    for name, value in seen.items():
        low, high, unit = _USUAL[name]
        if not low <= value <= high:
            usual = f"{low:g} to {high:g} {unit}"
            sentences.append(
                f"{name} of {value:.3g} {unit} lies outside what motors have ({usual}): check units, scale and rate of"
                " the recording"
            )
    return sentences
