"""Class, severity and the motor's parameters together: the joint posterior of a start.

It is a product: the probability of the class and the density of its severity, both by a `PosteriorNetwork`, and the
density of the parameters given both (`parameter_density`). Each factor has the shape that it needs, and a draw takes
one from each in turn.
"""

from __future__ import annotations

from collections.abc import Iterator
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from numpy.typing import NDArray

from motor_classifiers.estimators.cases import flat_cases
from motor_classifiers.estimators.networks.epoch_classifier import logits_in_parts
from motor_classifiers.estimators.networks.parameter_density import (
    N_OUT,
    PARAMETERS,
    Scales,
    drawn,
    given_fault,
    parameter_loss,
)
from motor_classifiers.estimators.networks.posterior import Posterior
from motor_classifiers.estimators.networks.posterior_network import PosteriorNetwork
from motor_classifiers.estimators.networks.severity_density import grid_like, severity_recipe, weights
from motor_classifiers.estimators.networks.signal_space import fresh_cases
from motor_classifiers.estimators.networks.training import Batch, one_thread
from motor_datasets.generate import generate_arrays
from motor_env.motor.parameters import FloatArray, require
from motor_env.simulation.recipes import Recipe

_STREAM = 2**62  # the seeds of its streams lie above; those of other networks lie above 2^63
_SCALED_BY = 4_096  # cases
_AT_ONCE = 4_096
_NOTHING = 1e-300  # share of a range in which there is none


class JointDraws(NamedTuple):
    """Draws from the joint posterior, each array of shape (n_draws, n_cases).

    Attributes:
        label: class.
        severity: of the fault, 0 for a healthy motor.
        parameters: of the motor without its fault, by name and in SI units.
    """

    label: NDArray[np.str_]
    severity: FloatArray
    parameters: dict[str, FloatArray]


@dataclass(eq=False)
class JointPosterior:
    """The joint posterior of class, severity and parameters, around a trained network.

    Args:
        network: trained on its recipe's stream, with severities.
        recipe: its recipe.
        severity: its densities of the severities.
        density: from coordinates and fault to the density of the parameters.
        scales: of the parameters' logarithms.
    """

    network: PosteriorNetwork
    recipe: Recipe
    severity: Posterior
    density: Posterior
    scales: Scales

    @classmethod
    def around(cls, network: PosteriorNetwork, *, seed: int = 0) -> Self:
        """Learn the parameters from the recipe's stream, for as many steps as the network itself.

        Args:
            network: trained on its recipe's stream, with severities: `load_model`, or `PosteriorNetwork.from_recipe`.
            seed: of the stream and of the weights.

        Raises:
            ValueError: a network without recipe or severities, or one of two faults at once.
        """
        recipe, severity = network.recipe, network.severity_
        if recipe is None or severity is None:
            raise ValueError(
                "network must be trained on a recipe's stream and with_severity, this one is not"
            )
        require(
            all(len(c.parts) == 1 for c in recipe.classes),
            f"recipe {recipe.name} must have one fault a class for a joint posterior",
        )
        low, high = network.noise_range or (1.0, 1.0)
        ranges = severity_recipe(recipe, with_healthy=network.n_references > 0)
        ranges = replace(ranges, starts_per_motor=1, sensor=ranges.sensor.with_noise(low))
        scales = Scales.of(generate_arrays(ranges, _STREAM, _SCALED_BY))
        tops = torch.tensor([prior.largest for prior in network.severity_priors_])
        density = Posterior(
            deepcopy(severity.space),
            n_told=len(tops),
            n_hidden=network.n_hidden,
            n_layers=network.n_layers,
            n_out=N_OUT,
        ).float()

        def batches(part: int, batch_size: int) -> Iterator[Batch]:
            stream = fresh_cases(
                density.space,
                ranges,
                _STREAM + 1 + 2 * seed + part,
                batch_size,
                most_noise=high / low,
                n_references=network.n_references,
            )
            for seen, batch in stream:
                kinds = torch.from_numpy(batch.class_index)
                position = torch.from_numpy(batch.severity).float() / tops[kinds]
                yield (
                    torch.cat([seen, given_fault(kinds, position, len(tops))], dim=1),
                    scales.standard(batch),
                )

        with one_thread():
            density.learn(
                batches,
                parameter_loss,
                torch.Generator().manual_seed(seed),
                steps=network.steps,
                batch_size=network.batch_size,
                learning_rate=network.learning_rate,
            )
        return cls(network, recipe, severity, density.double(), scales)

    def sample(self, X: Any, n_draws: int, rng: np.random.Generator) -> JointDraws:
        """Draws from the joint posterior of each case.

        Args:
            X: shape (n_cases, n_channels, n_timepoints), or flattened.
            n_draws: of each case.
            rng: of the draws.

        Raises:
            ValueError: fewer than one draw, or cases of another shape.
        """
        require(n_draws >= 1, f"n_draws must be >= 1, got {n_draws}")
        flat = flat_cases(self.network, X, reset=False)
        cumulated = np.cumsum(self.network.predict_proba(flat), axis=1)
        uniform = rng.uniform(size=(n_draws, len(flat), 1))
        chosen = np.minimum((uniform > cumulated).sum(axis=2), cumulated.shape[1] - 1)
        label = self.network.classes_[chosen]
        with one_thread(), torch.inference_mode():
            severity, told = self._severities(flat, label, rng)
            seen = logits_in_parts(self.density.space, flat, _AT_ONCE)
            inputs = np.concatenate([np.broadcast_to(seen, (n_draws, *seen.shape)), told], axis=2)
            outputs = self.density.network(torch.from_numpy(inputs.reshape(-1, inputs.shape[2])))
            values = drawn(outputs, self.scales, rng).reshape(n_draws, len(flat), -1)
        return JointDraws(label, severity, dict(zip(PARAMETERS, np.moveaxis(values, 2, 0), strict=True)))

    def _severities(
        self, flat: FloatArray, label: NDArray[np.str_], rng: np.random.Generator
    ) -> tuple[FloatArray, FloatArray]:
        """Severity of each draw, and the fault as the network is told of it, shape (n_draws, n_cases, n_kinds)."""
        priors = self.network.severity_priors_
        densities = logits_in_parts(self.severity, flat, _AT_ONCE).reshape(len(flat), len(priors), -1)
        severity, told = np.zeros(label.shape), np.zeros((*label.shape, len(priors)))
        kinds = [prior.kind for prior in priors]
        for fault_class in self.recipe.classes:
            if fault_class.kind is None:
                continue
            kind = kinds.index(fault_class.kind)
            draw, case = np.nonzero(label == fault_class.name)
            values = np.full(len(case), fault_class.severity)
            if fault_class.severity_to is not None:
                share = weights(torch.from_numpy(densities[:, kind]))
                grid = grid_like(share).numpy() * priors[kind].largest
                inside = (grid >= fault_class.severity) & (grid <= fault_class.severity_to)
                cumulated = np.cumsum(np.where(inside, share.numpy(), 0.0), axis=1)
                cumulated /= np.maximum(cumulated[:, -1:], _NOTHING)
                uniform = rng.uniform(size=len(case))
                values = np.array(
                    [np.interp(u, cumulated[n], grid) for u, n in zip(uniform, case, strict=True)]
                ).clip(fault_class.severity, fault_class.severity_to)
            severity[draw, case] = values
            told[draw, case, kind] = values / priors[kind].largest
        return severity, told
