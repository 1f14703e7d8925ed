"""How the code is laid out: small rooms, short argument lists, nothing written twice, one list of public names."""

import ast
import importlib
import importlib.util
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = [
    ROOT / "motor_env",
    ROOT / "datasets" / "motor_datasets",
    ROOT / "classifiers" / "motor_classifiers",
]
MODULES = sorted(file for package in PACKAGES for file in package.rglob("*.py"))
COMPILED = ("njit", "vectorize", "compiled", "inlined")


def site_pages() -> ModuleType:
    """The script docs/site_pages.py as a module."""
    spec = importlib.util.spec_from_file_location("site_pages", ROOT / "docs" / "site_pages.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def functions() -> Iterator[tuple[str, ast.FunctionDef | ast.AsyncFunctionDef]]:
    """Where each function stands, and its syntax."""
    for file in MODULES:
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                yield f"{file.relative_to(ROOT)}:{node.lineno} {node.name}", node


def is_compiled(node: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    """Whether Numba compiles it: its arguments are arrays and numbers, not objects that could carry them."""
    return any(word in ast.unparse(mark) for mark in node.decorator_list for word in COMPILED)


def test_no_folder_is_crowded() -> None:
    count: dict[Path, int] = defaultdict(int)
    for file in MODULES:
        count[file.parent] += not file.stem.startswith("__")
    assert {str(folder): n for folder, n in count.items() if n > 15} == {}
    top = [path.name for path in (ROOT / "motor_env").iterdir() if path.is_file()]
    assert len([name for name in top if name not in ("py.typed", "__init__.pyi")]) <= 8


def test_no_function_takes_more_than_five_positional_arguments() -> None:
    """Compiled kernels are exempt; the arguments of a constructor are named beyond the first two."""
    crowded = []
    for where, node in functions():
        if is_compiled(node):
            continue
        names = [each.arg for each in (*node.args.posonlyargs, *node.args.args)]
        own = [name for name in names if name not in ("self", "cls")]
        if len(own) > (2 if node.name == "__init__" else 5):
            crowded.append(where)
    assert crowded == []


def test_no_eight_lines_stand_twice() -> None:
    """No eight lines in a row; imports, docstrings and the argument lists of compiled kernels do not count."""
    places = defaultdict(list)
    for file in MODULES:
        tree = ast.parse(file.read_text(encoding="utf-8"))
        ignored = {
            line
            for node in ast.walk(tree)
            if isinstance(node, ast.Import | ast.ImportFrom)
            or (isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant))
            for line in range(node.lineno, (node.end_lineno or node.lineno) + 1)
        }
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef) and is_compiled(node):
                ignored.update(range(node.lineno, node.body[0].lineno))
        lines = [
            (number, line.strip())
            for number, line in enumerate(file.read_text(encoding="utf-8").splitlines(), 1)
            if line.strip() and not line.strip().startswith("#") and number not in ignored
        ]
        for first in range(len(lines) - 7):
            run = tuple(text for _, text in lines[first : first + 8])
            places[run].append(f"{file.relative_to(ROOT)}:{lines[first][0]}")
    assert [where for where in places.values() if len(where) > 1] == []


@pytest.mark.parametrize("name", site_pages().PACKAGES)
def test_public_names_exist_and_say_what_they_are(name: str) -> None:
    pages, package = site_pages(), importlib.import_module(name)
    listed = pages.homes(pages.stub_of(package))
    assert sorted(listed) == sorted(package.__all__)
    assert [each for each, home in listed.items() if not pages.summary(package, each, home)] == []
    with pytest.raises(AttributeError):
        _ = package.no_such_name


def test_every_public_name_can_be_imported_alone() -> None:
    code = "from motor_env import *; from motor_datasets import *; from motor_classifiers import *"
    subprocess.run([sys.executable, "-W", "error", "-c", code], check=True, timeout=120)
