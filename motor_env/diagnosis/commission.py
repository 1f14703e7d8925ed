"""`commission`: learn a motor from its healthy recordings."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import stdtrit

from motor_env.common.errors import InputError, require_options, require_several
from motor_env.diagnosis.diagnose import explain_unusable
from motor_env.diagnosis.estimation.preprocessing import at_terminals
from motor_env.diagnosis.estimation.starts.start_fit import StartFit
from motor_env.diagnosis.estimation.starts.start_identification import behind_capacitor
from motor_env.diagnosis.operation.window_baseline import learn_windows
from motor_env.diagnosis.readers.headers import ColumnChoice
from motor_env.diagnosis.readers.recording import (
    Recording,
    UnusableError,
    describe_reading,
    recording_of,
)
from motor_env.diagnosis.readers.regime import RegimeDecision, taken_for
from motor_env.diagnosis.readers.start import Circuit, chosen_starts, prepare, split_starts
from motor_env.diagnosis.verdict.decision import DEFAULT_FALSE_ALARM_RATE
from motor_env.diagnosis.verdict.healthy_motor import motor_of_windows, to_motor
from motor_env.diagnosis.verdict.healthy_spread import (
    detectable_changes,
    explain_disagreement,
    explain_outlier,
    fit_healthy,
    learn_starts,
)
from motor_env.diagnosis.verdict.hypotheses import Fitted
from motor_env.diagnosis.verdict.judgement import percent
from motor_env.diagnosis.verdict.report_text import UNITS, describe_friction_share
from motor_env.diagnosis.verdict.sensor_diagnosis import learn_signs
from motor_env.motor.data_sheet import Motor, lines as lines_of
from motor_env.motor.healthy import Healthy
from motor_env.motor.model import steady_state
from motor_env.motor.parameters import FloatArray

FEWEST_STARTS = 3
_NO_LOAD = 1.2  # of the current with the load: the same motor, within its friction's changes
_WARMTH = (
    "  a motor that is warmer or colder by {:.0f} K (1 sd) is healthy too: R +0.39 %, K -0.1 % and friction -0.3 % a"
    " kelvin come on top of that"
)


def intervals(healthy: Healthy, log_covariance: FloatArray, rate: float) -> dict[str, dict[str, Any]]:
    """Return quantities with units and intervals at a rate of false alarms; `log_covariance` is (n, n)."""
    half = -float(stdtrit(healthy.degrees_of_freedom, rate / 2.0)) * np.sqrt(np.diag(log_covariance))
    rows = zip(healthy.quantities, healthy.values.tolist(), half.tolist(), strict=True)
    return {
        name: {
            "value": value,
            "interval": [value * math.exp(-width), value * math.exp(width)],
            "unit": UNITS[name],
        }
        for name, value, width in rows
    }


def interval_lines(rows: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Format each interval as a line, in per cent of the value."""
    return [
        f"  {name:<12} {row['value']:11.4g} {row['unit']:<12}"
        f" {percent(row['interval'][0] / row['value'] - 1.0)} to {percent(row['interval'][1] / row['value'] - 1.0)}"
        for name, row in rows.items()
    ]


