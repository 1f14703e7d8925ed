"""What the drive itself knows: the filter of the healthy motor, and its own speed controller, compiled."""

from __future__ import annotations

import numpy as np

from motor_env.envs.drive.lanes import Block, Task
from motor_env.motor.compiled import inlined
from motor_env.motor.model import load_in_kernel


@inlined
def follow(s: Block, w: Block, j: int, p: Task) -> None:
    """Measure, and let the filter of the healthy motor follow with current, speed and unknown load as its states."""
    measured_i = s.current[j] + p.current_noise_a * float(w.noise[0, j])
    measured_w = s.speed[j] + p.speed_noise_rad_s * float(w.noise[1, j])
    i, speed, load, volts = s.estimated_current[j], s.estimated_speed[j], s.estimated_load[j], s.voltage[j]
    torque = load_in_kernel(p.load_torque_n_m, p.fan_n_m_s2, speed) + load
    expected_i = p.a00 * i + p.a01 * speed + p.b0 * volts + p.e0 * torque
    expected_w = p.a10 * i + p.a11 * speed + p.b1 * volts + p.e1 * torque
    r0, r1 = measured_i - expected_i, measured_w - expected_w
    current = expected_i + p.k00 * r0 + p.k01 * r1
    white_i, white_w = p.w00 * r0, p.w10 * r0 + p.w11 * r1
    into = np.sqrt(1.0 - p.slow_memory * p.slow_memory)
    heat = 0.5 * (i * i + current * current) * p.heating_k_per_a2
    s.measured_current[j], s.measured_speed[j] = measured_i, measured_w
    s.estimated_current[j] = current
    s.estimated_speed[j] = expected_w + p.k10 * r0 + p.k11 * r1
    s.estimated_load[j] = p.load_memory * load + p.k20 * r0 + p.k21 * r1
    s.innovation_current[j], s.innovation_speed[j] = white_i, white_w
    s.slow_current[j] = p.slow_memory * s.slow_current[j] + into * white_i
    s.slow_speed[j] = p.slow_memory * s.slow_speed[j] + into * white_w
    s.estimated_temperature[j] += p.cooling * (heat - s.estimated_temperature[j])


@inlined
def own_share(s: Block, j: int, p: Task) -> float:
    """Voltage of the drive's own controller, LQG with integral action on the healthy motor, in units of the limit."""
    now, then = s.profile[j], s.asked[1, j]
    middle = 0.5 * (now + then)
    torque = load_in_kernel(p.load_torque_n_m, p.fan_n_m_s2, middle) + s.estimated_load[j]
    torque += p.viscous_friction_n_m_s_per_rad * middle + p.inertia_kg_m2 * (then - now) / p.period_s
    current = torque / p.torque_constant_n_m_per_a
    wanted = p.resistance_ohm * current + p.back_emf_constant_v_s_per_rad * middle
    volts = wanted - p.by_current * (s.estimated_current[j] - current)
    volts -= p.by_speed * (s.estimated_speed[j] - now) + p.by_integral * s.integral[j]
    if abs(wanted) < p.voltage_limit_v:
        s.integral[j] += p.period_s * (s.measured_speed[j] - now)
    share: float = volts / p.voltage_limit_v
    return share
