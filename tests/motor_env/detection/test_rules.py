"""Rules against theory and simulation: known values, thresholds that keep their rate, stream equals batch."""

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy.stats import binom, chi2

from motor_env import (
    Cusum,
    Glr,
    ModelBank,
    MOfN,
    Rule,
    ShiryaevRoberts,
    Sprt,
    WindowedNis,
    in_a_row,
    nis_rule,
)
from motor_env.detection.rules import run_lengths
from motor_env.detection.run_length import HitChain, TwoSided, cusum_chain
from motor_env.motor.parameters import FloatArray

# Reaches in: thresholds are drawn from a stream of their own; the tests draw the same numbers.
from motor_env.simulation.random_streams import Stream, normals

RULES: dict[str, Rule] = {
    "nis": nis_rule(),
    "in a row": in_a_row(3),
    "m of n": MOfN(3, 5),
    "cusum": Cusum(0.5),
    "two-sided cusum": Cusum(0.5, two_sided=True),
    "shiryaev-roberts": ShiryaevRoberts(0.5),
    "sprt": Sprt(0.3),
    "restarted sprt": Sprt(0.3, restart=True),
}
WINDOWED: dict[str, Rule] = {
    "summed nis": WindowedNis(10),
    "glr": Glr(2, 40),
    "two-sided glr": Glr(1, 30, two_sided=True),
    "glr of a signature": Glr(1, 25, signature=tuple(1.0 - np.exp(-np.arange(1, 21) / 6.0))),
    "bank": ModelBank((0.5, -0.5, 1.0)),
}


def test_known_run_lengths() -> None:
    assert HitChain(0.05, 3, 5).average_run_length() == pytest.approx(1608.44, abs=0.01)
    assert cusum_chain(0.5, 5.0).average_run_length() == pytest.approx(930.887, abs=1e-3)
    # Two-sided, k = 0.5, h = 4 and 5: tabled as 168 and 465 (Montgomery 2013, table 9.3).
    assert Cusum(1.0, two_sided=True).average_run_length(4.0) == pytest.approx(168.0, abs=0.5)
    assert Cusum(1.0, two_sided=True).average_run_length(5.0) == pytest.approx(465.0, abs=0.5)


@pytest.mark.parametrize(("shift", "delay"), [(1.0, 15.1), (0.5, 49.0), (0.13, 416.0)])
def test_the_matched_cusums_worst_case_delay_at_arl0_of_ten_thousand(shift: float, delay: float) -> None:
    rule = Cusum(shift)
    threshold = rule.threshold_for(arl0=1e4).value
    assert rule.average_run_length(threshold) == pytest.approx(1e4, rel=1e-6)
    assert rule.average_run_length(threshold, shift) == pytest.approx(delay, rel=0.004)


@given(p=st.floats(0.01, 0.9), k=st.integers(1, 8))
def test_k_in_a_row_has_fellers_run_length(p: float, k: int) -> None:
    expected = (1.0 - p**k) / (p**k * (1.0 - p))
    if expected < 1e9:
        assert HitChain(p, k, k).average_run_length() == pytest.approx(expected, rel=1e-6)


def test_the_chain_of_hits_counts_every_pattern() -> None:
    p, needed, among, length = 0.3, 2, 4, 10
    probability = 0.0
    for pattern in range(2**length):
        hits = [(pattern >> k) & 1 for k in range(length)]
        if any(sum(hits[max(0, k - among + 1) : k + 1]) >= needed for k in range(length)):
            probability += p ** sum(hits) * (1 - p) ** (length - sum(hits))
    assert HitChain(p, needed, among).alarm_probability(length) == pytest.approx(probability, abs=1e-12)


def test_alarms_sample_by_sample_and_by_doubling_agree() -> None:
    chain = cusum_chain(0.25, 6.0)
    pmf = chain.alarm_pmf(60_000)
    assert pmf[:777].sum() == pytest.approx(chain.alarm_probability(777), abs=1e-12)
    assert pmf @ np.arange(1, 60_001) == pytest.approx(chain.average_run_length(), rel=1e-6)


def test_two_sided_alarms_match_its_run_length() -> None:
    chain = cusum_chain(0.5, 3.0)
    mean = TwoSided(chain, chain).alarm_pmf(4000) @ np.arange(1, 4001)
    assert mean == pytest.approx(Cusum(1.0, two_sided=True).average_run_length(3.0), rel=1e-6)


