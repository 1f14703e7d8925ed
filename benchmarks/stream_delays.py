"""Delay of alarms at equal false alarms, on the task `stream`: `python benchmarks/stream_delays.py`.

Each rule has one threshold. Swept, it trades false alarms (in a healthy stream, or before the onset) for delay. The
streams are those of the task; its score weighs both by one price, the curves leave the price open.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from cyclopts import run
from matplotlib.figure import Figure
from tables import keep_table

from motor_classifiers.scoring.frozen_tasks import StreamTask, load_task
from motor_classifiers.scoring.metrics import resampling_weights
from motor_classifiers.scoring.score import score
from motor_env import Cusum, Glr, TolerantFilter
from motor_env.common.plotting import drawing, save
from motor_env.detection.rules.base import Rule, first_above
from motor_env.motor.parameters import FloatArray

RULES: dict[str, Rule] = {"CUSUM": Cusum(0.2), "CUSUM, larger shift": Cusum(0.5), "GLR": Glr(10, 700)}
SHARES = (0.01, 0.02, 0.05, 0.10)
N_LEVELS = 400
KEPT_CURVES = Path(__file__).parent / "results" / "stream_delays.json"
PICTURE = Path(__file__).parents[1] / "docs" / "images" / "stream_delays.svg"
DRAWN, TICKS = (0.005, 0.25), (0.5, 1, 2, 5, 10, 20)

Curves = dict[str, tuple[FloatArray, FloatArray]]
"""Thresholds, and what `judged` says at each, by rule."""


def alarm_times(task: StreamTask, statistic: FloatArray, threshold: float) -> FloatArray:
    """First time above a threshold, nan for none, shape (n,)."""
    timing, index = task.recipe.timing, first_above(statistic, threshold)
    return np.where(index < 0, np.nan, (index + 1 - timing.n_quiet) * timing.dt_s)


def judged(alarm_s: FloatArray, onset_s: FloatArray) -> tuple[float, float, float]:
    """Share of false alarms, mean delay of the right ones in seconds, and share of faults without one in time."""
    alarm = np.where(np.isnan(alarm_s), np.inf, alarm_s)
    onset = np.where(np.isnan(onset_s), np.inf, onset_s)
    false = alarm < onset
    faulty = np.isfinite(onset) & ~false
    right = faulty & np.isfinite(alarm)
    delay = float((alarm[right] - onset[right]).mean()) if right.any() else float("nan")
    return float(false.mean()), delay, float((faulty & ~right).sum() / max(faulty.sum(), 1))


def curve(task: StreamTask, rule: Rule) -> tuple[FloatArray, FloatArray]:
    """Thresholds, and what `judged` says at each, shape (n, 3)."""
    streams = task.test()
    statistic = rule.statistic(TolerantFilter.from_recipe(task.recipe).white(streams.X))
    levels = np.unique(np.quantile(statistic.max(axis=1), np.linspace(0.0, 0.999, N_LEVELS)))
    rows = [judged(alarm_times(task, statistic, level), streams.truth) for level in levels]
    return levels, np.array(rows)


def at_equal_false_alarms(task: StreamTask, curves: Curves) -> Iterable[list[str]]:
    """Delay and misses of each rule at the lowest threshold with at most so many false alarms, and its score there."""
    streams = task.test()
    weights = resampling_weights(len(streams.truth), task.seed)
    white = TolerantFilter.from_recipe(task.recipe).white(streams.X)
    for share in SHARES:
        for name, (levels, told) in curves.items():
            at = int(np.flatnonzero(told[:, 0] <= share)[0])
            alarms = alarm_times(task, RULES[name].statistic(white), float(levels[at]))[:, None]
            value = score(task, streams.truth, {name: alarms}, weights)[name].value
            yield [
                f"{100.0 * share:g} %", name, f"{1e3 * told[at, 1]:.0f} ms", f"{100.0 * told[at, 2]:.1f} %",
                f"{value.value:.2f} ({value.low:.2f} to {value.high:.2f})",
            ]  # fmt: skip


def drawn(curves: Curves) -> dict[str, list[list[float]]]:
    """What is drawn of the curves: share of false alarms, delay in seconds and share of faults without an alarm."""
    return {
        name: [[round(float(value), 5) for value in row] for row in told if DRAWN[0] <= row[0] <= DRAWN[1]]
        for name, (_, told) in curves.items()
    }


def draw(kept: dict[str, list[list[float]]], path: Path) -> None:
    """Delay of the right alarms, and faults without one, against the share of false alarms."""
    with drawing():
        figure = Figure(figsize=(9.0, 3.8), layout="constrained")
        delay, missed = figure.subplots(1, 2)
        for name, rows in kept.items():
            false, seconds, silent = np.array(rows).T
            delay.plot(100.0 * false, 1e3 * seconds, label=name)
            missed.plot(100.0 * false, 100.0 * silent)
        for axis, label in ((delay, "mean delay, ms"), (missed, "faults without an alarm in time, %")):
            axis.set(xscale="log", xlabel="streams with a false alarm, %", ylabel=label)
            axis.set_xticks(TICKS, [f"{tick:g}" for tick in TICKS])
            axis.set_ylim(bottom=0.0)
        figure.legend(loc="outside lower center", ncols=len(kept), frameon=False)
        save(figure, path)


def main() -> None:
    """Draw the curves, and write the table."""
    task = load_task("stream")
    assert isinstance(task, StreamTask)
    curves = {name: curve(task, rule) for name, rule in RULES.items()}
    kept = drawn(curves)
    KEPT_CURVES.write_text(json.dumps(kept) + "\n", encoding="utf-8")
    draw(kept, PICTURE)
    header = ("false alarms", "rule", "mean delay", "no alarm in time", "score of the task")
    keep_table("calibration", "stream", header, at_equal_false_alarms(task, curves))


if __name__ == "__main__":
    run(main)
