"""From healthy recordings to a motor file: `motor-env commission`."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import stdtrit

from motor_env.diagnosis.decision import DEFAULT_FALSE_ALARM_RATE, decide, limits_of
from motor_env.diagnosis.diagnose import unusable_reason
from motor_env.diagnosis.healthy_motor import Reference, reference_of
from motor_env.diagnosis.learning import (
    disagreement,
    fit_healthy,
    learn_starts,
    odd_one_out,
    without,
)
from motor_env.diagnosis.running.lessons import learn_windows
from motor_env.diagnosis.shown.report import (
    UNITS,
    model_words,
    of_the_drag,
)
from motor_env.diagnosis.views import Fitted, smallest_of, views_of
from motor_env.errors import InputError
from motor_env.fitting.record import at_terminals
from motor_env.fitting.report import motor_of
from motor_env.fitting.starts import AMBIGUOUS, Identified
from motor_env.motor.assumptions import assumptions, lines as lines_of
from motor_env.motor.data_sheet import Motor
from motor_env.motor.healthy import Healthy
from motor_env.motor.model import steady_state
from motor_env.motor.parameters import MotorParameters
from motor_env.recordings.defects import UnusableError
from motor_env.recordings.headers import ColumnChoice
from motor_env.recordings.recording import Recording, recording_of
from motor_env.recordings.regime import Taken, taken_for
from motor_env.recordings.splitting import chosen_starts
from motor_env.recordings.start import Circuit

FEWEST_STARTS = 3
_DIFFERENT = 2.0  # standard errors
_NO_LOAD = 1.2  # of the current with the load: the same motor, within its friction's changes
_WARMTH = "R +0.39 %, K -0.1 % and friction -0.3 % a kelvin come on top of that"
_SPREAD = "  few {0}s give wide intervals, more {0}s narrow them"


@dataclass(frozen=True, slots=True)
class Commissioned:
    """A commissioned motor, what it was learned from, and what later recordings will show.

    Attributes:
        motor: with what its healthy pieces have taught.
        fits: of the healthy pieces.
        smallest: severity of each fault that the next piece shows in 95 of 100 cases.
        undecided: of so many healthy pieces, judged by the others, each quantity was undecided; by its name.
        false_alarm_rate: of the intervals and smallest changes.
        taken: what the recordings were taken for, and why.
    """

    motor: Motor
    fits: tuple[Fitted, ...]
    smallest: dict[str, float]
    undecided: dict[str, int]
    false_alarm_rate: float = DEFAULT_FALSE_ALARM_RATE
    taken: tuple[Taken, ...] = ()

    @property
    def parameters(self) -> dict[str, dict[str, Any]]:
        """Healthy quantities with the interval of the next healthy piece at the rate of false alarms, and unit."""
        healthy = self.healthy
        half = -float(stdtrit(healthy.degrees_of_freedom, self.false_alarm_rate / 2.0))
        widths = half * np.sqrt(np.diag(healthy.log_covariance))
        rows = zip(healthy.quantities, healthy.values.tolist(), widths.tolist(), strict=True)
        return {
            name: {
                "value": value,
                "interval": [value * math.exp(-width), value * math.exp(width)],
                "unit": UNITS[name],
            }
            for name, value, width in rows
        }

    @property
    def healthy(self) -> Healthy:
        """What the healthy pieces have taught."""
        assert self.motor.healthy is not None  # noqa: S101  # a commissioned motor has it
        return self.motor.healthy

    def text(self) -> str:
        """What was learned, with the interval of the next healthy piece."""
        return _text(self)

    def plot(self, path: Path) -> None:
        """A picture of the spread of each quantity; of starts also their fits and residuals.

        Raises:
            InputError: the file cannot be written.
        """
        from motor_env.diagnosis.shown.pictures import plot_commissioned

        plot_commissioned(self.fits, self.healthy, self.smallest, self.false_alarm_rate, path)


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
        word: what the user calls one of them.
        fewest: number of starts that are needed.
        regime: start, operation, or auto: decided by what the voltage does, or by a length of windows.
        start: which one of a file with several.
        voltage_v: level of the supply where none was recorded.
        circuit: what is known of the measuring circuit.
        constant: torque constant in N m/A, where known and the speed was not recorded.
        temperature_c: of the motor at these recordings, where known.
        window_s: length of the windows into which logs are cut; a twentieth of all of them unless given.
        steady: of logs: nothing but a fault moves the motor, as on a test bench.
        no_load_current_a: of starts: what the motor draws uncoupled from its load. It tells which share of the drag is
            the motor's own friction.
        false_alarm_rate: for the smallest changes.

    Raises:
        InputError: too few, one that cannot be read or used, or such as do not go together.
    """
    paths = [Path(one).resolve() for one in recordings if not isinstance(one, Recording)]
    if len(set(paths)) < len(paths):
        raise InputError(f"a healthy {word} is given twice: it would make the spread look smaller than it is")
    if window_s is not None and not 0.0 < window_s < math.inf:
        raise InputError(f"window must be > 0, got {window_s:g}")
    read = [recording_of(one, columns) for one in recordings]
    if regime == "auto" and window_s is not None:
        regime = "operation"
    taken = tuple(dict.fromkeys(taken_for(recording, regime, start) for recording in read))
    regimes = {one.regime for one in taken}
    if len(regimes) > 1:
        raise InputError(
            f"some are starts, and some logs of a motor at work: give {word}s of one kind, or --regime"
        )
    if regimes == {"operation"}:
        given = {"start": start, "sensor-lag": (circuit.sensor_lag_s if circuit else 0.0) or None}
        given |= {"torque-constant": constant, "no-load-current": no_load_current_a}
        for option, value in given.items():
            if value is not None:
                raise InputError(f"--{option} belongs to starts, and these are logs of a motor at work")
        fits: Sequence[Fitted]
        healthy, fits = _learn_logs(read, voltage_v, circuit, window_s, steady=steady)
        healthy = replace(healthy, temperature_c=temperature_c)
        motor = motor_of_windows(healthy, name)
    else:
        if steady or window_s is not None:
            raise InputError("--steady and --window belong to logs of a motor at work, and these are starts")
        starts = fit_starts(
            read, word, fewest, start=start, voltage_v=voltage_v, circuit=circuit, constant=constant
        )
        healthy = replace(learn_starts(starts), temperature_c=temperature_c)
        if no_load_current_a is not None:
            healthy = replace(healthy, own_friction=_own_friction(starts, no_load_current_a))
        motor = to_motor(starts, name, kind="commissioned", healthy=healthy, constant=constant)
        fits = starts
    promise = _promise(motor, fits, temperature_c, false_alarm_rate)
    return Commissioned(motor, tuple(fits), *promise, false_alarm_rate, taken)


