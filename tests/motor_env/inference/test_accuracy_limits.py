"""The tabulated limits against the known ones, on few cases."""

from dataclasses import replace

import numpy as np
import pytest
from limits import class_limits, severity_limit

from motor_env import FaultKind, SensorParameters, SeverityPrior, Timing, load_recipe

BENCH = load_recipe("bench")
BENCH_1KHZ = replace(BENCH, timing=Timing(1_000.0, 0.1))


def test_early_verdicts_know_windings_first_and_bearings_late() -> None:
    known = {20: 0.59, 100: 0.63, 200: 0.74, 400: 0.87, 600: 0.90}
    limits = class_limits(BENCH, 3, 250, tuple(known))
    for (limit, hits), expected in zip(limits, known.values(), strict=True):
        assert abs(limit.expected_accuracy - expected) < 4.0 * limit.standard_error + 0.005
        assert abs(hits - expected) < 4.0 * np.sqrt(expected * (1.0 - expected) / 250)


def test_limits_do_not_depend_on_chunks() -> None:
    """2100 cases take two chunks."""
    (longer,) = class_limits(replace(BENCH_1KHZ, timing=Timing(1_000.0, 0.02)), 3, 2100)
    assert longer[0].standard_error == pytest.approx(0.006, abs=0.002)
    with pytest.raises(ValueError, match="n_cases must be >= 2, got 1"):
        class_limits(BENCH_1KHZ, 3, 1)


def test_severity_limit_of_the_bearing() -> None:
    recipe = replace(BENCH_1KHZ, sensor=SensorParameters(current_noise_a=0.02))
    got = severity_limit(recipe, SeverityPrior(FaultKind.BEARING), 3, 600)
    assert got.expected_rmse == pytest.approx(0.062, rel=0.04)
    assert got.rmse == pytest.approx(got.expected_rmse, rel=0.1)
    assert got.coverage == pytest.approx(0.90, abs=0.04)
