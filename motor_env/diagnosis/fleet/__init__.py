"""Judge motors of one make by each other: fit their records, learn the healthy population, compare each unit with it.

Some of the motors may be faulty. Begin at `judging.diagnose_fleet`.

Example:
    >>> from pathlib import Path
    >>> from motor_env import diagnose_fleet
    >>> fleet = diagnose_fleet(sorted(Path("out/fleet").glob("*.csv")))  # doctest: +SKIP
    >>> print(fleet.units[0].unit_id.name, fleet.units[0].verdict)  # doctest: +SKIP
"""
