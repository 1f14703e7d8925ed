"""One start of each class for the benchmark's page: the current, the same near its level, the filter's residual."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.stats import norm

from motor_classifiers.estimators.features import whitened_residual
from motor_classifiers.report.charts import trace_chart
from motor_classifiers.report.names import readable
from motor_classifiers.scoring.score import ClassResult, Results
from motor_classifiers.scoring.task import TEST_FIRST_CASE, judged_cases
from motor_datasets.generate import generate_arrays
from motor_env.motor.parameters import Channel, FloatArray
from motor_env.simulation.simulate import simulate_states

ALARM_RATE = 0.01
"""False alarms at the thresholds drawn, in starts of a motor known exactly."""

SMOOTH = 50
"""Samples of the running mean at most, and a twentieth of the start."""


def running_mean(values: FloatArray, count: int) -> FloatArray:
    """Mean of the last `count` samples (of fewer at the begin), over the last axis."""
    total = np.cumsum(values, axis=-1)
    total[..., count:] = total[..., count:] - total[..., :-count].copy()
    mean: FloatArray = total / np.minimum(np.arange(1, values.shape[-1] + 1), count)
    return mean


def examples(result: Results, best: ClassResult) -> list[dict[str, Any]]:
    """The first test start of each class, drawn anew; empty without a current or a step of the supply."""
    recipe = result.task.recipe
    if Channel.CURRENT not in recipe.sensor.channels or recipe.duty is not None:
        return []
    column = recipe.sensor.channels.index(Channel.CURRENT)
    time_ms = 1e3 * recipe.timing.time_s
    nominal = simulate_states(recipe.motor, recipe.nominal_voltage_v, recipe.timing.dt_s)[:, 0]
    rows = [np.flatnonzero(result.truth == n) for n in range(len(recipe.classes))]
    chosen = [(n, int(members[0])) for n, members in enumerate(rows) if len(members)]
    numbers = judged_cases(recipe, TEST_FIRST_CASE, result.task.n_test)[[case for _, case in chosen]]
    cases = generate_arrays(recipe, result.task.seed, numbers).X.astype(np.float64)
    answer = best.answer
    smooth_over = min(SMOOTH, max(1, recipe.timing.n_samples // 20))
    n_channels = cases.shape[1]
    whitened = whitened_residual(recipe, cases).reshape(len(cases), -1, n_channels)[..., column]
    smooth = running_mean(whitened, smooth_over) * np.sqrt(
        np.minimum(np.arange(1, whitened.shape[1] + 1), smooth_over)
    )
    # Two-sided, and shared among the windows that do not overlap.
    windows = max(1, recipe.timing.n_samples // smooth_over)
    threshold = float(norm.isf(0.5 * ALARM_RATE / windows))
    reach = float(np.clip(1.1 * np.abs(smooth).max(), 2.0 * threshold, 16.0))
    top = 1.06 * float(max(nominal.max(), cases[:, column].max()))
    drawn = []
    for row, (n, case) in enumerate(chosen):
        beyond = np.flatnonzero(np.abs(smooth[row]) > threshold)
        alarm_ms = float(time_ms[beyond[0]]) if len(beyond) else None
        curves = {"measured": cases[row, column], "nominal": nominal}
        level = {style: 1e3 * running_mean(curve, smooth_over) for style, curve in curves.items()}
        drawn.append(
            {
                "smooth_ms": 1e3 * smooth_over * recipe.timing.dt_s,
                "truth": readable(recipe.class_names[n]),
                "decided": readable(recipe.class_names[answer.decided[case]]),
                "right": answer.decided[case] == n,
                "probability": answer.probabilities[case].max(),
                "limit_probability": result.limit.answer.probabilities[case, n],
                "current": trace_chart(
                    time_ms, curves, "A", span=(min(-0.1, float(cases[:, column].min())), top)
                ),
                "level": trace_chart(time_ms, level, "mA", span=(0.0, 80.0)),
                "residual": trace_chart(
                    time_ms,
                    {"residual": smooth[row]},
                    "σ",
                    span=(-reach, reach),
                    levels=(-threshold, threshold),
                    mark_ms=alarm_ms,
                    with_time=True,
                ),
            }
        )
    return drawn
