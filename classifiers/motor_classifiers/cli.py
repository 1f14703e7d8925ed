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
    from motor_classifiers.benchmark import AnswerStore, CellResult, Plan, Unit
    from motor_classifiers.prediction import Opinion
    from motor_env.recipes import Recipe

app = App(
    name="motor-classifiers",
    help="Learned opinions on a motor's start, and their benchmark.",
    version=__version__,
)

Json = Annotated[bool, Parameter(name="--json", negative=())]
Flag = Annotated[bool, Parameter(negative=())]


def _require_extras() -> None:
    for module in ("sklearn", "torch", "skops", "safetensors", "jinja2", "pyarrow"):
        console.require_extra(module, "classifiers")


@app.command
def train(
    dataset: str | None = None,
    /,
    *,
    out: Path,
    motor: str | None = None,
    recipe: str | None = None,
    method: str | None = None,
    voltage: float | None = None,
    sampling_rate_hz: float | None = None,
    duration_s: float | None = None,
    current_noise_a: float | None = None,
    noise_range: str | None = None,
    steps: int | None = None,
    seed: int = 0,
    json_: Json = False,
) -> int:
    """Train a network for a motor or a recipe on starts drawn without end, or a method on a data set.

    Examples: motor-classifiers train --motor examples/motor.toml --out out/motor.model

    motor-classifiers train out/bench --method residual-qda --out out/qda.model

    Args:
        dataset: Folder made by motor-datasets generate, or its URL: its training split is learned.
        out: New file of the model. An existing one is never overwritten.
        motor: Motor file (data sheet, identified or commissioned), or paper: its tolerances are the nuisances.
        recipe: Recipe file, or the name of a recipe: bench, bench-full, paper or field.
        method: For a data set: a method of the benchmark, residual-qda by default.
        voltage: Level of the supply in volt; the motor file's by default.
        sampling_rate_hz: Samples a second; by default the recipe's, or a thousand samples for a motor.
        duration_s: Time after the step; by default the recipe's, or 25 mechanical time constants of the motor.
        current_noise_a: Standard deviation of a current sample; by default the recipe's, or the motor file's.
        noise_range: Smallest and largest factor on that noise, with a comma between: the network then reads the
            noise off each start. For a motor 0.15,5 by default.
        steps: Batches seen by each of the two networks; 2500 by default.
        seed: Random state.
        json_: Print a summary as JSON.
    """
    _require_extras()
    if out.exists():
        raise console.InputError(f"{out}: exists already, and is not overwritten; give another name")
    if sum(source is not None for source in (dataset, motor, recipe)) != 1:
        raise console.InputError("give one of a data set, --motor and --recipe")
    _check_writable(out.parent)
    if dataset is not None:
        summary = _train_on_dataset(dataset, method or "residual-qda", seed, out)
    else:
        if method not in (None, "posterior-network"):
            raise console.InputError(f"--method {method} learns from a data set; give its folder")
        source = _training_recipe(motor, recipe, voltage, sampling_rate_hz, duration_s, current_noise_a)
        summary = _train_on_stream(
            source, _noise_range(noise_range, for_motor=motor is not None), steps, seed, out
        )
    print(
        json.dumps(summary) if json_ else f"trained {summary['method']} on {summary['n_train']} starts: {out}"
    )
    return 0


def _train_on_dataset(dataset: str, method: str, seed: int, out: Path) -> dict[str, Any]:
    from motor_classifiers.methods import make_method
    from motor_classifiers.persistence import save_model
    from motor_datasets.loaders import load

    cases = load(dataset, "train")
    model = make_method(method, cases.recipe, seed)
    with _status(f"training {method} on {len(cases)} starts"):
        model.fit(cases.X, cases.class_name)
        save_model(model, cases.recipe, method, out)
    return {"method": method, "n_train": len(cases), "out": str(out)}


def _training_recipe(
    motor: str | None,
    recipe: str | None,
    voltage: float | None,
    sampling_rate_hz: float | None,
    duration_s: float | None,
    current_noise_a: float | None,
) -> Recipe:
    from motor_classifiers.motor_recipe import changed_recipe, motor_recipe
    from motor_env.motor_file import load_motor
    from motor_env.recipe_file import load_recipe

    if motor is not None:
        found = motor_recipe(load_motor(motor), voltage_v=voltage, duration_s=duration_s)
    else:
        found = load_recipe(str(recipe))
    return changed_recipe(
        found,
        voltage_v=voltage,
        sampling_rate_hz=sampling_rate_hz,
        duration_s=duration_s,
        current_noise_a=current_noise_a,
    )


