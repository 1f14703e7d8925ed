"""Regime of a recording, a start or a motor at work, by its voltage."""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from motor_env.common.arrays import is_one_of, shown
from motor_env.common.errors import InputError
from motor_env.diagnosis.readers.noise import difference_noise
from motor_env.diagnosis.readers.recording import Recording, UnusableError
from motor_env.motor.parameters import FloatArray

REGIMES = ("auto", "start", "operation")
_OFF, _ON = 0.1, 0.8
_REVERSED_SHARE = 0.005
_BETWEEN_SHARE = 0.1
_FEWEST_CHANGES = 3
# Of the top, from where it counts as a rise, and how many blocks it lasts: ripple of a rectifier is faster.
_CLIMB, _FOOT, _BLOCK_S, _SLOW_BLOCKS = 0.2, 0.05, 0.01, 3
_MOST_SWITCHES = 5
_PAUSE_S, BOUNCE_S = 0.1, 0.02  # a motor does not stop in so short a pause; a contact has bounced and settled
_INRUSH, _STILL_TURNS = 0.75, 0.1  # of the largest inrush, and of the top speed
_FIRST = 3  # samples
_FEWEST_JUMPS = 8  # of the voltage
_CHANCE, _UNKNOWN, _KNOWN = 3.0, 0.25, 0.8  # rank correlation with the current's: standard errors; its bounds
_NOISE_SPAN = 10.0  # a voltage that is only noise spans so many standard deviations
_LEVEL, _OFF_LEVEL = 0.05, 0.02  # of the way between two levels; share of the samples that may lie off them


class RegimeDecision(NamedTuple):
    """Decision whether a recording is a start or a motor at work.

    Attributes:
        regime: start (one or several), or a motor at work.
        why: in words.
    """

    regime: Literal["start", "operation"]
    why: str

    def __str__(self) -> str:
        word = "a motor at work" if self.regime == "operation" else "a start"
        return f"{word} ({self.why})"


def taken_for(recording: Recording, regime: str = "auto", start: int | None = None) -> RegimeDecision:
    """Decide what a recording is: as asked, by its voltage, or a start where one is chosen.

    Raises:
        InputError: an unknown regime.
    """
    if not is_one_of(regime, REGIMES):
        raise InputError(f"regime must be one of {', '.join(REGIMES)}, got {shown(regime)}")
    if regime != "auto" or start is not None:
        return RegimeDecision("operation" if regime == "operation" else "start", "as asked")
    work = operation_evidence(recording)
    if work is not None:
        return RegimeDecision("operation", work)
    unknown = recording.voltage_v is None and recording.duty is None
    return RegimeDecision("start", "no voltage was recorded" if unknown else "the voltage is switched on")


def operation_evidence(recording: Recording) -> str | None:
    """Say what shows that a recording is no plain start; None for starts.

    A start is a supply that goes from off to on and stays; short gaps are a bouncing switch, pauses lie between starts.
    """
    voltage = recording.voltage_v if recording.voltage_v is not None else recording.duty
    if voltage is None:
        return None
    top = float(np.quantile(np.abs(voltage), 0.999))
    if top == 0.0:
        return None
    share = voltage / top
    size = np.abs(share)
    levels = np.digitize(size, (_OFF, _ON))
    pauses = gaps_s(levels == 0, recording.dt_s)
    reversed_share = min(float(np.mean(share > _OFF)), float(np.mean(share < -_OFF)))
    has_levels = float(np.mean(levels == 1)) > _BETWEEN_SHARE and (
        changes(size) >= _FEWEST_CHANGES or slow_rises(size, recording.dt_s) >= _FEWEST_CHANGES
    )
    is_pulsed = len(pauses) >= _MOST_SWITCHES and float(np.median(pauses)) < _PAUSE_S
    shown = {
        "the voltage reverses": reversed_share > _REVERSED_SHARE,
        "the voltage takes several levels": has_levels,
        "the motor starts under one voltage, and another follows": _starts_at_part_voltage(recording, size),
        "the voltage is switched faster than a motor stops": is_pulsed,
        "the voltage comes back before the motor stands": _restarts_turning(recording, size, levels == 0),
        # Without its voltage no log can be judged: what was recorded with a duty is taken for a start.
        "the motor turns already": recording.voltage_v is not None
        and size[0] > _OFF
        and _is_turning(recording, np.arange(min(_FIRST, len(size)))),
    }
    return next((words for words, is_shown in shown.items() if is_shown), None)


def _restarts_turning(recording: Recording, share: FloatArray, is_off: NDArray[np.bool_]) -> bool:
    """Return whether the motor turns when switched on again, by its speed or too small an inrush."""
    on = np.flatnonzero(~is_off)
    restarts = on[1:][np.diff(on) * recording.dt_s > BOUNCE_S]
    if len(restarts) == 0:
        return False
    if recording.speed_rad_s is not None:
        return _is_turning(recording, restarts - 1)
    current = np.where(is_off, 0.0, np.abs(recording.current_a - np.median(recording.current_a[is_off])))
    without_wild = np.append(np.minimum(current[:-1], current[1:]), 0.0)
    begins = np.append(on[0], restarts)
    inrush = np.maximum.reduceat(without_wild, begins) / np.maximum.reduceat(share, begins)
    return bool(np.median(inrush[1:]) < _INRUSH * inrush.max())


