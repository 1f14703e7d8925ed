"""Score the baselines of the environments: designs and thresholds tuned on one seed, scores from others.

python benchmarks/baselines.py --task Monitor-v0/medium
python benchmarks/baselines.py --task all --episodes 1000
"""

from collections.abc import Callable, Iterator, Sequence
from itertools import chain, product
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from cyclopts import run
from look_ahead import LookAhead, RatioTest
from tables import print_table
from tolerances import TolerancePolicy

from motor_env.detection.rules import Cusum, Glr, MOfN, Rule, nis_rule
from motor_env.envs.baselines.evaluation import Runs, joined, score, sweep
from motor_env.envs.baselines.policies import (
    BankPolicy,
    Never,
    Random,
    RulePolicy,
    ThresholdPolicy,
    baseline_features,
)
from motor_env.envs.baselines.posterior_policies import BayesPolicy
from motor_env.envs.baselines.probing import Bursts, OnDemand, OpenLoop, WorthTest
from motor_env.envs.monitor import MonitorVectorEnv
from motor_env.envs.options import Drive
from motor_env.envs.probe import ProbeVectorEnv
from motor_env.envs.setup import Setup
from motor_env.envs.tasks import task_recipe
from motor_env.envs.vector import MotorVectorEnv
from motor_env.motor.parameters import FloatArray

Task = Literal[
    "Monitor-v0/easy",
    "Monitor-v0/medium",
    "Monitor-v0/hard",
    "Monitor-v0/small",
    "MonitorSpeedLoop-v0/medium",
    "Probe-v0/small",
    "Probe-v0/medium",
]
HEADER = (
    *("policy", "design", "threshold", "return", "false alarms", "detected", "right kind"),
    *("median delay", "probing", "too late"),
)
N_THRESHOLDS = 24
TUNING_SEED = 100
EVALUATION_SEEDS = (1, 2, 3, 4, 5)
SHORTLIST = 6


class Design(NamedTuple):
    """One way to build a policy, and the thresholds to try with it; offsets of the voltage where it moves it."""

    label: str
    build: Callable[[Setup], ThresholdPolicy]
    thresholds: FloatArray
    level_v: float = 1.0


Entry = tuple[str, Sequence[Design]]
"""A policy, and the ways to build it."""


class Tuned(NamedTuple):
    """What the tuning chose, and its mean return there."""

    mean_return: float
    design: Design
    threshold: float


def geometric(low: float, high: float) -> FloatArray:
    """The thresholds that are tried, in equal ratios."""
    return np.geomspace(low, high, N_THRESHOLDS)


WORTHS = 1.0 - geometric(0.002, 1.0)
RATIOS = geometric(2.0, 60.0)


def rule(label: str, of: Rule, thresholds: FloatArray) -> Design:
    """A rule on the innovation."""
    return Design(label, lambda setup: RulePolicy(setup, of, threshold=0.0), thresholds)


