"""The verdict on a recording: what a healthy motor is like, what is off, which fault that is, and the report.

It never reads a file, and fits by `estimation` alone. Begin at `decision.decide`.
"""
