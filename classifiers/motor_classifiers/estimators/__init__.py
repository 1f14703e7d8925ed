"""Estimators: features, scikit-learn pipelines, torch networks, confirmation by thresholds.

They never see a label outside `fit`. Begin at `methods`.
"""
