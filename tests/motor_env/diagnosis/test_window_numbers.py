"""The judgement of windows and of looks part by part: rates, borders, spreads, what is chosen, what is said."""

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy import stats

from motor_env import FaultKind, InputError, Recording
from motor_env.cli import main
from motor_env.diagnosis.explanations import Change, joint_share
from motor_env.diagnosis.running import lessons, logs, looks as looking, windows
from motor_env.diagnosis.running.lessons import learn_windows
from motor_env.diagnosis.running.logs import RunningRecord, commissioned_text, exit_status
from motor_env.diagnosis.running.looks import Looks
from motor_env.diagnosis.running.windows import (
    NAMES,
    WARMTH,
    WindowVerdict,
    averaged,
    decided,
    from_healthy,
    is_closed,
    judge_windows,
    rms_volts,
    spread_of,
    windows_of,
)
from motor_env.motor.data_sheet import WindowReference
from motor_env.motor.identifiable import matrix, visible_direction
from motor_env.motor.parameters import FloatArray
from motor_env.operation import kernel
from motor_env.operation.record import Record
from motor_env.operation.window import WindowFit, first_steps
from motor_env.recordings.defects import UnusableError

EXPONENTS = matrix(NAMES)
REFERENCE = WindowReference(
    windows=12,
    window_s=0.5,
    degrees_of_freedom=15.0,
    values=np.array([2.0, 0.03, 4e-6, 1.0]),
    log_covariance=np.diag([4e-4, 1e-4, 9e-4, 16e-4]),
    terms=("R", "K", "J"),
    physical=np.zeros(kernel.N_VALUES),
    hold="held",
    dt_s=1e-3,
    rms_volts=(6.0, 8.0),
    temperature_k=0.0,
    peaks=(9.0, 3.0, 200.0),
    window_excess=0.7,
    excess=(1.1, 1.3, 1.6),
)


def recording(n: int, volts: float = 7.0, dt_s: float = 1e-3) -> Recording:
    time_s: FloatArray = dt_s * np.arange(float(n))
    sine = math.sqrt(2.0) * np.sin(2.0 * math.pi * np.arange(n) / 100.0)
    return Recording(Path("log"), time_s, np.arange(float(n)), volts * sine, 30.0 * np.arange(float(n)))


def spread(seed: int = 3) -> FloatArray:
    root = np.tril(np.random.default_rng(seed).normal(0.0, 0.01, (4, 4))) + 0.03 * np.eye(4)
    return np.asarray(root @ root.T)


def test_windows_are_cut_at_exact_samples() -> None:
    parts = windows_of(recording(1999), 0.5)
    assert [len(part.time_s) for part in parts] == [500, 500, 500]
    assert [float(part.current_a[0]) for part in parts] == [0.0, 500.0, 1000.0]
    long = recording(24_000, dt_s=1e-4)
    assert averaged(long, 0.6) is long  # 6,000 samples are kept as they are
    pairs = averaged(long, 0.61)
    assert len(pairs.time_s) == 12_000
    assert (pairs.current_a[0], pairs.time_s[0], pairs.dt_s) == pytest.approx((0.5, 5e-5, 2e-4))
    assert averaged(long, 1.21).current_a[0] == 1.0
    assert rms_volts(recording(400, 3.0)) == pytest.approx(3.0)
    with pytest.raises(UnusableError, match="only where voltage, current and speed"):
        rms_volts(replace(long, speed_rad_s=None))


def test_the_spread_of_a_window_by_hand() -> None:
    """What windows have taught, or a fit's own error where it is larger; and by how much windows scatter less."""
    error = np.diag([9e-4, 0.5e-4, 9e-4, 20e-4])
    expected = 0.7 * np.diag([9e-4, 1e-4, 9e-4, 20e-4])
    np.testing.assert_allclose(spread_of(error, REFERENCE), expected, rtol=1e-9, atol=1e-15)


