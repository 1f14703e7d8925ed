"""The number of threads changes no bit of an answer: every method is trained and judged on one thread."""

import os
import subprocess
import sys

import pytest

CODE = """
import hashlib, sys, torch
from motor_classifiers.scoring.judging import Cell, judge
from motor_env.simulation.named_recipes import named_recipe
from motor_env.simulation.simulate import Timing
torch.set_num_threads(int(sys.argv[1]))
cell = Cell(named_recipe("bench", timing=Timing(1_000.0, 0.1)), 120, 60)
for name in sys.argv[2:]:
    print(name, hashlib.sha256(judge(name, cell).probabilities.tobytes()).hexdigest())
"""
QUICK = (
    "threshold",
    "rules",
    "physical-logistic",
    "physical-boosting",
    "physical-forest",
    "raw-logistic",
    "network",
)
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


def answers(threads: int, methods: tuple[str, ...]) -> str:
    done = subprocess.run(
        [sys.executable, "-c", CODE, str(threads), *methods],
        env={**os.environ, **dict.fromkeys(THREADS, str(threads))},
        capture_output=True,
        text=True,
        check=True,
        timeout=280,
    )
    assert done.stdout.count("\n") == len(methods)
    return done.stdout


@pytest.mark.long
@pytest.mark.timeout(600)
@pytest.mark.parametrize("methods", [QUICK, ("physical-svm", "residual-network"), ("posterior-network",)])
def test_one_and_two_threads_give_the_same_bits(methods: tuple[str, ...]) -> None:
    assert answers(1, methods) == answers(2, methods)
