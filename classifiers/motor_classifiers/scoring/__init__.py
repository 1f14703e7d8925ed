"""Scores, the limit beside them, the plan of a benchmark, and frozen tasks.

Begin at `benchmark`.
"""
