"""The step of the drive, compiled: plant, filter, fault, heat, cost, and the drawing of episodes.

A lane is a sub-environment: a row of `state`, a column of the words and the flags, a row of `profile`. A single
environment has one lane and runs the same code.

The motor is `motor.model.discretize` of the driven motor with its fault; the load torque is that of the speed at the
beginning of a step. A test compares it with that function. All random numbers are of `simulation.random_streams`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from motor_env.envs import layout
from motor_env.envs.compiling import compiled, inlined
from motor_env.envs.layout import BoolArray, Float32Array, WordArray
from motor_env.envs.noise import four_normals
from motor_env.motor.model import exponential_and_phi, load_in_kernel
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.random_streams import Stream

# A lane: the truth, what the filter believes, and what is observed; from PROFILE on, the profile now and ahead.
CURRENT, SPEED, LOAD, TEMPERATURE, SEVERITY, KIND, ONSET, GROWTH = range(8)
ESTIMATED_CURRENT, ESTIMATED_SPEED, STEP, INTEGRAL = range(8, 12)
MEASURED_CURRENT, MEASURED_SPEED, ESTIMATED_LOAD, WHITE_CURRENT, WHITE_SPEED = range(12, 17)
SLOW_CURRENT, SLOW_SPEED, VOLTAGE, ESTIMATED_TEMPERATURE, SCALE, TIME, PROFILE = range(17, 24)

# The task: motor, limits, load, profile, fault, heat, costs, filter.
R, L, KE, KT, J, B, DT, MOST_V, MOST_A, BASE_LOAD, FAN, KEPT, STIR = range(13)
LOWEST, TOP, PLATEAU_0, PLATEAU_1, RAMP_0, RAMP_1 = range(13, 19)
HEALTHY_SHARE, BEARING_SHARE, EARLIEST, LOG_STAY, SLOWEST, LOG_RANGE, STRESS_SHARE, FULL_POWER = range(19, 27)
ONSET_SEVERITY, FAILURE_SEVERITY = 27, 29  # two each
TO_K, COOLING, WARM, BURN, LIMP_SHARE, LIMP_STEP, NOISE_A, NOISE_SPEED, HORIZON = range(31, 40)
TRACKING_COST, HEAT_COST, WEAR_COST, FAILURE_COST, STOP_COST, LIMP_COST = range(40, 46)
F00, F01, F10, F11, G0, G1, E0, E1 = range(46, 54)
K00, K01, K10, K11, K20, K21, W00, W10, W11, SLOW = range(54, 64)
TRACKING_LIMIT, HOLDS_SPEED, BY_CURRENT, BY_SPEED, BY_INTEGRAL, REPEATS = range(64, 70)
N_CONSTANTS = 70
PARTS = ("tracking", "heat", "wear", "limp", "stop", "failure")
"""What a reward is made of."""
STOP_ABOVE = 0.5
BEARING, WINDING = 1, 2

_CLASS, _ONSET, _SEVERITY = np.uint32(Stream.CLASS), np.uint32(Stream.ONSET), np.uint32(Stream.SEVERITY)
_PROFILE = np.uint32(Stream.PROFILE)


class Lanes(NamedTuple):
    """The task, and everything that changes.

    Attributes:
        numbers: constants, shape (N_CONSTANTS,).
        ahead: steps ahead at which the profile is observed.
        state: shape (n_lanes, n_fields).
        words: of what the random numbers depend on, shape (4, n_lanes).
        flags: shape (4, n_lanes).
        profile: speeds, shape (n_lanes, n_steps and what is seen beyond).
    """

    numbers: FloatArray
    ahead: NDArray[np.int64]
    state: FloatArray
    words: WordArray
    flags: BoolArray
    profile: FloatArray


@inlined
def _unpack(
    numbers: FloatArray,
    ahead: NDArray[np.int64],
    state: FloatArray,
    words: WordArray,
    flags: BoolArray,
    profile: FloatArray,
) -> Lanes:
    """The arrays with which a compiled function is called, by name: a named tuple costs ten times as much a call."""
    return Lanes(numbers, ahead, state, words, flags, profile)


@inlined
def _uniforms(stream: np.uint32, group: int, words: WordArray, n: int) -> tuple[float, ...]:
    """Four uniform numbers in (0, 1) of the episode that lane n runs."""
    a, b, c, d = layout.random_words(stream, group, words, n)
    unit = 2.0**-32
    return (float(a) + 0.5) * unit, (float(b) + 0.5) * unit, (float(c) + 0.5) * unit, (float(d) + 0.5) * unit


@inlined
def _draw_profile(p: FloatArray, words: WordArray, n: int, profile: FloatArray) -> None:
    """Plateaus and the ramps between them, until the row is full."""
    k, segment, speed = 0, 0, 0.0
    while k < len(profile):
        level, length, rise, _ = _uniforms(_PROFILE, segment, words, n)
        aim = p[LOWEST] + (p[TOP] - p[LOWEST]) * level
        if segment > 0:
            ramp = int(np.ceil((p[RAMP_0] + (p[RAMP_1] - p[RAMP_0]) * rise) / p[DT]))
            for m in range(min(ramp, len(profile) - k)):
                profile[k + m] = speed + (aim - speed) * (m + 1) / ramp
            k += ramp
        plateau = int(np.ceil((p[PLATEAU_0] + (p[PLATEAU_1] - p[PLATEAU_0]) * length) / p[DT]))
        for m in range(k, min(k + plateau, len(profile))):
            profile[m] = aim
        k, segment, speed = k + plateau, segment + 1, aim


@inlined
def _observe_profile(s: FloatArray, p: FloatArray, profile: FloatArray, ahead: NDArray[np.int64]) -> None:
    """What is asked of the speed now and later, as it is scaled now."""
    k = int(s[STEP])
    s[TIME] = s[STEP] / p[HORIZON]
    for m in range(len(ahead)):
        s[PROFILE + m] = s[SCALE] * profile[k + ahead[m]]


@inlined
def _begin_lane(n: int, lanes: Lanes) -> None:
    """Draw the next episode of lane n; the motor begins where it holds the begin of the profile."""
    s, p, words, profile = lanes.state[n], lanes.numbers, lanes.words, lanes.profile[n]
    layout.begin_episode(words, lanes.flags, n)
    s[:] = 0.0
    _draw_profile(p, words, n, profile)
    u = _uniforms(_CLASS, 0, words, n)[0]
    kind = 0 if u < p[HEALTHY_SHARE] else (BEARING if u < p[BEARING_SHARE] else WINDING)
    s[KIND], s[ONSET] = kind, -1.0
    if kind > 0:
        s[ONSET] = p[EARLIEST]
        if p[LOG_STAY] > -np.inf:
            s[ONSET] += np.floor(np.log(_uniforms(_ONSET, 0, words, n)[0]) / p[LOG_STAY])
        s[GROWTH] = p[SLOWEST] * np.exp(p[LOG_RANGE] * _uniforms(_SEVERITY, 0, words, n)[0])
    speed = profile[0]
    current = (p[BASE_LOAD] + p[FAN] * speed * speed + p[B] * speed) / p[KT]
    s[CURRENT] = s[ESTIMATED_CURRENT] = s[MEASURED_CURRENT] = current
    s[SPEED] = s[ESTIMATED_SPEED] = s[MEASURED_SPEED] = speed
    s[VOLTAGE], s[SCALE] = p[R] * current + p[KE] * speed, 1.0
    _observe_profile(s, p, profile, lanes.ahead)


@inlined
def motor_matrices(p: FloatArray, kind: int, severity: float) -> tuple[float, ...]:
    """The driven motor with its fault: transition row by row, gain of the voltage, gain of the load torque."""
    if severity == 0.0:
        return p[F00], p[F01], p[F10], p[F11], p[G0], p[G1], p[E0], p[E1]
    ohm = p[R] * (1.0 + severity if kind == WINDING else 1.0)
    drag = p[B] * (1.0 + severity if kind == BEARING else 1.0)
    dt = p[DT]
    a, phi = exponential_and_phi(-ohm / p[L] * dt, -p[KE] / p[L] * dt, p[KT] / p[J] * dt, -drag / p[J] * dt)
    by_volt, by_load = dt / p[L], -dt / p[J]
    return a[0], a[1], a[2], a[3], phi[0] * by_volt, phi[2] * by_volt, phi[1] * by_load, phi[3] * by_load


@inlined
def _run_motor(s: FloatArray, p: FloatArray, share: float, noise: tuple[np.float32, ...]) -> None:
    """Current, speed, voltage and temperature over a step, and how the unknown load moves on."""
    kind, severity = int(s[KIND]), s[SEVERITY]
    a00, a01, a10, a11, b0, b1, e0, e1 = motor_matrices(p, kind, severity)
    i, w = s[CURRENT], s[SPEED]
    torque = load_in_kernel(p[BASE_LOAD], p[FAN], w) + s[LOAD]
    volts = min(max(share, -1.0), 1.0) * p[MOST_V]
    free = a00 * i + a01 * w + e0 * torque
    folded = min(max(free + b0 * volts, -p[MOST_A]), p[MOST_A])
    volts = min(max((folded - free) / b0, -p[MOST_V]), p[MOST_V])
    s[VOLTAGE], s[CURRENT] = volts, free + b0 * volts
    s[SPEED] = a10 * i + a11 * w + b1 * volts + e1 * torque
    s[LOAD] = p[KEPT] * s[LOAD] + p[STIR] * float(noise[2])
    heat = 0.5 * (i * i + s[CURRENT] * s[CURRENT]) * p[TO_K]
    worse = 1.0 + severity if kind == WINDING else 1.0
    s[TEMPERATURE] += p[COOLING] * (heat * worse - s[TEMPERATURE])


@inlined
def _grow_fault(s: FloatArray, p: FloatArray, torque: float) -> float:
    """Let the fault set in and grow over a step; by how much a bearing's severity went up."""
    kind, before = int(s[KIND]), s[SEVERITY]
    if kind == 0 or s[STEP] < s[ONSET]:
        return 0.0
    if before == 0.0:
        s[SEVERITY] = p[ONSET_SEVERITY + kind - 1]
    pace = 1.0
    if kind == BEARING:
        pace += p[STRESS_SHARE] * (max(torque * s[SPEED], 0.0) / p[FULL_POWER] - 1.0)
    s[SEVERITY] *= np.exp(s[GROWTH] * p[DT] * pace)
    return s[SEVERITY] - before if kind == BEARING else 0.0


