"""What estimators compute, in closed form on made cases: thresholds, shares, temperatures, coordinates, schedules."""

import math
from dataclasses import replace
from itertools import islice
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.special import expit, softmax
from scipy.stats import norm
from sklearn.linear_model import LogisticRegression
from torch import nn

from motor_classifiers import (
    PerceptronClassifier,
    PosteriorNetwork,
    ResidualProjection,
    ThresholdConfirmationClassifier,
    load_model,
)
from motor_classifiers.estimators.confirmation import class_filter
from motor_classifiers.estimators.features import affine_map, signal_family, whitened_residual
from motor_classifiers.estimators.networks import severity_density
from motor_classifiers.estimators.networks.epoch_classifier import perceptron
from motor_classifiers.estimators.networks.posterior import Posterior, batch_schedule, total_cases
from motor_classifiers.estimators.networks.severity_density import severity_priors, severity_recipe
from motor_classifiers.estimators.networks.signal_space import SignalSpace, fresh_cases, with_more_noise
from motor_classifiers.estimators.reference_starts import referenced_starts, split_starts
from motor_classifiers.estimators.threshold_rule import (
    LEAST_STATISTIC,
    UNLIMITED,
    ThresholdRule,
    window_features,
)

# Reaches in: only a command names the network that is shipped; its layers are run by hand.
from motor_classifiers.model_files.persistence import PRETRAINED
from motor_datasets import generate_arrays
from motor_env import FaultKind, Timing, load_recipe
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.recipes import FaultClass

RECIPE = load_recipe("bench", timing=Timing(1_000.0, 0.1))


WINDOWS = np.array([[0, 1], [1, 2], [2, 4]])


def rule(**changes: Any) -> ThresholdRule:
    """Three classes, the healthy one in the middle; windows of one and two samples."""
    plain: dict[str, Any] = {
        "healthy_index": 1, "with_spread": False, "windows": WINDOWS, "bank_windows": WINDOWS,
        "needed": 1, "among": 1, "healthy_center": np.zeros((3, 1)), "healthy_scale": np.array([[1.0], [2.0], [4.0]]),
        "lower": np.full((3, 1), -2.0), "upper": np.full((3, 1), 2.0), "own_scale": np.array([[1.0], [2.0], [2.0]]),
        "prior": np.array([0.25, 0.5, 0.25]), "temperature": 2.0, "slope": 3.0, "intercept": -0.5,
    }  # fmt: skip
    return ThresholdRule(**plain | changes)


def residuals(*of_class: list[float]) -> FloatArray:
    """One case of four samples, its residual under each class: shape (n_classes, 1, 4, 1)."""
    return np.array(of_class, dtype=np.float64)[:, None, :, None]


def test_windows_are_sums_over_roots() -> None:
    white = np.array([[1.0, 2.0, 3.0, 5.0, 1.0, 1.0]])[..., None]
    got = window_features(white, np.array([[0, 2], [2, 6]]), True)
    mean = np.array([3.0, 10.0]) / np.sqrt([2.0, 4.0])
    spread = [
        (np.square(part - part.mean()).sum() - (len(part) - 1)) / np.sqrt(2.0 * (len(part) - 1))
        for part in (white[0, :2, 0], white[0, 2:, 0])
    ]
    np.testing.assert_allclose(got[0], np.column_stack([mean, spread]))
    overlapping = window_features(white, np.array([[3, 5], [2, 4], [0, 2]]), False)[0, :, 0]
    np.testing.assert_allclose(overlapping, np.array([6.0, 8.0, 3.0]) / np.sqrt(2.0))


@pytest.mark.parametrize(
    ("needed", "among", "statistic", "alarm"),
    [
        (1, 1, [1.0, 3.0, 2.5], 1),
        (1, 2, [3.0, 3.0], 1),
        (2, 2, [1.0, 2.5], 3),
        (2, 3, [2.5], 3),
        (3, 3, [1.0], -1),
    ],
)
def test_m_of_n_windows_beyond_the_threshold_confirm(
    needed: int, among: int, statistic: list[float], alarm: int
) -> None:
    """Distances in the windows are 1, 3 and 2.5; the thresholds are 2."""
    white = residuals([0.0] * 4, [-1.0, 6.0, 10.0 / np.sqrt(2.0), 10.0 / np.sqrt(2.0)], [0.0] * 4)
    own = rule(needed=needed, among=among)
    height = np.array(statistic) / 2.0
    np.testing.assert_allclose(own.statistic(window_features(white[1], own.windows, False))[0], height)
    got = own.decide(white)
    assert got.alarm_index.tolist() == [alarm]
    assert got.statistic == pytest.approx([max(statistic) / 2.0])
    assert got.class_index.tolist() == [1 if alarm < 0 else 0]  # both faults fit as well: the first one


