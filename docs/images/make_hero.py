"""Draws the README's picture: start-up currents, and the residual under which a fault is confirmed.

Run it as `python docs/images/make_hero.py`; it writes hero.png beside itself. Motors, noise and seed are simulated with
motor_env; the threshold is solved for 1 % false alarms in a healthy transient.
"""

from pathlib import Path

import numpy as np
from scipy.stats import norm

from motor_env import Fault, FaultKind, KalmanFilter, Scenario, run_filter, simulate
from motor_env.common.plotting import COLOUR, INK, drawing, end_label, save, subplots
from motor_env.motor.parameters import PAPER_MOTOR, FloatArray

SEED = 7
WINDOW = 50
FALSE_ALARM_RATE = 0.01


def residual_means(scenario: Scenario, cases: list[int]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Time (ms), measured currents, and the filter's whitened residual averaged over windows, in its own sd."""
    transients = simulate(scenario, SEED, cases)
    belief = KalmanFilter.from_parameters(PAPER_MOTOR, scenario.sensor, scenario.timing.dt_s)
    whitened = run_filter(belief, transients.measurements, transients.voltage_v).whitened[..., 0]
    means = whitened.reshape(len(cases), -1, WINDOW).mean(axis=-1) * np.sqrt(WINDOW)
    return 1e3 * transients.time_s, transients.measurements[:, 0], means


def main(path: Path) -> None:
    """Write the picture."""
    motors = (
        ("healthy", "healthy", ()),
        ("bearing", "bearing +25 %", (Fault(FaultKind.BEARING, 0.25),)),
        ("winding_contact", "winding +25 %", (Fault(FaultKind.WINDING_CONTACT, 0.25),)),
    )
    n_windows = Scenario(PAPER_MOTOR).timing.n_samples // WINDOW
    # Two windows in a row beyond the threshold confirm: for p a window, about n p^2 false alarms a transient.
    threshold = float(norm.isf(np.sqrt(FALSE_ALARM_RATE / (n_windows - 1)) / 2.0))
    with drawing():
        figure, (top, bottom) = subplots(2, width_in=9.0, height_in=5.6, height_ratios=(1, 1.1))
        for case, (colour, label, faults) in enumerate(motors):
            time_ms, current, means = residual_means(Scenario(PAPER_MOTOR, faults=faults), [case])
            top.plot(time_ms, current[0], color=COLOUR[colour], linewidth=1.6, label=label)
            window_ms = time_ms.reshape(-1, WINDOW)[:, -1]
            size = np.abs(means[0])
            bottom.plot(window_ms, size, "-", color=COLOUR[colour], linewidth=1.8, marker="o", markersize=4)
            beyond = size > threshold
            confirmed = np.flatnonzero(beyond[1:] & beyond[:-1]) + 1
            if confirmed.size:
                first = int(confirmed[0])
                bottom.plot(
                    window_ms[first], size[first], "o", color=COLOUR[colour], markersize=13, alpha=0.35
                )
                bottom.annotate(
                    f"{label.split()[0]} confirmed at {window_ms[first]:.0f} ms",
                    (window_ms[first], size[first]),
                    xytext=(window_ms[first] + 4.0, 60.0 if colour == "winding_contact" else 9.0),
                    arrowprops={"arrowstyle": "-", "color": COLOUR[colour]},
                    bbox={"facecolor": "white", "edgecolor": "none", "pad": 2.0},
                    color=COLOUR[colour],
                    fontsize=12,
                    fontweight="bold",
                )
        top.set(title="Start-up of a 12 V motor, measured with 20 mA of noise", ylabel="current (A)")
        top.legend(loc="upper right", fontsize=12)
        bottom.axhline(threshold, color=INK, linestyle="--", linewidth=1.3)
        end_label(bottom, 100.0, threshold, "threshold", INK)
        bottom.set(
            title="Residual of a Kalman filter that believes the motor is healthy",
            ylabel="|mean of 5 ms| (sd)",
            xlabel="time after the step (ms)",
            yscale="symlog",
            xlim=(0.0, 100.0),
            ylim=(0.0, None),
        )
        save(figure, path)


if __name__ == "__main__":
    main(Path(__file__).with_name("hero.png"))