@pytest.mark.parametrize("name", RULES)
def test_thresholds_keep_their_rate_in_a_transient(name: str) -> None:
    rule = RULES[name]
    threshold = rule.threshold_for(false_alarm_probability=0.02, n_samples=200)
    assert threshold.standard_error == 0.0
    noise = np.random.default_rng(11).standard_normal((10_000, 200, 1))
    alarms = int((rule.alarm_index(noise, threshold) >= 0).sum())
    level = 0.01 / len(RULES)
    assert binom.ppf(level / 2, 10_000, 0.02) <= alarms <= binom.ppf(1 - level / 2, 10_000, 0.02)


@pytest.mark.parametrize("name", ["m of n", "cusum", "two-sided cusum", "shiryaev-roberts", "restarted sprt"])
def test_delays_are_those_of_simulated_runs(name: str) -> None:
    rule = RULES[name]
    threshold = rule.threshold_for(arl0=300.0).value
    lengths = run_lengths(rule, threshold, 2_000, seed=8, mean=0.7)[:, 0]
    exact = rule.average_run_length(threshold, 0.7)
    assert lengths.mean() == pytest.approx(exact, abs=4.0 * lengths.std() / np.sqrt(2_000.0))


@pytest.mark.parametrize("name", ["nis", "m of n"])
def test_thresholds_count_the_channels(name: str) -> None:
    rule = RULES[name]
    threshold = rule.threshold_for(false_alarm_probability=0.05, n_samples=100, n_channels=2)
    noise = np.random.default_rng(12).standard_normal((5000, 100, 2))
    alarms = int((rule.alarm_index(noise, threshold) >= 0).sum())
    assert binom.ppf(5e-4, 5000, 0.05) <= alarms <= binom.ppf(1 - 5e-4, 5000, 0.05)


@pytest.mark.parametrize("name", [*RULES, *WINDOWED])
def test_stream_gives_what_the_batch_gives(name: str) -> None:
    rule, rounding = (RULES | WINDOWED)[name], 1e-9 if name in WINDOWED else 0.0
    values = np.random.default_rng(3).standard_normal((4, 60, 1))
    values[1, 20:25] = np.nan
    stream = rule.stream(n_streams=4)
    streamed = np.stack([stream.update(values[:, k]) for k in range(60)], axis=1)
    np.testing.assert_allclose(streamed, rule.statistic(values), rtol=rounding, atol=rounding)
    assert not np.isnan(streamed).any()
    stream.reset(np.array([True, False, False, False]))
    again = stream.update(values[:, 0])
    assert again[0] == streamed[0, 0]
    went_on = rule.statistic(np.concatenate([values, values[:, :1]], axis=1))[:, -1]
    np.testing.assert_allclose(again[1:], went_on[1:], rtol=rounding, atol=rounding)
    stream.reset()
    np.testing.assert_array_equal(stream.update(values[:, 0]), streamed[:, 0])


def test_bad_requests_are_refused_in_one_sentence() -> None:
    with pytest.raises(ValueError, match="give one of arl0 and false_alarm_probability, got none"):
        nis_rule().threshold_for()
    with pytest.raises(ValueError, match="got both"):
        nis_rule().threshold_for(arl0=100.0, false_alarm_probability=0.1, n_samples=3)
    with pytest.raises(ValueError, match="needs the transient's n_samples"):
        nis_rule().threshold_for(false_alarm_probability=0.1)
    with pytest.raises(ValueError, match="arl0 needs restart=True"):
        Sprt(0.3).threshold_for(arl0=100.0)
    with pytest.raises(ValueError, match="1 <= M <= N"):
        MOfN(4, 3)
    with pytest.raises(ValueError, match="1 <= M <= N <= 14, got 1 and 15"):
        MOfN(1, 15)
    with pytest.raises(ValueError, match="window must be a whole number in 1 .. 1000000, got 0"):
        WindowedNis(0)
    with pytest.raises(ValueError, match="1 <= shortest <= longest, got 5 and 4"):
        Glr(5, 4)
    with pytest.raises(ValueError, match="shift must be >= 1e-06"):
        Cusum(0.0)
    with pytest.raises(ValueError, match="whitened must have shape"):
        Cusum(1.0).statistic(np.zeros(10))