def passive(setup: Setup) -> Iterator[tuple[str, list[Design]]]:
    """Rules that never move the voltage, and chance; shifts and windows are scaled to the samples of a step."""
    n, uniform = setup.options.samples_per_step, 1.0 - len(setup.kinds) / len(setup.offsets_v)
    rng = np.random.default_rng(0)
    yield "never", [Design("", lambda _: Never(), np.ones(1))]
    yield "random", [Design("", lambda setup: Random(setup, rng), np.array([uniform]))]
    yield "NIS", [rule("", nis_rule(), geometric(3.0, 90.0))]
    counts = ((2, 3), (3, 5), (5, 10), (6, 14))
    yield "M of N", [rule(f"{m} of {k}", MOfN(m, k), geometric(0.5, 60.0)) for m, k in counts]
    shifts = [d * n**0.5 for d in (0.06, 0.12, 0.24, 0.48)]
    yield "CUSUM", [rule(f"shift {d:.2g}", Cusum(d, two_sided=True), RATIOS / d) for d in shifts]
    windows = [(max(1, a // n), b // n) for a, b in ((1, 100), (5, 400), (20, 800), (40, 1600))]
    yield "GLR of a step", [rule(f"{a} to {b}", Glr(a, b, two_sided=True), RATIOS) for a, b in windows]
    yield "bank of filters", [Design("", lambda setup: BankPolicy(setup, 0.0), RATIOS)]


def bursts(n_steps: int) -> list[Bursts]:
    """Open-loop probes to try at 1 V: start, period, length (all of it: one burst), sides changed each step or two."""
    periods = (6, 8, 10, 12, 15, 20, 40, n_steps)
    tried = product((10, 20), periods, (1, 2, 3, 4, 6), (1, 2))
    return [Bursts(*design) for design in tried if design[2] <= design[1]]


def open_loop(test: type[WorthTest], probe: Bursts, thresholds: FloatArray, level_v: float) -> Design:
    """A test under an open-loop probe."""
    label = (
        f"{level_v:g} V, {probe.length} of {probe.period} steps from {probe.start}, sides {probe.half_period}"
    )

    def build(setup: Setup) -> ThresholdPolicy:
        return OpenLoop(test(setup, 0.0), probe.actions(setup.options.n_steps))

    return Design(label, build, thresholds, level_v)


def on_demand(above: float, level_v: float) -> Design:
    """The posterior asks for the probe."""
    label = f"{level_v:g} V above {above:g}"
    return Design(label, lambda setup: OnDemand(WorthTest(setup, 0.0), above), WORTHS, level_v)


def look_ahead(bonus: float) -> Design:
    """The worth of every offset is computed beforehand."""
    return Design(f"1 V, bonus {bonus:g}", lambda setup: LookAhead(WorthTest(setup, 0.0), bonus), WORTHS)


class Bench:
    """Tunes and scores policies on one task.

    Args:
        name: environment and recipe, for example Monitor-v0/medium.
        episodes: of a seed.
    """

    def __init__(self, name: str, episodes: int) -> None:
        self.environment, recipe = name.split("/")
        self.recipe, self.episodes = task_recipe(recipe), episodes
        self.drive = Drive.SPEED_LOOP if self.environment == "MonitorSpeedLoop-v0" else Drive.OPEN_LOOP
        self._made: dict[tuple[int, float], MotorVectorEnv] = {}
        self.envs = self.vector(episodes)

    def vector(self, count: int, level_v: float = 1.0) -> MotorVectorEnv:
        """So many sub-environments with that level of the voltage's offsets."""
        if (count, level_v) not in self._made:
            options: dict[str, Any] = {
                "recipe": self.recipe,
                "observe": baseline_features(self.recipe),
                "drive": self.drive,
            }
            probes = self.environment == "Probe-v0"
            self._made[count, level_v] = (
                ProbeVectorEnv(count, **options, offsets_v=(0.0, -level_v, level_v))
                if probes
                else MonitorVectorEnv(count, **options)
            )
        return self._made[count, level_v]

    def tune(self, designs: Sequence[Design], episodes: int) -> list[Tuned]:
        """The best threshold of every design, best design first, on the tuning seed."""
        found = []
        for design in designs:
            envs = self.vector(episodes, design.level_v)
            runs = sweep(envs, design.build(envs.setup), list(design.thresholds), TUNING_SEED)
            means = [float(run.returns.mean()) for run in runs]
            best = int(np.argmax(means))
            found.append(Tuned(means[best], design, float(design.thresholds[best])))
        return sorted(found, key=lambda tuned: -tuned.mean_return)

    def evaluate(self, policy: ThresholdPolicy, threshold: float, level_v: float = 1.0) -> Runs:
        """What it does on the evaluation seeds."""
        envs = self.vector(self.episodes, level_v)
        return joined([sweep(envs, policy, [threshold], seed)[0] for seed in EVALUATION_SEEDS])

    def row(self, name: str, designs: Sequence[Design]) -> list[str]:
        """A line of the table: the best of the designs on the tuning seed, scored on the others."""
        _, design, threshold = self.tune(designs, 2 * self.episodes)[0]
        policy = design.build(self.vector(self.episodes, design.level_v).setup)
        found = score(self.envs, self.evaluate(policy, threshold, design.level_v))
        return [
            name,
            design.label,
            f"{threshold:.4g}",
            f"{found.mean_return:+.3f} ± {found.return_half_width:.3f}",
            *(
                f"{share:.1%}"
                for share in (found.false_alarm_share, found.detected_share, found.isolated_share)
            ),
            f"{1e3 * found.median_delay_s:.1f} ms",
            *(f"{share:.1%}" for share in (found.probing_share, found.late_share)),
        ]

    def passive(self) -> Iterator[Entry]:
        """Policies that do not move the voltage."""
        yield from passive(self.envs.setup)
        if self.drive is Drive.SPEED_LOOP:
            return  # no posterior: nobody is told what the controller does
        posterior = TolerancePolicy if self.recipe.name == "hard" else BayesPolicy
        test = WorthTest if self.environment == "Probe-v0" else posterior
        yield "Bayes posterior", [Design("", lambda setup: test(setup, 0.0), WORTHS)]

    def probing(self) -> Iterator[Entry]:
        """Policies that move the voltage: all bursts on few episodes at 1 V, the best of them at all levels on many."""
        yield "look ahead", [look_ahead(bonus) for bonus in (0.0006, 0.001, 0.0015, 0.003)]
        levels = (0.7, 1.0, 1.4)
        yield "on demand", [on_demand(p, level) for p in (0.03, 0.045, 0.06, 0.08) for level in levels]
        tried = bursts(self.envs.options.n_steps)
        first = self.tune([open_loop(WorthTest, probe, WORTHS, 1.0) for probe in tried], self.episodes // 2)
        labels = {open_loop(WorthTest, probe, WORTHS, 1.0).label: probe for probe in tried}
        short = [labels[tuned.design.label] for tuned in first[:SHORTLIST]]
        for name, test, thresholds in (
            ("open loop, matched GLR", RatioTest, RATIOS),
            ("open loop, Bayes posterior", WorthTest, WORTHS),
        ):
            yield name, [open_loop(test, probe, thresholds, level) for probe in short for level in levels]

    def rows(self, only: str | None) -> Iterator[list[str]]:
        """All lines of the task's table, or that of one policy."""
        probing = self.probing() if self.environment == "Probe-v0" else iter(())
        for name, designs in chain(self.passive(), probing):
            if only in (None, name):
                yield self.row(name, designs)
            if only == name:
                return


def main(
    *, task: Task | Literal["all"] = "Monitor-v0/medium", episodes: int = 1000, policy: str | None = None
) -> None:
    """Print the tables.

    Args:
        task: environment and recipe.
        episodes: of each of the five evaluation seeds.
        policy: the one of this name alone, for example "look ahead".
    """
    for name in get_args(Task) if task == "all" else (task,):
        print_table(name, HEADER, Bench(name, episodes).rows(policy))


if __name__ == "__main__":
    run(main)
