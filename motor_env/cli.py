"""The command `motor-env`: parse, call, print. Each command loads what it needs when it runs."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import App, Parameter

from motor_env import __version__, console
from motor_env.console import printable
from motor_env.errors import InputError

if TYPE_CHECKING:
    from motor_env.recordings.profiles import Profile

Json = Annotated[bool, Parameter(name="--json", negative=())]

app = App(
    name="motor-env",
    help="A DC motor that may be failing: simulate, diagnose, reproduce the paper.",
    version=__version__,
)


def _show(as_json: bool, objects: Callable[[], Any], text: Callable[[], str]) -> None:
    print(json.dumps(objects(), indent=1) if as_json else printable(text()))


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class Measurement:
    """What the user says of a recording.

    Attributes:
        voltage: Level of the supply in volt, for recordings without a voltage.
        column: A column that its header does not tell, its unit or its scale (may be repeated): current=CH2:mA,
            "current=CH2*10-0.05" for 10 A/V and an offset of -0.05 A, voltage=none.
        sampling_rate: Samples a second, for files without a time.
        shunt_ohm: Resistance in series with the motor (shunt, leads) in ohm; it is taken off R.
        sensor_lag: Time constant of the current sensor in seconds, where known; it is not fitted then.
        start: Which start, counted from 1, where a file holds several; all of them without it.
        profile: File of --save-profile; what is said here as well counts more.
        save_profile: File (TOML) to keep these choices in for the next time.
    """

    voltage: float | None = None
    column: list[str] | None = None
    sampling_rate: float | None = None
    shunt_ohm: float | None = None
    sensor_lag: float | None = None
    start: console.Whole | None = None
    profile: Path | None = None
    save_profile: Path | None = None

    @property
    def chosen(self) -> Profile:
        """The choices, with those of the profile."""
        from motor_env.recordings import profiles

        names = ("voltage", "sampling_rate", "shunt_ohm", "sensor_lag")
        given = {name: getattr(self, name) for name in names} | {"column": self.column or ()}
        own = profiles.profile_from(given)
        return own if self.profile is None else own.over(profiles.load_profile(self.profile))

    def keep(self) -> None:
        """Save them where that is asked for."""
        from motor_env.recordings.profiles import save_profile

        if self.save_profile is not None:
            save_profile(self.chosen, self.save_profile)

    @property
    def options(self) -> dict[str, Any]:
        """The same as the functions behind the commands take it."""
        return self.chosen.options | {"start": self.start}

    def for_windows(self, **others: object) -> dict[str, Any]:
        """The same for windows of a motor at work; options that belong to starts are refused, not ignored."""
        others |= {"start": self.start, "sensor_lag": self.chosen.sensor_lag or None}
        for name, value in others.items():
            if value is not None:
                raise InputError(
                    f"--{name.replace('_', '-')} belongs to starts, not to windows of a motor at work"
                )
        return {name: value for name, value in self.options.items() if name != "start"}


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class StartMeasurement(Measurement):
    """The same, and what is known of its commutation ripple.

    Attributes:
        ripple_periods_per_turn: Periods of the current's commutation ripple in a turn, for the true speed, K, J and B.
    """

    ripple_periods_per_turn: float | None = None


def _positive(option: str, value: float | None) -> float | None:
    if value is not None and not 0.0 < value < float("inf"):
        raise InputError(f"{option} must be > 0, got {value:g}")
    return value


_MEASUREMENT, _START = Measurement(), StartMeasurement()


@app.command
def reproduce(
    *,
    out: Path,
    image_format: str = "svg",
    json_: Json = False,
) -> int:
    """Write the source paper's figures, its numbers beside ours, and where it is wrong.

    Example: motor-env reproduce --out out/paper

    Args:
        out: Folder for index.html, paper.md, reproduce.json and images/. One with files of others is refused.
        image_format: svg or png.
        json_: Print what stands in reproduce.json.
    """
    from motor_env.apps import reproduce as paper

    with console.working("computing the paper's numbers") as say:
        result = paper.reproduce(
            out, image_format=image_format, progress=lambda figure: say(f"drawing {figure.name}")
        )
    counts = f"{len(result['figures'])} figures and {len(result['numbers'])} numbers"
    _show(json_, lambda: result, lambda: f"{counts}: {out / 'index.html'}")
    return 0


@app.command
def diagnose(
    files: list[Path],
    *,
    motor: str | None = None,
    healthy: Annotated[list[Path] | None, Parameter(consume_multiple=True, negative=())] = None,
    false_alarm_rate: float = 0.01,
    out: Path | None = None,
    measurement: StartMeasurement = _START,
    temperature_c: float | None = None,
    verbose: Annotated[bool, Parameter(negative=())] = False,
    json_: Json = False,
) -> int:
    """Verdict on recorded starts: healthy, bearing, winding, magnet, noise, other, no_reference or unusable.

    Example: motor-env diagnose examples/startup_capture.csv --motor examples/motor.toml

    A motor that was commissioned with --window is judged by windows of its logs.

    Exit status: 0 all healthy, 1 any fault, 2 a file that cannot be read, 3 no fault but some undecided.

    Args:
        files: Recordings (CSV and other text, .mat, .npy, .npz, .parquet) with time, current, and voltage, speed
            where measured; e.g. columns time_s, current_a, voltage_v, speed_rad_s.
        motor: Motor file (TOML), or the name of a catalogue motor.
        healthy: Recordings of the healthy motor to compare with, after the option: --healthy A.csv B.csv C.csv
        false_alarm_rate: How often a healthy recording may be called faulty.
        out: Folder for one HTML page a start: verdict, what to do first, and what it rests on.
        measurement: How it was measured.
        temperature_c: Temperature of the motor; it counts where `commission` was told one too.
        verbose: Print how well model and filter fit, too.
        json_: Print one array with one object a start.
    """
    from motor_env.diagnosis import report, running
    from motor_env.diagnosis.files import diagnose_files
    from motor_env.motor.data_sheet import load_motor

    known = None if motor is None else load_motor(motor)
    if known is not None and known.operation is not None:
        options = measurement.for_windows(temperature_c=temperature_c, healthy=healthy)
        records = running.diagnose_running(files, known, false_alarm_rate, out, **options)
        _show(json_, lambda: [r.as_json() for r in records], lambda: "\n".join(r.as_text() for r in records))
        measurement.keep()
        return running.exit_status(records)
    with console.working("reading") as say:
        outcomes = diagnose_files(
            files,
            motor=motor,
            healthy=healthy or (),
            false_alarm_rate=false_alarm_rate,
            out=out,
            periods_per_turn=measurement.ripple_periods_per_turn,
            temperature_c=temperature_c,
            **measurement.options,
            progress=lambda path: say(f"diagnosing {path}"),
        )
    for outcome in outcomes:
        if outcome.error is not None:
            print(f"motor-env: {printable(outcome.error)}", file=sys.stderr)
    judged = [outcome for outcome in outcomes if outcome.diagnosis is not None]
    if json_ or judged:
        _show(json_, lambda: [o.as_json() for o in outcomes], lambda: "\n".join(o.as_text() for o in judged))
    measurement.keep()
    if any(outcome.is_bug for outcome in outcomes):
        return int(console.ExitStatus.BUG)
    diagnoses = [outcome.diagnosis for outcome in outcomes if outcome.diagnosis is not None]
    return report.exit_status(diagnoses, unreadable=len(diagnoses) < len(outcomes))


@app.command
def trend(
    paths: list[Path],
    *,
    limit: Annotated[list[str] | None, Parameter(negative=())] = None,
    level: float = 0.9,
    voltage: float | None = None,
    date: Literal["name", "modified"] = "name",
    reference_count: console.Whole = 3,
    out: Path = Path("out/trend.html"),
    json_: Json = False,
) -> int:
    """Trends of a motor's quantities over its starts, and the time to a limit where there is a trend.

    Example: motor-env trend recordings/ --limit B/J=1.5 --limit R=0.9,1.1

    Exit status: 0 no trend, 1 a limit is reached or trended to, 2 input that cannot be used.

    Args:
        paths: A table of estimates (CSV or JSON), or a folder of recordings whose names hold a date.
        limit: Limits as factors on the mean of the first estimates, QUANTITY=FACTOR[,FACTOR]; by default
            0.75,1.25, and none of L.
        level: Probability that the interval of the remaining life holds.
        voltage: Level of the supply in volt, for recordings without a voltage.
        date: name (2026-01-31, 2026-01-31T11-00-14, Jan-31-2026_11-00-14), or modified: the file's own date.
        reference_count: Number of first estimates whose mean is the reference.
        out: The page, one self-contained HTML file.
        json_: Print one array with one object a quantity.
    """
    from motor_env.files import write_text
    from motor_env.prognosis import files as trends
    from motor_env.prognosis.page import page, status
    from motor_env.prognosis.trend import parse_limits

    with console.working("reading") as say:
        judged, notes = trends.trends_of(
            paths,
            parse_limits(limit or ()),
            level=level,
            voltage_v=voltage,
            date=date,
            reference_count=reference_count,
            progress=lambda path: say(f"fitting {path}"),
        )
    write_text(out, page(judged, notes))
    for note in notes:
        print(f"motor-env: {note}", file=sys.stderr)
    _show(json_, lambda: list(map(trends.as_json, judged)), lambda: f"{trends.as_text(judged)}\n{out}")
    return int(any(status(one) in ("reached", "trending") for one in judged))


@app.command
def identify(
    files: list[Path],
    *,
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
    out: Path | None = None,
    measurement: StartMeasurement = _START,
    torque_constant: float | None = None,
    name: str = "identified motor",
    regime: str = "auto",
    json_: Json = False,
) -> int:
    """Parameters of a motor from recorded starts or from logs of it at work, and the model that the evidence prefers.

    Example: motor-env identify examples/startup_capture.csv -o out/motor.toml

    Logs of a motor at work (reversals, several levels, fast switching) are identified jointly. Exit status 3: no
    motor explains them.

    Args:
        files: Recordings of one motor.
        output: Motor file to write (TOML).
        out: Folder for one picture a start.
        measurement: How it was measured.
        torque_constant: In N m/A, where known and the speed was not recorded: the current alone does not tell it.
        name: Name of the motor in that file.
        regime: start, operation, or auto: decided by what the voltage does.
        json_: Print one array with one object a start, and one for all logs of a motor at work.
    """
    from motor_env.diagnosis import commission as steps
    from motor_env.motor.data_sheet import save_motor
    from motor_env.operation import logs

    periods, options = measurement.ripple_periods_per_turn, measurement.options
    constant = _positive("torque-constant", torque_constant)
    works, starts = logs.sorted_files(files, options["columns"], regime=regime, start=measurement.start)
    if works:
        work = logs.identify_logs(works, voltage_v=options["voltage_v"], circuit=options["circuit"])
        if output is not None:
            save_motor(work.motor(name), output)
        if out is not None:
            work.plot(out)
    fits = [pair for path in starts for pair in steps.identify_file(path, **options, constant=constant)]
    if output is not None and fits:
        save_motor(steps.to_motor([fit for _, fit in fits], name, constant=constant), output)
    if out is not None:
        from motor_env.diagnosis.files import picture_of
        from motor_env.diagnosis.pictures import plot_identified

        for number, (recording, fit) in enumerate(fits, 1):
            plot_identified(fit, recording.path.name, picture_of(recording.path, out, number))
    _show(
        json_,
        lambda: [steps.identified_json(*one, periods) for one in fits] + (work.as_json() if works else []),
        lambda: "\n".join(
            [steps.identified_text(*one, periods) for one in fits] + (work.as_text() if works else [])
        ),
    )
    measurement.keep()
    return work.exit_status() if works else 0


@app.command
def commission(
    files: list[Path],
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    false_alarm_rate: float = 0.01,
    out: Path | None = None,
    measurement: Measurement = _MEASUREMENT,
    temperature_c: float | None = None,
    window: float | None = None,
    torque_constant: float | None = None,
    name: str = "commissioned motor",
) -> int:
    """Learn a motor from three or more healthy starts, for `motor-env diagnose --motor`.

    Example: motor-env commission healthy_1.csv healthy_2.csv healthy_3.csv -o out/motor.toml

    Args:
        files: Recordings of healthy starts of one motor; a file may hold several.
        output: Motor file to write (TOML).
        false_alarm_rate: For the intervals that are printed.
        out: Folder for the picture: starts, fits, residuals and the spread of each quantity.
        measurement: How they were measured.
        temperature_c: Temperature of the motor at these starts, where known.
        window: Length in seconds of the windows into which logs of the motor at work are cut, instead of starts.
        torque_constant: In N m/A, where known and the speed was not recorded: the current alone does not tell it.
        name: Name of the motor in that file.
    """
    from motor_env.diagnosis import commission as steps, running
    from motor_env.motor.data_sheet import save_motor

    if not 0.0 < false_alarm_rate < 0.5:
        raise InputError(f"false-alarm-rate must lie between 0 and 0.5, got {false_alarm_rate:g}")
    if window is not None:
        options = measurement.for_windows(
            temperature_c=temperature_c, out=out, torque_constant=torque_constant
        )
        known = running.commission_running(files, window, name, **options)
        save_motor(known, output)
        if known.operation is not None:
            print(running.commissioned_text(known.operation, false_alarm_rate))
        print(f"written: {output}")
        measurement.keep()
        return 0
    result = steps.commission(
        files,
        name,
        false_alarm_rate=false_alarm_rate,
        temperature_c=temperature_c,
        **measurement.options,
        constant=_positive("torque-constant", torque_constant),
    )
    save_motor(result.motor, output)
    if out is not None and result.motor.reference is not None:
        from motor_env.diagnosis.pictures import plot_commissioned

        picture = out / f"{output.stem}.png"
        plot_commissioned(result.fits, result.motor.reference, result.smallest, false_alarm_rate, picture)
    print(steps.commissioned_text(result, false_alarm_rate))
    print(printable(f"written: {output}"))
    measurement.keep()
    return 0


@app.command
def watch(
    motor: Path,
    log: Path | None = None,
    *,
    false_alarms_per_year: float = 1.0,
    state: Path | None = None,
    follow: bool = False,
) -> int:
    """Watch a motor at work: lines of CSV come in, a verdict on each window goes out as it ends.

    Example: motor-env watch out/motor.toml log.csv --follow --state out/watch.json

    On a terminal one line is kept up to date; otherwise each event is a line of JSON. Exit status when the lines end:
    0 all healthy, 1 any fault, 3 no fault but a window that cannot be judged.

    Args:
        motor: Motor file that `commission --window` wrote.
        log: File with the columns time, voltage, current and speed; standard input without it.
        false_alarms_per_year: Of a healthy motor that always runs.
        state: File that keeps what was seen, so that a new start goes on where the last window ended.
        follow: Wait for lines that are appended to the log.
    """
    from motor_env.diagnosis import live

    return live.run(motor, log, false_alarms_per_year=false_alarms_per_year, state=state, follow=follow)


@app.command(name="export-c")
def export_c(
    motor: str,
    *,
    out: Path,
    rate_hz: float,
    voltage: float | None = None,
    rule: Literal["cusum", "nis"] = "cusum",
    shift: float = 0.5,
    false_alarms_per_year: float = 1.0,
    arithmetic: Literal["fixed", "float"] = "fixed",
    gain: Literal["steady", "scheduled"] = "steady",
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
        out: Folder of the library.
        rate_hz: Samples a second.
        voltage: Level of the supply in volt; by default the motor's nominal voltage.
        rule: cusum (a lasting shift, up or down), or nis (the size of single samples).
        shift: Shift that the cusum looks for, in standard deviations of a sample.
        false_alarms_per_year: Of this motor, healthy, exactly known and without load.
        arithmetic: fixed (whole numbers, for chips without a floating-point unit), or float.
        gain: steady, or scheduled (a gain for each sample after a begin at rest).
        current_noise: Standard deviation of a current sample in ampere; by default that of the motor file.
        speed_noise: Standard deviation of a speed sample in rad/s; speed is read where this is given.
        current_count: What one count of a whole-number reading is worth, in ampere; by default a suitable power of ten.
        speed_count: The same of the speed, in rad/s.
        voltage_count: The same of the voltage, in volt.
        stuck_after: So many equal readings in a row, while voltage is on, are a stuck sensor.
        name: Of the library, and the first part of the names in it.
    """
    from motor_env.detection.rules import Cusum, nis_rule
    from motor_env.embedded.arithmetic import Steps
    from motor_env.embedded.monitor import monitor_of, sensor_of
    from motor_env.embedded.source import write_library
    from motor_env.motor.data_sheet import load_motor

    known = load_motor(motor)
    monitor = monitor_of(
        known,
        rate_hz,
        rule=nis_rule() if rule == "nis" else Cusum(shift, two_sided=True),
        sensor=sensor_of(known, current_noise, speed_noise),
        voltage_v=voltage if voltage is not None else known.nominal_voltage_v or 0.0,
        false_alarms_per_year=false_alarms_per_year,
        stuck_after=stuck_after,
        scheduled=gain == "scheduled",
    )
    counts = Steps.suited(monitor.limits, current_count, speed_count, voltage_count)
    wanted = f"{false_alarms_per_year:g} false alarms a year"
    for path in write_library(
        monitor, out, steps=counts if arithmetic == "fixed" else None, name=name, wanted=wanted
    ):
        print(printable(str(path)))
    return 0


