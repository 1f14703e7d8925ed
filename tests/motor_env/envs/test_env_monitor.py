"""MonitorInstant-v0: the contract of gymnasium, and the same physics and filter as everywhere else."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

from motor_env import (
    PAPER_MOTOR,
    Channel,
    Fault,
    FaultKind,
    KalmanFilter,
    Recipe,
    SensorParameters,
    Timing,
    discretize,
    draw,
    load_recipe,
    run_filter,
    simulate_states,
)
from motor_env.envs import MonitorEnv, MonitorVectorEnv
from motor_env.envs.layout import LANES, block_type
from motor_env.envs.setup import converged_gain
from motor_env.envs.single import Info

# Reaches in: the converged covariance, and the numbers of each stream, which an environment draws by itself.
from motor_env.filters.kalman import schedule
from motor_env.motor.faults import apply_fault
from motor_env.motor.model import State, steady_state
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.random_streams import Stream, normals, uniforms
from motor_env.simulation.recipes import FaultClass, Recovery, Spread
from motor_env.simulation.sampling import measure_draw

WAIT, MEDIUM = 0, load_recipe("medium")
INSTANT: dict[str, Any] = {"samples_per_step": 1, "confirm_steps": 1}

# To compile the steps of a vector in double precision, which nobody gets unasked, takes fifteen seconds.
PRECISIONS = ["float32", pytest.param("float64", marks=pytest.mark.long)]
NEAR = {"float32": 5e-6, "float64": 1e-9}


def monitor(**options: Any) -> MonitorEnv:
    return MonitorEnv(**{**INSTANT, **options})


def monitors(count: int, **options: Any) -> MonitorVectorEnv:
    return MonitorVectorEnv(count, **{**INSTANT, **options})


class Last:
    """The last lane of a vector, used like an environment alone: `test_env_vector.py` shows that the two are equal."""

    def __init__(self, lanes: int = 1, **options: Any) -> None:
        self.envs = monitors(lanes, **options)
        self.options, self.setup, self.observed = self.envs.options, self.envs.setup, self.envs.setup.observed

    def _now(self, field: str) -> float:
        last = self.envs._arrays[2].view(block_type(self.options.precision))[-1]
        return float(last[field][(self.envs.num_envs - 1) % LANES])

    def _info(self, info: Info) -> Info:
        mine = {name: values[-1] for name, values in info.items()}
        severity = self.envs._arrays[-1][self.envs.num_envs - 1, 0]
        return {**mine, "label": self.setup.labels[mine["class_index"]], "severity": severity}

    def reset(self, *, seed: int, options: dict[str, int] | None = None) -> tuple[Any, Info]:
        assert options is None or options["index"] == self.envs.num_envs - 1
        observations, info = self.envs.reset(seed=seed)
        return observations[-1], self._info(info)

    def step(self, action: int) -> tuple[Any, float, bool, bool, Info]:
        actions = np.full(self.envs.num_envs, action)
        observations, rewards, terminated, truncated, info = self.envs.step(actions)
        return observations[-1], rewards[-1], bool(terminated[-1]), bool(truncated[-1]), self._info(info)


def rollout(env: MonitorEnv | Last, seed: int, index: int = 0) -> tuple[FloatArray, list[Info], FloatArray]:
    """All observations, infos and the true states of a silent episode."""
    observation, info = env.reset(seed=seed, options={"index": index})
    observations, infos, states = [observation], [info], []
    over = False
    while not over:
        observation, _, over, truncated, info = env.step(WAIT)
        assert truncated is False
        observations.append(observation)
        infos.append(info)
        deviation = [env._now(name) for name in ("current", "speed")]
        states.append(deviation + env.setup.rest)
    return np.array(observations), infos, np.array(states)


def faulty_episode(env: MonitorEnv | Last, label: str) -> int:
    """A seed whose episode has that fault."""
    for seed in range(1000):
        _, info = env.reset(seed=seed)
        if info["label"] == label and info["onset_sample"] < 1500:
            return seed
    raise AssertionError(label)


def assert_near(states: FloatArray, expected: FloatArray, precision: str) -> None:
    """States are kept as deviations from the first one, roughly."""
    moved = np.abs(expected - expected[0]).max(axis=0)
    np.testing.assert_array_less(np.abs(states - expected).max(axis=0), NEAR[precision] * moved)


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("kind", [FaultKind.BEARING, FaultKind.WINDING_CONTACT])
def test_true_states_are_those_of_the_simulation(kind: FaultKind, precision: str) -> None:
    env = Last(precision=precision)
    seed = faulty_episode(env, kind)
    _, infos, states = rollout(env, seed)
    dt_s, load = env.options.dt_s, env.options.load_n_m
    fault = Fault(kind, infos[0]["severity"], onset_s=infos[0]["onset_sample"] * dt_s)
    expected = simulate_states(
        PAPER_MOTOR,
        np.full(len(states), 12.0),
        dt_s,
        faults=(fault,),
        load_torque_n_m=load,
        initial_state=steady_state(PAPER_MOTOR, 12.0, load),
    )
    assert_near(states, expected, precision)


@pytest.mark.parametrize("precision", PRECISIONS)
def test_a_speed_loop_is_a_pi_controller_that_the_filter_is_not_told_of(precision: str) -> None:
    options: dict[str, Any] = {"observe": ("innovation_current",), "precision": precision}
    env = Last(drive="speed_loop", loop_time_s=0.002, **options)
    seed = faulty_episode(env, FaultKind.WINDING_CONTACT)
    _, infos, states = rollout(env, seed)
    motor, rest, dt_s = PAPER_MOTOR, env.setup.rest, env.options.dt_s
    worse = apply_fault(motor, Fault(FaultKind.WINDING_CONTACT, infos[0]["severity"]))
    gain = 12.0 / steady_state(motor, 12.0, 0.0)[State.SPEED] / 0.002
    state, added, expected = rest, 0.0, []
    for k in range(len(states)):
        model = discretize(motor if k < infos[0]["onset_sample"] else worse, dt_s)
        before = state[State.SPEED]
        state = model.transition @ state + model.gain @ [12.0 + added, env.options.load_n_m]
        added -= gain * motor.mechanical_time_constant_s * (state[State.SPEED] - before)
        added -= gain * dt_s * (state[State.SPEED] - rest[State.SPEED])
        expected.append(state)
    assert_near(states, np.array(expected), precision)
    dropped = rollout(Last(**options), seed)[2][-1, State.SPEED] - rest[State.SPEED]
    assert abs(states[-1, State.SPEED] - rest[State.SPEED]) < 1e-3 * abs(dropped)


def test_a_declaration_can_be_asked_to_be_confirmed() -> None:
    env = monitor(confirm_steps=3, horizon_s=0.02, earliest_onset_s=0.0, mean_onset_s=0.0)

    def ended(*actions: int) -> bool:
        env.reset(seed=1)
        return [env.step(action)[2] for action in actions][-1]

    assert not ended(1, 1)
    assert ended(1, 1, 1)
    assert not ended(1, 1, 2, 1, 1)
    assert not ended(2, 2, 0, 2, 2)
    faulty_episode(env, FaultKind.BEARING)
    rewards = [env.step(0)[1] for _ in range(199)] + [env.step(1)[1]]
    assert rewards[-1] > 0.0  # in the last step the first word counts


BOTH = replace(MEDIUM, sensor=SensorParameters((Channel.CURRENT, Channel.SPEED), 0.02, 0.5))


LOOSE = Recovery(mean_duration_s=0.004, mean_pause_s=0.002)
FAILING = replace(
    BOTH,
    classes=(
        FaultClass(),
        FaultClass(FaultKind.BEARING, 0.25),
        FaultClass(FaultKind.WINDING_CONTACT, 0.1, severity_to=0.3, recovery=LOOSE),
        FaultClass(FaultKind("current_dead"), 1.0),
        FaultClass(FaultKind("current_gain"), 0.1),
        FaultClass(FaultKind("current_offset"), 0.1, recovery=LOOSE),
        FaultClass(FaultKind("current_drift"), 0.1),
        FaultClass(FaultKind("current_stuck"), 1.0, recovery=LOOSE),
        FaultClass(FaultKind("speed_dead"), 0.7),
        FaultClass(FaultKind("speed_gain"), 0.2),
        FaultClass(FaultKind("speed_offset"), 0.1, severity_to=0.4),
        FaultClass(FaultKind("speed_drift"), 0.02, recovery=LOOSE),
        FaultClass(FaultKind("speed_stuck"), 1.0),
    ),
)


@pytest.mark.parametrize(
    ("recipe", "label"),
    [(MEDIUM, "bearing"), (BOTH, "bearing"), (FAILING, "current_gain"), (FAILING, "speed_drift")],
)
def test_observations_are_those_of_the_filter_in_their_units(recipe: Recipe, label: str) -> None:
    """Innovations and estimates of `run_filter`; their weighted means, scaled to a standard deviation of 1, by hand."""
    env = monitor(recipe=recipe)
    channels, options = recipe.sensor.channels, env.options
    observations, _, _ = rollout(env, faulty_episode(env, label))
    seen = dict(zip(env.observed, observations.T.astype(np.float64), strict=True))
    units = {"current": 12.0 / 2.18, "speed": 12.0 / float(PAPER_MOTOR.back_emf_constant_v_s_per_rad)}
    measured = np.array([seen[f"measured_{c}"][1:] * units[c] for c in channels])
    belief = env.setup.belief
    gain, covariance = converged_gain(belief)
    predicted_covariance = schedule(belief, 20_000).covariance[-1]
    settled = KalmanFilter(
        belief.model,
        belief.observation,
        belief.process_covariance,
        belief.measurement_covariance,
        belief.initial_state,
        predicted_covariance,
    )
    result = run_filter(settled, measured[None], np.full(measured.shape[1], 12.0), 0.0147)
    result = type(result)(*(value.squeeze() for value in result))
    np.testing.assert_allclose(result.gain[-1], gain.squeeze(), rtol=1e-6)
    np.testing.assert_allclose(result.innovation_covariance[-1], covariance.squeeze(), rtol=1e-9)
    white = result.whitened.reshape(-1, len(channels))
    for number, unit in enumerate(units.values()):
        np.testing.assert_allclose(
            seen[f"estimated_{tuple(units)[number]}"][1:], result.state[:, number] / unit, atol=2e-6
        )
    shown = np.array([seen[f"innovation_{c}"][1:] for c in channels])
    np.testing.assert_allclose(shown, white.T, atol=2e-4)
    power = np.square(shown).sum(axis=0) - len(channels)
    fast, slow = np.exp(-options.dt_s / 1e-3), np.exp(-options.dt_s / 10e-3)
    for number, channel in enumerate(channels):
        for name, memory in (("fast", fast), ("slow", slow)):
            wanted = lfilter([np.sqrt(1.0 - memory**2)], [1.0, -memory], shown[number])
            np.testing.assert_allclose(seen[f"{name}_{channel}"][1:], np.clip(wanted, -10.0, 10.0), atol=2e-5)
    into = np.sqrt(
        (1.0 - slow**2) / (2.0 * len(channels))
    )  # a square of a standard normal has a variance of 2
    np.testing.assert_allclose(
        seen["excess"][1:], np.minimum(lfilter([into], [1.0, -slow], power), 10.0), atol=1e-4
    )
    np.testing.assert_allclose(seen["time"], np.arange(2001) / 2000.0, atol=1e-7)
    assert (seen["voltage"] == 1.0).all()
    assert not any(seen[name][0] for name in env.observed if name[:4] in ("inno", "fast", "slow", "exce"))


@pytest.mark.parametrize("precision", PRECISIONS)
def test_evidence_is_a_cumulative_sum_of_log_likelihood_ratios(precision: str) -> None:
    """Of a filter that believes in the smallest fault of a kind, which begins anew where its sum falls to zero."""
    names = ("evidence_bearing", "evidence_winding_contact")
    env = Last(observe=("measured_current", *names), precision=precision)
    observations, _, _ = rollout(env, faulty_episode(env, FaultKind.WINDING_CONTACT))
    measured, belief = observations[1:, 0].astype(np.float64) * 12.0 / 2.18, env.setup.belief.model
    gain, covariance = converged_gain(env.setup.belief)
    inputs, std = np.array([12.0, env.options.load_n_m]), float(np.sqrt(covariance[0, 0]))
    for column, kind in enumerate((FaultKind.BEARING, FaultKind.WINDING_CONTACT), 1):
        faulty = discretize(apply_fault(PAPER_MOTOR, Fault(kind, 0.1)), env.options.dt_s)
        healthy, other, total, wanted = env.setup.rest, env.setup.rest, 0.0, []
        for value in measured:
            predicted = belief.transition @ healthy + belief.gain @ inputs
            rival = faulty.transition @ other + faulty.gain @ inputs
            off, rivals = value - predicted[0], value - rival[0]
            total += 0.5 * (off**2 - rivals**2) / std**2
            healthy = predicted + gain[:, 0] * off
            other = rival + gain[:, 0] * rivals if total > 0.0 else healthy
            total = max(total, 0.0)
            wanted.append(min(0.1 * total, 10.0))
        np.testing.assert_allclose(observations[1:, column], wanted, atol=1e-4)
        assert observations[0, column] == 0.0
    assert observations[:, 2].max() > 3.0


def test_an_onset_is_the_draw_of_its_stream() -> None:
    """Geometric from the earliest sample on; the first sample that differs is the one after it."""
    envs = monitors(60, mean_onset_s=0.004)
    _, info = envs.reset(seed=9)
    u = uniforms(9, Stream.ONSET, np.arange(60) << 32, 1)[:, 0]
    wanted = 100 + np.floor(np.log(u) / np.log(40.0 / 41.0)).astype(int)
    faulty = info["class_index"] > 0
    np.testing.assert_array_equal(info["onset_sample"], np.where(faulty, wanted, -1))
    assert 20.0 < wanted.mean() - 100.0 < 60.0
    at_once = monitors(60, mean_onset_s=0.0)
    np.testing.assert_array_equal(at_once.reset(seed=9)[1]["onset_sample"], np.where(faulty, 100, -1))
    far = monitors(60, mean_onset_s=1e9).reset(seed=9)[1]["onset_sample"]
    np.testing.assert_array_equal(far, np.where(faulty, 2**31 - 1, -1))
    active = [at_once.step(np.zeros(60, dtype=np.int64))[4]["fault_active"] for _ in range(102)]
    np.testing.assert_array_equal(active[99], np.zeros(60, dtype=bool))
    np.testing.assert_array_equal(active[100], faulty)


def test_a_fault_shows_only_after_its_onset() -> None:
    env = monitor(observe=("innovation_current",))
    seed = faulty_episode(env, FaultKind.WINDING_CONTACT)
    observations, infos, _ = rollout(env, seed)
    onset = infos[0]["onset_sample"]
    innovations = observations[1:, 0]
    assert abs(innovations[:onset].mean()) < 4.0 / np.sqrt(onset)
    assert innovations[onset : onset + 10].mean() < -2.0


def outcome(env: MonitorEnv, seed: int, wait: int, action: int) -> float:
    """Reward of the last step: wait so many steps, then act."""
    env.reset(seed=seed)
    for _ in range(wait):
        env.step(WAIT)
    _, reward, terminated, _, _ = env.step(action)
    assert terminated
    assert type(reward) is float
    return reward


def test_rewards_say_what_the_options_say() -> None:
    env = monitor(correct_reward=2.0, false_alarm_cost=3.0, wrong_kind_cost=4.0, miss_cost=5.0)
    seed = faulty_episode(env, FaultKind.BEARING)
    onset = env.reset(seed=seed)[1]["onset_sample"]
    assert outcome(env, seed, onset, 1) == -3.0  # nothing of the fault has been observed yet
    assert outcome(env, seed, onset + 1, 1) == pytest.approx(2.0 - 5.0 * 1e-4, rel=1e-6)
    assert outcome(env, seed, onset + 3, 2) == pytest.approx(-4.0 - 3.0 * 5.0 * 1e-4, rel=1e-6)
    assert outcome(env, seed, 1999, WAIT) == pytest.approx(-5.0 - 5.0 * 1e-4 * (2000 - onset), rel=1e-6)
    healthy = next(s for s in range(100) if env.reset(seed=s)[1]["label"] == "healthy")
    assert outcome(env, healthy, 1999, WAIT) == 1.0


def test_delay_from_the_onset_on_is_charged_at_the_end() -> None:
    env = monitor(delay_cost_per_s=7.0, miss_cost=0.0)
    seed = faulty_episode(env, FaultKind.BEARING)
    onset = env.reset(seed=seed)[1]["onset_sample"]
    n_steps = env.options.n_steps
    rewards = [env.step(WAIT)[1] for _ in range(n_steps)]
    assert rewards[:-1] == [0.0] * (n_steps - 1)
    assert rewards[-1] == pytest.approx(-7.0e-4 * (n_steps - onset), rel=1e-6)


@pytest.mark.parametrize("precision", PRECISIONS)
def test_noise_is_that_of_the_streams_and_a_start_that_of_the_simulation(precision: str) -> None:
    """The environment, a data set and a recording that is simulated draw the same numbers for the same case."""
    env = Last(
        lanes=6,
        precision=precision,
        start="standstill",
        load_torque_n_m=0.0,
        horizon_s=0.05,
        recipe="bench",
        observe=("measured_current",),
        mean_onset_s=1e9,
    )
    observed, _, states = rollout(env, seed=3, index=5)
    stall = 12.0 / PAPER_MOTOR.resistance_ohm
    noise = observed[1:, 0] * stall - states[:, 0]
    case = np.array([5 << 32])
    expected = normals(3, Stream.MEASUREMENT, case, 501)[0, 1:] * env.options.task.sensor.current_noise_a
    np.testing.assert_allclose(noise, expected, atol=2e-6)
    drawn = draw(env.options.task, 3, case)
    simulated = simulate_states(
        drawn.scenario.parameters, np.full((1, 500), drawn.scenario.supply.voltage_v), env.options.dt_s
    )
    assert_near(states, simulated[0], precision)


@pytest.mark.parametrize("known", [True, False])
def test_sensors_fail_and_faults_recover_as_in_a_data_set(known: bool) -> None:
    """Every class: its draws, and each reading of a start but for the noise, whose order is another one."""
    recipe = replace(FAILING, sensor=replace(BOTH.sensor, current_noise_a=1e-7, speed_noise_rad_s=1e-5))
    recipe = replace(recipe, timing=Timing(10_000.0, 0.03), spread=Spread(*[0.0 if known else 0.02] * 5))
    if known:
        classes = [replace(c, severity_to=None) for c in FAILING.classes if not c.name.startswith("speed_")]
        recipe = replace(
            recipe, classes=tuple(classes), sensor=replace(recipe.sensor, channels=(Channel.CURRENT,))
        )
    channels = recipe.sensor.channels
    envs = monitors(
        60,
        recipe=recipe,
        start="standstill",
        load_torque_n_m=0.0,
        horizon_s=0.03,
        earliest_onset_s=0.0,
        mean_onset_s=0.0,
        observe=tuple(f"measured_{channel}" for channel in channels),
    )
    info, wait = envs.reset(seed=7)[1], np.zeros(60, dtype=np.int64)
    drawn = draw(recipe, 7, np.arange(60) << 32)
    np.testing.assert_array_equal(info["class_index"], drawn.class_index)
    np.testing.assert_array_equal(info["severity"], drawn.severity)
    assert set(drawn.class_index) == set(range(len(recipe.classes)))
    steps = [envs.step(wait) for _ in range(300)]
    units = np.array([[12.0 / 2.18], [12.0 / 0.02352]])[: len(channels)]
    found = units * np.stack([step[0] for step in steps], axis=-1)
    wanted = measure_draw(drawn, recipe, 7)
    np.testing.assert_allclose(found, wanted, rtol=2e-5, atol=2e-5)
    begins = recipe.timing.interval_start_s
    acts = np.zeros((60, 300), dtype=bool)
    for fault in drawn.scenario.faults:
        acts |= np.reshape(fault.severity, (-1, 1)) * fault.fraction_at(begins) > 0.0
    np.testing.assert_array_equal(np.stack([step[4]["fault_active"] for step in steps], axis=-1), acts)


def test_a_fault_that_has_acted_is_the_right_answer_in_its_pauses_too_and_they_count_as_delay() -> None:
    env = monitor(recipe=FAILING, mean_onset_s=0.01)
    right = 1 + env.setup.kinds.index("winding")
    assert env.setup.kinds == ("bearing", "winding", "current_sensor", "speed_sensor")
    onset = env.reset(seed=(seed := faulty_episode(env, "winding_contact")))[1]["onset_sample"]
    active = [env.step(WAIT)[4]["fault_active"] for _ in range(1500)]
    pause = onset + active[onset:].index(False)
    assert True in active[pause:]
    for wait in (pause + 1, pause + 1 + active[pause:].index(True)):
        wanted = 1.0 - 5.0e-4 * (wait - onset)
        assert outcome(env, seed, wait, right) == pytest.approx(wanted, rel=1e-6)
