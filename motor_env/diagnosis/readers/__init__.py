"""Recordings of real motors: tables read, columns recognised, time and level put right, starts cut out.

They never run what a file holds, and fit nothing. Begin at `recording.read_recording`.

Example:
    >>> from motor_env import read_recording
    >>> recording = read_recording("examples/startup_capture.csv")
    >>> print(f"{len(recording.current_a)} samples at {1 / recording.dt_s:.0f} Hz")
    3000 samples at 10000 Hz
"""
