"""A step of Monitor and Probe on one page: one lane in NumPy and float64, each line beside its equation.

For reading, and to hold the compiled step (`stepping`, `kernel`, `episode_sampling`) to it: a test plays both. States
are in ampere and rad/s here; the compiled step keeps deviations from the rest point. With x = (current, speed) and the
healthy motor's A, B:

    plant     x[k+1] = A_f x[k] + B_f (s (V + u + d), load), z = C x + v     a fault f, a supply that is off by s
    sensor    z + g (C x), z + s X, z + s X dt (k - onset), or its last z again   one that failed; X: full scale
    filter    e = z - C (A xh + B (V + u, load)), xh[k+1] = A xh + B (V + u, load) + K e, r = S^(-1/2) e
    reward    - price u^2 dt in each step; verdict - delay cost (k - onset) dt - price |power| dt at the end

Example:
    An episode in which nobody says anything.

    >>> from motor_env.envs import MonitorOptions
    >>> from motor_env.envs.reference import Reference
    >>> lane, over = Reference(MonitorOptions(recipe="easy")), False
    >>> observation = lane.reset(seed=1)
    >>> while not over:
    ...     observation, reward, over = lane.step(0)
    >>> print(f"onset at sample {lane.onset:g}, reward {reward:.2f}")
    onset at sample 827, reward -1.59
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.linalg import expm, solve_discrete_are

from motor_env.envs.options import Drive, MonitorOptions, Start
from motor_env.filters.kalman import DEFAULT_PROCESS_NOISE_STD
from motor_env.motor.faults import HEALTHY, Fault, FaultKind, apply_fault
from motor_env.motor.parameters import FloatArray, MotorParameters
from motor_env.simulation.random_streams import Stream, normals, uniforms
from motor_env.simulation.sampling import draw

MAX_BANK = 5


def held(motor: MotorParameters, dt_s: float) -> tuple[FloatArray, FloatArray]:
    """A and B of a sample with the input held: exp([[a, b], [0, 0]] dt) = [[A, B], [0, 1]] (Van Loan 1978)."""
    p, block = motor, np.zeros((4, 4))
    block[0] = np.array([-p.resistance_ohm, -p.back_emf_constant_v_s_per_rad, 1.0, 0.0]) / p.inductance_h
    block[1] = np.array([p.torque_constant_n_m_per_a, -p.viscous_friction_n_m_s_per_rad, 0.0, -1.0])
    block[1] /= p.inertia_kg_m2
    whole = expm(block * dt_s)
    return whole[:2, :2], whole[:2, 2:]


def at_rest(motor: MotorParameters, voltage_v: float, load_n_m: float) -> FloatArray:
    """Current and speed at which nothing moves: V = R i + Kb w and Kt i = B w + load."""
    p = motor
    rows = [
        [p.resistance_ohm, p.back_emf_constant_v_s_per_rad],
        [p.torque_constant_n_m_per_a, -p.viscous_friction_n_m_s_per_rad],
    ]
    return np.linalg.solve(np.array(rows, dtype=np.float64), np.array([voltage_v, load_n_m]))


class Reference:
    """One lane of Monitor or Probe.

    Args:
        options: of the task.
    """

    def __init__(self, options: MonitorOptions) -> None:
        o, recipe = options, options.task
        self.options, self.motor, self.dt_s = o, recipe.motor, o.dt_s
        self.voltage_v, self.load_n_m = float(recipe.supply.voltage_v), o.load_n_m
        self.a, self.b = held(self.motor, o.dt_s)
        self.rest = at_rest(self.motor, self.voltage_v, self.load_n_m)
        # The filter's gain after many samples: P = A (P - P C' S^-1 C P) A' + Q, S = C P C' + R, K = P C' S^-1.
        self.c = recipe.sensor.observation
        noise = np.diag(np.square(recipe.sensor.noise_std))
        p = solve_discrete_are(self.a.T, self.c.T, np.diag(np.square(DEFAULT_PROCESS_NOISE_STD)), noise)
        s = self.c @ p @ self.c.T + noise
        self.gain, self.whiten = p @ self.c.T @ np.linalg.inv(s), np.linalg.inv(np.linalg.cholesky(s))
        # A rival believes in the smallest fault of a kind that changes the motor.
        moving = [kind for kind in recipe.kinds if kind.motor_powers][:MAX_BANK]
        sizes = {
            k: min(c.severity or c.largest_severity for c in recipe.classes if c.kind == k) for k in moving
        }
        self.rivals = {k: held(apply_fault(self.motor, Fault(k, size)), o.dt_s) for k, size in sizes.items()}
        self.kinds = list(dict.fromkeys(kind.component for kind in recipe.kinds))
        # The speed loop's zero cancels the motor's slow pole.
        no_load = at_rest(self.motor, self.voltage_v, 0.0)[1]
        self.loop = self.voltage_v / no_load / o.loop_time_s if o.drive is Drive.SPEED_LOOP else 0.0
        # Means of the innovation over 1 and 10 ms: m[k+1] = a m[k] + sqrt(1 - a^2) r, of standard deviation 1.
        self.memory = np.exp(-o.dt_s / np.array([1e-3, 1e-2]))

    def reset(self, seed: int, index: int = 0, episode: int = 0) -> FloatArray:
        """Begin an episode of the stream (seed, index); return its first observation."""
        o, case = self.options, np.array([(index << 32) | episode])
        drawn, recipe = draw(o.task, seed, case), o.task
        self.fault = recipe.classes[int(drawn.class_index[0])]
        self.severity = float(drawn.severity[0])
        self.own = MotorParameters(
            *(float(np.ravel(getattr(drawn.scenario.parameters, n))[0]) for n in _FIELDS)
        )
        self.supply = float(np.ravel(drawn.scenario.supply.voltage_v)[0]) / self.voltage_v
        # The onset is geometric from the earliest sample on: P(onset > n) = (mean / (1 + mean))^n.
        self.onset, mean = math.inf, o.mean_onset_s / self.dt_s
        if self.fault.label_kind != HEALTHY:
            u = float(uniforms(seed, Stream.ONSET, case, 1)[0, 0])
            waits = math.floor(math.log(u) / math.log(mean / (1.0 + mean))) if mean > 0.0 else 0
            self.onset = round(o.earliest_onset_s / self.dt_s) + waits
        # A fault that recovers ends and returns in turn, after times that are geometric, too.
        self.changes, recovery = np.array([]), self.fault.recovery
        if recovery is not None:
            u = uniforms(seed, Stream.RECOVERY, case, o.n_samples)[0]
            self.changes = self.onset + recovery.changes(u, self.dt_s)
        self.noise = normals(seed, Stream.MEASUREMENT, case, (o.n_samples + 1) * len(self.c))[0].astype(float)
        self.time, self.level, self.drive_v, self.energy_j = 0, 0, 0.0, 0.0
        self.chosen, self.repeats, self.offset_v = 0, 0, 0.0
        self._set_motor()
        running = o.start is Start.RUNNING
        self.x = at_rest(self.own, self.voltage_v * self.supply, self.load_n_m) if running else np.zeros(2)
        self.estimate = self.rest.copy() if running else np.zeros(2)
        self.beliefs, self.evidence = (
            dict.fromkeys(self.rivals, self.estimate),
            dict.fromkeys(self.rivals, 0.0),
        )
        self.held_speed, self.excess, self.total = self.x[1], 0.0, np.zeros(len(self.c))
        self.means = np.zeros((2, len(self.c)))
        self.z, self.age = self.c @ self.x + self._sensor_noise(), 0.0
        return self.observation()

    def _set_motor(self) -> None:
        """The motor and the noise at the level that the fault has reached."""
        o, kind = self.options, self.fault.kind
        severity = self.severity * self.level / o.n_levels
        motor = self.own if kind is None else apply_fault(self.own, Fault(kind, severity))
        self.plant, factor = (
            held(motor, o.dt_s),
            1.0 if kind is None else float(kind.factor("noise", severity)),
        )
        self.noise_std = np.asarray(o.task.sensor.noise_std) * math.sqrt(factor)

    def _sensor_noise(self) -> FloatArray:
        first = len(self.c) * self.time
        noise: FloatArray = self.noise_std * self.noise[first : first + len(self.c)]
        return noise

    def _reading(self) -> FloatArray:
        """What the sensors show: the quantities and their noise, or what a failed one makes of them."""
        z: FloatArray = self.c @ self.x
        channel, _, failure = str(self.fault.kind).partition("_")
        failed = np.array([channel == name for name in self.options.task.sensor.channels])
        severity = self.severity * self.level / self.options.n_levels
        volts, own = abs(self.voltage_v * self.supply), self.own
        scale = self.c @ np.array([volts / own.resistance_ohm, volts / own.back_emf_constant_v_s_per_rad])
        error = {
            "gain": severity * z,
            "dead": -severity * z,
            "offset": severity * scale,
            "drift": severity * scale * self.dt_s * max(self.age, 0.0),
        }
        z = z + failed * error.get(failure, 0.0) + self._sensor_noise()
        return np.where(failed, self.z, z) if failure == "stuck" and severity * self.age > 0.0 else z

    def _sample(self) -> None:
        """Plant, sensor, filter, rivals, statistics and speed loop from sample k to k + 1."""
        o, voltage = self.options, self.voltage_v + self.offset_v
        growth, turn = round(o.growth_s / self.dt_s), int(np.searchsorted(self.changes, self.time, "right"))
        self.age = self.time - (self.changes[turn - 1] if turn else self.onset)
        level = sum(self.age >= growth * m // o.n_levels for m in range(o.n_levels)) if turn % 2 == 0 else 0
        if level != self.level:
            self.level = level
            self._set_motor()
        volts, before = (voltage + self.drive_v) * self.supply, self.x[1]
        self.x = self.plant[0] @ self.x + self.plant[1] @ (volts, self.load_n_m)
        self.time += 1
        self.z = self._reading()

        predicted = self.a @ self.estimate + self.b @ (voltage, self.load_n_m)
        error = self.z - self.c @ predicted
        r = self.whiten @ error
        self.estimate = predicted + self.gain @ error

        for kind, (a, b) in self.rivals.items():  # CUSUM of the log-likelihood ratio (Page 1954)
            guess = a @ self.beliefs[kind] + b @ (voltage, self.load_n_m)
            error = self.z - self.c @ guess
            rival = self.whiten @ error
            total = self.evidence[kind] + 0.5 * (r @ r - rival @ rival)
            self.evidence[kind] = max(float(total), 0.0)
            self.beliefs[kind] = guess + self.gain @ error if total > 0.0 else self.estimate

        a = self.memory[:, None]
        self.total = self.total + r
        self.means = a * self.means + np.sqrt(1.0 - a**2) * r
        slow, n = self.memory[1], len(r)
        self.excess = slow * self.excess + math.sqrt((1.0 - slow**2) / (2.0 * n)) * (r @ r - n)
        # A PI controller in incremental form: d[k+1] = d[k] - g (T (w[k+1] - w[k]) + dt (w[k+1] - w0)).
        rise, off = self.x[1] - before, self.x[1] - self.held_speed
        self.drive_v -= self.loop * (self.motor.mechanical_time_constant_s * rise + self.dt_s * off)
        self.energy_j += abs(volts * self.x[0]) * self.dt_s

    def observation(self) -> FloatArray:
        """The observed features, scaled and clipped."""
        o, v = self.options, abs(self.voltage_v)
        unit = {
            "current": v / self.motor.resistance_ohm,
            "speed": v / self.motor.back_emf_constant_v_s_per_rad,
        }
        channels = [str(channel) for channel in o.task.sensor.channels]
        names = ("measured", "innovation", "fast", "slow")
        of_channel = zip(self.z, self.total / math.sqrt(o.samples_per_step), *self.means, strict=True)
        seen: dict[str, float] = {}
        for channel, values in zip(channels, of_channel, strict=True):
            seen |= {f"{name}_{channel}": float(value) for name, value in zip(names, values, strict=True)}
            seen[f"measured_{channel}"] /= float(unit[channel])
        for channel, value in zip(unit, self.estimate, strict=True):
            seen[f"estimated_{channel}"] = float(value / unit[channel])
        seen |= {"excess": self.excess, "voltage": (self.voltage_v + self.offset_v) / v}
        seen["time"] = self.time / o.n_samples
        seen |= {f"evidence_{kind}": 0.1 * value for kind, value in self.evidence.items()}
        usual = [name for name in _ORDER if name in seen]
        usual += [f"evidence_{kind}" for kind in self.rivals if o.moves_voltage]
        clipped = [(seen[name], 3.0 if name in _IN_UNITS else 10.0) for name in o.observe or usual]
        return np.array([min(max(value, -bound), bound) for value, bound in clipped])

    def _decode(self, action: Any) -> tuple[float, int]:
        """Offset of the voltage, and number of the chosen kind, 0 for none; a choice moves no voltage."""
        offsets = self.options.offsets_v
        if np.ndim(action) == 0:
            return (offsets[action], 0) if action < len(offsets) else (0.0, int(action) - len(offsets) + 1)
        kind = int(np.argmax(action[1:])) + 1
        if action[kind] > 0.5:  # as the action space says
            return 0.0, kind
        return float(np.clip(action[0], -1.0, 1.0)) * self.options.max_offset_v, 0  # type: ignore[attr-defined]  # Probe's

    def step(self, action: Any) -> tuple[FloatArray, float, bool]:
        """Take an action: observation, reward, and whether the episode is over."""
        o, n = self.options, self.options.samples_per_step
        self.offset_v, kind = self._decode(action)
        self.repeats = self.repeats + 1 if kind == self.chosen else 1
        self.chosen = kind
        confirmed = self.repeats >= o.confirm_steps or self.time + n >= o.n_samples
        declared, spent_j, self.total = kind if confirmed else 0, self.energy_j, np.zeros(len(self.c))
        for _ in range(n):
            self._sample()
        reward = -o.probe_cost_per_v2_s * self.offset_v**2 * n * self.dt_s
        over = declared > 0 or self.time >= o.n_samples
        if over:  # what happens in the step that declares is neither seen nor paid
            until = self.time - n if declared else self.time
            reward += self._verdict(declared, until)
            reward -= o.delay_cost_per_s * self.dt_s * max(until - self.onset, 0.0)
            reward -= o.energy_cost_per_j * (spent_j if declared else self.energy_j)
        return self.observation(), reward, over

    def _verdict(self, declared: int, until: int) -> float:
        """What a declaration is worth, or silence until the horizon."""
        o = self.options
        if declared == 0:
            return -o.miss_cost if self.onset < o.n_samples else o.silent_reward
        if until <= self.onset:
            return -o.false_alarm_cost
        right = self.kinds[declared - 1] == FaultKind(str(self.fault.kind)).component
        return o.correct_reward if right else -o.wrong_kind_cost


_FIELDS = MotorParameters.__slots__
_IN_UNITS = ("measured_current", "measured_speed", "estimated_current", "estimated_speed", "voltage")
_ORDER = (
    *_IN_UNITS[:4],
    *("innovation_current", "innovation_speed", "fast_current", "slow_current", "fast_speed", "slow_speed"),
    *("excess", "voltage", "time"),
)
