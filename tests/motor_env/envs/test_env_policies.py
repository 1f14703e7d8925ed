"""Policies, their scores and posteriors by hand; the view for agents, and the examples' agents."""

import re
import runpy
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import bounds
import gymnasium as gym
import numpy as np
import pytest
import reference_scores
from best_policies import RatioTest
from scipy.stats import norm

from motor_env import Cusum, FaultKind, discretize, load_recipe
from motor_env.envs import (
    BankPolicy,
    BayesPolicy,
    BeliefPolicy,
    EventTriggeredProbing,
    ExpectedRewardTest,
    MonitorOptions,
    MonitorVectorEnv,
    PosteriorView,
    ProbeBelief,
    ProbeOptions,
    ProbeVectorEnv,
    RulePolicy,
    baseline_features,
    layout,
    parts_of,
    returns_of,
    run_episodes,
    score,
    sweep,
)
from motor_env.envs.policies.evaluation import Runs
from motor_env.envs.policies.fault_posterior import final_worth, worth
from motor_env.envs.policies.posterior_policies import Bursts, OpenLoop, signatures
from motor_env.envs.policies.residual_posterior import ResidualPosterior, innovation_signatures
from motor_env.envs.policies.rule_policies import column
from motor_env.envs.setup import converged_gain, make_setup
from motor_env.motor.faults import apply_faults
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.recipes import FaultClass

INSTANT, PROBED = (gym.spec(f"motor_env/{name}Instant-v0").kwargs for name in ("Monitor", "Probe"))
EASY, MEDIUM, HARD, SMALL, SENSOR = map(load_recipe, ("easy", "medium", "hard", "small", "sensor"))
MONITOR: dict[str, Any] = {"recipe": "easy", "horizon_s": 0.05, "observe": baseline_features(EASY), **INSTANT}
PROBE: dict[str, Any] = {"recipe": "small", "horizon_s": 0.1, **PROBED}


def monitor(count: int = 200) -> MonitorVectorEnv:
    return MonitorVectorEnv(count, **MONITOR)


def test_returns_are_those_of_the_first_episode_alone_and_their_parts_add_up() -> None:
    envs = monitor()
    policy = RulePolicy(envs.setup, Cusum(0.5, two_sided=True), threshold=8.0)
    wanted = run_episodes(monitor(), policy, 3)
    assert 0 < (wanted.steps > 0).sum() < envs.num_envs  # some begin a second episode, some do not end early
    np.testing.assert_allclose(returns_of(envs, policy, 3), wanted.returns, rtol=1e-12)
    np.testing.assert_allclose(np.sum(parts_of(envs, policy, 3), axis=0), wanted.returns, rtol=1e-12)


OPEN_LOOP = Bursts(5, 8, 3).actions(50)
AT_ONCE = {"earliest_onset_s": 0.0, "mean_onset_s": 0.0}


@pytest.mark.parametrize(
    ("options", "policy_of", "thresholds"),
    [
        (MONITOR, lambda s: BankPolicy(s, 0.0), (0.5, 3.0, 30.0)),
        (MONITOR | AT_ONCE, lambda s: BankPolicy(s, 0.0), (0.5, 3.0)),
        (MONITOR, lambda s: RulePolicy(s, Cusum(0.5, True), threshold=0.0), (2.0, 8.0, 1e9)),
        (MONITOR, lambda s: BayesPolicy(s, 0.0), (0.0, 0.8, 0.97)),
        (PROBE, lambda s: OpenLoop(RatioTest(s, 0.0), OPEN_LOOP), (1.0, 4.0, 9.0)),
        (PROBE, lambda s: EventTriggeredProbing(ExpectedRewardTest(s, 0.0), 0.05), (0.2, 0.97)),
    ],
)
def test_a_sweep_gives_what_every_threshold_gives_alone(
    options: dict[str, Any], policy_of: Callable[[Any], Any], thresholds: tuple[float, ...]
) -> None:
    envs = (ProbeVectorEnv if options is PROBE else MonitorVectorEnv)(60, **options)
    policy = policy_of(envs.setup)
    for threshold, runs in zip(thresholds, sweep(envs, policy, thresholds, 7), strict=True):
        policy.threshold = threshold
        alone = run_episodes(envs, policy, 7)
        np.testing.assert_allclose(runs.returns, alone.returns, atol=1e-6)
        for one, other in zip(runs[1:], alone[1:], strict=True):
            np.testing.assert_array_equal(one, other)


