"""What a current probe adds to a start: hum of the mains, and what a capacitor lacks.

Both are linear in their sizes, so every residual of a fit leaves out what these shapes explain of it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from motor_env.diagnosis.estimation.problem import Solution
from motor_env.diagnosis.readers.noise import (
    enlarged,
    fitted_lines,
    is_of_supply,
    mains_lines,
    total_current,
    waves,
)
from motor_env.diagnosis.readers.start import Start
from motor_env.motor.parameters import FloatArray


def shapes(start: Start) -> FloatArray:
    """Return the shapes of a start's hum and of its probe's charge, shape (n_samples, m)."""
    hum = waves(start.time_s, np.array([line.frequency_hz for line in start.hum])) * start.has_hum[:, None]
    return hum if start.coupling_per_s is None else np.column_stack([hum, -start.charge_a_s])


def with_sizes(start: Start, residual_a: FloatArray) -> Start:
    """Return a start with what a residual, shape (n_samples,), still has of the shapes."""
    more = np.linalg.lstsq(shapes(start)[start.counted], residual_a[start.counted])[0]
    coupling = None if start.coupling_per_s is None else start.coupling_per_s + float(more[-1])
    return replace(start, hum=enlarged(start.hum, more[: 2 * len(start.hum)]), coupling_per_s=coupling)


def with_hum(start: Start, best: Solution, residual_a: FloatArray) -> Start:
    """Return a start with the hum that stands out of its running motor's residual, about as large as it is.

    Args:
        start: without hum.
        best: its fit: what its unknowns explain is no hum.
        residual_a: of the fit, shape (n_samples,).
    """
    base, channels = best.problem.residuals(best.theta), int(best.problem.record.recorded.sum())
    n, begin, slopes = len(best.free[1]), start.alignment.onset_index, best.problem.jacobian(best.theta, base)
    running = slice(begin * channels, n * channels, channels)
    hum = mains_lines(base[running], start.time_s[begin:n], slopes[running], best.free[1][begin:, 3])
    hum = fitted_lines(hum, start.time_s[begin:], residual_a[begin:])
    rest = residual_a - total_current(hum, start.time_s)
    return replace(start, hum=hum, is_hum_of_supply=is_of_supply(hum, start.time_s, rest, begin))
