"""What healthy windows of a motor at work teach about its next window."""

from __future__ import annotations

import math
from collections.abc import Sequence, Sized
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from motor_env.diagnosis.healthy_spread import RECORD_SPREAD, next_window, usual_condition_windows
from motor_env.diagnosis.hypotheses import NAMES, FittedWindow
from motor_env.diagnosis.running.drives import FAR, NEEDED, driven, rms_volts, sorted_by_drive
from motor_env.diagnosis.running.pieces import Pieces, halvings_of, sections_of
from motor_env.diagnosis.running.replay import replay
from motor_env.diagnosis.running.scales import learn_scale, places_on_axes
from motor_env.diagnosis.running.windows import MOST_SAMPLES, WindowJudge, judge_of, over_speed, windows_of
from motor_env.fitting import places
from motor_env.fitting.identify import FEWEST_STEPS, UNSEEN_STEPS, Operation, identify_operation
from motor_env.fitting.problem import Solution
from motor_env.fitting.record import Record
from motor_env.fitting.recorded import MOST, from_recordings
from motor_env.fitting.uncertainty import beyond
from motor_env.fitting.window import LOAD, WindowFit, fit_window, without_load
from motor_env.motor.healthy import Drive, Healthy, Scale, Windows
from motor_env.motor.parameters import FloatArray
from motor_env.recordings.defects import UnusableError
from motor_env.recordings.recording import Recording

FEWEST_WINDOWS = 4
MOST_LEARNED = 40
_DEFAULT_WINDOWS, _SHORTEST = 20, 400  # samples
TEMPERATURE_K = 15.0
"""How much warmer or colder a healthy motor may be, one standard deviation."""
_TOLD = 0.1
"""Standard deviation of the drag beside an unknown load, as a share, up to which windows tell the two apart: as their
fits say, and as they scatter."""
_ONE_WAY = 0.9  # of the turns
_LEFT = 0.05
"""Torque that is another one in each interval, over the drag, from which on the model lacks something of the motor."""
_NOISES = slice(places.NOISE_I, places.WALK + 1)


