"""What `golden.py` records: data sets, environments, filters and rules, paper, recordings, classifiers.

Everything is reached through names that stay where they are: the three commands, `gymnasium.make`, and what
`motor_env` and `motor_datasets` export. A part is a function that yields items: "section/name" and the value, which
JSON can hold once `plain` has made lists of its arrays. The section decides the tolerance (`golden.TOLERANCES`).
"""

from __future__ import annotations

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"))

import functools
import hashlib
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

import motor_datasets
import motor_env
from motor_env import Fault, FaultKind, Rule, Scenario, SensorParameters, Timing
from motor_env.detection.rules import recipe_thresholds
from motor_env.motor.faults import apply_fault
from motor_env.motor.model import steady_state
from motor_env.simulation.named_recipes import RECIPES, named_recipe

MEASURED_COST = ("microseconds_per_transient", "inference_memory_mb", "train_s", "train_memory_mb")
BOTH = SensorParameters(("current", "speed"))  # type: ignore[arg-type]  # names become channels
ARRAYS = ("X", "class_name", "class_index", "kind", "severity", "case_id", "motor_id", "split")
SEED, STEPS, LANES = 7, 10_000, 16

Items = Iterator[tuple[str, Any]]


def plain(value: Any) -> Any:
    """What JSON can hold, without a loss: arrays become lists, tuples too."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, dict):
        return {str(key): plain(entry) for key, entry in value.items()}
    return [plain(entry) for entry in value] if isinstance(value, list | tuple) else value


def digest(value: NDArray[Any] | bytes) -> str:
    """SHA-256 of the bytes, with the type and shape of an array before it."""
    if isinstance(value, bytes):
        return hashlib.sha256(value).hexdigest()
    return f"{value.dtype} {value.shape} {hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()}"


def digests(folder: Path, pattern: str) -> dict[str, str]:
    """SHA-256 of the files of a folder, by their names in it."""
    files = sorted(path for path in folder.rglob(pattern) if path.is_file())
    return {str(path.relative_to(folder)): digest(path.read_bytes()) for path in files}


def command(scratch: Path, package: str, *arguments: str) -> dict[str, Any]:
    """Run a command line in a folder; its exit status, its answer, and what it complains of."""
    call = [sys.executable, "-P", "-m", package, *arguments]
    done = subprocess.run(call, cwd=scratch, capture_output=True, text=True, check=False)
    said = [line for line in done.stderr.splitlines() if re.match(r"motor-|\w+(Error|Warning)\b", line)]
    try:
        answer = json.loads(done.stdout)
    except json.JSONDecodeError:
        answer = done.stdout.splitlines()
    return {"status": done.returncode, "answer": answer, "said": said}


def datasets(scratch: Path) -> Items:
    """Every recipe with its shifts, and a data set on disk."""
    for name, recipe in RECIPES.items():
        shifted = {f"{name}-{shift.name}": recipe.shifted(shift.name) for shift in recipe.shifts}
        for title, one in {name: recipe, **shifted}.items():
            cases = motor_datasets.generate_arrays(one, SEED, 64 if one.field is None else 20)
            arrays = {name: getattr(cases, name) for name in ARRAYS} | dict(cases.parameters)
            yield f"datasets/{title}", {array: digest(values) for array, values in arrays.items()}
    folder = str(scratch / "bench")
    command(scratch, "motor_datasets", "generate", "bench", "--cases", "64", "--seed", "1", "--out", folder)
    yield "datasets/files", digests(Path(folder), "*")
    yield "datasets/loaded", digest(motor_datasets.load(folder, "train").X)
    for name in RECIPES:
        yield f"datasets/described-{name}", command(scratch, "motor_datasets", "describe", name)


def environments(scratch: Path) -> Items:
    """Steps of every environment alone and as a vector, the agent mostly waiting, or acting at random."""
    two_channels = named_recipe("bench-full", sensor=BOTH)
    settings: dict[str, dict[str, Any]] = {
        "usual": {},
        "hard": {"recipe": "hard"},
        "small": {"recipe": "small", "precision": "float64", "samples_per_step": 5},
        "speed": {"recipe": two_channels, "start": "standstill", "growth_s": 0.02, "mean_onset_s": 0.02},
        "busy": {},
    }
    for name in ("Monitor-v0", "Probe-v0", "ProbeContinuous-v0"):
        for title, options in settings.items():
            often = 1.0 if title == "busy" else 1e-3
            alone = gym.make(f"motor_env/{name}", disable_env_checker=True, **options)
            yield f"environments/{name}-{title}", walk(alone, alone.action_space, often)
            many = gym.make_vec(
                f"motor_env/{name}", LANES, vectorization_mode="vector_entry_point", **options
            )
            yield f"environments/{name}-{title}-vector", walk(many, many.single_action_space, often)


def walk(env: Any, space: gym.Space[Any], often: float) -> dict[str, Any]:
    """Digests of all that some steps give, and a few values to look at where they differ."""
    lanes = getattr(env, "num_envs", 0)
    seen: dict[str, list[Any]] = {"observations": [env.reset(seed=SEED)[0]], "rewards": [], "flags": []}
    infos = hashlib.sha256()
    for action in choose(space, (STEPS, lanes) if lanes else (STEPS,), often):
        observation, reward, terminated, truncated, info = env.step(
            action if space.shape or lanes else int(action)
        )
        seen["observations"].append(observation)
        seen["rewards"].append(reward)
        seen["flags"].append(np.stack([terminated, truncated]))
        infos.update(repr(sorted(info.items())).encode())
        if not lanes and (terminated or truncated):
            seen["observations"].append(env.reset()[0])
    arrays = {name: np.array(values) for name, values in seen.items()}
    found: dict[str, Any] = {name: digest(values) for name, values in arrays.items()}
    sums = {"reward": arrays["rewards"].sum(), "episodes": int(arrays["flags"].sum())}
    return {**found, "infos": infos.hexdigest(), **sums, "some": arrays["observations"][::1999]}


def choose(space: gym.Space[Any], shape: tuple[int, ...], often: float) -> NDArray[Any]:
    """Random actions; a declaration, which ends an episode, so often, else only offsets of the voltage."""
    rng = np.random.default_rng(SEED)
    declares = rng.random(shape) < often
    if isinstance(space, gym.spaces.Discrete):
        offsets = 3 if space.n > 4 else 1
        return np.where(declares, rng.integers(0, int(space.n), shape), rng.integers(0, offsets, shape))
    drawn = rng.uniform(-1.0, 1.0, (*shape, *(space.shape or ())))
    drawn[..., 1:][~declares] = -1.0
    return drawn.astype(np.float32)


def filters(scratch: Path) -> Items:
    """Motors, filter and rules on simulated transients."""
    nominal, timing = motor_env.PAPER_MOTOR, Timing()
    grown = Fault(FaultKind.WINDING_CONTACT, 0.2, 0.03, 0.02)
    transients = {}
    for title, sensor in {"current": SensorParameters(), "speed": BOTH}.items():
        drawn = motor_env.draw(named_recipe("bench-full", sensor=sensor), SEED, np.arange(4))
        transients[title] = motor_env.simulate(drawn.scenario, SEED, drawn.cases)
        yield f"filters/simulated-{title}", transients[title].measurements[..., ::10]
        belief = motor_env.KalmanFilter.from_parameters(nominal, sensor, timing.dt_s)
        own = motor_env.KalmanFilter.from_parameters(drawn.scenario.parameters, sensor, timing.dt_s)
        whole = transients[title].measurements
        gaps = np.where(np.arange(timing.n_samples) % 7 == 3, np.nan, whole)
        for kind, kalman, measured in (
            ("common", belief, whole),
            ("own", own, whole),
            ("gaps", belief, gaps),
        ):
            found = motor_env.run_filter(kalman, measured, transients[title].voltage_v)
            yield f"filters/{kind}-{title}", thinned(found._asdict(), timing.n_samples)
    scenario = Scenario(nominal, (grown,), timing=timing, process_noise_std=(1e-3, 0.1), load_torque_n_m=0.01)
    yield "filters/grown", motor_env.simulate(scenario, SEED, [0, 1]).states[:, ::10]
    model = motor_env.discretize(apply_fault(nominal, grown), timing.dt_s)
    rest = steady_state(nominal, 12.0, 0.01)
    yield "filters/model", {"transition": model.transition, "gain": model.gain, "rest": rest}
    white = motor_env.TolerantFilter.from_recipe(RECIPES["bench"]).white(transients["current"].measurements)
    yield "filters/tolerant", white[:, ::10]
    yield from rules(white)


def thinned(arrays: dict[str, NDArray[Any]], n_samples: int) -> dict[str, NDArray[Any]]:
    """Every tenth sample of each array."""
    axes = {name: [n for n, size in enumerate(a.shape) if size == n_samples] for name, a in arrays.items()}
    return {
        name: a.take(range(0, n_samples, 10), axes[name][0]) if axes[name] else a
        for name, a in arrays.items()
    }


def rules(white: NDArray[Any]) -> Items:
    """Statistics, alarms, average run lengths and thresholds of the decision rules."""
    some: dict[str, Rule] = {
        "nis": motor_env.nis_rule(),
        "in_a_row": motor_env.in_a_row(3),
        "m_of_n": motor_env.MOfN(3, 5),
        "windowed": motor_env.WindowedNis(20),
        "cusum": motor_env.Cusum(0.5),
        "cusum_two_sided": motor_env.Cusum(0.5, two_sided=True),
        "shiryaev_roberts": motor_env.ShiryaevRoberts(0.5),
        "sprt": motor_env.Sprt(0.5),
        "sprt_restart": motor_env.Sprt(0.5, restart=True),
        "glr": motor_env.Glr(1, 200),
        "glr_signature": motor_env.Glr(1, 200, two_sided=True, signature=(0.1, 0.3, 0.6)),
        "bank": motor_env.ModelBank((-0.5, 0.5)),
    }
    wanted = {"arl0": {"arl0": 500.0}, "rate": {"false_alarm_probability": 0.05, "n_samples": 1000}}
    for name, rule in some.items():
        statistic = rule.statistic(white)
        found: dict[str, Any] = {"statistic": statistic[:, ::10], "largest": statistic.max(axis=1)}
        found["run_length"] = rule.average_run_length(3.0, 0.5)
        for title, wish in wanted.items():
            try:
                found[title] = rule.threshold_for(**wish, runs=1000)  # type: ignore[arg-type]  # rates by name
                found[f"alarms_{title}"] = rule.alarm_index(white, found[title])
            except ValueError as error:
                found[title] = str(error)
        yield f"filters/rule-{name}", found
    tolerances = recipe_thresholds(list(some.values()), RECIPES["bench"], 0.05, runs=1000)
    yield "filters/recipe-thresholds", dict(zip(some, tolerances, strict=True))


def paper(scratch: Path) -> Items:
    """The paper's numbers, page and figures."""
    folder = scratch / "paper"
    yield "paper/numbers", command(scratch, "motor_env", "reproduce", "--out", str(folder), "--json")
    yield "paper/page", (folder / "paper.md").read_text(encoding="utf-8").splitlines()
    yield "figures/paper", digests(folder, "*.svg")


