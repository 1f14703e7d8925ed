"""A supply that steps between two samples must not look like another motor."""

from pathlib import Path

import numpy as np
import pytest
from recording_csv import write_csv
from sklearn.base import BaseEstimator

from motor_classifiers import make_method, predict_recording
from motor_classifiers.prediction import UNDECIDED
from motor_datasets import generate_arrays
from motor_env import draw, load_recipe, simulate_states
from motor_env.motor.faults import apply_faults

RECIPE = load_recipe("bench")
FINE = 10  # simulated steps in a sampling interval
N_STARTS = 10


def capture(
    path: Path, index: int, position: float, generator: np.random.Generator, *, with_voltage: bool
) -> Path:
    """A start whose supply steps `position` of a sample after a sample, 0.1 s of quiet before it, as CSV."""
    scenario = draw(RECIPE, 77, np.arange(N_STARTS)).scenario
    fault_class = RECIPE.classes[int(draw(RECIPE, 77, np.arange(N_STARTS)).class_index[index])]
    dt_s = RECIPE.timing.dt_s
    voltage = np.zeros(2300 * FINE)
    voltage[1000 * FINE + round(position * FINE) :] = np.asarray(scenario.supply.voltage_v)[index]
    motor = apply_faults(scenario.parameters.motor(index), fault_class.faults)
    current = simulate_states(motor, voltage, dt_s / FINE)[FINE - 1 :: FINE, 0]
    current = current + RECIPE.sensor.current_noise_a * generator.standard_normal(len(current))
    time_s = np.arange(len(current)) * dt_s
    columns = {"time_s": time_s, "current_a": current}
    if with_voltage:
        columns["voltage_v"] = voltage[FINE - 1 :: FINE] + 0.02 * generator.standard_normal(len(current))
    return write_csv(path, columns)


@pytest.fixture(scope="module")
def model() -> BaseEstimator:
    training = generate_arrays(RECIPE, 3, 1400)
    return make_method("residual-qda", RECIPE, 0).fit(training.X, training.class_name)


@pytest.mark.parametrize(
    ("position", "with_voltage"), [(0.0, False), (0.2, False), (0.5, False), (0.8, False), (0.2, True)]
)
def test_the_step_may_fall_between_samples(
    position: float, with_voltage: bool, model: BaseEstimator, tmp_path: Path
) -> None:
    truth = draw(RECIPE, 77, np.arange(N_STARTS)).class_index
    generator = np.random.default_rng(5)
    found = [
        predict_recording(
            model,
            RECIPE,
            capture(tmp_path / "start.csv", n, position, generator, with_voltage=with_voltage),
        )
        for n in range(N_STARTS)
    ]
    assert all(opinion.verdict != UNDECIDED for opinion in found)
    right = [RECIPE.class_names[truth[n]] == opinion.class_name for n, opinion in enumerate(found)]
    # An offset that must be estimated costs bearings some accuracy (docs/best-possible.md); without the shift onto a
    # sample three quarters are wrong at 0.2 and all are refused at 0.5.
    assert np.mean(right) >= 0.7
