"""A recorded motor's parameters: one physical model, fitted to a start and to a motor at work; windows of work judged.

It never compares with a healthy motor. Begin at `operation_fit.identify_operation`, and `terms` for its terms.

Example:
    >>> from motor_env import identify
    >>> ((_, fit),) = identify("examples/startup_capture.csv").starts
    >>> print(f"the fit explains {fit.r2_current:.2%} of the current")
    the fit explains 99.81% of the current
"""
