"""Tables of the benchmarks, in Markdown, row by row as they come."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping


def print_table(title: str, header: Iterable[str], rows: Iterable[Iterable[str]]) -> None:
    """Print a title, the header, and each row as soon as it is known."""
    names = list(header)
    print(f"\n## {title}\n\n| {' | '.join(names)} |\n|{'---|' * len(names)}")
    for row in rows:
        print(f"| {' | '.join(row)} |", flush=True)


def marked(text: str, parts: Mapping[str, str]) -> str:
    """A page with what stands between `<!-- begin NAME -->` and `<!-- end NAME -->` made anew.

    Raises:
        ValueError: the page has no such place.
    """
    for name, content in parts.items():
        place = re.compile(rf"(<!-- begin {name} -->\n).*?(<!-- end {name} -->)", re.DOTALL)
        text, count = place.subn(lambda found, new=content: f"{found[1]}\n{new.strip()}\n\n{found[2]}", text)
        if count != 1:
            raise ValueError(f"the page has {count} places of the name {name}")
    return text
