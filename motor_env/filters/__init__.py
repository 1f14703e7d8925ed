"""Kalman filters: batch, stream, smoother, adaptive noise, joint state and parameters, consistency tests."""
