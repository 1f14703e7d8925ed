"""One start as instruments and programs save it that nobody here wrote: other headers, units, marks, settings, clocks.

Among their columns are those that may be taken for a current.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np

from motor_env.motor.parameters import FloatArray

RATE_HZ, COUNT, ONSET, VOLTS = 2_000.0, 600, 60, 12.0


@dataclass(frozen=True, slots=True)
class ForeignFile:
    """A file.

    Attributes:
        text: of it.
        currents_a: each measured current in it; none where it holds none.
        named: choices of columns that a user makes who knows the instrument.
        rate_hz: sampling rate that the user has to tell.
        tolerance_a: rounding.
    """

    text: str
    currents_a: tuple[FloatArray, ...] = ()
    named: tuple[str, ...] = ()
    rate_hz: float | None = None
    tolerance_a: float = 2e-3


def _signals(seed: int) -> tuple[FloatArray, ...]:
    """Time, voltage, current and speed of a start, as sensors with noise show them."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(COUNT) / RATE_HZ
    since = np.maximum(np.arange(COUNT) - ONSET, 0) / RATE_HZ
    noise = rng.standard_normal((3, COUNT))
    current = (5.0 + 0.3 * seed) * (np.exp(-since / 0.06) - np.exp(-since / 0.002)) + 0.2 * (since > 0.0)
    speed = 240.0 * (1.0 - np.exp(-since / 0.06))
    return time_s, VOLTS * (since > 0.0) + 0.02 * noise[0], current + 0.01 * noise[1], speed + 0.4 * noise[2]


TIME, VOLTAGE, CURRENT, SPEED = _signals(0)
SECOND_VOLTAGE, SECOND, SECOND_SPEED = _signals(1)[1:]
RPM: FloatArray = SPEED * 30.0 / np.pi
ROWS: FloatArray = np.arange(float(COUNT))
PWM: FloatArray = np.rint(3_499.0 * (ROWS > ONSET) - 0.001 * RPM * (ROWS % 3))  # a loop's command
ANGLE: FloatArray = np.cumsum(np.maximum(SPEED, 0.0)) / RATE_HZ
TEMPERATURE = 23.0 + 0.1 * np.sin(ROWS / 40.0)
COUNTS = np.rint(CURRENT / 0.0132 + 512.0)
CLAMP = 0.1 * CURRENT  # V, of a current clamp of 100 mV/A
BEGIN_S, STEP_S = -0.02, 1.0 / RATE_HZ
SCOPE: FloatArray = TIME + BEGIN_S
WHEN = [datetime(2026, 1, 31, 23, 59, 59, 950_000, tzinfo=UTC) + timedelta(seconds=t) for t in TIME.tolist()]


def _lines(above: Sequence[str], row: str, *columns: Sequence[Any] | FloatArray, **more: Any) -> ForeignFile:
    """Lines above, and one for each sample."""
    rows = (row.format(*cells) for cells in zip(*columns, strict=True))
    return ForeignFile("\n".join([*above, *rows]) + "\n", **{"currents_a": (CURRENT,)} | more)


def _table(
    columns: dict[str, FloatArray], *currents: FloatArray, mark: str = ",", decimal: str = ".", form: str = ".6f",
    **more: Any,
) -> ForeignFile:  # fmt: skip
    made = _lines((), mark.join([f"{{:{form}}}"] * len(columns)), *columns.values(), **more)
    text = mark.join(columns) + "\n" + made.text.replace(".", decimal)
    return replace(made, text=text, currents_a=currents)


_REGBOT = [
    "% logfile from a robot",
    "%  1    time 0.007 sec",
    "%  2  3  4   (mission 0), state 2, entered (thread 1, line 0), events 0x0 (bit-flags)",
    "%  5  6 Motor voltage [V] left, right: 2.00 2.00",
    "%  7  8 Motor current left, right [A]: -0.094 0.084",
    "%  9 10 Wheel velocity [r/s] left, right: 0.0000 -0.0000",
    "% 11    Battery voltage [V]: 12.50",
]
_STATES = (0.0 * ROWS, 0.0 * ROWS + 2.0, 0.0 * ROWS + 1.0)

