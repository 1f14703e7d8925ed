"""The command `motor-env`: parse, call, print. Each command loads what it needs when it runs."""

from __future__ import annotations

import os
from collections.abc import Sequence

from cyclopts import App

from motor_env import __version__
from motor_env.cli import motors, programs, verdicts
from motor_env.common import console

app = App(
    name="motor-env",
    help="A DC motor that may be failing: simulate, diagnose, reproduce the paper.",
    version=__version__,
)
for _command in (
    verdicts.diagnose,
    verdicts.trend,
    motors.identify,
    motors.commission,
    verdicts.watch,
    verdicts.export_c,
    programs.reproduce,
    programs.lab,
    programs.examples,
    programs.offline,
    programs.warm_up,
):
    app.command(_command)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `motor-env` and return its exit status."""
    # Before SciPy is imported: the matrices are small, and threads that wait for each other cost a tenth of a command.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    return console.run(app, arguments)
