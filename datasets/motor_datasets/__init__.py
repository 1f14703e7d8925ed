"""Labelled transients of brushed DC motors: generated, stored, loaded."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from motor_datasets.arrays import Dataset
    from motor_datasets.generate import generate_arrays, generate_dataset
    from motor_datasets.loaders import load, to_pandas, to_torch
    from motor_datasets.splits import Split, split_of
    from motor_datasets.streaming import stream, to_torch_iterable

_HOME = {
    "arrays": ("Dataset",),
    "generate": ("generate_arrays", "generate_dataset"),
    "loaders": ("load", "to_pandas", "to_torch"),
    "splits": ("Split", "split_of"),
    "streaming": ("stream", "to_torch_iterable"),
}
_MODULE_OF = {name: module for module, names in _HOME.items() for name in names}

__all__ = [
    "Dataset",
    "Split",
    "generate_arrays",
    "generate_dataset",
    "load",
    "split_of",
    "stream",
    "to_pandas",
    "to_torch",
    "to_torch_iterable",
]


def __getattr__(name: str) -> Any:
    if name in _MODULE_OF:
        return getattr(import_module(f"motor_datasets.{_MODULE_OF[name]}"), name)
    raise AttributeError(f"module 'motor_datasets' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
