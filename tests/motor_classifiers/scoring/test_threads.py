"""What repeats: with other numbers of threads every bit, on another processor the starts and the decisions."""

import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest

CODE = """
import hashlib, sys, torch
from motor_env import Timing, load_recipe
from motor_classifiers.scoring.judging import judge
from motor_classifiers.scoring.task import class_task
torch.set_num_threads(int(sys.argv[1]))
cell = class_task(load_recipe("bench", timing=Timing(1_000.0, 0.1)), 120, 60)
def digest(values):
    return hashlib.sha256(values.tobytes()).hexdigest()
print("starts", digest(cell.train().X), digest(cell.test().X))
for name in sys.argv[2:]:
    answer = judge(name, cell)
    print(name, digest(answer.decided), digest(answer.probabilities))
"""
QUICK = (
    "threshold", "rules", "physical-logistic", "physical-boosting", "physical-forest", "raw-logistic", "network",
)  # fmt: skip
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
BEFORE_AVX = {  # has the libraries compute as on a processor of 2005
    "ATEN_CPU_CAPABILITY": "default",
    "NPY_DISABLE_CPU_FEATURES": "AVX2 FMA3 AVX512F AVX512CD AVX512_SKX AVX512_CLX AVX512_CNL AVX512_ICL AVX512_SPR"
    " X86_V3 X86_V4",  # what one version of NumPy does not know, it ignores
    "NUMBA_CPU_FEATURES": "",
    "NUMBA_CPU_NAME": "generic",
    "OPENBLAS_CORETYPE": "Prescott",
}


def answers(threads: int, methods: tuple[str, ...], processor: Mapping[str, str] = {}) -> list[list[str]]:
    """Digests: of the starts of training and test, then of each method's decisions and probabilities."""
    command = [sys.executable, "-c", CODE, str(threads), *methods]
    environment = {**os.environ, **dict.fromkeys(THREADS, str(threads)), **processor}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True, timeout=280)
    lines = [line.split() for line in done.stdout.splitlines()]
    assert [line[0] for line in lines] == ["starts", *methods]
    return lines


@pytest.mark.long
@pytest.mark.timeout(600)
@pytest.mark.parametrize("methods", [QUICK, ("physical-svm", "residual-network"), ("posterior-network",)])
def test_one_and_two_threads_give_the_same_bits(methods: tuple[str, ...]) -> None:
    assert answers(1, methods) == answers(2, methods)


@pytest.mark.long
@pytest.mark.timeout(600)
def test_an_older_processor_draws_the_same_starts_and_decides_alike(tmp_path: Path) -> None:
    here, there = answers(1, QUICK), answers(1, QUICK, {**BEFORE_AVX, "NUMBA_CACHE_DIR": str(tmp_path)})
    assert there[0] == here[0]
    assert [line[:2] for line in there] == [line[:2] for line in here]
    assert there != here  # probabilities round otherwise: it did compute as another one
