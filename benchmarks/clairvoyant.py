"""What the truth would be worth to a controller of the drive."""

from __future__ import annotations

import numpy as np

from motor_env.envs import DriveVectorEnv, Lqg, returns_of
from motor_env.motor.parameters import FloatArray

LIMP_FROM = (0.0, 0.2, 0.35, 0.5, 0.7, np.inf)
STOP_FROM = (0.97, np.inf)


class Clairvoyant(Lqg):
    """The reconfigured controller that is told kind, severity and temperature instead of a posterior.

    Args:
        envs: whose truth it is told.
        limp_from: severity or temperature, as a share of the limit, from which it limps; 0: from the onset.
        stop_from: the same from which it stops.
    """

    def __init__(self, envs: DriveVectorEnv, *, limp_from: float, stop_from: float) -> None:
        super().__init__(envs.setup, levels=6)
        self._truth, self._limp_from, self._stop_from = envs.truth, limp_from, stop_from

    def _follow(self, seen: dict[str, FloatArray]) -> None:
        super()._follow(seen)
        kind, severity = self._truth("kind"), self._truth("severity")
        far = np.abs(np.log((self.bank.severity[:, None] + 1e-9) / (severity + 1e-9)))
        other = self.bank.kind[:, None] != np.where(severity > 0.0, kind, 0.0)
        self.probability = np.eye(len(self.bank.kind))[:, np.argmin(np.where(other, np.inf, far), axis=0)]

    def _decision(self) -> FloatArray:
        options = self.setup.options
        failure = np.array([np.inf, *options.failure_severity])[self._truth("kind").astype(int)]
        worn = self._truth("severity") / failure
        worst = np.where(worn > 0.0, np.maximum(worn, self._truth("temperature") / options.burn_k), -1.0)
        return self._decided(worst >= self._limp_from, worst >= self._stop_from)


def clairvoyant_returns(envs: DriveVectorEnv, seed: int) -> FloatArray:
    """Best return of each episode in hindsight, among `Clairvoyant` with all pairs of thresholds, shape (episodes,).

    No rule of that family, which knows fault and onset, does better. Of all that a controller could do it is no bound.
    """
    rules = [Clairvoyant(envs, limp_from=limp, stop_from=stop) for limp in LIMP_FROM for stop in STOP_FROM]
    best: FloatArray = np.max([returns_of(envs, rule, seed) for rule in rules], axis=0)
    return best
