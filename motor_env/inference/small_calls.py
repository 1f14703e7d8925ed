"""What has the drawing of data sets compiled, and what classifiers ask of it: three cases of each named recipe."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from motor_env.inference.features import physical_features
from motor_env.inference.posterior import class_probabilities
from motor_env.inference.severity import SeverityPrior, severity_posterior
from motor_env.inference.work_features import work_features
from motor_env.motor.faults import FaultKind
from motor_env.simulation.drawing import draw, measure_draw
from motor_env.simulation.named_recipes import RECIPES


def _recipes() -> None:
    for recipe in RECIPES.values():
        measured = measure_draw(draw(recipe, 0, np.arange(3)), recipe, 0)
        if recipe.duty is not None:
            work_features(recipe, measured.astype(np.float64))
        else:
            physical_features(recipe, measured)
        if recipe.field is None:
            class_probabilities(recipe, measured)
            severity_posterior(recipe, SeverityPrior(FaultKind.BEARING), measured)


CALLS: dict[str, Callable[[], None]] = {"data sets and classifiers": _recipes}
