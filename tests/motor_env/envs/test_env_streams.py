"""What every registered environment gives must never move: options, spaces, draws and episodes, kept in a file.

So is what the textbook policies say in some of them: their scores stand in tables, their thresholds were tuned to them.
`PYTHONPATH=benchmarks python tests/motor_env/envs/test_env_streams.py` wrote the file, from the environments as they
were when the tables in docs/environments.md and docs/drive-and-maintain.md were made; it writes it anew after a change
that is wanted.
"""

import hashlib
import json
import math
import platform
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from best_policies import RatioTest
from bounds import maintenance_bound

import motor_env  # noqa: F401  # registers the environments
from motor_env import Channel, Cusum, SensorParameters, load_recipe
from motor_env.envs import (
    BankPolicy,
    BayesPolicy,
    DriveVectorEnv,
    EventTriggeredProbing,
    ExpectedRewardTest,
    Lqg,
    MaintainOptions,
    MonitorVectorEnv,
    PlannedUpkeep,
    ProbeVectorEnv,
    RulePolicy,
    baseline_features,
    parts_of,
)
from motor_env.envs.policies.posterior_policies import Bursts, OpenLoop

KEPT = Path(__file__).with_name("env_streams.json")
WRITTEN_BY = "PYTHONPATH=benchmarks python tests/motor_env/envs/test_env_streams.py"
IDS = tuple(name for name in gym.registry if name.startswith("motor_env/"))
BOTH = replace(load_recipe("bench"), sensor=SensorParameters((Channel.CURRENT, Channel.SPEED), 0.02, 0.5))
VOLTAGES: dict[str, Any] = {"control": "voltage_and_decision", "tracking_limit_per_s": 0.0}
VARIANTS: dict[str, tuple[str, dict[str, Any]]] = {
    "two sensors, from standstill": (
        "motor_env/MonitorInstant-v0",
        {"recipe": BOTH, "start": "standstill", "horizon_s": 0.06, "samples_per_step": 3},
    ),
    "slow growth": (
        "motor_env/MonitorInstant-v0",
        {"recipe": "hard", "growth_s": 0.02, "growth_levels": 5, "mean_onset_s": 0.01, "horizon_s": 0.06},
    ),
    "speed loop, confirmed, other prices": (
        "motor_env/ProbeInstant-v0",
        {
            "recipe": "hard",  # a supply that is not the nominal one: energy counts it
            "drive": "speed_loop",
            "loop_time_s": 0.003,
            "confirm_steps": 2,
            "energy_cost_per_j": 0.7,
        },
    ),
    "fast failures": (
        "motor_env/DriveControl-v0",
        {**VOLTAGES, "growth_per_s": (2.0, 3.0), "mean_onset_s": 0.3, "horizon_s": 5.0, "load_time_s": 0.3},
    ),
    "a winding that burns": (
        "motor_env/DriveControl-v0",
        {**VOLTAGES, "weights": (0.0, 0.0, 1.0), "thermal_time_s": 0.4, "warm_k": 20.0, "burn_k": 45.0},
    ),
    "fast wear": ("motor_env/MaintainUnknownRate-v0", {"drift_per_day": 0.04, "days": 60}),
}
NAMES = (*IDS, *VARIANTS)
LANES, SEEDS = 16, 400


def made(name: str) -> Any:
    """The environment of an id or of a variant."""
    identity, options = VARIANTS.get(name, (name, {}))
    return gym.make(identity, disable_env_checker=True, **options).unwrapped


def plain(value: Any) -> Any:
    """Options as JSON has them; a recipe or a motor with all that it holds."""
    if is_dataclass(value) and not isinstance(value, type):
        named = {field.name: plain(getattr(value, field.name)) for field in fields(value)}
        return {
            name: one for name, one in named.items() if name != "recovery" or one
        }  # as in a recipe's file
    if isinstance(value, str | bool | None):
        return None if value is None else value if isinstance(value, bool) else str(value)
    if isinstance(value, tuple | list):
        return [plain(one) for one in value]
    number = np.asarray(value)
    return str(value) if number.dtype == object else number.tolist()


def specification(name: str) -> dict[str, Any]:
    """Options, spaces, and what the first two episodes of some sub-environments are drawn to be."""
    identity, options = VARIANTS.get(name, (name, {}))
    env, envs = made(name), gym.make_vec(identity, num_envs=LANES, **options)
    limits = env.observation_space
    draws = [envs.reset(seed=11)[1], envs.reset()[1]]
    return {
        "options": plain(env.options),
        "observed": list(env.observed),
        "limits": [limits.low.tolist(), limits.high.tolist()],
        "actions": repr(env.action_space),
        "draws": [{key: value.tolist() for key, value in info.items() if key[0] != "_"} for info in draws],
    }