def test_probabilities_are_platts_times_the_shares_of_the_bank() -> None:
    """Likelihoods are those of standard normal windows, divided by the temperature, times the priors."""
    white = residuals([2.0, 0.0, 0.0, 0.0], [0.0, 3.0, 0.0, 0.0], [0.0, 4.0, 2.0, 2.0])
    own = rule(prior=np.array([0.125, 0.5, 0.375]))
    features = np.stack([window_features(one, own.windows, False) for one in white])
    log_likelihood = np.array([-0.5 * 4.0, -0.5 * (4.0 + 8.0 / 4.0)])
    weights = np.exp(log_likelihood / 2.0) * [0.125, 0.375]
    share = weights / weights.sum()
    np.testing.assert_allclose(own.fault_shares(features)[0], [share[0], 0.0, share[1]])
    faulty = expit(-0.5 + 3.0 * np.log(1.5 / 2.0))  # what goes furthest is 3 of 4
    np.testing.assert_allclose(
        own.decide(white).probabilities[0], [share[0] * faulty, 1.0 - faulty, share[1] * faulty]
    )
    assert own.decide(white).class_index.tolist() == [1]


def test_the_temperature_is_the_best_of_its_grid_and_platt_is_logistic_regression() -> None:
    rng = np.random.default_rng(0)
    labels = rng.integers(3, size=200)
    white = rng.normal(size=(3, 200, 4, 1)) + 1.5 * (np.arange(3)[:, None] != labels)[..., None, None]
    own = rule(temperature=1.0)
    got = own.calibrated(white, labels)
    features = np.stack([window_features(one, own.windows, False) for one in white])
    faulty = labels != 1
    log_likelihood = -0.5 * np.square(features / own.own_scale).sum(axis=(2, 3)).T[faulty][:, [0, 2]]
    columns = np.where(labels[faulty] == 0, 0, 1)

    def loss(temperature: float) -> float:
        share = softmax(log_likelihood / temperature + np.log([0.25, 0.25]), axis=1)
        return float(-np.log(share[np.arange(len(columns)), columns]).mean())

    grid = np.geomspace(0.5, 200.0, 40)
    assert got.temperature == grid[np.argmin([loss(t) for t in grid])]
    assert 0.6 < got.temperature < 100.0
    heights = np.maximum(np.abs(features[1] / own.healthy_scale).max(axis=(1, 2)) / 2.0, LEAST_STATISTIC)
    design = np.column_stack([np.ones(200), np.log(heights)])
    fitted = (
        LogisticRegression(C=100.0, fit_intercept=False, tol=1e-8, max_iter=1000).fit(design, faulty).coef_[0]
    )
    assert (got.intercept, got.slope) == pytest.approx(tuple(fitted), abs=1e-3)


def test_each_side_of_each_window_has_its_own_threshold() -> None:
    """Below the center the first window has 1, above it 4; the second has none below, 0.5 above."""
    own = rule(
        windows=WINDOWS[:2], healthy_center=np.array([[1.0], [0.0]]), healthy_scale=np.ones((2, 1)),
        lower=np.array([[-1.0], [-UNLIMITED]]), upper=np.array([[4.0], [0.5]]),
    )  # fmt: skip
    features = np.array([[-0.5, -90.0], [4.0, 0.4], [1.0, 0.51], [5.5, 0.0]])[..., None]
    height = [[1.5, 90.0 / UNLIMITED], [0.75, 0.8], [0.0, 1.02], [1.125, 0.0]]
    np.testing.assert_allclose(own.statistic(features), height)
    assert (own.statistic(features) > 1.0).any(axis=1).tolist() == [True, False, True, True]


def _tuned(height: list[float], healthy: list[bool], rate: float | None = None) -> ThresholdRule:
    """Two classes, one sample a case, which is the statistic but for the healthy cases' center and scale."""
    white = np.zeros((2, len(height), 1, 1))
    white[0, :, 0, 0] = height
    return ThresholdRule.tune(white, np.where(healthy, 0, 1), 0, false_alarm_rate=rate)


