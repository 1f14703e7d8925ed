"""Trained models as files.

Nothing is ever unpickled. Begin at `persistence`.
"""
