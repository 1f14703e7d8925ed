"""Wrappers around an estimator: prediction sets, unknown starts, early verdicts.

They never change its answers, only what is said of them. Begin at `conformal`.
"""