def learn_windows(
    recordings: Sequence[Recording], window_s: float | None = None, *, steady: bool = False
) -> tuple[Healthy, list[FittedWindow]]:
    """What windows of a healthy motor at work teach about its next window, and their fits.

    The spread is that of windows, with their own errors as a prior worth 4 of them, and that from record to record.

    Args:
        recordings: of the healthy motor at work.
        window_s: length of a window; by default a twentieth of all recordings.
        steady: nothing but a fault moves the motor, as on a test bench: records are alike, no other temperature, the
            load and the sensors' offsets as in the recordings.

    Raises:
        UnusableError: no current and speed, too few windows, or no motor explains them.
    """
    if window_s is None:
        window_s = window_length_s(recordings, _DEFAULT_WINDOWS)
    parts = [part for recording in recordings for part in windows_of(recording, window_s)]
    if len(parts) < FEWEST_WINDOWS:
        raise UnusableError(f"{len(parts)} windows of {window_s:g} s; at least {FEWEST_WINDOWS} are needed")
    samples = sum(len(recording.time_s) for recording in recordings)
    chosen = recordings
    if samples > MOST:
        every = math.ceil(sum(len(part.time_s) for part in parts) / MOST)
        chosen = parts[:: min(every, len(parts) // FEWEST_WINDOWS)]
    joint = identify_operation(chosen, most=max(MOST, sum(len(one.time_s) for one in chosen)))
    if not joint.record.seen.all():
        raise UnusableError(NEEDED)
    if joint.record.steps_seen < FEWEST_STEPS:
        raise UnusableError(f"samples are missing at the voltage's steps: {UNSEEN_STEPS}")
    hold, speed, times = joint.record.hold, effective_speed(joint), 1.0 if _lacks(joint) else FAR
    records = [replace(from_recordings([part]), hold=hold) for part in parts]
    known, wanted, fits = told_by(records, joint, steady=steady)
    one_way = turns_one_way(joint)
    # A window's noise is less than that of all windows in one fit: it is where the fit of the next one begins.
    known[_NOISES] = np.median([fit.values[_NOISES] for fit in fits], axis=0)
    fits = [fit_window(record, known, wanted, one_way=one_way) for record in records]
    volts = [rms_volts(part) for part in parts]
    found = [over_speed(fit, known, speed) for fit in fits]
    centre, covariance, freedom = next_window(found, steady=steady)
    of, alike = np.zeros(len(parts), dtype=np.intp), 1.0
    drives: tuple[Drive, ...] = ()
    if not steady:
        moved = np.array([driven(part) for part in parts])
        of, alike = sorted_by_drive(moved, times)
        groups = [np.flatnonzero(of == n).tolist() for n in range(of.max() + 1)]
        drives = tuple(_drive(some, usual_condition_windows(some, groups), moved, found) for some in groups)
    ratios = [fit.log_values - centre for fit in found]
    spreads = [covariance + beyond(covariance, fit.covariance) for fit in fits]
    windows = Windows(
        window_s=window_s,
        terms=wanted,
        physical=known,
        hold=hold,
        dt_s=parts[0].dt_s,
        speed_rad_s=speed,
        one_way=one_way,
        rms_volts=(min(volts), max(volts)),
        peaks=tuple(np.max([record.peaks for record in records], axis=0).tolist()),
        window_excess=_squares(ratios, spreads) / _squares(ratios, [covariance] * len(fits)),
        drives=drives,
        alike=alike,
    )
    warm = 0.0 if steady else TEMPERATURE_K
    healthy = Healthy(len(found), freedom, NAMES, np.exp(centre), covariance, warm, windows=windows)
    return replace(healthy, windows=_with_scales(healthy, records, found, of)), found


def _lacks(joint: Operation) -> bool:
    """Whether the model leaves torque unexplained; where it does not, it errs under far drives only."""
    known = joint.solution.values
    drag = known[places.COULOMB] + known[places.B] * effective_speed(joint)
    return bool(known[places.WALK] > 0.0 or known[places.NOISE_T] > _LEFT * drag)


def turns_one_way(joint: Operation) -> bool:
    """Whether the motor turns one way, but for a twentieth of its turns."""
    speed = joint.expected[:, 1]
    return bool(abs(np.mean(speed)) > _ONE_WAY * np.mean(np.abs(speed)))


def told_by(
    records: Sequence[Record], joint: Operation, *, steady: bool = False
) -> tuple[FloatArray, tuple[str, ...], list[WindowFit]]:
    """Physical values that windows share, the terms of a window, and fits of windows with these.

    Where the motor turns one way, all that brakes is friction: near standstill a fit may seem to tell a load from it,
    by the shape that it gives the friction there. Elsewhere a load is a term where windows tell it.
    """
    known, wanted = known_of(joint.solution), joint.solution.names
    one_way, own = turns_one_way(joint), tuple(name for name in wanted if name not in LOAD)
    if one_way and own != wanted:
        known = known_of(without_load(joint.solution, float(np.mean(joint.expected[:, 1]))))
        wanted = tuple(name for name in wanted if name != "load_constant")
    if not one_way and not steady:
        with_load = (*own, *LOAD)
        fits = [fit_window(record, known, with_load) for record in records]
        told_sd = math.sqrt(np.median([fit.covariance[-1, -1] for fit in fits]))
        if max(told_sd, np.std([fit.logs[-1] for fit in fits])) < _TOLD:
            return known, with_load, fits
    if "load_walk" not in wanted:
        known[places.WALK] = 0.0
    if steady:
        wanted = tuple(name for name in wanted if not name.startswith(("offset", "load_constant")))
    return known, wanted, [fit_window(record, known, wanted, one_way=one_way) for record in records]


def _drive(
    pieces: Sequence[int], usual: Sequence[int], moved: FloatArray, found: Sequence[FittedWindow]
) -> Drive:
    """What windows that are driven alike teach, some of all, beside those of the usual drive."""
    centre, covariance, freedom = next_window(
        [found[n] for n in pieces], steady=False, usual=[found[n] for n in usual]
    )
    return Drive(tuple(pieces), moved[pieces[:: _every(pieces)]], np.exp(centre), covariance, freedom)


def window_length_s(recordings: Sequence[Recording], parts: int, least_s: float = 0.0) -> float:
    """A window of such a part of all recordings, but no longer than one that is fitted whole, nor than a recording."""
    dt_s = recordings[0].dt_s
    lengths_s = [len(recording.time_s) * recording.dt_s for recording in recordings]
    part_s = min(sum(lengths_s) / parts, MOST_SAMPLES * dt_s)
    return min(max(part_s, least_s, _SHORTEST * dt_s), *lengths_s)


def effective_speed(joint: Operation) -> float:
    """Root mean square of the speed, at which the drag is told best."""
    return max(float(np.sqrt(np.mean(np.square(joint.expected[:, 1])))), 1e-9)


def _squares(ratios: Sequence[FloatArray], spreads: Sequence[FloatArray]) -> float:
    """Sum of the squared distances per dimension."""
    pairs = zip(ratios, spreads, strict=True)
    return sum(float(off @ np.linalg.solve(spread, off)) / len(NAMES) for off, spread in pairs)


def _with_scales(
    healthy: Healthy, records: Sequence[Record], found: Sequence[FittedWindow], of: NDArray[np.intp]
) -> Windows:
    """What pieces of the windows teach of the next ones, and how these windows alarm by what the others teach.

    Each is compared with its drive's.
    """
    assert healthy.windows is not None  # noqa: S101  # it was learned from them
    judge, prior_sd = judge_of(healthy), RECORD_SPREAD * (healthy.temperature_k > 0.0)
    some = slice(None, None, _every(records))
    lengths = halvings_of(healthy.windows.window_s, min(len(record.voltage_v) for record in records))
    windows = [
        _pieces_of(judge.under(n), record, fit, lengths)
        for n, record, fit in zip(of[some].tolist(), records[some], found[some], strict=True)
    ]
    # Where the circuit is open all the time, a window has no pieces of a length.
    told = [n for n in range(len(lengths)) if all(len(window[n].logs) for window in windows)]
    lengths, windows = tuple(lengths[n] for n in told), [[window[n] for n in told] for window in windows]

    def taught(others: Sequence[Sequence[Pieces]]) -> tuple[Scale, ...]:
        return tuple(
            learn_scale(
                halvings, [window[n] for window in others], prior_sd, temperature_k=healthy.temperature_k
            )
            for n, halvings in enumerate(lengths)
        )

    scales = taught(windows)
    each = [taught([*windows[:n], *windows[n + 1 :]]) for n in range(len(windows))]
    places = [places_on_axes(scales[-1], window[-1]).distances[0] for window in windows]
    return replace(
        healthy.windows,
        scales=scales,
        most=tuple(np.max(places, axis=0).tolist()),
        replayed=tuple(replay(each, windows)),
    )


def _every(windows: Sized) -> int:
    """Every which window teaches: each of few, some of many."""
    return math.ceil(len(windows) / MOST_LEARNED)


def _pieces_of(judge: WindowJudge, record: Record, fit: FittedWindow, lengths: Sequence[int]) -> list[Pieces]:
    """Pieces of a window of each length; the longest is the window, as it was fitted."""
    at = fit.log_values - judge.reference.log_values
    window = Pieces(at[None], fit.log_covariance[None], np.zeros(1, dtype=np.intp))
    ends = np.linspace(0, len(record.voltage_v), 2 ** lengths[0] + 1).round().astype(int).tolist()
    sections = sections_of(judge, record, np.zeros(len(NAMES)), ends)
    return [
        *(sections.pieces(2 ** (lengths[0] - k), np.zeros(len(NAMES)), judge.peaks[2]) for k in lengths[:-1]),
        window,
    ]


def known_of(joint: Solution) -> FloatArray:
    """Physical values of the joint fit, without warmth: each window is taken at its own temperature."""
    known = joint.values
    known[[places.HEATING, places.COOLING]] = 0.0
    return known
