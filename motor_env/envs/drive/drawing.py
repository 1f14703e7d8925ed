"""How an episode of the drive begins: profile, fault, and the motor at its first speed, compiled."""

from __future__ import annotations

import numpy as np

from motor_env.envs import layout
from motor_env.envs.compiling import fixed_tuple
from motor_env.envs.drive.lanes import N_CONSTANTS, Block, Lanes, Task
from motor_env.envs.layout import WordArray, random_uniforms
from motor_env.motor.compiled import inlined
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.random_streams import Stream

HEALTHY, BEARING, WINDING = range(3)
_CLASS, _ONSET, _SEVERITY = np.uint32(Stream.CLASS), np.uint32(Stream.ONSET), np.uint32(Stream.SEVERITY)
_PROFILE = np.uint32(Stream.PROFILE)


@inlined
def task_of(numbers: FloatArray) -> Task:
    """The constants by name: as single numbers they cost nothing."""
    return Task(*fixed_tuple(numbers, N_CONSTANTS))


@inlined
def _draw_profile(p: Task, words: WordArray, n: int, profile: FloatArray) -> None:
    """Plateaus and the ramps between them, until the row is full."""
    k, segment, speed = 0, 0, 0.0
    while k < len(profile):
        level, length, rise, _ = random_uniforms(_PROFILE, segment, words, n)
        aim = p.lowest_speed_rad_s + (p.top_speed_rad_s - p.lowest_speed_rad_s) * level
        if segment > 0:
            ramp_s = p.shortest_ramp_s + (p.longest_ramp_s - p.shortest_ramp_s) * rise
            ramp = int(np.ceil(ramp_s / p.period_s))
            for m in range(min(ramp, len(profile) - k)):
                profile[k + m] = speed + (aim - speed) * (m + 1) / ramp
            k += ramp
        plateau_s = p.shortest_plateau_s + (p.longest_plateau_s - p.shortest_plateau_s) * length
        plateau = int(np.ceil(plateau_s / p.period_s))
        for m in range(k, min(k + plateau, len(profile))):
            profile[m] = aim
        k, segment, speed = k + plateau, segment + 1, aim


@inlined
def observe_profile(s: Block, j: int, p: Task, lanes: Lanes, n: int) -> None:
    """What is asked of the speed now and later, as it is scaled now."""
    k = int(s.step[j])
    s.time[j] = s.step[j] / p.horizon
    for m in range(len(lanes.ahead)):
        s.asked[m, j] = s.scale[j] * lanes.profile[n, k + lanes.ahead[m]]


@inlined
def begin_lane(s: Block, j: int, p: Task, lanes: Lanes, n: int) -> None:
    """Draw the next episode of lane n, lane j of its block; the motor begins as it holds the begin of the profile."""
    words, profile = lanes.words, lanes.profile[n]
    layout.begin_episode(words, lanes.flags, n)
    for m in range(s.everything.shape[0]):
        s.everything[m, j] = 0.0
    _draw_profile(p, words, n, profile)
    u = random_uniforms(_CLASS, 0, words, n)[0]
    kind = HEALTHY if u < p.healthy_share else (BEARING if u < p.no_winding_share else WINDING)
    s.kind[j], s.onset[j] = kind, -1.0
    if kind != HEALTHY:
        s.onset[j] = p.earliest_onset
        if p.log_stay > -np.inf:
            s.onset[j] += np.floor(np.log(random_uniforms(_ONSET, 0, words, n)[0]) / p.log_stay)
        share = random_uniforms(_SEVERITY, 0, words, n)[0]
        s.growth[j] = p.slowest_growth_per_s * np.exp(p.log_growth_range * share)
    speed = profile[0]
    current = (
        p.load_torque_n_m + p.fan_n_m_s2 * speed * speed + p.viscous_friction_n_m_s_per_rad * speed
    ) / p.torque_constant_n_m_per_a
    s.current[j] = s.estimated_current[j] = s.measured_current[j] = current
    s.speed[j] = s.estimated_speed[j] = s.measured_speed[j] = speed
    s.voltage[j] = p.resistance_ohm * current + p.back_emf_constant_v_s_per_rad * speed
    s.scale[j] = 1.0
    s.a00[j], s.a01[j], s.a10[j], s.a11[j] = p.a00, p.a01, p.a10, p.a11
    s.b0[j], s.b1[j], s.e0[j], s.e1[j] = p.b0, p.b1, p.e0, p.e1
    observe_profile(s, j, p, lanes, n)
