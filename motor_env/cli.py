"""The command `motor-env`: parse, call, print. Each command loads what it needs when it runs."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from cyclopts import App

from motor_env import __version__, console

app = App(
    name="motor-env",
    help="A DC motor that may be failing: simulate, diagnose, reproduce the paper.",
    version=__version__,
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `motor-env` and return its exit status."""
    return console.run(app, arguments)


if __name__ == "__main__":
    sys.exit(main())
