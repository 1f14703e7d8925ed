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


@app.command
def diagnose(
    files: list[Path],
    *,
    motor: str | None = None,
    healthy: Annotated[list[Path] | None, Parameter(consume_multiple=True, negative=())] = None,
    voltage: float | None = None,
    false_alarm_rate: float = 0.01,
    out: Path | None = None,
    json_: Annotated[bool, Parameter(name="--json", negative=())] = False,
) -> int:
    """Verdict on recorded starts: healthy, bearing, winding, noise, other, no_reference or unusable.

    Example: motor-env diagnose examples/startup_capture.csv --motor examples/motor.toml

    Exit status: 0 all healthy, 1 any fault, 2 a file that cannot be read, 3 no fault but some undecided.

    Args:
        files: CSV recordings with the columns time_s, current_a, and voltage_v, speed_rad_s where measured.
        motor: Motor file (TOML), or the name of a catalogue motor.
        healthy: Recordings of the healthy motor to compare with, after the option: --healthy A.csv B.csv C.csv
        voltage: Level of the supply in volt, for recordings without a voltage.
        false_alarm_rate: How often a healthy recording may be called faulty.
        out: Folder for one picture a file.
        json_: Print one array with one object a file.
    """
    from rich.console import Console

    from motor_env import diagnosis_report as report
    from motor_env.diagnosis_files import diagnose_files

    with Console(stderr=True).status("reading") as status:
        outcomes = diagnose_files(
            files,
            motor=motor,
            healthy=healthy or (),
            voltage_v=voltage,
            false_alarm_rate=false_alarm_rate,
            out=out,
            progress=lambda path: status.update(f"diagnosing {path}"),
        )
    for outcome in outcomes:
        if outcome.error is not None:
            print(f"motor-env: {outcome.error}", file=sys.stderr)
    if json_:
        print(json.dumps([outcome.as_json() for outcome in outcomes], ensure_ascii=False, indent=1))
    else:
        for outcome in outcomes:
            if outcome.diagnosis is not None:
                print(report.as_text(outcome.diagnosis))
    diagnoses = [outcome.diagnosis for outcome in outcomes if outcome.diagnosis is not None]
    return report.exit_status(diagnoses, unreadable=len(diagnoses) < len(outcomes))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `motor-env` and return its exit status."""
    return console.run(app, arguments)


if __name__ == "__main__":
    sys.exit(main())