def test_statistics_are_their_definitions() -> None:
    """Sums and products over all onsets and windows, of a record of two channels with missing values."""
    values = np.random.default_rng(6).standard_normal((30, 2)) + 0.3
    values[4, 0] = values[9] = values[17, 1] = np.nan
    squares = np.nansum(np.square(values), axis=1)
    first = np.nan_to_num(values[:, 0])
    seen = ~np.isnan(values[:, 0])
    padded = np.concatenate([np.zeros(7), squares])
    windows = np.stack([padded[k + 1 : k + 8] for k in range(30)])
    np.testing.assert_allclose(WindowedNis(7).statistic(values), windows.sum(axis=1), rtol=1e-12)
    np.testing.assert_allclose(WindowedNis(1).statistic(values), squares, atol=1e-12)
    np.testing.assert_allclose(MOfN(3, 7).statistic(values), np.sort(windows, axis=1)[:, -3], rtol=1e-12)
    np.testing.assert_allclose(nis_rule().statistic(values), squares, rtol=1e-12)
    ratios = {d: np.exp(seen * (d * first - 0.5 * d * d)) for d in (0.5, -0.8)}
    odds = {
        d: np.array([sum(seen[m] * np.prod(ratio[m : k + 1]) for m in range(k + 1)) for k in range(30)])
        for d, ratio in ratios.items()
    }
    found = ShiryaevRoberts(0.5).statistic(values)
    np.testing.assert_allclose(found, np.log(odds[0.5]), rtol=1e-12)
    found = ModelBank((0.5, -0.8)).statistic(values)
    np.testing.assert_allclose(found, np.log(0.5 * odds[0.5] + 0.5 * odds[-0.8]), rtol=1e-12)
    for restart in (True, False):
        total, silent, expected = 0.0, False, []
        for k in range(30):
            total += 0.6 * first[k] - 0.18 * seen[k]
            if total <= -0.9:
                total, silent = 0.0, not restart
            expected.append(-np.inf if silent else total)
        np.testing.assert_allclose(Sprt(0.6, -0.9, restart).statistic(values), expected, rtol=1e-12)
        assert restart or silent
    up, down = 0.0, 0.0
    for k, got in enumerate(Cusum(0.5, two_sided=True).statistic(values)):
        up, down = (max(0.0, s + sign * first[k] - 0.25 * seen[k]) for s, sign in ((up, 1.0), (down, -1.0)))
        assert got == pytest.approx(max(up, down), abs=1e-12)


def test_ages_of_the_glr_lie_within_fifteen_per_cent_of_each_other() -> None:
    """A grid of ten steps reaches as far as ten of 15 %, and a little further it has one more."""
    reach = 10_000.0 * 1.15**10
    assert len(Glr(10_000, int(reach)).ages) == 11
    assert len(Glr(10_000, int(reach) + 10).ages) == 12
    ages = Glr().ages
    assert (ages[0], ages[-1], len(ages)) == (1, 1000, 43)


def noise_of_runs(runs: int, blocks: int, n_channels: int, seed: int) -> FloatArray:
    """Run n's block b is case n + 2^32 b of the stream of calibrations."""
    cases = np.arange(runs)
    parts = [normals(seed, Stream.CALIBRATION, cases + 2**32 * b, 500 * n_channels) for b in range(blocks)]
    return np.concatenate(parts, axis=1).reshape(runs, 500 * blocks, n_channels)


def test_simulated_runs_are_passages_of_the_statistic() -> None:
    """Run by run, over several blocks of samples, with a mean that changes in the third."""
    mean = np.where(np.arange(1200) < 1100, 0.0, 1.5)
    noise = noise_of_runs(40, 4, 2, 7)
    noise += np.concatenate([mean, np.full(800, 1.5)])[:, None]
    rule, levels = WindowedNis(20), [60.0, 75.0, 90.0]
    lengths = run_lengths(rule, levels, 40, n_channels=2, seed=7, mean=mean)
    statistic = rule.statistic(noise)
    for column, level in zip(lengths.T, levels, strict=True):
        np.testing.assert_array_equal(column, (statistic > level).argmax(axis=1) + 1)
    assert lengths.min() < 500 < 1100 < np.median(lengths)


