"""Scores, the limit beside them, and the plan of a benchmark."""
