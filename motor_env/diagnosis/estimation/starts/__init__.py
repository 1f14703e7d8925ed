"""Fits of single starts. Begin at `start_identification.identify`; `start_fit.StartFit` is its result."""
