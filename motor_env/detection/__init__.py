"""Decision rules on residuals, and their run lengths.

A rule takes the whitened residuals of a filter (of a motor known up to its tolerances: `rules.tolerant`). Begin at
`rules.cusum`, and `run_length` for its threshold.

Example:
    How high must a CUSUM's threshold be for one false alarm in a thousand healthy starts of 1,000 samples, and how long
    does it take to see a shift of one standard deviation?

    >>> from motor_env import Cusum
    >>> rule = Cusum(shift=1.0)
    >>> threshold = rule.threshold_for(false_alarm_probability=0.001, n_samples=1000)
    >>> print(f"{threshold.value:.1f}, {rule.average_run_length(threshold.value, shift=1.0):.0f} samples")
    11.9, 24 samples
"""
