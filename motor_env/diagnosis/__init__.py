"""Verdicts on recordings of real motors: `diagnose`, `commission` and `identify`.

The wing of real motors; the mission beside it never imports it. `readers` read files, `estimation` fits a motor,
`verdict` compares and decides, `operation` judges window by window; `streaming`, `fleet`, `prognosis` and `embedded`
stand on these. Begin at `diagnose.diagnose`: it checks the sensors, fits, decides and describes.

Example:
    >>> from motor_env import diagnose, load_motor, read_recording
    >>> result = diagnose(read_recording("examples/startup_capture.csv"), load_motor("examples/motor.toml"))
    >>> print(result.verdict, f"{result.severity:.0%}")
    bearing 31%
"""
