"""What a history must be like for the wear model: no jumps, one temperature, one drift."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import product

import numpy as np
from scipy.ndimage import maximum_filter1d

from motor_env.motor import identifiable
from motor_env.motor.parameters import FloatArray
from motor_env.prognosis.estimates import Series
from motor_env.prognosis.wear import Degradation

_BESIDE, _FEWEST = 8, 3  # estimates on either side of a jump
_JUMP = 6.0
_MAD = 1.4826
_UNKNOWN_TEMPERATURE_K = 30.0
"""Where no temperature is recorded a motor may be colder at one end by so much than at the other."""
_CLEAR, _CHANGED = 3.0, 2.0  # standard deviations
_EXCLUDED = 2.7  # rise of the chi-square with one degree of freedom
_FEWEST_STEPS = 8
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


def last_jump(series: Series) -> tuple[int, float] | None:
    """Index of the first estimate after the last jump, and its size; None without one.

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
    peaks = np.flatnonzero((size > _JUMP) & (size == maximum_filter1d(size, 2 * _FEWEST + 1)))
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
    change = abs(float(wear.weights @ wear.level) * wear.sign - float(series.estimate[:_FEWEST].mean()))
    if not knows_temperature and change < abs(_per_kelvin(series.name)) * _UNKNOWN_TEMPERATURE_K:
        return f"a change of the temperature by {_UNKNOWN_TEMPERATURE_K:.0f} K would explain it"
    if abs(wear.mean_drift) < _CLEAR * wear.drift_std:
        return "chance alone may have moved it so far: the drift is below three of its standard deviations"
    z = _drift_change(series, wear)
    if abs(z) > _CHANGED:
        return f"the drift {'accelerates' if z > 0.0 else 'slows down'}: no law is known for it"
    return ""


def _drift_change(series: Series, wear: Degradation) -> float:
    """Drift of the second half since the onset, over that of the first, in standard deviations of their difference."""
    later = since(series, round(float(wear.weights @ wear.onset)))
    time = later.time - later.time[0]
    if len(time) < _FEWEST_STEPS:
        return 0.0
    white = _whitening(later, wear)
    # Level, drift of the first half, and by how much that of the second half is larger.
    design = white @ np.stack([np.ones(len(time)), time, np.maximum(time - 0.5 * time[-1], 0.0)], axis=1)
    change = np.linalg.pinv(design)[2]
    return float(wear.sign * change @ white @ later.estimate / np.linalg.norm(change))


def earliest(series: Series, wear: Degradation) -> float:
    """Time until the limit under the fastest exponential growth that the history does not exclude, at 95 %."""
    white, fits = _whitening(series, wear), []
    for tau in np.ptp(series.time) * np.geomspace(0.1, 10.0, 25):
        grown = np.exp((series.time - series.time[-1]) / tau)
        design = white @ np.stack([np.ones(len(grown)), grown], axis=1)
        (level, size), *_ = np.linalg.lstsq(design, white @ (wear.sign * series.estimate))
        left = white @ (wear.sign * series.estimate) - design @ [level, size]
        ratio = (wear.sign * wear.limit - level) / size if size > 0.0 else math.inf
        fits.append((float(left @ left), tau * math.log(max(ratio, 1.0))))
    least = min(fits)[0]
    return min((end for chi_square, end in fits if chi_square < least + _EXCLUDED), default=math.inf)


def _whitening(series: Series, wear: Degradation) -> FloatArray:
    """What makes the estimates about the drift white, by the wear's random part and their errors, shape (n, n)."""
    diffusion, scatter = float(wear.weights @ wear.diffusion), float(wear.weights @ wear.scatter)
    elapsed = series.time - series.time[0]
    walk = diffusion**2 * np.minimum.outer(elapsed, elapsed)
    covariance = walk + np.diag(series.standard_error**2 + scatter**2 + 1e-18)
    return np.linalg.inv(np.linalg.cholesky(covariance))
