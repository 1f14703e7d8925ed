"""The equations and their discretisation, against scipy's expm, a stiff solver, and the balance of power."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy.linalg import expm

from motor_env import PAPER_MOTOR, MotorParameters, discretize, simulate_states
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
from motor_env.motor.parameters import FloatArray


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
    """Matrices that no motor has, so that each entry counts.

    The expm of [[X, 1, 0], [0, 0, 1], [0, 0, 0]] holds all three (Van Loan 1978).
    """
    matrix = np.eye(6, k=2)
    matrix[:2, :2] = size * np.array(unit)
    entries = matrix[:2, :2].ravel().tolist()
    found = all_three(*entries)
    expected = expm(matrix)[:2]
    for n, block in enumerate(np.hsplit(expected, 3)):
        np.testing.assert_allclose(np.reshape(found[n], (2, 2)), block, rtol=1e-12, atol=1e-15)
    assert exponential_and_phi(*entries) == found[:2]


def test_exponential_of_what_is_infinite_comes_to_an_end() -> None:
    assert not np.isfinite(all_three(-np.inf, 0.0, 0.0, -1.0)).all()


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
    whole = discretize(batch, 1e-4)
    for index in range(7):
        alone = discretize(batch.motor(index), 1e-4)
        assert np.array_equal(whole.transition[index], alone.transition)
        np.testing.assert_allclose(whole.gain[index], alone.gain, rtol=1e-15)
    # One voltage serves all motors, one motor all voltages, and a noise is each case's own.
    rng = np.random.default_rng(1)
    volts, noise = rng.standard_normal((7, 20)), rng.standard_normal((7, 20, 2))
    shared = simulate_states(batch, volts[0], 1e-4, process_noise=noise)
    single = simulate_states(
        PAPER_MOTOR, volts, 1e-4, load_torque_n_m=1e-3 * volts, initial_state=noise[:, 0]
    )
    for n in range(7):
        alone_states = simulate_states(batch.motor(n), volts[0], 1e-4, process_noise=noise[n])
        np.testing.assert_allclose(shared[n], alone_states, rtol=1e-13)
        other = simulate_states(
            PAPER_MOTOR, volts[n], 1e-4, load_torque_n_m=1e-3 * volts[n], initial_state=noise[n, 0]
        )
        np.testing.assert_allclose(single[n], other, rtol=1e-13)


def test_step_of_any_size_stays_finite() -> None:
    ends = [discretize(PAPER_MOTOR, dt_s).gain[:, Input.VOLTAGE] * 12.0 for dt_s in (1.0, 1e3, 1e6)]
    for first, second in pairwise(ends):
        np.testing.assert_allclose(first, second, rtol=1e-9)
    np.testing.assert_allclose(ends[0], steady_state(PAPER_MOTOR, 12.0), rtol=1e-9)


@pytest.mark.parametrize("dt_s", [0.0, -1e-4, float("nan")])
def test_bad_sampling_interval(dt_s: float) -> None:
    with pytest.raises(ValueError, match="dt_s must be finite and > 0"):
        discretize(PAPER_MOTOR, dt_s)


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
