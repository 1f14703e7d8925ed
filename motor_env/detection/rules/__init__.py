"""Decision rules: alarms on residuals, at a chosen rate of false alarms.

Each rule has `statistic(whitened)`, `alarm_index(whitened, threshold)`, `stream()` with `update(sample)`, and
`threshold_for(arl0=...)`, `threshold_for(false_alarm_probability=..., n_samples=...)` or
`threshold_for(false_alarm_probability=..., recipe=...)`. They read `FilterResult.whitened` or `TolerantFilter.white`:
rules on the NIS all channels, others the first.
"""

from motor_env.detection.rules.base import Rule, RuleStream, first_above
from motor_env.detection.rules.calibration import Threshold, recipe_thresholds, run_lengths
from motor_env.detection.rules.cusum import Cusum, ModelBank, ShiryaevRoberts, Sprt
from motor_env.detection.rules.tolerant import TolerantFilter
from motor_env.detection.rules.windowed import Glr, MOfN, WindowedNis, in_a_row, nis_rule

__all__ = [
    "Cusum",
    "Glr",
    "MOfN",
    "ModelBank",
    "Rule",
    "RuleStream",
    "ShiryaevRoberts",
    "Sprt",
    "Threshold",
    "TolerantFilter",
    "WindowedNis",
    "first_above",
    "in_a_row",
    "nis_rule",
    "recipe_thresholds",
    "run_lengths",
]
