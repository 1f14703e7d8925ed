"""Trained models as files, without pickle."""
