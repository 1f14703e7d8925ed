"""Pictures show what they are given."""

import numpy as np

from motor_env.detection.rules import Cusum, ModelBank, nis_rule
from motor_env.detection.rules.plots import plot_bank, plot_delay_curves, plot_rules


def test_pictures_hold_thresholds_alarms_and_curves() -> None:
    white = np.random.default_rng(1).standard_normal((400, 1))
    white[200:] += 1.0
    time = np.arange(400) * 1e-4
    rules = {
        "CUSUM": (Cusum(1.0), Cusum(1.0).threshold_for(arl0=1e4)),
        "NIS": (nis_rule(), nis_rule().threshold_for(arl0=1e4)),
    }
    figure = plot_rules(time, white, rules, onset_s=0.02)
    assert len(figure.axes) == 3
    legend = figure.axes[1].get_legend()
    assert legend is not None
    assert "alarm at" in legend.get_texts()[0].get_text()
    curves = plot_delay_curves(1.0, {"NIS": nis_rule()}, arl0=(1e2, 1e4)).axes[0].get_lines()
    assert [line.get_label() for line in curves][1] == "NIS"
    assert abs(float(np.asarray(curves[0].get_ydata())[1]) - 15.1) < 0.1
    bank = plot_bank(time, ModelBank((1.0, -1.0)).probabilities(white, 1e-3), ("healthy", "up", "down"))
    assert len(bank.axes[0].collections) == 3