@dataclass(frozen=True, slots=True)
class Commissioned:
    """A commissioned motor with its smallest detectable changes.

    Attributes:
        motor: with its healthy statistics.
        fits: of the healthy pieces.
        smallest: severity of each fault that is found in 95 of 100 cases.
        undecided: number of healthy pieces that leave a quantity undecided, by its name.
        false_alarm_rate: of the intervals and smallest changes.
        taken: regime of the recordings, and why.
        read: how their columns were understood.
    """

    motor: Motor
    fits: tuple[Fitted, ...]
    smallest: dict[str, float]
    undecided: dict[str, int]
    false_alarm_rate: float = DEFAULT_FALSE_ALARM_RATE
    taken: tuple[RegimeDecision, ...] = ()
    read: tuple[str, ...] = ()

    @property
    def parameters(self) -> dict[str, dict[str, Any]]:
        """Healthy quantities with units and the interval of the next healthy piece."""
        return intervals(self.healthy, self.healthy.log_covariance, self.false_alarm_rate)

    @property
    def healthy(self) -> Healthy:
        """Statistics of the healthy pieces."""
        assert self.motor.healthy is not None  # noqa: S101  # a commissioned motor has it
        return self.motor.healthy

    def __repr__(self) -> str:
        return self.text()

    def text(self) -> str:
        """Describe what was learned, with the interval of the next healthy piece."""
        healthy, rate = self.healthy, self.false_alarm_rate
        extensions = () if healthy.starts is None else healthy.starts.model
        piece, kind, drives = "start", f", model {' + '.join(['textbook', *extensions])}", 0
        if healthy.windows is not None:
            piece, kind = "window", f" of {healthy.windows.window_s:g} s"
            drives = len(healthy.windows.drives)
        explained = [fit.r2_current for fit in self.fits if isinstance(fit, StartFit)]
        quality = [f"  R2 of the current {min(explained):.4f} to {max(explained):.4f}"] if explained else []
        smallest = ", ".join(
            f"{fault} {percent(severity, '.1%')}" for fault, severity in self.smallest.items()
        )
        friction = describe_friction_share(healthy.own_friction)
        interval = f"({1.0 - rate:.0%}, Student t, {healthy.degrees_of_freedom:.0f} degrees)"
        lines = [
            f"{healthy.pieces} healthy {piece}s{kind}; prediction interval of the next healthy {piece} {interval}",
            *interval_lines(self.parameters),
            *(
                [f"  {drives} operating conditions: each window is compared with those of its own"]
                if drives > 1
                else []
            ),
            *(f"  taken for {reason}" for reason in self.taken),
            *self.read,
            *quality,
            f"  smallest change that is found in 95 of 100 cases: {smallest} ({friction})",
            *(
                f"  {name} is left undecided by {count} of these {len(self.fits)} {piece}s: a doubling would not show"
                for name, count in self.undecided.items()
            ),
            *([_WARMTH.format(healthy.temperature_k)] if healthy.temperature_k else []),
            f"  few {piece}s give wide intervals, more {piece}s narrow them",
            *lines_of(self.motor.assumed),
        ]
        return "\n".join(lines)

    def page(self) -> str:
        """Draw a self-contained HTML page: the spread of each quantity, and the fits of starts."""
        from motor_env.diagnosis.verdict.report_page import page_of_fits, spread_chart

        starts = [fit for fit in self.fits if isinstance(fit, StartFit)]
        smallest = ", ".join(
            f"{kind.replace('_', ' ')} {percent(share, '.0%')}" for kind, share in self.smallest.items()
        )
        return page_of_fits(
            f"Interval of the next healthy {'start' if starts else 'window'} ({1.0 - self.false_alarm_rate:.0%})",
            {f"Healthy start {number}": fit for number, fit in enumerate(starts, 1)},
            spread=spread_chart(self.fits, self.parameters),
            note=f"Smallest change found in 95 of 100 cases: {smallest}.",
        )


def commission(
    recordings: Sequence[Recording | str | Path],
    name: str = "commissioned motor",
    columns: Sequence[ColumnChoice] = (),
    *,
    word: str = "start",
    fewest: int = FEWEST_STARTS,
    regime: str = "auto",
    start: int | None = None,
    voltage_v: float | None = None,
    circuit: Circuit | None = None,
    constant: float | None = None,
    temperature_c: float | None = None,
    window_s: float | None = None,
    steady: bool = False,
    no_load_current_a: float | None = None,
    false_alarm_rate: float = DEFAULT_FALSE_ALARM_RATE,
) -> Commissioned:
    """Learn a motor from healthy recordings: all starts, or all logs of it at work.

    Args:
        recordings: as read, or their files; each may hold several starts.
        name: of the motor.
        columns: columns named by the user, of files.
        word: what messages call a recording.
        fewest: number of starts that are needed.
        regime: start, operation, or auto: operation if `window_s` is given, else decided by the voltage.
        start: which one of a file with several.
        voltage_v: level of the supply where none was recorded.
        circuit: the measuring circuit.
        constant: torque constant in N m/A, where known and the speed was not recorded.
        temperature_c: of the motor at these recordings, where known.
        window_s: length of the windows of logs; by default a twentieth of all logs.
        steady: of logs: load, temperature and offsets are constant, as on a test bench.
        no_load_current_a: of starts: current without the load, for the motor's own friction.
        false_alarm_rate: for intervals and smallest changes.

    Raises:
        InputError: too few, unusable or incompatible recordings.
    """
    require_several("recordings", recordings, (Recording, str, Path))
    paths = [Path(each).resolve() for each in recordings if not isinstance(each, Recording)]
    if len(set(paths)) < len(paths):
        raise InputError(f"a healthy {word} is given twice: it would make the spread look smaller than it is")
    require_options(
        false_alarm_rate=false_alarm_rate,
        start=start,
        temperature=temperature_c,
        voltage=voltage_v,
        torque_constant=constant,
        window=window_s,
        no_load_current=no_load_current_a,
    )
    read = [recording_of(each, columns) for each in recordings]
    if regime == "auto" and window_s is not None:
        regime = "operation"
    taken = _require_one_regime(read, [taken_for(recording, regime, start) for recording in read], word)
    if taken[0].regime == "operation":
        given = {
            "start": start,
            "sensor-lag": None if circuit is None else circuit.sensor_lag_s or None,
            "torque-constant": constant,
            "no-load-current": no_load_current_a,
        }
        for option, value in given.items():
            if value is not None:
                raise InputError(f"--{option} belongs to starts, and these are logs of a motor at work")
        try:
            whole = [at_terminals(recording, voltage_v, circuit) for recording in read]
            healthy, windows = learn_windows(whole, window_s, steady=steady)
        except UnusableError as error:
            raise InputError(f"the logs cannot be used: {error}") from None
        motor = motor_of_windows(replace(healthy, temperature_c=temperature_c), name)
        fits: tuple[Fitted, ...] = tuple(windows)
    else:
        if steady or window_s is not None:
            raise InputError("--steady and --window belong to logs of a motor at work, and these are starts")
        starts = fit_starts(
            read, word, fewest, start=start, voltage_v=voltage_v, circuit=circuit, constant=constant
        )
        healthy = replace(learn_starts(starts), temperature_c=temperature_c)
        if no_load_current_a is not None:
            healthy = replace(healthy, own_friction=_own_friction(starts, no_load_current_a))
        motor = to_motor(starts, name, healthy=healthy, constant=constant)
        motor = learn_signs(
            motor, [part for recording in read for part in chosen_starts(recording, start)], voltage_v
        )
        fits = tuple(starts)
    detectable = detectable_changes(motor, fits, temperature_c, false_alarm_rate)
    words = tuple(describe_reading((recording.path, recording.columns) for recording in read))
    return Commissioned(motor, fits, *detectable, false_alarm_rate, taken, words)


