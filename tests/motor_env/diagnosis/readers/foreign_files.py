"""Files of programs that nobody here wrote: other headers, units, marks, several motors, commands, counts, legends.

Each holds the same start, and among its columns those that may be taken for a current.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from motor_env.motor.parameters import FloatArray

RATE_HZ = 2_000.0
COUNT = 600
_ONSET = 60
VOLTS = 12.0


@dataclass(frozen=True, slots=True)
class ForeignFile:
    """A file.

    Attributes:
        text: of it.
        currents_a: each measured current in it; none where it holds none.
        named: what a user who knows the instrument makes of suggestions with blanks.
        tolerance_a: rounding.
    """

    text: str
    currents_a: tuple[FloatArray, ...]
    named: tuple[str, ...] = ()
    tolerance_a: float = 2e-3


def _signals(seed: int) -> tuple[FloatArray, ...]:
    """Time, voltage, current and speed of a start, as sensors with noise show them."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(COUNT) / RATE_HZ
    since = np.maximum(np.arange(COUNT) - _ONSET, 0) / RATE_HZ
    running = since > 0.0
    speed = 240.0 * (1.0 - np.exp(-since / 0.06))
    current = (5.0 + 0.3 * seed) * (np.exp(-since / 0.06) - np.exp(-since / 0.002)) + 0.2 * running
    voltage = VOLTS * running + 0.02 * rng.standard_normal(COUNT)
    return (
        time_s,
        voltage,
        current + 0.01 * rng.standard_normal(COUNT),
        speed + 0.4 * rng.standard_normal(COUNT),
    )


TIME, VOLTAGE, CURRENT, SPEED = _signals(0)
SECOND_VOLTAGE, SECOND, SECOND_SPEED = _signals(1)[1:]
RPM: FloatArray = SPEED * 30.0 / np.pi
PWM: FloatArray = np.rint(
    3_499.0 * (TIME[_ONSET] < TIME) - 0.001 * RPM * (np.arange(COUNT) % 3)
)  # a loop's command
ANGLE: FloatArray = np.cumsum(np.maximum(SPEED, 0.0)) / RATE_HZ
TEMPERATURE = 23.0 + 0.1 * np.sin(np.arange(COUNT) / 40.0)
COUNTS = np.rint(CURRENT / 0.0132 + 512.0)


def _table(
    columns: dict[str, FloatArray], *, mark: str = ",", decimal: str = ".", form: str = ".6f", above: str = ""
) -> str:
    table = np.column_stack(list(columns.values()))
    rows = (mark.join(format(value, form) for value in row).replace(".", decimal) for row in table)
    return "\n".join([above + mark.join(columns), *rows]) + "\n"


def _file(columns: dict[str, FloatArray], *currents: FloatArray, **options: str) -> ForeignFile:
    return ForeignFile(_table(columns, **options), currents)


def _legend(lines: list[str], columns: list[FloatArray], *currents: FloatArray) -> ForeignFile:
    rows = (" ".join(f"{value:.4f}" for value in row) + " " for row in np.column_stack(columns))
    return ForeignFile("\n".join([*lines, *rows]) + "\n", currents)


def _named(file: ForeignFile, *named: str, tolerance_a: float = 2e-3) -> ForeignFile:
    return ForeignFile(file.text, file.currents_a, named, tolerance_a)


_REGBOT = [
    "% logfile from a robot",
    "%  1    time 0.007 sec",
    "%  2  3  4   (mission 0), state 2, entered (thread 1, line 0), events 0x0 (bit-flags)",
    "%  5  6 Motor voltage [V] left, right: 2.00 2.00",
    "%  7  8 Motor current left, right [A]: -0.094 0.084",
    "%  9 10 Wheel velocity [r/s] left, right: 0.0000 -0.0000",
    "% 11 12 Get data time [us]: 100 +ctrl 420",
    "% 13    Battery voltage [V]: 12.50",
]
_STATES: list[FloatArray] = [np.zeros(COUNT), np.full(COUNT, 2.0), np.ones(COUNT)]
_TIMES_US: list[FloatArray] = [np.arange(100.0, 100.0 + COUNT) % 7, np.arange(float(COUNT)) % 3]
_BATTERY: FloatArray = 12.5 - 0.02 * CURRENT

