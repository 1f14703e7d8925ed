"""Draws the picture of the rooms and their imports on the page of the design.

Run it as `python docs/make_pages.py` after a change of who imports whom.
"""

import tomllib
from pathlib import Path

import grimp

from motor_env.common.plotting import COLOUR, INK, QUIET, drawing, save, subplots

DOCS = Path(__file__).parent


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
    draw_rooms(DOCS / "images" / "rooms.svg")
