"""Judge one method in its own process: answers, time and memory."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import time
import traceback
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator
from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]  # comes with scikit-learn, without types

from motor_classifiers.estimators.methods import (
    METHODS,
    find_method,
    model_input,
    model_probabilities,
    source_of,
)
from motor_classifiers.model_files.containers import read_arrays
from motor_classifiers.scoring.task import ClassTask
from motor_env import __version__
from motor_env.common.errors import InputError
from motor_env.common.files import end_with_parent, replacing
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.named_recipes import recipe_to_dict
from motor_env.simulation.recipes import Recipe

_Answer = TypeVar("_Answer")
_PROCESS = Path("/proc/self")


class Cost(NamedTuple):
    """Time and memory of some work.

    Attributes:
        seconds: processor time.
        memory_mb: largest additional memory of the process, in MB of a million bytes; None where unknown (known on
            Linux).
    """

    seconds: float
    memory_mb: float | None


def with_cost(work: Callable[[], _Answer]) -> tuple[_Answer, Cost]:
    """Do the work; return its result and its cost."""
    before = _fresh_peak_mb()
    begin = time.process_time()
    answer = work()
    seconds = time.process_time() - begin
    return answer, Cost(seconds, None if before is None else max(0.0, _peak_mb() - before))


def _fresh_peak_mb() -> float | None:
    """Reset the peak of memory; return the present memory."""
    try:
        (_PROCESS / "clear_refs").write_text("5")
        return _peak_mb()
    except OSError:
        return None


def _peak_mb() -> float:
    lines = (_PROCESS / "status").read_text().splitlines()
    return next(1024e-6 * float(line.split()[1]) for line in lines if line.startswith("VmHWM"))


LIMIT = "limit"
"""Name of the posterior's answer."""

_ROUNDS = 3
_LONG_ENOUGH_S = 2.0  # of a timing: slower methods are timed once


class Answer(NamedTuple):
    """Probabilities of a method for the test starts, and their cost.

    Attributes:
        probabilities: in the recipe's order of classes, shape (n_test, n_classes).
        train: seconds and memory of training.
        inference: seconds and memory of judging all starts in one batch on one thread; quick methods: least time of
            three.
        origin: source of a peer's answers; else empty.
    """

    probabilities: FloatArray
    train: Cost
    inference: Cost
    origin: str = ""

    @property
    def decided(self) -> NDArray[np.int64]:
        """Index of the most probable class of each start."""
        decided: NDArray[np.int64] = self.probabilities.argmax(axis=1)
        return decided

    @property
    def is_graded(self) -> bool:
        """Whether there are probabilities, beside decisions."""
        return bool(((self.probabilities > 0.0) & (self.probabilities < 1.0)).any())

    @property
    def microseconds_per_transient(self) -> float:
        """Time of a start in a batch."""
        return 1e6 * self.inference.seconds / len(self.probabilities)


def in_recipe_order(model: BaseEstimator, probabilities: FloatArray, recipe: Recipe) -> FloatArray:
    """Reorder probabilities by the recipe's classes; 0 for classes without training."""
    ordered = np.zeros((len(probabilities), len(recipe.classes)))
    names = list(recipe.class_names)
    ordered[:, [names.index(str(name)) for name in model.classes_]] = probabilities
    return ordered


def expected_severity(recipe: Recipe, probabilities: FloatArray) -> FloatArray:
    """Return the mean severity over the classes by their probabilities, shape (n_cases,)."""
    levels = np.array([sum(part.severity for part in c.parts) for c in recipe.classes])
    expected: FloatArray = probabilities @ levels
    return expected


def answer_of(model: BaseEstimator, recipe: Recipe, X: NDArray[np.float32]) -> FloatArray:
    """Return a fitted model's probabilities by the recipe's classes, shape (n_cases, n_classes)."""
    return in_recipe_order(model, model_probabilities(model, X), recipe)


