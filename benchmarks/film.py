"""Film an agent that probes a motor: `python benchmarks/film.py --out docs/images/probe-agent.gif`.

The agent is one of those that `examples/ppo.py` trained, from the weights that are kept beside it.
"""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import Any

from cyclopts import run
from PIL import Image

from motor_env.envs import Policy, ProbeEnv

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
FIRST_FRAME = 15  # before, the screen is nearly empty


def probe(observe: tuple[str, ...] = ()) -> ProbeEnv:
    """Probe-v0 with a screen."""
    return ProbeEnv(render_mode="rgb_array", observe=observe)


def film(env: Any, learned: Policy, path: Path, severity: float = 0.01) -> None:
    """An animation of one episode in which a winding grows worse by that much."""
    for seed in range(10_000):
        observation, info = env.reset(seed=seed)
        if info["severity"] == severity and 1000 < info["onset_sample"] < 2000:
            break
    learned.start(1)
    frames, over, step = [], False, 0
    while not over:
        observation, _, over, _, _ = env.step(int(learned.act(observation[None])[0]))
        if step % 2 == 0 or over:
            frames.append(Image.fromarray(env.render()).quantize(32))
        step += 1
    frames = [*frames[FIRST_FRAME:], *[frames[-1]] * 20]
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=80, loop=0, optimize=True)


def main(*, seed: int = 0, out: Path = Path("out/probe-agent.gif")) -> None:
    """Film the agent of that training seed."""
    sys.path.insert(0, str(EXAMPLES))
    ppo: Any = importlib.import_module("ppo")

    learner, env = ppo.Learner("probe", seed), probe(ppo.OBSERVED)
    learner.actor.load_state_dict(ppo.load_file(EXAMPLES / "ppo" / f"probe-{seed}.safetensors"))
    film(env, learner.policy(env), out)


if __name__ == "__main__":
    run(main)
