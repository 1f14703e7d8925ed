"""Simulated motors: the transients of a recipe, with supply, sensors, disturbances and random numbers.

The truth that it returns is for scoring alone. Begin at `simulate.simulate`.

Example:
    Three starts of one motor with a bad contact; case n has the same noise whatever else is simulated.

    >>> from motor_env import PAPER_MOTOR, Fault, Scenario, simulate
    >>> starts = simulate(Scenario(PAPER_MOTOR, (Fault("winding_contact", 0.25),)), seed=1, cases=[0, 1, 2])
    >>> print(starts.measurements.shape, f"peak {starts.measurements.max():.2f} A")
    (3, 1, 1000) peak 4.20 A
"""
