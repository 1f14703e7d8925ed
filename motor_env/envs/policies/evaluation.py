"""Scores of a policy on a task: one episode in each sub-environment, with intervals."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from motor_env.common.arrays import instance, shown
from motor_env.envs.layout import BoolArray
from motor_env.envs.policies.rule_policies import Actions, Player, Policy, ThresholdPolicy
from motor_env.envs.single import Info
from motor_env.envs.vector import MotorVectorEnv, StreamVectorEnv
from motor_env.motor.parameters import FloatArray, require


class Runs(NamedTuple):
    """Outcome and truth of each episode; all of shape (episodes,).

    Attributes:
        returns: sum of the rewards.
        steps: step of the declaration, 0 without one.
        declared: number of the declared kind, 0 for none.
        right: number of the right kind, 0 for healthy.
        onset: in samples, -1 without a fault.
        probing: share of the steps with a voltage offset.
    """

    returns: FloatArray
    steps: NDArray[np.int64]
    declared: NDArray[np.int64]
    right: NDArray[np.int64]
    onset: NDArray[np.int64]
    probing: FloatArray


@dataclass(frozen=True, slots=True)
class Score:
    """Score of a policy over episodes.

    Attributes:
        episodes: their number.
        mean_return: mean return of an episode.
        return_half_width: half the width of its 95 % interval.
        false_alarm_share: share of episodes with a declaration before any fault.
        detected_share: share of episodes with a declaration, of those with a fault and no false alarm.
        isolated_share: share of those declarations of the right kind.
        median_delay_s: median time from onset to declaration.
        late_share: share of the faults whose onset leaves less than 1 % of the horizon.
        probing_share: share of the steps with a voltage offset.
    """

    episodes: int
    mean_return: float
    return_half_width: float
    false_alarm_share: float
    detected_share: float
    isolated_share: float
    median_delay_s: float
    late_share: float
    probing_share: float

    def as_row(self) -> dict[str, float]:
        """Return the fields by name."""
        return asdict(self)


def _steps(
    envs: StreamVectorEnv[Any], policy: Player, seed: int
) -> Iterator[tuple[BoolArray, NDArray[Any], FloatArray, Info]]:
    """Play one episode each; yield which still run, actions, rewards and info of each step."""
    observations, _ = envs.reset(seed=seed)
    policy.start(envs.num_envs)
    alive = np.ones(envs.num_envs, dtype=np.bool_)
    while alive.any():
        actions = policy.act(observations)
        observations, rewards, terminated, truncated, info = envs.step(actions)
        yield alive, actions, rewards, info
        alive = alive & ~(terminated | truncated)


def _require_vector(envs: Any) -> None:
    """Raise `TypeError` without sub-environments; custom wrappers need no class of Gymnasium's."""
    if not hasattr(envs, "num_envs"):
        raise TypeError(f"envs must be a vector of environments, got {shown(envs)}")


def returns_of(envs: StreamVectorEnv[Any], policy: Player, seed: int) -> FloatArray:
    """Return the return of one episode in each sub-environment, of any family, shape (num_envs,)."""
    _require_vector(envs)
    returns = np.zeros(envs.num_envs)
    for alive, _, rewards, _ in _steps(envs, policy, seed):
        returns += rewards * alive
    return returns


def parts_of(envs: StreamVectorEnv[Any], policy: Player, seed: int) -> FloatArray:
    """Return the parts of these returns, in the order of the info's `reward_*`, shape (parts, num_envs)."""
    _require_vector(envs)
    parts = np.zeros((len(envs.part_names), envs.num_envs))
    for alive, _, _, info in _steps(envs, policy, seed):
        parts += np.stack([info[name] for name in envs.part_names]) * alive
    return parts


def run_episodes(envs: MotorVectorEnv, policy: Policy, seed: int) -> Runs:
    """Play one episode in each sub-environment of Monitor or Probe."""
    instance("envs", envs, VectorEnv)
    count, info = envs.num_envs, envs.reset(seed=seed)[1]
    right, onset = envs.setup.right_declarations[info["class_index"]], info["onset_sample"]
    returns, probing = np.zeros((2, count))
    steps, declared, lengths = np.zeros((3, count), dtype=np.int64)
    for step, (alive, actions, rewards, _) in enumerate(_steps(envs, policy, seed)):
        returns += rewards * alive
        probing += (envs.setup.offsets_v[actions] != 0.0) & alive
        lengths += alive
        declared[alive] = envs.setup.declarations[actions[alive]]
        steps[alive] = np.where(declared[alive] > 0, step, 0)
    return Runs(returns, steps, declared, right, onset, probing / lengths)