def test_a_simulated_threshold_is_an_order_statistic() -> None:
    """As many of the calibrating runs alarm as the probability says; the error is half the way between its own ends."""
    rule, runs = WindowedNis(10), 1000
    found = rule.threshold_for(false_alarm_probability=0.05, n_samples=100, runs=runs)
    noise = normals(20_101, Stream.CALIBRATION, np.arange(runs), 100)[..., None]
    largest = np.sort(rule.statistic(noise).max(axis=1))
    assert (largest > found.value).sum() == 49
    assert found.value in largest
    spread = np.sqrt(0.05 * 0.95 / runs)
    below, above = (largest[int(np.ceil((runs - 1) * (0.95 + sign * spread)))] for sign in (-1.0, 1.0))
    assert found.standard_error == pytest.approx(0.5 * (above - below))
    assert found.value == pytest.approx(27.76592788, rel=1e-6)  # a threshold is a number: it never moves
    with pytest.raises(ValueError, match=r"runs must be >= 200 to calibrate a probability of 0\.05, got 199"):
        rule.threshold_for(false_alarm_probability=0.05, n_samples=100, runs=199)


@pytest.mark.parametrize(("arl0", "runs"), [(1e3, 10_000), (1e5, 3_000), (1e6, 1_000)])
def test_run_lengths_are_calibrated_on_three_hundred_million_samples(
    monkeypatch: pytest.MonkeyPatch, arl0: float, runs: int
) -> None:
    """But on a thousand runs at least, and ten thousand at most."""
    asked: list[int] = []
    place = "motor_env.detection.rules.calibration._for_run_length"
    monkeypatch.setattr(place, lambda *given: asked.append(given[2]))
    Glr().threshold_for(arl0=arl0)
    assert asked == [runs]


@pytest.mark.parametrize("seed", [3, 4, 7])
def test_a_simulated_run_length_is_met_wherever_the_pilot_looked(seed: int) -> None:
    """Few runs: with the second seed the pilot's thresholds are all too high, with the third all too low."""
    rule = WindowedNis(3)
    found = rule.threshold_for(arl0=30.0, runs=8, seed=seed)
    lengths = run_lengths(rule, found.value, 8, seed=seed)
    assert lengths.mean() == pytest.approx(30.0, rel=0.11)


def test_the_error_of_a_simulated_run_length_is_that_of_its_mean() -> None:
    rule = WindowedNis(10)
    found = rule.threshold_for(arl0=100.0, runs=500)
    levels = found.value + np.array([-0.4, 0.0, 0.4])
    lengths = run_lengths(rule, levels, 500)
    mean = lengths.mean(axis=0)
    assert mean[1] == pytest.approx(100.0, rel=0.02)
    slope = np.log(mean[2] / mean[0]) / 0.8
    expected = lengths[:, 1].std() / mean[1] / np.sqrt(500.0) / slope
    assert found.standard_error == pytest.approx(expected, rel=0.15)
    assert rule.average_run_length(15.0) == run_lengths(rule, 15.0, 2000).mean()


def test_simulation_finds_the_threshold_that_the_integral_equation_gives() -> None:
    exact = ShiryaevRoberts(1.0).threshold_for(arl0=300.0).value
    found = ModelBank((1.0,)).threshold_for(arl0=300.0, runs=2000)
    assert found.value == pytest.approx(exact, abs=4.0 * found.standard_error)
    assert found.standard_error < 0.05


@pytest.mark.parametrize("two_sided", [False, True])
@pytest.mark.parametrize("signature", [None, (0.2, 0.6, 1.0)])
def test_glr_scans_every_onset_of_its_grid(signature: tuple[float, ...] | None, two_sided: bool) -> None:
    """Against sums over every age at every sample, over more samples than the rule holds at a time."""
    values = np.random.default_rng(9).standard_normal(1200)
    rule = Glr(3, 30, signature=signature, two_sided=two_sided)
    shape = np.ones(30) if signature is None else np.concatenate([[0.2, 0.6], np.ones(28)])
    found = rule.statistic(values[:, None])
    assert (found[:2] == -np.inf).all()
    for k in (2, 3, 40, 600, 1199):
        along = {
            m: shape[:m] @ values[k + 1 - m : k + 1] / np.linalg.norm(shape[:m])
            for m in rule.ages.tolist()
            if m <= k + 1
        }
        expected = max((abs(x) if two_sided else x) * abs(x) + 2.0 * np.log(m) for m, x in along.items())
        assert found[k] == pytest.approx(expected, rel=1e-9)


