"""PPO of Stable-Baselines3 with its defaults: train an agent, or watch and score the one that is kept (extra rl).

python examples/ppo.py --play Monitor-v0     # 500 episodes, and the screen at the end of one
python examples/ppo.py --train Monitor-v0    # 300,000 steps on eight sub-environments; two minutes of one core
python examples/ppo.py --train Monitor-v0 --tensorboard out/logs    # then: tensorboard --logdir out/logs

`examples/agents` keeps one agent of each of the ids to begin with: the weights of its policy alone, as plain arrays, so
that nothing is unpickled, and NumPy plays it.
"""

import argparse
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from matplotlib.image import imsave
from numpy.typing import NDArray

import motor_env  # noqa: F401  # registers the environments
from motor_env.envs import StableBaselinesVecEnv, returns_of
from motor_env.envs.policies.evaluation import interval

AGENTS = Path(__file__).parent / "agents"
EPISODES, SEED = 500, 77


class Agent:
    """The likeliest action of a policy network of PPO: two hidden layers with tanh."""

    def __init__(self, weights: dict[str, NDArray[np.float32]]) -> None:
        names = ("mlp_extractor.policy_net.0", "mlp_extractor.policy_net.2", "action_net")
        self._layers = [(weights[f"{name}.weight"].T, weights[f"{name}.bias"]) for name in names]

    def start(self, count: int) -> None:
        """Nothing is remembered."""

    def act(self, observations: NDArray[np.float32]) -> NDArray[np.int64]:
        """One action for each sub-environment."""
        *hidden, (weight, bias) = self._layers
        for rows, offset in hidden:
            observations = np.tanh(observations @ rows + offset)
        actions: NDArray[np.int64] = (observations @ weight + bias).argmax(axis=1)
        return actions


def train(name: str, steps: int, seed: int, logs: str | None) -> dict[str, NDArray[np.float32]]:
    """Weights of the policy after so many steps; its returns, losses and entropy go to a folder of logs."""
    import torch
    from stable_baselines3 import PPO

    torch.set_num_threads(1)  # small networks: one core is as quick, and the figures repeat
    envs = StableBaselinesVecEnv(gym.make_vec(f"motor_env/{name}", num_envs=8, autoreset_mode="SameStep"))
    envs.seed(1000 + seed)
    model = PPO("MlpPolicy", envs, seed=seed, device="cpu", tensorboard_log=logs).learn(steps)
    weights = {key: value.numpy() for key, value in model.policy.state_dict().items()}
    return {key: value for key, value in weights.items() if "policy_net" in key or "action_net" in key}


def play(name: str, agent: Agent, picture: Path) -> str:
    """Draw the screen at the end of an episode with a fault, and tell the agent's mean return."""
    env: Any = gym.make(f"motor_env/{name}", render_mode="rgb_array")
    observation, info = env.reset(seed=1)
    while info.get("onset_sample", info.get("onset_step", 0)) < 0:
        observation, info = env.reset()
    over = False
    while not over:
        observation, _, over, _, info = env.step(int(agent.act(observation[None])[0]))
    picture.parent.mkdir(parents=True, exist_ok=True)
    imsave(picture, env.render())
    envs: Any = gym.make_vec(f"motor_env/{name}", num_envs=EPISODES).unwrapped
    mean, half = interval(returns_of(envs, agent, SEED))
    return f"{name}: mean return {mean:+.3f} ± {half:.3f} of {EPISODES} episodes; the screen is in {picture}"


def main() -> None:
    """Train or play."""
    parser = argparse.ArgumentParser(description="Train an agent by PPO, or watch and score one.")
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--play", metavar="ID", help="such as Monitor-v0")
    what.add_argument("--train", metavar="ID", help="any id whose actions are numbered")
    parser.add_argument("--steps", type=int, default=300_000, help="of training, over all sub-environments")
    parser.add_argument("--seed", type=int, default=0, help="of the training")
    parser.add_argument(
        "--tensorboard", metavar="FOLDER", help="where a training leaves logs for TensorBoard"
    )
    parser.add_argument("--agents", type=Path, help="folder of weights (kept ones; of a training out/agents)")
    given = parser.parse_args()
    name, out = given.play or given.train, Path("out/agents")
    weights = (given.agents or (AGENTS if given.play else out)) / f"{name}.npz"
    if given.play and not weights.is_file():
        parser.error(f"{weights}: no such agent; --train {name} makes one")
    if given.train:
        weights.parent.mkdir(parents=True, exist_ok=True)
        np.savez(weights, **train(name, given.steps, given.seed, given.tensorboard))
    print(play(name, Agent(dict(np.load(weights))), out / f"{name}.png"))


if __name__ == "__main__":
    main()
