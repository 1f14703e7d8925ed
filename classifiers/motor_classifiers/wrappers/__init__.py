"""Wrappers around an estimator: prediction sets, unknown starts, early verdicts.

They never change the estimator that they are given. Begin at `conformal`.
"""
