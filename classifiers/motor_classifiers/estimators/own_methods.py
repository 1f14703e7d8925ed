"""Methods from outside the package: a function in a file, `FILE.py:NAME`, or an entry point; and how any model is fed.

Such a function takes a recipe and a seed, and returns an unfitted estimator, as those of `METHODS` do.
"""

from __future__ import annotations

import importlib.util
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import numpy as np
from sklearn.base import BaseEstimator
from sklearn.pipeline import Pipeline
from sklearn.utils import get_tags

from motor_classifiers.estimators.methods import METHODS, Make, Method
from motor_env.common.errors import InputError
from motor_env.common.files import LARGEST_NOTE_BYTES, read_file
from motor_env.motor.parameters import FloatArray

GROUP = "motor_classifiers.methods"
"""Group of entry points that an installed package offers methods under."""

_OF_FILE = ".py:"
_SECONDS = 30.0  # for progress bars: nobody knows


def find_method(name: str) -> Method:
    """A method by its name in `METHODS` or among the entry points, or by `FILE.py:NAME`, whose file is run.

    Raises:
        InputError: there is none, or its file cannot be run.
    """
    if name in METHODS:
        return METHODS[name]
    if _OF_FILE in name:
        make = _from_file(name)
    else:
        offered = {point.name: point for point in entry_points(group=GROUP)}
        if name not in offered:
            known = ", ".join([*METHODS, *offered])
            raise InputError(f"method must be FILE.py:NAME or one of {known}, got {name!r}")
        make = offered[name].load()
    about = (make.__doc__ or "A method of one's own").strip().splitlines()[0]
    return Method(name, "own", about, make, _SECONDS)


def _from_file(name: str) -> Make:
    file, _, function = name.rpartition(":")
    path = Path(file)
    read_file(path, LARGEST_NOTE_BYTES, "no such file; a method of your own is FILE.py:NAME")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None  # noqa: S101  # the name ends in .py
    assert spec.loader is not None  # noqa: S101  # the same
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:  # whatever the user's own file raises is the user's to read
        raise InputError(f"{file}: cannot be run ({type(error).__name__}: {error})") from error
    make: Make | None = getattr(module, function, None)
    if not callable(make):
        raise InputError(
            f"{file}: has no function {function!r} of a recipe and a seed that returns an estimator"
        )
    return make


def source_of(name: str) -> str:
    """The text that a method of one's own file depends on; empty for all others."""
    return Path(name.rpartition(":")[0]).read_text(encoding="utf-8") if _OF_FILE in name else ""


def fed(model: BaseEstimator, X: Any) -> Any:
    """Transients as a model takes them.

    That is flat, (n_cases, n_channels * n_timepoints); or (n_cases, n_channels, n_timepoints) where the model, or the
    first step of a pipeline, says so by scikit-learn's tag `input_tags.three_d_array`.
    """
    first = model
    while isinstance(first, Pipeline):
        first = first.steps[0][1]
    tags = get_tags(first).input_tags if hasattr(first, "__sklearn_tags__") else None
    return X if tags is not None and tags.three_d_array else X.reshape(len(X), -1)


def answered(model: BaseEstimator, X: Any) -> FloatArray:
    """Probability of each of the model's classes, shape (n_cases, n_classes); 0 and 1 where it only decides."""
    cases = fed(model, X)
    if hasattr(model, "predict_proba"):
        probabilities: FloatArray = np.asarray(model.predict_proba(cases), dtype=np.float64)
        return probabilities
    return np.asarray(model.predict(cases)[:, None] == model.classes_, dtype=np.float64)