def test_the_threshold_is_between_the_cases_that_it_parts() -> None:
    """Most right decisions: below 5 four of four are healthy, above it three of four are not."""
    height = [-4.0, -3.0, -2.0, -1.0, 6.0, 7.0, 8.0, 9.0, 0.0]
    healthy = [True, True, True, True, False, False, True, False, True]
    got = _tuned(height, healthy)
    center = -1.5
    scale = np.sqrt(np.square(np.array([-4.0, -3.0, -2.0, -1.0, 8.0, 0.0]) - center).mean())
    assert got.healthy_center.tolist() == [[center]]
    assert got.healthy_scale.tolist() == [[pytest.approx(scale)]]
    # One threshold for both sides: 2.5 below is healthy, 7.5 above is not.
    assert got.upper[0, 0] == pytest.approx(0.5 * (2.5 + 7.5) / scale)
    assert got.lower[0, 0] == -got.upper[0, 0]
    assert got.prior.tolist() == pytest.approx([6.0 / 9.0, 3.0 / 9.0])
    assert (got.needed, got.among, got.windows.tolist()) == (1, 1, [[0, 1]])


def test_a_side_on_which_no_fault_is_has_no_threshold() -> None:
    """Healthy ones reach -9; a fault lies above 1.5: one threshold for both sides errs in three of nine cases."""
    height = [-9.0, -8.0, -7.0, 0.0, 1.0, 1.0, 1.0, 2.0, 3.0, 4.0]
    got = _tuned(height, [True] * 7 + [False] * 3)
    assert got.lower.tolist() == [[-UNLIMITED]]
    assert got.upper[0, 0] * got.healthy_scale[0, 0] + got.healthy_center[0, 0] == pytest.approx(1.5)


def test_windows_need_not_cover_the_start() -> None:
    """One fault lowers the first of ten samples, one raises the last eight; tolerances go the other way."""
    rng = np.random.default_rng(0)
    labels = np.repeat([0, 1, 2], 300)
    white = rng.normal(size=(3, 900, 10, 1))
    tolerance = rng.exponential(10.0, (900, 2))
    white[0, :, 0, 0] += np.where(labels == 1, -8.0, tolerance[:, 0])
    white[0, :, 2:, 0] += np.where(labels == 2, 2.0, -tolerance[:, 1])[:, None]
    white[1, labels == 2] += 9.0
    white[2, labels == 1] += 9.0  # the bank is always right
    got = ThresholdRule.tune(white, labels, 0)
    (first, end), (late, last) = got.windows.tolist()
    assert (first, end) == (0, 1)
    assert late > 0
    assert (got.upper[0, 0], got.lower[1, 0]) == (UNLIMITED, -UNLIMITED)
    decided = got.decide(white)
    assert (decided.class_index == labels).mean() > 0.97
    assert set(decided.alarm_index.tolist()) == {-1, 0, last - 1}


@pytest.mark.parametrize(("rate", "expected"), [(0.25, 8.0), (0.2, 8.0), (0.5, 5.0), (0.1, 9.0), (0.3, 7.0)])
def test_the_factor_of_a_rate_is_an_order_statistic_of_cases_not_seen(rate: float, expected: float) -> None:
    """Of nine held cases 1 .. 9 the ceil(10 (1 - rate))-th: a tenth one exceeds it with at most that chance."""
    height = [*np.linspace(-5.0, 5.0, 9).tolist(), *np.arange(1.0, 10.0).tolist(), 20.0]
    got = _tuned(height, [True] * 18 + [False], rate)
    assert got.healthy_center.tolist() == [[0.0]]
    assert got.upper[0, 0] * got.healthy_scale[0, 0] == pytest.approx(expected)
    with pytest.raises(ValueError, match=r"needs at least 20 healthy training cases, got 18"):
        _tuned(height, [True] * 18 + [False], 0.091)


