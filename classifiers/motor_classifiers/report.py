"""The benchmark's page: one self-contained HTML file."""

from __future__ import annotations

from typing import Any

import numpy as np

from motor_classifiers.benchmark import SIGNIFICANCE, BenchmarkResult, MethodResult
from motor_classifiers.charts import Bar, Trace, interval_chart, reliability_chart, trace_chart
from motor_classifiers.features import whitened_residual
from motor_classifiers.methods import METHODS
from motor_classifiers.metrics import Score
from motor_env.confirmation import nominal_voltage
from motor_env.faults import HEALTHY
from motor_env.parameters import Channel, FloatArray
from motor_env.simulation import simulate_states

_ALARM_RATE = 0.01  # of the thresholds drawn in the examples, for a transient of a motor known exactly
_SMOOTH = 50  # samples of the running mean in the examples


def readable(name: str) -> str:
    """A class name for people: bearing_10 becomes bearing 10 %."""
    stem, _, level = name.rpartition("_")
    return (
        f"{stem.replace('_', ' ')} {level} %" if level.replace(".", "").isdigit() else name.replace("_", " ")
    )


def _short(name: str) -> str:
    """A class name for narrow columns: B 10, WC 25."""
    stem, _, level = name.rpartition("_")
    if not level.replace(".", "").isdigit():
        return "ok" if name == HEALTHY else name[:3]
    return f"{''.join(word[0].upper() for word in stem.split('_'))} {level}"


def render_report(result: BenchmarkResult, machine: str) -> str:
    """The page as HTML.

    Args:
        result: of `run_benchmark`.
        machine: what it ran on, in words.
    """
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("motor_classifiers", "templates"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["share"] = _share
    recipe, options = result.options.recipe, result.options
    limit = result.limit.accuracy
    ranked = sorted(result.methods, key=lambda method: -method.scores.accuracy.value)
    return environment.get_template("report.html.j2").render(
        recipe=recipe,
        options=options,
        machine=machine,
        best=ranked[0],
        titles={name: method.title for name, method in METHODS.items()},
        families={name: method.family for name, method in METHODS.items()},
        methods=ranked,
        limit=result.limit,
        limit_expected=float(result.limit_probabilities.max(axis=1).mean()),
        limit_microseconds=result.limit_microseconds,
        limit_log_loss=result.limit_log_loss,
        leaks=result.leaks,
        significance=SIGNIFICANCE,
        noise_ma=1e3 * recipe.sensor.current_noise_a,
        short_titles=[_short(name) for name in recipe.class_names],
        class_titles=[readable(name) for name in recipe.class_names],
        accuracy_chart=interval_chart(
            [Bar(m.name, METHODS[m.name].family, *m.scores.accuracy) for m in ranked],
            limit.value,
            f"Bayes limit on these motors: {100.0 * limit.value:.1f} %",
        ),
        confusions=[_confusion(method) for method in ranked],
        reliability=[_reliability(result, method) for method in ranked],
        examples=_examples(result, ranked[0]),
        smooth_ms=1e3 * _SMOOTH * recipe.timing.dt_s,
        alarm_rate=_ALARM_RATE,
    )


def _share(score: Score, digits: int = 1) -> str:
    return "–" if np.isnan(score.value) else f"{100.0 * score.value:.{digits}f}"


def _confusion(method: MethodResult) -> dict[str, Any]:
    counts = method.scores.confusion
    totals = np.maximum(counts.sum(axis=1, keepdims=True), 1)
    return {"name": method.name, "counts": counts.tolist(), "shares": (100.0 * counts / totals).tolist()}


def _reliability(result: BenchmarkResult, method: MethodResult) -> dict[str, Any]:
    right = (method.decided == result.test.class_index).astype(np.float64)
    confidence = method.probabilities.max(axis=1)
    return {
        "name": method.name,
        "chart": reliability_chart(confidence, right),
        "confidence": float(confidence.mean()),
        "log_loss": method.log_loss,
    }


def running_mean(values: FloatArray, count: int) -> FloatArray:
    """Mean of the last `count` samples (of fewer at the begin), over the last axis."""
    total = np.cumsum(values, axis=-1)
    total[..., count:] = total[..., count:] - total[..., :-count].copy()
    lengths = np.minimum(np.arange(1, values.shape[-1] + 1), count)
    mean: FloatArray = total / lengths
    return mean


def _examples(result: BenchmarkResult, best: MethodResult) -> list[dict[str, Any]]:
    """One transient a class: measured current, and the filter's residual with a threshold."""
    recipe, test = result.options.recipe, result.test
    if Channel.CURRENT not in recipe.sensor.channels:
        return []
    column = recipe.sensor.channels.index(Channel.CURRENT)
    time_ms = 1e3 * recipe.timing.time_s
    nominal = simulate_states(recipe.motor, nominal_voltage(recipe), recipe.timing.dt_s)[:, 0]
    rows = [np.flatnonzero(test.class_index == n) for n in range(len(recipe.classes))]
    chosen = [(n, int(members[0])) for n, members in enumerate(rows) if len(members)]
    cases = test.X[[case for _, case in chosen]].astype(np.float64)
    n_channels = cases.shape[1]
    whitened = whitened_residual(recipe, cases).reshape(len(cases), -1, n_channels)[..., column]
    smooth = running_mean(whitened, _SMOOTH) * np.sqrt(
        np.minimum(np.arange(1, whitened.shape[1] + 1), _SMOOTH)
    )
    threshold = _threshold(recipe.timing.n_samples)
    reach = float(np.clip(1.1 * np.abs(smooth).max(), 2.0 * threshold, 16.0))
    top = 1.06 * float(max(nominal.max(), cases[:, column].max()))
    examples = []
    for row, (n, case) in enumerate(chosen):
        beyond = np.flatnonzero(np.abs(smooth[row]) > threshold)
        alarm_ms = float(time_ms[beyond[0]]) if len(beyond) else None
        examples.append(
            {
                "truth": readable(recipe.class_names[n]),
                "decided": readable(recipe.class_names[int(best.decided[case])]),
                "right": int(best.decided[case]) == n,
                "probability": float(best.probabilities[case].max()),
                "limit_probability": float(result.limit_probabilities[case, n]),
                "alarm_ms": alarm_ms,
                "current": trace_chart(
                    [Trace("measured", time_ms, cases[row, column]), Trace("nominal", time_ms, nominal)],
                    "A",
                    span=(min(-0.1, float(cases[:, column].min())), top),
                ),
                "level": trace_chart(
                    [
                        Trace("measured", time_ms, 1e3 * running_mean(cases[row, column], _SMOOTH)),
                        Trace("nominal", time_ms, 1e3 * running_mean(nominal, _SMOOTH)),
                    ],
                    "mA",
                    span=(0.0, 80.0),
                ),
                "residual": trace_chart(
                    [Trace("residual", time_ms, smooth[row])],
                    "σ",
                    span=(-reach, reach),
                    levels=(-threshold, threshold),
                    mark_ms=alarm_ms,
                    with_time=True,
                ),
            }
        )
    return examples


def _threshold(n_samples: int) -> float:
    """Two-sided normal quantile for the wanted rate, shared among the windows that do not overlap."""
    from scipy.stats import norm

    windows = max(1, n_samples // _SMOOTH)
    return float(norm.isf(0.5 * _ALARM_RATE / windows))