def _noise_range(text: str | None, *, for_motor: bool) -> tuple[float, float] | None:
    from motor_classifiers.motor_recipe import UNKNOWN_NOISE

    if text is None:
        return UNKNOWN_NOISE if for_motor else None
    factors = _numbers("noise-range", text)
    if len(factors) != 2:
        raise console.InputError(f"--noise-range must be two factors with a comma between, got {text!r}")
    return factors[0], factors[1]


def _train_on_stream(
    recipe: Recipe, noise_range: tuple[float, float] | None, steps: int | None, seed: int, out: Path
) -> dict[str, Any]:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    from motor_classifiers.persistence import save_model
    from motor_classifiers.posterior_network import PosteriorNetwork

    model = PosteriorNetwork(recipe, noise_range=noise_range, random_state=seed)
    if steps is not None:
        model.set_params(steps=steps)
    columns = (TextColumn("{task.description}"), BarColumn(30), TimeElapsedColumn(), TimeRemainingColumn())
    errors = Console(stderr=True)
    with Progress(*columns, console=errors, disable=not errors.is_terminal) as bar:
        task = bar.add_task(f"training a network for {recipe.name}", total=None)
        model.fit_stream(lambda done, total: bar.update(task, completed=done, total=total))
    save_model(model, recipe, "posterior-network", out)
    return {"method": "posterior-network", "n_train": model.n_drawn_, "out": str(out)}


@app.command
def evaluate(model: Path, dataset: str, /, *, split: str = "test", seed: int = 0, json_: Json = False) -> int:
    """Judge a model on a split of a data set, beside the Bayes limit on the same cases.

    Example: motor-classifiers evaluate out/network.model out/bench

    Args:
        model: File made by motor-classifiers train.
        dataset: Folder made by motor-datasets generate, or its URL (s3://..., https://...).
        split: train, validation or test.
        seed: Of the bootstrap.
        json_: Print the scores as JSON.
    """
    _require_extras()
    from motor_classifiers.evaluation import evaluate_model, evaluation_lines
    from motor_classifiers.persistence import load_model
    from motor_datasets.loaders import load

    fitted, recipe, method = load_model(model)
    with _status("judging"):
        scored = evaluate_model(fitted, recipe, load(dataset, split), seed)
    if json_:
        print(
            json.dumps({"model": str(model), "method": method, "dataset": dataset, "split": split, **scored})
        )
    else:
        print(f"{method} on {scored['n_test']} cases of split {split}")
        print("\n".join(evaluation_lines(recipe, scored)))
    return 0


@app.command
def predict(
    files: list[Path], /, *, model: Path | None = None, split: str | None = None, json_: Json = False
) -> int:
    """Opinion of a model on recordings, beside the verdict of motor-env diagnose; or on the cases of data sets.

    Example: motor-classifiers predict examples/startup_capture.csv

    Exit status: 0 all healthy, 1 any fault, 2 a file that cannot be read, 3 no fault but some undecided.

    The status is the model's opinion. A model knows the motors of its recipe and no others (docs/classifiers.md); real
    motors, whose supply ramps and whose brushes drop a voltage, are better judged by the diagnosis beside it.

    Args:
        files: Recordings with columns time_s, current_a and, where measured, voltage_v and speed_rad_s; or folders
            of data sets.
        model: File made by motor-classifiers train; by default the network for the paper's motor that comes with
            the package.
        split: Of data sets: train, validation or test; all by default.
        json_: Print one array with one object a file or case.
    """
    _require_extras()
    from motor_classifiers.persistence import PRETRAINED, load_model
    from motor_classifiers.prediction import overall_status

    fitted, recipe, _ = load_model(PRETRAINED if model is None else model)
    rows: list[dict[str, Any]] = []
    given: list[Opinion] = []
    unreadable = False
    for path in files:
        try:
            found, second = _opinions(fitted, recipe, path, split)
        except console.InputError as error:
            print(f"motor-classifiers: {error}", file=sys.stderr)
            rows.append({"file": str(path), "error": str(error)})
            unreadable = True
            continue
        given += found
        for n, opinion in enumerate(found):
            beside = {"row": n} if path.is_dir() else {"model_based": second}
            rows.append({"file": str(path), **opinion.as_json(), **beside})
        if not json_:
            _print_opinions(path, found, second)
    if json_:
        print(json.dumps(rows))
    return int(console.ExitStatus.BAD_INPUT if unreadable else overall_status(given))