def test_several_thresholds_keep_the_rate_of_false_alarms() -> None:
    """Over 300 tunings of 60 healthy cases a new one alarms in at most a tenth, and hardly less often."""
    rng = np.random.default_rng(1)
    labels = np.r_[np.zeros(60, dtype=np.int64), np.ones(60, dtype=np.int64)]
    alarms = []
    for _ in range(300):
        white = rng.normal(size=(2, 120, 20, 1))
        white[0, 60:, :4, 0] -= 1.0
        white[0, 60:, 12:, 0] += 1.0
        tuned = ThresholdRule.tune(white, labels, 0, false_alarm_rate=0.1)
        alarms.append((tuned.largest(rng.normal(size=(200, 20, 1))) > 1.0).mean())
    error = np.std(alarms) / np.sqrt(len(alarms))
    assert 0.1 - 1.0 / 31.0 - 3.0 * error < np.mean(alarms) < 0.1 + 3.0 * error


def test_scales_are_root_mean_squares_under_the_own_class() -> None:
    white = np.zeros((2, 4, 1, 1))
    white[0, :, 0, 0] = [1.0, 3.0, 50.0, 60.0]
    white[1, :, 0, 0] = [7.0, 9.0, 2.0, 4.0]
    got = ThresholdRule.tune(white, np.array([0, 0, 1, 1]), 0)
    assert (got.healthy_center[0, 0], got.healthy_scale[0, 0]) == (2.0, 1.0)
    assert got.own_scale[0, 0] == pytest.approx(np.sqrt((1.0 + 9.0 + 4.0 + 16.0) / 4))


