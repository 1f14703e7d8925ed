"""Thresholds keep their rate: per transient, in motors known and known up to tolerances, and as run lengths."""

import numpy as np
import pytest
from scipy.stats import binomtest, norm

from motor_env import (
    Channel,
    Cusum,
    Glr,
    KalmanFilter,
    ModelBank,
    MOfN,
    MotorParameters,
    Recipe,
    Rule,
    SensorParameters,
    ShiryaevRoberts,
    Sprt,
    Timing,
    TolerantFilter,
    WindowedNis,
    in_a_row,
    load_recipe,
    nis_rule,
)
from motor_env.detection.rules import recipe_thresholds, run_lengths
from motor_env.detection.rules.calibration import healthy_measurements
from motor_env.detection.rules.tolerant import second_order
from motor_env.motor.parameters import FloatArray

WANTED = 0.01
SEED = 2  # of the motors that are tested: not that of the calibration
EXACT: dict[str, MOfN | Cusum | ShiryaevRoberts | Sprt] = {
    "NIS": nis_rule(),
    "3 in a row": in_a_row(3),
    "3 of 5": MOfN(3, 5),
    "CUSUM 0.13": Cusum(0.13),
    "CUSUM 0.13, two-sided": Cusum(0.13, two_sided=True),
    "CUSUM 0.5": Cusum(0.5),
    "Shiryaev-Roberts 0.13": ShiryaevRoberts(0.13),
    "SPRT 0.13": Sprt(0.13),
    "SPRT 0.13, repeated": Sprt(0.13, restart=True),
}
RULES: dict[str, Rule] = {
    **EXACT,
    "NIS over 20": WindowedNis(20),
    "GLR": Glr(),
    "GLR, two-sided": Glr(two_sided=True),
    "bank 0.13, 0.32": ModelBank((0.13, 0.32)),
}


def holm(p_values: dict[str, float], level: float = 0.01) -> dict[str, float]:
    """Those that Holm's procedure (1979) rejects."""
    rejected: dict[str, float] = {}
    for rank, (name, p) in enumerate(sorted(p_values.items(), key=lambda item: item[1])):
        if p > level / (len(p_values) - rank):
            break
        rejected[name] = p
    return rejected


