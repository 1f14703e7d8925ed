"""Tables of the benchmarks, in Markdown, row by row as they come."""

from __future__ import annotations

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
        begin, end = f"<!-- begin {name} -->\n", f"<!-- end {name} -->"
        if text.count(begin) != 1 or text.count(end) != 1:
            raise ValueError(f"the page must have one place of the name {name}")
        before, rest = text.split(begin)
        text = f"{before}{begin}\n{content.strip()}\n\n{end}{rest.split(end)[1]}"
    return text
