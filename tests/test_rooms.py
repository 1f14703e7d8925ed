"""How the code is laid out: small rooms, short argument lists, nothing written twice, one list of public names."""

import ast
import importlib
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = [ROOT / name for name in ("motor_env", "datasets/motor_datasets", "classifiers/motor_classifiers")]
MODULES = sorted(file for package in PACKAGES for file in package.rglob("*.py"))
FRONTS = ("motor_env", "motor_env.envs", "motor_datasets", "motor_classifiers")
"""Whose `__init__.pyi` lists what is public."""
SHARED = {
    "motor_classifiers.cli": "the command line",
    "motor_classifiers.cli.main": "the command line",
    "motor_datasets.cli": "the command line",
    "motor_env.cli": "the command line",
    "motor_env.common.console": "how every command ends",
    "motor_env.common.errors": "what every room raises",
    "motor_env.diagnosis.verdict.judgement": "what a Diagnosis is made of",
    "motor_env.motor.data_sheet": "what a Motor is made of",
    "motor_env.motor.faults": "what a Fault is made of",
    "motor_env.motor.healthy": "what a commissioned Motor holds",
    "motor_env.motor.model": "the equations that every room is compared with",
    "motor_env.motor.parameters": "the type of arrays, and constants of the paper's motor",
    "motor_env.diagnosis.estimation.parameter_index": "the order of the values in what healthy windows have taught",
    "motor_env.diagnosis.readers.recording": "what a recording is refused with",
    "motor_env.diagnosis.readers.start": "from a Recording to what `identify` takes; the documentation calls it",
    "motor_env.simulation.recipes": "what a Recipe is made of",
}
"""Inner modules that tests of every room may import, and why."""
IN_EVERY_FAMILY = {"kernel", "kernels", "options"}
"""Names that several modules of `motor_env` may have: each family has one."""
REACHES_IN = "# Reaches in: "
PAGES = importlib.import_module("api_pages")
COMPILED = ("njit", "vectorize", "compiled", "inlined")


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


def test_no_module_name_occurs_twice() -> None:
    places: dict[str, list[str]] = defaultdict(list)
    for file in MODULES:
        if file.is_relative_to(PACKAGES[0]) and not file.stem.startswith("__"):
            places[file.stem].append(str(file.relative_to(ROOT)))
    twice = {name: files for name, files in places.items() if len(files) > 1}
    assert {name: files for name, files in twice.items() if name not in IN_EVERY_FAMILY} == {}
    assert set(twice) == IN_EVERY_FAMILY


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
        text, ignored = file.read_text(encoding="utf-8"), set[int]()
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef) and is_compiled(node):
                ignored.update(range(node.lineno, node.body[0].lineno))
            elif isinstance(node, ast.Import | ast.ImportFrom) or (
                isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
            ):
                ignored.update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
        lines = [
            (number, line.strip())
            for number, line in enumerate(text.splitlines(), 1)
            if line.strip() and not line.strip().startswith("#") and number not in ignored
        ]
        for first in range(len(lines) - 7):
            run = tuple(line for _, line in lines[first : first + 8])
            places[run].append(f"{file.relative_to(ROOT)}:{lines[first][0]}")
    assert [where for where in places.values() if len(where) > 1] == []


@pytest.mark.parametrize("name", PAGES.PACKAGES)
def test_public_names_exist_and_say_what_they_are(name: str) -> None:
    package = importlib.import_module(name)
    listed = PAGES.homes(PAGES.stub_of(package))
    assert sorted(listed) == sorted(package.__all__)
    assert [each for each, home in listed.items() if not PAGES.summary(package, each, home)] == []
    with pytest.raises(AttributeError):
        _ = package.no_such_name


def test_every_public_name_can_be_imported_alone() -> None:
    code = "from motor_env import *; from motor_datasets import *; from motor_classifiers import *"
    subprocess.run([sys.executable, "-W", "error", "-c", code], check=True, timeout=120)


def is_module(name: str) -> bool:
    path = Path(*name.split("."))
    return any(package.parent.joinpath(path).with_suffix(".py") in MODULES for package in PACKAGES)


def imported(tree: ast.AST) -> Iterator[str]:
    """Our modules that a file imports; a module imported as a name out of its package counts as itself."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (each.name for each in node.names if each.name.startswith("motor_"))
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("motor_"):
            for each in node.names:
                inner = f"{node.module}.{each.name}"
                yield inner if is_module(inner) else str(node.module)


def room_of(module: str) -> str:
    parts = module.split(".")
    depth = 3 if parts[1:2] == ["diagnosis"] else 2
    while depth > 1 and is_module(".".join(parts[:depth])):
        depth -= 1
    return ".".join(parts[:depth])


def reaches(text: str, folder: tuple[str, ...]) -> set[str]:
    """Inner modules of other rooms than its own that a test imports; a room's tests lie in a folder of its name.

    A room is a package in one of the three, with all below it, or one of the wing `diagnosis`; modules beside the rooms
    belong to the package itself. Tests of the wing's own modules may open `verdict` and `operation`, too.
    """
    own, found = room_of(".".join(folder)), set()
    for module in imported(ast.parse(text)):
        if room_of(module) != own and module not in FRONTS and module not in SHARED:
            found.add(module)
    return found


def test_a_test_that_reaches_into_another_room_says_why() -> None:
    """And one that says so reaches in."""
    tests, wrong = ROOT / "tests", {}
    for file in sorted(tests.rglob("*.py")):
        text = file.read_text(encoding="utf-8")
        inner = reaches(text, file.relative_to(tests).parts[:-1])
        says_why = any(line.strip().startswith(REACHES_IN) for line in text.splitlines())
        if file != Path(__file__) and bool(inner) != says_why:
            wrong[str(file.relative_to(ROOT))] = sorted(inner)
    assert wrong == {}


def test_what_is_shared_is_there() -> None:
    assert [name for name in SHARED if not is_module(name) and not is_module(f"{name}.__init__")] == []