def test_likelihood_ratio_is_that_of_plant_and_filter_simulated_sample_by_sample() -> None:
    """The mean innovation under a fault, from the plant's and the filter's own recursions, gives the same ratio."""
    setup = make_setup(ProbeOptions(**PROBE, earliest_onset_s=0.0))
    n, steps, which, onset_step, rng = 20, 12, 3, 4, np.random.default_rng(5)
    offsets = rng.choice([-1.0, 0.0, 1.0], steps)
    plants = [discretize(apply_faults(SMALL.motor, SMALL.classes[c].faults), 1e-4) for c in (0, which)]
    gain, covariance = converged_gain(setup.belief)
    state, estimate = np.array(setup.rest), np.array(setup.rest)
    shown = []
    for sample in range(steps * n):
        u = np.array([12.0 + offsets[sample // n], 0.0])
        plant = plants[int(sample >= onset_step * n + n // 2)]
        state = plant.transition @ state + plant.gain @ u
        predicted = plants[0].transition @ estimate + plants[0].gain @ u
        surprise = state[0] - predicted[0]
        estimate = predicted + gain[:, 0] * surprise
        shown.append(surprise / np.sqrt(covariance[0, 0]))
    means = np.array(shown).reshape(steps, n).sum(axis=1) / np.sqrt(n)
    seen = (rng.normal(size=steps) + means).astype(np.float32)
    belief = ProbeBelief(setup)
    belief.start(1)
    voltage = layout.FEATURES.index("voltage")
    for step in range(steps):
        observation = np.zeros((1, len(setup.chosen)), dtype=np.float32)
        observation[0, column(setup, "innovation_current")] = seen[step]
        observation[0, column(setup, "voltage")] = (offsets[step] + 12.0) * setup.view[0, voltage]
        belief.update(observation)
    wanted = (means * (seen - 0.5 * means))[onset_step:].sum()
    age = steps - 1 - onset_step
    np.testing.assert_allclose(belief._hypotheses.ratio[0, which - 1, age], wanted, rtol=1e-5, atol=1e-6)


def test_expected_rewards_before_anything_is_seen_by_hand() -> None:
    setup = make_setup(ProbeOptions(**PROBE, earliest_onset_s=0.0))
    options, belief = setup.options, ProbeBelief(setup)
    belief.start(3)
    stay = options.mean_onset_s / (options.mean_onset_s + 1e-4)
    comes = (1.0 - SMALL.class_probabilities[0]) * (1.0 - stay**20)  # in the next 20 samples, halfway through
    waits = -options.delay_cost_per_s * 0.5 * comes * 2e-3
    probes = waits - options.probe_cost_per_v2_s * setup.offsets_v[1] ** 2 * 2e-3
    found = belief.expected_reward(np.array([0, 1, 3]))
    assert found == pytest.approx([waits, probes, -options.false_alarm_cost])


def test_restart_forgets_where_an_episode_is_over() -> None:
    envs = ProbeVectorEnv(64, **PROBE)
    belief = ProbeBelief(envs.setup)
    envs.reset(seed=1)
    belief.start(64)
    for _ in range(20):
        belief.update(envs.step(np.full(64, 1))[0])
    over = np.arange(64) % 2 == 0
    kept = belief.summary()[~over]
    belief.restart(over)
    fresh = ProbeBelief(envs.setup)
    fresh.start(64)
    np.testing.assert_array_equal(belief.summary()[over], fresh.summary()[over])
    np.testing.assert_array_equal(belief.summary()[~over], kept)


def test_no_policy_is_above_the_bound() -> None:
    envs = MonitorVectorEnv(400, horizon_s=0.05, observe=baseline_features(MEDIUM), **INSTANT)
    swept = sweep(envs, BayesPolicy(envs.setup, 0.0), (0.8, 0.9, 0.95), 42)
    best, bound = max((runs.returns for runs in swept), key=np.mean), bounds.upper_bound(envs.options)
    assert bound - 0.1 < best.mean() < bound + 2.0 * best.std() / 20.0  # and the bound is not an idle one


def test_a_score_by_hand() -> None:
    """Seven episodes of 1,000 samples in steps of 10: right, wrong, false twice, missed, late, rightly silent."""
    envs = MonitorVectorEnv(1, horizon_s=0.1, samples_per_step=10)
    runs = Runs(
        returns=np.array([1.0, -0.5, -1.0, -1.0, -1.0, 0.0, 1.0]),
        steps=np.array([31, 25, 20, 7, 0, 0, 0]),
        declared=np.array([1, 1, 2, 1, 0, 0, 0]),
        right=np.array([1, 2, 1, 0, 1, 2, 0]),
        onset=np.array([0, 150, 200, -1, 500, 991, -1]),
        probing=np.array([0.1, 0.3, 0.0, 0.0, 0.3, 0.0, 0.0]),
    )
    assert score(envs, runs).as_row() == pytest.approx(
        {
            "episodes": 7,
            "mean_return": -1.5 / 7.0,
            "return_half_width": 1.959964 * np.sqrt((5.25 - 1.5**2 / 7.0) / 6.0 / 7.0),
            "false_alarm_share": 2.0 / 7.0,  # at the onset itself nothing has been seen
            "detected_share": 2.0 / 4.0,
            "isolated_share": 1.0 / 2.0,
            "median_delay_s": 0.5 * (0.0310 + 0.0100),
            "late_share": 1.0 / 5.0,
            "probing_share": 0.1,
        },
        rel=2e-5,
    )
    silent = runs._replace(declared=np.zeros(7, dtype=np.int64))
    assert (score(envs, silent).detected_share, score(envs, silent).false_alarm_share) == (0.0, 0.0)
    for onset, late, detected in ((990, 0.0, 0.5), (1000, 0.0, 2.0 / 3.0)):  # seen in the last step, never
        one = score(envs, runs._replace(onset=np.array([0, 150, 200, -1, 500, onset, -1])))
        assert (one.late_share, one.detected_share) == (late, detected)


def test_what_to_declare_is_worth_by_hand() -> None:
    options = MonitorOptions(
        correct_reward=2.0, wrong_kind_cost=3.0, false_alarm_cost=5.0, silent_reward=7.0, miss_cost=11.0
    )
    quiet, kinds = np.array([0.5, 0.1]), np.array([[0.3, 0.2], [0.2, 0.7]])
    declared, silent = worth(options, quiet, kinds)
    np.testing.assert_allclose(declared, [0.3 * 2 - 0.2 * 3 - 0.5 * 5, 0.7 * 2 - 0.2 * 3 - 0.1 * 5])
    np.testing.assert_allclose(silent, [0.5 * 7 - 0.5 * 11, 0.1 * 7 - 0.9 * 11])
    np.testing.assert_array_equal(final_worth(options, False, quiet, kinds), declared)
    assert final_worth(options, True, quiet, kinds).tolist() == [-np.inf, np.inf]


def test_the_posterior_is_bayes_rule_over_all_classes_and_onsets() -> None:
    """Sample by sample against a plain sum over every hypothesis; an onset shows from the sample after it on."""
    n, first = 40, 2
    options: dict[str, Any] = {"horizon_s": 0.02, "earliest_onset_s": 2e-4, "mean_onset_s": 2e-3}
    envs = MonitorVectorEnv(1, recipe=MEDIUM, observe=("measured_current",), **options, **INSTANT)
    shown, off = signatures(envs.setup, n), np.random.default_rng(8).normal(size=n)
    off[n // 2 :] += shown[1][: n // 2]
    observed = (off * 0.02 + envs.setup.rest[0])[:, None, None] * 2.18 / 12.0
    policy = BayesPolicy(envs.setup, 0.9)
    policy.start(1)
    chance = envs.options.task.class_probabilities
    assert chance == pytest.approx([0.5, 0.125, 0.125, 0.125, 0.125])
    stay = 20.0 / 21.0
    fine = make_setup(ProbeOptions(**{**PROBED, "samples_per_step": 1}))
    assert (policy._signature.shape, ProbeBelief(fine)._n_ages) == ((4, 200), 400)  # 20 ms and 40 ms
    for seen in range(1, n + 1):
        value, action = policy.judge(observed[seen - 1])
        quiet, classes = chance[0] + (1.0 - chance[0]) * stay ** max(seen - 1 - first, 0), np.zeros(4)
        for c in range(4):
            for onset in range(first, seen - 1):
                mean = np.zeros(seen)
                mean[onset + 1 :] = shown[c + 1][: seen - onset - 1]
                ratio = np.exp((norm.logpdf(off[:seen], mean) - norm.logpdf(off[:seen])).sum())
                classes[c] += chance[c + 1] * (1.0 - stay) * stay ** (onset - first) * ratio
        total = quiet + classes.sum()
        assert policy.quiet[0] == pytest.approx(quiet / total, rel=1e-6)
        np.testing.assert_allclose(policy.classes[0], classes / total, rtol=1e-6, atol=1e-12)
        assert policy.kinds[0].tolist() == pytest.approx(
            [classes[:2].sum() / total, classes[2:].sum() / total]
        )
        assert value == pytest.approx(worth(envs.options, policy.quiet, policy.kinds)[0])
        assert action == 1 + policy.kinds[0].argmax()


SENSED: dict[str, Any] = {
    "recipe": SENSOR,
    "growth_s": 0.1,
    "observe": ("innovation_current", "innovation_speed"),
}


def test_a_signature_is_what_a_fault_adds_to_the_innovations() -> None:
    recipe, onset = (
        SENSOR,
        {"earliest_onset_s": 0.001, "mean_onset_s": 0.0},
    )  # in the middle of the first step

    def innovations(which: int) -> FloatArray:
        classes = [replace(c, weight=1e12 if m == which else 1.0) for m, c in enumerate(recipe.classes)]
        envs = MonitorVectorEnv(1, **{**SENSED, **onset, "recipe": replace(recipe, classes=tuple(classes))})
        assert envs.reset(seed=4)[1]["class_index"].tolist() == [which]
        return np.array([envs.step(np.zeros(1, dtype=np.int64))[0][0] for _ in range(60)])

    setup, healthy = make_setup(MonitorOptions(**SENSED)), innovations(0)
    faults = list(range(1, len(recipe.classes)))
    signatures_by_sample = innovation_signatures(setup, faults, 1200, onset=10)
    for which, by_sample in zip(faults, signatures_by_sample, strict=True):
        wanted = by_sample.reshape(60, 20, 2).sum(axis=1) / np.sqrt(20.0)
        np.testing.assert_allclose(innovations(which), np.clip(healthy + wanted, -10.0, 10.0), atol=2e-3)


def test_the_bank_of_hypotheses_has_the_posterior_and_tells_motor_from_sensor() -> None:
    envs = MonitorVectorEnv(200, **SENSED)
    setup, policy = envs.setup, ResidualPosterior(envs.setup, 0.9)
    assert setup.kinds == ("bearing", "winding", "current_sensor", "speed_sensor")
    result = score(envs, run_episodes(envs, policy, 3))
    assert 0.7 < result.mean_return < 0.883  # what no policy exceeds
    assert result.isolated_share > 0.95
    observations, seen = envs.reset(seed=5)[0], []
    policy.start(200)
    for _ in range(40):
        policy.judge(observations)
        observations = envs.step(np.zeros(200, dtype=np.int64))[0]
        seen.append(observations[0].astype(np.float64))
    policy.judge(observations)
    prior, begin = SENSOR.class_probabilities, np.maximum(20 * np.arange(41) - 100, 0)
    unborn = (500.0 / 501.0) ** begin
    by_kind, faults = np.zeros(4), range(1, len(prior))
    signs = (
        innovation_signatures(setup, list(faults), 800, onset=10).reshape(-1, 40, 20, 2).sum(axis=2)
        / 20.0**0.5
    )
    for which, shape in zip(faults, signs, strict=True):
        for born in range(40):
            mean = shape[: 40 - born]
            ratio = np.exp((mean * (np.array(seen[born:]) - 0.5 * mean)).sum())
            by_kind[setup.right_declarations[which] - 1] += (
                prior[which] * (unborn[born] - unborn[born + 1]) * ratio
            )
    quiet = prior[0] + (1.0 - prior[0]) * unborn[40]
    np.testing.assert_allclose(policy.kinds[0], by_kind / (by_kind.sum() + quiet), atol=1e-9)
    np.testing.assert_allclose(policy.quiet[0], quiet / (by_kind.sum() + quiet), atol=1e-9)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"start": "standstill"}, "start must be running"),
        ({"recipe": HARD, "observe": ()}, "recipe hard must have no spread"),
        ({"observe": ("innovation_current",)}, "this policy needs the feature innovation_speed"),
        ({"recipe": replace(SENSOR, classes=(FaultClass(), FaultClass(FaultKind("speed_stuck"), 1.0)))}, "speed_stuck"),
    ],
)  # fmt: skip
def test_a_task_that_the_bank_of_hypotheses_does_not_know_is_refused(
    changes: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(ValueError, match=sentence):
        ResidualPosterior(make_setup(MonitorOptions(**{**SENSED, **changes})), 0.9)


OPTIONS: dict[str, Any] = {"observe": ("innovation_current", "voltage"), "horizon_s": 0.1}
OPTIONS |= gym.spec("motor_env/ProbeInstant-v0").kwargs
EXAMPLES = Path(__file__).parents[3] / "examples"


def example(name: str) -> Any:
    """The module of an example."""
    return SimpleNamespace(**runpy.run_path(str(EXAMPLES / f"{name}.py")))


def test_a_posterior_view_pays_the_true_reward_on_average() -> None:
    count = 1000
    envs = ProbeVectorEnv(count, autoreset_mode="SameStep", **{**OPTIONS, "confirm_steps": 2})
    view, rng = PosteriorView(envs), np.random.default_rng(0)
    seen, _ = view.reset(seed=5)
    assert view.single_observation_space.contains(seen[0])
    told, true = np.zeros((2, count))
    step, answers = envs.step, []

    def watched(actions: Any) -> Any:
        answers.append(step(actions))
        return answers[-1]

    envs.step = watched  # type: ignore[method-assign]
    alive = np.ones(count, dtype=bool)
    for _ in range(envs.options.n_steps):
        sure = view.belief.kinds.max(axis=1) > 0.3
        actions = np.where(sure, 3 + view.belief.kinds.argmax(axis=1), rng.integers(0, 3, count))
        _, reward, over, _, _ = view.step(actions)
        told, true = told + alive * reward, true + alive * answers[-1][1]
        alive &= ~over
    assert not alive.any()
    difference = told - true
    assert difference.std() > 0.1
    assert abs(difference.mean()) < 4.0 * difference.std() / count**0.5


def test_a_policy_of_summaries_sees_what_the_view_shows() -> None:
    envs = ProbeVectorEnv(8, **OPTIONS)
    seen: list[Any] = []

    def wait(summary: Any) -> Any:
        seen.append(summary)
        return np.zeros(len(summary))

    policy = BeliefPolicy(ProbeBelief(envs.setup), wait)
    for _ in range(2):  # whatever it played before
        seen.clear()
        run_episodes(envs, policy, seed=3)
    view = PosteriorView(ProbeVectorEnv(8, autoreset_mode="SameStep", **OPTIONS))
    np.testing.assert_array_equal(seen[0], view.reset(seed=3)[0])
    for shown in seen[1:]:
        np.testing.assert_array_equal(shown, view.step(np.zeros(8, dtype=np.int64))[0])
    np.testing.assert_array_equal(view.reset(seed=3)[0], seen[0])  # it forgets
    with pytest.raises(ValueError, match="autoreset_mode of the vector must be SameStep, got NextStep"):
        PosteriorView(envs)


@pytest.mark.parametrize("name", [path.stem for path in (EXAMPLES / "agents").glob("*.npz")])
def test_the_agent_that_is_kept_is_better_than_one_action_always(name: str, tmp_path: Path) -> None:
    ppo = example("ppo")
    agent = ppo.Agent(dict(np.load(EXAMPLES / "agents" / f"{name}.npz")))
    told = ppo.play(name, agent, tmp_path / "screen.png")
    assert (tmp_path / "screen.png").stat().st_size > 1000
    found = float(re.findall(r"mean return (\S+)", told)[0])
    assert found > reference_scores.kept(name)["trivial"]["return"] + 0.5


@pytest.mark.long
def test_an_agent_with_a_memory_is_trained_scored_and_logged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["recurrent_ppo.py", "--steps", "1", "--tensorboard", str(tmp_path)])
    example("recurrent_ppo").main()
    assert re.fullmatch(r"mean return [+-]\d\.\d{3} ± 0\.\d{3} of 500 episodes\n", capsys.readouterr().out)
    assert len(list(tmp_path.rglob("events.out.tfevents.*"))) == 1
