"""Everyone's tools accept the environments: wrappers, Stable-Baselines3, TorchRL, a video writer, a window."""

import inspect
import re
import warnings
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

import motor_env  # noqa: F401  # registers the environments
from motor_env import PAPER_MOTOR, load_recipe
from motor_env.envs import (
    MaintainOptions,
    MonitorOptions,
    ProbeOptions,
    ProbeVectorEnv,
    StableBaselinesVecEnv,
)

KINDS = ("MonitorInstant", "ProbeInstant", "ProbeContinuous", "Maintain", "Drive", "DriveControl")
IDS = tuple(f"motor_env/{name}-v0" for name in KINDS)
SHORT: dict[str, Any] = {"horizon_s": 0.02, "earliest_onset_s": 0.001, "mean_onset_s": 0.005}


def short(name: str) -> dict[str, Any]:
    """Options of a short episode; a task whose episodes are short anyway has none."""
    return SHORT if "Monitor" in name or "Probe" in name else {}


def test_a_window_shows_the_screen_and_closes(monkeypatch: pytest.MonkeyPatch) -> None:
    pygame = pytest.importorskip("pygame", reason="the window is pygame's")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    env = gym.make(IDS[1], render_mode="human", horizon_s=0.01, samples_per_step=10)
    env.reset(seed=0)
    for _ in range(9):
        env.step(1)
    assert env.render() is None
    shown = pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1)
    screen = env.unwrapped._screen.draw()  # type: ignore[attr-defined]
    np.testing.assert_array_equal(shown, screen)
    env.close()
    assert not pygame.display.get_init()
    env.close()


def test_the_adapter_tells_how_each_episode_ended_and_forgets_it_at_a_reset() -> None:
    options: dict[str, Any] = SHORT | {"samples_per_step": 5, "confirm_steps": 1, "max_episode_steps": 7}
    envs = StableBaselinesVecEnv(ProbeVectorEnv(2, autoreset_mode="SameStep", **options))
    time = envs.envs.setup.observed.index("time")
    for waited in (4, 1):
        envs.seed(3)
        envs.reset()
        paid = sum(envs.step(np.full(2, action))[1] for action in [1] * waited)
        seen, last, over, infos = envs.step(np.full(2, 3))  # both declare
        assert over.all()
        assert (seen[:, time] == 0.0).all()  # of the next episode
        told = [one["terminal_observation"][time] for one in infos]
        assert told == pytest.approx([(waited + 1) / envs.envs.options.n_steps] * 2)
        assert [one["episode"]["l"] for one in infos] == [waited + 1] * 2
        assert not any(one["TimeLimit.truncated"] for one in infos)
        vector: Any = envs.envs
        assert [one["label"] for one in infos] == [vector.setup.labels[one["class_index"]] for one in infos]
        assert [one["episode"]["r"] for one in infos] == pytest.approx((paid + last).tolist())
        envs.step(np.full(2, 1))  # of an episode that the next reset breaks off
    *_, cut = (envs.step(np.full(2, 1))[3] for _ in range(6))
    assert all(one["TimeLimit.truncated"] for one in cut)