INSTRUMENTS: dict[str, Callable[[], ForeignFile]] = {
    "Rigol DS1000Z": lambda: _lines(
        ["X,CH1,CH2,Start,Increment,", f"Sequence,Volt,Volt,{BEGIN_S:.6e},{STEP_S:.6e}"],
        "{:.0f},{:.3e},{:.3e},", ROWS, VOLTAGE, CLAMP, named=("current=CH2*10",), tolerance_a=1e-2,
    ),
    "Tektronix MDO3000": lambda: _lines(
        ["Model,MDO3014", "Firmware Version,1.30", "", "Point Format,Y,Y", "Horizontal Units,s,",
         f"Sample Interval,{STEP_S:g},", f"Record Length,{COUNT},", "Gating,0.0% to 100.0%,",
         "Probe Attenuation,10,1", "Vertical Units,V,A", "Vertical Offset,0,0", ",,", "Label,Supply,Motor",
         "TIME,CH1,CH2"],
        "{:.6e},{:.4f},{:.4f}", SCOPE, VOLTAGE, CURRENT,
    ),
    "Keysight InfiniiVision": lambda: _lines(
        ["x-axis,1,2", "second,Volt,Ampere"], "{:+.6E},{:+.5E},{:+.5E}", SCOPE, VOLTAGE, CURRENT
    ),
    "Siglent SDS1000X": lambda: _lines(
        [f"Record Length,Analog:{COUNT},", f"Sample Interval,Analog:{STEP_S:E},", "Vertical Units,CH1:V CH2:A,,",
         "Vertical Scale,CH1:2.00 CH2:1.00,,", "Horizontal Units,s,", "Horizontal Scale,0.02,", "Source,CH1,CH2",
         "Second,Value,Value"],
        "{:.11f},{:.5f},{:.5f}", SCOPE, VOLTAGE, CURRENT,
    ),
    "PicoScope 6": lambda: _lines(
        ["Time,Channel A,Channel B", "(ms),(V),(mV)", ""],
        "{:.8f},{:.8f},{:.8f}", 1e3 * SCOPE, VOLTAGE, 1e3 * CLAMP, named=("current=Channel B*10",),
    ),
    "Saleae Logic 2": lambda: _lines(  # a divider by 4 before the supply
        ["Time [s],Channel 0,Channel 1"], "{:.9f},{:.6f},{:.6f}", TIME + 1.0, VOLTAGE / 4.0, CLAMP,
        named=("voltage=Channel 0*4", "current=Channel 1*10"),
    ),
    "Rohde & Schwarz RTB2000": lambda: _lines(
        ["in s,C1 in V,C2 in A"], "{:.7E},{:.7E},{:.7E}", SCOPE, VOLTAGE, CURRENT
    ),
    "LeCroy WaveRunner": lambda: _lines(
        ["LECROYWR204M,51184,Waveform", f"Segments,1,SegmentSize,{COUNT}", "Segment,TrigTime,TimeSinceSegment1",
         "#1,22-Jan-2015 11:35:11,0", "Time,Ampl"],
        "{:.8g},{:.8f}", SCOPE, CURRENT, named=("current=Ampl:A",),
    ),
    "Owon HDS242": lambda: _lines(
        ["Channel             :,CH1,CH2", "Probe attenuation   :,1X,1X", "Voltage per ADC value:,40.00mV,20.00mV",
         f"Time interval       :,{1e6 * STEP_S:.2f}uS", "", "index,CH1_Voltage(mV),CH2_Voltage(mV)"],
        "{:.0f},{:.2f},{:.2f}", ROWS, 1e3 * VOLTAGE, 1e3 * CLAMP, named=("current=CH2_Voltage*10",),
    ),
    "Hantek DSO5000": lambda: _lines(
        ["#CHANNEL:CH2", f"#CLOCK={STEP_S:.9f}S", f"#SIZE={COUNT}", "#UNITS:V", ""], "{:.6f}", CLAMP,
        named=("current=1*10",),
    ),
    "Arduino, counts": lambda: _lines(
        ["micros,A0,A1"], "{:.0f},{:.0f},{:.0f}", 1e6 * TIME + 3e7, np.rint(40.96 * VOLTAGE) + 0.0, COUNTS,
        named=(f"voltage=A0*{1.0 / 40.96:.7f}", "current=A1*0.0132-6.7584"), tolerance_a=7e-3,
    ),
    "serial monitor": lambda: _lines(  # a clock that is coarser than the samples
        (), "{} -> {:.2f},{:.1f}", [f"{when:%H:%M:%S.%f}"[:-3] for when in WHEN[200:]], VOLTAGE[:400],
        1e3 * CURRENT[:400], currents_a=(CURRENT[:400],), named=("voltage=2:V", "current=3:mA"), rate_hz=RATE_HZ,
    ),
    "logger of a German plant": lambda: _lines(
        ["Zeitstempel;Spannung;Strom", ";V;mA"], "{};{};{}", [f"{when:%d.%m.%Y %H:%M:%S,%f}" for when in WHEN],
        *([f"{each:.3f}".replace(".", ",") for each in column.tolist()] for column in (VOLTAGE, 1e3 * CURRENT)),
    ),
    "spreadsheet without a time": lambda: _lines(
        ["U (V)\tI (mA)"], "{:.3f}\t{:.2f}", VOLTAGE, 1e3 * CURRENT, rate_hz=RATE_HZ
    ),
}  # fmt: skip
"""After their makers' documented formats."""

