"""Tables of the benchmarks, in Markdown, row by row as they come."""

from __future__ import annotations

from collections.abc import Iterable


def print_table(title: str, header: Iterable[str], rows: Iterable[Iterable[str]]) -> None:
    """Print a title, the header, and each row as soon as it is known."""
    names = list(header)
    print(f"\n## {title}\n\n| {' | '.join(names)} |\n|{'---|' * len(names)}")
    for row in rows:
        print(f"| {' | '.join(row)} |", flush=True)