def _opinions(
    model: Any, recipe: Recipe, path: Path, split: str | None
) -> tuple[list[Opinion], dict[str, Any] | None]:
    """Opinions on a data set; or the one on a recording, and what the model-based diagnosis says of it."""
    from motor_classifiers.prediction import judge_recording, opinions, second_opinion
    from motor_datasets.loaders import load
    from motor_env.recordings import read_recording

    if not path.is_dir():
        recording = read_recording(path)
        return [judge_recording(model, recipe, recording)], second_opinion(recording, recipe)
    cases = load(path, split)
    _check_same_axis(cases.recipe, recipe, path)
    return opinions(model, recipe, cases.X), None


def _check_same_axis(cases: Recipe, trained: Recipe, path: Path) -> None:
    if (cases.timing, cases.sensor.channels) != (trained.timing, trained.sensor.channels):
        raise console.InputError(
            f"{path}: has another time axis or other channels than the model was trained on"
        )


def _print_opinions(path: Path, found: list[Opinion], second: dict[str, Any] | None) -> None:
    from collections import Counter

    if second is None:
        counts = Counter(opinion.verdict for opinion in found)
        print(
            f"{path}: {len(found)} cases: {', '.join(f'{n} {verdict}' for verdict, n in counts.most_common())}"
        )
        return
    opinion = found[0]
    if opinion.reason:
        print(f"{path}: no opinion: {opinion.reason}")
    else:
        doubt = " (undecided)" if opinion.status is console.ExitStatus.UNDECIDED else ""
        size = _size(opinion.severity, opinion.severity_interval) if opinion.verdict != "healthy" else ""
        print(f"{path}: {opinion.verdict}{doubt}, probability {opinion.probability:.2f}{size}")
    sure = "" if second["confidence"] is None else f", confidence {second['confidence']:.2f}"
    size = _size(second["severity"], second["severity_interval"]) if second["severity"] else ""
    print(f"  motor-env diagnose: {second['verdict']}{sure}{size}: {'; '.join(second['reasons'])}")


def _size(severity: float, interval: Sequence[float | None] | None) -> str:
    words = f", severity near {100.0 * severity:.0f} %"
    if interval is None or None in interval:
        return words
    low, high = (100.0 * bound for bound in interval if bound is not None)
    return f"{words} ({low:.0f} to {high:.0f})"


@app.command
def export(model: Path | None = None, /, *, out: Annotated[Path, Parameter(alias="-o")]) -> int:
    """Write a network as an ONNX graph: transients in, probabilities and severities out.

    Example: motor-classifiers export out/motor.model -o out/motor.onnx

    Args:
        model: File made by motor-classifiers train --motor or --recipe; by default the network for the paper's motor
            that comes with the package.
        out: New file of the graph. An existing one is never overwritten.
    """
    _require_extras()
    for module in ("onnx", "onnxscript"):
        console.require_extra(module, "onnx")
    from motor_classifiers.onnx_export import export_onnx
    from motor_classifiers.persistence import PRETRAINED, load_model
    from motor_classifiers.posterior_network import PosteriorNetwork

    if out.exists():
        raise console.InputError(f"{out}: exists already, and is not overwritten; give another name")
    path = PRETRAINED if model is None else model
    fitted, recipe, method = load_model(path)
    if not isinstance(fitted, PosteriorNetwork):
        raise console.InputError(f"{path}: holds {method}; only a posterior-network becomes an ONNX graph")
    with _status("exporting"):
        export_onnx(fitted, recipe, out)
    print(f"transients of shape (cases, {len(recipe.sensor.channels)}, {recipe.timing.n_samples}): {out}")
    return 0