@inlined
def _filter(s: FloatArray, p: FloatArray, noise: tuple[np.float32, ...]) -> None:
    """Measure, and let the filter of the healthy motor follow with current, speed and unknown load as its states."""
    s[MEASURED_CURRENT] = s[CURRENT] + p[NOISE_A] * float(noise[0])
    s[MEASURED_SPEED] = s[SPEED] + p[NOISE_SPEED] * float(noise[1])
    i, w, d, volts = s[ESTIMATED_CURRENT], s[ESTIMATED_SPEED], s[ESTIMATED_LOAD], s[VOLTAGE]
    torque = load_in_kernel(p[BASE_LOAD], p[FAN], w) + d
    expected_i = p[F00] * i + p[F01] * w + p[G0] * volts + p[E0] * torque
    expected_w = p[F10] * i + p[F11] * w + p[G1] * volts + p[E1] * torque
    r0, r1 = s[MEASURED_CURRENT] - expected_i, s[MEASURED_SPEED] - expected_w
    s[ESTIMATED_CURRENT] = expected_i + p[K00] * r0 + p[K01] * r1
    s[ESTIMATED_SPEED] = expected_w + p[K10] * r0 + p[K11] * r1
    s[ESTIMATED_LOAD] = p[KEPT] * d + p[K20] * r0 + p[K21] * r1
    s[WHITE_CURRENT], s[WHITE_SPEED] = p[W00] * r0, p[W10] * r0 + p[W11] * r1
    into = np.sqrt(1.0 - p[SLOW] * p[SLOW])
    s[SLOW_CURRENT] = p[SLOW] * s[SLOW_CURRENT] + into * s[WHITE_CURRENT]
    s[SLOW_SPEED] = p[SLOW] * s[SLOW_SPEED] + into * s[WHITE_SPEED]
    heat = 0.5 * (i * i + s[ESTIMATED_CURRENT] * s[ESTIMATED_CURRENT]) * p[TO_K]
    s[ESTIMATED_TEMPERATURE] += p[COOLING] * (heat - s[ESTIMATED_TEMPERATURE])


