"""The step of the drive, compiled: begin of an episode, plant, fault, heat, filter, speed controller, cost.

What happens in every step goes over all lanes of a block, one equation after the other; what is rare goes lane by lane.
A single environment is the first lane of a block.

The motor is `motor.model.discretize` of the driven motor with its fault; the load torque is that of the speed at the
beginning of a step. All random numbers are of `simulation.random_streams`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from motor_env.envs import layout
from motor_env.envs.drive.drive_setup import LANES, N_CONSTANTS, PARTS, Block, Lanes, Task
from motor_env.envs.layout import BoolArray, Float32Array, WordArray, fixed_tuple, random_uniforms
from motor_env.motor.compiled import compiled, inlined
from motor_env.motor.exponentials import exponentials_and_phis
from motor_env.motor.model import load_in_kernel
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.random_streams import Stream, box_muller, philox

HEALTHY, BEARING, WINDING = range(3)
_CLASS, _ONSET, _SEVERITY = np.uint32(Stream.CLASS), np.uint32(Stream.ONSET), np.uint32(Stream.SEVERITY)
_PROFILE = np.uint32(Stream.PROFILE)


@inlined
def task_of(numbers: FloatArray) -> Task:
    """The constants by name."""
    return Task(*fixed_tuple(numbers, N_CONSTANTS))


@inlined
def _draw_profile(p: Task, words: WordArray, n: int, profile: FloatArray) -> None:
    """Draw plateaus and the ramps between them, until the row is full."""
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
    """Write time, and the scaled profile now and ahead."""
    k = int(s.step[j])
    s.time[j] = s.step[j] / p.horizon
    for m in range(len(lanes.ahead)):
        s.asked[m, j] = s.scale[j] * lanes.profile[n, k + lanes.ahead[m]]


@inlined
def begin_lane(s: Block, j: int, p: Task, lanes: Lanes, n: int) -> None:
    """Draw the next episode of lane n, lane j of its block; the motor begins at the first speed of the profile."""
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


@inlined
def update_filter(s: Block, w: Block, j: int, p: Task) -> None:
    """Measure, and update the filter of the healthy motor, whose states are current, speed and unknown load."""
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
def speed_control(s: Block, j: int, p: Task) -> float:
    """Voltage of the drive's speed controller, LQG with integral action on the healthy motor, in units of the limit."""
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


TRACKING, HEAT, WEAR, LIMPING, STOPPING, FAILURE = range(len(PARTS))
STOP_ABOVE = 0.5
AT_ONCE = 8
"""Motors are discretized in whole groups of so many; a rest would be computed one by one."""

_MEASUREMENT = np.uint32(Stream.MEASUREMENT)


@inlined
def _draw_noise(s: Block, w: Block, lanes: Lanes, first: int, width: int) -> None:
    """Draw four normals for each lane, by the number of its step."""
    low, high = lanes.words[layout.CASE_LOW, first:], lanes.words[layout.CASE_HIGH, first:]
    k0, k1 = lanes.words[layout.SEED_LOW, first:], lanes.words[layout.SEED_HIGH, first:]
    for j in range(width):
        group = np.uint32(np.int32(s.step[j]))
        w.made[0, j], w.made[1, j], w.made[2, j], w.made[3, j] = philox(
            group, _MEASUREMENT, low[j], high[j], k0[j], k1[j]
        )
    for j in range(width):
        w.noise[0, j], w.noise[1, j] = box_muller(w.made[0, j], w.made[1, j])
        w.noise[2, j], w.noise[3, j] = box_muller(w.made[2, j], w.made[3, j])


@inlined
def _grow_faults(s: Block, w: Block, p: Task, width: int) -> int:
    """Let the faults set in and grow over a step; return their number, with their lanes in `w.faulty`."""
    count = 0
    for j in range(width):
        speed = s.speed[j]
        w.torque[j] = p.load_torque_n_m + p.fan_n_m_s2 * speed * abs(speed) + s.load[j]
        w.worn[j] = 0.0
    for j in range(width):
        if s.kind[j] != HEALTHY and s.step[j] >= s.onset[j] and w.stands[j] == 0:
            w.faulty[count] = j
            count += 1
    for place in range(count):
        j = w.faulty[place]
        before, is_bearing = s.severity[j], s.kind[j] == BEARING
        if before == 0.0:
            s.severity[j] = p.bearing_onset if is_bearing else p.winding_onset
        pace = 1.0
        if is_bearing:
            pace += p.stress_share * (max(w.torque[j] * s.speed[j], 0.0) / p.full_power_w - 1.0)
        s.severity[j] *= np.exp(s.growth[j] * p.period_s * pace)
        if is_bearing:
            w.worn[j] = s.severity[j] - before
    return count


