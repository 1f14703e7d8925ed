"""A posterior network as named arrays and plain values, and back; what a file says is believed after it was checked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.base import BaseEstimator

from motor_classifiers.estimators import severity_density
from motor_classifiers.estimators.posterior_network import PosteriorNetwork
from motor_classifiers.estimators.signal_space import SignalSpace
from motor_classifiers.estimators.stream_training import Posterior
from motor_env.inference.severity import SeverityPrior
from motor_env.motor.parameters import require
from motor_env.simulation.recipes import Recipe

Arrays = dict[str, NDArray[Any]]

_PARTS = {"classes": "posterior_", "severity": "severity_"}


def posterior_arrays(model: PosteriorNetwork) -> Arrays:
    """All numbers of a fitted network; in single precision where that loses nothing."""
    arrays: Arrays = {}
    for part, attribute in _PARTS.items():
        module = getattr(model, attribute)
        state = {} if module is None else module.state_dict()
        arrays |= {f"{part}.{name}": _compact(values.numpy()) for name, values in state.items()}
    return arrays


def _compact(values: NDArray[np.float64]) -> NDArray[Any]:
    single = values.astype(np.float32)
    return single if np.array_equal(single, values) else values


def posterior_values(model: PosteriorNetwork) -> dict[str, Any]:
    """What describes it beside its arrays and its recipe."""
    return {
        "kind": "posterior-network",
        "parameters": plain_parameters(model),
        "severities": [asdict(prior) for prior in model.severity_priors_],
        "sees_noise": {
            part: module.space.sees_noise
            for part, attribute in _PARTS.items()
            if (module := getattr(model, attribute)) is not None
        },
    }


def plain_parameters(model: BaseEstimator) -> dict[str, Any]:
    """Parameters that JSON can hold: without the recipe, and a random state only where it is a number."""
    parameters = {name: value for name, value in model.get_params().items() if name != "recipe"}
    if not isinstance(parameters["random_state"], int):
        parameters["random_state"] = None
    return parameters


def load_posterior(head: Mapping[str, Any], arrays: Arrays, recipe: Recipe) -> PosteriorNetwork:
    """The fitted network of a file.

    Raises:
        ValueError, KeyError, TypeError, RuntimeError: values or arrays of another type or shape than they must have.
    """
    parameters = dict(head["parameters"])
    if parameters.get("noise_range") is not None:
        low, high = parameters["noise_range"]
        require(
            all(type(factor) in (int, float) for factor in (low, high)), "noise_range must be two numbers"
        )
        parameters["noise_range"] = (float(low), float(high))
    references = parameters.get("n_references", 0)
    require(type(references) is int and references >= 0, f"n_references must be >= 0, got {references!r}")
    model = PosteriorNetwork(recipe, **parameters)
    model.classes_ = np.array(head["classes"])
    model.n_features_in_ = (1 + references) * len(recipe.sensor.channels) * recipe.timing.n_samples
    model.severity_priors_ = tuple(SeverityPrior(**prior) for prior in head["severities"])
    n_out = {"classes": len(model.classes_)}
    if model.severity_priors_:
        n_out["severity"] = severity_density.PARAMETERS * len(model.severity_priors_)
    require(
        set(arrays) == {name for name in arrays if name.split(".")[0] in n_out}, "it holds arrays of no part"
    )
    found = {
        part: _module(arrays, part, model, head["sees_noise"][part], size) for part, size in n_out.items()
    }
    model.posterior_, model.severity_ = found["classes"], found.get("severity")
    return model


def _module(arrays: Arrays, part: str, model: PosteriorNetwork, sees_noise: bool, n_out: int) -> Posterior:
    own = {name.removeprefix(f"{part}."): a for name, a in arrays.items() if name.startswith(f"{part}.")}
    require(type(sees_noise) is bool, f"sees_noise must be true or false, got {sees_noise!r}")
    for name, values in own.items():
        require(
            values.dtype in (np.float32, np.float64) and bool(np.isfinite(values).all()),
            f"{name} is not finite",
        )
    require(bool((own["space.noise"] > 0.0).all()), "its noise must be > 0")
    require(bool((own["space.variance"] >= 0.0).all()), "its variances must be >= 0")
    require(not sees_noise or own["space.level"][1] > 0.0, "its spread of the noise must be > 0")
    directions = own["space.directions"]
    require(
        directions.ndim == 2 and directions.shape[1] == model.n_features_in_,
        f"directions of shape {directions.shape} do not fit its recipe",
    )
    # The sizes are believed only once the file holds as much: memory for a false one would be taken before a look.
    n_layers, n_hidden = model.n_layers, model.n_hidden
    weights = sum(name.startswith("network.") and name.endswith(".weight") for name in own)
    require(
        type(n_layers) is int and n_layers >= 0 and weights == n_layers + 1,
        f"n_layers is {n_layers!r}, the file holds {weights} matrices",
    )
    first = own["network.0.weight"].shape
    require(
        type(n_hidden) is int and first[0] == (n_hidden if n_layers else n_out),
        f"n_hidden is {n_hidden!r}, the first matrix has shape {first}",
    )
    space = SignalSpace(model.n_features_in_, len(directions), sees_noise=sees_noise)
    posterior = Posterior(space, n_hidden, n_layers, n_out)
    posterior.load_state_dict({name: torch.from_numpy(values).double() for name, values in own.items()})
    return posterior.eval()
