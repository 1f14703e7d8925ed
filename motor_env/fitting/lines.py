"""Periodic lines in the current of a motor at work, which are no part of the motor: they are taken off."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from motor_env.fitting import kernel
from motor_env.fitting.problem import Solution
from motor_env.fitting.record import Record
from motor_env.recordings.periodic_lines import PeriodicLine, constant_lines, periodic_lines

_SAME_LINE = 2.0  # bins of a spectrum


def without_lines(found: Solution, record: Record) -> tuple[Record, tuple[PeriodicLine, ...]]:
    """A record of a motor at work without the lines of its current, and these lines; each recording has its own.

    A line that the voltage has too is the motor's answer to it, and stays.

    Args:
        found: its fit.
        record: what was fitted.
    """
    if record.seen[0] == 0.0:
        return record, ()
    free = found.free[1]
    residual, readings = np.nan_to_num(record.readings[:, 0] - free[:, 2]), record.readings.copy()
    begins, every = np.flatnonzero(record.marks == kernel.BEGIN), []
    for first, end in zip(begins, [*begins[1:], len(residual)], strict=True):
        some, time_s = slice(first, end), record.dt_s * np.arange(end - first)
        own = [line.frequency_hz for line in periodic_lines(record.voltage_v[some], time_s)]
        beside = _SAME_LINE / (record.dt_s * (end - first))
        for line in constant_lines(residual[some], time_s, np.abs(free[some, 3])):
            if all(abs(line.frequency_hz - one) > beside for one in own):
                readings[some, 0] -= line.current_a(time_s)
                every.append(line)
    return replace(record, readings=readings) if every else record, tuple(every)
