r"""Trends of a motor's quantities over many starts, and remaining life until a limit.

Begin at `trend_report.trend`.

Example:
    >>> from pathlib import Path
    >>> from motor_env import trend
    >>> days = [f"2026-01-{day:02d},{1 + 0.012 * day:.3f},0.01" for day in range(1, 21)]
    >>> _ = Path("estimates.csv").write_text("time,B,B_se\n" + "\n".join(days))
    >>> print(trend("estimates.csv").text().split(",")[0])
    B  trends to the limit at +25 %
"""
