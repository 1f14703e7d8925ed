"""Film an agent that probes a motor: `python benchmarks/film.py` draws docs/images/probe-agent.gif.

The agent is one of those that `examples/ppo.py` trained, from the weights that are kept beside it.
"""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path
from typing import Any

from PIL import Image

from motor_env.envs import ProbeEnv

FILM = Path(__file__).resolve().parents[1] / "docs" / "images" / "probe-agent.gif"
EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
FIRST_FRAME = 15  # before, the screen is nearly empty


def probe(observe: tuple[str, ...] = ()) -> ProbeEnv:
    """Probe-v0 with a screen."""
    return ProbeEnv(render_mode="rgb_array", observe=observe)


def last_screen() -> Any:
    """The screen at the end of the film, drawn anew from its seed and actions."""
    played = json.loads(FILM.with_suffix(".json").read_text(encoding="utf-8"))
    env = probe()
    env.reset(seed=played["seed"])
    for action in played["actions"]:
        env.step(action)
    return env.render()


def main() -> None:
    """Film an episode in which a winding grows worse by 1 %, and keep its seed and actions beside the film.

    It begins with its end, so that a still shows what it is about.
    """
    sys.path.insert(0, str(EXAMPLES))
    ppo: Any = importlib.import_module("ppo")
    learner, env = ppo.Learner("probe", 0), probe(ppo.OBSERVED)
    learner.actor.load_state_dict(ppo.load_file(EXAMPLES / "ppo" / "probe-0.safetensors"))
    learned = learner.policy(env)
    for seed in range(10_000):
        observation, info = env.reset(seed=seed)
        if info["severity"] == 0.01 and 1000 < info["onset_sample"] < 2000:
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
    first.save(FILM, save_all=True, append_images=others, duration=80, loop=0, optimize=True)
    FILM.with_suffix(".json").write_text(
        json.dumps({"seed": seed, "actions": actions}) + "\n", encoding="utf-8"
    )


if __name__ == "__main__":
    main()
