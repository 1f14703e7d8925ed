"""What networks are made of, in closed form: coordinates of starts, noise, batches, schedules, densities."""

import math
from dataclasses import replace
from itertools import islice
from typing import Any

import numpy as np
import pytest
import torch
from scipy.stats import truncnorm

from motor_classifiers import PerceptronClassifier, PosteriorNetwork, ResidualProjection
from motor_classifiers.estimators.features import affine_map, signal_family, whitened_residual
from motor_classifiers.estimators.networks import severity_density
from motor_classifiers.estimators.networks.posterior import Posterior, batch_schedule, total_cases
from motor_classifiers.estimators.networks.severity_density import severity_priors, severity_recipe
from motor_classifiers.estimators.networks.signal_space import SignalSpace, fresh_cases, with_more_noise
from motor_datasets import generate_arrays
from motor_env import FaultKind, Timing, load_recipe
from motor_env.simulation.recipes import FaultClass

RECIPE = load_recipe("bench", timing=Timing(1_000.0, 0.1))
FIELD = load_recipe("field", timing=Timing(1_000.0, 0.05, quiet_s=0.01))


def doubles(*values: Any) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def test_directions_are_the_leading_ones_of_the_familys_residuals() -> None:
    X = generate_arrays(RECIPE, 3, 20).X.astype(np.float64)
    got = ResidualProjection(RECIPE, 4, n_draws=300).fit(X)
    family = signal_family(RECIPE, 300)
    leading = np.linalg.eigh(family.T @ family)[1][:, ::-1][:, :4]
    expected = whitened_residual(RECIPE, X) @ leading
    np.testing.assert_allclose(np.abs(got.transform(X)), np.abs(expected), rtol=1e-5, atol=1e-6)
    factors, offsets = affine_map(RECIPE, lambda measured: 2.0 * measured[:, 0, :3] + 1.0)
    np.testing.assert_allclose(factors[:, :3], 2.0 * np.eye(3))
    np.testing.assert_allclose(offsets, 1.0)


def space(*, sees_noise: bool) -> SignalSpace:
    """Four values, two directions along the first two of them."""
    made = SignalSpace(4, 2, sees_noise=sees_noise)
    made.nominal, made.noise = doubles(1.0, 2.0, 3.0, 4.0), doubles(0.5, 0.5, 0.5, 0.5)
    made.directions = torch.eye(4, dtype=torch.float64)[:2]
    made.center, made.variance, made.level = doubles(1.0, -1.0), doubles(3.0, 8.0), doubles(0.5, 2.0)
    return made


def test_coordinates_are_standardised_by_signal_and_noise() -> None:
    X = doubles([2.0, 2.5, 4.0, 4.0], [1.0, 2.0, 3.0, 4.25])
    coefficients, energy = np.array([[2.0, 1.0], [0.0, 0.0]]), np.array([4.0, 0.25])
    plain, own = space(sees_noise=False), space(sees_noise=True)
    np.testing.assert_allclose(plain(X), (coefficients - [1.0, -1.0]) / np.sqrt([4.0, 9.0]))
    for got, expected in zip(own.coordinates(X), (coefficients, energy), strict=True):
        np.testing.assert_allclose(got, expected)
    assert (plain.n_coordinates, own.n_coordinates, own.freedom) == (2, 3, 2)
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
    on_a_line = np.tile(flat[:1], (5, 1)) + np.arange(5.0)[:, None]
    wanted = ((RECIPE, None), (load_recipe("field", timing=Timing(1_000.0, 0.05, 0.01)), None), (RECIPE, 3))
    seen = [SignalSpace.from_recipe(recipe, n, sees_noise=False).n_coordinates for recipe, n in wanted]
    assert seen == [10, 16, 3]  # more nuisances are seen along more directions
    exact = SignalSpace.from_cases(on_a_line, 1)  # nothing is left outside: a millionth of the scatter
    np.testing.assert_allclose(exact.noise, 1e-6 * np.sqrt(2.0), rtol=1e-6)


class Stubborn(np.random.Generator):
    """Normals are 1, and chi-squares their degrees of freedom."""

    def __init__(self) -> None:
        super().__init__(np.random.PCG64(0))

    def standard_normal(self, size: Any = None, *_: Any, **__: Any) -> Any:
        return np.ones(size)

    def chisquare(self, df: Any, size: Any = None) -> Any:
        return np.full(size, float(df))


def test_a_factor_of_2_on_the_noise_adds_the_root_of_three_of_it() -> None:
    factor = np.array([1.0, 2.0])
    along, outside = with_more_noise(torch.zeros(2, 3), torch.tensor([4.0, 4.0]), 6, factor, Stubborn())
    np.testing.assert_allclose(along, [[0.0] * 3, [np.sqrt(3.0)] * 3], rtol=1e-6)
    np.testing.assert_allclose(outside, [4.0, (2.0 + np.sqrt(3.0)) ** 2 + 3.0 * 5.0], rtol=1e-6)
    for freedom in (1, 2):  # one value is left outside, or two
        few = with_more_noise(torch.zeros(1, 3), torch.tensor([4.0]), freedom, factor[1:], Stubborn())[1]
        np.testing.assert_allclose(few, (2.0 + np.sqrt(3.0)) ** 2 + 3.0 * (freedom - 1), rtol=1e-6)


