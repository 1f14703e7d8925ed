"""Environments a CPU-second by policy, against CartPole (single and vector) and gym-electric-motor's DC environment.

Three policies: one that waits (declares in 0.1 % of the steps), one that ends 6 % of the steps' episodes (as random
actions do in CartPole), and uniform random actions, which end two of three. Each rate is measured in a process of its
own with every thread pool at 1, ours and the peer's in turn, five times; the medians count. Time is the process's CPU
time, and everything is on: faults, per-motor parameters, noise, filter, statistics, reward, autoreset with the drawing
of the new episodes, and info.
"""

import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from run import Result

ROUNDS = 5
ROWS = 500
DECLARES = {"waits": 0.001, "6 % ends": 0.064, "random": None}
"""Probability that an agent declares something; None: every action is as likely as any other."""
BASE, HARD = "motor_env/MonitorInstant-v0", "hard"
MONITOR, SENSOR = "motor_env/Monitor-v0", "motor_env/MonitorSensor-v0"
PROBE, DRIVE, MAINTAIN = "motor_env/ProbeInstant-v0", "motor_env/DriveControl-v0", "motor_env/Maintain-v0"
MADE: dict[str, tuple[str, dict[str, Any]]] = {HARD: (BASE, {"recipe": "hard"})}
"""What is no id of its own."""
CARTPOLE = "CartPole-v1"


class Row(NamedTuple):
    """A comparison: what of ours, by which policy, how many at once (1: single), beside which peer, and the bar."""

    ours: str
    policy: str
    number: int
    bar: float
    peer: str = CARTPOLE
    title: str = "MonitorInstant-v0"


TABLE = (
    Row(BASE, "waits", 4096, 4.0),
    Row(BASE, "6 % ends", 4096, 1.5),
    Row(BASE, "random", 4096, 0.38),  # 6 M steps a second beside 15.5 M of CartPole
    Row(HARD, "6 % ends", 4096, 0.9, title="MonitorInstant-v0 on hard"),
    Row(BASE, "waits", 256, 3.0),
    Row(BASE, "6 % ends", 256, 2.5),
    Row(BASE, "waits", 1, 2.0),
    Row(BASE, "6 % ends", 1, 1.7),
    Row(BASE, "random", 1, 0.7),
    Row(BASE, "waits", 1, 15.0, peer="gem"),
    Row(MONITOR, "waits", 4096, 0.7, title="Monitor-v0 (20 samples a step)"),
    Row(MONITOR, "6 % ends", 4096, 0.7, title="Monitor-v0 (20 samples a step)"),
    Row(SENSOR, "6 % ends", 4096, 0.3, title="MonitorSensor-v0 (20 samples a step)"),
    Row(MONITOR, "waits", 1, 1.6, title="Monitor-v0 (20 samples a step)"),
    Row(PROBE, "waits", 1, 0.5, title="ProbeInstant-v0 (20 samples a step)"),
    Row(DRIVE, "waits", 4096, 0.5, title="DriveControl-v0"),
    Row(DRIVE, "6 % ends", 4096, 0.2, title="DriveControl-v0"),
    Row(DRIVE, "waits", 1, 0.5, title="DriveControl-v0"),
    Row(MAINTAIN, "waits", 4096, 0.25, title="Maintain-v0"),
    Row(MAINTAIN, "random", 4096, 0.24, title="Maintain-v0"),
    Row(MAINTAIN, "waits", 1, 1.0, title="Maintain-v0"),
)


def rate_of(step: Callable[[int], object], steps_a_call: int, calls: int) -> float:
    """Steps a CPU-second, median of five stretches."""
    for k in range(calls // 4):
        step(k)
    rates = []
    for _ in range(5):
        start = time.process_time()
        for k in range(calls):
            step(k)
        rates.append(steps_a_call * calls / (time.process_time() - start))
    return median(rates)


def actions_of(env: Any, policy: str, shape: tuple[int, ...]) -> NDArray[Any]:
    """What the policy does in so many steps; the peers have random actions always.

    A drive stops instead of declaring something; a bearing is replaced.
    """
    rng = np.random.default_rng(0)
    space = getattr(env, "single_action_space", env.action_space)
    probability, setup = DECLARES.get(policy), getattr(env.unwrapped, "setup", None)
    if isinstance(space, gym.spaces.Box):
        drives = rng.uniform(0.3, 0.7, (*shape, 3))
        drives[..., 1], drives[..., 2] = -1.0, np.where(rng.random(shape) < (probability or 0.0), 1.0, -1.0)
        return drives
    if probability is not None and getattr(env.spec, "id", "") == MAINTAIN:
        return np.where(rng.random(shape) < probability, 2, 0)
    if probability is None or setup is None:
        return rng.integers(0, space.n, shape)
    declares = rng.integers(space.n - len(setup.kinds), space.n, shape)
    return np.where(rng.random(shape) < probability, declares, 0)


def vector_rate(name: str, policy: str, count: int) -> float:
    """Of a vector environment."""
    identity, options = MADE.get(name, (name, {}))
    envs = gym.make_vec(identity, num_envs=count, **options)
    actions = actions_of(envs, policy, (ROWS, count))
    envs.reset(seed=0)
    return rate_of(lambda k: envs.step(actions[k % ROWS]), count, 2_000_000 // count)


def single_rate(name: str, policy: str) -> float:
    """Of a single environment by `gymnasium.make`, resets included."""
    if name == "gem":
        import gym_electric_motor

        env: Any = gym_electric_motor.make("Cont-CC-PermExDc-v0")
        actions: list[Any] = [np.array([u]) for u in np.random.default_rng(0).uniform(0.0, 1.0, ROWS)]
    else:
        env = gym.make(name)
        chosen = actions_of(env, policy, (5 * ROWS,))
        actions = list(chosen) if chosen.ndim > 1 else chosen.tolist()
    env.reset(seed=0)
    n = len(actions)

    def step(k: int) -> None:
        result = env.step(actions[k % n])
        if result[2] or result[3]:
            env.reset()

    return rate_of(step, 1, 3000 if name == "gem" else 30_000)


def measured_apart(name: str, policy: str, count: int) -> float:
    """A rate, measured in a process of its own."""
    command = [sys.executable, str(Path(__file__).resolve()), name, policy, str(count)]
    answer = subprocess.run(command, check=True, capture_output=True, text=True, cwd=Path(__file__).parent)
    return float(answer.stdout.split()[-1])


def compare(row: Row) -> Result:
    """Ours and the peer in turn, the medians."""
    measured_apart(row.ours, row.policy, row.number)  # compiles what is not in numba's cache yet
    pairs = [
        (measured_apart(row.ours, row.policy, row.number), measured_apart(row.peer, row.policy, row.number))
        for _ in range(ROUNDS)
    ]
    size = "single by make" if row.number == 1 else f"vector of {row.number}"
    names = {CARTPOLE: "CartPole" if row.number == 1 else "CartPoleVectorEnv", "gem": "gym-electric-motor DC"}
    return Result(
        f"{row.title}, {size}, {row.policy}",
        ours=median(mine for mine, _ in pairs),
        peer=median(theirs for _, theirs in pairs),
        peer_name=names[row.peer],
        bar=row.bar,
    )


def run() -> list[Result]:
    """Rates are environment steps a CPU-second."""
    return [compare(row) for row in TABLE]


if __name__ == "__main__":
    import motor_env  # noqa: F401  # registers

    which, how, number = sys.argv[1:]
    print(vector_rate(which, how, int(number)) if int(number) > 1 else single_rate(which, how))
