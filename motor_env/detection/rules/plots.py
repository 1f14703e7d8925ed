"""Pictures of rules at work: residual and statistic with threshold and alarm, delay curves, posterior of a bank."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from motor_env.detection.rules.base import Rule, first_above
from motor_env.detection.rules.cusum import Cusum
from motor_env.detection.rules.thresholds import Threshold
from motor_env.motor.parameters import FloatArray


def plot_rules(
    time_s: ArrayLike,
    whitened: ArrayLike,
    rules: Mapping[str, tuple[Rule, Threshold]],
    onset_s: float | None = None,
) -> Figure:
    """Whitened residual of one transient, and each rule's statistic and threshold, on one time axis (Shewhart 1931).

    Args:
        time_s: shape (n_samples,).
        whitened: shape (n_samples, n_channels).
        rules: by name, each with its threshold.
        onset_s: true onset of the fault, if it is to be drawn.
    """
    time, values = 1e3 * np.asarray(time_s), np.asarray(whitened)
    figure = Figure(figsize=(8.0, 2.0 + 1.4 * len(rules)), layout="constrained")
    axes = figure.subplots(1 + len(rules), 1, sharex=True)
    axes[0].plot(time, values, linewidth=0.6)
    axes[0].set_ylabel("residual\n(white)")
    for axis, (name, (rule, threshold)) in zip(axes[1:], rules.items(), strict=True):
        statistic = rule.statistic(values)
        axis.plot(time, statistic, linewidth=0.9)
        axis.axhline(threshold.value, color="tab:red", linestyle="--", linewidth=1.0)
        alarm = int(first_above(statistic, threshold.value))
        if alarm >= 0:
            axis.plot(
                time[alarm], statistic[alarm], "o", color="tab:red", label=f"alarm at {time[alarm]:.1f} ms"
            )
            axis.legend(loc="upper left", frameon=False)
        axis.set_ylabel(name)
    if onset_s is not None:
        for axis in axes:
            axis.axvline(1e3 * onset_s, color="0.4", linestyle=":", linewidth=1.0)
    axes[-1].set_xlabel("time / ms")
    return figure


def plot_delay_curves(
    shift: float,
    rules: Mapping[str, Rule],
    arl0: Sequence[float] = (1e2, 3e2, 1e3, 3e3, 1e4, 3e4),
) -> Figure:
    """Delay of rules against their ARL0, beside the exact one of the matched CUSUM and the asymptote.

    The matched CUSUM has the least possible worst case (Moustakides 1986); ln(ARL0) / KL is drawn as the asymptote
    that it is (Lorden 1971). Delays are from an onset at the start of the rule.

    Args:
        shift: of the mean, in standard deviations of the innovation.
        rules: by name; exact where theory gives it, else simulated.
        arl0: average samples between false alarms.
    """
    figure = Figure(figsize=(9.0, 4.5), layout="constrained")
    axis = figure.subplots()
    for name, rule in {"CUSUM, true shift (least worst case)": Cusum(shift), **rules}.items():
        delays = [rule.average_run_length(rule.threshold_for(arl0=wanted).value, shift) for wanted in arl0]
        axis.plot(
            arl0, delays, marker="o", markersize=3.0, linewidth=1.5 if name in rules else 3.0, label=name
        )
    axis.plot(
        arl0,
        2.0 * np.log(arl0) / shift**2,
        color="0.5",
        linestyle=":",
        label="asymptote ln(ARL0) / KL, no bound",
    )
    axis.set_xscale("log")
    axis.set_yscale("log")
    axis.set_xlabel("samples between false alarms, ARL0")
    axis.set_ylabel(f"delay in samples, shift of {shift:g} sigma")
    figure.legend(loc="outside right upper", frameon=False, fontsize="small")
    return figure


def plot_bank(time_s: ArrayLike, probabilities: FloatArray, names: Sequence[str]) -> Figure:
    """Posterior of a bank over time (Magill 1965), as `ModelBank.probabilities` gives it for one transient.

    Args:
        time_s: shape (n_samples,).
        probabilities: shape (n_samples, 1 + n_models), health first.
        names: of health and the models.
    """
    figure = Figure(figsize=(8.0, 3.0), layout="constrained")
    axis = figure.subplots()
    axis.stackplot(1e3 * np.asarray(time_s), probabilities.T, labels=names, alpha=0.8)
    axis.set_xlabel("time / ms")
    axis.set_ylabel("probability")
    axis.set_ylim(0.0, 1.0)
    axis.margins(x=0.0)
    figure.legend(loc="outside upper center", ncols=len(names), frameon=False)
    return figure
