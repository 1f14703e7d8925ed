"""Lines and statements of Python by package, room, benchmarks and tests: `make lines`."""

from __future__ import annotations

import ast
from collections.abc import Iterable
from pathlib import Path

from tables import print_table

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("motor_env", "datasets/motor_datasets", "classifiers/motor_classifiers")
MUTANTS = "benchmarks/mutants.py"


def counts(files: Iterable[Path]) -> tuple[int, int]:
    """Lines, and nodes of the type `ast.stmt`."""
    texts = [path.read_text(encoding="utf-8") for path in files]
    statements = sum(isinstance(node, ast.stmt) for text in texts for node in ast.walk(ast.parse(text)))
    return sum(text.count("\n") for text in texts), statements


def parts() -> dict[str, list[Path]]:
    """Files by the name of their row: each package, its rooms, benchmarks and tests."""
    rows: dict[str, list[Path]] = {}
    for package in PACKAGES:
        top = ROOT / package
        rows[package] = sorted(top.rglob("*.py"))
        for path in rows[package]:
            room = path.relative_to(top).parts[:-1]
            depth = 2 if room[:1] == ("diagnosis",) else 1
            rows.setdefault("/".join((package, *room[:depth])) if room else f"{package}/*.py", []).append(
                path
            )
    rows["benchmarks without mutants.py"] = sorted({*(ROOT / "benchmarks").glob("*.py")} - {ROOT / MUTANTS})
    rows["examples"] = sorted((ROOT / "examples").rglob("*.py"))
    rows["tests"] = sorted((ROOT / "tests").rglob("*.py"))
    return rows


if __name__ == "__main__":
    counted = ((name, str(len(files)), *map(str, counts(files))) for name, files in parts().items())
    print_table("Python", ("part", "files", "lines", "statements"), counted)
