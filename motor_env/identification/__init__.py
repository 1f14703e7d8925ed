"""A real motor's parameters, fitted to recorded starts.

Example:
    >>> from motor_env import identify
    >>> ((_, fit),) = identify("examples/startup_capture.csv").starts
    >>> print(f"the fit explains {fit.r2_current:.2%} of the current")
    the fit explains 99.81% of the current
"""
