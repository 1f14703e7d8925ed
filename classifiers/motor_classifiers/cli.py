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
            "done": store.get(unit) is not None,
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
