"""Judge motors of one make by each other: fit their records, learn the healthy population, compare each unit with it.

It never trusts a single motor: some of those that teach may be sick. Begin at `judging.diagnose_fleet`.

Example:
    >>> from pathlib import Path
    >>> from motor_env import diagnose_fleet
    >>> fleet = diagnose_fleet(sorted(Path("out/fleet").glob("*.csv")))  # doctest: +SKIP
    >>> print(fleet.units[0].unit_id.name, fleet.units[0].verdict)  # doctest: +SKIP
"""