def _learn_logs(
    recordings: Sequence[Recording],
    voltage_v: float | None,
    circuit: Circuit | None,
    window_s: float | None,
    *,
    steady: bool,
) -> tuple[Healthy, Sequence[Fitted]]:
    try:
        whole = [at_terminals(recording, voltage_v, circuit) for recording in recordings]
        return learn_windows(whole, window_s, steady=steady)
    except UnusableError as error:
        raise InputError(f"the logs cannot be used: {error}") from None


def motor_of_windows(healthy: Healthy, name: str) -> Motor:
    """The motor that windows have taught."""
    if healthy.windows is None:
        raise ValueError("healthy holds no windows")
    return replace(motor_of(healthy.windows.physical, name, "commissioned"), healthy=healthy)


def _promise(
    motor: Motor, fits: Sequence[Fitted], temperature_c: float | None, rate: float
) -> tuple[dict[str, float], dict[str, int]]:
    """Smallest changes that the next piece shows; and how many pieces, judged by the others, leave what undecided."""
    reference = _reference(motor, fits[0], temperature_c)
    views = views_of(fits[0], reference, rate)
    limits = limits_of(views, rate, tests_noise=reference.log_noise is not None)
    undecided: Counter[str] = Counter()
    assert motor.healthy is not None  # noqa: S101  # it was just learned
    for n in range(len(fits) if len(fits) > 1 else 0):
        others = replace(motor, healthy=without(motor.healthy, fits, n))
        judged = decide(fits[n], _reference(others, fits[n], temperature_c), rate)
        undecided.update(change.name for change in judged.changes if change.verdict == "undecided")
    return smallest_of(views, reference.own_friction, limits.z), dict(undecided)


def _reference(motor: Motor, fit: Fitted, temperature_c: float | None) -> Reference:
    found = reference_of(
        motor, fit.quantity_names, are_starts=isinstance(fit, Identified), temperature_c=temperature_c
    )
    assert found is not None  # noqa: S101  # it was learned from these quantities
    return found


def fit_starts(
    recordings: Sequence[Recording],
    word: str = "start",
    fewest: int = 1,
    *,
    start: int | None = None,
    **options: Any,
) -> list[Identified]:
    """Fit the healthy starts of recordings as `fit_healthy` does; a recording may hold several.

    Raises:
        InputError: one of them cannot be used, or no motor explains it; they are fewer than `fewest`, or hold different
            columns. `word` is what the user calls them.
    """
    starts = [part for recording in recordings for part in chosen_starts(recording, start)]
    if len(starts) < fewest:
        raise InputError(f"commissioning needs at least {fewest} healthy starts, got {len(starts)}")
    try:
        fits = fit_healthy(starts, **options)
    except UnusableError as error:
        raise InputError(f"a healthy {word} cannot be used: {error}") from None
    if len({fit.quantity_names for fit in fits}) > 1:
        raise InputError(f"the healthy {word}s hold different columns; give such that agree")
    for number, part in enumerate(starts):
        reason = unusable_reason(fits[number]) or odd_one_out(fits, number)
        if reason is not None:
            raise InputError(f"{part.path}: a healthy {word} cannot be used: {reason}")
    reason = disagreement(fits)
    if reason is not None:
        raise InputError(f"the healthy {word}s cannot be used: {reason}")
    return fits