def recordings(scratch: Path) -> Items:
    """Diagnosis, identification, commissioning and trends; two commands at a time."""
    calls = {**example_calls(scratch), **(recording_calls(scratch) if (scratch / "real").is_dir() else {})}
    with ThreadPoolExecutor(2) as pool:
        answers = pool.map(lambda call: command(scratch, "motor_env", *call.split()), calls.values())
        yield from zip((f"recordings/{name}" for name in calls), answers, strict=True)
    for file in sorted(scratch.glob("written-*.toml")):
        yield f"recordings/{file.stem}", file.read_text(encoding="utf-8").splitlines()


def example_calls(scratch: Path) -> dict[str, str]:
    """Commands on what the repository has, and on a table of estimates made here."""
    rows = [
        f"2026-03-{d:02d},{1.2e-6 * (1 + 0.01 * d):.9g},1e-8,{2.18 + 0.002 * (-1) ** d:.9g},0.002"
        for d in range(1, 31)
    ]
    (scratch / "estimates.csv").write_text("\n".join(["date,B,B_se,R,R_se", *rows]) + "\n", encoding="utf-8")
    capture = "startup_capture.csv"
    return {
        "example-diagnose": f"diagnose {capture} --motor motor.toml --json",
        "example-text": f"diagnose {capture} --motor motor.toml",
        "example-alone": f"diagnose {capture} --json",
        "example-shunt": f"diagnose {capture} --motor paper --shunt-ohm 0.1 --sensor-lag 1e-4 --json",
        "example-identify": f"identify {capture} -o written-identified.toml --json",
        "example-trend": "trend estimates.csv --limit B=1.5 --limit R=0.9,1.1 --out trend.html --json",
    }


