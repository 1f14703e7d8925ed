"""Alarms and delays of `motor-env watch` on simulated work; watch_c counts those of the exported C with its parts.

    python benchmarks/watch_counts.py delays --runs 12
    python benchmarks/watch_counts.py other-physics --motors 10 --hours 0.25 --rows out/watch_other_physics.jsonl

`delays`: the textbook motor with a heavy flywheel on a test bench: a random duty cycle at 1 Hz, and nothing else moves.
It comes as the text that a device would print, in windows of 10 min after a commissioning of 5 h. One false alarm is
asked for in an hour, and in a year; the fault begins anywhere in a window. Beside it stands the CUSUM that knows kind
and size of the fault: it adds up the likelihood ratio of two Kalman filters of current and speed. Its threshold is
found by simulation for one alarm an hour.

`other-physics`: false alarms on motors of operation_simulator.py with all its switches on, whose physics the fit does
not have, each at work under one profile at 100 Hz. Windows of 20 s, a commissioning of 200 s, one false alarm an hour
asked for. A run that was stopped goes on where it was.
"""

from __future__ import annotations

import math
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from cyclopts import App
from numba import njit
from numpy.typing import NDArray
from operation_simulator import PROFILES, SWITCHES, draw_motor, simulate
from scipy.stats import poisson
from tables import keep_table
from verdict_tables import kept_rows

from motor_env import PAPER_MOTOR, Fault, FaultKind, KalmanFilter, SensorParameters, run_filter
from motor_env.diagnosis.operation.sequential_monitor import YEAR_S
from motor_env.diagnosis.streaming.state import State
from motor_env.diagnosis.streaming.watch import Event, LearningPhase, Watch
from motor_env.motor.faults import apply_fault
from motor_env.motor.healthy import Healthy
from motor_env.motor.model import discretize
from motor_env.motor.parameters import Channel, MotorParameters

app = App()
Floats = NDArray[np.float64]
Samples = TypeVar("Samples")
FLYWHEEL = 1000.0  # times the rotor's inertia
VOLTS = 12.0
RATES = {"hour": YEAR_S / 3600.0, "day": YEAR_S / 86_400.0}
"""False alarms a year that are asked for."""
NO_ALARM = ("window healthy", "window unusable")
ALARM_HEADER = ("asked for", "hours", "alarms due", "1 to 99 % of Poisson's", "alarms")


def heavy(inertia: float = FLYWHEEL) -> MotorParameters:
    """The textbook motor with a flywheel."""
    return PAPER_MOTOR.scaled(inertia_kg_m2=inertia)


@njit(cache=True)
def moved(transition: Floats, gain: Floats, volts: Floats, x: Floats) -> Floats:
    """States after each sample; `x` is left as the last of them."""
    out = np.empty((len(volts), 2))
    for k in range(len(volts)):
        i = transition[0, 0] * x[0] + transition[0, 1] * x[1] + gain[0] * volts[k]
        w = transition[1, 0] * x[0] + transition[1, 1] * x[1] + gain[1] * volts[k]
        x[0], x[1] = i, w
        out[k] = x
    return out


