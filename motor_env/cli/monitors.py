"""Commands for a motor at work: `watch` here, `export-c` on its own controller."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from motor_env.cli.options import Duration
from motor_env.common import console
from motor_env.common.console import printable


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
    """Watch a motor at work: lines of CSV come in, a verdict on each window goes out as it ends.

    Example: motor-env watch out/motor.toml log.csv --follow --state out/watch.json

    On a terminal a screen is kept up to date; otherwise each event is a line of JSON. Exit status when the lines end or
    with Ctrl-C: 0 all healthy, 1 any fault, 2 input that cannot be used, 3 no fault but a window that cannot be judged,
    or none that was.

    Args:
        motor: Motor file that `commission` wrote from logs, or that --learn writes.
        source: A file, serial:/dev/ttyACM0, mqtt://host/topic; standard input without it.
        false_alarms_per_year: Of a healthy motor that always runs.
        state: File that keeps what was seen of this motor and source, so that a new start goes on where the last
            window ended.
        follow: Wait for lines that are appended to the file, or to the one that takes its place.
        learn: Where there is no motor file yet: so long the motor is healthy, and is learned from; seconds, or 10min.
        window: Length of a window for --learn, in seconds, or 20s; a twentieth of it by default.
        steady: For --learn: only a fault moves this motor. Load, temperature and offsets stay, as on a test bench.
        columns: Names of the columns, such as time_s,voltage_v,current_a,speed_rad_s, where no line says them.
        baud: Of the serial port.
    """
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
    """Filter, rule and threshold for one motor as a C99 library for its controller, with CMake and Arduino files.

    Example: motor-env export-c examples/motor.toml --rate-hz 1000 --out out/motor_monitor

    Args:
        motor: Motor file (TOML), or the name of a catalogue motor.
        out: Folder of the library: a new or empty one, or one that export-c made.
        rate_hz: Samples a second.
        voltage: Level of the supply in volt; by default the motor's nominal voltage.
        shift: The only lasting shift that it looks for, in standard deviations of a sample; by default several.
        false_alarms_per_year: Of this motor, healthy, exactly known and without load.
        arithmetic: fixed (whole numbers, for chips without a floating-point unit), or float.
        current_noise: Standard deviation of a current sample in ampere; by default that of the motor file.
        speed_noise: Standard deviation of a speed sample in rad/s; speed is read where this is given.
        current_count: What one count of a whole-number reading is worth, in ampere; by default a suitable power of ten.
        speed_count: The same of the speed, in rad/s.
        voltage_count: The same of the voltage, in volt.
        stuck_after: So many equal readings in a row, while voltage is on, are a stuck sensor.
        name: Of the library, and the first part of the names in it.
    """
    from motor_env.diagnosis.embedded.monitor import CusumBank, monitor_of, sensor_of
    from motor_env.diagnosis.embedded.source import write_library
    from motor_env.motor.data_sheet import load_motor

    known = load_motor(motor)
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
