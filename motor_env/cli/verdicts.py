"""Commands that judge: recordings (`diagnose`, `trend`), and motors at work (`watch`, `export-c`)."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from motor_env.cli.options import (
    FLEET,
    READING,
    START,
    Duration,
    FleetOptions,
    Reading,
    StartMeasurement,
    refuse,
    show,
)
from motor_env.common import console
from motor_env.common.console import printable
from motor_env.common.errors import InputError


def watch(
    motor: Path,
    source: str | None = None,
    *,
    false_alarms_per_year: float = 1.0,
    state: Path | None = None,
    follow: bool = False,
    learn: Duration | None = None,
    window: Duration | None = None,
    steady: bool = False,
    columns: str | None = None,
    baud: console.Whole = 1_000_000,
) -> int:
    """Watch a motor at work: read lines of CSV as they come, and print a verdict at the end of each window.

    Example: motor-env watch out/motor.toml log.csv --follow --state out/watch.json

    On a terminal it shows a screen; otherwise it prints each event as a line of JSON. Exit status when the lines end
    or with Ctrl-C: 0 all healthy, 1 any fault, 2 input that cannot be used, 3 no fault, but a window could not be
    judged, or there was none.

    Args:
        motor: Motor file: for a log one that `commission` wrote from logs, or that --learn writes; for a folder any.
        source: A file, a folder of recordings, serial:/dev/ttyACM0, mqtt://host/topic; standard input without it.
        false_alarms_per_year: How many false alarms a year you accept of a healthy motor that always runs.
        state: File for the state of the watch, so that a new start continues after the last judged window.
        follow: Wait for new lines in the file, or in the one that replaces it; for new recordings in a folder.
        learn: If there is no motor file yet: how long to learn from the healthy motor first; seconds, or 10min.
        window: Length of a window for --learn: seconds, or 20s; a twentieth of --learn by default.
        steady: For --learn: load, temperature and offsets stay as they are, as on a test bench; only a fault changes
            the motor.
        columns: Names of the columns, such as time_s,voltage_v,current_a,speed_rad_s, if no line has them.
        baud: Baud rate of the serial port.
    """
    if source is not None and Path(source).is_dir():
        from motor_env.apps.folder import watch_folder

        refuse("a folder", state=state, learn=learn, columns=columns)
        return watch_folder(motor, Path(source), follow=follow)
    from motor_env.diagnosis.streaming.watch import LearningPhase, run

    return run(
        motor,
        source,
        false_alarms_per_year=false_alarms_per_year,
        state=state,
        follow=follow,
        baud=baud,
        columns=columns,
        learning=None if learn is None else LearningPhase(window or learn / 20.0, learn, steady=steady),
    )


def export_c(
    motor: str,
    *,
    out: Path,
    rate_hz: float,
    voltage: float | None = None,
    shift: float | None = None,
    false_alarms_per_year: float = 1.0,
    arithmetic: Literal["fixed", "float"] = "fixed",
    current_noise: float | None = None,
    speed_noise: float | None = None,
    current_count: float | None = None,
    speed_count: float | None = None,
    voltage_count: float | None = None,
    stuck_after: console.Whole = 100,
    name: str = "motor_monitor",
) -> int:
    """Write filter, rule and threshold of one motor as a C99 library, with CMake and Arduino files.

    Example: motor-env export-c examples/motor.toml --rate-hz 1000 --out out/motor_monitor

    Args:
        motor: Motor file (TOML), or the name of a catalogue motor.
        out: Folder of the library: new, empty, or written by export-c before.
        rate_hz: Samples a second.
        voltage: Level of the supply in volt; by default the motor's nominal voltage.
        shift: Look only for a lasting shift of this size, in standard deviations of a sample; by default for several.
        false_alarms_per_year: How many false alarms a year you accept of this motor, healthy and without load.
        arithmetic: fixed (whole numbers, for chips without a floating-point unit), or float.
        current_noise: Standard deviation of a current sample in ampere; by default that of the motor file.
        speed_noise: Standard deviation of a speed sample in rad/s; with it the library reads the speed, too.
        current_count: Ampere for one count of the converter; by default a suitable power of ten.
        speed_count: The same for the speed, in rad/s.
        voltage_count: The same for the voltage, in volt.
        stuck_after: How many equal readings in a row, with voltage on, mean a stuck sensor.
        name: Name of the library, and the first part of the names in it.
    """
    from motor_env.diagnosis.embedded.monitor import CusumBank, monitor_of, sensor_of
    from motor_env.diagnosis.embedded.source import write_library
    from motor_env.motor.data_sheet import load_motor, require_told

    known = load_motor(motor)
    require_told(known)
    monitor = monitor_of(
        known,
        rate_hz,
        rule=CusumBank() if shift is None else CusumBank((shift,), ()),
        sensor=sensor_of(known, current_noise, speed_noise),
        voltage_v=voltage if voltage is not None else known.nominal_voltage_v or 0.0,
        false_alarms_per_year=false_alarms_per_year,
        stuck_after=stuck_after,
    )
    counts = monitor.limits.counts(current_count, speed_count, voltage_count)
    wanted = f"{false_alarms_per_year:g} false alarms a year"
    for path in write_library(
        monitor, out, steps=counts if arithmetic == "fixed" else None, name=name, wanted=wanted
    ):
        print(printable(str(path)))
    return 0


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
    """Judge recordings: healthy, sensor, bearing, winding, magnet, noise, other, no_reference or unusable.

    Example: motor-env diagnose examples/startup_capture.csv --motor examples/motor.toml

    A recording holds starts, or a log of the motor at work, which is cut into windows. For a folder of starts the trend
    follows.

    With --fleet each file holds another motor of the same make, and each motor is judged by the others.

    Exit status: 0 all healthy, 1 any fault, 2 a file that cannot be read, 3 no fault but some undecided.

    Args:
        files: Recordings (CSV and other text, .mat, .h5, .npy, .npz, .parquet, .tdms, .xlsx) with time, current, and
            voltage, speed where measured, or folders of them; e.g. columns time_s, current_a, voltage_v, speed_rad_s.
        motor: Motor file (TOML), or the name of a catalogue motor.
        healthy: Recordings of the healthy motor to compare with, after the option: --healthy A.csv B.csv C.csv
        false_alarm_rate: How often a healthy recording may be called faulty.
        out: Folder for one HTML page per recording: the verdict, its reasons, and what to do first.
        measurement: How it was measured.
        temperature_c: Temperature of the motor; used if `commission` had one, too.
        regime: start, operation (a motor at work), or auto: decided by the voltage, and by the recordings of the
            commissioning.
        verbose: Print how well model and filter fit, too.
        json_: Print one array with one object per file, with --fleet per motor.
        fleet: Judge each motor by the others of its make, except those of its own machine.
        sisters: Which motors the files hold, with --fleet.
    """
    if fleet:
        beside = "--fleet, where sisters are the reference"
        refuse(beside, motor=motor, healthy=healthy, temperature_c=temperature_c)
        from motor_env.common.files import write_text
        from motor_env.diagnosis.fleet.judging import diagnose_fleet

        with sisters.fitted(files, measurement.of_fleet(regime)) as how:
            result = diagnose_fleet(files, false_alarm_rate=false_alarm_rate, **how)
        if out is not None:
            write_text(out / "fleet.html", result.page())
        show(json_, result.to_json, result.text)
        measurement.keep()
        return int(result.status)
    if sisters.group is not None:
        raise InputError("--group goes with --fleet")
    has_folder = any(path.is_dir() for path in files)
    with console.working("reading") as update:
        from motor_env.apps.folder import recordings_in, trend_of
        from motor_env.diagnosis.file_verdicts import diagnose_files

        outcomes = diagnose_files(
            recordings_in(files),
            motor=motor,
            healthy=healthy or (),
            false_alarm_rate=false_alarm_rate,
            out=out,
            periods_per_turn=measurement.ripple_periods_per_turn,
            temperature_c=temperature_c,
            regime=regime,
            **measurement.options,
            progress=lambda path: update(description=printable(f"diagnosing {path}")),
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
    if has_folder and not json_:
        chosen = measurement.chosen.options
        found = trend_of(outcomes, chosen["voltage_v"], columns=chosen["columns"])
        none = "no trend: fewer than three files hold one start that can be used"
        print(none if found is None else f"trends of the starts:\n{printable(found.text())}")
    measurement.keep()
    return int(console.worst(outcome.status for outcome in outcomes))


def trend(
    paths: list[Path],
    *,
    limit: list[str] | None = None,
    level: float = 0.9,
    voltage: float | None = None,
    reading: Reading = READING,
    date: Literal["name", "modified", "order"] = "name",
    reference_count: console.Whole = 3,
    out: Path = Path("out/trend.html"),
    json_: bool = False,
) -> int:
    """Find trends of a motor's quantities over its starts, and the time until a limit is reached.

    Example: motor-env trend recordings/ --limit B/J=1.5 --limit R=0.9,1.1

    Exit status: 0 no trend, 1 a trend to a limit, or a limit that is close or reached, 2 input that cannot be used.

    Args:
        paths: A table of estimates (CSV or JSON), or a folder of recordings whose names hold a date.
        limit: Limits as factors on the mean of the first estimates, QUANTITY=FACTOR[,FACTOR]; by default
            0.75,1.25, and none for L.
        level: Confidence level of the interval of the remaining life.
        voltage: Level of the supply in volt, for recordings without a voltage.
        reading: How the recordings are read.
        date: name (2026-01-31, 2026-01-31T11-00-14, Jan-31-2026_11-00-14), modified: the file's own date, or
            order: the order of the files, in a folder by name.
        reference_count: Number of first estimates whose mean is the reference.
        out: The page, one self-contained HTML file.
        json_: Print one array with one object per quantity.
    """
    from motor_env.common.files import write_text

    if out.exists() and out.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"{out}: is there, and is no page; give another --out")
    with console.working("reading") as update:
        from motor_env.diagnosis.prognosis.trend import parse_limits
        from motor_env.diagnosis.prognosis.trend_report import trend as trends_of

        chosen = reading.chosen
        result = trends_of(
            paths,
            parse_limits(limit or ()),
            level=level,
            voltage_v=voltage if voltage is not None else chosen.voltage,
            columns=chosen.options["columns"],
            date=date,
            reference_count=reference_count,
            progress=lambda path: update(description=printable(f"fitting {path}")),
        )
    write_text(out, result.page())
    for note in result.notes:
        print(f"motor-env: {note}", file=sys.stderr)
    show(json_, result.to_json, lambda: f"{result.text()}\n{out}")
    reading.keep()
    return int(result.verdict in ("reached", "trending", "close"))
