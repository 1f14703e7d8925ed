"""The command `motor-datasets`: parse, call, print. Each command loads what it needs when it runs."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import App, Parameter

from motor_env import __version__, console

if TYPE_CHECKING:
    from motor_env.parameters import MotorParameters
    from motor_env.recipes import Recipe

app = App(name="motor-datasets", help="Labelled transients of your motor.", version=__version__)


@app.command
def generate(
    recipe: str,
    /,
    *,
    cases: int,
    seed: int,
    out: Path,
    sampling_rate_hz: float | None = None,
    duration_s: float | None = None,
    quiet_s: float | None = None,
    current_noise_a: float | None = None,
    channels: str | None = None,
    motor: str | None = None,
    json_: Annotated[bool, Parameter(name="--json", negative=())] = False,
    dry_run: Annotated[bool, Parameter(negative=())] = False,
) -> int:
    """Write labelled start-up transients to a new folder. The same seed gives the same bytes.

    Example: motor-datasets generate bench --cases 4000 --seed 1 --out out/bench

    Args:
        recipe: What is sampled: paper (noise only) or bench (every motor and start differs by its tolerances).
        cases: Number of transients.
        seed: Random seed, 0 .. 2^64 - 1.
        out: New folder. An existing one is never overwritten.
        sampling_rate_hz: Samples a second.
        duration_s: Time recorded after the step of the supply.
        quiet_s: Time recorded before the step, on top of the duration.
        current_noise_a: Standard deviation of a current sample.
        channels: Measured channels, comma between: current, or current,speed.
        motor: Catalogue name (paper), or a motor TOML.
        json_: Print a summary as JSON.
        dry_run: Print what would be written, write nothing.
    """
    console.require_extra("pyarrow", "datasets")
    from motor_datasets import storage
    from motor_datasets.generate import generate_dataset

    chosen = _recipe(recipe, sampling_rate_hz, duration_s, quiet_s, current_noise_a, channels, motor)
    plan = storage.make_plan(chosen, cases, seed)
    summary: dict[str, object] = {
        "out": str(out),
        "recipe": chosen.name,
        "seed": seed,
        "cases": cases,
        "classes": list(chosen.class_names),
        "channels": [str(channel) for channel in chosen.sensor.channels],
        "samples": chosen.timing.n_samples,
        "files": len(plan.files),
        "bytes_uncompressed": plan.bytes_uncompressed,
    }
    if not dry_run:
        with _progress(cases) as advance:
            manifest = generate_dataset(chosen, cases, seed, out, on_progress=advance)
        summary["bytes"] = manifest.bytes
    if json_:
        print(json.dumps(summary))
    else:
        verb = "would write" if dry_run else "wrote"
        size = plan.bytes_uncompressed if dry_run else manifest.bytes
        print(
            f"{verb} {cases} cases of {chosen.timing.n_samples} samples in {len(plan.files)} files,"
            f" {size / 1e6:.1f} MB{' before compression' if dry_run else ''}: {out}"
        )
    return 0


def _recipe(
    name: str,
    sampling_rate_hz: float | None,
    duration_s: float | None,
    quiet_s: float | None,
    current_noise_a: float | None,
    channels: str | None,
    motor: str | None,
) -> Recipe:
    from dataclasses import replace

    from motor_env.recipes import named_recipe

    recipe = named_recipe(name)
    times = {"sampling_rate_hz": sampling_rate_hz, "duration_s": duration_s, "quiet_s": quiet_s}
    sensor = {
        "current_noise_a": current_noise_a,
        "channels": None if channels is None else tuple(channels.split(",")),
    }
    return replace(
        recipe,
        timing=replace(recipe.timing, **_given(times)),
        sensor=replace(recipe.sensor, **_given(sensor)),
        motor=recipe.motor if motor is None else _motor(motor),
    )


def _given(options: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in options.items() if value is not None}


def _motor(name_or_path: str) -> MotorParameters:
    from motor_env.motor_file import load_motor

    return load_motor(name_or_path).parameters


@contextmanager
def _progress(cases: int) -> Iterator[Callable[[int], object]]:
    """A progress bar with rate and time left, on standard error and only on a terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        BarColumn(),
        TextColumn("{task.completed:.0f} / {task.total:.0f} cases"),
        TimeRemainingColumn(),
    )
    console_of_errors = Console(stderr=True)
    with Progress(*columns, console=console_of_errors, disable=not console_of_errors.is_terminal) as bar:
        task = bar.add_task("", total=cases)
        yield lambda count: bar.advance(task, count)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `motor-datasets` and return its exit status."""
    return console.run(app, arguments)


if __name__ == "__main__":
    sys.exit(main())