def duty(rng: np.random.Generator, samples: int, holds: tuple[int, int], *, least: float = -1.0) -> Floats:
    """A random share of the voltage, least .. 1, held for a random while."""
    lengths = rng.integers(holds[0], holds[1] + 1, samples // holds[0] + 1)
    levels: Floats = np.repeat(VOLTS * rng.uniform(least, 1.0, len(lengths)), lengths)[:samples]
    return levels


def motion(motor: MotorParameters, dt_s: float, volts: Floats, x: Floats) -> Floats:
    """Current and speed after each sample; `x` is left as the last of them."""
    model = discretize(motor, dt_s)
    states: Floats = moved(model.transition, model.gain[:, 0], volts, x)
    return states


def lines(blocks: Iterable[Floats], form: bytes = b"%.0f,%.5g,%.5g,%.6g\n") -> Iterator[bytes]:
    """What a device prints."""
    yield b"time_s,voltage_v,current_a,speed_rad_s\n"
    for block in blocks:
        for row in block.tolist():
            yield form % tuple(row)


def alarms(said: Iterable[Event]) -> int:
    """Alarms; what follows one without a healthy window between is the same."""
    count, was = 0, False
    for event in said:
        is_alarm = event.kind in ("window", "another_motor") and event.name not in NO_ALARM
        count += is_alarm and not was
        if is_alarm or event.name in NO_ALARM:
            was = is_alarm
    return count


def due(rate: str, hours: float) -> float:
    """Alarms that are due on healthy work."""
    return hours * 3600.0 * RATES[rate] / YEAR_S


def alarm_row(what: str, rate: str, hours: float, alarms: int) -> list[str]:
    """Alarms beside those that are due, and the limits of chance."""
    expected = due(rate, hours)
    low, high = (int(poisson.ppf(share, expected)) for share in (0.01, 0.99))
    asked = f"one {'an' if rate == 'hour' else 'a'} {rate}"
    return [what, asked, f"{hours:g}", f"{round(expected, 2):g}", f"{low} to {high}", str(alarms)]


@njit(cache=True)
def alarms_of(ratios: Floats, threshold: float) -> tuple[int, int]:
    """Alarms of a CUSUM that begins anew after each, and the sample of the first or -1."""
    total, count, first = 0.0, 0, -1
    for k in range(len(ratios)):
        total = max(0.0, total + ratios[k])
        if total > threshold:
            first = k if count == 0 else first
            count += 1
            total = 0.0
    return count, first


def best_threshold(ratios: Floats, wanted: int) -> float:
    """Threshold at which healthy samples alarm so often, by bisection."""
    low, high = 0.0, 40.0
    for _ in range(30):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if alarms_of(ratios, middle)[0] > wanted else (low, middle)
    return high


def delays_by_fault(
    motor: MotorParameters,
    faults: Iterable[tuple[FaultKind, float]],
    usual: tuple[Samples, float],
    ratios: Callable[[Samples, MotorParameters], Floats],
    onset: int,
) -> Iterator[tuple[tuple[FaultKind, float], MotorParameters, Callable[[Samples], float]]]:
    """For each fault: kind and size, the faulty motor, and the samples that the best CUSUM needs in a record.

    Args:
        motor: the healthy one.
        faults: kind and severity.
        usual: healthy work, and how often the CUSUM may alarm in it.
        ratios: log likelihood ratios of samples, of a faulty motor over the healthy one.
        onset: sample of a record at which the fault begins.
    """
    healthy, wanted = usual
    for kind, severity in faults:
        faulty = apply_fault(motor, Fault(kind, severity))
        threshold = best_threshold(ratios(healthy, faulty), round(wanted))

        def best(samples: Samples, faulty: MotorParameters = faulty, threshold: float = threshold) -> float:
            first = alarms_of(ratios(samples, faulty)[onset:], threshold)[1]
            return first + 1 if first >= 0 else math.inf

        yield (kind, severity), faulty, best


NOISE_A, NOISE_RAD_S = 0.02, 1.0
SENSOR = SensorParameters((Channel.CURRENT, Channel.SPEED), NOISE_A, NOISE_RAD_S)
WINDOW_S, LEARN_S = 600.0, 5 * 3600.0
HEALTHY_S, FAULTY_S, CALIBRATION_H = 1200, 3600, 50
HOLDS = (6, 16)
FAULTS = (
    (FaultKind.BEARING, 0.25),
    (FaultKind.BEARING, 0.5),
    (FaultKind.BEARING, 1.0),
    (FaultKind.WINDING_CONTACT, 0.1),
    (FaultKind.WINDING_CONTACT, 0.25),
    (FaultKind.BEARING, 0.1),
    (FaultKind.WINDING_CONTACT, 0.01),
    (FaultKind.WINDING_CONTACT, 0.005),
)
ASKED = {"hour": RATES["hour"], "year": 1.0}
DELAY_HEADER = ("fault", "best CUSUM, hour (s)", "`watch`, hour (s)", "year (s)", "named at once")


def work(rng: np.random.Generator, *parts: tuple[MotorParameters, int]) -> Floats:
    """Time, voltage, current, speed at 1 Hz of motors, each for so many seconds, shape (n, 4)."""
    volts, x = duty(rng, sum(seconds for _, seconds in parts), HOLDS), np.zeros(2)
    ends = np.cumsum([seconds for _, seconds in parts])[:-1]
    each = zip(parts, np.split(volts, ends), strict=True)
    states = np.concatenate([motion(motor, 1.0, some, x) for (motor, _), some in each])
    shown = states + rng.standard_normal(states.shape) * (NOISE_A, NOISE_RAD_S)
    return np.column_stack([np.arange(len(volts)) + 1.0, volts, shown])


def taught(samples: Floats) -> Healthy:
    """Learn a healthy motor at work as `watch --learn` does, from what a device prints."""
    watch = Watch(LearningPhase(WINDOW_S, LEARN_S, steady=True), State(), false_alarms_per_year=1.0)
    next(event for event in watch.events(lines([samples])) if event.kind == "learned")
    if watch.healthy is None:
        raise TypeError("nothing was learned")
    return watch.healthy


def logs(motor: MotorParameters, samples: Floats) -> Floats:
    """Log likelihood of each sample."""
    _, volts, *measured = samples.T
    result = run_filter(KalmanFilter.from_parameters(motor, SENSOR, 1.0), np.array(measured), volts)
    out: Floats = -0.5 * (result.nis + np.linalg.slogdet(result.innovation_covariance)[1])
    return out


def ratios(samples: Floats, faulty: MotorParameters) -> Floats:
    """Log likelihood ratio of each sample."""
    return logs(faulty, samples) - logs(heavy(), samples)


def first_alarm(healthy: Healthy, samples: Floats, onset_s: float, rate: str) -> tuple[float, str]:
    """Measure the time from the fault's begin to the first alarm, and its verdict; infinite where there is none."""
    watch = Watch(healthy, State(), false_alarms_per_year=ASKED[rate])
    for event in watch.events(lines([samples])):
        if event.time_s > onset_s and event.name not in NO_ALARM:
            return event.time_s - onset_s, event.text
    return np.inf, "none"


def compared(runs: int) -> Iterator[tuple[str, float, list[str]]]:
    """Measure for each fault a row of median delays; yield its kind and size, too."""
    rng = np.random.default_rng([77, 3])
    healthy = taught(work(rng, (heavy(), int(LEARN_S + WINDOW_S))))
    usual = work(rng, (heavy(), CALIBRATION_H * 3600)), float(CALIBRATION_H)
    for fault, faulty, best in delays_by_fault(heavy(), FAULTS, usual, ratios, HEALTHY_S):
        kind, severity = fault
        firsts = []
        ours: dict[str, list[tuple[float, str]]] = {rate: [] for rate in ASKED}
        for _ in range(runs):
            samples = work(rng, (heavy(), HEALTHY_S), (faulty, FAULTY_S))
            firsts.append(best(samples))
            late = samples[rng.integers(int(WINDOW_S)) :]
            for rate, found in ours.items():
                found.append(first_alarm(healthy, late, HEALTHY_S, rate))
        ours_s = [float(np.median([delay for delay, _ in found])) for found in ours.values()]
        row = [
            f"{kind} +{severity:.1%}",
            f"{np.median(firsts):.3g}",
            *(f"{delay:.4g}" if np.isfinite(delay) else "none in an hour" for delay in ours_s),
            f"{sum(verdict == kind.verdict for _, verdict in ours['hour']) / runs:.0%}",
        ]
        print(*row, sep=", ", file=sys.stderr, flush=True)
        yield str(kind), severity, row


@app.command
def delays(*, runs: int = 40) -> None:
    """Measure the delays on the test bench and keep the table of docs/results/watch-delay.md."""
    keep_table("watch-delay", "delays", DELAY_HEADER, (row for _, _, row in sorted(compared(runs))))


SHORT_WINDOW_S, SHORT_LEARN_S, DT_S = 20.0, 200.0, 0.01
SUPPORT = {"yes": "if the fitted tails hold", "no": "is not supported"}
OTHER_HEADER = (
    *ALARM_HEADER,
    "on one motor",
    "motors beyond 99 %",
    "unusable windows",
    "rate supported",
)


def watched(job: tuple[int, int, float]) -> dict[str, Any]:
    """Watch one motor: alarms behind its commissioning, their names, and whether the rate is supported."""
    seed, number, hours = job
    rng, profile = np.random.default_rng([seed, number]), PROFILES[number % len(PROFILES)]
    samples = round((SHORT_LEARN_S + 2.0 * SHORT_WINDOW_S + 3600.0 * hours) / DT_S)
    recording = simulate(draw_motor(rng, SWITCHES), profile, rng, samples=samples, dt_s=DT_S)
    columns = (recording.time_s, recording.voltage_v, recording.current_a, recording.speed_rad_s)
    block = np.column_stack([np.asarray(column) for column in columns])
    watch = Watch(LearningPhase(SHORT_WINDOW_S, SHORT_LEARN_S), State(), false_alarms_per_year=RATES["hour"])
    said = list(watch.events(lines([block], b"%.2f,%.6g,%.6g,%.6g\n")))
    names = Counter(event.name for event in said if event.kind in ("window", "another_motor"))
    promise = next((event.text for event in said if event.kind == "learned"), "")
    return {
        "number": number,
        "profile": profile,
        "hours": hours,
        "alarms": alarms(said),
        "names": {name: count for name, count in names.items() if name != "window healthy"},
        "by": next((how for how, words in SUPPORT.items() if words in promise), "nothing learned"),
    }


def counted_row(found: list[dict[str, Any]]) -> list[str]:
    """Make the row of all motors."""
    hours = sum(one["hours"] for one in found)
    by = Counter(one["by"] for one in found)
    unusable = sum(one["names"].get("window unusable", 0) for one in found)
    return [
        *alarm_row("all", "hour", hours, sum(one["alarms"] for one in found))[1:],
        f"{max(one['alarms'] for one in found)} at most",
        f"{sum(one['alarms'] > poisson.ppf(0.99, due('hour', one['hours'])) for one in found)} of {len(found)}",
        f"{unusable * SHORT_WINDOW_S / 3600.0 / hours:.0%}",
        ", ".join(f"{how} {count}" for how, count in sorted(by.items())),
    ]


@app.command
def other_physics(
    *,
    motors: int = 40,
    hours: float = 0.5,
    seed: int = 5,
    workers: int = 1,
    rows: Path | None = None,
) -> None:
    """Watch motors of other physics and keep the table of docs/results/motors-at-work.md.

    Args:
        motors: number.
        hours: that each is watched.
        seed: of the motors.
        workers: processes.
        rows: file of a JSON line a motor; those that it holds are not watched again.
    """
    jobs = {number: (seed, number, hours) for number in range(motors)}
    known = kept_rows(watched, jobs, lambda row: row["number"], workers, rows)
    keep_table("motors-at-work", "watched", OTHER_HEADER, [counted_row(known)])


if __name__ == "__main__":
    app()
