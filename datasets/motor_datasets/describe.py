"""What a recipe samples, in words with units, and a sheet of examples."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

from motor_datasets.arrays import columns
from motor_env.simulation.disturbances import PER_MOTOR
from motor_env.simulation.recipes import FACTORS, Recipe


def describe(recipe: Recipe) -> str:
    """What the recipe samples, one line a quantity."""
    timing, sensor = recipe.timing, recipe.sensor
    lines = [f"recipe {recipe.name}", "motor"]
    lines += [f"  {f.name} = {getattr(recipe.motor, f.name):g}" for f in fields(recipe.motor)]
    duty, level = recipe.duty, f"{recipe.supply.voltage_v:g} V"
    if duty is None:
        lines.append(f"supply: step to {level}")
    else:
        lines.append(f"supply: up to {level}, each of these profiles as often: {', '.join(duty.profiles)}")
        lines.append("  hold_s: {:g} to {:g}, log-uniform, each start".format(*duty.hold_s))
    lines.append("relative standard deviations (supply: each start; the others: each motor)")
    lines += [f"  {name}: {100.0 * getattr(recipe.spread, name):g} %" for name in FACTORS]
    lines.append("classes")
    for fault_class, share in zip(recipe.classes, recipe.class_probabilities, strict=True):
        ranges = [
            f"{part.kind} {100 * part.severity:g} %"
            + ("" if part.severity_to is None else f" to {100 * part.severity_to:g} %")
            for part in fault_class.parts
            if part.kind is not None
        ]
        lines.append(f"  {fault_class.name}: {100 * share:.3g} %" + "".join(f", {text}" for text in ranges))
    lines.append(
        f"starts of each motor: {recipe.starts_per_motor}; healthy reference starts among them: {recipe.healthy_starts}"
    )
    lines.append(
        f"samples: {timing.n_samples} at {timing.sampling_rate_hz:g} Hz, {timing.quiet_s:g} s before the step"
        f" and {timing.duration_s:g} s after it"
    )
    lines.append(f"channels: {', '.join(recipe.channels)}; current noise {sensor.current_noise_a:g} A")
    if "speed" in sensor.channels:
        lines.append(f"speed noise {sensor.speed_noise_rad_s:g} rad/s")
    if recipe.field is not None:
        lines.append("field (uniform; torques relative to the viscous torque at no-load speed)")
        for name, (low, high) in recipe.priors.items():
            lines.append(f"  {name}: {low:g} to {high:g}, each {'motor' if name in PER_MOTOR else 'start'}")
        for name in ("ripple_hz", "sensor_lag_s", "sensor_range_a", "adc_bits", "missing_fraction"):
            lines.append(f"  {name} = {getattr(recipe.field, name):g}")
    if recipe.shifts:
        lines.append(f"shifts: {', '.join(shift.name for shift in recipe.shifts)}")
    lines.append("columns of its data sets")
    for column in columns(recipe):
        unit = f" [{column.unit}]" if column.unit else ""
        lines.append(f"  {column.name}{unit}: {column.meaning}")
    return "\n".join(lines)


def draw_sheet(recipe: Recipe, seed: int, path: Path) -> None:
    """Draw four examples of each class, the current over time: the start above, the settled level below.

    Raises:
        OSError: the picture cannot be written.
    """
    import numpy as np
    from matplotlib.figure import Figure

    from motor_datasets.generate import generate_arrays

    data = generate_arrays(recipe, seed, 80 * len(recipe.classes))
    figure = Figure(figsize=(2.2 * len(recipe.classes) + 1.0, 5.0), layout="constrained")
    axes = figure.subplots(2, len(recipe.classes), sharex="row", sharey="row", squeeze=False)
    time_ms = 1e3 * data.time_s
    late = time_ms > 0.5 * time_ms[-1]
    for column, name in enumerate(data.class_names):
        rows = np.flatnonzero(data.class_name == name)[:4]
        axes[0, column].set_title(name.replace("_", " "), fontsize=9)
        for row in rows:
            axes[0, column].plot(time_ms, data.X[row, 0], linewidth=0.8)
            axes[1, column].plot(time_ms[late], data.X[row, 0][late], linewidth=0.6)
        axes[1, column].set_xlabel("time / ms")
    quantity = "current / A" if recipe.sensor.channels[0] == "current" else "speed / (rad/s)"
    for axis in axes[:, 0]:
        axis.set_ylabel(quantity)
    axes[0, 0].set_xlim(time_ms[0], min(25.0, time_ms[-1]))
    figure.savefig(path, dpi=120)