def test_a_picture_shows_what_is_seen_and_changes_nothing() -> None:
    """A column shows the step that begins it, in SI: currents, speed, voltage, innovation."""
    shown, plain = (
        gym.make(IDS[0], render_mode=mode, recipe="easy").unwrapped for mode in ("rgb_array", None)
    )
    shown.reset(seed=5)
    seen = [plain.reset(seed=5)[0]]
    for _ in range(1100):
        seen.append(plain.step(0)[0])
        assert np.array_equal(shown.step(0)[0], seen[-1])
    scope: Any = shown._screen  # type: ignore[attr-defined]
    ampere, rad_s = 12.0 / 2.18, 12.0 / 0.02352
    units = np.array([ampere, ampere, rad_s, 12.0, 1.0])
    names = ("measured_current", "estimated_current", "estimated_speed", "voltage", "innovation_current")
    places = [plain.observed.index(name) for name in names]  # type: ignore[attr-defined]
    wanted = np.array(seen)[np.arange(scope._filled) * 2000 // 528][:, places] * units
    found = np.clip(
        scope._columns[:5, : scope._filled].T, [-np.inf] * 4 + [-10.0], np.inf
    )  # as it is observed
    np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize(
    ("label", "wait", "action", "verdict"),
    [
        ("healthy", 19, 0, ("rightly silent", True)),
        ("bearing", 0, 3, ("bearing: false alarm", False)),
        ("bearing", 3, 3, ("bearing: right", True)),
        ("bearing", 3, 4, ("winding: wrong kind", False)),
    ],
)
def test_the_screen_says_how_an_episode_ended(
    label: str, wait: int, action: int, verdict: tuple[str, bool]
) -> None:
    options: dict[str, Any] = {"earliest_onset_s": 0.0, "mean_onset_s": 1e-4, "horizon_s": 0.04}
    env: Any = gym.make("motor_env/ProbeInstant-v0", render_mode="rgb_array", **options).unwrapped
    env.reset(seed=next(seed for seed in range(40) if env.reset(seed=seed)[1]["label"] == label))
    for _ in range(wait):
        env.step(1)
    assert env.step(action)[2]
    assert (env._screen.verdict, env._screen.good) == verdict


@pytest.mark.parametrize("name", IDS)
def test_checkers_of_stable_baselines_and_torchrl_are_content(name: str) -> None:
    """TorchRL tries a keyword of its own first, and does without after a TypeError; a vector it wraps."""
    check_env(gym.make(name, **short(name)).unwrapped)
    envs = pytest.importorskip("torchrl.envs", reason="TorchRL is not installed")
    utils = pytest.importorskip("torchrl.envs.utils", reason="TorchRL is not installed")
    vector = gym.make_vec(name, num_envs=2, autoreset_mode="SameStep", **short(name))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # TorchRL's own, about its future versions
        for env in (envs.GymEnv(name), envs.GymWrapper(vector)):
            utils.check_env_specs(env)


MOTOR = PAPER_MOTOR.scaled(resistance_ohm=1.1)


@pytest.mark.parametrize(
    ("name", "given"),
    [
        ("motor_env/Monitor-v0", {"recipe": replace(load_recipe("bench"), name="own"), "horizon_s": 0.02}),
        ("motor_env/Monitor-v0", {"motor": MOTOR}),
        ("motor_env/Monitor-v0", {"options": MonitorOptions(motor=MOTOR, observe=("time", "excess"))}),
        ("motor_env/Probe-v0", {"options": ProbeOptions(offsets_v=(0.0, 2.0)), "horizon_s": 0.2}),
        ("motor_env/Drive-v0", {"motor": MOTOR, "ramp_s": (0.25, 0.5)}),
        ("motor_env/Maintain-v0", {"options": MaintainOptions(days=7)}),
    ],
)
def test_a_spec_comes_back_from_json(name: str, given: dict[str, Any]) -> None:
    env = gym.make(name, **given)
    assert env.spec is not None
    back = gym.make(gym.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    assert back.unwrapped.options == env.unwrapped.options  # type: ignore[attr-defined]
    np.testing.assert_array_equal(back.reset(seed=1)[0], env.reset(seed=1)[0])
    envs = gym.make_vec(name, num_envs=2, **given)
    assert envs.spec is not None
    again = gym.make_vec(gym.envs.registration.EnvSpec.from_json(envs.spec.to_json()))
    np.testing.assert_array_equal(again.reset(seed=1)[0], envs.reset(seed=1)[0])


def test_an_evaluation_through_the_adapter_reports_true_rewards_and_cut_episodes() -> None:

    def vector() -> Any:
        options: dict[str, Any] = {"samples_per_step": 5, "confirm_steps": 1, "horizon_s": 0.02}
        return StableBaselinesVecEnv(
            ProbeVectorEnv(4, autoreset_mode="SameStep", max_episode_steps=30, **options)
        )

    assert vector().env_is_wrapped(Monitor) == [True] * 4
    assert vector().env_is_wrapped(VecMonitor, indices=[0, 2]) == [False] * 2
    model = PPO("MlpPolicy", vector(), n_steps=8, batch_size=32, seed=0, device="cpu")
    normal: Any = VecNormalize(vector(), training=False, norm_obs=False)
    normal.ret_rms.var = np.array(100.0)  # its rewards are a tenth of the true ones
    found = []
    for envs in (normal, vector()):
        envs.seed(5)
        found.append(evaluate_policy(model, envs, n_eval_episodes=8, return_episode_rewards=True))
    assert found[0] == found[1]
    assert min(found[0][0]) < -0.1
    assert max(found[0][1]) <= 30


HEADINGS = (
    *("Description", "Action Space", "Observation Space", "Rewards", "Starting State", "Episode End"),
    *("Information", "Arguments", "Vectorized environment", "Version History"),
)
"""As Gymnasium's own environments have them."""


@pytest.mark.parametrize("name", ["Monitor", "Probe", "ProbeContinuous", "Drive", "Maintain"])
def test_docstrings_have_gymnasiums_headings_and_the_numbers_of_the_spaces(name: str) -> None:
    env: Any = gym.make(f"motor_env/{name}-v0").unwrapped
    text, space = inspect.getdoc(type(env)) or "", env.observation_space
    assert tuple(re.findall(r"^## (.*)$", text, re.MULTILINE)) == HEADINGS
    part = dict(zip(HEADINGS, re.split(r"^## .*$", text, flags=re.MULTILINE)[1:], strict=True))
    seen = re.findall(
        r"^\| (\d+) \| `(\w+)` \| .* \| (\S+) \| (\S+) \|$", part["Observation Space"], re.MULTILINE
    )
    wanted = [
        (str(n), each, f"{space.low[n]:.4g}", f"{space.high[n]:.4g}") for n, each in enumerate(env.observed)
    ]
    assert seen == wanted
    actions = env.action_space.n if hasattr(env.action_space, "n") else env.action_space.shape[0]
    numbers = re.findall(r"^\| (\d+) \|", part["Action Space"], re.MULTILINE)
    assert numbers == [str(n) for n in range(actions)]
