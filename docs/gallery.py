"""The page of all environments side by side: a picture, how long an episode is, what an agent may do."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
from PIL import Image
from site_pages import FAMILIES  # it lies beside this file

import motor_env  # noqa: F401  # registers the environments

WIDTH_PX = 240
TRIALS, SEED = 64, 1
HEAD = """# All ids at a glance

In the order in which an agent should try them. *Steps at random* is the mean length of {trials} episodes of random
actions: it shows how soon a careless agent ends one. What scores where: [reference scores](../reference-scores.md).

| id | | an episode, at most | steps at random | actions | observed | `reward_threshold` |
|---|---|---|---|---|---|---|
"""


def horizon(env: Any) -> tuple[int, str]:
    """The largest number of steps, and what a step is in time."""
    options = env.options
    if hasattr(options, "days"):
        return int(options.days), "a day"
    if hasattr(options, "steps_per_decision"):
        step_s = options.period_s * options.steps_per_decision
        return options.n_steps // options.steps_per_decision, f"{1000 * step_s:g} ms"
    return options.n_steps, f"{1000 * options.dt_s * options.samples_per_step:g} ms"


def random_length(env: Any) -> float:
    """Mean number of steps of an episode of random actions."""
    env.reset(seed=SEED)
    env.action_space.seed(SEED)
    steps = 0
    for _ in range(TRIALS):
        over = False
        while not over:
            over = env.step(env.action_space.sample())[2]
            steps += 1
        env.reset()
    return steps / TRIALS


def write_gallery(folder: Path) -> None:
    """Write the page into the folder with the screens of all ids, and a small picture beside each."""
    rows = []
    for spec in gym.registry.values():
        if spec.namespace != "motor_env":
            continue
        env: Any = gym.make(spec.id).unwrapped
        name, (most, step) = spec.id.split("/")[1], horizon(env)
        with Image.open(folder / f"{name}.png") as screen:
            small = screen.convert("RGB").resize((WIDTH_PX, WIDTH_PX * screen.height // screen.width))
        small.quantize(64).save(folder / f"{name}-small.png", optimize=True)
        space = env.action_space
        actions = f"{space.n} to choose from" if hasattr(space, "n") else f"{space.shape[0]} numbers"
        family = next(each for each in FAMILIES if name.startswith(each.removesuffix("-v0")))
        page = f"{family}.md" if name == family else f"{family}.md#{name.lower()}"
        cells = [
            f"[{name}]({page})",
            f"[![Screen of {name}]({name}-small.png)]({page})",
            f"{most:,} steps of {step}",
            f"{random_length(env):.0f}",
            actions,
            f"{env.observation_space.shape[0]} numbers",
            f"{spec.reward_threshold:+.3f}",
        ]
        rows.append("| " + " | ".join(cells) + " |\n")
    (folder / "all.md").write_text(HEAD.format(trials=TRIALS) + "".join(rows), encoding="utf-8")
