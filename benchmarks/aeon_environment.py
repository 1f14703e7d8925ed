"""Where aeon lives, and how a script is run there: one thread, an environment of its own."""

from __future__ import annotations

import os
from pathlib import Path

from run import FOLDER, ONE_THREAD

PYTHON = FOLDER.parent / ".venv-aeon" / "bin" / "python"


def command(script: str, *arguments: object) -> list[str]:
    """Command line of a script of this folder.

    Raises:
        FileNotFoundError: the environment is not there.
    """
    if not PYTHON.exists():
        raise FileNotFoundError(f"{PYTHON} is missing: `make peers` sets it up")
    return [str(PYTHON), str(Path(FOLDER) / script), *map(str, arguments)]


def environment() -> dict[str, str]:
    """Environment variables: one thread for everything."""
    return {**os.environ, **ONE_THREAD}
