"""A posterior network as one ONNX graph: raw transients in, probabilities and severities out.

The projection is in double precision, the perceptrons in single.
"""

from __future__ import annotations

import copy
import json
import logging
import warnings
from pathlib import Path

import torch
from torch import nn

from motor_classifiers.estimators.networks import severity_density
from motor_classifiers.estimators.networks.posterior import Posterior
from motor_classifiers.estimators.networks.posterior_network import PosteriorNetwork
from motor_classifiers.estimators.networks.training import one_thread
from motor_env.common.arrays import instance
from motor_env.common.files import replacing
from motor_env.simulation.named_recipes import recipe_to_dict
from motor_env.simulation.recipes import Recipe

INPUT = "transients"
OUTPUTS = ("probabilities", "severity", "severity_low", "severity_high")
"""Names of the outputs, (n, n_classes) or (n, n_kinds): severities have a mean and bounds of 90 %."""

_TAIL = 0.05
_EXAMPLES = 2  # cases traced; the graph takes any number


class Deployed(nn.Module):
    """Graph from transients (n_cases, n_channels, n_timepoints), float32, to `OUTPUTS`, float32."""

    tops: torch.Tensor

    def __init__(self, model: PosteriorNetwork) -> None:
        super().__init__()
        self.classes = copy.deepcopy(model.posterior_)
        self.classes.network.float()
        self.severity: Posterior | None = copy.deepcopy(model.severity_)
        if self.severity is not None:
            self.severity.network.float()
        tops = torch.tensor([prior.largest for prior in model.severity_priors_], dtype=torch.float32)
        self.register_buffer("tops", tops)

    def forward(self, transients: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Return probabilities and severities, or the probabilities alone."""
        flat = transients.flatten(1).double()
        logits = self.classes.network(self.classes.space(flat).float())
        probabilities = torch.softmax(logits, dim=1)
        if self.severity is None:
            return (probabilities,)
        numbers = self.severity.network(self.severity.space(flat).float())
        densities = numbers.reshape(-1, len(self.tops), severity_density.PARAMETERS)
        return (probabilities, *(self.tops * severity_density.summary(densities, _TAIL)))


def export_onnx(model: PosteriorNetwork, recipe: Recipe, path: Path) -> None:
    """Write a fitted network as a whole ONNX file, with classes, kinds and recipe in its metadata."""
    instance("model", model, PosteriorNetwork)
    instance("recipe", recipe, Recipe)
    instance("path", path, Path)
    deployed = Deployed(model).eval()
    channels = (1 + model.n_references) * len(recipe.sensor.channels)
    example = torch.zeros(_EXAMPLES, channels, recipe.timing.n_samples)
    names = OUTPUTS if model.severity_priors_ else OUTPUTS[:1]
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)  # it would tell the user of the exporter's inner life
    try:
        with warnings.catch_warnings(), one_thread(), replacing(path) as temporary:
            warnings.simplefilter("ignore")
            program = torch.onnx.export(
                deployed,
                (example,),
                dynamo=True,
                input_names=[INPUT],
                output_names=list(names),
                dynamic_shapes={"transients": {0: torch.export.Dim("cases")}},
                external_data=False,
                verbose=False,
            )
            if program is None:
                raise RuntimeError("the exporter gave no graph")
            words = {
                "classes": [str(name) for name in model.classes_],
                "kinds": [str(prior.kind) for prior in model.severity_priors_],
                "recipe": recipe_to_dict(recipe),
            }
            program.model.metadata_props.update({name: json.dumps(value) for name, value in words.items()})
            program.save(temporary, external_data=False)
    finally:
        logger.setLevel(level)