OTHERS: dict[str, Callable[[], ForeignFile]] = {
    "speed last, no unit": lambda: _table({"Time": TIME, "MotorCurrent": CURRENT, "Velo": SPEED}, CURRENT),
    "no current, command and speed": lambda: _table({"t [s]": TIME, "Commanded_PWM": PWM, "Velo": SPEED}),
    "command last, mA": lambda: _table({"t [s]": TIME, "I_motor": 1e3 * CURRENT, "Commanded_PWM": PWM}, CURRENT),
    "decimal commas": lambda: _table(
        {"Zeit [s]": TIME, "Ankerstrom": CURRENT, "Motordrehzahl": RPM}, CURRENT, mark=";", decimal=","
    ),
    "german, wanted and measured": lambda: _table(
        {"Zeit [s]": TIME, "Strom Soll [A]": np.rint(CURRENT), "Strom Ist [A]": CURRENT}, CURRENT, mark="\t"
    ),
    "voltage twice": lambda: _table({"time_s": TIME, "U [V]": VOLTAGE, "X": 2.0 * VOLTAGE + 1.0}),
    "one channel": lambda: _table(
        {"Time [s]": TIME, "Channel 0": VOLTAGE, "Channel 1": CLAMP}, CURRENT, named=("current=Channel 1*10",)
    ),
    "probe in mV": lambda: _table(
        {"Time [s]": TIME, "U (V)": VOLTAGE, "CH2 (mV)": 1e3 * CLAMP}, CURRENT, named=("current=CH2 (mV)*10",)
    ),
    "counts": lambda: _table(
        {"micros": 1e6 * TIME, "A0": COUNTS, "pos": np.floor(100.0 * ANGLE)}, CURRENT, form=".0f",
        named=("current=A0*0.0132-6.7584",), tolerance_a=7e-3,
    ),
    "two motors": lambda: _table(
        {"t": TIME, "I1 [A]": CURRENT, "U1 [V]": VOLTAGE, "I2 [A]": SECOND, "U2 [V]": SECOND_VOLTAGE},
        CURRENT, SECOND,
    ),
    "three motors in mA": lambda: _table(
        {"Time (ms)": 1e3 * TIME, "M1 current (mA)": 1e3 * CURRENT, "M2 current (mA)": 1e3 * SECOND,
         "M3 current (mA)": 1e3 * CURRENT[::-1], "M1 speed (rpm)": RPM, "M2 speed (rpm)": SECOND_SPEED * 9.549},
        CURRENT, SECOND, CURRENT[::-1], mark="\t", decimal=",",
    ),
    "legend": lambda: _lines(
        _REGBOT, "{:.4f} " * 11, TIME, *_STATES, VOLTAGE, SECOND_VOLTAGE, CURRENT, SECOND, SPEED, SECOND_SPEED,
        VOLTS - 0.02 * CURRENT, currents_a=(CURRENT, SECOND),
    ),
    "legend without a current": lambda: _lines(
        [*_REGBOT[:3], "%  5  6 Wheel velocity [rad/s] left, right: 0 0", "%  7  8  9 Gyro x,y,z [deg/s]: 0 0 0"],
        "{:.4f} " * 9, TIME, *_STATES, SPEED, SECOND_SPEED, CLAMP, 2.0 * CLAMP, TEMPERATURE, currents_a=(),
    ),
    "times rounded, decimal commas": lambda: _table(
        {"Zeit (ms)": np.floor(1e3 * TIME + 1e-6), "Strom (mA)": 1e3 * CURRENT, "Winkel": ANGLE},
        CURRENT, mark=";", decimal=",",
    ),
    "current clock": lambda: _table(
        {"Current_Time": TIME, "Iq": CURRENT, "Id": 0.1 * SECOND}, CURRENT,
        named=("time=Current_Time:s", "current=Iq:A"),
    ),
}  # fmt: skip
