"""Film an agent that probes a motor: `python benchmarks/film.py` draws docs/images/probe-agent.gif.

The agent is that of Probe-v0 that `examples/ppo.py` plays.
"""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from motor_env.envs import ProbeEnv

FILM = Path(__file__).resolve().parents[1] / "docs" / "images" / "probe-agent.gif"
EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
FIRST_FRAME = 10  # before, the screen is nearly empty


def probe() -> ProbeEnv:
    """Probe-v0 with a screen."""
    return ProbeEnv(render_mode="rgb_array")


def last_screen() -> Any:
    """The screen at the end of the film, drawn anew from its seed and actions."""
    played = json.loads(FILM.with_suffix(".json").read_text(encoding="utf-8"))
    env = probe()
    env.reset(seed=played["seed"])
    for action in played["actions"]:
        env.step(action)
    return env.render()


def played(env: ProbeEnv, agent: Any, seed: int) -> tuple[list[int], float]:
    """Actions of the agent in an episode, and the reward of its verdict."""
    observation, _ = env.reset(seed=seed)
    actions: list[int] = []
    while True:
        actions.append(int(agent.act(observation[None])[0]))
        observation, _, over, _, info = env.step(actions[-1])
        if over:
            return actions, info["reward_verdict"]


def main() -> None:
    """Film an episode in which a winding that is worse by 1 % is told, and keep its seed and actions beside the film.

    It begins with its end, so that a still shows what it is about.
    """
    sys.path.insert(0, str(EXAMPLES))
    ppo: Any = importlib.import_module("ppo")
    agent, env = ppo.Agent(dict(np.load(ppo.AGENTS / "Probe-v0.npz"))), probe()
    for seed in range(10_000):
        info = env.reset(seed=seed)[1]
        if info["severity"] == 0.01 and 1000 < info["onset_sample"] < 2000:
            actions, verdict = played(env, agent, seed)
            if verdict > 0.0:
                break
    env.reset(seed=seed)
    frames: list[Any] = []
    for step, action in enumerate(actions, start=1):
        env.step(action)
        if step % 2 == 0 or step == len(actions):
            frames.append(Image.fromarray(env.render()).quantize(32))
    end = [frames[-1]] * 20
    first, *others = [*end, *frames[FIRST_FRAME:], *end]
    first.save(FILM, save_all=True, append_images=others, duration=80, loop=0, optimize=True)
    FILM.with_suffix(".json").write_text(
        json.dumps({"seed": seed, "actions": actions}) + "\n", encoding="utf-8"
    )


if __name__ == "__main__":
    main()
