"""Reference scores of every environment: chance, the same action always, textbook, best known, bound, PPO.

python benchmarks/reference_scores.py                              # measures what is missing, then prints the table
python benchmarks/reference_scores.py --only Monitor --methods ppo --seeds 0 --seeds 1
python benchmarks/reference_scores.py --methods textbook --methods best      # no training
python benchmarks/reference_scores.py --show                       # the table of what is there

Each result is a file of its own, `results/reference/ID/METHOD.json` (of a trained agent one a seed), written when it
is done: begun anew, the command goes on with what is missing. A file that is removed is measured again.

Policies play seeds 1 to 10. The agent is PPO of Stable-Baselines3 with all defaults on eight sub-environments; it is
scored by its likeliest action on 500 other episodes, five times while it learns. One thread.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import tables
from cyclopts import run
from numpy.typing import NDArray
from reference_policies import REFERENCES

from motor_env.envs.policies.evaluation import interval, returns_of
from motor_env.envs.policies.rule_policies import Player, Random
from motor_env.motor.parameters import FloatArray

RESULTS = Path(__file__).resolve().parent / "results" / "reference"
SEEDS, TUNING_SEED, AGENT_SEED = tuple(range(1, 11)), 100, 77
STEPS, POINTS, N_ENVS, AGENT_EPISODES = 300_000, 10, 8, 500
TRIVIAL_EPISODES = 250
FEWEST = 3  # trainings of which an interval says anything
LEARNERS = ("ppo", "dqn")
POLICIES = ("random", "trivial", "textbook", "best", "bound")
METHODS = (*POLICIES, *LEARNERS)
DQN_IDS = ("Probe-v0", "Drive-v0")
"""Where another algorithm than PPO is tried, too."""
Result = dict[str, Any]


class Constant:
    """The same action always.

    Args:
        action: of one sub-environment.
    """

    def __init__(self, action: Any) -> None:
        self.action = action

    def start(self, count: int) -> None:
        """So many sub-environments begin."""
        self._actions = np.repeat(np.asarray(self.action)[None], count, axis=0)

    def act(self, observations: NDArray[np.float32]) -> NDArray[Any]:
        """That action."""
        return self._actions


class Agent:
    """What was learned, as a policy: the likeliest action.

    Args:
        model: of Stable-Baselines3.
    """

    def __init__(self, model: Any) -> None:
        self._model = model

    def start(self, count: int) -> None:
        """Nothing is remembered."""

    def act(self, observations: NDArray[np.float32]) -> NDArray[Any]:
        """What it holds for best."""
        actions: NDArray[Any] = self._model.predict(observations, deterministic=True)[0]
        return actions


def vector(name: str, count: int, **options: Any) -> Any:
    """So many sub-environments of an id."""
    return gym.make_vec(f"motor_env/{name}", num_envs=count, **options).unwrapped


def constants(space: Any) -> dict[str, Any]:
    """Actions that an agent could take always, by name."""
    if isinstance(space, gym.spaces.Discrete):
        return {f"always {n}": n for n in range(int(space.n))}
    width = int(space.shape[0])
    found = {"zeros": np.zeros(width)}
    for n in range(width):
        found |= {f"{sign:+d} at {n}": sign * np.eye(width)[n] for sign in (-1, 1)}
    return found


def trivial(name: str) -> tuple[str, Player]:
    """The best of them on the tuning seed."""
    envs = vector(name, TRIVIAL_EPISODES)
    found = constants(envs.single_action_space)
    means = {label: returns_of(envs, Constant(action), TUNING_SEED).mean() for label, action in found.items()}
    best = max(means, key=lambda label: float(means[label]))
    return best, Constant(found[best])


def scored(name: str, label: str, make: Callable[[Any], Player], options: Any, episodes: int) -> Result:
    """Mean over the episodes of all seeds, half its 95 % interval, and its standard error."""
    envs = vector(name, episodes, **options)
    policy = make(envs)
    found = np.concatenate([returns_of(envs, policy, seed) for seed in SEEDS])
    mean, half = interval(found)
    error = float(found.std(ddof=1) / len(found) ** 0.5)
    return {
        "policy": label,
        "episodes": len(found),
        "return": mean,
        "half_width": half,
        "standard_error": error,
    }


def wanted(name: str, method: str) -> bool:
    """Whether this is part of the table."""
    return method != "dqn" or name in DQN_IDS


def trained(name: str, learner: str, seed: int) -> Result:
    """An agent of Stable-Baselines3 with its defaults, and its learning curve."""
    import stable_baselines3
    import torch
    from quick_ppo import QuickPPO

    from motor_env.envs import StableBaselinesVecEnv

    torch.set_num_threads(1)
    envs = StableBaselinesVecEnv(vector(name, N_ENVS, autoreset_mode="SameStep"))
    envs.seed(1000 + seed)
    quick = learner == "ppo" and isinstance(envs.action_space, gym.spaces.Discrete)
    learner_type = QuickPPO if quick else getattr(stable_baselines3, learner.upper())
    model = learner_type("MlpPolicy", envs, seed=seed, device="cpu")
    test, curve = vector(name, AGENT_EPISODES), []
    begun, rollout = time.process_time(), getattr(model, "n_steps", 1) * N_ENVS
    rollouts = -(-STEPS // rollout)
    for part in np.diff(np.linspace(0, rollouts, POINTS + 1).astype(int)):
        model.learn(int(part) * rollout, reset_num_timesteps=False)
        mean, half = interval(returns_of(test, Agent(model), AGENT_SEED))
        curve.append({"steps": model.num_timesteps, "return": mean, "half_width": half})
    return {"seed": seed, **curve[-1], "cpu_s": round(time.process_time() - begun), "curve": curve}


def measure(name: str, method: str, seed: int) -> Result | None:
    """One result; None where nobody knows it."""
    reference = REFERENCES[name]
    if method == "bound":
        bound = reference.bound
        return None if bound is None else {"return": bound(vector(name, 1, **reference.options).options)}
    if method in LEARNERS:
        return trained(name, method, seed)
    if method in ("textbook", "best"):
        label, make = getattr(reference, method)
        return scored(name, label, make, reference.options, reference.episodes)
    label, policy = trivial(name) if method == "trivial" else ("random", None)
    return scored(
        name, label, lambda envs: policy or Random(envs.single_action_space, 0), {}, TRIVIAL_EPISODES
    )


def kept(name: str) -> dict[str, Any]:
    """What is known of an id: by method, of trained agents a list."""
    found: dict[str, Any] = {}
    for path in sorted((RESULTS / name).glob("*.json")):
        result = json.loads(path.read_text(encoding="utf-8"))
        method = path.stem.partition("-")[0]
        if method in LEARNERS:
            found.setdefault(method, []).append(result)
        else:
            found[method] = result
    return found


def threshold(best: Result) -> float:
    """The `reward_threshold` of an id: the mean of the best policy known, less one standard error."""
    return float(np.floor(1000.0 * (best["return"] - best["standard_error"])) / 1000.0)


def interquartile(returns: FloatArray, rng: np.random.Generator, rounds: int = 20_000) -> tuple[float, ...]:
    """Mean of the middle half of the runs, and its 95 % interval by the bootstrap, as rliable has it for one task.

    Agarwal et al. 2021, "Deep reinforcement learning at the edge of the statistical precipice". rliable 1.2.0 itself
    gives the same numbers; it does not run beside pandas 3.
    """
    from scipy.stats import trim_mean

    drawn = trim_mean(rng.choice(returns, (rounds, len(returns))), 0.25, axis=1)
    return float(trim_mean(returns, 0.25)), *np.quantile(drawn, [0.025, 0.975]).tolist()


def cell(result: Result | None) -> str:
    """A mean and half its interval."""
    if result is None:
        return ""
    half = f" ± {result['half_width']:.3f}" if "half_width" in result else ""
    return f"{result['return']:+.3f}{half}"


def runs(returns: list[float]) -> str:
    """What agents of several training seeds return."""
    if len(returns) < FEWEST:
        return ", ".join(f"{value:+.3f}" for value in returns)
    middle, low, high = interquartile(np.array(returns), np.random.default_rng(0))
    return f"{middle:+.3f} ({low:+.3f} to {high:+.3f}; {len(returns)})"


def page_of(name: str) -> str:
    """The place in the documentation that describes an id: variants share the page of their family."""
    family = next(
        each for each in ("Monitor-v0", "Probe-v0", "Drive-v0", "Maintain-v0") if name.startswith(each[:-3])
    )
    return f"{family}.md" if name == family else f"{family}.md#{name.lower()}"


def cells_of(name: str) -> tuple[list[str], list[str]]:
    """What policies, and what agents return in an id."""
    found = kept(name)
    policies = [cell(found.get(method)) for method in POLICIES]
    learned = {method: runs([each["return"] for each in found.get(method, [])]) for method in LEARNERS}
    return policies, [cell(found.get("best")), *learned.values()]


def table() -> str:
    """Two tables of all ids in the order of the registry: policies, then agents."""
    names = [spec.removeprefix("motor_env/") for spec in gym.registry if spec.startswith("motor_env/")]
    heads = (
        ["id", "random", "always", "textbook", "best known", "no policy exceeds"],
        ["id", "best known", "PPO, defaults", "DQN, defaults"],
    )
    cells = {f"[{name}](environments/{page_of(name)})": cells_of(name) for name in names}
    return "\n\n".join(
        tables.table(head, ([link, *parts[which]] for link, parts in cells.items()))
        for which, head in enumerate(heads)
    )


def main(
    *,
    only: str = "",
    methods: tuple[str, ...] = METHODS,
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4),
    show: bool = False,
) -> None:
    """Measure what is missing and print the table.

    Args:
        only: ids that contain this.
        methods: of METHODS.
        seeds: of the trainings.
        show: measure nothing.
    """
    chosen = [name for name in REFERENCES if only in name]
    if not chosen:
        raise SystemExit(f"no id in REFERENCES of reference_policies.py contains {only!r}")
    for name in chosen:
        for method in methods:
            learns = method in LEARNERS
            for seed in seeds if learns else (0,):
                path = RESULTS / name / (f"{method}-{seed}.json" if learns else f"{method}.json")
                if show or not wanted(name, method) or path.exists():
                    continue
                begun = time.monotonic()
                result = measure(name, method, seed)
                if result is not None:
                    path.parent.mkdir(parents=True, exist_ok=True)
                    path.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
                    print(f"{name} {path.stem}: {cell(result)}, {time.monotonic() - begun:.0f} s", flush=True)
    print(table())
    for name in chosen:
        if "best" in kept(name):
            print(f"reward_threshold of {name}: {threshold(kept(name)['best']):.3f}")


if __name__ == "__main__":
    run(main)
