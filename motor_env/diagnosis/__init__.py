"""Verdicts on recordings of real motors: `diagnose`, `commission` and `identify`.

The wing of real motors; the mission beside it never imports it. Files are read in `readers`, a motor is fitted in
`estimation`, compared and judged in `verdict`, window by window in `operation`. Begin at `diagnose.diagnose`: it checks
the sensors, fits, decides and describes.

Example:
    >>> from motor_env import diagnose, load_motor, read_recording
    >>> result = diagnose(read_recording("examples/startup_capture.csv"), load_motor("examples/motor.toml"))
    >>> print(result.verdict, f"{result.severity:.0%}")
    bearing 31%
"""
