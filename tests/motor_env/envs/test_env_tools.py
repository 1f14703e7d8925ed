"""Everyone's tools accept the environments: wrappers, Stable-Baselines3, TorchRL, a video writer, a window."""

import inspect
import re
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import RecordVideo
from gymnasium.wrappers.vector import RecordEpisodeStatistics as RecordVectorStatistics

import motor_env  # noqa: F401  # registers the environments
from motor_env import PAPER_MOTOR, load_recipe
from motor_env.envs import (
    MaintainOptions,
    MonitorOptions,
    MonitorVectorEnv,
    ProbeOptions,
    ProbeVectorEnv,
)

KINDS = ("MonitorInstant", "ProbeInstant", "ProbeContinuous", "Maintain", "Drive", "DriveControl")
IDS = tuple(f"motor_env/{name}-v0" for name in KINDS)
SHORT: dict[str, Any] = {"horizon_s": 0.02, "earliest_onset_s": 0.001, "mean_onset_s": 0.005}


def short(name: str) -> dict[str, Any]:
    """Options of a short episode; a task whose episodes are short anyway has none."""
    return SHORT if "Monitor" in name or "Probe" in name else {}


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_episode_statistics_of_a_vector(mode: str) -> None:
    envs = RecordVectorStatistics(gym.make_vec(IDS[0], num_envs=3, autoreset_mode=mode, **SHORT))
    envs.reset(seed=0)
    lengths: list[int] = []
    for _ in range(450):
        _, _, terminated, _, info = envs.step(np.zeros(3, dtype=np.int64))
        if terminated.any():
            told = info["final_info"] if "final_info" in info and "episode" in info["final_info"] else info
            lengths += told["episode"]["l"][terminated].tolist()
    if mode == "SameStep" and gym.__version__.startswith("1.2."):
        # Its wrapper loses a step of every later episode, of any environment.
        assert lengths == [200] * 3 + [199] * 3
    else:
        assert lengths == [200] * 6


def test_a_video_is_written(tmp_path: Path) -> None:
    pytest.importorskip("moviepy", reason="RecordVideo writes with moviepy")
    env = RecordVideo(
        gym.make(IDS[1], render_mode="rgb_array", **SHORT),
        str(tmp_path / "video"),
        lambda episode: episode == 0,
    )
    with warnings.catch_warnings():
        warnings.simplefilter(
            "ignore", ResourceWarning
        )  # moviepy leaves the pipe to its writer to the collector
        env.reset(seed=0)
        over = False
        while not over:
            over = bool(env.step(1)[2])
        env.close()  # type: ignore[no-untyped-call]  # gymnasium's
    written = next((tmp_path / "video").glob("*.mp4")).read_bytes()
    assert written[4:8] == b"ftyp"  # ISO base media file
    assert len(written) > 5000


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


@pytest.mark.parametrize("name", IDS)
def test_stable_baselines_checker_is_content(name: str) -> None:
    checker = pytest.importorskip("stable_baselines3.common.env_checker", reason="extra rl")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        checker.check_env(gym.make(name, **short(name)).unwrapped)


@pytest.mark.parametrize("name", ["ProbeInstant", "Drive", "Maintain"])
def test_ppo_learns_through_the_adapter(name: str) -> None:
    stable = pytest.importorskip("stable_baselines3", reason="extra rl")
    from motor_env.envs import StableBaselinesVecEnv

    made = gym.make_vec(f"motor_env/{name}-v0", num_envs=8, autoreset_mode="SameStep", **short(name))
    envs = StableBaselinesVecEnv(made.unwrapped)
    model = stable.PPO("MlpPolicy", envs, n_steps=64, batch_size=128, n_epochs=2, seed=0, device="cpu")
    before = [parameter.detach().clone() for parameter in model.policy.parameters()]
    model.learn(2 * 64 * 8)
    assert model.num_timesteps == 2 * 64 * 8
    assert any(
        not bool((old == new).all()) for old, new in zip(before, model.policy.parameters(), strict=True)
    )
    assert all(bool(parameter.isfinite().all()) for parameter in model.policy.parameters())
    assert len(model.ep_info_buffer) >= 8


