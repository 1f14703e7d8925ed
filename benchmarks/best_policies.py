"""The best policies known, where the package has none as good: they play in the table of reference scores.

`LookAhead` probes by the worth of the next look. `PlannedDrive` limps and stops by what is still to come, under a
posterior of fault and growth: a fine bank of filters tells the severity, and beside it each fault's rate of growth is
followed, so that every hypothesis says when the motor would fail. It limps where running a little longer would cost
more than limping does, if the motor limped from then on. It stops where the next step risks more than it earns.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from bounds import LOG_ODDS, PLACES, Pair
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.special import logsumexp

from motor_env.envs import Lqg
from motor_env.envs.drive.drive_env import LIMP, RUN, STOP, as_actions
from motor_env.envs.drive.drive_setup import DriveSetup
from motor_env.envs.drive.lqg import LEAST, named
from motor_env.envs.policies.fault_posterior import kind_matrix, known_faults
from motor_env.envs.policies.posterior_policies import (
    ExpectedRewardTest,
    Probing,
    winding_of,
)
from motor_env.envs.policies.rule_policies import Actions, Observations
from motor_env.motor.parameters import FloatArray


class RatioTest(ExpectedRewardTest):
    """Declares the kind whose generalised likelihood ratio reaches a threshold: matched to the voltage applied.

    Args:
        setup: see `ProbeBelief`.
        threshold: log-likelihood ratio, maximised over onset and severity.
    """

    def _statistic(self) -> tuple[FloatArray, Actions]:
        ratios = self.belief.ratios
        return ratios.max(axis=1), self._declarations[ratios.argmax(axis=1)]


class LookAhead(Probing):
    """Moves the voltage to where it is worth most, if one were told next which class of fault it may be (`pairs`).

    That is the worth of the posterior split into pairs, a class or none. Healthy motors are counted with the
    winding fault that shows least. As nobody tells the class, a look is worth more than that, by a bonus. (With
    the state told instead of the class: Littman, Cassandra & Kaelbling 1995.)

    Args:
        test: decides.
        bonus: what a step with a moved voltage is worth beyond.
    """

    test: ExpectedRewardTest

    def __init__(self, test: ExpectedRewardTest, bonus: float) -> None:
        super().__init__(test)
        setup = test.belief.setup
        options, faults = setup.options, known_faults(setup)
        self._pairs = [Pair(setup, which) for which in faults]
        self._offsets_v = np.array(options.offsets_v)
        self._bonus = np.where(self._offsets_v == 0.0, 0.0, bonus)[:, None]
        shown = np.array([pair.looks.information[3, 3] for pair in self._pairs])  # by 1 V
        hides = kind_matrix(setup, faults)[:, winding_of(setup)] > 0.0
        self._hidden = int(np.where(hides, shown, np.inf).argmin())
        healthy = float(options.task.class_probabilities[setup.right_declarations == 0].sum())
        seeming = np.where(np.arange(len(self._pairs)) == self._hidden, healthy, 0.0)
        self._worths = [
            np.array([worth[..., 0].astype(np.float32) for worth in pair.worths(at)])[::-1]
            for pair, at in zip(self._pairs, seeming[:, None], strict=True)
        ]

    def start(self, count: int) -> None:
        """Forget everything; so many sub-environments begin."""
        super().start(count)
        self._places, self._last = np.zeros((len(self._pairs), 2, count)), np.zeros(count, dtype=np.int64)

    def probe(self) -> Actions:
        """The offset that is worth most."""
        belief = self.test.belief
        present, absent = belief.classes, belief.coming
        absent[:, self._hidden] += np.maximum(belief.quiet - absent.sum(axis=1), 0.0)
        with np.errstate(divide="ignore"):
            odds = np.clip(np.log(present) - np.log(absent), LOG_ODDS[0], LOG_ODDS[-1])
        at = (odds - LOG_ODDS[0]) / (LOG_ODDS[1] - LOG_ODDS[0])
        total = np.tile(self._bonus, self.count)
        for c, (pair, worths) in enumerate(zip(self._pairs, self._worths, strict=True)):
            where = [self._last, *pair.coordinates(self._places[c]), at[:, c]]
            for m, table in enumerate(worths[belief.steps[0]]):
                cube = table.reshape(-1, PLACES, PLACES, len(LOG_ODDS))
                total[m] += (present + absent)[:, c] * map_coordinates(cube, where, order=1)
        last, self._last = self._last, total.argmax(axis=0)
        before, now = self._offsets_v[last], self._offsets_v[self._last]
        for c, pair in enumerate(self._pairs):
            self._places[c] = pair.looks.move @ [*self._places[c], before, now, np.ones(self.count)]
        return self._last


AHEAD_S = 0.1
LEVELS, RATES = 32, 4  # severities of each kind, and rates of growth that are told apart
SPREAD_V, SPREAD_N_M = 0.05, 2e-4  # of the residuals of the decisions, beyond what the sensors' noise gives
LIMP_ABOVE_N_M, STOP_ABOVE = 1.5e-3, 4.25  # load beyond the known one; resistance over the healthy motor's


class PlannedDrive(Lqg):
    """LQG on a bank of filters that knows the time left, the prices, and how fast faults may grow.

    Args:
        setup: of the environment.
        late_cost: what it costs, beyond the time lost, if a motor would have to stop before the end.
        margin: of bearing and winding, the share of a failure's price that counts where it decides to stop: what the
            bank says of the last severity is coarse.
    """

    def __init__(
        self, setup: DriveSetup, *, late_cost: float = 1.5, margin: tuple[float, float] = (0.3, 0.3)
    ) -> None:
        super().__init__(setup, levels=LEVELS)
        o = setup.options
        self._margin, self._late = margin, late_cost
        slow, fast = o.growth_per_s
        rates = slow * (fast / slow) ** ((np.arange(RATES) + 0.5) / RATES)
        self._spread = np.log(np.array(o.failure_severity) / np.array(o.onset_severity))
        self._pace = rates[None, :] / self._spread[:, None]  # of the share from onset to failure, 1/s
        self._shares = (np.arange(LEVELS) + 0.5) / LEVELS
        weights = np.array(o.weights) / sum(o.weights)
        self._onset = weights[1:, None] / RATES * o.period_s / (o.mean_onset_s + o.period_s)
        self._stress = [self._mean_pace(share) for share in (1.0, o.limp_share)]

    def _mean_pace(self, scale: float) -> float:
        """Mean pace of a bearing's growth over the profile, which is scaled."""
        o = self.setup.options
        speed = scale * np.linspace(o.lowest_speed_rad_s, o.top_speed_rad_s, 200)
        return float(self._stressed(speed).mean())

    def _stressed(self, speed: FloatArray) -> FloatArray:
        o = self.setup.options
        power = np.maximum(self._torque(speed, np.zeros_like(speed)) * speed, 0.0)
        pace: FloatArray = 1.0 + o.stress_share * (power / self.setup.task.full_power_w - 1.0)
        return pace

    def start(self, count: int) -> None:
        """Forget everything; so many sub-environments begin."""
        super().start(count)
        self._faults = np.zeros((2, RATES, LEVELS, count))

    def _predicted(self, seen: dict[str, FloatArray]) -> FloatArray:
        """Let the faults set in and grow: probability of each motor of the bank, shape (h, count)."""
        o = self.setup.options
        self._left_s = (1.0 - seen["time"]) * o.horizon_s
        may_begin = o.horizon_s - self._left_s > o.earliest_onset_s
        pace = np.stack([self._stressed(seen["measured_speed"]), np.ones_like(self._left_s)])
        share = (self._pace[:, :, None] * pace[:, None] * o.period_s * LEVELS)[:, :, None]
        healthy = self.probability[0]
        for _ in range(o.steps_per_decision):
            moved = self._faults * share
            self._faults -= moved
            self._faults[:, :, 1:] += moved[:, :, :-1]
            begins = self._onset[:, :, None] * (healthy * may_begin)
            self._faults[:, :, 0] += begins
            healthy = healthy - begins.sum(axis=(0, 1))
        return np.concatenate([healthy[None], self._faults.sum(axis=1).reshape(-1, len(healthy))])

    def _weigh(self, fit: FloatArray, seen: dict[str, FloatArray]) -> None:
        before = self._predicted(seen)
        logs = fit + np.log(before + LEAST)
        self.probability = np.exp(logs - logsumexp(logs, axis=0))
        ratio = self.probability[1:] / (before[1:] + 1e-300)
        self._faults *= ratio.reshape(2, 1, LEVELS, -1)

    def _begin(self, new: Any, measured: FloatArray) -> None:
        super()._begin(new, measured)
        self._faults[..., new] = 0.0

    def _limping(self, share: FloatArray, left_s: FloatArray) -> FloatArray:
        """Cost to the end for a bearing that limps from now on, which stops at failure; (rates, levels, count)."""
        o = self.setup.options
        pace = self._pace[0][:, None, None] * self._stress[1]
        end = share + pace * left_s
        lost = np.maximum(end - 1.0, 0.0) / pace
        wear = o.wear_cost * np.exp((np.minimum(end, 1.0) - 1.0) * self._spread[0])
        saved = o.stop_cost_per_s - o.limp_cost_per_s
        cost: FloatArray = wear + lost * saved + np.clip((end - 1.0) / 0.05, 0.0, 1.0) * self._late
        return cost

    def _decision(self) -> FloatArray:
        o = self.setup.options
        left, share = self._left_s, self._shares[None, :, None]
        pace = self._pace[0][:, None, None]
        bearing = self._faults[0]
        after = [self._limping(share + pace * k * AHEAD_S, left - AHEAD_S) for k in self._stress]
        dearer = (bearing * (after[0] - after[1])).sum(axis=(0, 1)) / AHEAD_S
        limps = (dearer > o.limp_cost_per_s) | (self._temperature > o.warm_k)
        ahead_s = o.period_s * o.steps_per_decision
        paces = self._pace * [[self._stress[0]], [1.0]]
        reached = self._shares + paces[:, :, None] * ahead_s - 1.0
        fails = np.clip(reached * LEVELS + 0.5, 0.0, 1.0) * np.array(self._margin)[:, None, None]
        risk = np.tensordot(fails, self._faults, axes=3) * o.failure_cost / ahead_s
        stops = (risk > o.stop_cost_per_s) | (self._temperature > 0.95 * o.burn_k)
        return self._decided(limps, stops)


