"""Compile everything that commands and environments use, ahead of its first use."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np

from motor_env.apps import lab
from motor_env.diagnosis.diagnose import diagnose
from motor_env.diagnosis.identification import identify
from motor_env.diagnosis.readers.recording import Recording
from motor_env.envs.offline_data import TASKS, Behaviour, episodes_of
from motor_env.inference.class_model import physical_features
from motor_env.inference.posterior import SeverityPrior, class_probabilities, severity_posterior
from motor_env.inference.work_features import work_features
from motor_env.motor.compiled import without_notice
from motor_env.motor.faults import FaultKind
from motor_env.motor.model import State
from motor_env.motor.parameters import PAPER_MOTOR, FloatArray
from motor_env.simulation.named_recipes import load_recipe
from motor_env.simulation.sampling import draw, measure_draw
from motor_env.simulation.simulate import simulate_states

_LEVEL_V, _STEP_S, _NOISE = 12.0, 1e-3, np.array([0.02, 0.5])


def _step(*names: str) -> None:
    for name in names:
        for env in (gym.make(f"motor_env/{name}-v0"), gym.make_vec(f"motor_env/{name}-v0", num_envs=2)):
            env.reset(seed=0)
            space = env.action_space
            env.step(np.zeros(space.shape or (), dtype=space.dtype))
            env.close()


def _play_policies() -> None:
    for task in TASKS:
        for behaviour in (Behaviour.RULE, Behaviour.BEST):
            episodes_of(task, behaviour, 1, 0)


def _draw_recipes() -> None:
    """Draw three cases of each recipe of data sets, and compute what classifiers ask of them."""
    for recipe in map(load_recipe, ("paper", "bench", "bench-full", "field", "operation")):
        measured = measure_draw(draw(recipe, 0, np.arange(3)), recipe, 0)
        if recipe.duty is not None:
            work_features(recipe, measured.astype(np.float64))
        else:
            physical_features(recipe, measured)
        if recipe.field is None:
            class_probabilities(recipe, measured)
            severity_posterior(recipe, SeverityPrior(FaultKind.BEARING), measured)


def _recorded(voltage_v: FloatArray) -> Recording:
    time_s: FloatArray = _STEP_S * np.arange(len(voltage_v), dtype=np.float64)
    states = simulate_states(PAPER_MOTOR, voltage_v, _STEP_S)
    states = states + np.random.default_rng(0).normal(size=states.shape) * _NOISE
    return Recording(Path("warm-up"), time_s, states[:, State.CURRENT], voltage_v, states[:, State.SPEED])


def _diagnose_start() -> None:
    start = _recorded(np.repeat([0.0, _LEVEL_V], [50, 250]))
    diagnose(replace(start, speed_rad_s=None), "paper")


def _identify_log() -> None:
    identify(_recorded(np.repeat([_LEVEL_V, -_LEVEL_V, 4.0, 8.0, 2.0, -6.0], 60)), regime="operation")


def _show_lab() -> None:
    for rule in lab.RULES:
        lab.simulated(lab.Settings(rule=rule))
        lab.roc(lab.Settings(rule=rule))


_CALLS: dict[str, Callable[[], None]] = {
    "Monitor and Probe": partial(_step, "Monitor", "Probe", "ProbeContinuous"),
    "logs of a motor at work": _identify_log,
    "starts": _diagnose_start,
    "data sets and classifiers": _draw_recipes,
    "Drive": partial(_step, "Drive"),
    "policies": _play_policies,
    "Maintain": partial(_step, "Maintain"),
    "lab": _show_lab,
}

PARTS = tuple(_CALLS)
"""Names of the parts, the slowest first."""


def warm_up(
    parts: Sequence[str] = PARTS, said: Callable[[str, float], None] = lambda part, seconds: None
) -> dict[str, float]:
    """Compile parts into numba's cache, or load them from there.

    Args:
        parts: of `PARTS`; several processes may share them out.
        said: called after each part with its name and its seconds.

    Returns:
        Seconds that each part took.

    Raises:
        ValueError: there is no such part.
    """
    if unknown := [part for part in parts if part not in _CALLS]:
        raise ValueError(f"there is no part {unknown[0]!r}; there are {', '.join(PARTS)}")
    seconds = {}
    for part in parts:
        begin = time.perf_counter()
        with without_notice():
            _CALLS[part]()
        seconds[part] = time.perf_counter() - begin
        said(part, seconds[part])
    return seconds