def test_the_adapter_tells_how_each_episode_ended_and_forgets_it_at_a_reset() -> None:
    pytest.importorskip("stable_baselines3", reason="extra rl")
    from motor_env.envs import StableBaselinesVecEnv

    blocks: dict[str, Any] = {"samples_per_step": 5, "confirm_steps": 1}
    envs = StableBaselinesVecEnv(ProbeVectorEnv(2, autoreset_mode="SameStep", **blocks, **SHORT))
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
        vector: Any = envs.envs
        assert [one["label"] for one in infos] == [vector.setup.labels[one["class_index"]] for one in infos]
        assert [one["episode"]["r"] for one in infos] == pytest.approx((paid + last).tolist())
        envs.step(np.full(2, 1))  # of an episode that the next reset breaks off


@pytest.mark.parametrize("name", IDS)
def test_torchrl_accepts_single_and_vector(name: str) -> None:
    envs = pytest.importorskip("torchrl.envs", reason="TorchRL is not installed")
    utils = pytest.importorskip("torchrl.envs.utils", reason="TorchRL is not installed")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # TorchRL's own, about its future versions
        utils.check_env_specs(envs.GymWrapper(gym.make(name, **short(name))))
        utils.check_env_specs(
            envs.GymWrapper(gym.make_vec(name, num_envs=2, autoreset_mode="SameStep", **short(name)))
        )


def test_a_vector_refuses_what_it_cannot_show() -> None:
    with pytest.raises(ValueError, match=r"render_mode of a vector must be None, got 'rgb_array'"):
        MonitorVectorEnv(2, render_mode="rgb_array")


