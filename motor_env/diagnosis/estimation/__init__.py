"""A recorded motor's parameters: one physical model, fitted to a start, to logs of a motor at work, and to a window.

It never compares with a healthy motor. Begin at `operation_fit.identify_operation`, and `terms` for what can
be fitted; fits of starts lie in `starts`.

Example:
    >>> from motor_env import identify
    >>> ((_, fit),) = identify("examples/startup_capture.csv").starts
    >>> print(f"the fit explains {fit.r2_current:.2%} of the current")
    the fit explains 99.81% of the current
"""
