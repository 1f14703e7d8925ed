"""Draw one episode as the environment's oscilloscope shows it, or a film of it.

python examples/scope.py motor_env/Probe-v0 --label winding_contact --out out/scope.png
python examples/scope.py motor_env/Monitor-v0 --label winding_contact --out out/scope.gif
"""

import argparse
from pathlib import Path
from typing import Any

import gymnasium as gym
from matplotlib.image import imsave

from motor_env.envs.single import MotorEnv


def episode_of(env: Any, label: str) -> None:
    """Reset to an episode with that label, and an onset in its first half."""
    half = env.unwrapped.options.n_samples // 2
    for seed in range(1000):
        _, info = env.reset(seed=seed)
        if info["label"] == label and info["onset_sample"] < half:
            return
    raise SystemExit(f"no episode with label {label} among 1000")


def main() -> None:
    """Wait, or probe with +-1 V in turn; declare once the bank is sure or the episode nears its end."""
    parser = argparse.ArgumentParser(description="Draw one episode.")
    parser.add_argument("id")
    parser.add_argument("--label", default="winding_contact")
    parser.add_argument("--out", type=Path, default=Path("out/scope.png"))
    given = parser.parse_args()
    env = gym.make(f"motor_env:{given.id}", render_mode="rgb_array")
    episode_of(env, given.label)
    motor: MotorEnv = env.unwrapped  # type: ignore[assignment]  # ours
    probes, steps = "Probe" in given.id, motor.options.n_steps
    declare = len(motor.setup.offsets_v) - len(motor.setup.kinds) + ("winding" in given.label)
    frames = []
    for step in range(int(0.9 * steps)):
        env.step(1 + (step // 4) % 2 if probes and (step // 20) % 2 == 0 else 0)
        if given.out.suffix == ".gif" and step % max(1, steps // 80) == 0:
            frames.append(env.render())
    env.step(declare)
    given.out.parent.mkdir(parents=True, exist_ok=True)
    if given.out.suffix == ".gif":
        from PIL import Image

        images = [Image.fromarray(frame).quantize(32) for frame in [*frames, *[env.render()] * 15]]  # type: ignore[arg-type]
        images[0].save(given.out, save_all=True, append_images=images[1:], duration=60, loop=0)
    else:
        imsave(given.out, env.render())


if __name__ == "__main__":
    main()
