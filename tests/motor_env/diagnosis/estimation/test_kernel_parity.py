"""The compiled fit kernel takes the steps of `discretize` and filters as `KalmanFilter` does."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import pytest
from scipy.linalg import expm

from motor_env import KalmanFilter, MotorParameters, discretize, run_filter, simulate_states
from motor_env.diagnosis.estimation import ekf, parameter_index as index

# Reaches in: `KalmanFilter` has two states; a load that walks is a third.
from motor_env.filters.kalman import measurement_update
from motor_env.motor.model import continuous_model
from motor_env.motor.parameters import FloatArray

MOTORS = {
    "small": (2.0, 1e-3, 0.03, 4e-6, 2e-5),
    "stiff": (10.0, 1e-5, 0.02, 1e-5, 1e-6),
    "underdamped": (0.5, 5e-3, 0.05, 2e-6, 1e-6),
    "large": (0.3, 2e-3, 0.5, 0.05, 1e-3),
    "braked": (5.0, 1e-3, 0.01, 1e-4, 1e-2),
}
"""R, L, K, J, B."""
each_motor = pytest.mark.parametrize("name", MOTORS)
NOISE_I, NOISE_W = 3e-3, 0.2


def motor_of(name: str) -> MotorParameters:
    ohm, henry, constant, inertia, drag = MOTORS[name]
    return MotorParameters(ohm, henry, constant, constant, inertia, drag)


def values(name: str, **given: float) -> FloatArray:
    out = np.zeros(index.N_VALUES)
    out[[index.R, index.L, index.K, index.J, index.B]] = MOTORS[name]
    for place, value in ({"NOISE_I": NOISE_I, "NOISE_W": NOISE_W} | given).items():
        out[getattr(index, place)] = value
    return out


def time_scale_s(motor: MotorParameters) -> float:
    """The fastest one."""
    return 1.0 / float(np.abs(np.linalg.eigvals(continuous_model(motor).transition)).max())


def predicted(
    p: FloatArray,
    dt_s: float,
    voltage: FloatArray,
    readings: FloatArray,
    seen: FloatArray,
    marks: FloatArray,
    *,
    learn: bool,
) -> tuple[FloatArray, float]:
    """Table and sum of log variances of the kernel for one vector of values."""
    out, logs, reach = (
        np.zeros((1, len(voltage), 6)),
        np.zeros(1),
        1e-9 + np.abs(voltage).max(keepdims=True)[0],
    )
    which, room = np.zeros(1, int), ekf.room_to_work()
    ekf.predict_each(
        p[None], dt_s, voltage[None], marks[None], reach, which, readings, seen, learn, out, logs, room
    )
    return out[0], float(logs[0])


def steps(name: str, dt_s: float) -> Iterator[FloatArray]:
    """What one interval makes of each input alone: current, speed, a voltage held, one that rises to 1 V, torque."""
    for column in range(5):
        begin, before, rise, torque = np.split(np.eye(5)[column], [2, 3, 4])
        voltage = np.tile([before[0], before[0] + rise[0]], (2, 1))
        p, readings, marks = (
            values(name, LOAD=torque[0]),
            np.tile(begin, (2, 1)),
            np.array([ekf.BEGIN, 0.0]),
        )
        table, _ = predicted(p, dt_s, voltage, readings, np.ones(2), marks, learn=False)
        yield table[1, 2:4]


@each_motor
@pytest.mark.parametrize("share", [0.01, 1.0, 30.0])
def test_a_step_is_the_exact_one(name: str, share: float) -> None:
    """Against `discretize`, and for a rising voltage the exponential of motor, voltage and its rise as one system."""
    motor = motor_of(name)
    dt_s = share * time_scale_s(motor)
    current, speed, held, rising, torque = steps(name, dt_s)
    model = discretize(motor, dt_s)
    np.testing.assert_allclose(np.stack([current, speed], axis=1), model.transition, rtol=1e-12)
    np.testing.assert_allclose(np.stack([held, torque], axis=1), model.gain, rtol=1e-12)
    whole, (slope, gain) = np.eye(4, k=1), continuous_model(motor)
    whole[:2, :2], whole[:2, 2] = slope * dt_s, gain[:, 0] * dt_s
    np.testing.assert_allclose(np.stack([held, rising], axis=1), expm(whole)[:2, 2:], rtol=1e-12)


class Recorded(NamedTuple):
    """A motor at work, as it is recorded: readings, the voltage held before each of them."""

    dt_s: float
    volts: FloatArray
    readings: FloatArray

    def predict(self, p: FloatArray, seen: FloatArray) -> tuple[FloatArray, float]:
        """Table and sum of log variances of the kernel."""
        voltage, marks = np.stack([self.volts, self.volts], axis=1), np.eye(1, len(self.volts))[0]
        return predicted(p, self.dt_s, voltage, self.readings, seen, marks, learn=True)


def recorded(name: str, load: float, noise_v: float) -> Recorded:
    rng, n, motor = np.random.default_rng(5), 81, motor_of(name)
    dt_s = 0.7 * time_scale_s(motor)
    volts = np.append(0.0, np.repeat(rng.uniform(-12.0, 12.0, 8), 10))
    supplied = volts + noise_v * rng.standard_normal(n)
    begin = [0.4, 20.0]
    states = simulate_states(motor, supplied[1:], dt_s, load_torque_n_m=load, initial_state=begin)
    noise = rng.standard_normal((n, 2)) * [NOISE_I, NOISE_W]
    return Recorded(dt_s, volts, np.vstack([begin, states]) + noise)


def begun(p: FloatArray, record: Recorded, seen: FloatArray) -> FloatArray:
    """Variances of current, speed and load where the kernel begins; what is not recorded is known to 30 %."""
    reach, sd_i, sd_w = float(np.abs(record.volts).max()) + 1e-9, NOISE_I, NOISE_W
    if not seen[1]:
        sd_w = np.hypot(0.3 * reach, p[index.L] / record.dt_s * NOISE_I) / p[index.K]
    if not seen[0]:
        sd_i = 0.3 * reach / p[index.R]
    return np.square([sd_i, sd_w, 0.1 * p[index.K] * reach / p[index.R]])


each_sensor = pytest.mark.parametrize(
    "seen", [[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]], ids=["current", "speed", "both"]
)


@each_motor
@each_sensor
@pytest.mark.parametrize(("load", "noise_v"), [(0.0, 0.0), (0.002, 0.3)])
def test_innovations_are_those_of_run_filter(
    name: str, seen: list[float], load: float, noise_v: float
) -> None:
    """Its Cholesky factor whitens a reading given those before it, as the kernel does by one update after the other."""
    record, is_seen = recorded(name, load, noise_v), np.array(seen) > 0.0
    p = values(name, LOAD=load, NOISE_V=noise_v)
    out, logs = record.predict(p, np.array(seen))
    model = discretize(motor_of(name), record.dt_s)
    by_volt = noise_v * model.gain[:, 0]
    kalman = KalmanFilter(
        model=model,
        observation=np.eye(2)[is_seen],
        process_covariance=np.outer(by_volt, by_volt),
        measurement_covariance=np.diag(np.square([NOISE_I, NOISE_W])[is_seen]),
        initial_state=out[0, 2:4],
        initial_covariance=np.diag(begun(p, record, np.array(seen))[:2]),
    )
    volts = record.volts[1:]
    expected = run_filter(kalman, record.readings[1:, is_seen].T, volts, load)
    assert np.abs(expected.whitened).max() < 6.0  # none is wild
    np.testing.assert_allclose(out[1:, :2][:, is_seen], expected.whitened, rtol=1e-9, atol=1e-9)
    inputs = np.stack([volts, np.full_like(volts, load)], axis=1)
    states = np.vstack([out[0, 2:4], expected.state[:-1]])
    predicted = states @ model.transition.T + inputs @ model.gain.T
    peaks = np.abs(predicted).max(axis=0)
    np.testing.assert_allclose(out[1:, 2:4] / peaks, predicted / peaks, rtol=1e-9, atol=1e-9)
    assert logs == pytest.approx(np.linalg.slogdet(expected.innovation_covariance)[1].sum(), rel=1e-9)


@each_motor
@each_sensor
def test_a_load_that_walks_is_a_third_state(name: str, seen: list[float]) -> None:
    """`KalmanFilter` has two: here the update of the library's larger filters, sample by sample."""
    record, is_seen = recorded(name, 0.002, 0.3), np.array(seen) > 0.0
    p = values(name, LOAD=0.001, NOISE_V=0.3, WALK=0.02)
    out, logs = record.predict(p, np.array(seen))
    model = discretize(motor_of(name), record.dt_s)
    transition, by_volt = np.eye(3), np.append(model.gain[:, 0], 0.0)
    transition[:2, :2], transition[:2, 2] = model.transition, model.gain[:, 1]
    process = 0.3**2 * np.outer(by_volt, by_volt) + np.diag([0.0, 0.0, 0.02**2 * record.dt_s])
    noise, observation = np.diag(np.square([NOISE_I, NOISE_W])[is_seen]), np.eye(3)[:2][is_seen]
    state = np.append(out[0, 2:4], 0.001)[None]
    covariance, log_variances = np.diag(begun(p, record, np.array(seen)))[None], 0.0
    for k in range(1, len(out)):
        state = state @ transition.T + by_volt * record.volts[k]
        covariance = transition @ covariance @ transition.T + process
        np.testing.assert_allclose(out[k, 2:4], state[0, :2], rtol=1e-9, atol=1e-9)
        measured = record.readings[k : k + 1, is_seen]
        step = measurement_update(state, covariance, measured, observation=observation, noise=noise)
        factor = np.linalg.cholesky(step.innovation_covariance[0])
        white = np.linalg.solve(factor, step.innovation[0])
        assert np.abs(white).max() < 6.0
        np.testing.assert_allclose(out[k, :2][is_seen], white, rtol=1e-9, atol=1e-9)
        log_variances += 2.0 * np.log(np.diag(factor)).sum()
        state, covariance = step.state, step.covariance
        assert out[k, 4] == pytest.approx(state[0, 2] - 0.001, rel=1e-9, abs=1e-12)
    assert logs == pytest.approx(log_variances, rel=1e-9)
