"""Estimators: features, scikit-learn pipelines, torch networks, confirmation by thresholds."""
