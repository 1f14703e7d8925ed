"""Commands that judge recordings: `diagnose` and `trend`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from motor_env.cli.options import FLEET, READING, START, FleetOptions, Reading, StartMeasurement, refuse, show
from motor_env.common import console
from motor_env.common.console import printable
from motor_env.common.errors import InputError


def diagnose(
    files: list[Path],
    *,
    motor: str | None = None,
    healthy: Annotated[list[Path] | None, Parameter(consume_multiple=True)] = None,
    false_alarm_rate: float = 0.01,
    out: Path | None = None,
    measurement: StartMeasurement = START,
    temperature_c: float | None = None,
    regime: str = "auto",
    verbose: bool = False,
    json_: bool = False,
    fleet: bool = False,
    sisters: FleetOptions = FLEET,
) -> int:
    """Verdict on recordings: healthy, sensor, bearing, winding, magnet, noise, other, no_reference or unusable.

    Example: motor-env diagnose examples/startup_capture.csv --motor examples/motor.toml

    A recording is one start, several, or a log of the motor at work, which is judged by windows.

    With --fleet each file is of another motor of the same make, and each motor is judged by the others.

    Exit status: 0 all healthy, 1 any fault, 2 a file that cannot be read, 3 no fault but some undecided.

    Args:
        files: Recordings (CSV and other text, .mat, .h5, .npy, .npz, .parquet, .xlsx) with time, current, and voltage,
            speed where measured; e.g. columns time_s, current_a, voltage_v, speed_rad_s.
        motor: Motor file (TOML), or the name of a catalogue motor.
        healthy: Recordings of the healthy motor to compare with, after the option: --healthy A.csv B.csv C.csv
        false_alarm_rate: How often a healthy recording may be called faulty.
        out: Folder for one HTML page a recording: verdict, what to do first, and what it rests on.
        measurement: How it was measured.
        temperature_c: Temperature of the motor; it counts where `commission` was told one too.
        regime: start, operation (a motor at work), or auto: decided by what the voltage does, and by what the motor was
            commissioned on.
        verbose: Print how well model and filter fit, too.
        json_: Print one array with one object a file, with --fleet one a motor.
        fleet: Judge each motor by its sisters. Those of its own machine do not count.
        sisters: Which motors the files are of, with --fleet.
    """
    if fleet:
        beside = "--fleet, where sisters are the reference"
        refuse(beside, motor=motor, healthy=healthy, temperature_c=temperature_c)
        from motor_env.common.files import write_text
        from motor_env.diagnosis.fleet.judging import diagnose_fleet

        with sisters.fitted(files, measurement.of_fleet(regime)) as how:
            found = diagnose_fleet(files, false_alarm_rate=false_alarm_rate, **how)
        if out is not None:
            write_text(out / "fleet.html", found.page())
        show(json_, found.to_json, found.text)
        measurement.keep()
        return int(found.status)
    if sisters.group is not None:
        raise InputError("--group goes with --fleet")
    from motor_env.diagnosis.batch import diagnose_files

    with console.working("reading") as say:
        outcomes = diagnose_files(
            files,
            motor=motor,
            healthy=healthy or (),
            false_alarm_rate=false_alarm_rate,
            out=out,
            periods_per_turn=measurement.ripple_periods_per_turn,
            temperature_c=temperature_c,
            regime=regime,
            **measurement.options,
            progress=lambda path: say(f"diagnosing {path}"),
        )
    for outcome in outcomes:
        if outcome.error is not None:
            print(f"motor-env: {printable(outcome.error)}", file=sys.stderr)
    judged = [outcome.diagnosis for outcome in outcomes if outcome.diagnosis is not None]
    if json_ or judged:
        show(
            json_,
            lambda: [o.as_json() for o in outcomes],
            lambda: "\n".join(one.text(verbose=verbose) for one in judged),
        )
    measurement.keep()
    return int(console.worst(outcome.status for outcome in outcomes))


def trend(
    paths: list[Path],
    *,
    limit: list[str] | None = None,
    level: float = 0.9,
    voltage: float | None = None,
    reading: Reading = READING,
    date: Literal["name", "modified"] = "name",
    reference_count: console.Whole = 3,
    out: Path = Path("out/trend.html"),
    json_: bool = False,
) -> int:
    """Trends of a motor's quantities over its starts, and the time to a limit where there is a trend.

    Example: motor-env trend recordings/ --limit B/J=1.5 --limit R=0.9,1.1

    Exit status: 0 no trend, 1 a limit is reached, trended to or close, 2 input that cannot be used.

    Args:
        paths: A table of estimates (CSV or JSON), or a folder of recordings whose names hold a date.
        limit: Limits as factors on the mean of the first estimates, QUANTITY=FACTOR[,FACTOR]; by default
            0.75,1.25, and none of L.
        level: Probability that the interval of the remaining life holds.
        voltage: Level of the supply in volt, for recordings without a voltage.
        reading: How the recordings are read.
        date: name (2026-01-31, 2026-01-31T11-00-14, Jan-31-2026_11-00-14), or modified: the file's own date.
        reference_count: Number of first estimates whose mean is the reference.
        out: The page, one self-contained HTML file.
        json_: Print one array with one object a quantity.
    """
    from motor_env.common.files import write_text
    from motor_env.diagnosis.prognosis.files import trend as trends_of
    from motor_env.diagnosis.prognosis.trend import parse_limits

    chosen = reading.chosen
    with console.working("reading") as say:
        found = trends_of(
            paths,
            parse_limits(limit or ()),
            level=level,
            voltage_v=voltage if voltage is not None else chosen.voltage,
            columns=chosen.options["columns"],
            date=date,
            reference_count=reference_count,
            progress=lambda path: say(f"fitting {path}"),
        )
    write_text(out, found.page())
    for note in found.notes:
        print(f"motor-env: {note}", file=sys.stderr)
    show(json_, found.to_json, lambda: f"{found.text()}\n{out}")
    reading.keep()
    return int(found.verdict in ("reached", "trending", "close"))
