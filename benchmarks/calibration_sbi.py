"""TARP and LC2ST by `sbi`, in .venv-bench: `python benchmarks/calibration_sbi.py CASES.npz ANSWERS.json`."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import torch
from sbi.diagnostics.lc2st import LC2ST  # type: ignore[import-not-found]  # lives in .venv-bench
from sbi.diagnostics.tarp import (  # type: ignore[import-not-found]  # as above
    _run_tarp,
    check_tarp,
    get_tarp_references,
)
from scipy.stats import kstest

SEED, TRIALS, OBSERVED, LEVEL = 5, 20, 40, 0.05


def tarp(truth: torch.Tensor, draws: torch.Tensor) -> tuple[float, float]:
    """Area between the curves, and the p-value that coverage is uniform.

    `check_tarp` compares two curves as if they were samples; here the share of draws nearer than the truth is tested.
    """
    torch.manual_seed(SEED)  # sbi draws from the global generator; a process of its own
    references = get_tarp_references(truth)
    area, _ = check_tarp(*_run_tarp(draws, truth, references, z_score_theta=True))
    span = truth.max(dim=0).values - truth.min(dim=0).values
    away = [((each - references) / span).norm(dim=-1) for each in (truth, draws)]
    nearer = (away[1] < away[0]).float().mean(dim=0).numpy()
    uniform = np.random.default_rng(SEED).uniform(size=len(nearer))
    return area, float(kstest((nearer * len(draws) + uniform) / (len(draws) + 1), "uniform").pvalue)


def lc2st(truth: torch.Tensor, draws: torch.Tensor, seen: torch.Tensor) -> float:
    """Share of observed cases in which the classifier tells truth from draws at a level of 5 %."""
    torch.manual_seed(SEED)  # of the permutations; the classifiers have a state of their own
    train = slice(OBSERVED, None)
    test = LC2ST(
        prior_samples=truth[train],
        xs=seen[train],
        posterior_samples=draws[0, train],
        seed=SEED,
        num_trials_null=TRIALS,
        z_score=True,
        classifier_kwargs={
            "hidden_layer_sizes": (32, 32),
            "max_iter": 60,
            "early_stopping": True,
            "random_state": SEED,
        },
    )
    test.train_on_observed_data(verbosity=0).train_under_null_hypothesis(verbosity=0)
    told = [test.p_value(draws[:, n], seen[n]) < LEVEL for n in range(OBSERVED)]
    return float(np.mean(told))


def main(cases: Path, answers: Path) -> None:
    """Judge every posterior of a file."""
    torch.set_num_threads(1)
    arrays = {name: torch.from_numpy(values).float() for name, values in np.load(cases).items()}
    rows = []
    for n in range(len(arrays) // 3):
        truth, draws, seen = (arrays[f"{n}-{part}"] for part in ("truth", "draws", "seen"))
        area, p = tarp(truth, draws)
        rows.append({"atc": area, "tarp_p": p, "lc2st": lc2st(truth, draws, seen)})
        print(rows[-1], flush=True)
    answers.write_text(json.dumps(rows))


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