def _require_one_regime(
    read: Sequence[Recording], taken: Sequence[RegimeDecision], word: str
) -> tuple[RegimeDecision, ...]:
    """Require starts only or logs only; return the regime, each reason once. Repeated starts count as a log.

    Raises:
        InputError: some are single starts, and some are logs of a motor at work.
    """
    work = [regime for regime in taken if regime.regime == "operation"]
    starts = [recording for recording, each in zip(read, taken, strict=True) if each.regime == "start"]
    if work and any(len(split_starts(recording)) == 1 for recording in starts):
        raise InputError(
            f"some are starts, and some logs of a motor at work: give {word}s of one kind, or --regime"
        )
    return tuple(dict.fromkeys(work or taken))


def fit_starts(
    recordings: Sequence[Recording],
    word: str = "start",
    fewest: int = 1,
    *,
    start: int | None = None,
    voltage_v: float | None = None,
    circuit: Circuit | None = None,
    constant: float | None = None,
) -> list[StartFit]:
    """Fit the healthy starts of recordings by `fit_healthy`; a recording may hold several.

    Raises:
        InputError: a start cannot be used, they are fewer than `fewest`, or their columns differ.
    """
    starts = [part for recording in recordings for part in chosen_starts(recording, start)]
    if len(starts) < fewest:
        raise InputError(f"commissioning needs at least {fewest} healthy starts, got {len(starts)}")
    prepared = []
    for part in starts:
        try:
            prepared.append(prepare(part, voltage_v, circuit))
        except UnusableError as error:
            raise InputError(f"{part.path}: a healthy {word} cannot be used: {error}") from None
    try:
        fits = fit_healthy(prepared, constant=constant)
    except UnusableError as error:
        raise InputError(f"a healthy {word} cannot be used: {error}") from None
    if len({fit.quantity_names for fit in fits}) > 1:
        raise InputError(f"the healthy {word}s hold different columns; give such that agree")
    for number, part in enumerate(starts):
        fit = behind_capacitor(fits[number], constant=constant, can_be_slow=True) or fits[number]
        reason = explain_unusable(fit) or explain_outlier(fits, number)
        if reason is not None:
            raise InputError(f"{part.path}: a healthy {word} cannot be used: {reason}")
    reason = explain_disagreement(fits)
    if reason is not None:
        raise InputError(f"the healthy {word}s cannot be used: {reason}")
    return fits


def _own_friction(fits: Sequence[StartFit], no_load_current_a: float) -> float:
    """Return the motor's own share of the drag, by its currents without and with the load.

    Raises:
        InputError: it draws less with the load.
    """
    running = float(np.mean([steady_state(fit.parameters, fit.start.level_v)[0] for fit in fits]))
    if not no_load_current_a <= _NO_LOAD * running:
        raise InputError(
            f"no-load-current must be at most the {running:.3g} A that the motor draws at the end of these starts,"
            f" got {no_load_current_a:g}"
        )
    return min(no_load_current_a / running, 1.0)