def test_a_picture_shows_the_evidence_and_changes_nothing() -> None:
    shown, plain = (gym.make(IDS[0], render_mode=mode, recipe="easy") for mode in ("rgb_array", None))
    seed = next(k for k in range(20) if plain.reset(seed=k)[1]["onset_sample"] in range(1000))
    shown.reset(seed=seed)
    plain.reset(seed=seed)
    seen = [plain.unwrapped.reset(seed=seed)[0]]
    for _ in range(1100):
        seen.append(plain.step(0)[0])
        assert np.array_equal(shown.step(0)[0], seen[-1])
    scope = shown.unwrapped._screen  # type: ignore[attr-defined]
    assert np.nanmax(scope._columns[5:7]) > 12.0
    # a column shows the step that begins it: measured and estimated current, estimated speed, voltage, innovation
    volts = 12.0
    units = [volts / 2.18, volts / 2.18, volts / float(PAPER_MOTOR.back_emf_constant_v_s_per_rad), volts, 1.0]
    names = ("measured_current", "estimated_current", "estimated_speed", "voltage", "innovation_current")
    places = [plain.unwrapped.observed.index(name) for name in names]  # type: ignore[attr-defined]
    for column in range(scope._filled):
        wanted = np.array(seen[column * 2000 // 528])[places] * units
        found = np.clip(scope._columns[:5, column], [-np.inf] * 4 + [-10.0], np.inf)  # as it is observed
        np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=1e-4)
    assert scope.onset_step == plain.unwrapped._truth["onset_sample"]  # type: ignore[attr-defined]


def test_the_screen_says_how_an_episode_ended() -> None:
    short: dict[str, Any] = {"earliest_onset_s": 0.0, "mean_onset_s": 1e-4, "horizon_s": 0.04}
    env: Any = gym.make("motor_env/ProbeInstant-v0", render_mode="rgb_array", **short).unwrapped
    seeds = {env.reset(seed=seed)[1]["label"]: seed for seed in range(40)}
    for label, wait, action, verdict in (
        ("healthy", 19, 0, ("rightly silent", True)),
        ("bearing", 19, 0, ("fault missed", False)),
        ("bearing", 0, 3, ("bearing: false alarm", False)),
        ("bearing", 3, 3, ("bearing: right", True)),
        ("bearing", 3, 4, ("winding: wrong kind", False)),
        ("healthy", 3, 4, ("winding: false alarm", False)),
    ):
        env.reset(seed=seeds[label])
        for _ in range(wait):
            env.step(1)
        assert env.step(action)[2]
        assert (env._screen.verdict, env._screen.good) == verdict
    env.reset(seed=seeds["bearing"])
    seen, *_ = env.step(1)
    innovation = seen[env.observed.index("innovation_current")]  # a mean over the root of 20 samples
    assert env._screen._columns[4, env._screen._filled - 1] == pytest.approx(innovation, rel=1e-5)
    assert env._screen._columns[3, env._screen._filled - 1] == pytest.approx(11.0)


ALL_IDS = tuple(name for name in gym.registry if name.startswith("motor_env/"))


@pytest.mark.parametrize("name", ALL_IDS)
def test_torchrl_makes_every_id_by_itself(name: str) -> None:
    """It tries a keyword of its own first, and does without after a TypeError."""
    envs = pytest.importorskip("torchrl.envs", reason="TorchRL is not installed")
    env = envs.GymEnv(name)
    env.set_seed(3)
    steps, *shape = env.rollout(3)["observation"].shape  # random actions may end the episode sooner
    assert 1 <= steps <= 3
    assert tuple(shape) == gym.make(name).observation_space.shape


def test_torchrl_runs_several_in_one_process() -> None:
    envs = pytest.importorskip("torchrl.envs", reason="TorchRL is not installed")
    both = envs.SerialEnv(2, lambda: envs.GymEnv(ALL_IDS[0]))
    assert tuple(both.rollout(1)["observation"].shape[:2]) == (2, 1)
    both.close()


@pytest.mark.long
def test_torchrl_runs_several_in_processes_of_their_own() -> None:
    envs = pytest.importorskip("torchrl.envs", reason="TorchRL is not installed")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch's own, about how it begins processes
        both = envs.ParallelEnv(2, envs.EnvCreator(lambda: envs.GymEnv(f"motor_env:{ALL_IDS[0]}")))
        assert tuple(both.rollout(3)["observation"].shape[:2]) == (2, 3)
        both.close()


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


def test_a_spec_with_a_path_is_refused_when_it_is_written() -> None:
    env = gym.make(IDS[0], motor=Path("examples/motor.toml"))
    assert env.spec is not None
    with pytest.raises(TypeError, match="Path is not JSON serializable"):
        env.spec.to_json()


def test_a_dictionary_that_describes_no_recipe_is_refused_in_one_sentence() -> None:
    for recipe, sentence in (
        ({}, "recipe must be a name, a TOML file or a Recipe, got a value of type dict"),
        ({"name": 3}, "name must be"),
        ({"nam": "x"}, "unknown key 'nam'"),
    ):
        with pytest.raises(ValueError, match=sentence):
            gym.make(IDS[0], recipe=recipe)
    with pytest.raises(ValueError, match="resistance_ohm is missing"):
        gym.make("motor_env/Drive-v0", motor={"resistance": 3.0})


def test_an_evaluation_through_the_adapter_reports_true_rewards_and_cut_episodes() -> None:
    """Under VecNormalize, which changes the rewards, an evaluation reads those of Monitor."""
    stable = pytest.importorskip("stable_baselines3", reason="extra rl")
    from stable_baselines3.common.evaluation import evaluate_policy
    from stable_baselines3.common.monitor import Monitor
    from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

    from motor_env.envs import StableBaselinesVecEnv

    def vector() -> Any:
        short: dict[str, Any] = {
            "max_episode_steps": 30,
            "samples_per_step": 5,
            "confirm_steps": 1,
            "horizon_s": 0.02,
        }
        made = ProbeVectorEnv(4, autoreset_mode="SameStep", **short)
        return StableBaselinesVecEnv(made)

    assert vector().env_is_wrapped(Monitor) == [True] * 4
    assert vector().env_is_wrapped(VecMonitor, indices=[0, 2]) == [False] * 2
    model = stable.PPO("MlpPolicy", vector(), n_steps=8, batch_size=32, seed=0, device="cpu")
    normal: Any = VecNormalize(vector(), training=False, norm_obs=False)
    normal.ret_rms.var = np.array(100.0)  # its rewards are a tenth of the true ones
    found = []
    for envs in (normal, vector()):
        envs.seed(5)
        found.append(evaluate_policy(model, envs, n_eval_episodes=8, return_episode_rewards=True))
    assert found[0] == found[1]
    assert min(found[0][0]) < -0.1
    assert max(found[0][1]) <= 30
    envs = vector()
    envs.seed(2)
    envs.reset()
    seen = [envs.step(np.zeros(4, dtype=np.int64)) for _ in range(30)][-1]
    assert seen[2].all()
    assert [info["TimeLimit.truncated"] for info in seen[3]] == [True] * 4


def test_the_adapter_refuses_options_of_a_reset() -> None:
    pytest.importorskip("stable_baselines3", reason="extra rl")
    from motor_env.envs import StableBaselinesVecEnv

    envs = StableBaselinesVecEnv(ProbeVectorEnv(2, autoreset_mode="SameStep"))
    nothings: tuple[Any, ...] = (None, {}, [{}, {}])
    for nothing in nothings:
        envs.set_options(nothing)
    for options in ({"index": 3}, [{}, {"index": 3}]):
        with pytest.raises(NotImplementedError, match="has no options of a reset, got"):
            envs.set_options(options)


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