def acted(env: Any, step: int) -> Any:
    """What is done in the middle of an episode: something of everything, up to where it would mean another."""
    if "Maintain" in type(env).__name__:
        return 1 if step % 17 == 5 else 2 if step % 40 == 39 else 0
    if "Drive" in type(env).__name__:
        share, limps = 0.6 + 0.45 * math.sin(0.05 * step), step % 200 > 150
        if env.options.control == "decision":
            return int(step % 20 > 15)
        return np.array([share, 0.5 if limps else 0.0, 0.5][: env.action_space.shape[0]])
    if isinstance(env.action_space, gym.spaces.Box):
        return np.array([1.1 * math.sin(0.37 * step), *[0.5] * (env.action_space.shape[0] - 1)])
    offsets = env.action_space.n - len(env.setup.kinds)
    return (0, 1, 0, 2, 2)[step % 5] % offsets


def said(env: Any, kind: int) -> Any:
    """The action that declares the kind of that number, or stops the motor."""
    if "Drive" in type(env).__name__:
        return 2 if env.options.control == "decision" else np.eye(env.action_space.shape[0])[-1] * 0.502
    if isinstance(env.action_space, gym.spaces.Box):
        return np.eye(env.action_space.shape[0])[1 + kind] * 0.502
    return env.action_space.n - len(env.setup.kinds) + kind


def plans(name: str) -> Iterator[dict[str, int]]:
    """Episodes worth keeping: every class once, ended by every kind of end.

    `wait` steps pass before the kind `say` is declared (again and again); -1: never.
    """
    env = made(name)
    seen: set[int] = set()
    for seed in range(SEEDS):
        info = env.reset(seed=seed, options={"index": seed % 3})[1]
        which = info.get("class_index", seed % 2)
        if which in seen:
            continue
        if "Maintain" in name or "wear" in name:
            yield {"seed": seed, "wait": -1, "say": 0}
        elif "onset_step" in info:
            middle = 333 // env.options.steps_per_decision
            yield {"seed": seed, "wait": -1 if which else middle, "say": 0}
            if not which:
                yield {"seed": seed, "wait": -1, "say": 0}
        elif which == 0:
            yield {"seed": seed, "wait": -1, "say": 0}
            yield {"seed": seed, "wait": 3, "say": 0}
        else:
            begun = info["onset_sample"] // env.options.samples_per_step + 1
            if begun > env.options.n_steps // 2:
                continue
            if which == 1:
                yield {"seed": seed, "wait": -1, "say": 0}
            if which <= 2:
                yield {"seed": seed, "wait": begun - 1, "say": 0}
            yield {"seed": seed, "wait": begun + 4 + which, "say": which % len(env.setup.kinds)}
        seen.add(which)


