"""The Kalman filter of a fit over one long record: whitened innovations, against a jitted JAX scan that gives the same.

Both update the covariance at each sample, as noise of the voltage enters. Ours also looks whether friction stops the
motor, and allows for missing samples. A fit runs it thousands of times, so that its loop decides how long a fit takes.
"""

import os
from collections.abc import Callable
from typing import Any

os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")

import jax
import jax.numpy as jnp
import numpy as np
from result import Result
from timing import best_rate

from motor_env import MotorParameters, discretize, simulate_states
from motor_env.diagnosis.estimation import parameter_index as index
from motor_env.diagnosis.estimation.ekf import BEGIN
from motor_env.diagnosis.estimation.record import Record
from motor_env.motor.parameters import FloatArray

jax.config.update("jax_enable_x64", True)

N_SAMPLES, DT_S = 2_000, 1e-3
R_OHM, L_H, K_V_S, J_KG_M2, B_N_M_S = 2.0, 1e-3, 0.03, 4e-6, 2e-5
MOTOR = MotorParameters(R_OHM, L_H, K_V_S, K_V_S, J_KG_M2, B_N_M_S)
NOISE_A, NOISE_V = 3e-3, 0.3


def make_record() -> Record:
    """Current of the motor under steps of the voltage, which is held over each interval."""
    rng = np.random.default_rng(5)
    volts = np.repeat(rng.uniform(-12.0, 12.0, N_SAMPLES // 50), 50)
    supplied = volts[:-1] + NOISE_V * rng.standard_normal(N_SAMPLES - 1)
    current = np.append(0.0, simulate_states(MOTOR, supplied, DT_S)[:, 0])
    readings = np.stack([current + NOISE_A * rng.standard_normal(N_SAMPLES), np.zeros(N_SAMPLES)], axis=1)
    return Record(DT_S, volts, readings, np.array([1.0, 0.0]), np.eye(1, N_SAMPLES)[0] * BEGIN)


def scan(record: Record, begin: FloatArray) -> Callable[[], Any]:
    """The filter as a jitted scan, each number by itself; it begins at the state of the other's first sample."""
    model = discretize(MOTOR, DT_S)
    ((a, b), (c, d)), (g, h) = model.transition.tolist(), model.gain[:, 0].tolist()

    def step(carry: Any, given: Any) -> Any:
        (i, w, p, q, r), (volts, shown) = carry, given
        i, w = a * i + b * w + g * volts, c * i + d * w + h * volts
        noise = NOISE_V**2
        p, q, r = (
            a * a * p + 2.0 * a * b * q + b * b * r + noise * g * g,
            a * c * p + (a * d + b * c) * q + b * d * r + noise * g * h,
            c * c * p + 2.0 * c * d * q + d * d * r + noise * h * h,
        )
        error, variance = shown - i, p + NOISE_A**2
        after = (
            i + p / variance * error,
            w + q / variance * error,
            p - p * p / variance,
            q - p * q / variance,
        )
        return (*after, r - q * q / variance), error / jnp.sqrt(variance)

    run = jax.jit(lambda start, given: jax.lax.scan(step, start, given, unroll=4)[1])
    given = (jnp.asarray(record.voltage_v[:-1]), jnp.asarray(record.readings[1:, 0]))
    start = tuple(jnp.float64(value) for value in begin)
    return lambda: jax.block_until_ready(run(start, given))


def run() -> list[Result]:
    """Check that both agree, then measure them. Rates are samples filtered a second."""
    record, p = make_record(), np.zeros(index.N_VALUES)
    p[[index.R, index.L, index.K, index.J, index.B]] = R_OHM, L_H, K_V_S, J_KG_M2, B_N_M_S
    p[[index.NOISE_I, index.NOISE_V]] = NOISE_A, NOISE_V
    ours = record.predict(p)[0]
    # The speed, which is not measured, is known to 30 % of the largest at first, and by the current's change.
    sd_w = np.hypot(0.3 * np.abs(record.voltage_v).max(), L_H / DT_S * NOISE_A) / K_V_S
    peer = scan(record, np.array([*ours[0, 2:4], NOISE_A**2, 0.0, sd_w**2]))
    np.testing.assert_allclose(np.asarray(peer()), ours[1:, 0], atol=1e-6)
    rate = best_rate(lambda: record.predict(p), N_SAMPLES)
    return [
        Result(
            f"filter of a fit, {N_SAMPLES} samples", rate, best_rate(peer, N_SAMPLES), "jitted JAX scan", 2.5
        )
    ]