@inlined
def _set_motors(s: Block, w: Block, p: Task, count: int) -> None:
    """Discretize the motors of the lanes in `w.faulty`."""
    dt, henry, moment = p.period_s, p.inductance_h, p.inertia_kg_m2
    for place in range(count):
        j = w.faulty[place]
        worse = 1.0 + s.severity[j]
        ohm = p.resistance_ohm * (worse if s.kind[j] == WINDING else 1.0)
        drag = p.viscous_friction_n_m_s_per_rad * (worse if s.kind[j] == BEARING else 1.0)
        w.x[0, place], w.x[1, place] = -ohm / henry * dt, -p.back_emf_constant_v_s_per_rad / henry * dt
        w.x[2, place], w.x[3, place] = p.torque_constant_n_m_per_a / moment * dt, -drag / moment * dt
    whole = -(-count // AT_ONCE) * AT_ONCE
    for place in range(count, whole):
        w.x[0, place] = w.x[1, place] = w.x[2, place] = w.x[3, place] = 0.0
    exponentials_and_phis(whole, w.x, w.exponential, w.phi, w.room)
    by_volt, by_load = dt / henry, -dt / moment
    for place in range(count):
        j = w.faulty[place]
        s.a00[j], s.a01[j] = w.exponential[0, place], w.exponential[1, place]
        s.a10[j], s.a11[j] = w.exponential[2, place], w.exponential[3, place]
        s.b0[j], s.b1[j] = w.phi[0, place] * by_volt, w.phi[2, place] * by_volt
        s.e0[j], s.e1[j] = w.phi[1, place] * by_load, w.phi[3, place] * by_load


@inlined
def _run_motor(s: Block, w: Block, j: int, p: Task) -> None:
    """Advance current, speed, voltage, temperature and unknown load by a step."""
    i, speed = s.current[j], s.speed[j]
    torque = load_in_kernel(p.load_torque_n_m, p.fan_n_m_s2, speed) + s.load[j]
    volts = min(max(w.share[j], -1.0), 1.0) * p.voltage_limit_v
    free = s.a00[j] * i + s.a01[j] * speed + s.e0[j] * torque
    folded = min(max(free + s.b0[j] * volts, -p.current_limit_a), p.current_limit_a)
    volts = min(max((folded - free) / s.b0[j], -p.voltage_limit_v), p.voltage_limit_v)
    current = free + s.b0[j] * volts
    s.speed[j] = s.a10[j] * i + s.a11[j] * speed + s.b1[j] * volts + s.e1[j] * torque
    s.voltage[j], s.current[j] = volts, current
    s.load[j] = p.load_memory * s.load[j] + p.load_stir_n_m * float(w.noise[2, j])
    heat = 0.5 * (i * i + current * current) * p.heating_k_per_a2
    worse = 1.0 + s.severity[j] if s.kind[j] == WINDING else 1.0
    s.temperature[j] += p.cooling * (heat * worse - s.temperature[j])


@inlined
def _price(s: Block, w: Block, p: Task, lanes: Lanes, first: int, width: int) -> None:
    """Add the cost of the step of each lane, and end episodes; -0.0 adds nothing, not even to the sign of a zero."""
    for j in range(width):
        if w.stands[j] == 0:  # the time of a lane that stands may lie beyond its profile
            w.asked[j] = lanes.profile[first + j, int(s.step[j])]
    for j in range(width):
        stands = w.stands[j] != 0
        deviation = (s.speed[j] - s.scale[j] * w.asked[j]) / p.top_speed_rad_s
        error = p.tracking_cost * deviation * deviation
        if p.tracking_limit > 0.0:
            error /= 1.0 + error / p.tracking_limit
        heat = p.heat_cost * max(s.temperature[j] - p.warm_k, 0.0)
        w.parts[TRACKING, j] += -0.0 if stands else -error
        s.heat_due[j] += heat
        s.wear_due[j] += p.wear_cost * w.worn[j]
        w.parts[LIMPING, j] += -0.0 if stands else -p.limp_cost * (1.0 - s.scale[j])
        failure = p.bearing_failure if s.kind[j] == BEARING else p.winding_failure
        broken = s.kind[j] != HEALTHY and s.severity[j] >= failure
        fails = not stands and (broken or s.temperature[j] >= p.burn_k)
        left_s = (p.horizon - (s.step[j] - 1.0)) * p.period_s
        stop = p.stop_cost_per_s * (left_s - p.period_s)
        w.parts[FAILURE, j] += -p.failure_cost - stop if fails else -0.0
        ends = fails or (not stands and s.step[j] >= p.horizon)
        w.over[j] |= np.uint8(ends)


@inlined
def _advance(s: Block, w: Block, p: Task, lanes: Lanes, first: int, width: int) -> None:
    """Advance all lanes of a block by a period."""
    for j in range(width):
        s.scale[j] += min(max(w.aim[j] - s.scale[j], -p.limp_step), p.limp_step)
    _draw_noise(s, w, lanes, first, width)
    _set_motors(s, w, p, _grow_faults(s, w, p, width))
    if p.holds_speed > 0.0:
        for j in range(width):
            w.share[j] = speed_control(s, j, p)
    for j in range(width):
        _run_motor(s, w, j, p)
    for j in range(width):
        update_filter(s, w, j, p)
    for j in range(width):
        s.step[j] += 1.0
    _price(s, w, p, lanes, first, width)
    for j in range(width):
        if w.stands[j] == 0:
            observe_profile(s, j, p, lanes, first + j)


@inlined
def _begin_step(
    s: Block, w: Block, p: Task, lanes: Lanes, first: int, width: int, actions: FloatArray, begins: bool
) -> None:
    """Take the actions; a lane stands in this step if its motor stops, or its next episode begins."""
    for j in range(width):
        w.share[j], decision = actions[first + j, 0], actions[first + j, 1]
        w.aim[j] = p.limp_share if decision > 0.0 else 1.0
        w.over[j] = np.uint8(decision > STOP_ABOVE)
        w.stands[j] = w.over[j]
    for j in range(width):
        stop = -p.stop_cost_per_s * ((p.horizon - s.step[j]) * p.period_s)
        w.parts[STOPPING, j], w.parts[FAILURE, j] = stop if w.over[j] != 0 else 0.0, 0.0
    for j in range(width):
        if begins and lanes.flags[layout.TERMINATED, first + j]:
            begin_lane(s, j, p, lanes, first + j)
            w.parts[STOPPING, j], w.over[j], w.stands[j] = 0.0, 0, 1
    for m in (TRACKING, LIMPING):
        for j in range(width):
            w.parts[m, j] = 0.0 if w.stands[j] != 0 else -0.0


@inlined
def _copy_lane(source: FloatArray, target: FloatArray, j: int) -> None:
    for m in range(source.shape[0]):
        target[m, j] = source[m, j]


@inlined
def _step_block(
    s: Block, w: Block, p: Task, lanes: Lanes, first: int, width: int, actions: FloatArray, begins: bool
) -> None:
    """Advance by the periods of one decision, fewer where the episode ends; lanes that stand are restored."""
    _begin_step(s, w, p, lanes, first, width, actions, begins)
    for _ in range(int(p.periods)):
        standing = 0
        for j in range(width):
            w.stands[j] |= w.over[j]
            standing += w.stands[j]
        if standing > 0:
            for j in range(width):
                if w.stands[j] != 0:
                    _copy_lane(s.everything, w.kept, j)
        if standing < width:
            _advance(s, w, p, lanes, first, width)
        if standing > 0:
            for j in range(width):
                if w.stands[j] != 0:
                    _copy_lane(w.kept, s.everything, j)
    for j in range(width):  # in each step they would tell of the fault to whoever sees the last reward
        w.parts[HEAT, j] = -s.heat_due[j] if w.over[j] != 0 else 0.0
        w.parts[WEAR, j] = -s.wear_due[j] if w.over[j] != 0 else 0.0
    for j in range(width):
        lanes.flags[layout.TERMINATED, first + j] = w.over[j] != 0
        lanes.flags[layout.FAULT_ACTIVE, first + j] = s.severity[j] > 0.0


@compiled
def begin(mask: BoolArray, numbers: FloatArray, *arrays: Any) -> None:
    """Begin the next episodes of the lanes in the mask; `arrays` are those of `Lanes`."""
    p, lanes = task_of(numbers), Lanes(*arrays)
    for n in range(len(mask)):
        if mask[n]:
            begin_lane(lanes.state[n // LANES], n % LANES, p, lanes, n)


@inlined
def _observe_block(s: Block, view: FloatArray, observation: Float32Array, first: int, width: int) -> None:
    for m in range(view.shape[1]):
        unit, least, most, row = view[0, m], view[1, m], view[2, m], observation[m, first:]
        for j in range(width):
            row[j] = np.float32(min(max(s.observed[m, j] / unit, least), most))


@compiled
def observe(state: Any, view: FloatArray, observation: Float32Array) -> None:
    """Write the observation of all lanes in units of `view[0]`, clipped to `view[1]` .. `view[2]`."""
    for first in range(0, observation.shape[1], LANES):
        width = min(LANES, observation.shape[1] - first)
        _observe_block(state[first // LANES], view, observation, first, width)


@compiled
def step(
    actions: FloatArray,
    begins: bool,
    view: FloatArray,
    observation: Float32Array,
    reward: FloatArray,
    parts: FloatArray,
    numbers: FloatArray,
    *arrays: Any,
) -> int:
    """Step all lanes; with `begins`, a lane whose episode is over begins the next one. Return how many are over."""
    p, lanes, n_over = task_of(numbers), Lanes(*arrays), 0
    w = lanes.work[0]
    for first in range(0, len(reward), LANES):
        s, width = lanes.state[first // LANES], min(LANES, len(reward) - first)
        _step_block(s, w, p, lanes, first, width, actions, begins)
        for j in range(width):
            total = 0.0
            for m in range(len(PARTS)):
                total += w.parts[m, j]
            reward[first + j] = total
            n_over += w.over[j]
        for m in range(len(PARTS)):
            row = parts[m, first:]
            for j in range(width):
                row[j] = w.parts[m, j]
        _observe_block(s, view, observation, first, width)
    return n_over
