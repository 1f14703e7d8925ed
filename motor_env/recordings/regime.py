"""Whether a recording is a start, for `motor_env.identification`, or a motor at work; measured in volts and seconds."""

from __future__ import annotations

from typing import Literal

import numpy as np

from motor_env.motor.parameters import FloatArray
from motor_env.recordings.defects import UnusableError
from motor_env.recordings.recording import Recording

Regime = Literal["auto", "start", "operation"]
REGIMES: tuple[Regime, ...] = ("auto", "start", "operation")
_OFF, _ON = 0.1, 0.8
_REVERSED_SHARE = 0.005
_BETWEEN_SHARE = 0.1
_FEWEST_CHANGES = 3
_MOST_SWITCHES = 5
_PAUSE_S = 0.1
_FEWEST_JUMPS, _KNOWN = 50, 0.25  # jumps of the voltage, and their correlation with the current's
_LEVEL, _OFF_LEVEL = 0.05, 0.02  # of the way between two levels; share of the samples that may lie off them


def work_seen(recording: Recording) -> str | None:
    """What shows that a recording is no plain start, in words; None for starts.

    A start is a supply that goes from off to on and stays; short gaps in it are a bouncing switch. Several starts in
    one file lie apart by pauses.
    """
    voltage = recording.voltage_v if recording.voltage_v is not None else recording.duty
    if voltage is None:
        return None
    top = float(np.quantile(np.abs(voltage), 0.999))
    if top == 0.0:
        return None
    share = voltage / top
    if min(float(np.mean(share > _OFF)), float(np.mean(share < -_OFF))) > _REVERSED_SHARE:
        return "the voltage reverses"
    levels = np.digitize(np.abs(share), (_OFF, _ON))
    if float(np.mean(levels == 1)) > _BETWEEN_SHARE and changes(np.abs(share)) >= _FEWEST_CHANGES:
        return "the voltage takes several levels"
    pauses = gaps_s(levels == 0, recording.dt_s)
    if len(pauses) >= _MOST_SWITCHES and float(np.median(pauses)) < _PAUSE_S:
        return "the voltage is switched faster than a motor stops"
    return None


def refuse_work(recording: Recording) -> None:
    """Refuse a log of a motor at work where a start is wanted.

    Raises:
        UnusableError: the voltage shows that the recording is no plain start.
    """
    reason = work_seen(recording)
    if reason is not None:
        raise UnusableError(
            f"a log of a motor at work ({reason}), and no start: learn its motor from healthy logs with"
            " `motor-env commission --window SECONDS`"
        )


def refuse_aliased(voltage_v: FloatArray, current_a: FloatArray) -> None:
    """Refuse a raw pulse-width modulation that was sampled more slowly than it switches: its mean is not in the record.

    Its voltage jumps between two levels; the current knows nothing of the jumps, neither at once nor until the next.

    Raises:
        UnusableError: it is one.
    """
    low, high = np.quantile(voltage_v, (0.02, 0.98))
    off = np.minimum(np.abs(voltage_v - low), np.abs(voltage_v - high))
    jumps = np.flatnonzero(np.diff((voltage_v > 0.5 * (low + high)).astype(np.int8))) + 1
    jumps = jumps[(jumps > 1) & (jumps < len(voltage_v) - 2)]
    if len(jumps) < _FEWEST_JUMPS or float(np.mean(off > _LEVEL * (high - low))) > _OFF_LEVEL:
        return
    signs = np.sign(voltage_v[jumps] - voltage_v[jumps - 1])[:-1]
    following = [current_a[jumps + later] - current_a[jumps + later - 1] for later in (0, 1, 2)]
    rises = [*(each[:-1] for each in following), np.diff(current_a[jumps])]
    if max(abs(float(np.corrcoef(signs, each)[0, 1])) for each in rises if np.ptp(each) > 0.0) < _KNOWN:
        raise UnusableError(
            "the voltage is a raw pulse-width modulation, sampled more slowly than it switches, so that its mean is"
            " unknown: record it behind a low-pass filter, or the duty cycle times the supply"
        )


def changes(share: FloatArray) -> int:
    """How often a voltage goes to another level and stays there for three samples."""
    steps, settled = np.abs(share[1:] - share[:-1]) > _OFF, 0
    last = -3
    for k in np.flatnonzero(steps):
        settled += int(k - last >= 3)
        last = int(k)
    return settled


def gaps_s(is_off: FloatArray, dt_s: float) -> FloatArray:
    """Lengths in seconds of the stretches without voltage between two with it."""
    edges = np.diff(is_off.astype(np.int8))
    begins, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
    ends = ends[ends > begins[0]] if len(begins) else ends[:0]
    count = min(len(begins), len(ends))
    return np.asarray((ends[:count] - begins[:count]) * dt_s, dtype=np.float64)
