"""The command `motor-classifiers`: parse, call, print. Each command loads what it needs when it runs."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from cyclopts import App, Parameter

from motor_env import __version__
from motor_env.common import console
from motor_env.common.errors import InputError, require_extra


def task(name: str, /, *, out: Path) -> int:
    """Write a frozen task: its question, labelled training starts, and test cases without labels.

    Example: motor-classifiers task bench --out out/bench-task

    Args:
        name: bench, bench-full, field, operation, reference, severity, unknown or stream.
        out: Folder of task.json, train.npz and test.npz.
    """
    require_extra("sklearn", "classifiers")
    import numpy as np

    from motor_classifiers.scoring.frozen_tasks import load_task, task_facts
    from motor_env.common.files import replacing, write_text

    chosen = load_task(name)
    with console.working("drawing the starts of the task"):
        test = chosen.test()
        arrays: dict[str, dict[str, Any]] = {"train": chosen.training_arrays(), "test": {"X": test.X}}
        for part, content in arrays.items():
            with replacing(out / f"{part}.npz") as temporary:
                np.savez(temporary, allow_pickle=False, **content)
        write_text(out / "task.json", json.dumps(task_facts(chosen), indent=1) + "\n")
    print(f"{chosen.title}: {chosen.n_train} starts to learn from, {len(test.X)} cases to answer: {out}")
    return 0


def score(task: str, answers: Path, /, *, json_: bool = False) -> int:
    """Score a file of answers to a frozen task, beside the best possible on the same cases.

    Example: motor-classifiers score bench out/answers.csv

    Args:
        task: Name of the task.
        answers: CSV file: the column case (row of the test case, counted from 0), and the columns named in task.json.
        json_: Print the score as JSON.
    """
    require_extra("sklearn", "classifiers")
    from motor_classifiers.scoring.frozen_tasks import load_task, read_answers, score_answers

    asked = load_task(task)
    with console.working("scoring the answers"):
        scored = score_answers(asked, read_answers(answers, asked))
    if json_:
        print(json.dumps(scored, indent=1))
        return 0
    print(f"task {scored['task']} {scored['version']}, {scored['n_test']} cases")
    print(f"  {scored['metric']}: {scored['value']:.2f} ({scored['low']:.2f} to {scored['high']:.2f})")
    if "limit" in scored:
        low, high = scored["above_limit_low"], scored["above_limit_high"]
        print(f"  the best possible on the same cases: {scored['limit']:.2f}")
        print(f"  above it by {scored['above_limit']:.2f} ({low:.2f} to {high:.2f}, paired)")
    elif "bracket" in scored:
        print("  the best possible on average: between {:.2f} and {:.2f}".format(*scored["bracket"]))
    else:
        print("  the best possible is not known")
    return 0


app = App(
    name="motor-classifiers",
    help="Train, score and use classifiers of a motor's starts.",
    version=__version__,
)


def _require_extras() -> None:
    for module in ("sklearn", "torch", "skops", "safetensors", "pyarrow"):
        require_extra(module, "classifiers")
    with console.working("loading the learning libraries"):
        from motor_classifiers.estimators import methods  # noqa: F401  # and torch and scikit-learn with it


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
    steps: console.Whole | None = None,
    seed: console.Whole = 0,
    json_: bool = False,
) -> int:
    """Train a network for a motor or a recipe on an endless stream of starts, or a method on a data set.

    Examples: motor-classifiers train --motor examples/motor.toml --out out/motor.model

    motor-classifiers train out/bench --method residual-qda --out out/qda.model

    Args:
        dataset: Folder made by motor-datasets generate, or its URL: the method learns its training split.
        out: New file for the model. An existing one is never overwritten.
        motor: Motor file (data sheet, identified or commissioned), or paper: motors vary by its tolerances.
        recipe: Recipe file, or the name of a recipe: bench, bench-full, paper or field.
        method: For a data set: a method of the benchmark, residual-qda by default; or FILE.py:NAME, your own.
        voltage: Level of the supply in volt; the motor file's by default.
        sampling_rate_hz: Samples a second; by default the recipe's, or a thousand samples for a motor.
        duration_s: Time after the step; by default the recipe's, or 25 mechanical time constants of the motor.
        current_noise_a: Standard deviation of a current sample; by default the recipe's, or the motor file's.
        noise_range: Smallest and largest factor on that noise, with a comma between: the network then estimates the
            noise from each start. For a motor 0.15,5 by default.
        steps: Training batches of each of the two networks; 2500 by default.
        seed: Random seed.
        json_: Print a summary as JSON.
    """
    _require_extras()
    from motor_classifiers.cli import training
    from motor_classifiers.cli.sweep import require_writable

    if out.exists():
        raise InputError(f"{out}: exists already, and is not overwritten; give another name")
    if sum(source is not None for source in (dataset, motor, recipe)) != 1:
        raise InputError("give one of a data set, --motor and --recipe")
    require_writable(out.parent)
    if dataset is not None:
        summary = training.train_on_dataset(dataset, method or "residual-qda", seed, out)
    else:
        if method not in (None, "posterior-network"):
            raise InputError(f"--method {method} learns from a data set; give its folder")
        source = training.training_recipe(
            motor,
            recipe,
            voltage_v=voltage,
            sampling_rate_hz=sampling_rate_hz,
            duration_s=duration_s,
            current_noise_a=current_noise_a,
        )
        noises = training.noise_factors(noise_range, for_motor=motor is not None)
        summary = training.train_on_stream(source, noise_range=noises, steps=steps, seed=seed, out=out)
    print(
        console.json_text(summary)
        if json_
        else f"trained {summary['method']} on {summary['n_train']} starts: {out}"
    )
    return 0


@app.command
def evaluate(
    model: Path, dataset: str, /, *, split: str = "test", seed: console.Whole = 0, json_: bool = False
) -> int:
    """Judge a model on a split of a data set, beside the Bayes limit on the same cases.

    Example: motor-classifiers evaluate out/network.model out/bench

    Args:
        model: File made by motor-classifiers train.
        dataset: Folder made by motor-datasets generate, or its URL (s3://..., https://...).
        split: train, validation or test.
        seed: Random seed of the bootstrap.
        json_: Print the scores as JSON.
    """
    _require_extras()
    from motor_classifiers.model_files.persistence import load_model
    from motor_classifiers.scoring.results import evaluate_model, evaluation_lines
    from motor_datasets.loaders import load

    fitted, recipe, method = load_model(model)
    with console.working(f"judging {dataset}"):
        scored = evaluate_model(fitted, recipe, load(dataset, split), seed)
    if json_:
        print(
            console.json_text(
                {"model": str(model), "method": method, "dataset": dataset, "split": split, **scored}
            )
        )
    else:
        print(f"{method} on {scored['n_test']} cases of split {split}")
        print("\n".join(evaluation_lines(recipe, scored)))
    return 0


@app.command
def predict(
    files: list[Path],
    /,
    *,
    model: Path | None = None,
    motor: Path | None = None,
    split: str | None = None,
    json_: bool = False,
) -> int:
    """Predict recordings with a model, beside the verdict of motor-env diagnose; or the cases of data sets.

    Example: motor-classifiers predict examples/startup_capture.csv --motor examples/motor.toml

    Exit status: 0 all healthy, 1 any fault, 2 a file that cannot be read, 3 no fault but some undecided.

    The status is that of the model's prediction. A model knows only the motors of its recipe (docs/classifiers.md). For
    real motors, whose supply ramps and whose brushes drop a voltage, trust the diagnosis beside it.

    Args:
        files: Recordings with columns time_s, current_a and, where measured, voltage_v and speed_rad_s; or folders
            of data sets.
        model: File made by motor-classifiers train; by default the network for the paper's motor that comes with
            the package.
        motor: Motor file for the diagnosis; by default the recipe's motor with its tolerances.
        split: Of data sets: train, validation or test; all by default.
        json_: Print one array with one object per file or case.
    """
    _require_extras()
    from motor_classifiers.model_files.persistence import PRETRAINED, load_model
    from motor_classifiers.prediction import UNDECIDED, predict_file, prediction_lines
    from motor_env.motor.data_sheet import load_motor

    fitted, recipe, _ = load_model(PRETRAINED if model is None else model)
    healthy = None if motor is None else load_motor(motor)
    rows: list[dict[str, Any]] = []
    statuses: list[console.ExitStatus] = []
    for path in files:
        try:
            with console.working(console.printable(f"judging {path}")):
                predictions, second = predict_file(fitted, recipe, path, split, healthy)
        except InputError as error:
            print(f"motor-classifiers: {error}", file=sys.stderr)
            rows.append({"file": str(path), "verdict": UNDECIDED, "error": str(error)})
            statuses.append(console.ExitStatus.BAD_INPUT)
            continue
        statuses += [prediction.status for prediction in predictions]
        for n, prediction in enumerate(predictions):
            beside = {"row": n} if path.is_dir() else {"model_based": second}
            rows.append({"file": str(path), **prediction.as_json(), **beside})
        if not json_:
            print("\n".join(prediction_lines(path, predictions, second)))
    if json_:
        print(console.json_text(rows))
    return int(console.worst(statuses))


@app.command
def export(model: Path | None = None, /, *, out: Annotated[Path, Parameter(alias="-o")]) -> int:
    """Write a network as an ONNX graph: transients in, probabilities and severities out.

    Example: motor-classifiers export out/motor.model -o out/motor.onnx

    Args:
        model: File made by motor-classifiers train --motor or --recipe; by default the network for the paper's motor
            that comes with the package.
        out: New file for the graph. An existing one is never overwritten.
    """
    _require_extras()
    for module in ("onnx", "onnxscript"):
        require_extra(module, "onnx")
    from motor_classifiers.estimators.networks.posterior_network import PosteriorNetwork
    from motor_classifiers.model_files.onnx_export import export_onnx
    from motor_classifiers.model_files.persistence import PRETRAINED, load_model

    if out.exists():
        raise InputError(f"{out}: exists already, and is not overwritten; give another name")
    path = PRETRAINED if model is None else model
    fitted, recipe, method = load_model(path)
    if not isinstance(fitted, PosteriorNetwork):
        raise InputError(f"{path}: holds {method}; only a posterior-network becomes an ONNX graph")
    with console.working("exporting"):
        export_onnx(fitted, recipe, out)
    print(f"transients of shape (cases, {len(recipe.sensor.channels)}, {recipe.timing.n_samples}): {out}")
    return 0


@app.command
def benchmark(
    *,
    out: Path = Path("out/benchmark"),
    full: bool = False,
    recipe: str | None = None,
    sampling_rate_hz: str | None = None,
    current_noise_a: str | None = None,
    n_train: str | None = None,
    methods: str | None = None,
    with_: Annotated[tuple[str, ...], Parameter(name="--with")] = (),
    n_test: console.Whole = 2000,
    seed: console.Whole = 0,
    duration_s: float | None = None,
    channels: str | None = None,
    peers: Path | None = None,
    fresh: bool = False,
    dry_run: bool = False,
    json_: bool = False,
) -> int:
    """Train all methods, judge all on the same unseen motors beside the Bayes limit; write a report.

    Example: motor-classifiers benchmark --out out/benchmark

    Give several values with commas between them: recipes, rates and noises are crossed, and training sizes are tried at
    the usual noise. Such a sweep can be interrupted: the same command continues it.

    Exit status: 0 done, 1 a method scored significantly above the Bayes limit (labels have leaked), 2 wrong use.

    Args:
        out: Folder for report.html, results.json, results.csv, recipes.json, and the answers of a sweep.
        full: Sweep over all recipes, 1 and 10 kHz, 5, 20 and 100 mA, 200 to 8000 training starts: hours.
        recipe: Recipe of the motors: bench (the default), bench-full, paper, field or operation; several with commas.
        sampling_rate_hz: Samples a second; the recipe's by default.
        current_noise_a: Standard deviation of a current sample; the recipe's by default.
        n_train: Number of training starts, 2000 by default; of several the first one is for all rates and noises.
        methods: Names with commas between; by default all, or all that take motors at work.
        with_: A method of your own beside them: FILE.py:NAME, a function of a recipe and a seed that returns an
            estimator, or the name of an entry point motor_classifiers.methods. May be given several times.
        n_test: Number of test starts.
        seed: Random seed.
        duration_s: Time recorded after the step of the supply.
        channels: Measured channels: current, or current,speed.
        peers: File with stored answers of other packages' classifiers; refused if its starts are others.
        fresh: Compute all answers of a sweep again.
        dry_run: Print what would be run, and about how long it takes; run nothing.
        json_: Print the content of results.json.
    """
    _require_extras()
    from motor_classifiers.cli.sweep import (
        FULL_SWEEP,
        numbers,
        plan_lines,
        require_writable,
        run_with_progress,
        table_lines,
        whole_numbers,
    )
    from motor_classifiers.estimators.methods import AT_WORK, METHODS
    from motor_classifiers.report.page import write_results
    from motor_classifiers.scoring.benchmark import AnswerStore, Plan, make_tasks
    from motor_classifiers.scoring.results import result_rows
    from motor_env.simulation.named_recipes import changed_recipe, named_recipe

    usual = FULL_SWEEP if full else {}
    measured = tuple(channels.split(",")) if channels else None
    names = (recipe or usual.get("recipe", "bench")).split(",")
    tasks = make_tasks(
        [changed_recipe(named_recipe(name), duration_s=duration_s, channels=measured) for name in names],
        rates_hz=numbers("sampling-rate-hz", sampling_rate_hz or usual.get("sampling_rate_hz")),
        noises_a=numbers("current-noise-a", current_noise_a or usual.get("current_noise_a")),
        train_sizes=whole_numbers("n-train", n_train or usual.get("n_train", "2000")),
        n_test=n_test,
        seed=seed,
    )
    at_work = any(task.recipe.duty is not None for task in tasks)
    usual_methods = AT_WORK if at_work else tuple(METHODS)
    plan = Plan(tasks, (*(methods.split(",") if methods else usual_methods), *with_), peers)
    folder = out / "answers" if len(tasks) > 1 else None
    if peers is not None and not peers.is_file():
        raise InputError(f"{peers}: no such file of answers of peers")
    if dry_run:
        print("\n".join(plan_lines(plan, AnswerStore(None if fresh else folder), as_json=json_)))
        return 0
    require_writable(out)
    results = run_with_progress(plan, AnswerStore(folder, fresh=fresh))
    page = write_results(plan, results, out)
    if json_:
        print(console.json_text(result_rows(results)))
    else:
        print("\n".join(table_lines(results[plan.reference])))
        print(f"report: {page}")
    leaks = [(name, result.task) for result in results for name in result.leaks]
    for name, setting in leaks:
        print(
            f"motor-classifiers: check failed: {name} scored above the Bayes limit on {setting.title}",
            file=sys.stderr,
        )
    return 1 if leaks else 0


app.command(task)
app.command(score)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `motor-classifiers` and return its exit status."""
    return console.run(app, arguments)
