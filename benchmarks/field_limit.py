"""The best possible accuracy on `field`: `python benchmarks/field_limit.py [--minutes 11]`, again until it is done.

It samples the posterior of starts (`sampled_probabilities`), and again, independently, of the first half (`COUNTS`): 50
starts a file below out/field_limit, and what is there is not done again. After the given minutes it ends; the figures
of all go to benchmarks/results/field_limit.json. `--recipe operation` does the same for motors at work.

A posterior that is a little wrong decides a little worse, and its largest probability is a little too large. So the
largest probability bounds the best accuracy from above, and one run's decisions judged by the other run's probabilities
bound it from below. A trained method, for `field` the posterior network, is the control variate: both bounds are its
accuracy on many starts, and what the decisions gain over its own on the sampled ones.
"""

from __future__ import annotations

import json
import math
import time
from functools import cache
from pathlib import Path
from typing import Any, Literal, NamedTuple

import cyclopts
import numpy as np
from networks import network_of
from numpy.typing import NDArray
from sampled_posterior import sampled_probabilities

from motor_classifiers.estimators.methods import make_method
from motor_classifiers.scoring.judging import in_recipe_order
from motor_classifiers.wrappers.outlier_detector import single_starts
from motor_datasets.arrays import Dataset
from motor_datasets.generate import generate_arrays
from motor_env.common.files import replacing, write_text
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.named_recipes import named_recipe
from motor_env.simulation.recipes import Recipe

FOLDER = Path(__file__).resolve().parent
SEED, CHUNK, AT_ONCE = 41, 50, 2_000
CONTROL = "physical-logistic"


class Counts(NamedTuple):
    """Starts whose posterior is sampled, and again; starts on which the control variate is judged, and learned."""

    starts: int
    twice: int
    judged: int
    learned: int = 0


COUNTS = {"field": Counts(2000, 1000, 100_000), "operation": Counts(1500, 750, 40_000, 4_000)}
Z_95 = 1.96
ARRAYS = ("probabilities", "effective")


def single(name: str) -> Recipe:
    """The recipe with one start of each motor."""
    return single_starts(named_recipe(name))


def kept(name: str) -> Path:
    """Folder of what was sampled."""
    return FOLDER.parent / "out" / f"{name}_limit"


def chunks(name: str, run: int) -> list[tuple[int, int, Path]]:
    """Run, first start and file of each chunk of a run."""
    return [(run, first, kept(name) / f"{run}-{first}.npz") for first in range(0, COUNTS[name][run], CHUNK)]


def sample(recipe: Recipe, run: int, first: int, path: Path) -> None:
    """Posteriors of a chunk."""
    starts = generate_arrays(recipe, SEED, range(first, first + CHUNK))
    began = time.process_time()
    sampled = [
        sampled_probabilities(recipe, start, np.random.default_rng([SEED, run, first + n]))
        for n, start in enumerate(starts.X)
    ]
    seconds = time.process_time() - began
    probabilities, effective = (np.array(part) for part in zip(*sampled, strict=True))
    with replacing(path) as temporary:
        np.savez(temporary, probabilities=probabilities, effective=effective, seconds=seconds)


def mean_and_error(values: FloatArray) -> tuple[float, float]:
    """Mean, and its standard error."""
    return float(values.mean()), float(values.std(ddof=1) / np.sqrt(len(values)))


@cache
def control(name: str) -> Any:
    """The control variate: the posterior network of a field, fitted parameters and logistic regression at work."""
    if named_recipe(name).duty is None:
        return network_of(named_recipe(name))
    train = generate_arrays(single(name), SEED + 1, COUNTS[name].learned)
    return make_method(CONTROL, single(name), 0).fit(train.X, train.class_name)


def decisions(starts: Dataset) -> NDArray[np.int64]:
    """What the control variate decides, as indices of the recipe's classes."""
    model = control(starts.recipe.name)
    probabilities = in_recipe_order(model, model.predict_proba(starts.X), starts.recipe)
    decided: NDArray[np.int64] = probabilities.argmax(axis=1)
    return decided