def test_decision_and_largest_probability_are_swapped_where_they_disagree(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    X = np.random.default_rng(0).normal(size=(40, 3)) + np.repeat([[0.0], [4.0]], 20, axis=0)
    model = ThresholdConfirmationClassifier().fit(X, np.repeat(["healthy", "worn"], 20))
    graded = np.array([[0.7, 0.3], [0.2, 0.8], [0.4, 0.6]])
    decided = model.decide(X[:3])._replace(probabilities=graded, class_index=np.array([1, 1, 0]))
    monkeypatch.setattr(ThresholdConfirmationClassifier, "decide", lambda self, X: decided)
    np.testing.assert_allclose(model.predict_proba(X[:3]), [[0.3, 0.7], [0.2, 0.8], [0.6, 0.4]])


def test_the_filter_of_a_louder_class_expects_more_noise() -> None:
    loud = class_filter(RECIPE, FaultClass(FaultKind.NOISE, 3.0))
    quiet = class_filter(RECIPE, FaultClass())
    np.testing.assert_allclose(loud.measurement_covariance, 4.0 * quiet.measurement_covariance)


def test_directions_are_the_leading_ones_of_the_familys_residuals() -> None:
    X = generate_arrays(RECIPE, 3, 20).X.astype(np.float64)
    got = ResidualProjection(RECIPE, 4, n_draws=300).fit(X)
    family = signal_family(RECIPE, 300)
    eigenvalues, vectors = np.linalg.eigh(family.T @ family)
    leading = vectors[:, ::-1][:, :4]
    expected = whitened_residual(RECIPE, X) @ leading
    np.testing.assert_allclose(np.abs(got.transform(X)), np.abs(expected), rtol=1e-5, atol=1e-6)
    assert eigenvalues[-1] > eigenvalues[-2]
    twice = affine_map(RECIPE, lambda measured: 2.0 * measured[:, 0, :3] + 1.0)
    np.testing.assert_allclose(twice[0][:, :3], 2.0 * np.eye(3))
    np.testing.assert_allclose(twice[1], 1.0)


def space(*, sees_noise: bool) -> SignalSpace:
    """Four values, two directions along the first two of them."""
    made = SignalSpace(4, 2, sees_noise=sees_noise)
    made.nominal = torch.tensor([1.0, 2.0, 3.0, 4.0], dtype=torch.float64)
    made.noise = torch.full((4,), 0.5, dtype=torch.float64)
    made.directions = torch.eye(4, dtype=torch.float64)[:2]
    made.center = torch.tensor([1.0, -1.0], dtype=torch.float64)
    made.variance = torch.tensor([3.0, 8.0], dtype=torch.float64)
    made.level = torch.tensor([0.5, 2.0], dtype=torch.float64)
    return made


def test_coordinates_are_standardised_by_signal_and_noise() -> None:
    X = torch.tensor([[2.0, 2.5, 4.0, 4.0], [1.0, 2.0, 3.0, 4.25]], dtype=torch.float64)
    coefficients = np.array([[2.0, 1.0], [0.0, 0.0]])
    energy = np.array([4.0, 0.25])
    plain = space(sees_noise=False)
    np.testing.assert_allclose(plain(X), (coefficients - [1.0, -1.0]) / np.sqrt([4.0, 9.0]))
    assert plain.n_coordinates == 2
    own = space(sees_noise=True)
    got = own.coordinates(X)
    np.testing.assert_allclose(got[0], coefficients)
    np.testing.assert_allclose(got[1], energy)
    assert (own.n_coordinates, own.freedom) == (3, 2)
    level = np.maximum(energy / 2.0, 0.5)  # no quieter than half of the variance
    expected = (coefficients - [1.0, -1.0]) / np.sqrt(np.array([3.0, 8.0]) + level[:, None])
    np.testing.assert_allclose(own(X), np.column_stack([expected, (np.log(level) - 0.5) / 2.0]))


def test_given_cases_span_their_own_directions() -> None:
    rng = np.random.default_rng(1)
    flat = rng.normal(size=(50, 2)) @ rng.normal(size=(2, 12)) + 5.0 + 0.1 * rng.normal(size=(50, 12))
    got = SignalSpace.from_cases(flat, 2)
    scatter = flat - flat.mean(axis=0)
    left = np.linalg.svd(scatter, compute_uv=False)[2:]
    np.testing.assert_allclose(got.noise, np.sqrt(np.square(left).sum() / flat.size))
    np.testing.assert_allclose(got.nominal, flat.mean(axis=0))
    coefficients = (scatter / got.noise.numpy()) @ got.directions.numpy().T
    np.testing.assert_allclose(coefficients, got.coordinates(torch.from_numpy(flat))[0])
    np.testing.assert_allclose(got.center, coefficients.mean(axis=0), atol=1e-9)
    np.testing.assert_allclose(got.variance, coefficients.var(axis=0))
    flat2 = np.tile(flat[:1], (5, 1)) + np.arange(5.0)[:, None]
    exact = SignalSpace.from_cases(flat2, 1)  # nothing is left outside: a millionth of the scatter
    np.testing.assert_allclose(exact.noise, 1e-6 * np.sqrt(2.0), rtol=1e-6)


class Stubborn(np.random.Generator):
    """Normals are 1, and chi-squares their degrees of freedom."""

    def __init__(self) -> None:
        super().__init__(np.random.PCG64(0))

    def standard_normal(self, size: Any = None, *_: Any, **__: Any) -> Any:
        return np.ones(size)

    def chisquare(self, df: Any, size: Any = None) -> Any:
        return np.full(size, float(df))


def test_more_noise_by_hand() -> None:
    """A factor of 2 on the noise adds the root of three of it."""
    factor = np.array([1.0, 2.0])
    along, outside = with_more_noise(torch.zeros(2, 3), torch.tensor([4.0, 4.0]), 6, factor, Stubborn())
    np.testing.assert_allclose(along, [[0.0] * 3, [np.sqrt(3.0)] * 3], rtol=1e-6)
    np.testing.assert_allclose(outside, [4.0, (2.0 + np.sqrt(3.0)) ** 2 + 3.0 * 5.0], rtol=1e-6)
    for freedom in (1, 2):  # one value is left outside, or two
        few = with_more_noise(torch.zeros(1, 3), torch.tensor([4.0]), freedom, factor[1:], Stubborn())[1]
        np.testing.assert_allclose(few, (2.0 + np.sqrt(3.0)) ** 2 + 3.0 * (freedom - 1), rtol=1e-6)


def test_fresh_batches_are_the_next_cases_with_noise_up_to_the_largest() -> None:
    made = SignalSpace.from_recipe(RECIPE, 4, sees_noise=True).float()
    stream = list(islice(fresh_cases(made, RECIPE, 9, 16, most_noise=4.0), 40))
    assert [batch.case_id.tolist() for _, batch in stream[:2]] == [list(range(16)), list(range(16, 32))]
    rng = np.random.default_rng(9)
    factor = np.exp(rng.uniform(0.0, math.log(4.0), 16))
    expected = made.standardise(
        *with_more_noise(
            *made.coordinates(torch.from_numpy(stream[0][1].X.reshape(16, -1))), made.freedom, factor, rng
        )
    )
    np.testing.assert_array_equal(stream[0][0], expected)
    plain = next(fresh_cases(made, RECIPE, 9, 16))[0]
    np.testing.assert_array_equal(plain, made(torch.from_numpy(stream[0][1].X.reshape(16, -1))))


def test_the_last_batches_of_a_training_are_larger() -> None:
    """Three tenths of the steps see four times as many cases."""
    begun: list[tuple[int, int]] = []

    def make(part: int, size: int) -> Any:
        begun.append((part, size))
        return iter([(part, n) for n in range(100)])

    batches: list[Any] = list(batch_schedule(make, 8, 10))
    assert begun == [(0, 8), (1, 32)]
    assert batches == [(0, n) for n in range(7)] + [(1, n) for n in range(3)]
    assert total_cases(8, 10) == 8 * 7 + 32 * 3


def test_the_rate_warms_up_and_falls_and_weights_are_averaged() -> None:
    """AdamW's first step is the rate itself for each weight with a gradient: steps tell the schedule."""
    made = Posterior(SignalSpace(2, 2, sees_noise=False), n_hidden=1, n_layers=0, n_out=1)
    inputs = torch.ones(1, 2, dtype=torch.float64)
    seen: list[float] = []

    def batches(part: int, size: int) -> Any:
        while True:
            yield inputs, torch.zeros(1)

    def loss(outputs: torch.Tensor, _: torch.Tensor) -> torch.Tensor:
        seen.append(float(outputs.detach().sum()))
        return -outputs.sum()  # a gradient of one everywhere: each step moves by the rate

    steps = 300
    made.learn(batches, loss, torch.Generator().manual_seed(0), steps=steps, batch_size=1, learning_rate=0.01)
    rates = [0.01 * min(1.0, n / 100) * 0.5 * (1.0 + math.cos(math.pi * n / steps)) for n in range(steps)]
    weights = np.concatenate([[0.0], np.cumsum(rates)])  # two weights and an offset, all alike
    np.testing.assert_allclose(seen, 3.0 * weights[:-1], rtol=1e-6, atol=1e-12)
    average = weights[1]
    for done, weight in enumerate(weights[2:], start=1):
        kept = min(0.999, done / (done + 20))
        average = kept * average + (1.0 - kept) * weight
    assert float(next(made.network.parameters()).detach()[0, 0]) == pytest.approx(average, rel=1e-6)


def test_a_perceptron_has_the_layers_that_it_is_asked_for() -> None:
    def sizes(*numbers: int) -> list[tuple[int, int]]:
        return [
            (one.in_features, one.out_features) for one in perceptron(*numbers) if isinstance(one, nn.Linear)
        ]

    assert sizes(5, 3, 2, 4) == [(5, 3), (3, 3), (3, 4)]
    assert sizes(5, 3, 0, 4) == [(5, 4)]
    assert [type(one) for one in perceptron(5, 3, 1, 4)] == [nn.Linear, nn.SiLU, nn.Linear]
    assert len(list(perceptron(1, 1, 1000, 1))) == 2001
    for wrong in ((5, 3, -1, 4), (5, 3, 1001, 4), (5, 0, 1, 4)):
        with pytest.raises(ValueError, match="must be"):
            perceptron(*wrong)


def test_inputs_are_standardised_by_the_training_cases() -> None:
    X = np.random.default_rng(2).normal(size=(30, 8)) * np.arange(1.0, 9.0)
    model = PerceptronClassifier(n_components=3, epochs=1, random_state=0).fit(X, np.repeat([0, 1], 15))
    assert model.projection_ is not None
    features = model.projection_.transform(X)
    np.testing.assert_allclose(model._inputs(features).mean(axis=0), 0.0, atol=1e-9)
    np.testing.assert_allclose(model._inputs(features).std(axis=0), 1.0)
    logits = model._logits(X)
    np.testing.assert_allclose(model.predict_proba(X)[:, 1], expit(logits[:, 1] - logits[:, 0]))


def test_densities_of_the_severity_on_their_grid() -> None:
    """Position and width are 0.5 and 1 / e where the network says 0; bounds that lie between two grid points."""
    zeros = torch.zeros(1, 2, dtype=torch.float64)
    share = severity_density.weights(zeros)[0].numpy()
    grid = np.linspace(0.0, 1.0, 201)
    expected = norm.pdf(grid, 0.5, np.exp(-1.0))
    expected[[0, -1]] *= 0.5
    np.testing.assert_allclose(share, expected / expected.sum())
    assert severity_density.mean(torch.from_numpy(share)[None]).item() == pytest.approx(0.5)
    two = torch.zeros(1, 201, dtype=torch.float64)
    two[0, 100], two[0, 101] = 0.25, 0.75
    # Half of a point's weight lies on either side: the first has 1/8 below it, the second 5/8.
    assert severity_density.quantile(two, 0.375).item() == pytest.approx((100 + 0.25 / 0.5) / 200)
    assert severity_density.quantile(two, 0.125).item() == pytest.approx(100 / 200, abs=1e-6)
    low, high = severity_density.summary(zeros, 0.05)[1:].numpy()[:, 0]
    assert (low + high) == pytest.approx(1.0)
    outputs = torch.tensor([[9.0, 9.0, 0.25, 0.5], [0.25, 0.5, 9.0, 9.0]], dtype=torch.float64)
    targets = torch.tensor([[1.0, 0.3], [0.0, 0.3]], dtype=torch.float64)
    own = severity_density.negative_log_likelihood(outputs[1:, :2], torch.tensor([0.3], dtype=torch.float64))
    assert severity_density.severity_loss(outputs, targets).item() == pytest.approx(own.item())


def test_ranges_are_a_fifth_beyond_the_classes() -> None:
    classes = (
        FaultClass(),
        FaultClass(FaultKind.BEARING, 0.1, severity_to=0.5),
        FaultClass(FaultKind.WINDING_SHORT, 0.9),
    )
    recipe = replace(RECIPE, classes=classes)
    largest = {str(prior.kind): prior.largest for prior in severity_priors(recipe)}
    assert largest == pytest.approx({"bearing": 0.6, "winding_contact": 0.3, "winding_short": 0.95})
    drawn = severity_recipe(recipe, with_healthy=True)
    assert [(c.kind, c.severity, c.severity_to) for c in drawn.classes] == [
        *(
            (kind, 0.0, top)
            for kind, top in zip((p.kind for p in severity_priors(recipe)), largest.values(), strict=True)
        ),
        (None, 0.0, None),
    ]
    assert drawn.class_probabilities[-1] == 0.0


def test_severities_of_the_shipped_network_are_scaled_to_their_ranges() -> None:
    """One case, by the network's own numbers: mean and bounds of 90 % of the cut normal times the largest severity."""
    model, recipe, _ = load_model(PRETRAINED)
    assert isinstance(model, PosteriorNetwork)
    assert model.severity_ is not None
    X = generate_arrays(recipe, 3, 4).X
    flat = torch.from_numpy(X.reshape(4, -1).astype(np.float64))
    with torch.inference_mode():
        raw = model.severity_(flat).reshape(4, 3, 2)
    names = [str(prior.kind) for prior in model.severity_priors_]
    for column, (name, prior) in enumerate(zip(names, model.severity_priors_, strict=True)):
        told = model.predict_severity(X, name, coverage=0.8)
        expected = prior.largest * severity_density.summary(raw[:, column], 0.1).numpy()
        np.testing.assert_allclose([told.mean, told.low, told.high], expected)
        usual = model.predict_severity(X, name)
        np.testing.assert_allclose(
            usual.low, prior.largest * severity_density.summary(raw[:, column], 0.05)[1].numpy()
        )
    probabilities = model.predict_proba(X)
    kinds: NDArray[np.str_] = np.array([label.rpartition("_")[0] for label in model.classes_])
    shares = np.stack([probabilities[:, kinds == name].sum(axis=1) for name in names], axis=1)
    assert model.predict_severity(X).kind.tolist() == [names[n] for n in shares.argmax(axis=1)]


def test_references_are_the_starts_before_the_judged_one() -> None:
    drawn = referenced_starts(RECIPE, 4, [7, 2], 2)
    several = replace(RECIPE, starts_per_motor=3, healthy_starts=2)
    for row, motor in enumerate((7, 2)):
        own = generate_arrays(several, 4, 3 * motor + np.array([2, 0, 1]))
        np.testing.assert_array_equal(drawn.X[row], own.X[:, 0])
        assert (drawn.case_id[row], drawn.motor_id[row]) == (3 * motor + 2, motor)
        assert own.class_name[1:].tolist() == ["healthy", "healthy"]
    assert split_starts(drawn.X, RECIPE).shape == (2, 3, 1, 100)
    with pytest.raises(ValueError, match="must be starts of 1 x 100 values each, got 150 values"):
        split_starts(np.zeros((2, 150)), RECIPE)
