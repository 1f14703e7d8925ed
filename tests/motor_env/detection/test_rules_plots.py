"""Pictures show what they are given."""

import numpy as np

from motor_env import Cusum, ModelBank, nis_rule, plot_bank, plot_rules


def test_pictures_hold_thresholds_and_alarms() -> None:
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
    bank = plot_bank(time, ModelBank((1.0, -1.0)).probabilities(white, 1e-3), ("healthy", "up", "down"))
    assert len(bank.axes[0].collections) == 3
