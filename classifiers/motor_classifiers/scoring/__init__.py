"""Scores, the limit beside them, the plan of a benchmark, and frozen tasks.

It never trains on what it scores. Begin at `benchmark`.
"""