@app.command
def benchmark(
    *,
    out: Path = Path("out/benchmark"),
    full: Flag = False,
    recipe: str | None = None,
    sampling_rate_hz: str | None = None,
    current_noise_a: str | None = None,
    n_train: str | None = None,
    methods: str | None = None,
    n_test: int = 2000,
    seed: int = 0,
    duration_s: float | None = None,
    channels: str | None = None,
    peers: Path | None = None,
    fresh: Flag = False,
    dry_run: Flag = False,
    json_: Json = False,
) -> int:
    """Train all methods, judge all on the same unseen motors beside the Bayes limit; write a report.

    Example: motor-classifiers benchmark --out out/benchmark

    Where an option takes several values, commas stand between them: recipes, rates and noises are crossed, and
    training sizes tried at the usual noise. Such a sweep can be interrupted: the same command goes on where it stopped.

    Exit status: 0 done, 1 a method scored significantly above the Bayes limit (then something leaks), 2 wrong use.

    Args:
        out: Folder for report.html, results.json, results.csv and recipes.json; answers of a sweep are kept below it.
        full: Sweep over all recipes, 1 and 10 kHz, 5, 20 and 100 mA, 200 to 8000 training starts: hours.
        recipe: What motors are drawn from: bench, bench-full, paper or field; several with commas. Default bench.
        sampling_rate_hz: Samples a second; the recipe's by default.
        current_noise_a: Standard deviation of a current sample; the recipe's by default.
        n_train: Starts to learn from, 2000 by default; the first of several is that of the sweep over rates and noises.
        methods: Names with commas between; all by default.
        n_test: Starts to be judged on.
        seed: Random seed.
        duration_s: Time recorded after the step of the supply.
        channels: Measured channels: current, or current,speed.
        peers: Answers of other packages' classifiers (make peers-anew); those of the default setting are shipped.
        fresh: Have all answers of a sweep again.
        dry_run: Only tell what would be run, and about how long it takes.
        json_: Print what stands in results.json.
    """
    _require_extras()
    from motor_classifiers.benchmark import AnswerStore, Plan, make_cells
    from motor_classifiers.methods import METHODS
    from motor_classifiers.peers import shipped_peers
    from motor_classifiers.results import result_rows, write_results

    usual = FULL_SWEEP if full else {}
    recipes = tuple(
        _recipe(name, duration_s, channels) for name in (recipe or usual.get("recipe", "bench")).split(",")
    )
    cells = make_cells(
        recipes,
        _numbers("sampling-rate-hz", sampling_rate_hz or usual.get("sampling_rate_hz")),
        _numbers("current-noise-a", current_noise_a or usual.get("current_noise_a")),
        tuple(int(n) for n in _numbers("n-train", n_train or usual.get("n_train", "2000"))),
        n_test,
        seed,
    )
    plan = Plan(cells, tuple(methods.split(",")) if methods else tuple(METHODS), peers or shipped_peers())
    folder = out / "answers" if len(cells) > 1 else None
    if peers is not None and not peers.is_file():
        raise console.InputError(f"{peers}: no such file of answers of peers")
    if dry_run:
        _print_plan(plan, AnswerStore(None if fresh else folder), json_)
        return 0
    _check_writable(out)
    results = _run_with_progress(plan, AnswerStore(folder, fresh=fresh))
    page = write_results(plan, results, out)
    if json_:
        print(json.dumps(result_rows(results)))
    else:
        _print_table(results[plan.reference])
        print(f"report: {page}")
    leaks = [(name, result.cell) for result in results for name in result.leaks]
    for name, cell in leaks:
        print(
            f"motor-classifiers: check failed: {name} scored above the Bayes limit on {cell.title}",
            file=sys.stderr,
        )
    return 1 if leaks else 0


FULL_SWEEP = {
    "recipe": "bench,bench-full,paper,field",
    "sampling_rate_hz": "10000,1000",
    "current_noise_a": "0.02,0.005,0.1",
    "n_train": "2000,200,500,1000,8000",
}
"""Options of `benchmark --full`."""


def _recipe(name: str, duration_s: float | None, channels: str | None) -> Recipe:
    from dataclasses import replace

    from motor_env.parameters import Channel
    from motor_env.recipes import named_recipe

    chosen = named_recipe(name)
    if duration_s is not None:
        chosen = replace(chosen, timing=replace(chosen.timing, duration_s=duration_s))
    if channels is not None:
        measured = tuple(Channel(part) for part in channels.split(","))
        chosen = replace(chosen, sensor=replace(chosen.sensor, channels=measured))
    return chosen


