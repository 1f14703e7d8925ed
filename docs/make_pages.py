"""Draws the picture of the rooms and their imports on the page of the design.

Run it as `python docs/make_pages.py` after a change of who imports whom.
"""

import tomllib
from pathlib import Path

import grimp

from motor_env.common.plotting import COLOUR, INK, QUIET, drawing, save, subplots

DOCS = Path(__file__).parent


def layers(container: str) -> list[list[str]]:
    """The rooms of a package from top to bottom, as its import contract in pyproject.toml names them."""
    settings = tomllib.loads((DOCS.parent / "pyproject.toml").read_text(encoding="utf-8"))
    contracts = settings["tool"]["importlinter"]["contracts"]
    (contract,) = [each for each in contracts if each.get("containers") == [container]]
    rows = [[f"{container}.{room.strip()}" for room in row.split("|")] for row in contract["layers"]]
    return [row for row in rows if row != ["motor_env.__main__"]]


def arrows(rooms: set[str]) -> set[tuple[str, str]]:
    """Imports of one room by another, without those that follow from a chain of others."""
    graph = grimp.build_graph("motor_env")
    direct: dict[str, set[str]] = {room: set() for room in rooms}
    for importer in graph.modules:
        for imported in graph.find_modules_directly_imported_by(importer):
            upper, lower = room_of(importer, rooms), room_of(imported, rooms)
            if upper != lower and upper and lower:
                direct[upper].add(lower)

    def below(room: str) -> set[str]:
        return direct[room].union(*(below(lower) for lower in direct[room]))

    return {
        (upper, lower)
        for upper in rooms
        for lower in direct[upper]
        if not any(lower in below(other) for other in direct[upper])
    }


def room_of(module: str, rooms: set[str]) -> str:
    """The room that a module lies in; empty for a front."""
    parts = module.split(".")
    heads = (".".join(parts[:n]) for n in (3, 2))
    return next((head for head in heads if head in rooms), "")


def draw_rooms(path: Path) -> None:
    """Two wings side by side, one row a layer; an arrow from the room that imports to the one that is imported."""
    top, both, bottom = layers("motor_env"), "motor_env.diagnosis", "motor_env.common"
    mission = [[room for room in row if room not in (both, bottom)] for row in top]
    mission = [row for row in mission if row and row[0] not in ("motor_env.cli", "motor_env.apps")]
    wing = layers(both)
    places = {"motor_env.cli": (0.5, 10.0), "motor_env.apps": (0.5, 9.0), bottom: (0.22, 0.0)}
    for rows, centre, width in ((mission, 0.22, 0.3), (wing, 0.72, 0.5)):
        for depth, row in enumerate(rows):
            for column, room in enumerate(row):
                x = centre + width * ((column + 0.5) / len(row) - 0.5)
                places[room] = (x, 7.5 - depth * 6.5 / max(len(rows) - 1, 1))
    with drawing():
        figure, (axes,) = subplots(width_in=7.5, height_in=6.5)
        for upper, lower in sorted(arrows(set(places))):
            (x0, y0), (x1, y1) = places[upper], places[lower]
            line = {"arrowstyle": "->", "color": QUIET, "shrinkA": 10, "shrinkB": 12, "alpha": 0.8}
            axes.annotate("", (x1, y1), (x0, y0), arrowprops=line)
        for room, (x, y) in places.items():
            box = {"boxstyle": "round,pad=0.35", "facecolor": "white", "edgecolor": COLOUR["healthy"]}
            name = room.rpartition(".")[2]
            axes.text(x, y, name, ha="center", va="center", color=INK, fontsize=10, bbox=box)
        for x, title in ((0.22, "simulated motors"), (0.72, "recordings of real motors")):
            axes.text(x, 8.3, title, ha="center", va="center", color=QUIET, fontsize=11, fontstyle="italic")
        axes.set(xlim=(0, 1), ylim=(-0.5, 10.5))
        axes.set_axis_off()
        save(figure, path)


if __name__ == "__main__":
    draw_rooms(DOCS / "images" / "rooms.svg")