def _starts_at_part_voltage(recording: Recording, share: FloatArray) -> bool:
    """Return whether another voltage follows the first, under which the motor is not settled."""
    steps = np.flatnonzero(np.abs(np.diff(share)) > _OFF)
    if not _OFF < share[0] < _ON or len(steps) == 0 or steps[0] < _BETWEEN_SHARE * len(share):
        return False
    shown = recording.current_a if recording.speed_rad_s is None else recording.speed_rad_s
    moved = np.median(shown[max(steps[0] - _FIRST, 0) : steps[0] + 1]) - np.median(shown[:_FIRST])
    return bool(abs(moved) > _STILL_TURNS * np.quantile(np.abs(shown), 0.999))


def _is_turning(recording: Recording, samples: NDArray[np.intp]) -> bool:
    """Return whether the motor turns at most of some samples, by its speed."""
    if recording.speed_rad_s is None:
        return False
    speed = np.abs(recording.speed_rad_s)
    return bool(np.median(speed[samples]) > _STILL_TURNS * np.quantile(speed, 0.999))


def refuse_aliased(voltage_v: FloatArray, current_a: FloatArray) -> None:
    """Refuse a raw pulse-width modulation that was sampled more slowly than it switches: its mean is lost.

    Its voltage jumps between two levels, or stays at one; the current follows neither jumps nor noise.

    Raises:
        UnusableError: it is one.
    """
    low, high = np.quantile(voltage_v, (0.02, 0.98))
    distance = np.minimum(np.abs(voltage_v - low), np.abs(voltage_v - high))
    is_noise = float(np.ptp(voltage_v)) < _NOISE_SPAN * difference_noise(voltage_v)
    if not is_noise and float(np.mean(distance > _LEVEL * (high - low))) > _OFF_LEVEL:
        return
    jumps = np.flatnonzero(np.diff((voltage_v > 0.5 * (low + high)).astype(np.int8))) + 1
    jumps = jumps[(jumps > 1) & (jumps < len(voltage_v) - 2)]
    if len(jumps) < _FEWEST_JUMPS:
        return
    signs = np.sign(voltage_v[jumps] - voltage_v[jumps - 1])[:-1]
    following = [current_a[jumps + later] - current_a[jumps + later - 1] for later in (0, 1, 2)]
    rises = [*(each[:-1] for each in following), np.diff(current_a[jumps])]
    # Of two signs the ranks are a straight line: this is Spearman's correlation.
    ranks = (_ranks(rise) for rise in rises if np.ptp(rise) > 0.0)
    known = max((abs(np.corrcoef(signs, each)[0, 1]) for each in ranks), default=0.0)
    if not known > min(max(_CHANCE / math.sqrt(len(signs)), _UNKNOWN), _KNOWN):
        raise UnusableError(
            "the current does not follow the voltage as a motor's does; a raw pulse-width modulation looks like this"
            " where it is sampled more slowly than it switches: record it behind a low-pass filter, or the duty cycle"
            " times the supply"
        )


def _ranks(values: FloatArray) -> FloatArray:
    """Return the rank of each value; equal ones share the mean of theirs."""
    _, which, counts = np.unique(values, return_inverse=True, return_counts=True)
    return np.asarray((np.cumsum(counts) - 0.5 * (counts - 1))[which])


def changes(share: FloatArray) -> int:
    """Count how often a voltage goes to another level and stays there for three samples."""
    steps = np.flatnonzero(np.abs(np.diff(share)) > _OFF)
    return int(np.count_nonzero(np.diff(steps, prepend=-3) >= 3))


def slow_rises(share: FloatArray, dt_s: float) -> int:
    """Count how often a voltage climbs by a fifth of its top more slowly than any switch."""
    block = max(round(_BLOCK_S / dt_s), 1)
    means = share[: len(share) // block * block].reshape(-1, block).mean(axis=1)
    count, climbs, extreme, since = 0, False, math.inf, 0
    for at, value in enumerate(means.tolist()):
        if climbs:
            extreme = max(extreme, value)
            if value < extreme - _CLIMB:
                climbs, extreme, since = False, value, at
            continue
        extreme = min(extreme, value)
        if value < extreme + _FOOT:
            since = at
        elif value > extreme + _CLIMB:
            count += at - since >= _SLOW_BLOCKS
            climbs, extreme = True, value
    return count


def gaps_s(is_off: NDArray[np.bool_], dt_s: float) -> FloatArray:
    """Return the lengths in seconds of the stretches without voltage between two with it."""
    steps = np.diff(np.flatnonzero(~is_off))
    return np.asarray((steps[steps > 1] - 1) * dt_s, dtype=np.float64)
