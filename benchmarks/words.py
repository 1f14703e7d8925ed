"""Words of the documentation by page and by group: `make words`.

Prose is what is left of a page without code, tables, formulas and comments. A test holds pages by hand, and those below
*Results* in the navigation, to their limits.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable
from functools import cache
from pathlib import Path

from tables import print_table

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("motor_env", "datasets/motor_datasets", "classifiers/motor_classifiers")
BESIDE = ("README.md", "CONTRIBUTING.md", "SECURITY.md")
MADE = ("api", "environments")
LIMITS = {"by hand": 15_000, "results": 4_000}
APART = (
    *("fleet.md", "fleet-power.md", "trend.md", "remaining-life.md"),
    *("reference-scores.md", "calibrated-probabilities.md"),
)
"""Pages that are counted apart."""


def words(text: str) -> int:
    """Words that hold a letter or a digit."""
    return sum(bool(re.search(r"\w", each)) for each in text.split())


def parts_of(text: str) -> tuple[int, int, int]:
    """Words of prose, of tables and of code in a page of Markdown."""
    code = "\n".join(re.findall(r"^```.*?^```", text, re.M | re.S))
    text = re.sub(r"^---\n.*?\n---\n|^```.*?^```|<!--.*?-->|\$\$.*?\$\$", "", text, flags=re.M | re.S)
    tables = "\n".join(re.findall(r"^\|.*$", text, re.M))
    prose = re.sub(r"^\|.*$", "", text, flags=re.M)
    prose = re.sub(r"(!?)\[([^\]]*)\]\([^)]*\)", r"\2", prose)
    return words(prose), words(tables), words(code)


def group_of(page: Path) -> str:
    """The group that a page counts for."""
    if page.parent.name in MADE:
        return "made by commands"
    if page.name in APART:
        return "apart"
    if page.parent.name == "notebooks":
        return "notebooks"
    return "results" if page in results() else "by hand"


@cache
def results() -> frozenset[Path]:
    """Pages that the navigation lists below *Results*, with the pages below them."""
    return frozenset(_below(ROOT / "docs" / "index.md", r":caption: Results\n"))


def _below(page: Path, marked: str = "") -> list[Path]:
    text = page.read_text(encoding="utf-8")
    trees = re.findall(rf"^```\{{toctree\}}\n{marked}(.*?)^```", text, re.M | re.S)
    entries = [line for tree in trees for line in tree.splitlines() if line and not line.startswith(":")]
    pages = [(page.parent / f"{entry}.md").resolve() for entry in entries if "*" not in entry]
    return [*pages, *(deeper for each in pages for deeper in _below(each))]


def pages() -> list[Path]:
    """Pages that are written by hand, and those that a build of the site has left."""
    docs = ROOT / "docs"
    found = (page for page in docs.rglob("*.md") if page.relative_to(docs).parts[0] != "_build")
    return [*(ROOT / name for name in BESIDE), *sorted(found)]


def docstrings(files: Iterable[Path]) -> int:
    """Words of all docstrings, and of the strings below assignments."""
    nodes = (node for path in files for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
    values = (node.value for node in nodes if isinstance(node, ast.Expr))
    return sum(
        words(each.value) for each in values if isinstance(each, ast.Constant) and isinstance(each.value, str)
    )


def counted() -> dict[str, tuple[int, int, int]]:
    """Words of prose, tables and code by page."""
    return {str(page.relative_to(ROOT)): parts_of(page.read_text(encoding="utf-8")) for page in pages()}


def groups() -> dict[str, tuple[int, int, int]]:
    """Words of prose, tables and code by group of pages."""
    sums: dict[str, tuple[int, int, int]] = {}
    for name, each in counted().items():
        group = group_of(ROOT / name)
        first, second, third = sums.get(group, (0, 0, 0))
        sums[group] = (first + each[0], second + each[1], third + each[2])
    return sums


if __name__ == "__main__":
    head = ("prose", "tables", "code")
    print_table("Pages", ("page", *head), ((name, *map(str, each)) for name, each in counted().items()))
    print_table("Groups", ("group", *head), ((name, *map(str, each)) for name, each in groups().items()))
    said = ((package, str(docstrings((ROOT / package).rglob("*.py")))) for package in PACKAGES)
    print_table("Docstrings", ("package", "words"), said)
