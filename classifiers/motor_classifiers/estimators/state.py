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


def load_module(module: nn.Module, arrays: Arrays) -> None:
    """Set the weights and buffers of a torch module in double precision.

    Raises:
        RuntimeError: names or shapes are not the module's.
    """
    module.double().load_state_dict({name: torch.from_numpy(a).double() for name, a in arrays.items()})
    module.eval()


def check_perceptron(arrays: Arrays, n_hidden: Any, n_layers: Any, n_out: int) -> None:
    """Check sizes before a perceptron of these sizes is made: memory for a false one would be taken before a look.

    Raises:
        ValueError: the arrays are of other sizes.
    """
    weights = sum(name.startswith("network.") and name.endswith(".weight") for name in arrays)
    require(
        type(n_layers) is int and n_layers >= 0 and weights == n_layers + 1,
        f"n_layers is {n_layers!r}, the file holds {weights} matrices",
    )
    first = arrays["network.0.weight"].shape
    require(
        type(n_hidden) is int and first[0] == (n_hidden if n_layers else n_out),
        f"n_hidden is {n_hidden!r}, the first matrix has shape {first}",
    )
