"""What every registered environment gives must never move by a bit, nor what textbook policies gain in some of them.

The policies' scores stand in tables, and their thresholds were tuned to them. `WRITTEN_BY` writes the file after a
change that is wanted. That what does not move is right hold the reference step and the tests of each family.
"""

import hashlib
import json
import platform
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import reference_scores
from best_policies import RatioTest
from reference_policies import REFERENCES

import motor_env  # noqa: F401  # registers the environments
from motor_env import Cusum
from motor_env.envs import (
    BankPolicy,
    BayesPolicy,
    DriveVectorEnv,
    EventTriggeredProbing,
    ExpectedRewardTest,
    Lqg,
    MaintainVectorEnv,
    MonitorVectorEnv,
    PlannedUpkeep,
    ProbeVectorEnv,
    RulePolicy,
    baseline_features,
    parts_of,
)
from motor_env.envs.policies.posterior_policies import Bursts, OpenLoop

WRITTEN_BY = "PYTHONPATH=benchmarks python tests/motor_env/envs/test_env_streams.py"
KEPT = Path(__file__).with_name("env_streams.json")
TABLE: dict[str, Any] = json.loads(KEPT.read_text(encoding="utf-8"))
IDS = tuple(name for name in gym.registry if name.startswith("motor_env/"))
LANES = 16


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


OF_MONITORS, OF_PROBES = (gym.spec(f"motor_env/{name}Instant-v0").kwargs for name in ("Monitor", "Probe"))
DRIVEN = {"control": "voltage_and_decision", "horizon_s": 2.0, "growth_per_s": (1.0, 2.0), "warm_k": 15.0}


def monitored(recipe: str) -> Any:
    options = {"recipe": recipe, "horizon_s": 0.05, "observe": baseline_features(recipe), **OF_MONITORS}
    return MonitorVectorEnv(30, **options)


def probed() -> Any:
    return ProbeVectorEnv(30, horizon_s=0.1, **OF_PROBES)


def driven() -> Any:
    options: Any = DRIVEN | {"earliest_onset_s": 0.1, "mean_onset_s": 0.1, "steps_per_decision": 1}
    return DriveVectorEnv(6, **options)


POLICIES: dict[str, Callable[[], tuple[Any, Any]]] = {
    "bayes": lambda: (envs := monitored("medium"), BayesPolicy(envs.setup, 0.8)),
    "bank": lambda: (envs := monitored("hard"), BankPolicy(envs.setup, 3.0)),
    "cusum": lambda: (
        envs := monitored("hard"),
        RulePolicy(envs.setup, Cusum(0.5, two_sided=True), threshold=8.0),
    ),
    "bursts": lambda: (envs := probed(), OpenLoop(RatioTest(envs.setup, 4.0), Bursts(5, 8, 3).actions(50))),
    "on demand": lambda: (envs := probed(), EventTriggeredProbing(ExpectedRewardTest(envs.setup, 0.8), 0.05)),
    "lqg": lambda: (envs := driven(), Lqg(envs.setup)),
    "reconfigured": lambda: (envs := driven(), Lqg(envs.setup, levels=3)),
    "upkeep": lambda: (envs := MaintainVectorEnv(30, rate_spread=0.5), PlannedUpkeep(envs.options)),
}


def test_every_registered_id_is_kept() -> None:
    assert TABLE.keys() == {*IDS, "policies"}, f"`{WRITTEN_BY}` writes {KEPT.name}"


@pytest.mark.skipif(platform.machine() != "x86_64", reason="other processors round otherwise")
@pytest.mark.parametrize("name", IDS)
def test_a_version_is_the_same_to_the_bit(name: str) -> None:
    """What changes this needs a new version of the id: see docs/citing.md."""
    assert digest(name) == TABLE.get(name, f"`{WRITTEN_BY}` writes it")


@pytest.mark.parametrize("name", POLICIES)
def test_policies_gain_what_was_kept(name: str) -> None:
    np.testing.assert_allclose(parts_of(*POLICIES[name](), 4), TABLE["policies"][name], rtol=1e-4, atol=1e-4)


NAMES = [name.removeprefix("motor_env/") for name in gym.registry if name.startswith("motor_env/")]


def test_every_id_has_policies_of_its_own() -> None:
    assert sorted(REFERENCES) == sorted(NAMES), (
        "benchmarks/reference_policies.py names the policies of each id"
    )


@pytest.mark.parametrize("name", NAMES)
def test_thresholds_are_the_best_policys_mean_less_its_error(name: str) -> None:
    found = reference_scores.kept(name)
    assert "best" in found, f"`python benchmarks/reference_scores.py --only {name}` measures it"
    best, threshold = found["best"], gym.spec(f"motor_env/{name}").reward_threshold
    assert threshold == reference_scores.threshold(best), "reward_threshold in motor_env/__init__.py"
    assert (
        best["return"] - best["standard_error"] - 0.001 < threshold <= best["return"] - best["standard_error"]
    )
    assert found["trivial"]["return"] < found["textbook"]["return"] < best["return"] + 0.02
    if "bound" in found:
        assert best["return"] < found["bound"]["return"] + 2.0 * best["standard_error"]


if __name__ == "__main__":
    table: dict[str, Any] = {name: digest(name) for name in IDS}
    table["policies"] = {name: np.round(parts_of(*made(), 4), 6).tolist() for name, made in POLICIES.items()}
    KEPT.write_text("{\n" + ",\n".join(f'"{key}": {json.dumps(one)}' for key, one in table.items()) + "\n}\n")
