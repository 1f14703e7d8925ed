"""One start of a motor as common instruments save it, after their makers' documented formats."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import numpy as np
from numpy.typing import NDArray

from motor_env import PAPER_MOTOR, Scenario, SensorParameters, Timing, simulate

RATE_HZ = 5_000.0
PROBE_V_PER_A = 0.1  # a current clamp of 100 mV/A
COUNTS_PER_A, COUNTS_PER_V, ZERO_COUNT = 75.76, 40.96, 512.0
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Capture:
    """A start as it is: times, supply, current."""

    time_s: Array
    voltage_v: Array
    current_a: Array

    @property
    def rows(self) -> Iterable[tuple[float, float, float]]:
        return zip(self.time_s.tolist(), self.voltage_v.tolist(), self.current_a.tolist(), strict=True)


@dataclass(frozen=True)
class InstrumentFile:
    """What an instrument saved.

    Attributes:
        text: content of the file.
        columns: choices of columns that the user has to add.
        sampling_rate_hz: the same of the rate.
        has_voltage: whether the supply is in it.
        resolution_a: steps of the current.
    """

    text: str
    columns: tuple[str, ...] = ()
    sampling_rate_hz: float | None = None
    has_voltage: bool = True
    resolution_a: float = 1e-3


def capture() -> Capture:
    """A start of the paper's motor at 12 V under 5 mA of noise."""
    sensor = SensorParameters(current_noise_a=0.005)
    timing = Timing(duration_s=0.1, quiet_s=0.02)
    start = simulate(Scenario(PAPER_MOTOR, sensor=sensor, timing=timing), seed=7, cases=[0])
    each = round(10_000.0 / RATE_HZ)
    time_s = start.time_s[::each] - 0.02
    return Capture(time_s, start.voltage_v[0, ::each], start.measurements[0, 0, ::each])


def rigol(given: Capture) -> InstrumentFile:
    """DS1000Z: samples counted, start and increment in the row of the units."""
    begin, step = given.time_s[0], 1.0 / RATE_HZ
    lines = ["X,CH1,CH2,Start,Increment,", f"Sequence,Volt,Volt,{begin:.6e},{step:.6e}"]
    lines += [f"{k},{v:.3e},{PROBE_V_PER_A * i:.3e}," for k, (_, v, i) in enumerate(given.rows)]
    return InstrumentFile(_text(lines), ("current=CH2*10",), resolution_a=1e-2)


def tektronix(given: Capture) -> InstrumentFile:
    """MDO3000: settings in rows, units among them."""
    lines = [
        "Model,MDO3014",
        "Firmware Version,1.30",
        "",
        "Waveform Type,ANALOG,ANALOG",
        "Point Format,Y,Y",
        "Horizontal Units,s,",
        "Horizontal Scale,0.04,",
        f"Sample Interval,{1.0 / RATE_HZ:g},",
        f"Record Length,{len(given.time_s)},",
        "Gating,0.0% to 100.0%,",
        "Probe Attenuation,10,1",
        "Vertical Units,V,A",
        "Vertical Offset,0,0",
        "Vertical Scale,2,1",
        ",,",
        "Label,Supply,Motor",
        "TIME,CH1,CH2",
    ]
    return InstrumentFile(_text([*lines, *(f"{t:.6e},{v:.4f},{i:.4f}" for t, v, i in given.rows)]))


def keysight(given: Capture) -> InstrumentFile:
    """InfiniiVision: channels are numbers, units stand in the second row."""
    lines = ["x-axis,1,2", "second,Volt,Ampere"]
    return InstrumentFile(_text([*lines, *(f"{t:+.6E},{v:+.5E},{i:+.5E}" for t, v, i in given.rows)]))


def siglent(given: Capture) -> InstrumentFile:
    """SDS1000X-E: the units of the channels stand among the settings."""
    lines = [
        f"Record Length,Analog:{len(given.time_s)},",
        f"Sample Interval,Analog:{1.0 / RATE_HZ:E},",
        "Vertical Units,CH1:V CH2:A,,",
        "Vertical Scale,CH1:2.00 CH2:1.00,,",
        "Vertical Offset,CH1:-6.00000 CH2:0.00000,,",
        "Horizontal Units,s,",
        "Horizontal Scale,0.02,",
        "Model Number,SDS1104X-E,",
        "Serial Number,SDSMMEBX2R0000,",
        "Source,CH1,CH2",
        "Second,Value,Value",
    ]
    return InstrumentFile(_text([*lines, *(f"{t:.11f},{v:.5f},{i:.5f}" for t, v, i in given.rows)]))


def picoscope(given: Capture) -> InstrumentFile:
    """PicoScope 6: a row of units in brackets, which change with the range, and an empty line."""
    lines = ["Time,Channel A,Channel B", "(ms),(V),(mV)", ""]
    rows = (f"{1e3 * t:.8f},{v:.8f},{1e3 * PROBE_V_PER_A * i:.8f}" for t, v, i in given.rows)
    return InstrumentFile(_text([*lines, *rows]), ("current=Channel B*10",))


