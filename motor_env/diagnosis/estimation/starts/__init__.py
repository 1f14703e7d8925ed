"""Fits of single starts."""
