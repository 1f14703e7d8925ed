"""Film an agent that probes a motor: `python benchmarks/film.py` draws docs/images/probe-agent.gif.

The agent is one of those that `examples/ppo.py` trained, from the weights that are kept beside it.
"""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path
from typing import Any

from cyclopts import run
from PIL import Image

from motor_env.envs import Policy, ProbeEnv

FILM = Path(__file__).resolve().parents[1] / "docs" / "images" / "probe-agent.gif"
EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
FIRST_FRAME = 15  # before, the screen is nearly empty


def probe(observe: tuple[str, ...] = ()) -> ProbeEnv:
    """Probe-v0 with a screen."""
    return ProbeEnv(render_mode="rgb_array", observe=observe)


def film(env: Any, learned: Policy, path: Path, severity: float = 0.01) -> None:
    """An animation of one episode in which a winding grows worse by that much, and its seed and actions beside it.

    It begins with its end, so that a still shows what it is about.
    """
    for seed in range(10_000):
        observation, info = env.reset(seed=seed)
        if info["severity"] == severity and 1000 < info["onset_sample"] < 2000:
            break
    learned.start(1)
    frames: list[Any] = []
    actions: list[int] = []
    over = False
    while not over:
        actions.append(int(learned.act(observation[None])[0]))
        observation, _, over, _, _ = env.step(actions[-1])
        if len(actions) % 2 == 1 or over:
            frames.append(Image.fromarray(env.render()).quantize(32))
    end = [frames[-1]] * 20
    first, *others = [*end, *frames[FIRST_FRAME:], *end]
    first.save(path, save_all=True, append_images=others, duration=80, loop=0, optimize=True)
    path.with_suffix(".json").write_text(
        json.dumps({"seed": seed, "actions": actions}) + "\n", encoding="utf-8"
    )


def last_screen(path: Path) -> Any:
    """The screen at the end of a film, drawn anew from its seed and actions."""
    played = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
    env = probe()
    env.reset(seed=played["seed"])
    for action in played["actions"]:
        env.step(action)
    return env.render()


def main(*, seed: int = 0, out: Path = FILM) -> None:
    """Film the agent of that training seed."""
    sys.path.insert(0, str(EXAMPLES))
    ppo: Any = importlib.import_module("ppo")

    learner, env = ppo.Learner("probe", seed), probe(ppo.OBSERVED)
    learner.actor.load_state_dict(ppo.load_file(EXAMPLES / "ppo" / f"probe-{seed}.safetensors"))
    film(env, learner.policy(env), out)


if __name__ == "__main__":
    run(main)