class PlannedDecisions(PlannedDrive):
    """The same where the drive's own controller sets the voltage, and an observation follows every few periods.

    The bank cannot follow in between. What is seen tells the faults directly: voltage less back-EMF over the current is
    the resistance, and what the healthy motor's filter takes for a load that nobody knows is the friction of a bearing.

    Args:
        setup: of the environment.
    """

    def __init__(self, setup: DriveSetup) -> None:
        super().__init__(setup, late_cost=4.0, margin=(1.5, 0.3))
        o, motor = setup.options, setup.options.driven
        self._kept = 1.0 - (1.0 - setup.task.cooling) ** o.steps_per_decision
        self._drag = (self.bank.drag - self.bank.drag[0])[:, None]
        self._back_emf = float(motor.back_emf_constant_v_s_per_rad)

    def start(self, count: int) -> None:
        """Forget everything; so many sub-environments begin."""
        super().start(count)
        self._load = np.zeros((len(self.bank.kind), count))

    def act(self, observations: Observations) -> NDArray[Any]:
        """The decision."""
        seen = named(self.setup, observations)
        self._follow(seen)
        decision = self._decision()
        return as_actions(self.setup.options.control, np.stack([np.zeros(len(decision)), decision], axis=1))

    def _follow(self, seen: dict[str, FloatArray]) -> None:
        o, ohm = self.setup.options, self.bank.ohm[:, None]
        current, speed = seen["measured_current"], seen["measured_speed"]
        volts = seen["voltage"] - self._back_emf * speed - ohm * current
        volts_std = np.sqrt(
            (ohm * o.current_noise_a) ** 2 + (self._back_emf * o.speed_noise_rad_s) ** 2 + SPREAD_V**2
        )
        load = seen["estimated_load"] - self._drag * speed
        kept = o.load_memory**o.steps_per_decision
        load_std = np.sqrt(o.load_std_n_m**2 * (1.0 - kept**2) + SPREAD_N_M**2)
        fit = -0.5 * ((volts / volts_std) ** 2 + ((load - kept * self._load) / load_std) ** 2) - np.log(
            volts_std
        )
        self._load = load
        self._weigh(fit, seen)
        rise = (
            current**2 * (self.bank.ohm @ self.probability) * o.thermal_resistance_k_per_w - self._temperature
        )
        self._temperature += self._kept * rise
        self._begin(seen["time"] == 0.0, np.stack([current, speed]))
        self._load[:, seen["time"] == 0.0] = 0.0


class ShownFaults:
    """Limps where the load seems too large, stops where the resistance seems too large: two thresholds on what is seen.

    Args:
        setup: of an environment whose action is a decision.
    """

    def __init__(self, setup: DriveSetup) -> None:
        self.setup = setup

    def start(self, count: int) -> None:
        """Nothing is remembered."""

    def act(self, observations: Observations) -> NDArray[Any]:
        """The decision."""
        seen, motor = named(self.setup, observations), self.setup.options.driven
        volts = seen["voltage"] - float(motor.back_emf_constant_v_s_per_rad) * seen["measured_speed"]
        healthy = float(np.asarray(motor.resistance_ohm)) * np.maximum(seen["measured_current"], 0.1)
        limps = seen["estimated_load"] > LIMP_ABOVE_N_M
        decision = np.where(volts / healthy > STOP_ABOVE, STOP, np.where(limps, LIMP, RUN))
        return as_actions(self.setup.options.control, np.stack([np.zeros(len(decision)), decision], axis=1))
