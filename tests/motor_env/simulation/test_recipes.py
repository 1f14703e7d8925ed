"""Recipes: class frequencies, spreads, independence of the batch, refusals."""

import numpy as np
import pytest

from motor_env.motor.faults import FaultKind, apply_faults
from motor_env.motor.parameters import PAPER_MOTOR
from motor_env.simulation import recipes
from motor_env.simulation.drawing import apply_factors, draw
from motor_env.simulation.named_recipes import RECIPES, named_recipe
from motor_env.simulation.recipes import FACTORS, FaultClass, Recipe, Spread

N = 20_000


def test_classes_of_bench_are_equally_likely() -> None:
    counts = np.bincount(draw(RECIPES["bench"], 1, np.arange(N)).class_index, minlength=5)
    assert RECIPES["bench"].class_names == (
        "healthy",
        "bearing_10",
        "bearing_25",
        "winding_contact_10",
        "winding_contact_25",
    )
    assert np.abs(counts - N / 5).max() < 4.0 * np.sqrt(N * 0.2 * 0.8)


def test_weights_are_frequencies() -> None:
    classes = (
        FaultClass(weight=6.0),
        FaultClass(FaultKind.BEARING, 0.1, 3.0),
        FaultClass(FaultKind.NOISE, 2.0),
    )
    recipe = Recipe("mine", classes=classes)
    counts = np.bincount(draw(recipe, 2, np.arange(N)).class_index, minlength=3)
    np.testing.assert_allclose(counts / N, recipe.class_probabilities, atol=4.0 * 0.5 / np.sqrt(N))


def test_factors_have_their_deviations_and_are_independent() -> None:
    factors = draw(RECIPES["bench"], 3, np.arange(N)).factors
    assert FACTORS == ("supply", "resistance", "constants", "inertia", "friction")
    std = np.array([0.01, 0.01, 0.01, 0.02, 0.02])
    assert np.abs(factors.mean(axis=0) - 1.0).max() < 4.0 * std.max() / np.sqrt(N)
    np.testing.assert_allclose(factors.std(axis=0), std, rtol=4.0 / np.sqrt(2 * N))
    correlation = np.corrcoef(factors.T) - np.eye(5)
    assert np.abs(correlation).max() < 4.5 / np.sqrt(N)


def test_paper_recipe_has_no_spread() -> None:
    drawn = draw(RECIPES["paper"], 3, np.arange(10))
    assert np.all(drawn.factors == 1.0)


def test_a_case_does_not_depend_on_its_batch() -> None:
    whole = draw(RECIPES["bench"], 4, np.arange(100))
    part = draw(RECIPES["bench"], 4, [42, 7])
    assert np.array_equal(part.class_index, whole.class_index[[42, 7]])
    assert np.array_equal(part.factors, whole.factors[[42, 7]])
    assert not np.array_equal(draw(RECIPES["bench"], 5, np.arange(100)).class_index, whole.class_index)


def test_each_case_has_its_class_and_its_factors_in_the_parameters() -> None:
    recipe = RECIPES["bench"]
    drawn = draw(recipe, 6, np.arange(50))
    faulty = apply_faults(drawn.scenario.parameters, drawn.scenario.faults)
    for n in range(50):
        fault_class = recipe.classes[drawn.class_index[n]]
        supply, resistance, constants, inertia, friction = drawn.factors[n]
        expected = apply_faults(PAPER_MOTOR, fault_class.faults).scaled(
            resistance_ohm=resistance,
            back_emf_constant_v_s_per_rad=constants,
            torque_constant_n_m_per_a=constants,
            inertia_kg_m2=inertia,
            viscous_friction_n_m_s_per_rad=friction,
        )
        motor = faulty.motor(n)
        for field in PAPER_MOTOR.__slots__:
            assert getattr(motor, field) == pytest.approx(getattr(expected, field), rel=1e-14)
        assert np.asarray(drawn.scenario.supply.voltage_v)[n] == pytest.approx(12.0 * supply, rel=1e-15)


def test_supply_factor_leaves_the_motor() -> None:
    factors = np.ones((1, 5))
    factors[0, FACTORS.index("supply")] = 2.0
    assert apply_factors(PAPER_MOTOR, factors).motor(0) == PAPER_MOTOR


def test_refusals() -> None:
    with pytest.raises(ValueError, match=r"recipe must be one of bench, .*, got 'benchh'"):
        named_recipe("benchh")
    with pytest.raises(ValueError, match=r"severity of healthy must be 0, got 0\.1"):
        FaultClass(None, 0.1)
    with pytest.raises(ValueError, match=r"severity of bearing must be a share .* got 15"):
        FaultClass(FaultKind.BEARING, 15.0)
    with pytest.raises(ValueError, match="severity of bearing must be finite and > 0, got 0"):
        FaultClass(FaultKind.BEARING)
    with pytest.raises(ValueError, match=r"spread of friction must be <= 0\.14, got 0\.2"):
        Spread(friction=0.2)
    with pytest.raises(ValueError, match="classes of recipe none must not be empty"):
        Recipe("none", classes=())
    with pytest.raises(ValueError, match="motor of recipe many must be one motor, got a batch"):
        Recipe("many", motor=PAPER_MOTOR.scaled(resistance_ohm=np.ones(2)))


def test_named_recipe_with_changes() -> None:
    changed = named_recipe("bench", classes=(FaultClass(),))
    assert (changed.name, changed.class_names) == ("bench", ("healthy",))
    assert changed.spread == RECIPES["bench"].spread


def test_no_factor_can_reach_zero_at_the_largest_spread() -> None:
    # The largest normal number that 32-bit words can give (Box & Muller): sqrt(-2 ln(2^-33)) = 6.76.
    assert 1.0 - recipes.LARGEST_SPREAD * np.sqrt(-2.0 * np.log(2.0**-33)) > 0.0
