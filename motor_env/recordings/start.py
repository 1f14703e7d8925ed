"""One start out of a recording: turned, aligned, with what is known of its supply and its sensors."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from motor_env.motor.parameters import FloatArray
from motor_env.recordings.alignment import Alignment, align
from motor_env.recordings.defects import UnusableError
from motor_env.recordings.periodic_lines import PeriodicLine
from motor_env.recordings.recording import Recording, cut
from motor_env.recordings.splitting import OFF, end_of_supply, stretches

_FEWEST_AFTER = 15


@dataclass(frozen=True, slots=True)
class Circuit:
    """What the user knows of the measuring circuit.

    Attributes:
        shunt_ohm: resistance in series with the motor: shunt and leads; it is not the motor's.
        sensor_lag_s: time constant of the current sensor; it is not fitted then.
    """

    shunt_ohm: float = 0.0
    sensor_lag_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Start:
    """What is fitted: one start, turned so that its current is positive.

    Attributes:
        time_s: shape (n_samples,).
        current_a: shape (n_samples,).
        speed_rad_s: shape (n_samples,), or None.
        voltage_v: measured voltage, shape (n_samples,), or None for a step.
        level_v: level of the step; 1 where the voltage is unknown (everything is then per volt).
        voltage_known: whether volts are volts.
        alignment: onset and quiet part.
        from_rest: whether the motor stands before; else it runs steadily under the first voltage.
        circuit: what is known of the measuring circuit.
        lines: ripple of constant frequency in the current of the running motor, which belongs to the supply.
        missing: which samples of current and speed are missing, shape (n_samples, 2); None for none.
    """

    time_s: FloatArray
    current_a: FloatArray
    speed_rad_s: FloatArray | None
    voltage_v: FloatArray | None
    level_v: float
    voltage_known: bool
    alignment: Alignment
    from_rest: bool = True
    circuit: Circuit = Circuit()
    lines: tuple[PeriodicLine, ...] = ()
    missing: NDArray[np.bool_] | None = None

    @property
    def dt_s(self) -> float:
        """Sampling interval."""
        return float((self.time_s[-1] - self.time_s[0]) / (len(self.time_s) - 1))

    @property
    def counted(self) -> NDArray[np.bool_]:
        """Which samples of the current count: all but the wild and the missing ones, shape (n_samples,)."""
        out = np.ones(len(self.time_s), dtype=np.bool_) if self.missing is None else ~self.missing[:, 0]
        out[[k for k in self.alignment.wild if k < len(out)]] = False
        return out

    @property
    def ripple_a(self) -> FloatArray:
        """The lines' current, from the onset on, shape (n_samples,)."""
        out = np.zeros(len(self.time_s))
        running = self.time_s >= self.alignment.onset_s
        for line in self.lines:
            out[running] += line.current_a(self.time_s[running])
        return out

    def shortened(self, count: int) -> Start:
        """The start with at most `count` samples after its onset."""
        return cut(self, slice(self.alignment.onset_index + count))


