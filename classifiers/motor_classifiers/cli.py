"""The command `motor-classifiers`: parse, call, print. Each command loads what it needs when it runs."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import App, Parameter

from motor_env import __version__, console

if TYPE_CHECKING:
    from motor_classifiers.benchmark import BenchmarkResult
    from motor_classifiers.prediction import Opinion
    from motor_env.recipes import Recipe

app = App(
    name="motor-classifiers",
    help="Learned opinions on a motor's start, and their benchmark.",
    version=__version__,
)

Json = Annotated[bool, Parameter(name="--json", negative=())]


def _require_extras() -> None:
    for module in ("sklearn", "torch", "skops", "safetensors", "jinja2", "pyarrow"):
        console.require_extra(module, "classifiers")


@app.command
def train(
    dataset: Path, /, *, out: Path, method: str = "residual-qda", seed: int = 0, json_: Json = False
) -> int:
    """Train a method on the training split of a data set.

    Example: motor-classifiers train out/bench --method network --out out/network.model

    Args:
        dataset: Folder made by motor-datasets generate.
        out: New file of the model. An existing one is never overwritten.
        method: threshold, physical-lda, physical-forest, residual-qda, raw-logistic or network.
        seed: Random state of methods that need one.
        json_: Print a summary as JSON.
    """
    _require_extras()
    from motor_classifiers.methods import make_method
    from motor_classifiers.persistence import save_model
    from motor_datasets.loaders import load

    if out.exists():
        raise console.InputError(f"{out}: exists already, and is not overwritten; give another name")
    cases = load(dataset, "train")
    model = make_method(method, cases.recipe, seed)
    with _status(f"training {method} on {len(cases)} cases"):
        model.fit(cases.X, cases.class_name)
        save_model(model, cases.recipe, method, out)
    summary = {"method": method, "n_train": len(cases), "out": str(out)}
    print(json.dumps(summary) if json_ else f"trained {method} on {len(cases)} cases: {out}")
    return 0


@app.command
def evaluate(
    model: Path, dataset: Path, /, *, split: str = "test", seed: int = 0, json_: Json = False
) -> int:
    """Judge a model on a split of a data set, beside the Bayes limit on the same cases.

    Example: motor-classifiers evaluate out/network.model out/bench

    Args:
        model: File made by motor-classifiers train.
        dataset: Folder made by motor-datasets generate.
        split: train, validation or test.
        seed: Of the bootstrap.
        json_: Print the scores as JSON.
    """
    _require_extras()
    from motor_classifiers.benchmark import evaluate_model
    from motor_classifiers.persistence import load_model
    from motor_datasets.loaders import load

    fitted, recipe, method = load_model(model)
    with _status("judging"):
        scored = evaluate_model(fitted, recipe, load(dataset, split), seed)
    scored = {"model": str(model), "method": method, "dataset": str(dataset), "split": split, **scored}
    if json_:
        print(json.dumps(scored))
    else:
        print(f"{method} on {scored['n_test']} cases of split {split}")
        for name in ("accuracy", "macro_f1", "false_alarm_rate", "missed_detection_rate", "level_error"):
            if scored[name] is not None:
                low, high = scored[f"{name}_low"], scored[f"{name}_high"]
                print(f"  {name.replace('_', ' '):22} {scored[name]:7.4f}   {low:.4f} to {high:.4f}")
        print(f"  {'Bayes limit accuracy':22} {scored['bayes_accuracy']:7.4f}   on the same cases")
    return 0


@app.command
def predict(files: list[Path], /, *, model: Path, split: str | None = None, json_: Json = False) -> int:
    """Opinion of a model on recordings, or on the cases of data sets.

    Example: motor-classifiers predict examples/startup_capture.csv --model out/network.model

    Exit status: 0 all healthy, 1 any fault, 2 a file that cannot be read, 3 no fault but some undecided.

    A model knows the motors of its recipe and no others (docs/classifiers.md); for captures of real motors, whose
    supply ramps and whose brushes drop a voltage, ask motor-env diagnose too.

    Args:
        files: Recordings with columns time_s, current_a and, where measured, voltage_v and speed_rad_s; or folders
            of data sets.
        model: File made by motor-classifiers train.
        split: Of data sets: train, validation or test; all by default.
        json_: Print one array with one object a file or case.
    """
    _require_extras()
    from motor_classifiers.persistence import load_model
    from motor_classifiers.prediction import overall_status

    fitted, recipe, _ = load_model(model)
    rows: list[dict[str, Any]] = []
    given: list[Opinion] = []
    unreadable = False
    for path in files:
        try:
            found = _opinions(fitted, recipe, path, split)
        except console.InputError as error:
            print(f"motor-classifiers: {error}", file=sys.stderr)
            rows.append({"file": str(path), "error": str(error)})
            unreadable = True
            continue
        given += found
        for n, opinion in enumerate(found):
            rows.append({"file": str(path), **({"row": n} if path.is_dir() else {}), **opinion.as_json()})
        if not json_:
            _print_opinions(path, found)
    if json_:
        print(json.dumps(rows))
    return int(console.ExitStatus.BAD_INPUT if unreadable else overall_status(given))


def _opinions(model: Any, recipe: Recipe, path: Path, split: str | None) -> list[Opinion]:
    from motor_classifiers.prediction import opinions, predict_recording
    from motor_datasets.loaders import load

    if not path.is_dir():
        return [predict_recording(model, recipe, path)]
    cases = load(path, split)
    _check_same_axis(cases.recipe, recipe, path)
    return opinions(model, recipe, cases.X)


def _check_same_axis(cases: Recipe, trained: Recipe, path: Path) -> None:
    if (cases.timing, cases.sensor.channels) != (trained.timing, trained.sensor.channels):
        raise console.InputError(
            f"{path}: has another time axis or other channels than the model was trained on"
        )


def _print_opinions(path: Path, found: list[Opinion]) -> None:
    from collections import Counter

    if path.is_dir():
        counts = Counter(opinion.verdict for opinion in found)
        print(
            f"{path}: {len(found)} cases: {', '.join(f'{n} {verdict}' for verdict, n in counts.most_common())}"
        )
        return
    opinion = found[0]
    if opinion.reason:
        print(f"{path}: no opinion: {opinion.reason}")
        return
    size = f", severity near {100.0 * opinion.severity:.0f} %" if opinion.verdict != "healthy" else ""
    doubt = " (undecided)" if opinion.status is console.ExitStatus.UNDECIDED else ""
    print(f"{path}: {opinion.verdict}{doubt}, probability {opinion.probability:.2f}{size}")


@app.command
def benchmark(
    *,
    out: Path = Path("out/benchmark"),
    recipe: str = "bench",
    methods: str | None = None,
    n_train: int = 2000,
    n_test: int = 2000,
    seed: int = 0,
    sampling_rate_hz: float | None = None,
    duration_s: float | None = None,
    current_noise_a: float | None = None,
    channels: str | None = None,
    json_: Json = False,
) -> int:
    """Train all methods, judge all on the same unseen motors beside the Bayes limit; write a report.

    Example: motor-classifiers benchmark --out out/benchmark

    Exit status: 0 done, 1 a method scored significantly above the Bayes limit (then something leaks), 2 wrong use.

    Args:
        out: Folder for report.html and results.json.
        recipe: What motors are drawn from: bench or paper.
        methods: Names with commas between; all by default.
        n_train: Motors to learn from.
        n_test: Motors to be judged on.
        seed: Random seed.
        sampling_rate_hz: Samples a second.
        duration_s: Time recorded after the step of the supply.
        current_noise_a: Standard deviation of a current sample.
        channels: Measured channels: current, or current,speed.
        json_: Print what stands in results.json.
    """
    _require_extras()
    from dataclasses import replace

    from motor_classifiers.benchmark import Options, result_rows, write_results
    from motor_classifiers.methods import METHODS
    from motor_env.recipes import named_recipe

    chosen = named_recipe(recipe)
    timing = {"sampling_rate_hz": sampling_rate_hz, "duration_s": duration_s}
    sensor: dict[str, Any] = {
        "current_noise_a": current_noise_a,
        "channels": tuple(channels.split(",")) if channels else None,
    }
    chosen = replace(
        chosen,
        timing=replace(chosen.timing, **{k: v for k, v in timing.items() if v is not None}),
        sensor=replace(chosen.sensor, **{k: v for k, v in sensor.items() if v is not None}),
    )
    names = tuple(methods.split(",")) if methods else tuple(METHODS)
    options = Options(chosen, names, n_train, n_test, seed)
    _check_writable(out)
    result = _run_with_progress(options)
    report = write_results(result, out)
    if json_:
        print(json.dumps(result_rows(result)))
    else:
        _print_table(result)
        print(f"report: {report}")
    for name in result.leaks:
        print(f"motor-classifiers: check failed: {name} scored above the Bayes limit", file=sys.stderr)
    return 1 if result.leaks else 0


def _check_writable(out: Path) -> None:
    """Fail before the work, not after it."""
    from motor_env.files import replacing

    if out.exists() and not out.is_dir():
        raise console.InputError(f"{out}: is a file, not a folder")
    probe = out / ".writable"
    with replacing(probe):
        pass
    probe.unlink()


def _run_with_progress(options: Any) -> BenchmarkResult:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    from motor_classifiers.benchmark import count_steps, run_benchmark

    columns = (BarColumn(30), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("{task.description}"))
    errors = Console(stderr=True)
    with Progress(*columns, console=errors, disable=not errors.is_terminal) as bar:
        task = bar.add_task("starting", total=count_steps(options))
        begun = 0

        def step(sentence: str) -> None:
            nonlocal begun
            bar.update(task, completed=begun, description=sentence)
            begun += 1
            if not errors.is_terminal:
                print(f"[{begun}/{count_steps(options)}] {sentence}", file=sys.stderr, flush=True)

        result = run_benchmark(options, step)
        bar.update(task, completed=begun, description="done")
    return result


def _print_table(result: BenchmarkResult) -> None:
    heads = f"{'accuracy':>9}{'95 % interval':>17}{'below limit':>13}{'macro-F1':>10}"
    print(f"{'method':17}{heads}{'false alarms':>14}{'missed':>8}{'us':>8}")
    bayes = ("Bayes limit", result.limit, 0.0, result.limit_microseconds)
    rows = [
        (m.name, m.scores, -m.against_limit.difference.value, m.microseconds_per_transient)
        for m in result.methods
    ]
    for name, scored, below, microseconds in (bayes, *rows):
        accuracy = scored.accuracy
        print(
            f"{name:17}{accuracy.value:9.4f}{accuracy.low:9.4f}..{accuracy.high:.4f}{below:13.4f}"
            f"{scored.macro_f1.value:10.4f}{scored.false_alarm_rate.value:14.4f}"
            f"{scored.missed_detection_rate.value:8.4f}{microseconds:8.1f}"
        )


def _status(sentence: str) -> AbstractContextManager[object]:
    from rich.console import Console

    return Console(stderr=True).status(sentence)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `motor-classifiers` and return its exit status."""
    return console.run(app, arguments)


if __name__ == "__main__":
    sys.exit(main())
