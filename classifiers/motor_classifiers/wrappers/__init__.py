"""Wrappers around an estimator: prediction sets, unknown faults, early verdicts."""