def false_alarms(recipe_name: str, timing: Timing, tested: int) -> dict[str, int]:
    """Alarms of each rule on healthy motors of a recipe, simulated thresholds from ten times as many others."""
    recipe = load_recipe(recipe_name, timing=timing)
    thresholds = recipe_thresholds(list(RULES.values()), recipe, WANTED, runs=10 * tested)
    tolerant, counts = TolerantFilter.from_recipe(recipe), dict.fromkeys(RULES, 0)
    for cases in np.array_split(np.arange(tested), max(1, tested // 500)):
        white = tolerant.white(healthy_measurements(recipe, SEED, cases))
        for (name, rule), threshold in zip(RULES.items(), thresholds, strict=True):
            counts[name] += int((rule.alarm_index(white, threshold) >= 0).sum())
    print(recipe_name, counts)  # noqa: T201  # the table of docs/rules.md: `pytest -m long -s`
    return counts


def check(counts: dict[str, int], tested: int) -> None:
    p_values = {name: binomtest(count, tested, WANTED).pvalue for name, count in counts.items()}
    assert not holm(p_values), counts


def test_thresholds_keep_one_per_cent_of_short_healthy_starts() -> None:
    check(false_alarms("bench", Timing(1_000.0, 0.1), 2_000), 2_000)


@pytest.mark.long
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("recipe_name", ["paper", "bench"])
def test_thresholds_keep_one_per_cent_of_healthy_motors(recipe_name: str) -> None:
    check(false_alarms(recipe_name, Timing(), 20_000), 20_000)


def check_run_lengths(arl0: float, tested: int, rules: dict[str, Rule]) -> None:
    """The mean run length is as wanted; where theory gives the law, so is the share of alarms within ARL0 samples."""
    p_values = {}
    for name, rule in rules.items():
        threshold = rule.threshold_for(arl0=arl0, runs=10 * tested).value
        lengths = run_lengths(rule, threshold, tested, seed=SEED)[:, 0]
        error = lengths.std() / np.sqrt(tested)
        p_values[name] = 2.0 * float(norm.sf(abs(lengths.mean() - arl0) / error))
        print(f"{name}: {lengths.mean():.1f} +- {error:.1f}")  # noqa: T201  # the table of docs/rules.md
        if name in EXACT:
            expected = EXACT[name].alarm_probability(threshold, int(arl0))
            count = int((lengths <= arl0).sum())
            p_values[f"{name}, share"] = binomtest(count, tested, expected).pvalue
    assert not holm(p_values), p_values


WITH_ARL0 = {name: rule for name, rule in RULES.items() if name != "SPRT 0.13"}
"""A test that ends once and for all in "healthy" has no run length."""


def test_run_lengths_of_two_hundred_are_kept() -> None:
    check_run_lengths(200.0, 1_000, WITH_ARL0)


@pytest.mark.long
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("arl0", [1_000.0, 10_000.0])
def test_average_run_lengths_are_kept(arl0: float) -> None:
    check_run_lengths(arl0, 20_000, WITH_ARL0)


@pytest.mark.long
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("shift", [1.0, 0.5, 0.13])
def test_delays_at_ten_thousand_are_near_the_matched_cusums(shift: float) -> None:
    """The GLR, which does not know the size, and a bank within 25 %; the CUSUM itself within 3 %, simulated."""
    matched = Cusum(shift)
    least = matched.average_run_length(matched.threshold_for(arl0=1e4).value, shift)
    bank = ModelBank((0.5 * shift, shift, 2.0 * shift))
    for rule, bar in ((matched, 1.03), (Glr(), 1.25), (bank, 1.25)):
        threshold = rule.threshold_for(arl0=1e4, runs=4_000).value
        lengths = run_lengths(rule, threshold, 4_000, seed=SEED, mean=shift)[:, 0]
        assert lengths.mean() < bar * least


def test_a_recipe_without_tolerances_gets_the_exact_threshold() -> None:
    recipe = load_recipe("paper")
    exact = Cusum(0.5).threshold_for(false_alarm_probability=WANTED, n_samples=recipe.timing.n_samples)
    assert Cusum(0.5).threshold_for(false_alarm_probability=WANTED, recipe=recipe) == exact


def test_a_recipe_with_tolerances_raises_the_threshold() -> None:
    recipe = load_recipe("bench", timing=Timing(1_000.0, 0.1))
    threshold = Sprt(0.3).threshold_for(false_alarm_probability=WANTED, recipe=recipe, runs=20_000)
    exact = Sprt(0.3).threshold_for(false_alarm_probability=WANTED, n_samples=100)
    assert threshold.standard_error > 0.0
    assert threshold.value > exact.value
    assert threshold.method == "simulated: 20000 healthy motors of bench"


def test_run_lengths_do_not_depend_on_the_other_runs_and_follow_the_mean() -> None:
    rule, levels = Cusum(1.0), [1.0, 3.0]
    many = run_lengths(rule, levels, 900, seed=3)
    np.testing.assert_array_equal(run_lengths(rule, levels, 5, seed=3), many[:5])
    assert (many[:, 0] <= many[:, 1]).all()
    shifted = run_lengths(rule, 3.0, 2_000, seed=3, mean=[0.0, 0.0, 50.0])[:, 0]
    assert shifted.max() == 3
    exact = rule.average_run_length(3.0)
    assert many[:, 1].mean() == pytest.approx(exact, abs=4.0 * many[:, 1].std() / 30.0)


def test_tolerances_are_taken_out_to_second_order(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of residuals that are exactly quadratic in the tolerances: r = c + G z + z'Hz / 2 with z standard normal."""
    recipe = load_recipe("bench", timing=Timing(1_000.0, 0.006))
    belief = KalmanFilter.from_parameters(recipe.motor, recipe.sensor, 1e-3)
    rng = np.random.default_rng(2)
    constant, slope, bend = (
        rng.standard_normal(6),
        rng.standard_normal((6, 5)),
        rng.standard_normal((6, 5, 5)),
    )
    bend += bend.swapaxes(1, 2)

    def innovations(
        recipe: Recipe, _: KalmanFilter, motors: MotorParameters, voltage_v: FloatArray
    ) -> FloatArray:
        fields = (
            "resistance_ohm",
            "torque_constant_n_m_per_a",
            "inertia_kg_m2",
            "viscous_friction_n_m_s_per_rad",
        )
        factors = [getattr(motors, name) / getattr(recipe.motor, name) for name in fields]
        z = (np.stack([voltage_v[:, 0] / 12.0, *factors], axis=1) - 1.0) / recipe.spread.std
        quadratic: FloatArray = constant + z @ slope.T + 0.5 * np.einsum("ni,kij,nj->nk", z, bend, z)
        return quadratic[..., None]

    monkeypatch.setattr("motor_env.detection.rules.tolerant.noise_free_innovations", innovations)
    mean, slopes = second_order(recipe, belief)
    np.testing.assert_allclose(mean[:, 0], constant + 0.5 * np.trace(bend, axis1=1, axis2=2), rtol=1e-9)
    covariance = slope @ slope.T + 0.5 * np.einsum("kij,mji->km", bend, bend)
    np.testing.assert_allclose(slopes[:, 0] @ slopes[:, 0].T, covariance, rtol=1e-8, atol=1e-8)
    # Directions of less than a hundredth of the noise are left out, and only those.
    left, sizes = np.linalg.qr(rng.standard_normal((6, 3)))[0], np.array([2.0, 0.01005, 0.00995])
    right = np.linalg.qr(rng.standard_normal((5, 3)))[0]
    monkeypatch.setattr(
        "motor_env.detection.rules.tolerant.second_order",
        lambda *_: (mean, ((left * sizes) @ right.T)[:, None]),
    )
    kept = TolerantFilter.from_recipe(recipe).whitener.slopes
    np.testing.assert_allclose(kept @ kept.T, (left[:, :2] * sizes[:2] ** 2) @ left[:, :2].T, atol=1e-12)


def test_the_tolerant_stream_gives_what_the_batch_gives() -> None:
    both = SensorParameters((Channel.CURRENT, Channel.SPEED), speed_noise_rad_s=2.0)
    recipe = load_recipe("bench", timing=Timing(1_000.0, 0.05), sensor=both)
    measurements = healthy_measurements(recipe, 3, np.arange(4)).astype(np.float64)
    measurements[1, 0, 20:25] = np.nan
    measurements[2, :, 30] = np.nan
    tolerant = TolerantFilter.from_recipe(recipe)
    white = tolerant.white(measurements)
    stream = tolerant.stream(4)
    streamed = np.stack([stream.update(measurements[..., k]) for k in range(50)], axis=1)
    np.testing.assert_allclose(streamed, white, rtol=1e-7, atol=1e-7)
    np.testing.assert_array_equal(np.isnan(white), np.isnan(np.moveaxis(measurements, 1, 2)))
    with pytest.raises(ValueError, match="has 50 samples, got one more"):
        stream.update(measurements[..., 0])


def test_bad_requests_for_a_recipe_are_refused() -> None:
    recipe = load_recipe("bench")
    with pytest.raises(ValueError, match="recipe goes with false_alarm_probability alone"):
        nis_rule().threshold_for(arl0=100.0, recipe=recipe)
    with pytest.raises(ValueError, match=r"runs must be >= 1000 to calibrate a probability of 0.01, got 50"):
        nis_rule().threshold_for(false_alarm_probability=0.01, recipe=recipe, runs=50)