@inlined
def _own_share(s: FloatArray, p: FloatArray) -> float:
    """Voltage of the drive's own controller, LQG with integral action on the healthy motor, in units of the limit."""
    now, then = s[PROFILE], s[PROFILE + 1]
    middle = 0.5 * (now + then)
    torque = load_in_kernel(p[BASE_LOAD], p[FAN], middle) + s[ESTIMATED_LOAD]
    torque += p[B] * middle + p[J] * (then - now) / p[DT]
    current = torque / p[KT]
    wanted = p[R] * current + p[KE] * middle
    volts = wanted - p[BY_CURRENT] * (s[ESTIMATED_CURRENT] - current)
    volts -= p[BY_SPEED] * (s[ESTIMATED_SPEED] - now) + p[BY_INTEGRAL] * s[INTEGRAL]
    if abs(wanted) < p[MOST_V]:
        s[INTEGRAL] += p[DT] * (s[MEASURED_SPEED] - now)
    share: float = volts / p[MOST_V]
    return share


@inlined
def _step_lane(n: int, action: FloatArray, lanes: Lanes, parts: FloatArray) -> None:
    """A step of lane n in the middle of an episode: its costs go into the column n of the parts."""
    s, p, flags, profile = lanes.state[n], lanes.numbers, lanes.flags, lanes.profile[n]
    for m in range(len(PARTS)):
        parts[m, n] = 0.0
    left_s = (p[HORIZON] - s[STEP]) * p[DT]
    if action[1] > STOP_ABOVE:
        parts[4, n] = -p[STOP_COST] * left_s
        flags[layout.TERMINATED, n] = True
        return
    aim = p[LIMP_SHARE] if action[1] > 0.0 else 1.0
    s[SCALE] += min(max(aim - s[SCALE], -p[LIMP_STEP]), p[LIMP_STEP])
    noise = four_normals(int(s[STEP]), lanes.words, n)
    torque = p[BASE_LOAD] + p[FAN] * s[SPEED] * abs(s[SPEED]) + s[LOAD]
    worn = _grow_fault(s, p, torque)
    flags[layout.FAULT_ACTIVE, n] = s[SEVERITY] > 0.0
    _run_motor(s, p, _own_share(s, p) if p[HOLDS_SPEED] > 0.0 else action[0], noise)
    _filter(s, p, noise)
    s[STEP] += 1.0
    off = (s[SPEED] - s[SCALE] * profile[int(s[STEP])]) / p[TOP]
    error = p[TRACKING_COST] * off * off
    if p[TRACKING_LIMIT] > 0.0:
        error /= 1.0 + error / p[TRACKING_LIMIT]
    parts[0, n] = -error
    parts[1, n] = -p[HEAT_COST] * max(s[TEMPERATURE] - p[WARM], 0.0)
    parts[2, n] = -p[WEAR_COST] * worn
    parts[3, n] = -p[LIMP_COST] * (1.0 - s[SCALE])
    kind = int(s[KIND])
    broken = kind > 0 and s[SEVERITY] >= p[FAILURE_SEVERITY + kind - 1]
    if broken or s[TEMPERATURE] >= p[BURN]:
        parts[5, n] = -p[FAILURE_COST] - p[STOP_COST] * (left_s - p[DT])
        flags[layout.TERMINATED, n] = True
    elif s[STEP] >= p[HORIZON]:
        flags[layout.TERMINATED, n] = True
    _observe_profile(s, p, profile, lanes.ahead)


