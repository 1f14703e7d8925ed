"""Motors of one make judged by each other: learning from sisters, of which some are sick, and the table of a fleet.

Example:
    >>> from pathlib import Path
    >>> from motor_env import diagnose_fleet
    >>> fleet = diagnose_fleet(sorted(Path("out/fleet").glob("*.csv")))  # doctest: +SKIP
    >>> print(fleet.sisters[0].name, fleet.sisters[0].verdict)  # doctest: +SKIP
"""