def _numbers(option: str, text: str | None) -> tuple[float, ...]:
    if text is None:
        return ()
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        raise console.InputError(f"--{option} must be numbers with commas between, got {text!r}") from None
    if len(set(values)) != len(values):
        raise console.InputError(f"--{option} must not name a value twice, got {text!r}")
    return values


def _print_plan(plan: Plan, store: AnswerStore, as_json: bool) -> None:
    from motor_classifiers.benchmark import units

    rows = [
        {
            "setting": unit.cell.title,
            "method": unit.name,
            "done": store.find(unit) is not None,
            "about_s": unit.seconds,
        }
        for unit in units(plan)
    ]
    open_s = sum(unit.seconds for unit, row in zip(units(plan), rows, strict=True) if not row["done"])
    if as_json:
        print(json.dumps(rows))
        return
    for setting, done in _by_setting(rows).items():
        print(f"{setting:58} {done[0]:3} of {done[1]:3} answers there")
    print(
        f"{len(plan.cells)} settings, {len(rows)} answers, about {open_s / 60.0:.0f} minutes of one core to go"
    )


def _by_setting(rows: list[dict[str, Any]]) -> dict[str, tuple[int, int]]:
    counted: dict[str, tuple[int, int]] = {}
    for row in rows:
        done, total = counted.get(row["setting"], (0, 0))
        counted[row["setting"]] = (done + row["done"], total + 1)
    return counted


def _check_writable(out: Path) -> None:
    """Fail before the work, not after it."""
    from motor_env.files import replacing

    if out.exists() and not out.is_dir():
        raise console.InputError(f"{out}: is a file, not a folder")
    probe = out / ".writable"
    with replacing(probe):
        pass
    probe.unlink()


def _run_with_progress(plan: Plan, store: AnswerStore) -> tuple[CellResult, ...]:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    from motor_classifiers.benchmark import run_plan, units

    todo = units(plan)
    columns = (BarColumn(30), TimeElapsedColumn(), TimeRemainingColumn(), TextColumn("{task.description}"))
    errors = Console(stderr=True)
    with Progress(*columns, console=errors, disable=not errors.is_terminal) as bar:
        task = bar.add_task("starting", total=sum(unit.seconds for unit in todo))
        begun, before = 0, 0.0

        def step(unit: Unit, known: bool) -> None:
            nonlocal begun, before
            begun += 1
            sentence = f"{begun} of {len(todo)}: {unit.name} on {unit.cell.title}"
            bar.update(task, advance=before, description=sentence)
            before = unit.seconds
            if not errors.is_terminal:
                print(f"{sentence}{' (known)' if known else ''}", file=sys.stderr, flush=True)

        results = run_plan(plan, store, step)
        bar.update(task, advance=before, description="done")
    return results


def _print_table(result: CellResult) -> None:
    print(result.cell.title)
    heads = f"{'accuracy':>9}{'95 % interval':>17}{'below limit':>13}{'winding':>9}{'bearing':>9}{'level':>8}"
    print(f"{'method':18}{heads}{'us':>9}{'MB':>7}")
    limit = result.limit
    rows = [
        ("Bayes estimate" if result.limit_is_estimate else "Bayes limit", limit, 0.0),
        *((m.name, m.judged, -m.against_limit.difference.value) for m in result.ranked()),
    ]
    for name, judged, below in rows:
        accuracy, cost = judged.scores.accuracy, judged.answer
        memory = cost.inference.memory_mb
        print(
            f"{name:18}{accuracy.value:9.4f}{accuracy.low:9.4f}..{accuracy.high:.4f}{below:13.4f}"
            f"{judged.scores.winding.value:9.4f}{judged.scores.bearing.value:9.4f}{judged.scores.level.value:8.4f}"
            f"{cost.microseconds_per_transient:9.1f}{'' if memory is None else f'{memory:7.0f}'}"
        )


def _status(sentence: str) -> AbstractContextManager[object]:
    from rich.console import Console

    return Console(stderr=True).status(sentence)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `motor-classifiers` and return its exit status."""
    return console.run(app, arguments)


if __name__ == "__main__":
    sys.exit(main())
