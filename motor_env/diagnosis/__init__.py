"""Verdicts on recordings of real motors: `diagnose`, `commission` and `identify`.

It fits nothing itself and reads no files' columns: `motor_env.fitting` and `motor_env.recordings` do. Begin with
`diagnose.py`: sensors are checked (`sensors`), a start is fitted, compared (`hypotheses.py`), decided on
(`decision.py`) and described (`report`).

Example:
    >>> from motor_env import diagnose, load_motor, read_recording
    >>> result = diagnose(read_recording("examples/startup_capture.csv"), load_motor("examples/motor.toml"))
    >>> print(result.verdict, f"{result.severity:.0%}")
    bearing 31%
"""
