"""Quickly trained models of every kind, as objects and as the content of their files."""

import json
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from hostile import json_of
from safetensors.numpy import load, save
from sklearn.base import BaseEstimator

from motor_classifiers import make_method, save_model

# Reaches in: files are forged under the entry in which the description of a model stands.
from motor_classifiers.model_files.persistence import FORMAT
from motor_datasets import generate_arrays
from motor_env import Timing, load_recipe

RECIPE = load_recipe("bench", timing=Timing(1_000.0, 0.1))
TRAIN, TEST = generate_arrays(RECIPE, 1, 200), generate_arrays(RECIPE, 2, 20)
QUICK: dict[str, dict[str, Any]] = {
    "posterior-network": {"steps": 3, "batch_size": 32},
    "residual-network": {"epochs": 1, "stem": 4, "width": 4},
    "network": {"epochs": 2},
}


@cache
def fitted(name: str) -> BaseEstimator:
    """A method that was fitted to a few starts."""
    model = make_method(name, RECIPE, 0).set_params(**QUICK.get(name, {}))
    return model.fit(TRAIN.X, TRAIN.class_name)


def file_of(model: BaseEstimator, name: str) -> bytes:
    """The file of a model."""
    with TemporaryDirectory() as folder:
        save_model(model, RECIPE, name, Path(folder) / "model")
        return (Path(folder) / "model").read_bytes()


@cache
def content(name: str) -> bytes:
    """The file of a fitted method."""
    return file_of(fitted(name), name)


def head_of(file: bytes) -> dict[str, Any]:
    """The head of a safetensors model, without its digest: a stranger leaves it out, or makes a new one."""
    length = int.from_bytes(file[:8], "little")
    head: dict[str, Any] = json.loads(json.loads(file[8 : 8 + length])["__metadata__"][FORMAT])
    return {key: value for key, value in head.items() if key != "sha256"}


def with_head(file: bytes, head: dict[str, Any] | str, **tensors: Any) -> bytes:
    """A safetensors model with another head, and other tensors."""
    text = head if isinstance(head, str) else json_of(head)
    return save({**load(file), **tensors}, metadata={FORMAT: text})


def with_changes(file: bytes, changes: dict[str, Any]) -> bytes:
    """A safetensors model with changes to its head; nested tables are merged."""
    head = head_of(file)
    merged = {k: {**head[k], **v} if isinstance(v, dict) else v for k, v in changes.items()}
    return with_head(file, head | merged)