def sweep(
    envs: MotorVectorEnv, policy: ThresholdPolicy, thresholds: Sequence[float], seed: int
) -> list[Runs]:
    """Play all thresholds of a policy at once, as nothing depends on them before a declaration.

    Raises:
        ValueError: a declaration needs confirmation, or energy has a price, known only at the end.
    """
    instance("envs", envs, VectorEnv)
    for name, wanted in (("confirm_steps", 1), ("energy_cost_per_j", 0)):
        found = getattr(envs.options, name)
        require(found == wanted, f"{name} of the environments must be {wanted} for a sweep, got {found:g}")
    count, limits = envs.num_envs, np.asarray(thresholds, dtype=np.float64)[:, None]
    observations, info = envs.reset(seed=seed)
    right, onset = envs.setup.right_declarations[info["class_index"]], info["onset_sample"]
    policy.start(count)
    waited, probed = np.zeros((2, count))
    returns, probing = np.zeros((2, len(limits), count))
    steps, declared = np.zeros((2, len(limits), count), dtype=np.int64)
    alive = np.ones((len(limits), count), dtype=bool)
    for step in range(envs.options.n_steps):
        statistic, declaration = policy.judge(observations)
        says = alive & (statistic >= limits)
        if says.any():
            verdict = _verdict(envs, declaration, step, right, onset)
            returns = np.where(says, waited + verdict, returns)
            declared = np.where(says, envs.setup.declarations[declaration], declared)
            steps[says] = step
            probing = np.where(says, probed / (step + 1), probing)
            alive &= ~says
            if not alive.any():
                break
        actions = policy.probe()
        observations, rewards, _, _, _ = envs.step(actions)
        waited += rewards
        probed += envs.setup.offsets_v[actions] != 0.0
    returns = np.where(alive, waited, returns)
    probing = np.where(alive, probed / envs.options.n_steps, probing)
    return [
        Runs(r, s, d, right, onset, p) for r, s, d, p in zip(returns, steps, declared, probing, strict=True)
    ]


def _verdict(
    envs: MotorVectorEnv, actions: Actions, step: int, right: NDArray[np.int64], onset: NDArray[np.int64]
) -> FloatArray:
    """Return the reward of declaring now, verdict and delay, see `motor_env.envs.kernel.settle`."""
    options = envs.options
    acting = np.where(onset >= 0, step * options.samples_per_step - onset, 0)
    happened = acting > 0
    correct = envs.setup.declarations[actions] == right
    worth: FloatArray = np.where(
        happened,
        np.where(correct, options.correct_reward, -options.wrong_kind_cost),
        -options.false_alarm_cost,
    )
    return worth - options.delay_cost_per_s * options.dt_s * np.maximum(acting, 0)


def joined(runs: Sequence[Runs]) -> Runs:
    """Concatenate episodes of several seeds."""
    return Runs._make(np.concatenate(parts) for parts in zip(*runs, strict=True))


def interval(values: FloatArray) -> tuple[float, float]:
    """Return mean of independent values, and half the width of its 95 % interval."""
    return float(values.mean()), float(1.96 * values.std(ddof=1) / np.sqrt(len(values)))


def score(envs: MotorVectorEnv, runs: Runs) -> Score:
    """Compute mean return, false alarms, detections and delays of a policy's episodes."""
    instance("envs", envs, VectorEnv)
    instance("runs", runs, Runs)
    options = envs.options
    onset, said = runs.onset, runs.declared > 0
    at = runs.steps * options.samples_per_step
    happens = (onset >= 0) & (onset < options.n_samples)
    false = said & ~((onset >= 0) & (at > onset))
    detected = said & ~false
    could = happens & ~false
    delay = (at - onset)[detected] * options.dt_s
    mean, half_width = interval(runs.returns)
    return Score(
        episodes=len(onset),
        mean_return=mean,
        return_half_width=half_width,
        false_alarm_share=float(false.mean()),
        detected_share=float(detected.sum() / max(1, could.sum())),
        isolated_share=float((runs.declared == runs.right)[detected].mean())
        if detected.any()
        else float("nan"),
        median_delay_s=float(np.median(delay)) if detected.any() else float("nan"),
        late_share=float((happens & (onset > 0.99 * options.n_samples)).sum() / max(1, happens.sum())),
        probing_share=float(runs.probing.mean()),
    )
