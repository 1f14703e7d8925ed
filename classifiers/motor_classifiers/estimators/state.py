"""What a fitted estimator is made of, as a model file can hold it: named arrays, and values for JSON.

Each estimator has `to_state()` and `from_state(state, recipe)`. What a file says is believed after it was checked.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from numpy.typing import NDArray
from sklearn.base import BaseEstimator
from torch import nn

from motor_env.motor.parameters import require

Arrays = dict[str, NDArray[Any]]


class State(NamedTuple):
    """A fitted estimator.

    Attributes:
        arrays: its numbers.
        values: what JSON can hold; in a file the list of `classes`, too.
    """

    arrays: Arrays
    values: dict[str, Any]


def plain_parameters(model: BaseEstimator) -> dict[str, Any]:
    """Parameters that JSON can hold: without the recipe, and a random state only where it is a number."""
    parameters = {name: value for name, value in model.get_params().items() if name != "recipe"}
    if not isinstance(parameters["random_state"], int):
        parameters["random_state"] = None
    return parameters


def module_arrays(module: nn.Module, part: str) -> Arrays:
    """Weights and buffers of a torch module, each name after the part's."""
    return {f"{part}.{name}": values.numpy() for name, values in module.state_dict().items()}


def part_of(arrays: Arrays, part: str) -> Arrays:
    """The arrays of one part, without its name."""
    return {name.removeprefix(f"{part}."): a for name, a in arrays.items() if name.startswith(f"{part}.")}


def loaded_module(module: nn.Module, arrays: Arrays) -> nn.Module:
    """A torch module made on the device `meta`, with weights and buffers in double precision.

    Raises:
        ValueError: names or shapes are not the module's; no memory was taken.
    """
    # A file has one value in the place of a number.
    wanted = {name: tuple(values.shape) or (1,) for name, values in module.state_dict().items()}
    shapes = {name: values.shape or (1,) for name, values in arrays.items()}
    require(shapes == wanted, "its arrays do not fit its parameters")
    module.double().to_empty(device="cpu")
    module.load_state_dict({name: torch.from_numpy(a) for name, a in arrays.items()})
    return module.eval()