def accuracy_of_network(name: str) -> tuple[float, float]:
    """On many starts that are not those of the sampled posterior, and its standard error."""
    path = kept(name) / "network.npz"
    if not path.is_file():
        right = []
        sampled, count = COUNTS[name].starts, COUNTS[name].judged
        for first in range(sampled, sampled + count, AT_ONCE):
            starts = generate_arrays(single(name), SEED, range(first, first + AT_ONCE))
            right.append(decisions(starts) == starts.class_index)
        with replacing(path) as temporary:
            np.savez(temporary, right=np.concatenate(right))
    return mean_and_error(np.load(path)["right"].astype(np.float64))


def stored(name: str, run: int) -> tuple[FloatArray, FloatArray, float]:
    """Posteriors of `chunks` as far as they go, the effective draws behind them, and the processor seconds."""
    parts = []
    for _, _, path in chunks(name, run):
        if not path.is_file():
            break
        parts.append(dict(np.load(path)))
    probabilities, effective = (np.concatenate([part[array] for part in parts]) for array in ARRAYS)
    return probabilities, effective, sum(float(part["seconds"]) for part in parts)


def figures(
    once: FloatArray, again: FloatArray, network: tuple[float, float], name: str = "field"
) -> dict[str, Any]:
    """All figures.

    Args:
        once: posteriors of all starts, shape (n_starts, n_classes).
        again: of the first ones, sampled again.
        network: accuracy of the control variate, and the standard error.
        name: of the recipe.
    """
    starts = generate_arrays(single(name), SEED, range(len(once)))
    of_network, rows = decisions(starts), np.arange(len(again))
    pair = np.stack([once[: len(again)], again])
    decided, largest = pair.argmax(axis=2), pair.max(axis=2)
    crossed = np.stack([pair[1 - run, rows, decided[run]] for run in (0, 1)])
    gain, gain_error = mean_and_error(once.max(axis=1) - once[np.arange(len(once)), of_network])
    optimism, optimism_error = mean_and_error((largest - crossed).mean(axis=0))
    accuracy, error = network
    errors = [float(np.hypot(gain_error, optimism_error)), gain_error]
    behind = [gain - optimism, gain]
    low, high = (
        accuracy + b + sign * Z_95 * float(np.hypot(error, e))
        for b, e, sign in zip(behind, errors, (-1.0, 1.0), strict=True)
    )
    return {
        "n_starts": len(once),
        "n_twice": len(again),
        "bracket": [low, high],
        "network_accuracy": accuracy,
        "network_accuracy_error": error,
        "n_of_network": COUNTS[name].judged,
        "network_behind": behind,
        "network_behind_error": errors,
        "expected_accuracy": float(once.max(axis=1).mean()),
        "right": float((once.argmax(axis=1) == starts.class_index).mean()),
        "expected_accuracy_of_runs": largest.mean(axis=1).tolist(),
        "same_decision": float((decided[0] == decided[1]).mean()),
    }


def main(*, minutes: float = math.inf, recipe: Literal["field", "operation"] = "field") -> None:
    """Sample what is missing, for so many minutes of processor time, and write the figures."""
    name = recipe
    parts = sorted([*chunks(name, 0), *chunks(name, 1)], key=lambda each: each[1] * (1 + each[0]))
    for run, first, path in parts:
        if not path.is_file():
            if time.process_time() > 60.0 * minutes:
                raise SystemExit("not done: run it again")
            sample(single(name), run, first, path)
    once, effective_once, seconds_once = stored(name, 0)
    again, effective_again, seconds_again = stored(name, 1)
    effective = np.concatenate([effective_once[once > 0.01], effective_again[again > 0.01]])
    result = {
        "command": f"python benchmarks/field_limit.py{'' if name == 'field' else f' --recipe {name}'}",
        "recipe": name,
        "control": "posterior-network" if COUNTS[name].learned == 0 else CONTROL,
        "learned": COUNTS[name].learned,
        "seed": SEED,
        **figures(once, again, accuracy_of_network(name), name),
        "effective_draws": {f"{q:g} %": float(np.quantile(effective, 0.01 * q)) for q in (0, 1, 10, 50)},
        "seconds_per_start": (seconds_once + seconds_again) / (len(once) + len(again)),
    }
    write_text(FOLDER / "results" / f"{name}_limit.json", json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    cyclopts.run(main)