def _own_friction(fits: Sequence[Identified], no_load_current_a: float) -> float:
    """Share of the drag that is the motor's own friction, by its currents without and with the load.

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


def to_motor(
    fits: Sequence[Identified],
    name: str,
    *,
    kind: Any = "identified",
    healthy: Healthy | None = None,
    constant: float | None = None,
) -> Motor:
    """Motor file of fits of one motor: the geometric mean of their parameters.

    Where the speed was not recorded, `constant` is the torque constant that the user knows.
    """
    mean = {
        field: float(np.exp(np.mean([math.log(max(getattr(fit.parameters, field), 1e-300)) for fit in fits])))
        for field in MotorParameters.__dataclass_fields__
    }
    known = fits[0].start.voltage_known
    assumed = assumptions(fits[0].quantity_names, has_voltage=known)
    if constant is not None:
        assumed = {key: source for key, source in assumed.items() if key == "nominal_voltage_v"}
    return Motor(
        name=name,
        kind=kind,
        parameters=MotorParameters(**mean),
        nominal_voltage_v=float(np.mean([fit.start.level_v for fit in fits])),
        current_noise_a=float(np.exp(np.mean([math.log(max(fit.noise_a, 1e-12)) for fit in fits]))),
        coulomb_friction_n_m=_if_told(fits, "coulomb"),
        brush_drop_v=_if_told(fits, "brush_drop"),
        healthy=healthy,
        notes=() if known and fits[0].start.speed_rad_s is not None else tuple(not_told(fits[0])),
        assumed=assumed,
    )


def _if_told(fits: Sequence[Identified], name: str) -> float:
    """Mean of an extension over fits, or 0 where it is not different from 0 by two standard errors."""
    each = [fit.fitted_extension.get(name, (0.0, 0.0)) for fit in fits]
    mean, error = np.mean(each, axis=0)[0], float(np.linalg.norm([e for _, e in each])) / len(each)
    return float(mean) if mean > _DIFFERENT * error else 0.0


def not_told(fit: Identified) -> list[str]:
    """What this recording cannot tell, in sentences."""
    sentences = []
    if not fit.start.voltage_known:
        sentences.append("the voltage is unknown: everything is per volt, the supply counts as 1 V")
    if fit.start.speed_rad_s is None:
        sentences.append(
            "the current alone tells K^2/J and B/J, not K, J and B (K down looks like J and B up): K is assumed"
        )
    if fit.start.voltage_v is None:
        sentences.append("a step cannot tell a brush drop from a lower supply")
    if fit.start.voltage_v is None and AMBIGUOUS & set(fit.model):
        sentences.append("a supply that rises slowly, a lag of the sensor and L look alike: L is hardly told")
    sigma = np.sqrt(np.diag(fit.log_covariance))
    sentences += [
        f"{name} is not told by this recording (its standard error is {100 * s:.0f} %)"
        for name, s in zip(fit.quantity_names, sigma, strict=True)
        if s > 0.5
    ]
    return sentences


def _text(result: Commissioned) -> str:
    """See `Commissioned.text`."""
    healthy, rate = result.healthy, result.false_alarm_rate
    smallest = ", ".join(f"{kind} {severity:.1%}" for kind, severity in result.smallest.items())
    interval = f"({1.0 - rate:.0%}, Student t, {healthy.degrees_of_freedom:.0f} degrees)"
    if healthy.starts is not None:
        head, piece = f"{healthy.pieces} healthy starts, model {model_words(healthy.starts.model)}", "start"
    else:
        length = 0.0 if healthy.windows is None else healthy.windows.window_s
        head, piece = f"{healthy.pieces} healthy windows of {length:g} s", "window"
    starts = [fit for fit in result.fits if isinstance(fit, Identified)]
    explained = [fit.r2_current for fit in starts]
    quality = [f"  R2 of the current {min(explained):.4f} to {max(explained):.4f}"] if explained else []
    warm = f"  a motor that is warmer or colder by {healthy.temperature_k:.0f} K (1 sd) is healthy too: {_WARMTH}"
    lines = [
        f"{head}; prediction interval of the next healthy {piece} {interval}",
        *(
            f"  {name:<12} {row['value']:11.4g} {row['unit']:<12}"
            f" {row['interval'][0] / row['value'] - 1.0:+.1%} to {row['interval'][1] / row['value'] - 1.0:+.1%}"
            for name, row in result.parameters.items()
        ),
        *(f"  taken for {one}" for one in result.taken),
        *quality,
        f"  smallest change that is found in 95 of 100 cases: {smallest} ({of_the_drag(healthy.own_friction)})",
        *(
            f"  {name} is left undecided by {count} of these {len(result.fits)} {piece}s: a doubling would not show"
            for name, count in result.undecided.items()
        ),
        *([warm] if healthy.temperature_k else []),
        _SPREAD.format(piece),
        *lines_of(result.motor.assumed),
    ]
    return "\n".join(lines)
