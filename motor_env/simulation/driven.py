"""Integration of motors at work: a voltage and a load that change from sample to sample, and a speed loop."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from motor_env.motor.compiled import njit
from motor_env.motor.model import load_in_kernel
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.nonlinear import LANES, Sampling, step_lanes

LOOP_GAIN, LOOP_INTEGRAL = 0.5, 0.05
"""Gains of the speed loop on a back-EMF in volts, and of its sum over the samples."""


class Driving(NamedTuple):
    """What drives and loads drawn cases.

    Attributes:
        voltage_v: applied voltage, or the back-EMF that a speed loop wants, shape (n_cases or 1, n_samples).
        is_loop: whether a loop makes the voltage of it, shape (n_cases,).
        resistance_ohm: that the loop believes in.
        limit_v: largest voltage that the loop can apply, shape (n_cases,).
        load_rise_n_m: what the load gains over the record, shape (n_cases,).
        fan_n_m_s2: load over the square of the speed, shape (n_cases,).
    """

    voltage_v: FloatArray
    is_loop: NDArray[np.bool_]
    resistance_ohm: float
    limit_v: FloatArray
    load_rise_n_m: FloatArray
    fan_n_m_s2: FloatArray


@njit(cache=True, error_model="numpy")
def integrate_driven(
    groups: NDArray[np.void], sampling: Sampling, driving: Driving, noise: FloatArray
) -> None:
    """True current and speed at the end of each sampling interval, and the voltage that was applied in it.

    Voltage and load are held over each sample, the voltage is the last channel.

    Args:
        groups: the cases (`groups_of`); of their supply the resistance and the ripple count alone.
        sampling: what is filled.
        driving: voltage and load.
        noise: of the current that a speed loop sees, shape (n_cases, n_samples); no rows without a loop.
    """
    dt_s, steps, is_current, out = sampling
    wanted, limit = driving.voltage_v, driving.limit_v
    n_cases, last, n_samples = out.shape[0], out.shape[1] - 1, out.shape[2]
    for first in range(0, n_cases, LANES):
        p = groups[first // LANES]
        lanes = min(LANES, n_cases - first)
        still, integral = p.dry.copy(), np.zeros(LANES)
        p.step[:] = dt_s / steps
        for k in range(n_samples):
            for lane in range(lanes):
                n, current, speed = first + lane, p.current[lane], p.speed[lane]
                volts = wanted[n if wanted.shape[0] > 1 else 0, k]
                if driving.is_loop[n] and k > 0:
                    error = volts - (
                        out[n, last, k - 1] - driving.resistance_ohm * (current + noise[n, k - 1])
                    )
                    integral[lane] = min(max(integral[lane] + LOOP_INTEGRAL * error, -limit[n]), limit[n])
                    volts = min(max(volts + LOOP_GAIN * error + integral[lane], -limit[n]), limit[n])
                out[n, last, k] = volts
                p.voltage[lane] = out[n, last, k]  # what is applied is what is recorded
                share = (k + 0.5) / n_samples
                load = load_in_kernel(share * driving.load_rise_n_m[n], driving.fan_n_m_s2[n], abs(speed))
                p.dry[lane] = still[lane] + load
            for _ in range(steps):
                step_lanes(p)
            for lane in range(lanes):
                for c in range(last):
                    out[first + lane, c, k] = p.current[lane] if is_current[c] else p.speed[lane]
