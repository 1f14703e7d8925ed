"""What a record of a motor at work tells: against the truth, and of a motor that is linear."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import log_softmax, softmax

from motor_env import FaultKind, draw, load_recipe
from motor_env.inference.class_model import ClassModel
from motor_env.inference.work_features import work_feature_names, work_features, work_probabilities
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.recipes import FACTORS, FaultClass

# Reaches in: `motor_datasets` keeps what is measured, not the draw; these tests compare the two.
from motor_env.simulation.sampling import measure_draw

OPERATION = load_recipe("operation")
DRAWN = draw(OPERATION, 5, np.arange(150))
CASES = measure_draw(DRAWN, OPERATION, 5).astype(np.float64)


def test_the_severity_of_a_winding_the_fit_and_the_classes() -> None:
    features = work_features(OPERATION, CASES)
    names = work_feature_names(OPERATION)
    assert features.shape == (150, len(names))
    assert np.isfinite(features).all()
    # In units of a range from 0 to 50 %; the temperature takes part of it.
    winding = 0.5 * features[:, names.index("winding_contact")]
    truth = np.asarray(next(f.severity for f in DRAWN.scenario.faults if f.kind == "winding_contact"))
    assert np.quantile(np.abs(winding - truth), 0.9) < 0.05
    # Every fit arrives: noise alone is left, a mean square of 1 with a standard deviation of 0.06.
    left = np.expm1(features[:, -1])
    assert abs(np.median(left) - 1.0) < 0.03
    assert left.max() < 1.3
    logs = features[:, -1 - len(OPERATION.classes) : -1]
    assert (logs.argmax(axis=1) == DRAWN.class_index).mean() > 0.65
    np.testing.assert_allclose(work_probabilities(OPERATION, CASES[:3]), softmax(logs[:3], axis=1))


def test_of_a_linear_motor_features_are_exact(monkeypatch: pytest.MonkeyPatch) -> None:
    """Readings that are linear in the coordinates make the fit a regression, and the classes distances in it."""
    rng, contact = np.random.default_rng(4), FaultKind.WINDING_CONTACT
    classes = (
        FaultClass(),
        FaultClass(FaultKind.BEARING, 0.25),
        FaultClass(contact, 0.10, severity_to=0.50),
        FaultClass(FaultKind.BEARING, 0.20, 2.0, also=(FaultClass(contact, 0.15),)),
    )
    assert OPERATION.field is not None
    # A converter's step of 4 / 2^11 A has the error of a uniform number beside the noise of 2 mA.
    coarse = replace(OPERATION.field, sensor_range_a=2.0, adc_bits=11)
    recipe = replace(OPERATION, classes=classes, shifts=(), field=coarse)
    names = work_feature_names(recipe)
    assert names[:5] == FACTORS
    assert names[11:13] == ("winding_contact", "bearing")
    assert names[13:] == (
        *(f"log_std_{name}" for name in names[11:13]),
        *(f"log_probability_{name}" for name in recipe.class_names),
        "log1p_chi2",
    )
    slopes, sigma = 2e-4 * rng.standard_normal((13, 500)), np.hypot(0.002, 4.0 / 2**11 / np.sqrt(12.0))

    def readings(model: ClassModel, values: FloatArray) -> FloatArray:
        assert model.voltage_v is not None
        return values @ slopes + model.voltage_v

    monkeypatch.setattr(ClassModel, "readings", readings)
    truth = np.hstack([0.3 * rng.standard_normal((3, 5)), rng.uniform(0.3, 0.7, (3, 8))])
    voltage = rng.standard_normal((3, 500))
    read = truth @ slopes + voltage + sigma * rng.standard_normal((3, 500))
    features = work_features(recipe, np.stack([read, voltage], axis=1))
    # Standard normal factors; uniform numbers as normal ones of their variance; severities that hardly have a prior.
    precision, centre = np.repeat([1.0, 12.0, 0.01], [5, 6, 2]), np.repeat([0.0, 0.5, 0.2], [5, 6, 2])
    covariance = np.linalg.inv(slopes @ slopes.T / sigma**2 + np.diag(precision))
    mean = ((read - voltage) @ slopes.T / sigma**2 + precision * centre) @ covariance
    np.testing.assert_allclose(features[:, :13], mean, rtol=1e-6)
    logs = np.tile(0.5 * np.log(np.diag(covariance)[-2:]), (3, 1))
    np.testing.assert_allclose(features[:, 13:15], logs, rtol=1e-6)
    # In units of twice the largest, 0.3 and 0.25: the winding's range counts by its middle.
    away = mean[:, None, -2:] - np.array([[0.0, 0.0], [0.0, 0.5], [0.5, 0.0], [0.25, 0.4]])
    distance = np.einsum("nci,ij,ncj->nc", away, np.linalg.inv(covariance[-2:, -2:]), away)
    expected = log_softmax(np.log([0.2, 0.2, 0.2, 0.4]) - 0.5 * distance, axis=1)
    np.testing.assert_allclose(features[:, 15:19], np.maximum(expected, -12.0), rtol=1e-5)
    left = np.square((read - voltage - mean @ slopes) / sigma).mean(axis=1)
    np.testing.assert_allclose(features[:, 19], np.log1p(left), rtol=1e-3)
