"""The command `motor-env`: parse, call, print. Each command loads what it needs when it runs."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from motor_env import __version__, console

app = App(
    name="motor-env",
    help="A DC motor that may be failing: simulate, diagnose, reproduce the paper.",
    version=__version__,
)


@app.command
def reproduce(
    *,
    out: Path,
    image_format: str = "svg",
    json_: Annotated[bool, Parameter(name="--json", negative=())] = False,
) -> int:
    """Write the source paper's figures, its numbers beside ours, and where it is wrong.

    Example: motor-env reproduce --out out/paper

    Args:
        out: Folder for index.html, paper.md, reproduce.json and images/. One with files of others is refused.
        image_format: svg or png.
        json_: Print what stands in reproduce.json.
    """
    from rich.console import Console

    from motor_env import reproduce as paper

    with Console(stderr=True).status("computing the paper's numbers") as status:
        result = paper.reproduce(
            out, image_format=image_format, progress=lambda figure: status.update(f"drawing {figure.name}")
        )
    if json_:
        print(json.dumps(result, ensure_ascii=False))
    else:
        print(f"{len(result['figures'])} figures and {len(result['numbers'])} numbers: {out / 'index.html'}")
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `motor-env` and return its exit status."""
    return console.run(app, arguments)


if __name__ == "__main__":
    sys.exit(main())
