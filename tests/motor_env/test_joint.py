"""Joint filters against the Cramer-Rao bound and against each other."""

import numpy as np
import pytest

from motor_env.faults import Fault, FaultKind
from motor_env.joint import JointKind, joint_filter, parameter_test_threshold
from motor_env.parameters import PAPER_MOTOR, SensorParameters
from motor_env.simulation import Scenario, Timing, simulate

TIMING = Timing()
FAULTS = (Fault(FaultKind.WINDING_CONTACT, 0.1), Fault(FaultKind.BEARING, 0.25))


@pytest.mark.parametrize("kind", list(JointKind))
def test_estimates_are_near_the_cramer_rao_bound(kind: JointKind) -> None:
    transients = simulate(Scenario(PAPER_MOTOR, faults=FAULTS, timing=TIMING), seed=3, cases=range(120))
    result = joint_filter(
        PAPER_MOTOR,
        SensorParameters(),
        TIMING.dt_s,
        transients.measurements,
        transients.voltage_v[0],
        kind=kind,
    )
    estimate = np.exp(result.log_factor[:, -1])
    # Cramer-Rao bound at 20 mA, 0.1 s: 0.11 % of R, 2.6 % of B for the healthy motor; the faulty one's B shows better.
    assert estimate[:, 0].std() / 1.1 < 0.0016
    assert estimate[:, 1].std() / 1.25 < 0.030
    np.testing.assert_allclose(estimate.mean(axis=0), [1.1, 1.25], rtol=0.01)
    claimed = np.sqrt(np.diagonal(result.covariance[:, -1], axis1=1, axis2=2)).mean(axis=0)
    np.testing.assert_allclose(result.log_factor[:, -1].std(axis=0), claimed, rtol=0.3)


def test_healthy_motors_are_found_faulty_at_the_wanted_rate() -> None:
    transients = simulate(Scenario(PAPER_MOTOR, timing=TIMING), seed=4, cases=range(300))
    result = joint_filter(
        PAPER_MOTOR, SensorParameters(), TIMING.dt_s, transients.measurements, transients.voltage_v[0]
    )
    rate = (result.statistic[:, -1] > parameter_test_threshold(2, 0.1)).mean()
    assert 0.04 < rate < 0.17


def test_bad_input_is_refused() -> None:
    with pytest.raises(ValueError, match="names must be of resistance"):
        joint_filter(PAPER_MOTOR, SensorParameters(), 1e-4, np.zeros((1, 1, 5)), np.zeros(5), names=("mass",))
    with pytest.raises(ValueError, match="measurements must have shape"):
        joint_filter(PAPER_MOTOR, SensorParameters(), 1e-4, np.zeros((1, 5)), np.zeros(5))
