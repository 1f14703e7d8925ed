"""Environments a CPU-second, against CartPole (single and vector) and gym-electric-motor's DC environment.

Each rate is measured in a process of its own with every thread pool at 1, ours and the peer's in turn, three times; the
best of each counts. Time is the process's CPU time, and everything is on: faults, per-motor parameters, noise, filter,
statistics, reward, autoreset (drawing the new motors included) and info.
"""

import subprocess
import sys
import time
from collections.abc import Callable
from itertools import cycle
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from result import Result

ROUNDS = 3
WAITING = 0.999
"""Probability that our random agent waits; otherwise it declares something, so episodes end all the time."""


def rate_of(step: Callable[[], object], steps_a_call: int, calls: int) -> float:
    """Steps a CPU-second, best of five stretches."""
    for _ in range(calls // 4):
        step()
    best = 0.0
    for _ in range(5):
        start = time.process_time()
        for _ in range(calls):
            step()
        best = max(best, steps_a_call * calls / (time.process_time() - start))
    return best


def vector_rate(name: str, count: int) -> float:
    """Of a vector environment with random actions."""
    envs = gym.make_vec(name, num_envs=count)
    rng = np.random.default_rng(0)
    choices = int(envs.single_action_space.n)  # type: ignore[attr-defined]  # Discrete in all of these
    anything = rng.integers(0, choices, (500, count))
    if name.startswith("motor_env"):
        anything = np.where(rng.random((500, count)) < WAITING, 0, anything)
    envs.reset(seed=0)
    actions = cycle(anything)

    def step() -> None:
        envs.step(next(actions))

    return rate_of(step, count, 2_000_000 // count)


def single_rate(name: str) -> float:
    """Of a single environment with random actions, resets included."""
    env = make_single(name)
    rng = np.random.default_rng(0)
    if name == "gem":
        actions = [np.array([value]) for value in rng.uniform(0.0, 1.0, 512)]
    else:
        choices = int(env.action_space.n)
        actions = rng.integers(0, choices, 512).tolist()
        if name.startswith("motor_env"):
            actions = np.where(rng.random(512) < WAITING, 0, actions).tolist()
    env.reset(seed=0)
    place = 0

    def step() -> None:
        nonlocal place
        place = (place + 1) % 512
        result = env.step(actions[place])
        if result[2] or result[3]:
            env.reset()

    return rate_of(step, 1, 3000 if name == "gem" else 30_000)


def make_single(name: str) -> Any:
    """By `gymnasium.make`; gem is gym-electric-motor's permanently excited DC motor under current control."""
    if name == "gem":
        import gym_electric_motor

        return gym_electric_motor.make("Cont-CC-PermExDc-v0")
    return gym.make(name)


def measured_apart(kind: str, name: str, count: int) -> float:
    """A rate, measured in a process of its own."""
    command = [sys.executable, str(Path(__file__).resolve()), kind, name, str(count)]
    answer = subprocess.run(command, check=True, capture_output=True, text=True, cwd=Path(__file__).parent)
    return float(answer.stdout.split()[-1])


def compare(title: str, kind: str, ours: str, peer: str, count: int, bar: float, peer_name: str) -> Result:
    """Ours and the peer in turn, the best of each."""
    measured_apart(kind, ours, count)  # compiles what is not in numba's cache yet
    pairs = [(measured_apart(kind, ours, count), measured_apart(kind, peer, count)) for _ in range(ROUNDS)]
    return Result(
        title,
        ours=max(mine for mine, _ in pairs),
        peer=max(theirs for _, theirs in pairs),
        peer_name=peer_name,
        bar=bar,
    )


def run() -> list[Result]:
    """Rates are environment steps a CPU-second."""
    monitor, probe, cartpole = "motor_env/Monitor-v0", "motor_env/Probe-v0", "CartPole-v1"
    return [
        compare("Monitor-v0, vector of 4096", "vector", monitor, cartpole, 4096, 4.0, "CartPoleVectorEnv"),
        compare("Monitor-v0, vector of 1024", "vector", monitor, cartpole, 1024, 5.0, "CartPoleVectorEnv"),
        compare("Monitor-v0, single by make", "single", monitor, cartpole, 1, 2.0, "CartPole"),
        compare("Monitor-v0, single by make", "single", monitor, "gem", 1, 15.0, "gym-electric-motor DC"),
        compare("Probe-v0 (20 samples a step), single", "single", probe, cartpole, 1, 0.5, "CartPole"),
    ]


if __name__ == "__main__":
    import motor_env  # noqa: F401  # registers

    which, what, number = sys.argv[1:]
    print(vector_rate(what, int(number)) if which == "vector" else single_rate(what))
