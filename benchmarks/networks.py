"""Posterior networks of named recipes, trained once and kept in out/networks."""

from __future__ import annotations

from pathlib import Path

from motor_classifiers.estimators.networks.posterior_network import PosteriorNetwork
from motor_classifiers.model_files.persistence import load_model, save_model
from motor_env.simulation.recipes import Recipe

KEPT = Path(__file__).resolve().parent.parent / "out" / "networks"


def network_of(recipe: Recipe, n_references: int = 0) -> PosteriorNetwork:
    """The posterior network of a recipe with the settings of the benchmark, without severities."""
    path = KEPT / f"{recipe.name}{n_references or ''}.model"
    if not path.is_file():
        made = PosteriorNetwork(recipe, n_references=n_references, with_severity=False, random_state=0)
        save_model(made.fit_stream(), recipe, "posterior-network", path)
    network: PosteriorNetwork = load_model(path)[0]
    return network