@app.command
def warm_up() -> int:
    """Compile the environments for this machine, so that no program has to wait for it later.

    Example: motor-env warm-up
    """
    from motor_env.envs.compiling import warm_up as compile_steps

    print(f"the environments are compiled ({compile_steps():.1f} s)")
    return 0


@app.command
def examples(folder: Path = Path("examples")) -> int:
    """Write the files that the documentation reads into a folder: a capture, a motor file, and scripts.

    Example: motor-env examples

    Args:
        folder: Where to; files of these names that are there already are kept.
    """
    from motor_env.files import write_examples

    for path in write_examples(folder):
        print(path)
    return 0


@app.command
def lab(*, port: console.Whole = 0, browser: bool = True) -> int:
    """A page in the browser: faults, noise and motor by sliders, residual, rule and verdict; drop a recording on it.

    Example: motor-env lab

    It runs on this machine only (127.0.0.1), needs no network, and ends with Ctrl-C.

    Args:
        port: Port to listen on; 0 takes a free one.
        browser: Open the page.
    """
    import webbrowser

    from motor_env.apps import lab_server

    with lab_server.make_server(port) as server:
        print(f"{lab_server.address(server)}  (Ctrl-C ends it)", flush=True)
        if browser:
            webbrowser.open(lab_server.address(server))
        server.serve_forever()
    return 0


@app.command
def coastdown(file: Path, *, json_: Json = False) -> int:
    """Viscous and Coulomb friction from a coast-down: the speed of a motor whose voltage was taken away.

    Example: motor-env coastdown coastdown.csv

    Args:
        file: Recording with time, current and speed.
        json_: Print one object.
    """
    from motor_env.identification.coastdown import fit_coastdown
    from motor_env.recordings.defects import UnusableError
    from motor_env.recordings.recording import read_recording

    recording = read_recording(file)
    try:
        friction = fit_coastdown(recording)
    except UnusableError as error:
        raise InputError(f"{file}: {error}") from None
    viscous, coulomb = f"B/J {friction.viscous_per_s:.4g} 1/s", f"Tc/J {friction.coulomb_rad_s2:.4g} rad/s2"
    alone = f"with viscous friction alone {friction.r2_viscous:.4f}; evidence {friction.evidence:.0f}"
    text = f"{file}: {viscous}, Coulomb friction {coulomb}\n  R2 {friction.r2:.4f}; {alone}"
    _show(json_, lambda: asdict(friction), lambda: text)
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `motor-env` and return its exit status."""
    return console.run(app, arguments)
