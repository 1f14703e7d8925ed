"""The command `motor-datasets`: parse, call, print. Each command loads what it needs when it runs."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from cyclopts import App

from motor_env import __version__
from motor_env.common import console
from motor_env.common.errors import require_extra

if TYPE_CHECKING:
    from motor_datasets.generate import Plan


app = App(name="motor-datasets", help="Labelled transients of your motor.", version=__version__)


@app.command
def generate(
    recipe: str,
    /,
    *,
    cases: console.Whole,
    seed: console.Whole,
    out: str,
    sampling_rate_hz: float | None = None,
    duration_s: float | None = None,
    quiet_s: float | None = None,
    current_noise_a: float | None = None,
    speed_noise_rad_s: float | None = None,
    channels: str | None = None,
    motor: str | None = None,
    workers: console.Whole | None = None,
    scheduler: str | None = None,
    resume: bool = False,
    json_: bool = False,
    dry_run: bool = False,
) -> int:
    """Write labelled transients to a new folder. The same seed gives the same bytes.

    Example: motor-datasets generate bench --cases 4000 --seed 1 --out out/bench

    Args:
        recipe: Recipe of the motors: paper (noise only), bench (tolerances), bench-full (all fault kinds), field (dry
            friction, temperature, supply, load, sensor errors), operation (motors at work: another voltage, which is a
            channel, and load in each case), easy, medium, hard, small, sensor (those of the environments), or a recipe
            TOML.
        cases: Number of transients.
        seed: Random seed, 0 .. 2^64 - 1.
        out: New folder, or a URL such as s3://bucket/prefix. An existing one is never overwritten.
        sampling_rate_hz: Samples a second.
        duration_s: Time recorded after the step of the supply.
        quiet_s: Time recorded before the step, on top of the duration.
        current_noise_a: Standard deviation of a current sample.
        speed_noise_rad_s: Standard deviation of a speed sample, with --channels current,speed.
        channels: Measured channels, comma between: current, or current,speed.
        motor: Catalogue name (paper), or a motor TOML.
        workers: Number of processes that write; one by default, with a Dask cluster all of its workers.
        scheduler: Address of a Dask scheduler whose workers write, such as tcp://10.0.0.1:8786.
        resume: Finish an interrupted generation.
        json_: Print a summary as JSON.
        dry_run: Print what would be written, and write nothing.
    """
    require_extra("pyarrow", "datasets")
    with console.working("loading"):
        from motor_datasets.folder import generate_dataset, seconds_per_case
        from motor_datasets.generate import make_plan
        from motor_datasets.manifest import folder_of
        from motor_env.motor.data_sheet import load_motor, usable_parameters
        from motor_env.motor.parameters import Channel
        from motor_env.simulation.named_recipes import changed_recipe, load_recipe

    chosen = changed_recipe(
        load_recipe(recipe),
        sampling_rate_hz=sampling_rate_hz,
        duration_s=duration_s,
        quiet_s=quiet_s,
        current_noise_a=current_noise_a,
        speed_noise_rad_s=speed_noise_rad_s,
        channels=tuple(channels.split(",")) if channels is not None else None,
    )
    if motor is not None:
        needs_speed = Channel.SPEED in chosen.sensor.channels
        chosen = replace(chosen, motor=usable_parameters(load_motor(motor), needs_speed=needs_speed))
    plan = make_plan(chosen, cases, seed)
    folder = folder_of(out)
    summary: dict[str, object] = {
        "out": str(folder),
        "recipe": chosen.name,
        "seed": seed,
        "cases": cases,
        "cases_of_shifts": plan.cases_of_all - cases,
        "classes": list(chosen.class_names),
        "channels": [str(channel) for channel in chosen.channels],
        "samples": chosen.timing.n_samples,
        "files": len(plan.files),
        "bytes_uncompressed": plan.bytes_uncompressed,
    }
    if dry_run:
        summary["seconds"] = round(plan.cases_of_all * seconds_per_case(chosen, seed) / (workers or 1), 1)
    else:
        with _progress(plan.cases_of_all) as advance, _cluster(scheduler) as all_workers:
            start, count = time.perf_counter(), workers or all_workers
            manifest = generate_dataset(
                chosen, cases, seed, folder, workers=count, resume=resume, on_progress=advance
            )
        summary["bytes"] = manifest.bytes
        summary["seconds"] = round(time.perf_counter() - start, 3)
    if json_:
        print(console.json_text(summary))
    elif dry_run:
        print(
            f"would write {_counted(plan)} of {chosen.timing.n_samples} samples in {len(plan.files)} files to"
            f" {folder}: {plan.bytes_uncompressed / 1e6:.1f} MB before compression, some {summary['seconds']} s"
        )
    else:
        print(
            f"wrote {_counted(plan)} of {chosen.timing.n_samples} samples in {len(plan.files)} files,"
            f" {manifest.bytes / 1e6:.1f} MB: {folder}"
        )
    return 0


def _counted(plan: Plan) -> str:
    """Cases asked for, and those of the shifts beside them."""
    shifted = plan.cases_of_all - plan.cases
    return f"{plan.cases} cases" + (f" and {shifted} of shifts" if shifted else "")


@app.command
def verify(folder: str, /, *, json_: bool = False) -> int:
    """Check every file of a data set against its digest. Exit status 1 if one is missing, damaged or foreign.

    Example: motor-datasets verify out/bench

    Args:
        folder: A data set: its folder or URL.
        json_: Print the findings as a JSON array.
    """
    require_extra("pyarrow", "datasets")
    from motor_datasets.manifest import folder_of, problems

    with console.working(f"checking {folder}"):
        defects = problems(folder_of(folder))
    if json_:
        print(console.json_text(defects))
    else:
        print("\n".join(defects) if defects else f"{folder}: every file is whole")
    return 1 if defects else 0


@app.command
def describe(recipe: str, /, *, picture: Path | None = None, seed: console.Whole = 0) -> int:
    """Print the priors and columns of a recipe, or of a data set's recipe, and draw examples.

    Example: motor-datasets describe field --picture out/field.png

    Args:
        recipe: Name of a recipe, a recipe TOML, or the folder or URL of a data set.
        picture: PNG or SVG file for the examples.
        seed: Random seed of the examples.
    """
    from motor_datasets.card import describe, draw_sheet
    from motor_env.simulation.named_recipes import load_recipe

    if "://" in recipe or Path(recipe).is_dir():
        require_extra("pyarrow", "datasets")
        from motor_datasets.manifest import folder_of, read_manifest

        chosen = read_manifest(folder_of(recipe)).recipe
    else:
        chosen = load_recipe(recipe)
    print(describe(chosen))
    if picture is not None:
        require_extra("pyarrow", "datasets")
        from motor_env.common.files import replacing

        with replacing(picture) as temporary:
            draw_sheet(chosen, seed, temporary)
    return 0


@app.command
def export(folder: str, file: Path, /, *, split: str | None = None) -> int:
    """Write a data set, or one split of it, as .npz (NumPy) or .mat (MATLAB, Octave).

    Example: motor-datasets export out/bench out/bench_test.mat --split test

    Args:
        folder: A data set: its folder or URL.
        file: New file, .npz or .mat.
        split: train, validation, test or shift_NAME; train, validation and test together where it is left out.
    """
    require_extra("pyarrow", "datasets")
    from motor_datasets.loaders import export as export_arrays, load

    with console.working(f"writing {file}"):
        dataset = load(folder, split)
        export_arrays(dataset, file)
    print(f"wrote {len(dataset)} cases: {file}")
    return 0


@contextmanager
def _cluster(scheduler: str | None) -> Iterator[int]:
    """Joblib's own processes, or the workers of a Dask cluster: by default so many write."""
    if scheduler is None:
        yield 1
        return
    require_extra("distributed", "dask")
    import joblib
    from distributed import Client

    with Client(scheduler) as client, joblib.parallel_config(backend="dask"):
        yield max(sum(client.nthreads().values()), 2)  # a single one would be this process


@contextmanager
def _progress(cases: int) -> Iterator[Callable[[int], None]]:
    """A progress bar that also shows cases a second."""
    from rich.progress import ProgressColumn, Task
    from rich.text import Text

    class Rate(ProgressColumn):
        """Cases a second."""

        def render(self, task: Task) -> Text:
            rate = task.finished_speed or task.speed
            count = f"{task.completed:.0f} / {task.total:.0f} cases"
            return Text(count if rate is None else f"{count}, {rate:.0f} a second")

    with console.working("writing cases", cases, Rate()) as update:
        yield lambda count: update(advance=count)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `motor-datasets` and return its exit status."""
    return console.run(app, arguments)
