"""The verdict on a recording: commissioning of the healthy motor, decision, report and pictures.

Example:
    >>> from motor_env import diagnose, load_motor, read_recording
    >>> result = diagnose(read_recording("examples/startup_capture.csv"), load_motor("examples/motor.toml"))
    >>> print(result.verdict, f"{result.severity:.0%}")
    bearing 31%
"""