def recording_calls(scratch: Path) -> dict[str, str]:
    """Commands on the real recordings, with what their README says of voltage, shunt and ripple."""
    found: dict[str, str] = {}
    for file in sorted((scratch / "real").rglob("*.csv")):
        here, folder = file.relative_to(scratch), file.parent.name
        if folder == "jhg":
            options = f"--voltage {abs(int(file.stem.removeprefix('pwm_')) - 1800) / 150:.4g}"
        else:
            options = "--voltage 12.3 --shunt-ohm 0.47" if folder == "oscillo_lab" else ""
        if folder != "production_line":
            found[f"{folder}-{file.stem}-diagnose"] = f"diagnose {here} {options} --json"
        if folder != "production_line" or file.stem.endswith("_01"):
            found[f"{folder}-{file.stem}-identify"] = f"identify {here} {options} --json"
    line = [
        f"real/production_line/{file.name}"
        for file in sorted((scratch / "real/production_line").glob("*.csv"))
    ]
    good = " ".join(file for file in line if re.search(r"ok_0[1-5]", file))
    if good:
        (scratch / "dated").mkdir()
        for day, name in enumerate(good.split(), 1):
            shutil.copy(scratch / name, scratch / f"dated/2026-05-{day:02d}.csv")
        others = " ".join(file for file in line if file not in good)
        ripple = "--ripple-periods-per-turn 20"
        found["production_line-judged"] = f"diagnose {others} --healthy {good} {ripple} --json"
        found["production_line-commission"] = f"commission {good} -o written-commissioned.toml"
        found["production_line-trend"] = "trend dated --out dated.html --json"
    return found


def learned(scratch: Path) -> Items:
    """Opinions of the network that is shipped, and a small benchmark of all methods."""
    ask = functools.partial(command, scratch, "motor_classifiers")
    yield "opinions/example", ask("predict", "startup_capture.csv", "--json")
    generate = ("generate", "bench", "--cases", "64", "--seed", "2", "--out", "cases")
    command(scratch, "motor_datasets", *generate)
    yield "opinions/cases", ask("predict", "cases", "--json")
    ask("benchmark", "--n-train", "200", "--n-test", "200", "--out", "learned")
    for row in json.loads((scratch / "learned/results.json").read_text(encoding="utf-8")):
        kept = {name: value for name, value in row.items() if name not in MEASURED_COST}
        yield f"learned/{row['method'].replace(' ', '-')}", kept
    yield "learned/trust", json.loads((scratch / "learned/trust.json").read_text(encoding="utf-8"))


PARTS: dict[str, Callable[[Path], Items]] = {
    part.__name__: part for part in (datasets, environments, filters, paper, recordings, learned)
}
