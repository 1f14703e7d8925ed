"""Estimators: features, scikit-learn pipelines, torch networks, confirmation by thresholds.

Begin at `methods`.
"""
