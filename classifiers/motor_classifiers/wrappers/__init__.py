"""Wrappers around an estimator: prediction sets, unknown starts, early verdicts.

Begin at `conformal`.
"""