@inlined
def _column(parts: FloatArray, n: int) -> tuple[float, ...]:
    return parts[0, n], parts[1, n], parts[2, n], parts[3, n], parts[4, n], parts[5, n]


@inlined
def _decide_lane(n: int, action: FloatArray, lanes: Lanes, parts: FloatArray) -> None:
    """The periods of one decision: as many as `REPEATS` says, or until the episode is over."""
    _step_lane(n, action, lanes, parts)
    for _ in range(1, int(lanes.numbers[REPEATS])):
        if lanes.flags[layout.TERMINATED, n]:
            break
        so_far = _column(parts, n)
        _step_lane(n, action, lanes, parts)
        for m in range(len(PARTS)):
            parts[m, n] += so_far[m]


@compiled
def begin(mask: BoolArray, *arrays: Any) -> None:
    """Let the lanes of the mask begin their next episodes; `arrays` are those of `Lanes`."""
    lanes = _unpack(*arrays)
    for n in range(len(mask)):
        if mask[n]:
            _begin_lane(n, lanes)


@compiled
def observe(state: FloatArray, view: FloatArray, observation: Float32Array) -> None:
    """Write the observed fields of all lanes in units of `view[0]`, clipped to `view[1]` .. `view[2]`."""
    for n in range(len(state)):
        for m in range(view.shape[1]):
            value = state[n, MEASURED_CURRENT + m] / view[0, m]
            observation[n, m] = np.float32(min(max(value, view[1, m]), view[2, m]))


@compiled
def step(
    actions: FloatArray,
    begins: bool,
    view: FloatArray,
    observation: Float32Array,
    reward: FloatArray,
    parts: FloatArray,
    *arrays: Any,
) -> int:
    """A step of all lanes; where an episode is over and `begins`, its successor begins instead. How many are over."""
    lanes, n_over = _unpack(*arrays), 0
    for n in range(len(reward)):
        if begins and lanes.flags[layout.TERMINATED, n]:
            _begin_lane(n, lanes)
            parts[:, n] = 0.0
        else:
            _decide_lane(n, actions[n], lanes, parts)
            n_over += lanes.flags[layout.TERMINATED, n]
        total = 0.0
        for m in range(len(PARTS)):
            total += parts[m, n]
        reward[n] = total
    observe(lanes.state, view, observation)
    return n_over
