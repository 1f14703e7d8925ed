"""Tables of the benchmarks in Markdown: printed row by row, and kept for the pages of the documentation."""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

KEPT = Path(__file__).resolve().parent / "results" / "tables"


def print_table(title: str, header: Iterable[str], rows: Iterable[Iterable[str]]) -> None:
    """Print a title, the header, and each row as soon as it is known."""
    names = list(header)
    print(f"\n## {title}\n\n| {' | '.join(names)} |\n|{'---|' * len(names)}")
    for row in rows:
        print(f"| {' | '.join(row)} |", flush=True)


def table(header: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """A table in Markdown."""
    names = list(header)
    lines = [f"| {' | '.join(cells)} |" for cells in rows]
    return "\n".join([f"| {' | '.join(names)} |", f"|{'---|' * len(names)}", *lines])


def kept_tables(page: str) -> dict[str, dict[str, Any]]:
    """Tables of docs/results/PAGE.md, or docs/PAGE.md, by the name of their place: header, rows, command."""
    path = KEPT / f"{page}.json"
    tables: dict[str, dict[str, Any]] = json.loads(path.read_bytes()) if path.is_file() else {}
    return tables


def keep_table(page: str, name: str, header: Iterable[str], rows: Iterable[Iterable[str]]) -> None:
    """Print a table and keep it; `python benchmarks/result_tables.py` writes it into docs/results/PAGE.md."""
    names, seen = list(header), []

    def each() -> Iterable[Iterable[str]]:
        for row in rows:
            seen.append(list(row))
            yield seen[-1]

    print_table(name, names, each())
    command = shlex.join(["python", f"benchmarks/{Path(sys.argv[0]).name}", *sys.argv[1:]])
    tables = kept_tables(page) | {name: {"command": command, "header": names, "rows": seen}}
    KEPT.mkdir(exist_ok=True)
    (KEPT / f"{page}.json").write_text(
        json.dumps(tables, indent=1, ensure_ascii=False) + "\n", encoding="utf-8"
    )


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
