"""Wear over many starts: trend, remaining life, simulated runs to failure."""