def saleae(given: Capture) -> InstrumentFile:
    """Logic 2: analog channels in volt, without a unit; a divider by 4 before the supply."""
    rows = (f"{t + 1.0:.9f},{v / 4.0:.6f},{PROBE_V_PER_A * i:.6f}" for t, v, i in given.rows)
    columns = ("voltage=Channel 0*4", "current=Channel 1*10")
    return InstrumentFile(_text(["Time [s],Channel 0,Channel 1", *rows]), columns)


def rohde_schwarz(given: Capture) -> InstrumentFile:
    """RTB2000: names and units in one header."""
    rows = (f"{t:.7E},{v:.7E},{i:.7E}" for t, v, i in given.rows)
    return InstrumentFile(_text(["in s,C1 in V,C2 in A", *rows]))


def lecroy(given: Capture) -> InstrumentFile:
    """WaveRunner: one channel a file, no units."""
    lines = [
        "LECROYWR204M,51184,Waveform",
        f"Segments,1,SegmentSize,{len(given.time_s)}",
        "Segment,TrigTime,TimeSinceSegment1",
        "#1,22-Jan-2015 11:35:11,0",
        "Time,Ampl",
    ]
    rows = (f"{t:.8g},{i:.8f}" for t, _, i in given.rows)
    return InstrumentFile(_text([*lines, *rows]), ("current=Ampl:A",), has_voltage=False)


def owon(given: Capture) -> InstrumentFile:
    """HDS242: samples counted, their interval among the settings."""
    lines = [
        "Channel             :,CH1,CH2",
        "Probe attenuation   :,1X,1X",
        "Voltage per ADC value:,40.00mV,20.00mV",
        f"Time interval       :,{1e6 / RATE_HZ:.2f}uS",
        "",
        "index,CH1_Voltage(mV),CH2_Voltage(mV)",
    ]
    rows = (f"{k},{1e3 * v:.2f},{1e3 * PROBE_V_PER_A * i:.2f}" for k, (_, v, i) in enumerate(given.rows))
    return InstrumentFile(_text([*lines, *rows]), ("current=CH2_Voltage*10",))


def hantek(given: Capture) -> InstrumentFile:
    """DSO5000: one channel a file, one number a line."""
    lines = ["#CHANNEL:CH2", f"#CLOCK={1.0 / RATE_HZ:.9f}S", f"#SIZE={len(given.time_s)}", "#UNITS:V", ""]
    rows = (f"{PROBE_V_PER_A * i:.6f}" for _, _, i in given.rows)
    return InstrumentFile(_text([*lines, *rows]), ("current=1*10",), has_voltage=False)


def arduino(given: Capture) -> InstrumentFile:
    """A sketch that prints micros() and two analog inputs, in counts."""
    rows = (
        f"{round(1e6 * t) + 30_000_000},{round(COUNTS_PER_V * v)},{round(COUNTS_PER_A * i + ZERO_COUNT)}"
        for t, v, i in given.rows
    )
    zero_a = ZERO_COUNT / COUNTS_PER_A
    columns = (f"voltage=A0*{1.0 / COUNTS_PER_V:.7f}", f"current=A1*{1.0 / COUNTS_PER_A:.7f}-{zero_a:.6f}")
    return InstrumentFile(_text(["micros,A0,A1", *rows]), columns, resolution_a=1.0 / COUNTS_PER_A)


def serial_monitor(given: Capture) -> InstrumentFile:
    """Arduino's serial monitor with its clock, which is coarser than the samples: the rate has to be told."""
    rows = (
        f"{datetime(2026, 1, 31, 11, tzinfo=UTC) + timedelta(seconds=t):%H:%M:%S.%f}"[:-3]
        + f" -> {v:.2f},{1e3 * i:.1f}"
        for t, v, i in given.rows
    )
    return InstrumentFile(_text(rows), ("voltage=2:V", "current=3:mA"), sampling_rate_hz=RATE_HZ)


def logger(given: Capture) -> InstrumentFile:
    """A logger of a German plant: date and time of a clock, decimal commas, milliampere."""
    when = (
        f"{datetime(2026, 1, 31, 23, 59, 59, 950_000, tzinfo=UTC) + timedelta(seconds=t):%d.%m.%Y %H:%M:%S.%f}"
        for t in given.time_s
    )
    rows = (
        f"{clock};{v:.3f};{1e3 * i:.2f}".replace(",", ";")
        for clock, (_, v, i) in zip(when, given.rows, strict=True)
    )
    body = (row[:20] + row[20:].replace(".", ",") for row in rows)
    return InstrumentFile(_text(["Zeitstempel;Spannung;Strom", ";V;mA", *body]))


def bare(given: Capture) -> InstrumentFile:
    """A spreadsheet without a time."""
    rows = (f"{v:.3f}\t{1e3 * i:.2f}" for _, v, i in given.rows)
    return InstrumentFile(_text(["U (V)\tI (mA)", *rows]), sampling_rate_hz=RATE_HZ)


INSTRUMENTS = (
    rigol,
    tektronix,
    keysight,
    siglent,
    picoscope,
    saleae,
    rohde_schwarz,
    lecroy,
    owon,
    hantek,
    arduino,
    serial_monitor,
    logger,
    bare,
)


def _text(lines: Iterable[str]) -> str:
    return "\n".join(lines) + "\n"