def test_bank_posterior_is_bayes_rule_over_all_onsets() -> None:
    hazard, shifts = 0.02, (0.7, -1.2)
    values = np.random.default_rng(2).standard_normal(15) + 0.4
    values[[4, 9]] = np.nan  # not measured: tells nothing
    weights = {(-1, -1): (1.0 - hazard) ** 15}
    for j, shift in enumerate(shifts):
        for onset in range(15):
            likelihood = np.exp(np.nansum(shift * values[onset:] - 0.5 * shift**2))
            weights[j, onset] = hazard / 2 * (1.0 - hazard) ** onset * likelihood
    total = sum(weights.values())
    expected = [sum(w for (model, _), w in weights.items() if model == j) / total for j in (-1, 0, 1)]
    for wrong in (0.0, 1.0):
        with pytest.raises(ValueError, match=f"hazard must be > 0 and < 1, got {wrong:g}"):
            ModelBank(shifts).probabilities(values[:, None], wrong)
    found = ModelBank(shifts).probabilities(values[:, None], hazard)[-1]
    np.testing.assert_allclose(found, expected, rtol=1e-10)


def test_rare_alarms_are_exact() -> None:
    # 1 - (1 - p)^n = 1e-14 for n = 1000: p = 1e-17
    rare = nis_rule().threshold_for(false_alarm_probability=1e-14, n_samples=1000)
    assert rare.value == pytest.approx(chi2.isf(1e-17, 1), rel=1e-9)
    assert nis_rule().threshold_for(arl0=1e15).value == pytest.approx(chi2.isf(1e-15, 1), rel=1e-9)
    rule = Cusum(1.0)
    value = rule.threshold_for(false_alarm_probability=1e-13, n_samples=1000).value
    # Far out an alarm's rate falls by exp(-d) for each unit of the threshold (Lorden 1971).
    ratio = rule.alarm_probability(value, 1000) / rule.alarm_probability(value + 1.0, 1000)
    assert ratio == pytest.approx(np.e, rel=0.01)


@pytest.mark.parametrize(
    "rule",
    [Cusum(1.0), Cusum(1.0, two_sided=True), Cusum(0.3), ShiryaevRoberts(1.0), Sprt(1.0, restart=True)],
)
def test_long_run_lengths_are_exact(rule: Cusum | ShiryaevRoberts | Sprt) -> None:
    # Far out the run length grows by exp(d) for each unit of a sum's threshold, by e for each of a logarithm's.
    rate = rule.shift if isinstance(rule, Cusum) else 1.0
    low, middle, high = (rule.threshold_for(arl0=arl0).value for arl0 in (1e12, 1e15, 1e24))
    assert rate * (middle - low) == pytest.approx(3.0 * np.log(10.0), rel=1e-7)
    assert rate * (high - middle) == pytest.approx(9.0 * np.log(10.0), rel=1e-7)


def test_what_a_rule_cannot_have_is_refused() -> None:
    with pytest.raises(ValueError, match="even at its lowest threshold this rule gives fewer false alarms"):
        Cusum(20.0).threshold_for(arl0=1e6)
    for rule in (Cusum(1.0), nis_rule()):
        with pytest.raises(ValueError, match="arl0 must be > 1 and <="):
            rule.threshold_for(arl0=np.inf)
        with pytest.raises(ValueError, match="false_alarm_probability must be >="):
            rule.threshold_for(false_alarm_probability=1e-310, n_samples=10)
    with pytest.raises(ValueError, match="741 standard deviations high: too high for the equation"):
        Cusum(0.01).average_run_length(741.0)


def test_simulations_without_end_are_refused() -> None:
    with pytest.raises(ValueError, match=r"arl0 1e\+09 needs 1e\+12 simulated samples for 1000 runs"):
        Glr().threshold_for(arl0=1e9)
    message = r"n_samples 1000000 needs 1e\+11 simulated samples for 100000 runs, more than 1e\+10"
    with pytest.raises(ValueError, match=message):
        Glr().threshold_for(false_alarm_probability=0.01, n_samples=1_000_000)


def test_long_windows_are_quick() -> None:
    rule = MOfN(7, 14)
    assert rule.average_run_length(rule.threshold_for(arl0=1e4).value) == pytest.approx(1e4, rel=1e-6)
