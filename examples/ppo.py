"""PPO in one file on our vector environment (Schulman et al. 2017, in the manner of CleanRL; needs torch, safetensors).

python examples/ppo.py --task monitor --out out/ppo     # five training seeds; some four minutes of one core
python examples/ppo.py --task probe --steps 1200000 --out out/ppo
python examples/ppo.py --task monitor --score --out examples/ppo   # scores the weights that are there

A vector with autoreset SameStep needs no special case: the observation after the end of an episode is the first of
the next one, and no value is carried over the end. A uniform first policy would end every episode after two steps. So
the monitor asks for a declaration to be confirmed (`confirm_steps`), and the probe's agent is reluctant to declare at
first. The agent sees the summary of a posterior, made from what the environment shows, and learns from the reward that
it expects. It is scored by its likeliest action with the environment's own rewards, beside the best textbook policy, on
the same episodes.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from motor_env.envs import (
    BayesPolicy,
    BeliefPolicy,
    EventTriggeredProbing,
    ExpectedRewardTest,
    MonitorVectorEnv,
    Policy,
    PosteriorView,
    ProbeBelief,
    ProbeVectorEnv,
    run_episodes,
)
from motor_env.envs.policies.evaluation import interval, joined
from motor_env.envs.vector import MotorVectorEnv

OBSERVED = ("innovation_current", "voltage")
N_ENVS, N_STEPS, N_EPOCHS, BATCH = 256, 64, 4, 2048
CLIP, LAMBDA, LEARNING_RATE, ENTROPY = 0.2, 0.97, 1e-3, 1e-3
EVALUATION_SEEDS, EPISODES = (1, 2, 3, 4, 5), 500
CONFIRM, RELUCTANCE = {"monitor": 3, "probe": 1}, {"monitor": 0.0, "probe": 6.0}


def make(task: str, count: int, **options: Any) -> MotorVectorEnv:
    """The task with a decision every 0.5 ms (a monitor, which has to declare three times) or 2 ms (a probe)."""
    options |= {"observe": OBSERVED, "confirm_steps": CONFIRM[task]}
    if task == "probe":
        return ProbeVectorEnv(count, **options)
    return MonitorVectorEnv(count, samples_per_step=5, **options)


def textbook(task: str) -> tuple[MotorVectorEnv, Policy]:
    """The best textbook policy, tuned on other episodes, and where it acts: after every sample."""
    if task == "probe":
        envs: MotorVectorEnv = ProbeVectorEnv(EPISODES, observe=OBSERVED)
        return envs, EventTriggeredProbing(ExpectedRewardTest(envs.setup, 0.97), 0.08)
    envs = MonitorVectorEnv(EPISODES, observe=("measured_current",))
    return envs, BayesPolicy(envs.setup, 0.9609)


def network(n_inputs: int, n_outputs: int, last: float) -> nn.Sequential:
    """Two hidden layers of 64, orthogonal weights."""
    sizes, scales = (n_inputs, 64, 64, n_outputs), (2.0**0.5, 2.0**0.5, last)
    layers: list[nn.Module] = []
    for n_in, n_out, scale in zip(sizes[:-1], sizes[1:], scales, strict=True):
        layer = nn.Linear(n_in, n_out)
        nn.init.orthogonal_(layer.weight, scale)
        nn.init.zeros_(layer.bias)
        layers += [layer, nn.Tanh()]
    return nn.Sequential(*layers[:-1])


def advantages(rewards: Tensor, over: Tensor, values: Tensor) -> Tensor:
    """Generalised advantages of a rollout, undiscounted; `values` has one row more."""
    answer, following = torch.empty_like(rewards), torch.zeros(rewards.shape[1])
    for t in reversed(range(len(rewards))):
        goes_on = 1.0 - over[t]
        following = rewards[t] + goes_on * (values[t + 1] + LAMBDA * following) - values[t]
        answer[t] = following
    return answer


class Learner:
    """Actor, critic, and what they learn from."""

    entropy = ENTROPY

    def __init__(self, task: str, seed: int) -> None:
        self.task = task
        envs = PosteriorView(make(task, N_ENVS, autoreset_mode="SameStep"))
        self.begin(envs, np.where(envs.belief.setup.declarations > 0, RELUCTANCE[task], 0.0), seed)

    def begin(self, envs: Any, reluctance: Any, seed: int) -> None:
        """Networks that at first are so reluctant to take each action, and the first observations."""
        torch.manual_seed(seed)
        self.envs = envs
        self.seen = torch.from_numpy(np.ascontiguousarray(envs.reset(seed=1000 + seed)[0]))
        self.width = self.seen.shape[1]
        self.actor, self.critic = network(self.width, len(reluctance), 0.01), network(self.width, 1, 1.0)
        with torch.no_grad():
            self.actor[-1].bias -= torch.tensor(reluctance)
        self.parameters = [*self.actor.parameters(), *self.critic.parameters()]
        self.optimizer = torch.optim.Adam(self.parameters, LEARNING_RATE, eps=1e-5)

    @torch.no_grad()
    def rollout(self) -> tuple[Tensor, ...]:
        """Observations, actions, their log-probabilities, advantages and returns of the next steps, flat."""
        seen = torch.empty(N_STEPS + 1, N_ENVS, self.width)
        actions = torch.empty(N_STEPS, N_ENVS, dtype=torch.int64)
        chances, rewards, over = torch.empty(3, N_STEPS, N_ENVS)
        for t in range(N_STEPS):
            seen[t] = self.seen
            choice = torch.distributions.Categorical(logits=self.actor(self.seen))
            actions[t] = choice.sample()
            chances[t] = choice.log_prob(actions[t])
            observed, reward, ended, _, _ = self.envs.step(actions[t].numpy())
            self.seen = torch.from_numpy(observed)
            rewards[t], over[t] = torch.from_numpy(reward), torch.from_numpy(ended)
        seen[N_STEPS] = self.seen
        values = self.critic(seen)[..., 0]
        gained = advantages(rewards, over, values)
        parts = (seen[:-1], actions, chances, gained, gained + values[:-1])
        return tuple(part.flatten(0, 1) for part in parts)

    def update(self, left: float) -> None:
        """Learn from one rollout; `left` is the share of the training that is to come."""
        self.optimizer.param_groups[0]["lr"] = LEARNING_RATE * min(1.0, 2.0 * left)
        data = self.rollout()
        for _ in range(N_EPOCHS):
            for rows in torch.randperm(N_ENVS * N_STEPS).split(BATCH):
                seen, actions, chances, gained, returns = (part[rows] for part in data)
                choice = torch.distributions.Categorical(logits=self.actor(seen))
                ratio = (choice.log_prob(actions) - chances).exp()
                gained = (gained - gained.mean()) / (gained.std() + 1e-8)
                worse = torch.minimum(ratio * gained, ratio.clamp(1.0 - CLIP, 1.0 + CLIP) * gained)
                error = (self.critic(seen)[:, 0] - returns).square()
                loss = (0.5 * error - worse - self.entropy * left * choice.entropy()).mean()
                self.optimizer.zero_grad()
                loss.backward()  # type: ignore[no-untyped-call]  # torch's
                nn.utils.clip_grad_norm_(self.parameters, 0.5)
                self.optimizer.step()

    @torch.no_grad()
    def choose(self, seen: NDArray[np.float32]) -> NDArray[np.int64]:
        """The likeliest actions."""
        actions: NDArray[np.int64] = (
            self.actor(torch.from_numpy(np.ascontiguousarray(seen))).argmax(1).numpy()
        )
        return actions

    def policy(self, envs: MotorVectorEnv) -> Policy:
        """The likeliest action."""
        return BeliefPolicy(ProbeBelief(envs.setup), self.choose)

    def validation(self) -> NDArray[np.float64]:
        """Returns of validation episodes."""
        envs = make(self.task, EPISODES // 2)
        return run_episodes(envs, self.policy(envs), 800).returns


def train(learner: Learner, steps: int, points: int = 8) -> list[dict[str, float]]:
    """The learning curve: mean return on validation episodes."""
    rounds, curve = max(1, steps // (N_ENVS * N_STEPS)), []
    for k in range(rounds):
        learner.update(1.0 - k / rounds)
        if (k + 1) * points // rounds > k * points // rounds:
            mean, half = interval(learner.validation())
            curve.append({"steps": (k + 1) * N_ENVS * N_STEPS, "mean_return": mean, "half_width": half})
            print(f"{curve[-1]['steps']:>9} steps: {mean:+.3f} ± {half:.3f}", flush=True)  # noqa: T201
    return curve


def main() -> None:
    """Train or load, score, write."""
    parser = argparse.ArgumentParser(description="Train agents by PPO and score them beside the textbook.")
    parser.add_argument("--task", choices=["monitor", "probe"], default="monitor")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4], help="of the training")
    parser.add_argument("--steps", type=int, default=800_000, help="of training, over all sub-environments")
    parser.add_argument("--score", action="store_true", help="score the weights in the folder, train nothing")
    parser.add_argument("--out", type=Path, default=Path("out/ppo"))
    given = parser.parse_args()
    torch.set_num_threads(1)
    given.out.mkdir(parents=True, exist_ok=True)
    rival, envs = textbook(given.task), make(given.task, EPISODES)
    theirs = joined([run_episodes(*rival, seed) for seed in EVALUATION_SEEDS]).returns
    found: dict[str, Any] = {"steps": given.steps, "textbook": interval(theirs), "agents": {}}
    for seed in given.seeds:
        learner, weights = Learner(given.task, seed), given.out / f"{given.task}-{seed}.safetensors"
        if given.score:
            learner.actor.load_state_dict(load_file(weights))
        curve = [] if given.score else train(learner, given.steps)
        policy = learner.policy(envs)
        ours = joined([run_episodes(envs, policy, at) for at in EVALUATION_SEEDS]).returns
        ahead = interval(ours - theirs)
        if not given.score:
            found["agents"][seed] = {"return": interval(ours), "ahead": ahead, "curve": curve}
            save_file(learner.actor.state_dict(), weights)
            (given.out / f"{given.task}.json").write_text(json.dumps(found, indent=1) + "\n")
        print(f"seed {seed}: {ours.mean():+.4f}, ahead by {ahead[0]:+.4f} ± {ahead[1]:.4f}", flush=True)  # noqa: T201


if __name__ == "__main__":
    main()
