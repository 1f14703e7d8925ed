"""Writes what the documentation derives from the code: api.md, and the picture of the rooms and their imports.

Run it as `python docs/make_pages.py` after a change of what is public or of who imports whom. A test compares api.md.
"""

import ast
import itertools
import tomllib
from importlib import import_module
from pathlib import Path
from types import ModuleType

import grimp

from motor_env.plotting import COLOUR, INK, QUIET, drawing, save, subplots

DOCS = Path(__file__).parent
PACKAGES = ("motor_env", "motor_env.envs", "motor_datasets", "motor_classifiers")
HEAD = """# Public names

What a user imports. Everything is loaded when it is first used; what is not listed here is private and may change.
The site has a page for each group, with an example and every argument; `help(motor_env.filters)` shows the same.
The lists are the files `__init__.pyi` of the packages; `python docs/make_pages.py` writes this page from them.
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
    for node, after in itertools.pairwise(body):
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        named = any(isinstance(target, ast.Name) and target.id == name for target in targets)
        if named and isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
            return str(after.value.value)
    return ""


def api_page() -> str:
    """The page that lists every public name."""
    parts = [HEAD]
    for package in map(import_module, PACKAGES):
        rows = sorted(homes(stub_of(package)).items(), key=lambda item: (item[1], item[0].lower()))
        lines = [f"| `{name}` | {summary(package, name, home)} | `{home}` |" for name, home in rows]
        table = ["| name | what it is | module |", "|---|---|---|", *lines]
        parts.append(f"## `{package.__name__}`\n\n" + "\n".join(table) + "\n")
    return "\n".join(parts)


def layers() -> list[list[str]]:
    """The rooms of motor_env from top to bottom, as the import contract in pyproject.toml names them."""
    settings = tomllib.loads((DOCS.parent / "pyproject.toml").read_text(encoding="utf-8"))
    contracts = settings["tool"]["importlinter"]["contracts"]
    (contract,) = [each for each in contracts if each.get("containers") == ["motor_env"]]
    rows = [[room.strip() for room in row.split("|")] for row in contract["layers"]]
    return [row for row in rows if row != ["__main__"]]


def arrows(rooms: set[str]) -> set[tuple[str, str]]:
    """Imports of one room by another, without those that follow from a chain of others."""
    graph = grimp.build_graph("motor_env")
    direct: dict[str, set[str]] = {room: set() for room in rooms}
    for importer in graph.modules - {"motor_env"}:
        for imported in graph.find_modules_directly_imported_by(importer) - {"motor_env"}:
            upper, lower = importer.split(".")[1], imported.split(".")[1]
            if upper != lower and upper in rooms:
                direct[upper].add(lower)

    def below(room: str) -> set[str]:
        return direct[room].union(*(below(lower) for lower in direct[room]))

    return {
        (upper, lower)
        for upper in rooms
        for lower in direct[upper]
        if not any(lower in below(other) for other in direct[upper])
    }


def draw_rooms(path: Path) -> None:
    """Rooms as boxes, one row a layer; an arrow from the room that imports to the one that is imported."""
    rows = layers()
    places = {
        room: ((column + 0.5) / len(row), len(rows) - depth)
        for depth, row in enumerate(rows)
        for column, room in enumerate(row)
    }
    with drawing():
        figure, (axes,) = subplots(width_in=6.5, height_in=6.5)
        for upper, lower in sorted(arrows(set(places))):
            (x0, y0), (x1, y1) = places[upper], places[lower]
            bend = 0.25 if x0 == x1 and y0 - y1 > 1 else 0.0
            line = {"arrowstyle": "->", "color": QUIET, "connectionstyle": f"arc3,rad={bend}"}
            axes.annotate("", (x1, y1 + 0.27), (x0, y0 - 0.27), arrowprops=line)
        for room, (x, y) in places.items():
            box = {"boxstyle": "round,pad=0.4", "facecolor": "white", "edgecolor": COLOUR["healthy"]}
            axes.text(x, y, room, ha="center", va="center", color=INK, fontsize=11, bbox=box)
        axes.set(xlim=(0, 1), ylim=(0.4, len(rows) + 0.6))
        axes.set_axis_off()
        save(figure, path)


if __name__ == "__main__":
    (DOCS / "api.md").write_text(api_page(), encoding="utf-8")
    draw_rooms(DOCS / "images" / "rooms.svg")