def prepare(recording: Recording, voltage_v: float | None = None, circuit: Circuit | None = None) -> Start:
    """Align a recording, leave out what follows the end of its supply, and decide what is known of that.

    Args:
        recording: as read.
        voltage_v: level of the supply, given by the user or the data sheet, for a recording without a voltage.
        circuit: what is known of the measuring circuit.

    Raises:
        UnusableError: no start in it, or too few samples after it; a shunt is given and no voltage is known; the
            voltage is on before the recording begins; samples of the voltage are missing where it rises, or of the
            current where it begins to.
    """
    alignment, missing = align(recording), recording.missing
    end = end_of_supply(recording, alignment)
    if end < len(recording.time_s) and end - alignment.onset_index >= _FEWEST_AFTER:
        return prepare(cut(recording, slice(end)), voltage_v, circuit)
    sign, after = alignment.sign, len(recording.time_s) - alignment.onset_index
    if missing is not None:
        after -= int(missing[alignment.onset_index :, 1].sum())
        _refuse_lost_onset(missing[:, 1], alignment.onset_index)
    if after < _FEWEST_AFTER:
        raise UnusableError(f"only {after} samples follow the start; at least {_FEWEST_AFTER} are needed")
    supply, measured, level = recording.voltage_v, None, 1.0 if voltage_v is None else abs(voltage_v)
    known = supply is not None or voltage_v is not None
    if supply is None and recording.duty is not None:
        supply = level * recording.duty
    if supply is not None:
        level, measured, sign = _supply(supply, sign, None if missing is None else missing[:, 0])
    if circuit is not None and circuit.shunt_ohm > 0.0 and not known:
        raise UnusableError("a shunt in series can be taken off only where the voltage is known")
    speed = None
    if recording.speed_rad_s is not None and np.ptp(recording.speed_rad_s) > 0.0:
        speed = recording.speed_rad_s * (1.0 if mean_tail(recording.speed_rad_s) >= 0.0 else -1.0)
    from_rest = measured is None or abs(float(measured[0])) < OFF * float(np.max(np.abs(measured)))
    alignment = replace(alignment, sign=sign, offset_a=sign * alignment.offset_a)
    if measured is not None and not from_rest:
        _refuse_begun(sign * recording.current_a, measured)
        alignment = replace(alignment, offset_a=0.0, n_quiet=0)
    current = sign * recording.current_a
    return Start(
        recording.time_s,
        current,
        speed,
        measured,
        level,
        known,
        alignment,
        from_rest,
        circuit or Circuit(),
        missing=None if missing is None else missing[:, 1:],
    )


def mean_tail(values: FloatArray) -> float:
    """Mean of the last tenth."""
    return float(np.mean(values[-max(len(values) // 10, 1) :]))


def _supply(
    voltage: FloatArray, sign: float, missing: NDArray[np.bool_] | None
) -> tuple[float, FloatArray | None, float]:
    """Level of a commanded step, or the measured curve: a command takes at most two values."""
    levels = np.unique(voltage if missing is None else voltage[~missing])
    tail = float(np.median(voltage[-max(len(voltage) // 4, 1) :]))
    if len(levels) == 1 or (len(levels) == 2 and 0.0 in levels):
        if tail == 0.0:
            raise UnusableError("the voltage is 0 at the end: this is no start under voltage")
        return abs(tail), None, sign
    # An even square wave has the median 0.
    largest = float(np.max(np.abs(voltage)))
    if missing is not None and missing.any():
        _refuse_lost_rise(voltage, missing, largest)
    return abs(tail) if abs(tail) > OFF * largest else largest, voltage, 1.0


def _refuse_begun(current: FloatArray, voltage: FloatArray) -> None:
    """Refuse a start that began before its recording: a running motor's current moves as its voltage does.

    Raises:
        UnusableError: the voltage is on in the first sample, and does not go where the current goes.
    """
    peak = int(np.argmax(np.abs(current - current[0])))
    moved = np.sign(current[peak] - current[0]) * (voltage[: peak + 1] - voltage[0])
    if moved.max() < OFF * np.max(np.abs(voltage)):
        raise UnusableError(
            f"the voltage is {voltage[0]:.3g} V in the first sample already: record from at least 1 ms before the"
            " motor is switched on"
        )


def _refuse_lost_onset(missing: NDArray[np.bool_], onset: int) -> None:
    """Refuse a current with a hole of several samples where it begins to rise: in it the onset and L may be anything.

    Raises:
        UnusableError: it is one.
    """
    for first, end in zip(*stretches(missing), strict=True):
        if first - 1 <= onset <= end and end - first > 1:
            raise UnusableError(
                f"{end - first} samples of the current are missing where it begins to rise: when it did is not known"
            )


def _refuse_lost_rise(voltage: FloatArray, missing: NDArray[np.bool_], largest: float) -> None:
    """Refuse a measured curve with a hole in which it changes.

    Raises:
        UnusableError: it is one.
    """
    firsts, ends = stretches(missing)
    before, after = np.maximum(firsts - 1, 0), np.minimum(ends, len(voltage) - 1)
    change = np.abs(voltage[after] - voltage[before])
    if change.max() > OFF * largest:
        n = int(np.argmax(change))
        raise UnusableError(
            f"samples of the voltage are missing where it goes from {voltage[before[n]]:.3g} to"
            f" {voltage[after[n]]:.3g} V: the start cannot be fitted without them"
        )