def episode(name: str, seed: int, wait: int, say: int) -> dict[str, Any]:
    """What happens in an episode: its length, rows at some of its steps, and sums over all."""
    env = made(name)
    observation, info = env.reset(seed=seed, options={"index": seed % 3})
    rows, over = [(observation, 0.0, info)], False
    while not over:
        step = len(rows) - 1
        observation, reward, over, _, info = env.step(
            said(env, say) if 0 <= wait <= step else acted(env, step)
        )
        rows.append((observation, reward, info))
    count = len(rows) - 1
    onset = max(info.get("onset_sample", info.get("onset_step", 0)), 0)
    begun = min(onset // getattr(env.options, "samples_per_step", 1), count)
    shown = sorted({0, min(begun + 1, count), count})
    observations = np.array([row[0] for row in rows], dtype=np.float64)
    parts = [key for key in info if key.startswith("reward_")]
    return {
        "steps": count,
        "label": info.get("label", ""),
        "active": sum(bool(row[2].get("fault_active", row[2].get("failed"))) for row in rows),
        "return": math.fsum(row[1] for row in rows),
        "parts": {key: math.fsum(row[2][key] for row in rows[1:]) for key in parts},
        "rms": np.sqrt(np.square(observations).mean(axis=0)).tolist(),
        "rows": {
            str(k): [*rows[k][0].astype(float).tolist(), rows[k][1], *_numbers(rows[k][2])] for k in shown
        },
    }


def _numbers(info: dict[str, Any]) -> list[float]:
    return [float(value) for value in info.values() if not isinstance(value, str)]


def judged(envs: Any, policy: Any) -> dict[str, Any]:
    """Statistics, actions and posterior of a policy at some steps of episodes that nobody ends."""
    observations, _ = envs.reset(seed=3)
    policy.start(envs.num_envs)
    steps, told = envs.options.n_steps, {}
    for step in range(steps - 1):
        statistic, declaration = policy.judge(observations)
        action = policy.probe()
        if step in (1, steps // 3, steps // 2, steps - 2):
            told[str(step)] = [np.maximum(statistic, -1e9).tolist(), declaration.tolist(), action.tolist()]
            knows = getattr(getattr(policy, "test", policy), "belief", policy)
            if hasattr(knows, "quiet"):
                told[str(step)] += [knows.quiet.tolist(), knows.classes.tolist()]
            if hasattr(knows, "summary"):
                told[str(step)] += [knows.summary().astype(float).tolist(), knows.coming.tolist()]
                told[str(step)] += [
                    knows.expected_reward(np.full(envs.num_envs, one)).tolist()
                    for one in range(envs.single_action_space.n)
                ]
        observations = envs.step(action)[0]
    return told


def monitored(recipe: str) -> Any:
    return MonitorVectorEnv(
        4,
        recipe=recipe,
        horizon_s=0.05,
        observe=baseline_features(recipe),
        **gym.spec("motor_env/MonitorInstant-v0").kwargs,
    )


def driven(policy: Any) -> list[list[float]]:
    """The parts of the returns of a few short drives, in thousandths: a tolerance is small beside them."""
    short: dict[str, Any] = {"horizon_s": 2.0, "earliest_onset_s": 0.1, "mean_onset_s": 0.1}
    envs = DriveVectorEnv(6, **VOLTAGES, **short, steps_per_decision=1, growth_per_s=(1.0, 2.0), warm_k=15.0)
    parts = parts_of(envs, policy(envs), 4)
    return [(1e3 * part).tolist() for part in parts]


def upkeep() -> list[Any]:
    """What the plan thinks every action is worth, at some places of its grid, and the bound."""
    options = MaintainOptions(days=4, drift_per_day=0.05, rate_spread=0.5)
    values = PlannedUpkeep(options)._values[:, :, ::2, ::37]
    return [values.tolist(), maintenance_bound(options)]


POLICIES: dict[str, Callable[[], Any]] = {
    "bayes": lambda: judged(envs := monitored("medium"), BayesPolicy(envs.setup, 0.0)),
    "bank": lambda: judged(envs := monitored("hard"), BankPolicy(envs.setup, 0.0)),
    "cusum": lambda: judged(
        envs := monitored("hard"), RulePolicy(envs.setup, Cusum(0.5, two_sided=True), threshold=0.0)
    ),
    "bursts": lambda: judged(
        envs := ProbeVectorEnv(4, horizon_s=0.1, **gym.spec("motor_env/ProbeInstant-v0").kwargs),
        OpenLoop(RatioTest(envs.setup, 0.0), Bursts(5, 8, 3).actions(50)),
    ),
    "on demand": lambda: judged(
        envs := ProbeVectorEnv(4, horizon_s=0.1, **gym.spec("motor_env/ProbeInstant-v0").kwargs),
        EventTriggeredProbing(ExpectedRewardTest(envs.setup, 0.0), 0.05),
    ),
    "lqg": lambda: driven(lambda envs: Lqg(envs.setup)),
    "reconfigured": lambda: driven(lambda envs: Lqg(envs.setup, levels=3)),
    "upkeep": upkeep,
}


def same(found: Any, kept: Any, where: str, within: Any) -> None:
    """Equal: numbers up to a tolerance, one for all or one for each number of a list; all else exactly."""
    if isinstance(kept, dict):
        assert found.keys() == kept.keys(), where
        for key in kept:
            same(found[key], kept[key], f"{where}, {key}", within)
    elif isinstance(kept, list) and kept and isinstance(kept[0], float):
        off = np.abs(np.subtract(found, kept))
        assert (off <= within + np.min(within) * np.abs(kept)).all(), f"{where}: {found} is not {kept}"
    elif isinstance(kept, list):
        assert len(found) == len(kept), where
        for number, (one, other) in enumerate(zip(found, kept, strict=True)):
            same(one, other, f"{where}[{number}]", within)
    elif isinstance(kept, float):
        assert found == pytest.approx(kept, rel=np.min(within), abs=np.min(within)), where
    else:
        assert found == kept, where


def rounded(value: Any, digits: int) -> Any:
    """With more digits than are compared."""
    if isinstance(value, dict):
        return {key: rounded(one, digits) for key, one in value.items()}
    if isinstance(value, list):
        return [rounded(one, digits) for one in value]
    return float(f"{value:.{digits}g}") if isinstance(value, float) else value


def digest(name: str) -> str:
    """Of all that a vector gives in 1,000 steps and more, under all actions: the bits that make a version.

    Most actions are the first one, so that episodes last to see their faults and reach their horizon.
    """
    envs: Any = gym.make_vec(name, num_envs=LANES)
    space, rng, found = envs.single_action_space, np.random.default_rng(5), hashlib.sha256()
    lasts = getattr(envs.unwrapped.options, "n_steps", 120)
    found.update(envs.reset(seed=13)[0].tobytes())
    for _ in range(max(1000, lasts + 200)):
        seldom = rng.random(LANES) < 4.0 / lasts
        if isinstance(space, gym.spaces.Discrete):
            actions: Any = np.where(seldom, rng.integers(0, space.n, LANES), 0)
        else:
            bold = rng.uniform(space.low, space.high, (LANES, *space.shape)).astype(np.float32)
            actions = np.where(seldom[:, None], bold, np.float32(0.4) * np.abs(bold) * (bold > 0.0))
        observation, reward, terminated, _, _ = envs.step(actions)
        for each in (observation, np.asarray(reward, dtype=np.float64), terminated):
            found.update(np.ascontiguousarray(each).tobytes())
    return found.hexdigest()


TABLE: dict[str, Any] = json.loads(KEPT.read_text(encoding="utf-8")) if KEPT.exists() else {}


def kept(name: str) -> dict[str, Any]:
    assert name in TABLE, f"{name} has no rows in {KEPT.name}: `{WRITTEN_BY}` writes them"
    return dict(TABLE[name])


def test_every_registered_id_is_kept() -> None:
    assert TABLE.keys() == {*NAMES, "policies"}, f"`{WRITTEN_BY}` writes {KEPT.name}"


@pytest.mark.parametrize("name", NAMES)
def test_options_spaces_and_draws_are_those_that_were_kept(name: str) -> None:
    same(specification(name), kept(name)["specification"], name, 1e-8)


@pytest.mark.parametrize("name", NAMES)
def test_episodes_are_those_that_were_kept(name: str) -> None:
    """Single environments; other tests hold that a vector gives the same to the bit."""
    # In float32 another processor may round otherwise, and evidence starts anew at zero: docs/environments.md.
    scale = np.array([4e-3 if "evidence" in each else 1e-5 for each in made(name).observed])
    for one in kept(name)["episodes"]:
        where, plan, wanted = f"{name}, {one['plan']}", one["plan"], dict(one["found"])
        found = episode(name, **plan)
        same(found.pop("rms"), wanted.pop("rms"), f"{where}, rms", scale)
        rows, wanted_rows = found.pop("rows"), wanted.pop("rows")
        assert rows.keys() == wanted_rows.keys(), where
        for step, row in wanted_rows.items():
            within = np.pad(scale, (0, len(row) - len(scale)), constant_values=1e-5)
            same(rows[step], row, f"{where}, step {step}", within)
        same(found, wanted, where, 1e-5)


@pytest.mark.skipif(
    platform.machine() != "x86_64", reason="other processors round otherwise: the rows above count"
)
@pytest.mark.parametrize("name", IDS)
def test_a_version_is_the_same_to_the_bit(name: str) -> None:
    """What changes this needs a new version of the id: see docs/environments.md."""
    assert digest(name) == kept(name)["digest"]


@pytest.mark.parametrize("name", POLICIES)
def test_policies_say_what_was_kept(name: str) -> None:
    # Observations are in single precision; a sum of evidence that starts anew may do so elsewhere by rounding.
    same(POLICIES[name](), TABLE["policies"][name], name, 4e-2 if name == "bank" else 1e-4)


if __name__ == "__main__":
    table = {
        name: {
            "specification": rounded(specification(name), 12),
            "episodes": [{"plan": plan, "found": rounded(episode(name, **plan), 7)} for plan in plans(name)],
        }
        for name in NAMES
    }
    for name in IDS:
        table[name]["digest"] = digest(name)
    table["policies"] = rounded({name: policy() for name, policy in POLICIES.items()}, 7)
    lines = [f"{json.dumps(name)}:{json.dumps(each, separators=(',', ':'))}" for name, each in table.items()]
    KEPT.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
