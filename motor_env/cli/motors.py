"""Commands that learn a motor from its recordings: `identify` and `commission`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from motor_env.cli import options
from motor_env.common.console import ExitStatus, printable, working
from motor_env.common.errors import InputError
from motor_env.common.files import write_text

if TYPE_CHECKING:
    from motor_env.diagnosis.fleet.fits import Reading


def identify(
    files: list[Path],
    *,
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
    out: Path | None = None,
    measurement: options.StartMeasurement = options.START,
    torque_constant: float | None = None,
    name: str = "identified motor",
    regime: str = "auto",
    motor: Path | None = None,
    json_: bool = False,
) -> int:
    """Estimate the parameters of a motor from recorded starts or logs, with the model that fits them best.

    Example: motor-env identify examples/startup_capture.csv -o out/motor.toml

    Logs of a motor at work (reversals, several levels, fast switching) are identified jointly. Exit status 3: no
    motor explains one of the starts, or the logs.

    Args:
        files: Recordings of one motor.
        output: Motor file to write (TOML).
        out: Folder for a page of the fits.
        measurement: How it was measured.
        torque_constant: In N m/A, if you know it and the speed was not recorded: the current does not determine it.
        name: Name of the motor in that file.
        regime: start, operation, or auto: decided by the voltage.
        motor: Motor file of `commission --fleet`: the other motors of its make supply what the recordings leave open.
        json_: Print one array with one object per start, and one for all logs of a motor at work.
    """
    if output is not None:
        _require_motor_file(output)
    if motor is not None:
        options.refuse("--motor", torque_constant=torque_constant, out=out)
        return _identify_with_fleet(files, motor, output, measurement, regime=regime, name=name, json_=json_)
    with working(f"fitting {_recordings(files, '')}"):
        from motor_env.diagnosis.identification import identify as fitted
        from motor_env.motor.data_sheet import save_motor

        result = fitted(
            files,
            **measurement.options,
            regime=regime,
            constant=torque_constant,
            periods_per_turn=measurement.ripple_periods_per_turn,
        )
    if output is not None and (result.logs or result.usable):
        identified = result.motor(name)
        _report_moved(output)
        save_motor(identified, output)
    if out is not None:
        write_text(out / "identify.html", result.page())
    options.show(json_, result.to_json, result.text)
    measurement.keep()
    return int(ExitStatus.HEALTHY if result.is_complete else ExitStatus.UNDECIDED)


def _identify_with_fleet(
    files: list[Path],
    motor: Path,
    output: Path | None,
    measurement: options.StartMeasurement,
    *,
    regime: str,
    name: str,
    json_: bool,
) -> int:
    """Run `identify` with a fleet's motor file as the prior."""
    with working(f"fitting {_recordings(files, '')}"):
        from motor_env.diagnosis.fleet.learning import unit_quantities, update_unit
        from motor_env.motor.data_sheet import load_motor, save_motor

        result = update_unit(files, load_motor(motor), name, reading=measurement.of_fleet(regime))
    rows = unit_quantities(result)
    if output is not None:
        _report_moved(output)
        save_motor(result, output)
    lines = [
        f"{_recordings(files, '')} beside the sisters of {motor}; 95 % intervals",
        *(
            f"  {quantity:<12} {row['value']:11.4g} {row['unit']:<12}"
            f" {row['interval'][0]:.4g} to {row['interval'][1]:.4g}"
            for quantity, row in rows.items()
        ),
    ]
    options.show(
        json_,
        lambda: [{"files": [str(path) for path in files], "motor": str(motor), "parameters": rows}],
        lambda: "\n".join(lines),
    )
    measurement.keep()
    return 0


def _recordings(files: list[Path], word: str) -> str:
    return f"{len(files)} {word}recording{'s' * (len(files) != 1)}"


