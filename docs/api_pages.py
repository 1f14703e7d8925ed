"""Writes the pages of the API reference from the public names: `conf.py` does so when the site is built."""

import ast
import inspect
import re
from importlib import import_module
from itertools import groupby, pairwise
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

from environment_pages import table  # it lies beside this file

import motor_env

API = Path(__file__).parent / "api"
PACKAGES = ("motor_env", "motor_env.envs", "motor_datasets", "motor_classifiers")
API_HEAD = """# All public names

Each group has a page with an example, every argument and every method.
What is not listed here is private and may change.
"""


def stub_of(package: ModuleType) -> Path:
    """The file that lists a package's public names."""
    return Path(str(package.__file__)).with_suffix(".pyi")


def homes(stub: Path) -> dict[str, str]:
    """Public names and the modules, relative to the package, that define them."""
    tree = ast.parse(stub.read_text(encoding="utf-8"))
    imports = [node for node in tree.body if isinstance(node, ast.ImportFrom)]
    return {alias.name: str(node.module) for node in imports for alias in node.names}


def summary(package: ModuleType, name: str, home: str) -> str:
    """First sentence of what a name's docstring says; a constant's docstring is the string below it."""
    thing = getattr(package, name)
    text = (
        thing.__doc__
        if callable(thing)
        else constant_docstring(import_module(f"{package.__name__}.{home}"), name)
    )
    return " ".join((text or "").strip().split("\n\n")[0].split()).replace("|", "\\|")


def constant_docstring(module: ModuleType, name: str) -> str:
    """The string that stands below an assignment."""
    body = ast.parse(Path(str(module.__file__)).read_text(encoding="utf-8")).body
    for node, after in pairwise(body):
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        named = any(isinstance(target, ast.Name) and target.id == name for target in targets)
        if named and isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
            return str(after.value.value)
    return ""


class PublicName(NamedTuple):
    """A name that a user imports: where it is described, its path, what it stands for, and what is said of it."""

    page: str
    path: str
    thing: Any
    said: str


def public_names() -> list[PublicName]:
    """All of them, page by page."""
    listed = []
    for package in map(import_module, PACKAGES):
        for name, home in homes(stub_of(package)).items():
            room = home.split(".")[0] if package is motor_env else ""
            page, path = f"{package.__name__}.{room}".rstrip("."), f"{package.__name__}.{name}"
            listed.append(PublicName(page, path, getattr(package, name), summary(package, name, home)))
    return sorted(
        listed, key=lambda each: (not each.page.startswith("motor_env"), each.page, each.path.lower())
    )


def directive(each: PublicName, paths: dict[int, str]) -> str:
    """What makes autodoc describe one public name; `paths` has the path of each by its `id`."""
    if not isinstance(each.thing, type):
        return (
            f".. autofunction:: {each.path}\n"
            if callable(each.thing)
            else f".. py:data:: {each.path}\n\n   {each.said}\n"
        )
    ancestors = each.thing.__mro__[1:]
    above = {member for ancestor in ancestors for member in vars(ancestor)}
    hidden = sorted({*getattr(each.thing, "_fields", ()), *(above & set(vars(each.thing)))})
    hidden = [member for member in hidden if not member.startswith("_")]
    left_out = f"   :exclude-members: {', '.join(hidden)}\n" if hidden else ""
    base = next((paths[id(ancestor)] for ancestor in ancestors if id(ancestor) in paths), None)
    shared = f"\n   More methods: see `~{base}`.\n" if base else ""
    return f".. autoclass:: {each.path}\n   :members:\n{left_out}{shared}"


def api_pages() -> dict[str, str]:
    """A page for each room that has public names, and one that lists them all."""
    names = public_names()
    paths = {id(each.thing): each.path for each in names}
    pages, groups = {}, []
    for page, members in groupby(names, key=lambda each: each.page):
        of_page = list(members)
        body = "\n".join(
            [f".. automodule:: {page}\n   :no-members:\n", *(directive(each, paths) for each in of_page)]
        )
        pages[page] = f"# {page}\n\n```{{eval-rst}}\n{body}```\n"
        rows = [[f"{{py:obj}}`~{each.path}`", each.said] for each in of_page]
        purpose = re.split(r"\.\s", inspect.getdoc(import_module(page)) or "")[0]
        package = of_page[0].path.rpartition(".")[0]
        head = f"## [{page}]({page}.md)\n\n{purpose}. Import from `{package}`.\n"
        groups.append(f"{head}\n{table(['name', 'what it is'], rows)}\n")
    tree = "\n".join(["```{toctree}", ":hidden:", "", *pages, "```\n"])
    return pages | {"index": "\n".join([API_HEAD, *groups, tree])}


def write_pages() -> None:
    """Write all pages into docs/api."""
    API.mkdir(exist_ok=True)
    for old in API.iterdir():
        old.unlink()
    for module, text in api_pages().items():
        (API / f"{module}.md").write_text(text, encoding="utf-8")