def test_fresh_batches_are_the_next_cases_with_noise_up_to_the_largest() -> None:
    made = SignalSpace.from_recipe(RECIPE, 4, sees_noise=True).float()
    stream = list(islice(fresh_cases(made, RECIPE, 9, 16, most_noise=4.0), 2))
    assert [batch.case_id.tolist() for _, batch in stream] == [list(range(16)), list(range(16, 32))]
    rng, flat = np.random.default_rng(9), torch.from_numpy(stream[0][1].X[:, 0])
    factor = np.exp(rng.uniform(0.0, math.log(4.0), 16))
    expected = made.standardise(*with_more_noise(*made.coordinates(flat), made.freedom, factor, rng))
    np.testing.assert_array_equal(stream[0][0], expected)
    np.testing.assert_array_equal(next(fresh_cases(made, RECIPE, 9, 16))[0], made(flat))


def test_the_stream_draws_classes_by_their_weights() -> None:
    often, *rest = RECIPE.classes
    classes = (replace(often, weight=6.0), *(replace(one, weight=1.0) for one in rest))
    streamed = PosteriorNetwork(recipe=replace(RECIPE, classes=classes))._stream_recipe()
    made = SignalSpace.from_recipe(streamed, 8, sees_noise=False).float()
    drawn = np.mean(next(fresh_cases(made, streamed, 3, 3000))[1].class_index == 0)
    share = 6.0 / (6.0 + len(rest))
    assert drawn == pytest.approx(share, abs=4.0 * (share * (1.0 - share) / 3000) ** 0.5)


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
    seen: list[float] = []

    def batches(part: int, size: int) -> Any:
        while True:
            yield torch.ones(1, 2, dtype=torch.float64), torch.zeros(1)

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


def test_inputs_are_standardised_by_the_training_cases() -> None:
    X = np.random.default_rng(2).normal(size=(30, 8)) * np.arange(1.0, 9.0)
    model = PerceptronClassifier(n_components=3, epochs=1, random_state=0).fit(X, np.repeat([0, 1], 15))
    assert model.projection_ is not None
    inputs = model._inputs(model.projection_.transform(X))
    np.testing.assert_allclose([inputs.mean(axis=0), inputs.std(axis=0)], [[0.0] * 3, [1.0] * 3], atol=1e-9)


@pytest.mark.parametrize(("place", "width"), [(0.4, 0.1), (-0.2, 0.3), (0.98, 0.05), (0.5, 3.0)])
def test_density_is_the_cut_normal(place: float, width: float) -> None:
    parameters = doubles([place - 0.5, np.log(width) + 1.0])
    exact = truncnorm(-place / width, (1.0 - place) / width, loc=place, scale=width)
    share = severity_density.weights(parameters)
    assert severity_density.mean(share).item() == pytest.approx(exact.mean(), abs=1e-3)
    for probability in (0.05, 0.5, 0.95):
        found = severity_density.quantile(share, probability).item()
        assert found == pytest.approx(exact.ppf(probability), abs=2e-3)
    loss = severity_density.negative_log_likelihood(parameters, doubles(0.3)).item()
    assert loss == pytest.approx(-exact.logpdf(0.3), abs=0.02)


def test_quantiles_of_the_severity_lie_between_the_points_of_the_grid() -> None:
    """Half of a point's weight lies on either side: the first has 1/8 below it, the second 5/8."""
    two = torch.zeros(1, 201, dtype=torch.float64)
    two[0, 100], two[0, 101] = 0.25, 0.75
    assert severity_density.quantile(two, 0.375).item() == pytest.approx((100 + 0.25 / 0.5) / 200)
    outputs = doubles([9.0, 9.0, 0.25, 0.5], [0.25, 0.5, 9.0, 9.0])
    own = severity_density.negative_log_likelihood(outputs[1:, :2], doubles(0.3))
    loss = severity_density.severity_loss(outputs, doubles([1.0, 0.3], [0.0, 0.3]))
    assert loss.item() == pytest.approx(own.item())


def test_ranges_are_a_fifth_beyond_the_classes() -> None:
    wide = FaultClass(FaultKind.BEARING, 0.1, severity_to=0.5)
    recipe = replace(RECIPE, classes=(FaultClass(), wide, FaultClass(FaultKind.WINDING_SHORT, 0.9)))
    largest = {str(prior.kind): prior.largest for prior in severity_priors(recipe)}
    assert largest == pytest.approx({"bearing": 0.6, "winding_contact": 0.3, "winding_short": 0.95})
    drawn = severity_recipe(recipe, with_healthy=True)
    ranges = [(prior.kind, 0.0, prior.largest) for prior in severity_priors(recipe)]
    assert [(c.kind, c.severity, c.severity_to) for c in drawn.classes] == [*ranges, (None, 0.0, None)]
    assert drawn.class_probabilities[-1] == 0.0
