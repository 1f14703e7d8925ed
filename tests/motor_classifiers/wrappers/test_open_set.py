"""The verdict `other`: the distance against another minimiser, its rate of false alarms, and foreign faults."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from sklearn.discriminant_analysis import QuadraticDiscriminantAnalysis
from sklearn.pipeline import make_pipeline

from motor_classifiers import OpenSetClassifier, ResidualProjection

# Reaches in: the faults that no recipe has are those on which the benchmark tries detectors.
from motor_classifiers.scoring.unknown_faults import UNKNOWN_FAULTS, ForeignFault, foreign_starts
from motor_classifiers.wrappers.fault_family import QUANTITIES, family_fit
from motor_classifiers.wrappers.open_set import OUTSIDE
from motor_datasets import generate_arrays
from motor_env import FaultKind, Recipe, Timing, load_recipe, simulate_states
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.recipes import FaultClass

BENCH = load_recipe("bench", timing=Timing(1_000.0, 0.1))
FIELDS = {
    "resistance": "resistance_ohm",
    "constants": "torque_constant_n_m_per_a",
    "inertia": "inertia_kg_m2",
    "friction": "viscous_friction_n_m_s_per_rad",
    "inductance": "inductance_h",
}


def _residuals(logarithms: FloatArray, measured: FloatArray, recipe: Recipe) -> FloatArray:
    """Residuals in units of the noise, from the simulation alone."""
    factor = dict(zip(QUANTITIES, np.exp(logarithms), strict=True))
    motor = recipe.motor.scaled(
        back_emf_constant_v_s_per_rad=factor["constants"],
        **{field: factor[name] for name, field in FIELDS.items()},
    )
    voltage = factor["supply"] * recipe.timing.step(12.0)
    current = simulate_states(motor, voltage, recipe.timing.dt_s)[:, 0]
    residuals: FloatArray = (measured - current) / recipe.sensor.current_noise_a
    return residuals


def test_the_distance_is_that_of_another_minimiser() -> None:
    foreign = foreign_starts(BENCH, ForeignFault("inertia +10 %", inertia=1.1), 3, np.arange(3))
    known = generate_arrays(BENCH, 3, 5).X
    still = [
        simulate_states(BENCH.motor.scaled(**{FIELDS["friction"]: factor}), BENCH.timing.step(12.0), 1e-3).T[
            :1
        ]
        for factor in (1.0, np.exp(0.6))
    ]
    loud = still[0] + 1.6 * (
        known[:1] - still[0]
    )  # noise beyond what is believed, and a severity without noise
    X = np.concatenate([foreign, known, loud, still[1][None]]).astype(np.float64)
    got = family_fit(BENCH, X)
    tolerance = np.array([0.01, 0.01, 0.01, 0.02, 0.02, 1e-4])
    kinds = (None, QUANTITIES.index("friction"), QUANTITIES.index("resistance"))
    for case, distance in zip(X[:, 0], got.distance, strict=True):

        def anything(values: FloatArray, case: FloatArray = case) -> FloatArray:
            return np.concatenate([_residuals(0.3 * values, case, BENCH), values])

        def known_family(values: FloatArray, kind: int | None, case: FloatArray = case) -> FloatArray:
            logarithms = tolerance * values[:6]  # in units of the tolerances, and beside them t
            if kind is not None:
                logarithms[kind] += values[6]
            return np.concatenate([_residuals(logarithms, case, BENCH), values])

        loose = least_squares(anything, np.zeros(6))
        chi2 = float(np.square(loose.fun[:100]).sum())
        noise = max(chi2 / 100.0, 1.0)
        anyhow = 2.0 * loose.cost - chi2 + chi2 / noise + 100.0 * np.log(noise)
        bounds = (np.append(np.full(6, -np.inf), 0.0), np.inf)
        start = np.append(np.zeros(6), 0.1)
        best = min(2.0 * least_squares(known_family, start, bounds=bounds, args=(n,)).cost for n in kinds)
        assert distance == pytest.approx(best - anyhow, abs=0.02)


def test_a_bearing_beyond_the_trained_range_is_a_bearing() -> None:
    recipe = replace(BENCH, classes=(FaultClass(FaultKind.BEARING, 0.60),))
    worn = generate_arrays(recipe, 5, 300)
    train = generate_arrays(BENCH, 0, 1000)
    pipeline = make_pipeline(ResidualProjection(BENCH, 6), QuadraticDiscriminantAnalysis())
    model = OpenSetClassifier(pipeline, BENCH).fit(train.X, train.class_name)
    verdicts = model.verdicts(worn.X)
    assert (verdicts.label[verdicts.out_of_range] == "bearing").all()
    assert verdicts.out_of_range.mean() > 0.85
    assert verdicts.is_outside.mean() < 0.05
    assert np.nanmedian(verdicts.severity) == pytest.approx(0.60, abs=0.05)
    foreign = model.verdicts(foreign_starts(BENCH, UNKNOWN_FAULTS[0], 1, np.arange(50)))
    assert (foreign.label[foreign.is_outside] == OUTSIDE).all()
    assert foreign.is_outside.mean() > 0.95
    ordinary = model.verdicts(train.X[:600])
    assert ordinary.out_of_range.mean() < 0.02
    inside = ~ordinary.is_outside & ~ordinary.out_of_range
    np.testing.assert_array_equal(ordinary.label[inside], model.predict(train.X[:600])[inside])


def test_shorts_noise_and_joint_faults_have_their_places() -> None:
    short, noise = FaultClass(FaultKind.WINDING_SHORT, 0.10), FaultClass(FaultKind.NOISE, 1.0)
    both = FaultClass(FaultKind.BEARING, 0.25, also=(FaultClass(FaultKind.WINDING_CONTACT, 0.10),))
    recipe = replace(BENCH, classes=(FaultClass(), short, noise, both))
    cases = generate_arrays(recipe, 7, 600)
    got = family_fit(recipe, cases.X)
    faulty = cases.kind != "healthy"
    assert (got.kind == cases.kind)[faulty].mean() > 0.97
    assert np.quantile(got.distance, 0.95) < 9.0
    assert got.severity[cases.class_index == 1].mean() == pytest.approx(0.10, abs=0.01)
    assert got.severity[cases.class_index == 2].mean() == pytest.approx(1.0, abs=0.15)
    assert got.severity[cases.class_index == 3].mean() == pytest.approx(0.35, abs=0.03)
    # A recipe that knows no short and no noise calls both foreign, or out of range.
    plain = family_fit(BENCH, cases.X)
    assert (plain.distance[cases.class_index == 2] > 9.0).mean() > 0.8
