"""Peers of aeon on the benchmark's own starts, in an environment of their own (`make peers`).

`python aeon_peers.py CASES.npz ANSWER.npz METHOD...` trains each peer on the training starts and judges the test
starts. The files hold plain arrays; neither side needs the other's packages.
"""

from __future__ import annotations

import datetime as dt
import json
import os
import platform
import sys
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

# Of the project only this module, which needs the standard library alone: the rest is not installed here.
sys.path.extend(str(Path(__file__).resolve().parents[1] / each) for each in ("", "classifiers"))
from motor_classifiers.scoring.judging import with_cost

SEED = 0


def make_peer(name: str) -> Any:
    """A classifier of aeon as its authors set it, on one thread."""
    from aeon.classification.convolution_based import MiniRocketClassifier, MultiRocketHydraClassifier
    from aeon.classification.interval_based import QUANTClassifier

    makers: dict[str, Callable[[], Any]] = {
        "minirocket": lambda: MiniRocketClassifier(random_state=SEED),
        "multirocket-hydra": lambda: MultiRocketHydraClassifier(random_state=SEED),
        "quant": lambda: QUANTClassifier(random_state=SEED),
    }
    return makers[name]()


def judge(name: str, cases: dict[str, npt.NDArray[Any]]) -> tuple[npt.NDArray[np.float32], dict[str, Any]]:
    """Probabilities of a peer on the test starts, columns by class index, and what they took."""
    train, labels, test = cases["train_X"], cases["train_class_index"], cases["test_X"]
    # One call beforehand: compiling is not training.
    make_peer(name).fit(train[:60], labels[:60]).predict_proba(test[:10])
    model, training = with_cost(lambda: make_peer(name).fit(train, labels))
    found, inference = with_cost(lambda: model.predict_proba(test))
    probabilities = np.zeros((len(test), int(cases["n_classes"])), dtype=np.float32)
    probabilities[:, model.classes_.astype(int)] = found
    return probabilities, {
        "train_s": training.seconds,
        "microseconds_per_transient": 1e6 * inference.seconds / len(test),
        "train_memory_mb": training.memory_mb,
        "inference_memory_mb": inference.memory_mb,
        "graded": bool(((found > 0.0) & (found < 1.0)).any()),
    }


def machine() -> dict[str, str]:
    """Where and when this was measured."""
    return {
        "date": dt.datetime.now(dt.UTC).date().isoformat(),
        "machine": f"{platform.machine()}, one core of {os.cpu_count()}, Python {platform.python_version()}",
        "aeon": version("aeon"),
        "command": "make peers-anew",
    }


def main() -> None:
    """Judge the peers asked for and write their answers, whole or not at all."""
    source, target, *names = sys.argv[1:]
    with np.load(source) as arrays:  # plain arrays only: NumPy refuses anything else by itself
        cases = dict(arrays)
    answers = {
        name: cases[name] for name in ("train_mean", "test_mean", "train_class_index", "test_class_index")
    }
    facts: dict[str, Any] = {
        **machine(),
        "recipe": str(cases["recipe"]),
        "seed": int(cases["seed"]),
        "methods": {},
    }
    for name in names:
        print(f"{name}: training on {len(cases['train_X'])} starts", file=sys.stderr, flush=True)
        probabilities, measured = judge(name, cases)
        answers[name] = probabilities.astype(np.float16)
        facts["methods"][name] = measured
        hits = probabilities.argmax(axis=1) == cases["test_class_index"][: len(probabilities)]
        print(f"{name}: accuracy {hits.mean():.4f}, {measured}", file=sys.stderr, flush=True)
    partial = Path(target).with_suffix(".partial.npz")
    np.savez_compressed(partial, facts=np.array(json.dumps(facts)), **answers)
    partial.replace(target)


if __name__ == "__main__":
    main()
