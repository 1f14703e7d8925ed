"""Parameters, the equations and their discretisation, against scipy's expm and by hand."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy.linalg import expm

from motor_env import (
    PAPER_MOTOR,
    Channel,
    MotorParameters,
    SensorParameters,
    SupplyParameters,
    discretize,
    simulate_states,
)
from motor_env.motor.compiled import njit
from motor_env.motor.exponentials import ROOM, exponentials_and_phis
from motor_env.motor.model import (
    Input,
    State,
    continuous_model,
    exponential_and_phi,
    exponential_and_phis,
    steady_state,
)
from motor_env.motor.parameters import (
    CATALOGUE,
    COPPER_PER_KELVIN,
    FRICTION_PER_KELVIN,
    MAGNET_PER_KELVIN,
    PAPER_MATRICES_DT_S,
    PAPER_MATRICES_MOTOR,
    RAD_S_PER_RPM,
    FloatArray,
    require_plausible,
)


def motors() -> st.SearchStrategy[MotorParameters]:
    """Motors from a watch's to a rolling mill's: each parameter over several decades."""

    def decades(low: int, high: int) -> st.SearchStrategy[float]:
        return st.floats(low, high).map(lambda exponent: 10.0**exponent)

    friction = st.one_of(st.just(0.0), decades(-9, -2))
    return st.builds(
        MotorParameters,
        decades(-2, 2),
        decades(-6, -1),
        decades(-3, 0),
        decades(-3, 0),
        decades(-8, -1),
        friction,
    )


def augmented_expm(motor: MotorParameters, dt_s: float) -> tuple[FloatArray, FloatArray]:
    """Ad and Bd from expm of [[A, B], [0, 0]] dt (Van Loan 1978)."""
    model = continuous_model(motor)
    matrix = np.zeros((4, 4))
    matrix[:2, :2], matrix[:2, 2:] = model.transition, model.gain
    exponential = expm(matrix * dt_s)
    return exponential[:2, :2], exponential[:2, 2:]


@given(motor=motors(), shift=st.floats(-6.0, 1.5))
def test_discretisation_against_expm(motor: MotorParameters, shift: float) -> None:
    # dt from a millionth to thirty times the fastest time scale; far beyond it expm itself loses digits.
    model = continuous_model(motor)
    dt_s = 10.0**shift / float(np.abs(np.linalg.eigvals(model.transition)).max())
    discrete = discretize(motor, dt_s)
    transition, gain = augmented_expm(motor, dt_s)
    # Errors count in balanced units: amperes and rad/s differ by decades.
    balance = np.sqrt(np.abs(model.transition[0, 1] / model.transition[1, 0]))
    units = np.array([[1.0, 1.0 / balance], [balance, 1.0]])
    assert np.abs((discrete.transition - transition) * units).max() < 1e-10
    for column in Input:
        scale = np.abs(gain[:, column] * np.array([1.0, balance])).max()
        error = np.abs((discrete.gain - gain)[:, column] * np.array([1.0, balance])).max()
        assert error < 1e-9 * scale


@njit()
def all_three(a: float, b: float, c: float, d: float) -> tuple[tuple[float, ...], ...]:
    """As it stands in its callers, which compile it."""
    answer: tuple[tuple[float, ...], ...] = exponential_and_phis(a, b, c, d)
    return answer


@pytest.mark.parametrize("size", [0.1, 0.9, 20.0])
@pytest.mark.parametrize(
    "unit", [[[-1.0, 0.0], [0.7, -0.2]], [[-1.0, 0.6], [0.0, -0.3]], [[0.4, 5.0], [-0.01, 0.1]]]
)
def test_exponential_and_phi_of_any_matrix(unit: list[list[float]], size: float) -> None:
    """Of matrices that no motor has: the expm of [[X, 1, 0], [0, 0, 1], [0, 0, 0]] holds all three (Van Loan 1978)."""
    matrix = np.eye(6, k=2)
    matrix[:2, :2] = size * np.array(unit)
    entries = matrix[:2, :2].ravel().tolist()
    found = all_three(*entries)
    expected = expm(matrix)[:2]
    for n, block in enumerate(np.hsplit(expected, 3)):
        np.testing.assert_allclose(np.reshape(found[n], (2, 2)), block, rtol=1e-12, atol=1e-15)
    assert exponential_and_phi(*entries) == found[:2]


def test_signs_of_the_equations() -> None:
    model = continuous_model(PAPER_MOTOR)
    current, speed, voltage, load = 2.0, 300.0, 12.0, 1e-3
    derivative = model.transition @ [current, speed] + model.gain @ [voltage, load]
    assert derivative[State.CURRENT] == pytest.approx((12.0 - 2.18 * 2.0 - 0.02352 * 300.0) / 0.238e-3)
    assert derivative[State.SPEED] == pytest.approx((0.0235 * 2.0 - 1.2e-6 * 300.0 - 1e-3) / 1.07e-6)


def test_steady_state_is_where_the_simulation_ends() -> None:
    loads = np.array([0.0, 5e-3])
    states = simulate_states(PAPER_MOTOR, np.full((2, 2000), 12.0), 1e-4, load_torque_n_m=loads[:, None])
    np.testing.assert_allclose(states[:, -1], steady_state(PAPER_MOTOR, 12.0, loads), rtol=1e-10)


def test_a_batch_is_its_motors() -> None:
    factors = np.linspace(0.5, 2.0, 7)
    batch = PAPER_MOTOR.scaled(resistance_ohm=factors, inertia_kg_m2=factors[::-1])
    rng = np.random.default_rng(1)
    volts, noise = rng.standard_normal((7, 20)), rng.standard_normal((7, 20, 2))
    whole, shared = discretize(batch, 1e-4), simulate_states(batch, volts[0], 1e-4, process_noise=noise)
    begin: dict[str, Any] = {"load_torque_n_m": 1e-3 * volts, "initial_state": noise[:, 0]}
    single = simulate_states(PAPER_MOTOR, volts, 1e-4, **begin)
    for n in range(7):
        alone = discretize(batch.motor(n), 1e-4)
        assert np.array_equal(whole.transition[n], alone.transition)
        np.testing.assert_allclose(whole.gain[n], alone.gain, rtol=1e-15)
        states = simulate_states(batch.motor(n), volts[0], 1e-4, process_noise=noise[n])
        np.testing.assert_allclose(shared[n], states, rtol=1e-13)
        states = simulate_states(PAPER_MOTOR, volts[n], 1e-4, **{name: row[n] for name, row in begin.items()})
        np.testing.assert_allclose(single[n], states, rtol=1e-13)


@njit(error_model="numpy", _nrt=False)
def side_by_side(count: int, room: FloatArray) -> None:
    """The exponentials of many motors, as a compiled step calls them."""
    exponentials_and_phis(count, room[:4], room[4:8], room[8:12], room[12:])


def test_many_exponentials_are_to_the_bit_those_of_one() -> None:
    rng, room = np.random.default_rng(0), np.zeros((12 + ROOM, 40))
    entries = rng.standard_normal((4, 40)) * 10.0 ** rng.uniform(-3, 2, (4, 40))
    entries[[1, 2], [5, 7]], entries[:, 9] = 0.0, 0.0
    room[:4] = entries
    side_by_side(40, room)
    for n, matrix in enumerate(entries.T):
        whole, phi = exponential_and_phi(*matrix)
        assert (tuple(room[4:8, n]), tuple(room[8:12, n])) == (whole, phi)


def test_only_friction_may_be_zero_and_each_entry_of_a_batch_counts() -> None:
    assert PAPER_MOTOR.scaled(viscous_friction_n_m_s_per_rad=0.0).viscous_friction_n_m_s_per_rad == 0.0
    for field in PAPER_MOTOR.__slots__[:-1]:
        with pytest.raises(ValueError, match=f"{field} must be finite and > 0, got 0"):
            PAPER_MOTOR.scaled(**{field: np.array([1.0, 0.0])})


def test_time_constants_of_the_paper_motor() -> None:
    # 2.18 ohm and 0.238 mH; J R / (Kt Kb + R B) by hand.
    assert PAPER_MOTOR.electrical_time_constant_s == pytest.approx(0.238e-3 / 2.18)
    assert PAPER_MOTOR.mechanical_time_constant_s == pytest.approx(
        1.07e-6 * 2.18 / (0.0235 * 0.02352 + 2.18 * 1.2e-6)
    )


def test_sensor_rows_follow_the_channels() -> None:
    sensor = SensorParameters((Channel.SPEED, Channel.CURRENT), current_noise_a=0.02, speed_noise_rad_s=3.0)
    assert sensor.observation.tolist() == [[0.0, 1.0], [1.0, 0.0]]
    assert sensor.noise_std.tolist() == [3.0, 0.02]
    assert SensorParameters().observation.tolist() == [[1.0, 0.0]]


def test_the_papers_motor_and_the_constants_of_physics_stand_as_printed() -> None:
    """The paper's table (part 2B), what its printed matrices come from, IEC 60028, and round numbers for the rest."""
    assert CATALOGUE == {"paper": PAPER_MOTOR, "paper-matrices": PAPER_MATRICES_MOTOR}
    printed = (2.18, 0.238e-3, 0.02352, 0.0235, 1.07e-6, 12e-7)
    assert MotorParameters(*printed) == PAPER_MOTOR
    assert PAPER_MATRICES_MOTOR.resistance_ohm == pytest.approx(2.06, rel=1e-12)
    assert PAPER_MATRICES_MOTOR.inductance_h == pytest.approx(2.38e-3, rel=1e-12)
    assert replace(PAPER_MATRICES_MOTOR, resistance_ohm=2.18, inductance_h=0.238e-3) == PAPER_MOTOR
    assert PAPER_MATRICES_DT_S == 0.01
    assert (COPPER_PER_KELVIN, MAGNET_PER_KELVIN, FRICTION_PER_KELVIN) == (0.00393, -0.001, -0.003)
    assert pytest.approx(math.tau) == 60.0 * RAD_S_PER_RPM
    sensor = SensorParameters()
    assert (sensor.current_noise_a, sensor.speed_noise_rad_s) == (0.02, 1.0)
    assert SupplyParameters().voltage_v == 12.0
    assert sensor.with_noise(3.0) == SensorParameters(current_noise_a=0.06, speed_noise_rad_s=3.0)


@pytest.mark.parametrize("field", PAPER_MOTOR.__slots__)
def test_numbers_beyond_every_motor_are_refused(field: str) -> None:
    for value in (1e-15, 1e12):
        require_plausible(replace(PAPER_MOTOR, **{field: value}), "motor")
    for value in (0.999e-15, 1.001e12):
        with pytest.raises(ValueError, match=rf"^motor\.{field} must be in 1e-15 .. 1e\+12, got "):
            require_plausible(replace(PAPER_MOTOR, **{field: value}), "motor")
