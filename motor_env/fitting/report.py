"""A motor at work for people and for programs: table, JSON, motor file, picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from motor_env.errors import InputError
from motor_env.fitting import places
from motor_env.fitting.identify import Operation
from motor_env.motor.data_sheet import Kind, Motor
from motor_env.motor.parameters import FloatArray, MotorParameters
from motor_env.plotting import COLOUR, drawing, save, subplots


def as_text(found: Operation, paths: Sequence[Path], reason: str) -> str:
    """Table with intervals, and what is not told."""
    lines = [
        f"{', '.join(map(str, paths))}: a motor at work ({reason}); model {' + '.join(found.model)}",
        f"  the voltage of a sample is {_HELD[found.record.hold]}",
    ]
    for one in found.quantities:
        told = f"{one.low:.4g} to {one.high:.4g}" if one.is_told else "not determined"
        lines.append(f"  {one.name:<16} {one.value:11.4g} {one.unit:<16} {told}")
    r2 = [f"{name} {value:.4f}" for name, value in _r2(found).items() if value is not None]
    lines.append(f"  R2 of the free-running model: {', '.join(r2)}")
    warmest = float(found.warmth_k.max())
    if warmest > 0.5:
        lines.append(f"  the winding warms by up to {warmest:.0f} K")
    return "\n".join([*lines, *(f"  note: {note}" for note in found.notes)])


_HELD = {
    "held": "held until the next one",
    "straight": "on a straight line to the next one",
    "late": "held since the one before",
}


def _r2(found: Operation) -> dict[str, float | None]:
    return {"current": found.r2_current, "speed": found.r2_speed}


def to_motor(found: Operation, name: str) -> Motor:
    """Motor file of an identified motor.

    Raises:
        InputError: current and speed were not both recorded: R, K, J and B are not known one by one.
    """
    if not found.record.seen.all():
        raise InputError("a motor file needs current and speed: the parameters are not known one by one")
    v = found.solution.values
    return replace(
        motor_of(v, name, "identified"),
        nominal_voltage_v=found.record.peaks[0],
        current_noise_a=float(v[places.NOISE_I]),
        speed_noise_rad_s=float(v[places.NOISE_W]),
        notes=found.notes,
    )


def motor_of(values: FloatArray, name: str, kind: Kind) -> Motor:
    """A motor of a fit's physical values, shape (places.N_VALUES,)."""
    return Motor(
        name=name,
        kind=kind,
        parameters=MotorParameters(
            resistance_ohm=float(values[places.R]),
            inductance_h=float(values[places.L]),
            back_emf_constant_v_s_per_rad=float(values[places.K]),
            torque_constant_n_m_per_a=float(values[places.K]),
            inertia_kg_m2=float(values[places.J]),
            viscous_friction_n_m_s_per_rad=float(values[places.B]),
        ),
        coulomb_friction_n_m=float(values[places.COULOMB]),
        brush_drop_v=float(values[places.DROP]),
    )


def plot_operation(found: Operation, title: str, path: Path) -> None:
    """Voltage, and measured beside modelled current and speed.

    Raises:
        InputError: the file cannot be written.
    """
    record, time_s = found.record, found.record.dt_s * np.arange(len(found.record.voltage_v))
    rows = [n for n in range(2) if record.seen[n]]
    with drawing():
        figure, axes = subplots(1 + len(rows), height_in=2.5 + 2.5 * len(rows))
        axes[0].plot(time_s, record.voltage_v, color=COLOUR["measured"], linewidth=1.0)
        axes[0].set_ylabel("voltage (V)")
        axes[0].set_title(title)
        for axis, n in zip(axes[1:], rows, strict=True):
            axis.plot(
                time_s, record.readings[:, n], color=COLOUR["measured"], linewidth=1.2, label="measured"
            )
            axis.plot(
                time_s,
                found.expected[:, n],
                color=COLOUR["healthy"],
                linewidth=1.0,
                label="free-running model",
            )
            axis.set_ylabel(("current (A)", "speed (rad/s)")[n])
            axis.legend(loc="upper right")
        axes[-1].set_xlabel("time (s)")
        figure.align_ylabels()
        save(figure, path)