def commission(
    files: list[Path],
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    false_alarm_rate: float = 0.01,
    out: Path | None = None,
    measurement: options.Measurement = options.MEASUREMENT,
    temperature_c: float | None = None,
    regime: str = "auto",
    window: float | None = None,
    steady: bool = False,
    torque_constant: float | None = None,
    no_load_current: float | None = None,
    name: str = "commissioned motor",
    fleet: bool = False,
    motor: Path | None = None,
    sisters: options.FleetOptions = options.FLEET,
) -> int:
    """Learn a motor from three or more healthy starts, or from logs of it at work, for `motor-env diagnose --motor`.

    Example: motor-env commission healthy_1.csv healthy_2.csv healthy_3.csv -o out/motor.toml

    With --fleet the recordings are of motors of the same make (sisters), of which some may be faulty.

    Args:
        files: Healthy recordings of one motor: all starts, of which a file may hold several, or all logs.
        output: Motor file to write (TOML).
        false_alarm_rate: Rate of false alarms for the printed intervals.
        out: Folder for a page: the spread of each quantity, and starts with their fits and residuals.
        measurement: How they were measured.
        temperature_c: Temperature of the motor in these recordings, if you know it.
        regime: start, operation (a motor at work), or auto: decided by the voltage.
        window: Length in seconds of the windows into which logs are cut; a twentieth of all logs by default.
        steady: For logs: load, temperature and offsets stay as they are, as on a test bench; only a fault changes the
            motor.
        torque_constant: In N m/A, if you know it and the speed was not recorded: the current does not determine it.
        no_load_current: In A, of the motor without its load: separates its own friction from the load.
        name: Name of the motor in that file.
        fleet: Each file holds another motor; learn how healthy motors of this make differ.
        motor: Motor file of --fleet: with it one healthy recording of this motor is enough.
        sisters: Which motors the files hold, with --fleet.
    """
    _require_motor_file(output)
    if fleet or motor is not None:
        options.refuse(
            "--fleet" if fleet else "--motor",
            motor=motor if fleet else None,
            temperature_c=temperature_c,
            window=window,
            steady=steady,
            torque_constant=torque_constant,
            no_load_current=no_load_current,
            out=out,
        )
        reading = measurement.of_fleet(regime)
        text, before = _commission_fleet(
            files, output, reading, sisters, name=name, motor=motor, rate=false_alarm_rate
        )
    else:
        if sisters.group is not None:
            raise InputError("--group goes with --fleet")
        with working(f"learning from {_recordings(files, 'healthy ')}"):
            from motor_env.diagnosis.commission import commission as learned
            from motor_env.motor.data_sheet import save_motor

            result = learned(
                files,
                name,
                false_alarm_rate=false_alarm_rate,
                temperature_c=temperature_c,
                regime=regime,
                window_s=window,
                steady=steady,
                **measurement.options,
                constant=torque_constant,
                no_load_current_a=no_load_current,
            )
        before = _move_aside(output)
        save_motor(result.motor, output)
        if out is not None:
            write_text(out / f"{output.stem}.html", result.page())
        text = result.text()
    print(printable(text))
    print(printable(f"written: {output}{before}"))
    measurement.keep()
    return 0


def _commission_fleet(
    files: list[Path],
    output: Path,
    reading: Reading,
    sisters: options.FleetOptions,
    *,
    name: str,
    motor: Path | None,
    rate: float,
) -> tuple[str, str]:
    """Learn a fleet, or one motor with a fleet's motor file as the prior; return both in words, see `_kept`."""
    from motor_env.diagnosis.fleet.learning import learn_fleet, update_unit
    from motor_env.diagnosis.readers.recording import describe_reading, read_recording
    from motor_env.motor.data_sheet import load_motor, save_motor

    if motor is not None:
        with working(f"fitting {_recordings(files, 'own ')}"):
            learned = update_unit(files, load_motor(motor), name, reading=reading)
        read = [(path, read_recording(path, reading.columns).columns) for path in files]
        text = "\n".join(
            [f"{_recordings(files, 'own ')} beside the sisters of {motor}", *describe_reading(read)]
        )
    else:
        with sisters.fitted(files, reading) as how:
            fleet = learn_fleet(files, **how)
        learned, text = fleet.motor(name), fleet.text(rate)
    before = _move_aside(output)
    save_motor(learned, output)
    return text, before


def _require_motor_file(output: Path) -> None:
    """Refuse by an `InputError` to write over a file that is no motor's, before the long work."""
    from motor_env.motor.data_sheet import load_motor

    if output.exists():
        try:
            load_motor(output)
        except InputError:
            raise InputError(f"{output}: is there, and is no motor file; give another -o") from None


def _move_aside(output: Path) -> str:
    """Rename a motor file that is to be replaced; return words that say to what, or nothing."""
    if not output.exists():
        return ""
    names = (f"{output.name}.before{number}" for number in ("", *range(2, 1000)))
    kept = next(path for path in map(output.with_name, names) if not path.exists())
    output.replace(kept)
    return f"; the motor file that was there is now {kept}"


def _report_moved(output: Path) -> None:
    if before := _move_aside(output):
        print(f"motor-env: {printable(f'{output}{before}')}", file=sys.stderr)
