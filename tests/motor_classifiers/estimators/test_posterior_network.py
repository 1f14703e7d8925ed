"""The amortised posterior network against the exact posterior, and what its training stands on."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.stats import ks_2samp, kstest, truncnorm
from sklearn.base import clone
from trust_figures import severity_figures

from motor_classifiers import PosteriorNetwork, evaluate_model
from motor_classifiers.estimators.networks import severity_density
from motor_classifiers.estimators.networks.signal_space import SignalSpace, fresh_cases, with_more_noise
from motor_datasets import generate_arrays
from motor_env import Channel, FaultKind, Recipe, SensorParameters, Timing, load_recipe, severity_posterior
from motor_env.simulation.recipes import FaultClass

RECIPE = load_recipe("bench", timing=Timing(1_000.0, 0.1))
FULL = load_recipe("bench-full", timing=Timing(1_000.0, 0.1))
QUICK: dict[str, Any] = {"steps": 400, "batch_size": 192, "n_hidden": 32}
FIELD = load_recipe("field", timing=Timing(1_000.0, 0.05, quiet_s=0.01))


@pytest.fixture(scope="module")
def trained() -> PosteriorNetwork:
    return PosteriorNetwork.from_recipe(RECIPE, random_state=0, **QUICK)


def test_it_is_near_the_limit_and_not_above(trained: PosteriorNetwork) -> None:
    scored = evaluate_model(trained, RECIPE, generate_arrays(RECIPE, 4, 3000), 0)
    assert scored["below_bayes_low"] < 0.01
    assert scored["p_above_bayes"] > 0.001
    assert scored["log_loss"] < 1.03 * scored["bayes_log_loss"]
    assert scored["ece"] < scored["bayes_ece"] + 0.015
    assert [prior.kind for prior in trained.severity_priors_] == [
        "bearing",
        "winding_contact",
        "winding_short",
    ]
    for prior in trained.severity_priors_:
        told = severity_figures(trained, RECIPE, prior, 4, 250)
        assert told["network"]["rmse"] < 1.10 * told["limit"]["rmse"]
        assert 0.84 < told["network"]["coverage"] < 0.96


def test_coefficients_of_noise_are_white_and_the_rest_is_chi_square() -> None:
    """The oracle of `with_more_noise` and of the standardisation: what white noise becomes."""
    space = SignalSpace.from_recipe(FULL, 8, sees_noise=True)
    rng = np.random.default_rng(0)
    noise = space.noise.numpy() * rng.standard_normal((4000, len(space.noise)))
    coefficients, energy = space.coordinates(space.nominal + torch.from_numpy(noise))
    np.testing.assert_allclose(np.cov(coefficients.T), np.eye(8), atol=0.08)
    assert kstest(energy, "chi2", args=(space.freedom,)).pvalue > 1e-3
    for column in coefficients.T:
        assert kstest(column, "norm").pvalue > 1e-3


def test_added_noise_is_that_of_a_noisier_sensor() -> None:
    space = SignalSpace.from_recipe(RECIPE, 8, sees_noise=True)
    many = np.arange(4000)
    quiet = generate_arrays(RECIPE, 1, many).X.reshape(len(many), -1)
    sensor = replace(RECIPE.sensor, current_noise_a=3.0 * RECIPE.sensor.current_noise_a)
    loud = generate_arrays(replace(RECIPE, sensor=sensor), 2, many).X.reshape(len(many), -1)
    factor = np.full(len(many), 3.0)
    before = space.coordinates(torch.from_numpy(quiet).double())
    made = with_more_noise(*before, space.freedom, factor, np.random.default_rng(3))
    found = space.coordinates(torch.from_numpy(loud).double())
    for ours, theirs in zip((*made[0].T, made[1]), (*found[0].T, found[1]), strict=True):
        assert ks_2samp(ours, theirs).pvalue > 1e-3


@pytest.mark.parametrize(("place", "width"), [(0.4, 0.1), (-0.2, 0.3), (0.98, 0.05), (0.5, 3.0)])
def test_density_is_the_cut_normal(place: float, width: float) -> None:
    parameters = torch.tensor([[place - 0.5, np.log(width) + 1.0]], dtype=torch.float64)
    exact = truncnorm(-place / width, (1.0 - place) / width, loc=place, scale=width)
    share = severity_density.weights(parameters)
    assert severity_density.mean(share).item() == pytest.approx(exact.mean(), abs=1e-3)
    for probability in (0.05, 0.5, 0.95):
        found = severity_density.quantile(share, probability).item()
        assert found == pytest.approx(exact.ppf(probability), abs=2e-3)
    position = torch.tensor([0.3], dtype=torch.float64)
    loss = severity_density.negative_log_likelihood(parameters, position).item()
    assert loss == pytest.approx(-exact.logpdf(0.3), abs=0.02)


def test_it_repeats_itself_to_the_bit_and_leaves_torch_alone() -> None:
    X = generate_arrays(RECIPE, 2, 50).X
    state, threads = torch.random.get_rng_state(), torch.get_num_threads()
    first, second = (
        PosteriorNetwork.from_recipe(RECIPE, steps=20, batch_size=64, random_state=7) for _ in range(2)
    )
    np.testing.assert_array_equal(first.predict_proba(X), second.predict_proba(X))
    np.testing.assert_array_equal(first.predict_severity(X).low, second.predict_severity(X).low)
    other = PosteriorNetwork.from_recipe(RECIPE, steps=20, batch_size=64, random_state=8)
    assert not np.array_equal(first.predict_proba(X), other.predict_proba(X))
    assert torch.equal(state, torch.random.get_rng_state())
    assert threads == torch.get_num_threads()


def test_a_recipe_with_more_nuisances_is_seen_along_more_directions() -> None:
    seen = [
        SignalSpace.from_recipe(recipe, None, sees_noise=False).n_coordinates for recipe in (RECIPE, FIELD)
    ]
    assert seen == [10, 16]
    assert SignalSpace.from_recipe(RECIPE, 3, sees_noise=False).n_coordinates == 3


def test_commissioning_starts_are_not_learned_as_healthy_motors() -> None:
    X = generate_arrays(RECIPE, 2, 50).X
    several = replace(RECIPE, starts_per_motor=5, healthy_starts=3)
    first, second = (
        PosteriorNetwork.from_recipe(recipe, steps=20, batch_size=64, random_state=7)
        for recipe in (RECIPE, several)
    )
    np.testing.assert_array_equal(first.predict_proba(X), second.predict_proba(X))


def test_the_stream_draws_classes_by_their_weights() -> None:
    often, *rest = RECIPE.classes
    recipe = replace(
        RECIPE, classes=(replace(often, weight=6.0), *(replace(one, weight=1.0) for one in rest))
    )
    streamed = PosteriorNetwork(recipe=recipe)._stream_recipe()
    space = SignalSpace.from_recipe(streamed, 8, sees_noise=False).float()
    _, batch = next(fresh_cases(space, streamed, 3, 3000))
    share = 6.0 / (6.0 + len(rest))
    assert np.mean(batch.class_index == 0) == pytest.approx(
        share, abs=4.0 * (share * (1.0 - share) / 3000) ** 0.5
    )


def test_without_a_recipe_it_learns_from_the_cases_it_is_given() -> None:
    first, second = generate_arrays(RECIPE, 3, 400), generate_arrays(RECIPE, 4, 400)
    model = PosteriorNetwork(steps=100, batch_size=64, n_components=10, random_state=0)
    fitted = clone(model).fit(first.X, first.class_name)
    assert fitted.score(second.X, second.class_name) > 0.65  # the limit at 1 kHz is 0.80
    shuffled = clone(model).fit(first.X, np.random.default_rng(0).permutation(first.class_name))
    assert shuffled.score(second.X, second.class_name) < 0.4
    with pytest.raises(ValueError, match="this one has none"):
        fitted.predict_severity(first.X)
    with pytest.raises(ValueError, match="needs a recipe"):
        PosteriorNetwork().fit_stream()


def test_with_a_recipe_it_learns_from_the_stream_and_checks_the_cases_it_is_given() -> None:
    given = generate_arrays(RECIPE, 3, 40)
    model = PosteriorNetwork(RECIPE, steps=5, batch_size=64, random_state=0)
    fitted = clone(model).fit(given.X, given.class_name)
    streamed = PosteriorNetwork.from_recipe(RECIPE, steps=5, batch_size=64, random_state=0)
    np.testing.assert_array_equal(fitted.predict_proba(given.X), streamed.predict_proba(given.X))
    with pytest.raises(ValueError, match="class must be one of"):
        model.fit(given.X, np.where(given.class_index > 0, "odd", "healthy"))
    with pytest.raises(ValueError, match="1 x 100 values"):
        model.fit(given.X[:, :, :50], given.class_name)


def test_severity_of_the_most_probable_kind(trained: PosteriorNetwork) -> None:
    data = generate_arrays(RECIPE, 5, 300)
    told = trained.predict_severity(data.X)
    assert set(told.kind) <= {"bearing", "winding_contact"}
    windings = data.kind == "winding_contact"
    assert (told.kind[windings] == "winding_contact").mean() > 0.97
    np.testing.assert_array_equal(
        told.mean[told.kind == "bearing"],
        trained.predict_severity(data.X, "bearing").mean[told.kind == "bearing"],
    )
    assert ((told.low <= told.mean) & (told.mean <= told.high)).all()
    narrow = trained.predict_severity(data.X, "bearing", coverage=0.5)
    wide = trained.predict_severity(data.X, "bearing", coverage=0.9)
    assert (narrow.high - narrow.low < wide.high - wide.low).all()
    with pytest.raises(ValueError, match="kind must be one of bearing"):
        trained.predict_severity(data.X, "noise")
    with pytest.raises(ValueError, match="coverage must be > 0"):
        trained.predict_severity(data.X, coverage=1.0)


def test_a_noise_fault_is_told_by_what_is_left_over() -> None:
    recipe = replace(FULL, classes=(FULL.classes[0], FULL.classes[-1]))
    data = generate_arrays(recipe, 2, 1000)
    model = PosteriorNetwork.from_recipe(recipe, steps=120, batch_size=128, random_state=0)
    assert model.score(data.X, data.class_name) > 0.97  # twice the variance over 100 samples
    loud = data.X[data.class_index == 1][:60]
    exact = severity_posterior(recipe, model.severity_priors_[-1], loud)
    told = model.predict_severity(loud, "noise")
    assert np.sqrt(np.square(told.mean - exact.mean).mean()) < 0.05


def test_the_noise_may_be_unknown() -> None:
    model = PosteriorNetwork.from_recipe(
        RECIPE, noise_range=(0.25, 5.0), with_severity=False, random_state=0, **QUICK | {"batch_size": 256}
    )
    for factor in (0.25, 5.0):
        other = replace(RECIPE, sensor=RECIPE.sensor.with_noise(factor))
        scored = evaluate_model(model, RECIPE, generate_arrays(other, 4, 2000), 0)
        # A network that takes the noise for the recipe's has 2.8 and 8.9 times the log-loss of the limit.
        assert scored["below_bayes"] < 0.03
        assert scored["log_loss"] < 1.3 * scored["bayes_log_loss"]
    for bad in ((0.0, 1.0), (2.0, 1.0)):
        with pytest.raises(ValueError, match="noise_range must be 0 < low < high"):
            PosteriorNetwork.from_recipe(RECIPE, noise_range=bad)
    with pytest.raises(ValueError, match="they look the same"):
        PosteriorNetwork.from_recipe(FULL, noise_range=(0.5, 2.0))


def recipes() -> Iterator[Recipe]:
    yield replace(RECIPE, sensor=SensorParameters(channels=(Channel.CURRENT, Channel.SPEED)))
    yield FIELD
    yield load_recipe("paper", timing=Timing(1_000.0, 0.006))
    joint = FaultClass(FaultKind.BEARING, 0.1, also=(FaultClass(FaultKind.NOISE, 1.0),))
    yield replace(RECIPE, classes=(FaultClass(), joint, FaultClass(FaultKind.BEARING, 0.05, severity_to=0.5)))


@pytest.mark.parametrize("recipe", list(recipes()), ids=["speed", "field", "few samples", "joint"])
def test_any_recipe_trains(recipe: Recipe) -> None:
    model = PosteriorNetwork.from_recipe(recipe, steps=10, batch_size=32, random_state=0)
    data = generate_arrays(recipe, 2, 20)
    probabilities = model.predict_proba(data.X)
    np.testing.assert_allclose(probabilities.sum(axis=1), 1.0)
    assert model.classes_.tolist() == sorted(recipe.class_names)
    assert np.isfinite(model.predict_severity(data.X).mean).all()
