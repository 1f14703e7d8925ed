"""Consistency checks keep their level and see what is wrong; process noise is found and absorbs faults."""

from collections.abc import Callable

import numpy as np
import pytest

from motor_env.detection.rules import Cusum
from motor_env.filters.batch import run_filter
from motor_env.filters.consistency import check_consistency
from motor_env.filters.kalman import DEFAULT_PROCESS_NOISE_STD, KalmanFilter
from motor_env.filters.process_noise import choose_process_noise, matched_power, signature_energy
from motor_env.motor.faults import Fault, FaultKind, apply_fault
from motor_env.motor.parameters import PAPER_MOTOR, FloatArray, SensorParameters
from motor_env.simulation.simulate import Scenario, Timing, simulate

SENSOR = SensorParameters()


def test_white_innovations_are_rejected_at_the_level() -> None:
    noise = np.random.default_rng(1).standard_normal((1500, 300, 1))
    rejected = sum(not check_consistency(row, level=0.05).holds for row in noise)
    assert 0.02 * 1500 < rejected < 0.08 * 1500
    everything = check_consistency(noise)
    assert everything.holds
    assert everything.warning == ""
    assert everything.coverage == pytest.approx(0.95, abs=0.002)


@pytest.mark.parametrize(
    ("spoil", "word"),
    [
        (lambda x: x + 0.3, "mean is not 0"),
        (lambda x: 1.3 * x, "mean square is"),
        (lambda x: (x + 0.5 * np.roll(x, 1, axis=0)) / np.sqrt(1.25), "correlated in time"),
    ],
)
def test_each_kind_of_inconsistency_is_named(spoil: Callable[[FloatArray], FloatArray], word: str) -> None:
    noise = np.random.default_rng(2).standard_normal((1000, 1))
    noise[100:110] = np.nan
    spoiled = check_consistency(np.where(np.isnan(noise), np.nan, spoil(np.nan_to_num(noise))))
    assert not spoiled.holds
    assert word in spoiled.warning
    assert spoiled.n_values == 990


def test_too_much_process_noise_absorbs_a_bearing_fault() -> None:
    faulty = apply_fault(PAPER_MOTOR, Fault(FaultKind.BEARING, 0.1))
    voltage = np.full(1000, 12.0)
    beliefs = [
        KalmanFilter.from_parameters(PAPER_MOTOR, SENSOR, 1e-4, process_noise_std=std)
        for std in ((0.0, 0.0), (1e-5, 1e-3), (1e-2, 0.316))
    ]
    energy = [signature_energy(belief, faulty, voltage, 1e-4) for belief in beliefs]
    # Without process noise it is the separation of the two known signals, 3.8 at 20 mA.
    assert energy[0] == pytest.approx(3.8, abs=0.1)
    assert energy[0] > energy[1] > energy[2]
    assert energy[2] < 1.0


def test_too_much_process_noise_blinds_a_cusum() -> None:
    """A residual against a threshold from healthy transients, at 1 % false alarms."""
    timing, fault = Timing(), Fault(FaultKind.BEARING, 0.1)
    healthy = simulate(Scenario(PAPER_MOTOR, timing=timing), seed=1, cases=range(500))
    faulty = simulate(Scenario(PAPER_MOTOR, faults=(fault,), timing=timing), seed=2, cases=range(200))
    rule, found = Cusum(shift=0.13, two_sided=True), []
    for std in (DEFAULT_PROCESS_NOISE_STD, (1e-2, 0.316)):
        belief = KalmanFilter.from_parameters(PAPER_MOTOR, SENSOR, timing.dt_s, process_noise_std=std)
        largest = [
            rule.statistic(run_filter(belief, t.measurements, t.voltage_v[0]).whitened).max(axis=1)
            for t in (healthy, faulty)
        ]
        found.append((largest[1] > np.quantile(largest[0], 0.99)).mean())
    assert found[0] > 0.65
    assert found[1] < 0.08


def test_the_power_of_a_matched_test_is_that_of_two_normals() -> None:
    assert matched_power(0.0, 0.01) == pytest.approx(0.01)
    generator = np.random.default_rng(3)
    healthy, faulty = generator.standard_normal(200_000), generator.standard_normal(200_000) + 3.0
    found = (faulty > np.quantile(healthy, 0.99)).mean()
    assert matched_power(3.0, 0.01) == pytest.approx(found, abs=0.01)


@pytest.mark.parametrize("true_std", [(0.0, 0.0), (5e-3, 0.5)])
def test_process_noise_is_found_from_healthy_data(true_std: tuple[float, float]) -> None:
    scenario = Scenario(PAPER_MOTOR, timing=Timing(duration_s=0.05), process_noise_std=true_std)
    transients = simulate(scenario, seed=5, cases=range(40))
    faulty = apply_fault(PAPER_MOTOR, Fault(FaultKind.BEARING, 0.1))
    design = choose_process_noise(
        PAPER_MOTOR, SENSOR, 1e-4, transients.measurements, transients.voltage_v[0], faulty=(faulty,)
    )
    assert design.consistency.holds
    kept = design.separation[0] / design.separation_without[0]
    assert kept < 0.6 if true_std[0] else kept == pytest.approx(1.0, abs=1e-3)
    if true_std[0]:
        assert design.scale == pytest.approx(0.5, rel=0.2)
    else:
        assert design.scale == pytest.approx(1e-6)


def test_bad_input_is_refused() -> None:
    with pytest.raises(ValueError, match=r"n_samples > 20"):
        check_consistency(np.zeros((20, 1)))
    with pytest.raises(ValueError, match="must hold a measured sample"):
        check_consistency(np.full((30, 1), np.nan))
