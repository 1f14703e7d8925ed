"""What a history must be like for the laws of wear: no repairs, one temperature."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import product

import numpy as np
from scipy.ndimage import maximum_filter1d

from motor_env.motor import identifiable
from motor_env.prognosis.estimates import Series
from motor_env.prognosis.wear import Degradation

_BESIDE, _FEWEST = 8, 3  # estimates on either side of a jump
_JUMP = 6.0
_MAD = 1.4826
_UNKNOWN_TEMPERATURE_K = 30.0
"""Where no temperature is recorded a motor may be colder at one end by so much than at the other."""
_KNOWN = {
    name
    for has_voltage, has_speed in product((False, True), repeat=2)
    for name in identifiable.names(has_voltage=has_voltage, has_speed=has_speed)
}


def at_one_temperature(series: Series, temperature: Series) -> Series:
    """The estimates as they would be at the first temperature, by copper, magnets and friction."""
    kelvin = np.interp(series.time, temperature.time, temperature.estimate)
    factor = np.exp(-_per_kelvin(series.name) * (kelvin - kelvin[0]))
    return replace(series, estimate=series.estimate * factor, standard_error=series.standard_error * factor)


def _per_kelvin(name: str) -> float:
    """By how much the logarithm of a quantity moves a kelvin; 0 of one that is not known."""
    return float(identifiable.warmth_direction(identifiable.matrix((name,)))[0]) if name in _KNOWN else 0.0


def last_jump(series: Series, sign: float = 0.0) -> tuple[int, float] | None:
    """Index of the first estimate after the last jump, and its size; None without one. A sign asks for its direction.

    At each interval a straight line with a step is fitted to the eight estimates on either side. A jump is a step of
    six robust standard deviations of all steps.
    """
    n = len(series.time)
    if n < _BESIDE:
        return None
    fits = []
    for k in range(_FEWEST, n - _FEWEST + 1):
        some = slice(max(k - _BESIDE, 0), k + _BESIDE)
        time = series.time[some] - series.time[k]
        design = np.stack([np.ones(len(time)), time / np.ptp(time), time >= 0.0], axis=1)
        both = np.linalg.inv(design.T @ design)
        fits.append(((both @ (design.T @ series.estimate[some]))[2], math.sqrt(both[2, 2])))
    height, error = np.array(fits).T
    z = height / error
    spread = max(_MAD * float(np.median(np.abs(z))), 0.5 * float(np.median(series.standard_error)))
    size = np.abs(z) / max(spread, 1e-9 * float(np.ptp(series.estimate)), 1e-9)
    wanted = (size > _JUMP) & (sign * height >= 0.0)
    peaks = np.flatnonzero(wanted & (size == maximum_filter1d(size, 2 * _FEWEST + 1)))
    return (_FEWEST + int(peaks[-1]), float(height[peaks[-1]])) if len(peaks) else None


def since(series: Series, first: int) -> Series:
    """The estimates from one on."""
    return replace(
        series,
        time=series.time[first:],
        estimate=series.estimate[first:],
        standard_error=series.standard_error[first:],
    )


def withheld(series: Series, wear: Degradation, *, knows_temperature: bool) -> str:
    """Why no remaining life is told, in words; empty where the law holds.

    Args:
        series: relative to the reference, without jumps.
        wear: fitted to it.
        knows_temperature: whether the estimates are at one temperature.
    """
    change = abs(wear.mean_level - float(series.estimate[:_FEWEST].mean()))
    if not knows_temperature and change < abs(_per_kelvin(series.name)) * _UNKNOWN_TEMPERATURE_K:
        return f"a change of the temperature by {_UNKNOWN_TEMPERATURE_K:.0f} K would explain it"
    return ""