MAKERS: dict[str, Callable[[], ForeignFile]] = {
    "speed last, no unit": lambda: _file({"Time": TIME, "MotorCurrent": CURRENT, "Velo": SPEED}, CURRENT),
    "no current, speed": lambda: _file({"Time": TIME, "Velo": SPEED}),
    "no current, command and speed": lambda: _file({"t [s]": TIME, "Commanded_PWM": PWM, "Velo": SPEED}),
    "command last": lambda: _file({"t [s]": TIME, "I_motor": CURRENT, "Commanded_PWM": PWM}, CURRENT),
    "command last, mA": lambda: _file({"t [s]": TIME, "I_motor": 1e3 * CURRENT, "Commanded_PWM": PWM}, CURRENT),
    "decimal commas": lambda: _file(
        {"Zeit [s]": TIME, "Ankerstrom": CURRENT, "Motordrehzahl": RPM}, CURRENT, mark=";", decimal=","
    ),
    "german, wanted and measured": lambda: _file(
        {"Zeit [s]": TIME, "Strom Soll [A]": np.rint(CURRENT), "Strom Ist [A]": CURRENT}, CURRENT, mark="\t"
    ),
    "setpoint alone": lambda: _file({"time_s": TIME, "Current setpoint [A]": np.rint(CURRENT), "rpm": RPM}),
    "limit and measured": lambda: _file(
        {"time_s": TIME, "Phase [A]": CURRENT, "Current limit [A]": np.full(COUNT, 9.0)}, CURRENT
    ),
    "temperature last": lambda: _file(
        {"ms": 1e3 * TIME, "Motor_Current": CURRENT, "Temp": TEMPERATURE}, CURRENT, mark=";"
    ),
    "temperature alone": lambda: _file({"ms": 1e3 * TIME, "volts": VOLTAGE, "Temp": TEMPERATURE}),
    "angle, nameless kind": lambda: _file({"time_s": TIME, "speed [rpm]": RPM, "phi": ANGLE}),
    "voltage and speed alone": lambda: _file({"time_s": TIME, "voltage_v": VOLTAGE, "speed_rad_s": SPEED}),
    "voltage twice": lambda: _file({"time_s": TIME, "U [V]": VOLTAGE, "X": 2.0 * VOLTAGE + 1.0}),
    "speed twice": lambda: _file({"time_s": TIME, "speed [rpm]": RPM, "X": SPEED}),
    "units unknown here": lambda: _file(
        {"time_s": TIME, "Torque [Nm]": 0.05 * CURRENT, "v [m/s]": 0.03 * SPEED, "P [W]": VOLTAGE * CURRENT}
    ),
    "a unit of something else": lambda: _file({"time_s": TIME, "rpm": RPM, "Y [bar]": 3.0 + 0.1 * CURRENT}),
    "one channel": lambda: _named(
        _file({"Time [s]": TIME, "Channel 0": VOLTAGE, "Channel 1": 0.1 * CURRENT}, CURRENT),
        "current=Channel 1*10",
    ),
    "probe in mV": lambda: _named(
        _file({"Time [s]": TIME, "U (V)": VOLTAGE, "CH2 (mV)": 100.0 * CURRENT}, CURRENT),
        "current=CH2 (mV)*10",
    ),
    "counts": lambda: _named(
        _file({"micros": 1e6 * TIME, "A0": COUNTS, "pos": np.floor(100.0 * ANGLE)}, CURRENT, form=".0f"),
        "current=A0*0.0132-6.7584", tolerance_a=7e-3,
    ),
    "counts of current": lambda: _named(
        _file({"micros": 1e6 * TIME, "current": np.rint(1e3 * CURRENT), "pwm": PWM}, CURRENT, form=".0f"),
        "current=current*0.001+0",
    ),
    "two motors": lambda: _file(
        {"t": TIME, "I1 [A]": CURRENT, "U1 [V]": VOLTAGE, "I2 [A]": SECOND, "U2 [V]": SECOND_VOLTAGE},
        CURRENT, SECOND,
    ),
    "two motors, no units": lambda: _file(
        {"t": TIME, "left_current": CURRENT, "left_pwm": PWM, "right_current": SECOND, "right_pwm": PWM},
        CURRENT, SECOND, mark=";",
    ),
    "three motors in mA": lambda: _file(
        {"Time (ms)": 1e3 * TIME, "M1 current (mA)": 1e3 * CURRENT, "M2 current (mA)": 1e3 * SECOND,
         "M3 current (mA)": 1e3 * CURRENT[::-1], "M1 speed (rpm)": RPM, "M2 speed (rpm)": SECOND_SPEED * 9.549},
        CURRENT, SECOND, CURRENT[::-1], mark="\t", decimal=",",
    ),
    "legend": lambda: _legend(
        _REGBOT,
        [TIME, *_STATES, VOLTAGE, SECOND_VOLTAGE, CURRENT, SECOND, SPEED, SECOND_SPEED, *_TIMES_US, _BATTERY],
        CURRENT, SECOND,
    ),
    "legend without a current": lambda: _legend(
        [*_REGBOT[:3], "%  5  6 Wheel velocity [rad/s] left, right: 0 0", "%  7  8  9 Gyro x,y,z [deg/s]: 0 0 0"],
        [TIME, *_STATES, SPEED, SECOND_SPEED, 0.1 * CURRENT, 0.2 * CURRENT, TEMPERATURE],
    ),
    "legend of single columns": lambda: _legend(
        ["# column 1: time [s]", "# column 2: PWM [%]", "# column 3: motor current [mA]", "# column 4: tacho [V]"],
        [TIME, np.arange(float(COUNT)) % 2, 1e3 * CURRENT, 0.02 * SPEED],
        CURRENT,
    ),
    "times rounded": lambda: _file(
        {"time": np.round(TIME, 3), "current (A)": CURRENT, "speed (rpm)": RPM}, CURRENT
    ),
    "times rounded, decimal commas": lambda: _file(
        {"Zeit (ms)": np.floor(1e3 * TIME + 1e-6), "Strom (mA)": 1e3 * CURRENT, "Winkel": ANGLE},
        CURRENT, mark=";", decimal=",",
    ),
    "time without a name": lambda: _named(
        _file({"X": TIME, "Y": TEMPERATURE, "current (A)": CURRENT}, CURRENT), "time=X:s"
    ),
    "current clock": lambda: _named(
        _file({"Current_Time": TIME, "Iq": CURRENT, "Id": 0.1 * SECOND}, CURRENT), "time=Current_Time:s", "current=Iq:A"
    ),
    "another unit of large": lambda: _file({"time_s": TIME, "current (A)": 1e3 * CURRENT, "rpm": RPM}),
}  # fmt: skip
