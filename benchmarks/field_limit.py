"""The best possible accuracy on `field`: `python benchmarks/field_limit.py [--minutes 11]`, again until it is done.

It samples the posterior of 2,000 starts (`sampled_probabilities`), and again, independently, of the first 1,000: 100
starts a file below out/field_limit, and what is there is not done again. At the end the figures go to
benchmarks/results/field_limit.json.

A posterior that is a little wrong decides a little worse, and its largest probability is a little too large. So the
largest probability bounds the best accuracy from above, and one run's decisions judged by the other run's probabilities
bound it from below. The posterior network is the control variate: both bounds are its accuracy on many starts, and what
the decisions gain over its own on the sampled ones.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from networks import network_of

from motor_datasets.arrays import Dataset
from motor_datasets.generate import generate_arrays
from motor_env.files import replacing, write_text
from motor_env.inference.field_posterior import sampled_probabilities
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.named_recipes import named_recipe

FOLDER = Path(__file__).resolve().parent
KEPT = FOLDER.parent / "out" / "field_limit"
RESULT = FOLDER / "results" / "field_limit.json"

SEED, CHUNK = 41, 100
N_STARTS, N_TWICE = 2000, 1000
N_OF_NETWORK, AT_ONCE = 200_000, 10_000
RECIPE = replace(named_recipe("field"), starts_per_motor=1, healthy_starts=0, shifts=())
Z_95 = 1.96


def chunks(run: int) -> list[tuple[int, int, Path]]:
    """Run, first start and file of each chunk of a run."""
    return [(run, first, KEPT / f"{run}-{first}.npz") for first in range(0, (N_STARTS, N_TWICE)[run], CHUNK)]


def sample(run: int, first: int, path: Path) -> None:
    """Posteriors of a chunk."""
    starts = generate_arrays(RECIPE, SEED, range(first, first + CHUNK))
    began = time.process_time()
    sampled = [
        sampled_probabilities(RECIPE, start, np.random.default_rng([SEED, run, first + n]))
        for n, start in enumerate(starts.X)
    ]
    seconds = time.process_time() - began
    probabilities, effective = (np.array(part) for part in zip(*sampled, strict=True))
    with replacing(path) as temporary:
        np.savez(temporary, probabilities=probabilities, effective=effective, seconds=seconds)


def mean_and_error(values: FloatArray) -> tuple[float, float]:
    """Mean, and its standard error."""
    return float(values.mean()), float(values.std(ddof=1) / np.sqrt(len(values)))


def decisions(starts: Dataset) -> np.ndarray[Any, np.dtype[np.int64]]:
    """What the network decides, as indices of the recipe's classes."""
    network = network_of(named_recipe("field"))
    order = [list(network.classes_).index(name) for name in RECIPE.class_names]
    decided: np.ndarray[Any, np.dtype[np.int64]] = network.predict_proba(starts.X)[:, order].argmax(axis=1)
    return decided


def accuracy_of_network() -> tuple[float, float]:
    """On many starts that are not those of the sampled posterior, and its standard error."""
    right = []
    for first in range(N_STARTS, N_STARTS + N_OF_NETWORK, AT_ONCE):
        starts = generate_arrays(RECIPE, SEED, range(first, first + AT_ONCE))
        right.append(decisions(starts) == starts.class_index)
    return mean_and_error(np.concatenate(right).astype(np.float64))


def figures(once: FloatArray, again: FloatArray, network: tuple[float, float]) -> dict[str, Any]:
    """All figures.

    Args:
        once: posteriors of all starts, shape (n_starts, n_classes).
        again: of the first ones, sampled again.
        network: its accuracy, and the standard error.
    """
    starts = generate_arrays(RECIPE, SEED, range(N_STARTS))
    of_network, rows = decisions(starts), np.arange(len(again))
    pair = np.stack([once[: len(again)], again])
    decided, largest = pair.argmax(axis=2), pair.max(axis=2)
    crossed = np.stack([pair[1 - run, rows, decided[run]] for run in (0, 1)])
    gain, gain_error = mean_and_error(once.max(axis=1) - once[np.arange(N_STARTS), of_network])
    optimism, optimism_error = mean_and_error((largest - crossed).mean(axis=0))
    accuracy, error = network
    errors = [float(np.hypot(gain_error, optimism_error)), gain_error]
    behind = [gain - optimism, gain]
    low, high = (
        accuracy + b + sign * Z_95 * float(np.hypot(error, e))
        for b, e, sign in zip(behind, errors, (-1.0, 1.0), strict=True)
    )
    return {
        "n_starts": N_STARTS,
        "n_twice": len(again),
        "bracket": [low, high],
        "network_accuracy": accuracy,
        "network_accuracy_error": error,
        "n_of_network": N_OF_NETWORK,
        "network_behind": behind,
        "network_behind_error": errors,
        "expected_accuracy": float(once.max(axis=1).mean()),
        "right": float((once.argmax(axis=1) == starts.class_index).mean()),
        "network_right": float((of_network == starts.class_index).mean()),
        "expected_accuracy_of_runs": largest.mean(axis=1).tolist(),
        "network_behind_of_runs": (largest - pair[:, rows, of_network[: len(again)]]).mean(axis=1).tolist(),
        "same_decision": float((decided[0] == decided[1]).mean()),
        "difference_of_runs_rms": float(np.sqrt(np.square(pair[0] - pair[1]).mean())),
    }


def main() -> None:
    """Sample what is missing, as long as there is time; then write the figures."""
    parser = argparse.ArgumentParser(description="The best possible accuracy on the recipe field.")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="of processor time, about")
    options = parser.parse_args()
    todo = sorted([*chunks(0), *chunks(1)], key=lambda each: each[1] * (1 + each[0]))
    for run, first, path in todo:
        if not path.is_file():
            if time.process_time() > 60.0 * options.minutes:
                print(f"{path.name} and those after it are missing: run again")
                return
            sample(run, first, path)
    parts = [[dict(np.load(path)) for _, _, path in chunks(run)] for run in (0, 1)]
    once, again = (np.concatenate([part["probabilities"] for part in run]) for run in parts)
    effective = np.concatenate(
        [part["effective"][part["probabilities"] > 0.01] for run in parts for part in run]
    )
    seconds = sum(float(part["seconds"]) for run in parts for part in run)
    result = {
        "command": "python benchmarks/field_limit.py",
        "recipe": "field",
        "seed": SEED,
        **figures(once, again, accuracy_of_network()),
        "effective_draws": {f"{q:g} %": float(np.quantile(effective, 0.01 * q)) for q in (0, 1, 10, 50)},
        "seconds_per_start": seconds / (N_STARTS + N_TWICE),
    }
    write_text(RESULT, json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