@pytest.fixture
def fits(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Instead of fits: a window is off by nothing; and its rates are noted."""
    rates: list[float] = []

    def deciding(ratios: FloatArray, covariance: FloatArray, rate: float, *more: float) -> Any:
        rates.append(rate)
        return decided(ratios, covariance, rate, *more)

    def fitting(record: Record, _: FloatArray, __: Sequence[str]) -> WindowFit:
        return WindowFit(np.log(REFERENCE.values) + 0.01, np.eye(4) * 1e-6, np.zeros(kernel.N_VALUES))

    monkeypatch.setattr(windows, "fit_window", fitting)
    monkeypatch.setattr(windows, "decided", deciding)
    return rates


def test_windows_of_a_record_share_its_rate(fits: list[float]) -> None:
    found = judge_windows(recording(2500), REFERENCE, 0.03)
    assert [one.verdict for one in found] == ["healthy"] * 5
    assert [one.begin_s for one in found] == pytest.approx([0.0, 0.5, 1.0, 1.5, 2.0])
    assert fits == pytest.approx([0.03 / 5.0] * 5)
    half = stats.t.isf(0.025, 15.0)
    for change, variance in zip(found[0].changes, [4e-4, 1e-4, 9e-4, 16e-4], strict=True):
        width = half * math.sqrt(0.7 * variance)
        assert (change.ratio, change.low, change.high) == pytest.approx(
            np.exp([0.01, 0.01 - width, 0.01 + width])
        )


def test_of_many_windows_some_are_judged_and_the_rate_is_still_shared_by_all(
    fits: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    odd = {7, 20, 33}

    def predict(self: Record, _: FloatArray) -> tuple[FloatArray, float]:
        out = np.zeros((len(self.voltage_v), 6))
        window = (self.readings[:, 0] // 500.0).astype(int)
        out[:, 0] = np.where(np.isin(window, list(odd)), 5.0, 1.0 + 1e-3 * window)
        return out, 0.0

    monkeypatch.setattr(Record, "predict", predict)
    few = judge_windows(recording(40 * 500), REFERENCE, 0.03)
    assert len(few) == 40
    many = judge_windows(recording(41 * 500), REFERENCE, 0.03)
    begins = {round(one.begin_s / 0.5) for one in many}
    evenly = set(np.linspace(0, 40, 10).round().astype(int).tolist())
    worst = odd | set(range(34, 41))
    assert begins == evenly | worst
    assert [one.begin_s for one in many] == sorted(one.begin_s for one in many)
    assert fits[-1] == pytest.approx(0.03 / 41.0)


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"volts": 2.99}, "outside the commissioned regime: 2.99 V effective, commissioned 6 to 8 V"),
        ({"volts": 3.01}, ""),
        ({"volts": 15.99}, ""),
        ({"volts": 16.01}, "outside the commissioned regime"),
        ({"dt_s": 1.99e-3}, ""),
        ({"dt_s": 2.01e-3}, "another sampling interval"),
        ({"dt_s": 0.505e-3}, ""),
        ({"dt_s": 0.495e-3}, "another sampling interval"),
        ({"n": 499}, "shorter than a window of 0.5 s"),
    ],
)
def test_a_record_is_judged_near_the_commissioned_regime(
    changed: dict[str, Any], reason: str, fits: list[float]
) -> None:
    given = recording(**({"n": 2000} | changed))
    if reason:
        with pytest.raises(UnusableError, match=reason):
            judge_windows(given, REFERENCE, 0.01)
    else:
        assert judge_windows(given, REFERENCE, 0.01)


def off_by(kind: str, size: float, covariance: FloatArray, freedom: float, rate: float) -> FloatArray:
    """So many times the limit of the tests of a window along a fault."""
    share = joint_share(rate, covariance, EXPONENTS, freedom)
    g = visible_direction(FaultKind(kind), EXPONENTS)
    sd = (g @ np.linalg.inv(covariance) @ g) ** -0.5
    return np.asarray(size * stats.t.isf(share, freedom) * sd * g)


@pytest.mark.parametrize("kind", ["bearing", "winding_contact", "magnet", "winding_short"])
def test_a_window_alarms_from_its_joint_limit_on(kind: str) -> None:
    covariance, freedom, rate = spread(), 30.0, 0.02
    for size, verdict in ((0.998, "healthy"), (1.002, kind)):
        off = off_by(kind, size, covariance, freedom, rate)
        found, changes = decided(off, covariance, rate, freedom, 0.0)
        assert found == verdict
    limit = stats.t.isf(joint_share(rate, covariance, EXPONENTS, freedom), freedom)
    for change, ratio, sd in zip(changes, off, np.sqrt(np.diag(covariance)), strict=True):
        assert change.significant is bool(abs(ratio) > limit * sd)


def test_what_a_fault_leaves_unexplained_makes_it_something_else() -> None:
    """From the rate on: the rest, squared, per dimension of the three that are left."""
    covariance, freedom, rate = np.diag([4e-4, 4e-4, 4e-4, 4e-4]), 30.0, 0.02
    for size, verdict in ((0.995, "bearing"), (1.005, "other")):
        rest = size * math.sqrt(3.0 * stats.f.isf(rate, 3, freedom)) * 0.02
        off = np.array([0.0, 0.0, rest, 0.3])  # no fault moves the inertia
        assert decided(off, covariance, rate, freedom, 0.0)[0] == verdict


def test_the_whole_alarms_where_no_fault_does() -> None:
    covariance, freedom, rate = np.diag([4e-4, 4e-4, 4e-4, 4e-4]), 30.0, 0.02
    share = joint_share(rate, covariance, EXPONENTS, freedom)
    at = 0.02 * math.sqrt(4.0 * stats.f.isf(share, 4, freedom))
    for size, verdict in ((0.998, "healthy"), (1.002, "other")):
        assert decided(np.array([0.0, 0.0, size * at, 0.0]), covariance, rate, freedom, 0.0)[0] == verdict


def test_warmth_widens_what_is_healthy() -> None:
    """Along the direction of warmth 15 K are one standard deviation; R by 0.393 % a kelvin."""
    covariance = np.diag([1e-3, 1e-3, 1.0, 1e-3]) ** 2
    np.testing.assert_allclose(WARMTH, [0.00393, -0.001, 0.0, -0.003])
    ratios = np.log1p(20.0 * WARMTH)
    assert decided(ratios, covariance, 0.01, 1e3, 0.0)[0] != "healthy"
    assert decided(ratios, covariance, 0.01, 1e3, 15.0)[0] == "healthy"
    assert decided(ratios, covariance, 0.01, 1e3, 2.0)[0] != "healthy"
    # What is taken for warmth is drawn towards none by the temperature that is believed beforehand.
    pull = np.linalg.solve(spread(), WARMTH)
    kelvin = float(pull @ ratios / (pull @ WARMTH + 5.0**-2))
    found = windows._straightened(ratios, spread(), 5.0)
    np.testing.assert_allclose(found, ratios + kelvin * WARMTH - np.log1p(kelvin * WARMTH), rtol=1e-9)
    # At most 100 K are taken for warmth when logarithms are straightened.
    tight = np.diag([1e-5, 1e-5, 1.0, 1e-5]) ** 2
    for kelvin in (99.0, 101.0, 130.0):
        found = windows._straightened(np.log1p(kelvin * WARMTH), tight, 1e3)
        slope = np.linalg.solve(tight, WARMTH)
        least = slope @ np.log1p(kelvin * WARMTH) / (slope @ WARMTH + 1e-6)
        kept = min(float(least), 100.0) * WARMTH
        np.testing.assert_allclose(found, np.log1p(kelvin * WARMTH) + kept - np.log1p(kept), rtol=1e-9)


def looks(rate: float = 0.04, **changed: Any) -> Looks:
    return Looks(replace(REFERENCE, **changed), rate, np.zeros(4))


def test_looks_share_their_rate() -> None:
    """Four looks while a part passes, all lengths alike; those that overlap alarm together."""
    found, together = looks(), 1.0 - 0.5 * 0.04**0.2
    for k in (1, 2, 3):
        assert found._rate(k) == pytest.approx(0.04 / together / 3.0 / (4.0 * 2.0**k), rel=1e-12)
    assert found.every_s == 0.5 / 32.0
    assert [found.due(n) for n in (1, 2, 4)] == [[3], [2, 3], [1, 2, 3]]
    assert (found.needed_s(1), found.needed_s(3)) == (0.25, 0.0625)
    assert looks(dt_s=2e-3).needed_s(3) == pytest.approx(42 * 2e-3)


def test_the_freedom_of_a_look() -> None:
    """What was learned of its spread counts with that freedom, the rest with 80 at most (Satterthwaite)."""
    for share in (0.25, 1.0):
        for k, more in ((1, 80.0), (3, 80.0)):
            spread_ = REFERENCE.log_covariance * REFERENCE.excess[k - 1] / share
            expected = 1.0 / (share**2 / 15.0 + 1.0 / more)
            assert looks()._freedom(spread_, k) == pytest.approx(expected)
    few = looks(windows=4)
    learned = REFERENCE.log_covariance * 1.1
    assert few._freedom(learned, 1) == pytest.approx(1.0 / (1.0 / 15.0 + 1.0 / (4 * 4 * 2)))
    assert looks(windows=900, degrees_of_freedom=1e9)._freedom(learned, 1) == pytest.approx(80.0, rel=1e-5)


def part(n: int, open_at: int | None = None) -> Record:
    marks = np.eye(1, n)[0]
    if open_at is not None:
        marks[open_at] = kernel.OPEN
    return Record(1e-3, np.full(n, 7.0), np.zeros((n, 2)), np.ones(2), marks)


def test_a_look_alarms_from_its_own_limit_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """Far from warm: its steps always give the same ratios, so that an alarm is confirmed."""
    covariance, k = np.eye(4) * 4e-4, 2
    found = looks()
    rate, scatter = found._rate(k), covariance * REFERENCE.excess[k - 1]
    freedom = found._freedom(scatter, k)
    asked: list[FloatArray] = []
    for size, verdict in ((0.998, "healthy"), (1.002, "bearing")):
        off = off_by("bearing", size, scatter, freedom, rate)

        def steps(
            parts: Sequence[Record], _: WindowReference, at: FloatArray, off: FloatArray = off
        ) -> Iterator[tuple[FloatArray, FloatArray]]:
            asked.append(at)
            yield from ((off, covariance) for _ in parts)

        monkeypatch.setattr(looking, "from_healthy", steps)
        ((said, _),) = found.verdicts([part(100)], [k])
        assert said == verdict
    assert (
        len(asked) == 2 + 2 * 4
    )  # two first steps; of the alarm three steps and one more, under two beliefs
    # The second step begins at the healthy motor that explains the first one best.
    healthy = REFERENCE.log_covariance
    np.testing.assert_allclose(asked[3], healthy @ np.linalg.solve(healthy + covariance, off), rtol=1e-9)
    np.testing.assert_allclose(asked[7], 0.25 / (0.25 + 4e-4) * off, rtol=1e-9)
    ((said, changes),) = found.verdicts([part(100, open_at=50)], [k])
    assert (said, changes) == ("healthy", ())
    assert is_closed(part(9)) is True


def test_a_look_ends_with_its_recording(monkeypatch: pytest.MonkeyPatch) -> None:
    lengths: list[list[int]] = []

    def verdicts(
        _: Looks, parts: Sequence[Record], due: Sequence[int]
    ) -> Iterator[tuple[str, tuple[Change, ...]]]:
        lengths.append([len(one.voltage_v) for one in parts])
        assert all(one.readings[-1, 0] == 299.0 for one in parts)
        yield from (("healthy" if k < 3 else "bearing", ()) for k in due)

    monkeypatch.setattr(Looks, "verdicts", verdicts)
    found = looks().at_end(recording(300), [1, 2, 3])
    assert lengths == [[250, 125, 62]]
    assert found is not None
    assert found.verdict == "bearing"
    assert found.begin_s == pytest.approx(0.299 - 0.062)
    assert looks().at_end(recording(300), [1, 2]) is None
    assert looks().at_end(recording(30), [1, 2, 3]) is None  # no record
    assert looks().at_end(recording(61), [3]) is None  # no part
    assert lengths[1:] == [[250, 125]]


def test_parts_are_steps_from_where_the_motor_is_thought_to_be(monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[Any] = []

    def steps(parts: Sequence[Record], known: FloatArray, terms: Sequence[str], peaks: Any) -> Any:
        given.append((known[[kernel.R, kernel.K, kernel.J, kernel.DRAG]], terms, peaks))
        return iter([(np.array([0.01, 0.0, 0.0, 0.0]), np.diag([9e-4, 1e-9, 1e-9, 1e-9]))])

    monkeypatch.setattr(windows, "first_steps", steps)
    at = np.array([0.1, 0.0, -0.2, 0.0])
    ((ratios, covariance),) = from_healthy([part(9)], REFERENCE, at)
    np.testing.assert_allclose(ratios, [0.11, 0.0, -0.2, 0.0])
    np.testing.assert_allclose(covariance, np.diag([9e-4, 1e-4, 9e-4, 16e-4]), atol=1e-12)
    np.testing.assert_allclose(given[0][0], REFERENCE.values * np.exp(at))
    assert given[0][1:] == (REFERENCE.terms, REFERENCE.peaks)
    assert first_steps is not steps


LOGS = np.random.default_rng(6).normal(0.0, 0.03, (6, 4))


class Lesson:
    """Instead of fits: windows with these logarithms, errors and noises."""

    def __init__(
        self, monkeypatch: pytest.MonkeyPatch, *, load_sd: float = 0.2, scatter: float = 1.0
    ) -> None:
        self.logs = scatter * LOGS
        self.wanted: list[tuple[str, ...]] = []
        self.joint: list[int] = []
        self.error = np.diag([1e-4, 1e-4, 1e-4, load_sd**2])
        self.values = np.array([2.0, 1e-3, 0.03, 4e-6, *np.zeros(20)])
        self.values[[kernel.HEATING, kernel.COOLING]] = 5.0, 0.1
        monkeypatch.setattr(lessons, "identify_operation", self.identify)
        monkeypatch.setattr(lessons, "fit_window", self.fit)
        monkeypatch.setattr(lessons, "from_healthy", self.steps)

    def identify(self, recordings: Sequence[Recording], *, most: int) -> Any:
        self.joint.append(sum(len(one.time_s) for one in recordings))
        assert most == max(10_000, self.joint[-1])
        record = SimpleNamespace(seen=np.ones(2), hold="late")
        solution = SimpleNamespace(values=self.values, names=("R", "K", "offset_speed"))
        return SimpleNamespace(record=record, solution=solution)

    def fit(self, record: Record, known: FloatArray, wanted: tuple[str, ...]) -> WindowFit:
        assert record.hold == "late"
        assert known[kernel.HEATING] == known[kernel.COOLING] == 0.0
        number = len(self.wanted)
        self.wanted.append(wanted)
        values = self.values.copy()
        values[kernel.NOISE_I] = [1.0, 2.0, 3.0, 4.0, 5.0, 9.0][number % 6]
        error = self.error.copy() if len(self.wanted) <= 6 else np.diag([1e-4, 1e-4, 1e-4, 1e-4])
        return WindowFit(self.logs[number % 6], error, values)

    def steps(self, parts: Sequence[Record], _: WindowReference, at: FloatArray) -> Iterator[Any]:
        n = len(parts)
        yield from ((at * (1.0 + 0.5 * n), np.diag([9e-4, 9e-4, 9e-4, 9e-4])) for _ in parts)


@pytest.mark.parametrize("steady", [False, True])
def test_windows_teach_the_next_one(steady: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    Lesson(monkeypatch)
    found = learn_windows([recording(3100)], 0.5, steady=steady)
    centre, error = LOGS.mean(axis=0), np.eye(4) * 1e-4
    prior = error + (0.0 if steady else 1e-4) * np.eye(4)
    scatter = (LOGS - centre).T @ (LOGS - centre)
    covariance = (scatter + 4.0 * prior) / 9.0 * 7.0 / 6.0
    np.testing.assert_allclose(found.values, np.exp(centre))
    np.testing.assert_allclose(found.log_covariance, covariance)
    assert (found.windows, found.window_s, found.degrees_of_freedom, found.dt_s) == pytest.approx(
        (6, 0.5, 9.0, 1e-3)
    )
    assert found.temperature_k == (0.0 if steady else 15.0)
    assert found.terms == (("R", "K") if steady else ("R", "K", "offset_speed"))
    assert found.rms_volts == pytest.approx((7.0, 7.0))
    assert found.peaks is not None
    volts = np.quantile(np.abs(recording(500).voltage_v), 0.999)  # type: ignore[arg-type]  # it has a voltage
    amps = np.quantile(np.arange(2500.0, 3000.0), 0.999)
    assert found.peaks == pytest.approx((volts, amps, 30.0 * amps))
    assert found.physical[kernel.NOISE_I] == 3.5  # the median of the windows
    believed = np.linalg.inv(spread_of(error, replace(found, window_excess=1.0)))
    squares = [
        sum(off @ inverse @ off for off in LOGS - centre) for inverse in (believed, np.linalg.inv(covariance))
    ]
    assert found.window_excess == pytest.approx(squares[0] / squares[1])
    assert (
        found.window_excess < 0.99
    ) is steady  # where there is no prior some errors are larger than the spread
    # Halves and so on: at is taken 1.5, 2.5, 4.5, ... times, with a spread of their own.
    whole = np.linalg.inv(np.diag([9e-4] * 4))
    one = np.mean([off @ whole @ off / 4.0 for off in LOGS - centre])
    lengths = int(math.log2(min(2.0**6, 500 / 8, 0.5 / 0.2)))
    expected = [max(one * (1.0 + 0.5 * 2**k) ** 2, 1.0) for k in range(1, lengths + 1)]
    assert found.excess == pytest.approx(expected)


def test_a_load_is_unknown_in_windows_that_tell_it_from_friction(monkeypatch: pytest.MonkeyPatch) -> None:
    for sd, is_told in ((0.099, True), (0.101, False)):
        lesson = Lesson(monkeypatch, load_sd=sd)
        found = learn_windows([recording(3000)], 0.5)
        assert ("load_walk" in found.terms) is is_told
        assert lesson.wanted[0] == ("R", "K", "offset_speed", "load_constant", "load_walk")


def test_a_lesson_needs_four_windows_and_chooses_some_of_many(monkeypatch: pytest.MonkeyPatch) -> None:
    lesson = Lesson(monkeypatch)
    with pytest.raises(UnusableError, match=r"3 windows of 0\.5 s; at least 4 are needed"):
        learn_windows([recording(1999)], 0.5)
    assert learn_windows([recording(1000), recording(1000)], 0.5).windows == 4
    first = learn_windows([recording(500), recording(1500, dt_s=1.004e-3)], 0.5)
    assert (first.windows, first.dt_s) == pytest.approx((4, 1e-3))
    lesson.joint.pop()
    learn_windows([recording(10_000)], 0.5)
    learn_windows([recording(10_500)], 0.5)
    learn_windows([recording(30_000)], 0.5)
    assert lesson.joint == [2000, 10_000, 5500, 10_000]  # all; all; every second window; every third


def test_parts_are_looked_at_down_to_eight_samples_and_a_fifth_of_a_second(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for window_s, dt_s, count in (
        (0.5, 1e-3, 1),
        (0.39, 1e-3, 0),
        (0.41, 1e-3, 1),
        (6.4, 0.1, 3),
        (6.2, 0.1, 2),
    ):
        Lesson(monkeypatch)
        found = learn_windows([recording(round(4.2 * window_s / dt_s), dt_s=dt_s)], window_s)
        assert len(found.excess) == count, window_s
    Lesson(monkeypatch, scatter=0.01)
    found = learn_windows([recording(4 * 2000, dt_s=0.1)], 200.0)
    assert found.excess == (1.0,) * 6  # parts that scatter less than is believed are believed as they are


CHANGES = tuple(Change(name, ratio, ratio - 0.1, ratio + 0.1, False) for name, ratio in
                zip(NAMES, (1.25, 0.98, 1.0, 1.333), strict=True))  # fmt: skip


def verdicts(*said: str) -> tuple[WindowVerdict, ...]:
    return tuple(WindowVerdict(0.5 * n, one, CHANGES) for n, one in enumerate(said))


@pytest.mark.parametrize(
    ("said", "verdict"),
    [
        (("healthy", "bearing", "magnet", "bearing", "unusable"), "bearing"),
        (("healthy", "unusable"), "healthy"),
        (("unusable", "unusable"), "unusable"),
        (("unusable", "other"), "other"),
    ],
)
def test_the_verdict_on_a_record_is_its_most_frequent_alarm(said: tuple[str, ...], verdict: str) -> None:
    assert RunningRecord(Path("a"), verdicts(*said), len(said)).verdict == verdict
    assert RunningRecord(Path("a"), verdicts(*said), trouble="torn").verdict == "unusable"


def test_text_and_json_of_a_record_say_the_same() -> None:
    record = RunningRecord(Path("a.csv"), verdicts("healthy", "bearing"), 7)
    assert record.as_text().splitlines() == [
        "a.csv: bearing",
        "  2 of 7 windows are judged: some evenly spread, and the oddest",
        "  from 0 s: healthy; R +25.0%, K -2.0%, J +0.0%, friction +33.3%",
        "  from 0.5 s: bearing; R +25.0%, K -2.0%, J +0.0%, friction +33.3%",
    ]
    told = record.as_json()
    assert (told["file"], told["verdict"], told["reason"], told["windows_of_record"]) == (
        "a.csv",
        "bearing",
        None,
        7,
    )
    assert [one["begin_s"] for one in told["windows"]] == [0.0, 0.5]
    expected = {"ratio": 1.333, "interval": [pytest.approx(1.233), pytest.approx(1.433)]}
    assert told["windows"][1]["changes"]["friction"] == expected
    whole = RunningRecord(Path("a.csv"), verdicts("healthy", "bearing"), 2)
    assert "are judged" not in whole.as_text()
    assert RunningRecord(Path("a.csv"), (), trouble="torn").as_text() == "a.csv: unusable (torn)"


@pytest.mark.parametrize(
    ("records", "status"),
    [
        ([{}], 0),
        ([{"windows": verdicts("magnet")}, {"trouble": "torn"}], 1),
        ([{"windows": verdicts("magnet")}, {"trouble": "no file", "unreadable": True}], 2),
        ([{"trouble": "torn"}, {}], 3),
        ([{"is_bug": True, "unreadable": True}], 70),
    ],
)
def test_exit_status_of_records(records: list[dict[str, Any]], status: int) -> None:
    given = [RunningRecord(Path("a"), **({"windows": verdicts("healthy")} | one)) for one in records]
    assert exit_status(given) == status


def test_words_of_a_commissioning_by_windows() -> None:
    """The interval of the next healthy window at the rate, on both sides together."""
    text = commissioned_text(replace(REFERENCE, temperature_k=15.0), 0.05)
    half = stats.t.isf(0.025, 15.0)
    lines = text.splitlines()
    assert lines[0] == "12 healthy windows of 0.5 s; the next one lies within (95%)"
    for line, name, value, sd in zip(
        lines[1:],
        ("R", "K", "J", "friction"),
        ("2", "0.03", "4e-06", ""),
        (0.02, 0.01, 0.03, 0.04),
        strict=False,
    ):
        interval = f"{math.expm1(-half * sd):+.1%} to {math.expm1(half * sd):+.1%}"
        assert line.split() == [name, *value.split(), *interval.split()]
    assert lines[5] == "  and another temperature, by 15 K (1 sd), is healthy too"
    assert len(commissioned_text(REFERENCE, 0.05).splitlines()) == 5


def test_the_command_counts_all_windows_of_a_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    given: list[float] = []

    def judge(_: Recording, __: WindowReference, rate: float) -> list[WindowVerdict]:
        given.append(rate)
        return list(verdicts("healthy", "bearing"))

    monkeypatch.setattr(logs, "judge_windows", judge)
    monkeypatch.setattr(
        "motor_env.motor.data_sheet.load_motor", lambda _: SimpleNamespace(operation=REFERENCE)
    )
    one = recording(2750)
    rows = np.stack([one.time_s, cast("FloatArray", one.voltage_v), one.current_a + 0.5], axis=1)
    log = tmp_path / "log.csv"
    np.savetxt(log, rows, delimiter=",", header="time_s,voltage_v,current_a", comments="", fmt="%.6f")
    assert main(["diagnose", str(log), "--motor", "m.toml", "--json", "--false-alarm-rate", "0.2"]) == 1
    (told,) = json.loads(capsys.readouterr().out)
    assert (told["verdict"], told["windows_of_record"], given) == ("bearing", 5, [0.2])
    assert main(["diagnose", str(log), "--motor", "m.toml", "--start", "1"]) == 2
    assert "--start belongs to starts" in capsys.readouterr().err


@pytest.mark.parametrize("window_s", [0.0, math.inf, -1.0])
def test_a_window_has_a_length(window_s: float) -> None:
    with pytest.raises(InputError, match="window must be > 0"):
        logs.commission_running([], window_s, "m")
