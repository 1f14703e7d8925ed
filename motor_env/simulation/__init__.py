"""Simulated motors: the transients of a recipe, with supply, sensors, disturbances and random numbers."""
