"""Pictures of rules: residual and statistic with threshold and alarm, and the posterior of a bank."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from motor_env.common.arrays import instance, number, numbers
from motor_env.detection.rules.base import Rule, first_above
from motor_env.detection.rules.calibration import Threshold
from motor_env.motor.parameters import FloatArray


def plot_rules(
    time_s: ArrayLike,
    whitened: ArrayLike,
    rules: Mapping[str, tuple[Rule, Threshold]],
    onset_s: float | None = None,
) -> Figure:
    """Plot a transient's whitened residual and each rule's statistic and threshold on one time axis.

    `time_s` has shape (n_samples,), `whitened` (n_samples, n_channels); `onset_s` is drawn if given.
    """
    instance("rules", rules, Mapping)
    values = numbers("whitened", whitened, ("n_samples", "n_channels"), missing=True)
    time = 1e3 * numbers("time_s", time_s, (len(values),))
    onset_s = None if onset_s is None else number("onset_s", onset_s)
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


def plot_bank(time_s: ArrayLike, probabilities: FloatArray, names: Sequence[str]) -> Figure:
    """Plot the posterior of a bank over time, `ModelBank.probabilities` of one transient.

    `time_s` has shape (n_samples,), `probabilities` (n_samples, 1 + n_models), health first.
    """
    shares = numbers("probabilities", probabilities, ("n_samples", len(names)))
    time = 1e3 * numbers("time_s", time_s, (len(shares),))
    figure = Figure(figsize=(8.0, 3.0), layout="constrained")
    axis = figure.subplots()
    axis.stackplot(time, shares.T, labels=names, alpha=0.8)
    axis.set_xlabel("time / ms")
    axis.set_ylabel("probability")
    axis.set_ylim(0.0, 1.0)
    axis.margins(x=0.0)
    figure.legend(loc="outside upper center", ncols=len(names), frameon=False)
    return figure
