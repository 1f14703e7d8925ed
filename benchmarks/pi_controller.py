"""The controller of the drive that is compared with: PI, which neither limps nor stops."""

from __future__ import annotations

import numpy as np

from motor_env.envs.baselines.policies import Observations
from motor_env.envs.drive.actions import RUN
from motor_env.envs.drive.policies import named
from motor_env.envs.drive.setup import DriveSetup
from motor_env.motor.parameters import FloatArray


class PI:
    """A PI controller of the measured speed, with its integral held where the voltage is at its limit.

    Args:
        setup: of the environment.
        gain: in V s/rad.
        reset_s: time constant of its integral.
    """

    def __init__(self, setup: DriveSetup, *, gain: float = 0.06, reset_s: float = 0.03) -> None:
        self.setup, self.gain, self.reset_s = setup, gain, reset_s

    def start(self, count: int) -> None:
        """Forget everything; so many sub-environments begin."""
        self._integral = np.zeros(count)

    def act(self, observations: Observations) -> FloatArray:
        """Voltage that takes the speed to the profile."""
        options, seen = self.setup.options, named(self.setup, observations)
        error = seen["profile_1"] - seen["measured_speed"]
        self._integral = np.where(seen["time"] == 0.0, seen["voltage"], self._integral)
        moved = self._integral + self.gain * options.period_s / self.reset_s * error
        volts = self.gain * error + moved
        free = np.abs(volts) < options.voltage_limit_v
        self._integral = np.where(free, moved, self._integral)
        return np.stack([volts / options.voltage_limit_v, np.full(len(volts), RUN)], axis=1)
