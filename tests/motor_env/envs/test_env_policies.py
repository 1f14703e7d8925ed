"""Baselines and their scores: against the truth, against the posterior built by hand, and below their bounds."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import bounds
import gymnasium as gym
import numpy as np
import pytest
from best_policies import LookAhead, RatioTest
from bounds import LOG_ODDS, PROBABILITY, declared_worth, look_matrix, silent_worth
from scipy.stats import norm

from motor_env import Cusum, FaultKind, Recipe, discretize, load_recipe
from motor_env.envs import (
    BankPolicy,
    BayesPolicy,
    EventTriggeredProbing,
    ExpectedRewardTest,
    MonitorOptions,
    MonitorVectorEnv,
    Never,
    ProbeBelief,
    ProbeOptions,
    ProbeVectorEnv,
    Random,
    RulePolicy,
    baseline_features,
    layout,
    returns_of,
    run_episodes,
    score,
    sweep,
)
from motor_env.envs.policies.evaluation import Runs, interval, joined
from motor_env.envs.policies.fault_posterior import final_worth, worth
from motor_env.envs.policies.posterior_policies import Bursts, OpenLoop, signatures
from motor_env.envs.policies.residual_posterior import ResidualPosterior, innovation_signatures
from motor_env.envs.policies.rule_policies import ThresholdPolicy, column
from motor_env.envs.setup import converged_gain, make_setup
from motor_env.motor.faults import apply_faults
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.recipes import FaultClass

EASY, MEDIUM, HARD, SMALL, SENSOR = map(load_recipe, ("easy", "medium", "hard", "small", "sensor"))
INSTANT, PROBED = (gym.spec(f"motor_env/{name}Instant-v0").kwargs for name in ("Monitor", "Probe"))
MONITOR: dict[str, Any] = {"recipe": "easy", "horizon_s": 0.05, "observe": baseline_features(EASY), **INSTANT}
PROBE: dict[str, Any] = {"recipe": "small", "horizon_s": 0.1, **PROBED}


def monitor(count: int = 200) -> MonitorVectorEnv:
    return MonitorVectorEnv(count, **MONITOR)


def test_silence_costs_what_the_truth_says() -> None:
    envs = monitor()
    runs = run_episodes(envs, Never(), 3)
    options = envs.options
    late = (runs.onset < 0) | (runs.onset >= options.n_samples)
    delay = options.delay_cost_per_s * options.dt_s * (options.n_samples - runs.onset)
    wanted = np.where(late, options.silent_reward, -options.miss_cost - delay)
    np.testing.assert_allclose(runs.returns, wanted, atol=1e-4)  # float32 sums 500 costs
    found = score(envs, runs)
    assert found.detected_share == found.false_alarm_share == 0.0


def test_returns_are_those_of_the_first_episode_alone() -> None:
    envs = monitor()
    policy = RulePolicy(envs.setup, Cusum(0.5, two_sided=True), threshold=8.0)
    wanted = run_episodes(monitor(), policy, 3)
    assert 0 < (wanted.steps > 0).sum() < envs.num_envs  # some begin a second episode, some do not end early
    np.testing.assert_allclose(returns_of(envs, policy, 3), wanted.returns, rtol=1e-12)


@pytest.mark.parametrize("name", ["bank", "bank at once", "cusum", "bayes", "open loop", "on demand"])
def test_a_sweep_gives_what_every_threshold_gives_alone(name: str) -> None:
    envs = monitor(100) if name in ("bank", "cusum", "bayes") else ProbeVectorEnv(100, **PROBE)
    if name == "bank at once":  # all onsets at sample 0
        envs = MonitorVectorEnv(30, **MONITOR | {"earliest_onset_s": 0.0, "mean_onset_s": 0.0})
    setup = envs.setup
    cases: dict[str, Callable[[], tuple[ThresholdPolicy, tuple[float, ...]]]] = {
        "bank": lambda: (BankPolicy(setup, 0.0), (0.5, 3.0, 30.0)),
        "bank at once": lambda: (BankPolicy(setup, 0.0), (0.5, 3.0)),
        "cusum": lambda: (RulePolicy(setup, Cusum(0.5, two_sided=True), threshold=0.0), (2.0, 8.0, 1e9)),
        "bayes": lambda: (BayesPolicy(setup, 0.0), (0.0, 0.8, 0.97)),
        "open loop": lambda: (
            OpenLoop(RatioTest(setup, 0.0), Bursts(5, 8, 3).actions(envs.options.n_steps)),
            (1.0, 4.0, 9.0),
        ),
        "on demand": lambda: (EventTriggeredProbing(ExpectedRewardTest(setup, 0.0), 0.05), (0.2, 0.8, 0.97)),
    }
    policy, thresholds = cases[name]()
    swept = sweep(envs, policy, thresholds, 7)
    for threshold, runs in zip(thresholds, swept, strict=True):
        policy.threshold = threshold
        alone = run_episodes(envs, policy, 7)
        np.testing.assert_allclose(runs.returns, alone.returns, atol=1e-6)
        for one, other in zip(runs[1:], alone[1:], strict=True):
            np.testing.assert_array_equal(one, other)


def test_random_takes_every_action_as_often() -> None:
    envs = ProbeVectorEnv(3000, **PROBE)
    policy = Random(envs.single_action_space, 1)
    policy.start(3000)
    counts = np.bincount(policy.act(envs.reset(seed=1)[0]), minlength=5)
    assert (abs(counts - 600.0) < 4.0 * np.sqrt(600.0)).all()


def test_bursts_move_where_they_say() -> None:
    actions = Bursts(start=2, period=6, length=3, half_period=1).actions(12)
    assert actions.tolist() == [0, 0, 1, 2, 1, 0, 0, 0, 1, 2, 1, 0]
    one_pulse = Bursts(start=1, period=10, length=4, half_period=4).actions(8)
    assert one_pulse.tolist() == [0, 1, 1, 1, 1, 0, 0, 0]
    with pytest.raises(ValueError, match="length must be from 1 to 3, got 4"):
        Bursts(0, 3, 4).actions(5)


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


def test_posterior_of_a_probed_motor_is_calibrated() -> None:
    """Among the moments at which it says 30 %, a fault has set in at 30 %."""
    envs = ProbeVectorEnv(1500, **PROBE)
    belief, schedule = ProbeBelief(envs.setup), Bursts(5, 8, 3).actions(envs.options.n_steps)
    _, info = envs.reset(seed=21)
    belief.start(1500)
    said, true = [], []
    for step, action in enumerate(schedule[:-1]):
        observations = envs.step(np.full(1500, action))[0]
        belief.update(observations)
        np.testing.assert_allclose(belief.quiet + belief.kinds.sum(axis=1), 1.0, atol=1e-9)
        if step % 5 == 4:
            said.append(1.0 - belief.quiet)
            onset = info["onset_sample"]
            true.append((onset >= 0) & (onset < (step + 1) * envs.options.samples_per_step))
    p, happened = np.concatenate(said), np.concatenate(true)
    for low, high in ((0.0, 0.02), (0.02, 0.1), (0.1, 0.5), (0.5, 0.9), (0.9, 1.01)):
        chosen = (p >= low) & (p < high)
        assert chosen.sum() > 50
        expected = p[chosen].mean()
        # moments of one episode are not independent: five of them may be alike
        error = np.sqrt(5.0 * expected * (1.0 - expected) / chosen.sum())
        assert abs(happened[chosen].mean() - expected) < 4.0 * error + 1e-3


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
    thresholds = (0.5, 0.8, 0.9, 0.95, 0.98)
    best = max(
        sweep(envs, BayesPolicy(envs.setup, 0.0), thresholds, 42), key=lambda runs: runs.returns.mean()
    )
    bound = bounds.upper_bound(envs.options)
    assert best.returns.mean() < bound + 2.0 * best.returns.std() / 20.0
    assert bound - 0.1 < best.returns.mean()  # and the bound is not an idle one
    assert bound < 1.0
    assert bound == pytest.approx(0.872541, abs=2e-4)  # as it was when the tables of the bounds were made


def test_posterior_stays_finite_when_a_fault_is_far_beyond_doubt() -> None:
    envs = monitor(100)
    policy = BayesPolicy(envs.setup, np.inf)
    observations, _ = envs.reset(seed=2)
    policy.start(100)
    for _ in range(envs.options.n_steps):
        value, _ = policy.judge(observations)
        assert not np.isnan(value).any()
        np.testing.assert_allclose(policy.quiet + policy.kinds.sum(axis=1), 1.0, atol=1e-9)
        observations = envs.step(np.zeros(100, dtype=np.int64))[0]


def test_what_a_policy_gets_that_knows_the_class_is_just_below_its_bound() -> None:
    classes = (FaultClass(weight=1.0), FaultClass(FaultKind.WINDING_CONTACT, 0.02))
    envs = ProbeVectorEnv(1000, **PROBE | {"recipe": replace(SMALL, classes=classes), "mean_onset_s": 0.03})
    policy = LookAhead(ExpectedRewardTest(envs.setup, 0.95), 0.0)
    mean, half_width = interval(run_episodes(envs, policy, 3).returns)
    asks = EventTriggeredProbing(ExpectedRewardTest(envs.setup, 0.95), 0.08)
    assert mean > run_episodes(envs, asks, 3).returns.mean()
    bound = bounds.upper_bound(envs.options)
    assert mean - half_width < bound < mean + half_width + 0.03
    # As they were when the tables were made: the bound, what a look shows, the worth of every offset after every other.
    assert bound == pytest.approx(0.9662982, abs=2e-6)
    [pair], [worths] = policy._pairs, policy._worths
    np.testing.assert_allclose(
        pair.looks.information[[0, 1, 2, 3, 4, 0, 3], [0, 1, 2, 3, 4, 3, 4]],
        [7.529858, 26775.58, 0.742006, 6.656316, 0.0342745, -6.721407, 0.463464],
        rtol=1e-4,
    )
    np.testing.assert_allclose(pair.looks.move[0, [0, 2, 3]], [0.613145, 0.0172118, 0.367820], rtol=1e-4)
    np.testing.assert_allclose(pair.looks.reach, [0.933005, 0.01227737], rtol=1e-4)
    np.testing.assert_allclose(
        worths[[0, 16, 48]][:, :, 1, [9, 40, 62], 60].reshape(3, 9),
        [
            [0.967524, 0.964573, 0.966939, 0.964444, 0.964191, 0.965115, 0.965377, 0.964175, 0.964791],
            [0.971269, 0.968126, 0.970504, 0.968451, 0.967476, 0.968460, 0.968615, 0.967167, 0.968167],
            [0.823465, 0.746130, 0.792630, 0.882033, 0.876649, 0.955013, 0.972810, 0.900738, 0.943166],
        ],
        atol=5e-6,
    )


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
    found = score(envs, runs)
    assert found.as_row() == pytest.approx(
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
    just = runs._replace(onset=np.array([0, 150, 200, -1, 500, 990, -1]))
    assert score(envs, just).late_share == 0.0
    never = runs._replace(onset=np.array([0, 150, 200, -1, 500, 1000, -1]))
    assert (score(envs, never).late_share, score(envs, never).detected_share) == (0.0, 2.0 / 3.0)
    assert joined([runs, just]).onset.tolist() == [*runs.onset, *just.onset]


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
    middle = len(LOG_ODDS) // 2
    np.testing.assert_allclose(LOG_ODDS[[0, middle, middle + 1, -1]], [-14.0, 0.0, 0.2, 14.0], atol=1e-12)
    assert declared_worth(options)[[0, middle, -1]] == pytest.approx([-5.0, -1.5, 2.0], abs=1e-4)
    assert silent_worth(options)[[0, middle, -1]] == pytest.approx([7.0, -2.0, -11.0], abs=1e-4)


def first_samples(recipe: Recipe, count: int) -> tuple[MonitorVectorEnv, FloatArray, FloatArray]:
    """A task whose faults come from the third sample on; currents for it, in the sensor's noise, from rest."""
    envs = MonitorVectorEnv(
        1,
        recipe=recipe,
        horizon_s=0.02,
        earliest_onset_s=2e-4,
        mean_onset_s=2e-3,
        observe=("measured_current",),
        **INSTANT,
    )
    off = np.random.default_rng(8).normal(size=count)
    off[count // 2 :] += signatures(envs.setup, count)[1][: count - count // 2]
    noise_a = recipe.sensor.current_noise_a
    observed = (off * noise_a + envs.setup.rest[0]) * float(np.asarray(recipe.motor.resistance_ohm)) / 12.0
    return envs, off, observed[:, None, None]


def test_the_posterior_is_bayes_rule_over_all_classes_and_onsets() -> None:
    """Sample by sample against a plain sum over every hypothesis; an onset shows from the sample after it on."""
    n, first = 40, 2
    envs, off, observed = first_samples(MEDIUM, n)
    shown = signatures(envs.setup, n)
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


def test_a_look_against_its_integral() -> None:
    """Log-odds move by N(+-I/2, I); between the places of the grid a value is linear in the probability."""
    value = PROBABILITY**2
    odds = np.linspace(-40.0, 40.0, 80_001)
    at = np.interp(1.0 / (1.0 + np.exp(-odds)), PROBABILITY, value)
    for information in (0.3, 4.0):
        found, spread = look_matrix(information) @ value, information**0.5
        for m in (40, 70, 77, 100):
            wanted = sum(
                share * (norm.pdf(odds, LOG_ODDS[m] + sign * information / 2.0, spread) * at).sum() * 1e-3
                for sign, share in ((1.0, PROBABILITY[m]), (-1.0, 1.0 - PROBABILITY[m]))
            )
            assert found[m] == pytest.approx(wanted, abs=2e-5)


def test_times_that_may_remain_after_an_onset() -> None:
    options = MonitorOptions()
    late, weights, remaining = bounds._remaining(options)  # by itself: in a bound its parts add up
    assert late == pytest.approx(np.exp(-0.19 / 0.05))
    np.testing.assert_allclose(weights, (1.0 - late) / 24.0)
    np.testing.assert_allclose(
        1.0 - np.exp(-(0.19 - remaining) / 0.05), weights.cumsum() - weights, atol=1e-12
    )


def test_the_bound_of_a_probe_takes_the_worst_shares(monkeypatch: pytest.MonkeyPatch) -> None:
    """Convex totals by the share of the false hints, lines between those that were tried."""
    tried = [0.0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.4, 0.7, 1.0]
    healthy = float(SMALL.class_probabilities[0])

    class Told:
        def __init__(self, _: Any, which: int) -> None:
            self.which = which

        def totals(self, seeming: Any) -> Any:
            np.testing.assert_allclose(seeming, healthy * np.array(tried))
            return self.which * (seeming / healthy) ** 2

    monkeypatch.setattr(bounds, "Pair", Told)
    recipe = replace(SMALL, classes=(SMALL.classes[0], *SMALL.classes[3:5]))
    healthy = float(recipe.class_probabilities[0])
    share = np.linspace(0.0, 1.0, 100_001)
    wanted = np.interp(share, tried, np.square(tried)) + np.interp(1.0 - share, tried, 2.0 * np.square(tried))
    assert bounds.upper_bound(ProbeOptions(recipe=recipe, **PROBED)) == pytest.approx(wanted.min(), abs=1e-3)


SENSED: dict[str, Any] = {
    "recipe": SENSOR,
    "growth_s": 0.1,
    "observe": ("innovation_current", "innovation_speed"),
}


def test_a_signature_is_what_a_fault_adds_to_the_innovations() -> None:
    """The same case draws the same noise whatever its class: what differs between a faulty and a healthy motor."""
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
