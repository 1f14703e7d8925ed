"""Controllers for the drive: LQG with integral action, and the same reconfigured by a bank of filters."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import softmax

from motor_env.common.arrays import instance
from motor_env.envs.drive.drive_env import LIMP, RUN, STOP, as_actions
from motor_env.envs.drive.drive_setup import DriveSetup, drive_filter, faulty, speed_feedback
from motor_env.envs.drive.options import LABELS, DriveOptions
from motor_env.envs.policies.rule_policies import Observations
from motor_env.envs.setup import converged_gain
from motor_env.motor.model import Input, discretize, load_torque
from motor_env.motor.parameters import FloatArray, MotorParameters


def named(setup: DriveSetup, observations: Observations) -> dict[str, FloatArray]:
    """The observed numbers by name, in SI units."""
    values = (observations * setup.view[0]).T
    return dict(zip(setup.observed, values, strict=True))


class Bank(NamedTuple):
    """Hypotheses of the motor, the healthy one first, with a filter and a controller for each of the h."""

    kind: NDArray[np.int64]  # index of its label, shape (h,)
    severity: FloatArray  # shape (h,)
    ohm: FloatArray  # resistance, shape (h,)
    drag: FloatArray  # friction, shape (h,)
    transition: FloatArray  # of current and speed, shape (h, 2, 2)
    by_volt: FloatArray  # gain of the voltage, shape (h, 2)
    by_load: FloatArray  # gain of the load torque, shape (h, 2)
    gain: FloatArray  # of the filter, whose states are current, speed, unknown load, shape (h, 3, 2)
    whitening: FloatArray  # of its innovation, shape (h, 2, 2)
    feedback: FloatArray  # voltage for current, speed and integral of the speed's error, shape (h, 3)
    moves: FloatArray  # transition probabilities of a step, shape (h, h)


LEAST = 1e-12  # probability that a motor of the bank never falls below


def _feedback(options: DriveOptions, motor: MotorParameters) -> tuple[FloatArray, ...]:
    """Model of a driven motor, gain and whitening of its filter, and its feedback."""
    belief, model = drive_filter(options, motor), discretize(motor, options.period_s)
    gain, covariance = converged_gain(belief)
    feedback = speed_feedback(options, motor)
    return model.transition, model.gain, gain, np.linalg.inv(np.linalg.cholesky(covariance)), feedback


def make_bank(options: DriveOptions, levels: int) -> Bank:
    """The healthy motor, and each kind of fault at so many severities from onset to failure."""
    spread = np.array(options.failure_severity) / np.array(options.onset_severity)
    share = (np.arange(levels) + 0.5) / max(levels, 1)
    severity = np.concatenate(
        [[0.0], *(s * r**share for s, r in zip(options.onset_severity, spread, strict=True))]
    )
    kind = np.repeat([0, 1, 2], [1, levels, levels])
    motors = [faulty(options, LABELS[k], s) for k, s in zip(kind, severity, strict=True)]
    parts = [np.stack(part) for part in zip(*(_feedback(options, motor) for motor in motors), strict=True)]
    moves = np.eye(len(kind))
    step, (slow, fast) = options.period_s, options.growth_per_s
    for k, ratio in enumerate(spread[: 2 if levels else 0]):
        first = 1 + k * levels
        moves[0, first] = step / (options.mean_onset_s + step) * options.weights[1 + k] / sum(options.weights)
        for m in range(first, first + levels - 1):
            moves[m, m + 1] = step * np.sqrt(slow * fast) * levels / np.log(ratio)
    np.fill_diagonal(moves, 0.0)
    np.fill_diagonal(moves, 1.0 - moves.sum(axis=1))
    transition, gains, gain, whitening, feedback = parts
    return Bank(
        kind=kind,
        severity=severity,
        ohm=np.array([float(np.asarray(motor.resistance_ohm)) for motor in motors]),
        drag=np.array([float(np.asarray(motor.viscous_friction_n_m_s_per_rad)) for motor in motors]),
        transition=transition,
        by_volt=gains[:, :, Input.VOLTAGE],
        by_load=gains[:, :, Input.LOAD_TORQUE],
        gain=gain,
        whitening=whitening,
        feedback=feedback,
        moves=moves,
    )


class Lqg:
    """LQG with integral action: each motor of a bank has a filter and a voltage; the weighted mean is applied.

    With the healthy motor alone it is the fixed LQG, which never limps or stops. With a bank the posterior of the
    motors gives the weights and the decision: limp where a bad bearing is probable or the winding is hot, stop just
    before a failure.

    Args:
        setup: of the environment.
        levels: severities of each kind in the bank; 0: the healthy motor alone.
        reconfigures: whether the posterior shapes the voltage.
        decides: whether it limps and stops.
        limp_above: probability of a bad bearing above which it limps.
        stop_above: expected severity of bearing and winding, as shares of those at failure, above which it stops; the
            second holds for the temperature, too.
    """

    def __init__(
        self,
        setup: DriveSetup,
        *,
        levels: int = 0,
        reconfigures: bool = True,
        decides: bool = True,
        limp_above: float = 0.5,
        stop_above: tuple[float, float] = (2.0, 0.75),
    ) -> None:
        instance("setup", setup, DriveSetup)
        self.setup, self.bank = setup, make_bank(setup.options, levels)
        self.reconfigures, self.decides = reconfigures, decides and levels > 0
        self.limp_above, self.stop_above = limp_above, stop_above
        self._motor = setup.options.driven
        self._fit = np.log(np.linalg.det(self.bank.whitening))[:, None]
        self._share = np.zeros((2, len(self.bank.kind)))
        for k, failure in enumerate(setup.options.failure_severity):
            self._share[k] = np.where(self.bank.kind == k + 1, self.bank.severity / failure, 0.0)

    def start(self, count: int) -> None:
        """Begin anew with `count` sub-environments."""
        size = len(self.bank.kind)
        self._state = np.zeros((size, 3, count))
        self._integral, self._temperature, self._current = np.zeros((3, count))
        self.probability = np.zeros((size, count))

    def act(self, observations: Observations) -> NDArray[Any]:
        """Voltage and decision from the posterior after the last measurement."""
        limit, observed = self.setup.options.voltage_limit_v, named(self.setup, observations)
        self._follow(observed)
        volts = self._volts(observed)
        mean = (volts * self.probability).sum(axis=0) if self.reconfigures else volts[0]
        given = np.stack([np.clip(mean / limit, -1.0, 1.0), self._decision()], axis=1)
        return as_actions(self.setup.options.control, given)

    def _torque(self, speed: FloatArray, unknown: FloatArray) -> FloatArray:
        options = self.setup.options
        return load_torque(options.load_torque_n_m, options.fan_n_m_s2, speed) + unknown

    def _follow(self, observed: dict[str, FloatArray]) -> None:
        """Update each filter, and weigh it by the likelihood of its innovation (Magill 1965)."""
        bank, options, state = self.bank, self.setup.options, self._state
        measured = np.stack([observed["measured_current"], observed["measured_speed"]])
        torque = self._torque(state[:, 1], state[:, 2])
        expected = bank.transition @ state[:, :2] + bank.by_load[:, :, None] * torque[:, None]
        expected += bank.by_volt[:, :, None] * observed["voltage"]
        innovation = measured - expected
        state[:, :2] = expected
        state[:, 2] *= options.load_memory
        state += bank.gain @ innovation
        fit = self._fit - 0.5 * np.square(bank.whitening @ innovation).sum(axis=1)
        self._weigh(fit, observed)
        self._heat(measured[0])
        self._begin(observed["time"] == 0.0, measured)

    def _weigh(self, fit: FloatArray, observed: dict[str, FloatArray]) -> None:
        """Update the probability of each motor by its log-likelihood."""
        self.probability = softmax(fit + np.log(self.bank.moves.T @ self.probability + LEAST), axis=0)

    def _heat(self, current: FloatArray) -> None:
        """Update the temperature of a winding with the expected resistance."""
        loss_w = 0.5 * (current**2 + self._current**2) * (self.bank.ohm @ self.probability)
        rise = loss_w * self.setup.options.thermal_resistance_k_per_w - self._temperature
        self._temperature += self.setup.task.cooling * rise
        self._current = current

    def _begin(self, new: NDArray[np.bool_], measured: FloatArray) -> None:
        """Where an episode begins, reset to a healthy motor in the measured state."""
        self._state[:, :, new], self.probability[:, new] = 0.0, np.eye(len(self.bank.kind), 1)
        self._state[:, :2, new] = measured[:, new]
        self._integral[new], self._temperature[new] = 0.0, 0.0

    def _volts(self, observed: dict[str, FloatArray]) -> FloatArray:
        """Voltage of each motor's controller: feedforward of the profile, and feedback; shape (h, count)."""
        bank, options, motor = self.bank, self.setup.options, self._motor
        now, then = observed["profile_0"], observed["profile_1"]
        middle = 0.5 * (now + then)
        torque = self._torque(middle, self._state[:, 2]) + bank.drag[:, None] * middle
        torque += motor.inertia_kg_m2 * (then - now) / options.period_s
        current = torque / motor.torque_constant_n_m_per_a
        wanted = bank.ohm[:, None] * current + motor.back_emf_constant_v_s_per_rad * middle
        errors = (self._state[:, 0] - current, self._state[:, 1] - now, self._integral)
        volts: FloatArray = wanted - sum(
            gain[:, None] * error for gain, error in zip(bank.feedback.T, errors, strict=True)
        )
        room = np.abs(wanted[0]) < options.voltage_limit_v
        self._integral += np.where(room, options.period_s * (observed["measured_speed"] - now), 0.0)
        return volts

    def _decision(self) -> FloatArray:
        """Run; limp where a bad bearing is probable or the winding is warm; stop before a failure."""
        if not self.decides:
            return np.full(len(self._integral), RUN)
        options, worn = self.setup.options, self._share @ self.probability
        bearing = self.probability[self.bank.kind == 1].sum(axis=0)
        limps = (bearing > self.limp_above) | (self._temperature > options.warm_k)
        burnt = self._temperature / options.burn_k
        stops = (self.stop_above < worn.T).any(axis=1) | (burnt > self.stop_above[1])
        return self._decided(limps, stops)

    def _decided(self, limps: NDArray[np.bool_], stops: NDArray[np.bool_]) -> FloatArray:
        return np.where(stops, STOP, np.where(limps, LIMP, RUN))