def judge(name: str, task: ClassTask, random_state: int | None = None) -> Answer:
    """Train a method, by default with the task's seed, and let it judge, in this process."""
    train, X = task.train(), task.test().X
    method = find_method(name)
    unfitted = method.make(task.recipe, task.seed % 2**32 if random_state is None else random_state)
    if method.from_stream:
        unfitted.set_params(with_severity=False)  # only probabilities are asked for
    with threadpool_limits(1):
        model, training = with_cost(lambda: unfitted.fit(model_input(unfitted, train.X), train.class_name))
        probabilities, inference = with_cost(lambda: answer_of(model, task.recipe, X))
        if inference.seconds < _LONG_ENOUGH_S:
            again = min(
                with_cost(lambda: model_probabilities(model, X))[1].seconds for _ in range(_ROUNDS - 1)
            )
            inference = inference._replace(seconds=min(inference.seconds, again))
    return Answer(probabilities, training, inference)


def _judge_plugin(name: str, task: ClassTask) -> Answer:
    """Judge a plugin method; its errors become sentences that name file and line."""
    try:
        return judge(name, task)
    except InputError:
        raise
    except Exception as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        raise ValueError(
            f"{type(error).__name__}: {error} ({place.filename}, line {place.lineno})"
        ) from error


def judge_in_subprocess(name: str, task: ClassTask) -> Answer:
    """Train and judge in a fresh process.

    Raises:
        InputError: the method cannot learn from these starts, or its process died.
    """
    methods = multiprocessing.get_all_start_methods()
    context = multiprocessing.get_context("forkserver" if "forkserver" in methods else "spawn")
    if "forkserver" in methods:
        context.set_forkserver_preload([__name__])  # imports are paid once, not for every method
    with (
        ProcessPoolExecutor(1, mp_context=context, initializer=end_with_parent) as pool,
        ThreadPoolExecutor(1) as thread,
    ):
        begun = thread.submit(pool.submit, judge if name in METHODS else _judge_plugin, name, task)
        try:
            return begun.result().result()
        except KeyboardInterrupt:
            begun.result()  # a worker that starts when this process is gone would show a traceback
            for worker in multiprocessing.active_children():
                worker.terminate()  # closing the pool would wait for its answer
            raise
        except BrokenProcessPool:
            reason = "its process ended without an answer; is there memory enough?"
        except (ValueError, np.linalg.LinAlgError) as error:
            reason = str(error)
    raise InputError(f"{name} on {task.title}: {reason}")


def posterior(task: ClassTask) -> Answer:
    """Return Bayes-optimal probabilities of the test starts, or their estimate."""
    X = task.test().X
    with threadpool_limits(1):
        task.best(X[:8])  # compiles, or loads what was compiled
        probabilities, inference = with_cost(lambda: task.best(X))
    return Answer(probabilities, Cost(0.0, 0.0), inference)


def answer_key(name: str, task: ClassTask) -> str:
    """Return a digest of setting, method and version of the package."""
    contents: dict[str, Any] = {
        "method": name,
        "recipe": recipe_to_dict(task.recipe),
        "n_test": task.n_test,
        "seed": task.seed,
    }
    if name != LIMIT and not find_method(name).from_stream:
        contents["n_train"] = task.n_train
        contents |= {"source": source} if (source := source_of(name)) else {}
    return digest_of(contents)


def digest_of(contents: dict[str, Any]) -> str:
    """Return a digest of JSON values and of the package's version."""
    contents = {**contents, "version": __version__}
    return hashlib.sha256(json.dumps(contents, sort_keys=True).encode()).hexdigest()[:24]


def save_answer(answer: Answer, path: Path) -> None:
    """Write an answer, as a whole file."""
    costs = [*answer.train, *answer.inference]
    known = np.array([np.nan if cost is None else cost for cost in costs], dtype=np.float64)
    with replacing(path) as temporary:
        np.savez_compressed(temporary, probabilities=answer.probabilities, costs=known)


def load_answer(path: Path, task: ClassTask) -> Answer | None:
    """Read an answer; None if there is none or it is damaged."""
    try:
        arrays = read_arrays(path)
    except InputError:
        return None
    wanted = {"probabilities": (task.n_test, len(task.recipe.classes)), "costs": (4,)}
    if {name: values.shape for name, values in arrays.items()} != wanted:
        return None
    train, inference = (
        Cost(s, None if np.isnan(mb) else mb) for s, mb in arrays["costs"].reshape(2, 2).tolist()
    )
    return Answer(arrays["probabilities"], train, inference)
