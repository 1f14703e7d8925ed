"""What a current probe adds to a start: hum of the mains, and what a capacitor lacks.

Both are linear in their sizes, so every residual of a fit leaves out what these shapes explain of it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from motor_env.diagnosis.estimation.problem import Solution
from motor_env.diagnosis.readers.noise import PeriodicLine, mains_lines, waves
from motor_env.diagnosis.readers.start import Start
from motor_env.motor.parameters import FloatArray


def shapes(start: Start) -> FloatArray:
    """Return the shapes of a start's hum and of the charge of its probe's capacitor, shape (n_samples, m)."""
    hum = waves(start.time_s, np.array([line.frequency_hz for line in start.hum]))
    return hum if start.coupling_per_s is None else np.column_stack([hum, -start.charge_a_s])


def with_sizes(start: Start, residual_a: FloatArray) -> Start:
    """Return a start with what a residual, shape (n_samples,), still has of the shapes."""
    counted, coupling = start.counted, start.coupling_per_s
    more = np.linalg.lstsq(shapes(start)[counted], residual_a[counted])[0].tolist()
    hum = tuple(
        PeriodicLine(line.frequency_hz, line.cosine_a + cosine, line.sine_a + sine)
        for line, cosine, sine in zip(start.hum, more[::2], more[1::2], strict=False)
    )
    return replace(start, hum=hum, coupling_per_s=None if coupling is None else coupling + more[-1])


def find_hum(best: Solution, time_s: FloatArray) -> tuple[PeriodicLine, ...]:
    """Find the hum that stands out of a start's residual, beside what the unknowns of its fit explain.

    Args:
        best: the fit.
        time_s: of its samples, shape (n,).
    """
    base, channels = best.problem.residuals(best.theta), int(best.problem.record.recorded.sum())
    slopes = best.problem.jacobian(best.theta, base)
    current = slice(0, len(time_s) * channels, channels)
    return mains_lines(base[current], time_s, slopes[current], best.free[1][:, 3])
