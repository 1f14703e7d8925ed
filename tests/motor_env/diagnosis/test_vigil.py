"""The two procedures of a watch: an e-detector over calibrated scores, and counting."""

import itertools
import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from motor_env import InputError, Recording
from motor_env.diagnosis.hypotheses import NAMES, FittedWindow
from motor_env.diagnosis.running.counting import Counting, fewest_in_a_row, windows_between_alarms
from motor_env.diagnosis.running.detector import Detector
from motor_env.diagnosis.running.drives import driven
from motor_env.diagnosis.running.learned import Learned
from motor_env.diagnosis.running.pieces import N_STATES, Motion, Pieces
from motor_env.diagnosis.running.replay import THRESHOLDS, replay, tails_hold
from motor_env.diagnosis.running.scales import (
    AXES,
    calibrated,
    directions,
    learn_scale,
    normal_scores,
    places_on_axes,
    reaches,
)
from motor_env.diagnosis.running.vigil import YEAR_S, Vigil
from motor_env.diagnosis.running.windows import judge_of
from motor_env.diagnosis.verdict import Judgement, Verdict
from motor_env.fitting import places
from motor_env.motor.faults import FaultKind
from motor_env.motor.healthy import Drive, Healthy, Scale, Windows
from motor_env.motor.parameters import FloatArray

WINDOW_S, ERROR = 600.0, np.diag([0.002, 0.002, 0.005, 0.01]) ** 2
HOUR = YEAR_S / 3600.0
Random = np.random.Generator


def run_lengths(rng: Random, pieces: float, runs: int, sd: float = 1.0) -> FloatArray:
    """Pieces until an alarm, of normal scores in five directions at two lengths."""
    found = []
    root = np.linalg.cholesky(0.5 * np.eye(5) + 0.5)
    for _ in range(runs):
        detector, count, pair = Detector(2, np.array([4.0, 4.0, 1.0, 1.0, 1.0])), 0, np.zeros(5)
        while not detector.passes(pieces):
            count += 1
            scores = sd * root @ rng.standard_normal(5)
            detector.add(0, scores, 1)
            pair = pair + scores
            if count % 2 == 0:
                detector.add(1, pair / math.sqrt(2.0), 2)
                pair = np.zeros(5)
        found.append(count)
    return np.array(found, dtype=np.float64)


def test_false_alarms_of_the_detector_are_as_far_apart_as_was_asked() -> None:
    """The mean is no less, by three standard errors; and not more than three times as much."""
    rng = np.random.default_rng(1)
    for pieces in (40.0, 160.0):
        lengths = run_lengths(rng, pieces, 150)
        error = lengths.std() / math.sqrt(len(lengths))
        assert pieces - 3.0 * error < lengths.mean() < 3.0 * pieces
    assert run_lengths(rng, 160.0, 60, sd=1.3).mean() < 0.6 * 160.0  # scores that are no normal ones


def test_the_detector_finds_a_fault_its_direction_and_its_begin() -> None:
    """At a shift of two standard deviations, at one false alarm in a million: about ten pieces."""
    rng, found = np.random.default_rng(2), []
    for _ in range(40):
        detector = Detector(1, np.ones(4))
        for _ in range(50):
            detector.add(0, rng.standard_normal(4), 1)
        count = 0
        while not detector.passes(1e6):
            count += 1
            detector.add(0, rng.standard_normal(4) + np.array([0.0, 2.0, 0.0, 0.0]), 1)
        found.append((count, detector.strongest[1], detector.strongest[2] - count, detector.shares[1]))
    counts, which, late, shares = np.array(found).T
    assert 8.0 <= np.median(counts) <= 14.0
    assert (which == 1).mean() > 0.95
    assert abs(np.median(late)) <= 2.0
    assert np.median(shares) > 0.9
    detector.forget()
    assert detector.evidence == 0.0


def test_a_sum_is_that_of_shiryaev_and_roberts() -> None:
    """By hand: the sum over begins of the products of e-values since."""
    detector, scores = Detector(1, np.ones(1)), [0.3, -1.0, 2.0]
    for score in scores:
        detector.add(0, np.array([score]), 1)
    lean = np.array([0.6, 1.2, 2.4])
    e_values = [np.exp(lean * score - 0.5 * lean**2) for score in scores]
    products = [np.prod(e_values[k:], axis=0) for k in range(3)]
    np.testing.assert_allclose(detector.sums[0, 0], sum(products))
    assert detector.evidence == pytest.approx(float(np.mean(sum(products))))
    best = int(np.argmax(sum(products)))
    age = sum(product[best] * (3 - k) for k, product in enumerate(products)) / sum(products)[best]
    assert detector.strongest[2] == pytest.approx(age)


def test_evidence_that_is_not_asked_for_stays_finite() -> None:
    """Its direction and age are as they were."""
    detector = Detector(1, np.ones(2))
    for _ in range(300):
        detector.add(0, np.array([10.0, 0.0]), 1)
    assert 1e99 < detector.evidence < 1e101
    length, direction, age = detector.strongest
    assert (length, direction) == (0, 0)
    assert age == pytest.approx(300.0, rel=0.01)


def test_sizes_go_with_what_a_piece_tells() -> None:
    """A piece of half the reach looks for half the shift: by hand, for one piece."""
    detector = Detector(1, np.ones(2))
    detector.add(0, np.array([1.0, 1.0]), 1, np.array([0.5, 1.0]))
    lean = np.array([0.6, 1.2, 2.4])
    np.testing.assert_allclose(detector.sums[0, 0], np.exp(0.5 * lean - 0.125 * lean**2))
    np.testing.assert_allclose(detector.sums[0, 1], np.exp(lean - 0.5 * lean**2))
    of, rng = taught(np.random.default_rng(12))[0], np.random.default_rng(13)
    blurred = window(rng, 1, np.zeros(4))._replace(errors=16.0 * ERROR[None])
    for one, expected in ((window(rng, 1, np.zeros(4)), 1.0), (blurred, 0.25)):
        found = calibrated(of, one, directions().along)
        np.testing.assert_allclose(reaches(of, found, directions().along), expected, rtol=0.05)


def test_counting_alarms_as_rarely_as_combinatorics_says() -> None:
    """Of all orders of three healthy windows and those since: exact."""
    for later in (1, 2, 3):
        orders = list(itertools.permutations(range(3 + later)))
        alarms = 0
        for order in orders:
            counting = Counting(3, np.full(1, float(max(order[:3]))), np.zeros(1))
            for value in order[3:]:
                counting.add(np.array([float(value)]))
            alarms += counting.rows[0] >= later
        assert alarms * math.comb(3 + later, later) == len(orders)
    assert windows_between_alarms(3, 2, 1) == 10
    assert windows_between_alarms(10, 3, 8) == 286 / 8


@pytest.mark.parametrize(
    ("healthy", "windows", "tests", "needed"),
    [
        (10, 180, 1, 3),
        (10, YEAR_S / 20.0, 1, 14),
        (30, YEAR_S / 20.0, 1, 6),
        (100, YEAR_S / 20.0, 1, 4),
        (10, 180, 8, 5),
        (4, YEAR_S / 20.0, 8, 130),
        (10, 66, 1, 2),
        (10, 67, 1, 3),
    ],
)
def test_windows_in_a_row_that_a_rate_needs(healthy: int, windows: float, tests: int, needed: int) -> None:
    assert fewest_in_a_row(healthy, windows, tests) == needed
    counting = Counting(healthy, np.zeros(tests), np.zeros(tests))
    for row in range(1, needed + 1):
        assert not counting.alarms(windows)
        counting.add(np.eye(tests)[0])
        assert counting.rows[0] == row
    assert counting.alarms(windows)
    counting.add(np.zeros(tests))
    assert not counting.alarms(windows)
    counting.learn(np.full(tests, 2.0))
    assert (counting.healthy, counting.most[0]) == (healthy + 1, 2.0)


def test_states_of_a_motor() -> None:
    """Standing, creeping, slow, fast; backwards, to and fro, forwards."""
    mean = np.array([0.0, -5.0, 5.0, 0.0, 30.0, 0.0, -80.0, 80.0])
    effective = np.array([1.9, 5.0, 5.0, 14.0, 30.0, 49.0, 80.0, 80.0])
    n = np.full(8, 10.0)
    states = Motion(n, n * mean, n * effective**2).states(100.0)
    assert states.tolist() == [0, 1, 3, 2, 6, 5, 7, 9]
    assert max(states) < N_STATES


def window(rng: Random, count: int, level: FloatArray, scale: float = 1.0) -> Pieces:
    """Pieces that scatter more than their errors say, by a factor on the standard deviation."""
    logs = level + scale * rng.multivariate_normal(np.zeros(4), ERROR, count)
    return Pieces(logs, np.tile(ERROR, (count, 1, 1)), np.zeros(count, dtype=np.intp))


def taught(rng: Random, count: int = 30, scale: float = 1.0) -> tuple[Scale, Scale]:
    """Pieces of a steady motor, 16 a window; and windows."""
    none = np.zeros(4)
    short = [window(rng, 16, none, scale) for _ in range(count)]
    whole = [window(rng, 1, none, scale) for _ in range(count)]
    return (
        learn_scale(4, short, np.zeros(4), temperature_k=0.0),
        learn_scale(0, whole, np.zeros(4), temperature_k=0.0),
    )


def scored(scale: Scale, pieces: Pieces, windows: float = 1e3) -> FloatArray:
    """Normal scores, at one false alarm in so many windows."""
    return normal_scores(scale, pieces.states, calibrated(scale, pieces, directions().along), windows)


@pytest.mark.parametrize("scale", [1.0, 5.0])
def test_scores_of_healthy_pieces_are_normal_or_less_whatever_the_fit_believes(scale: float) -> None:
    """As e-values their mean is 1 at most, over commissionings; along a fault they are as large as it."""
    none, e_values, ups = np.zeros(4), [], []
    up = int(np.flatnonzero((directions().along == [1.0, 0.0, 0.0, 0.0]).all(axis=1))[0])
    for seed in range(12):
        rng = np.random.default_rng([3, seed])
        each = taught(rng, scale=scale)
        scores = np.array([scored(of, window(rng, 400, none, scale)) for of in each])
        e_values.append([np.exp(lean * scores - 0.5 * lean**2).mean(axis=1) for lean in (0.7, 1.5)])
        off = window(rng, 100, scale * np.sqrt(np.diag(ERROR)) * [3.0, 0.0, 0.0, 0.0], scale)
        ups.append([scored(of, off)[:, up].mean() for of in each])
    assert (np.mean(e_values, axis=0) > 0.4).all()
    assert (np.mean(e_values, axis=0) < 1.1).all()
    assert (np.mean(ups, axis=0) > [2.5, 1.8]).all()


def test_each_state_has_its_own_friction_and_scatter() -> None:
    rng, errors = np.random.default_rng(4), np.tile(ERROR, (20, 1, 1))
    states = np.repeat([0, 4], 10)
    centres, sizes = np.where(states == 4, -0.4, 0.0), np.where(states == 4, 6.0, 1.0)

    def piece() -> Pieces:
        logs = sizes[:, None] * rng.multivariate_normal(np.zeros(4), ERROR, 20)
        logs[:, 3] += centres
        return Pieces(logs, errors, states)

    scale = learn_scale(5, [piece() for _ in range(20)], np.zeros(4), temperature_k=0.0)
    assert scale.centres[[0, 4], 3] == pytest.approx([0.0, -0.4], abs=0.02)
    assert np.diag(scale.covariances[4]) == pytest.approx([36.0] * 4, rel=0.3)
    assert (np.diag(scale.covariances[0]) < 1.6).all()
    assert scale.counts[[0, 1, 4]].tolist() == [200.0, 0.0, 200.0]


def test_no_piece_says_more_than_the_rarest_where_tails_are_heavy() -> None:
    rng = np.random.default_rng(5)
    heavy = [window(rng, 16, np.zeros(4)) for _ in range(30)]
    heavy = [each._replace(logs=each.logs * rng.standard_t(3.0, (16, 1))) for each in heavy]
    of = learn_scale(4, heavy, np.zeros(4), temperature_k=0.0)
    assert of.freedom < 20.0
    far = Pieces(np.full((1, 4), 1.0), ERROR[None], np.zeros(1, dtype=np.intp))
    assert scored(of, far).max() == pytest.approx(stats.norm.isf(1.0 / 481.0))
    assert scored(taught(rng)[0], far).max() > 8.0


def test_a_healthy_motor_may_stay_off_by_what_is_believed() -> None:
    """Two per cent of R and 15 K are allowed where 1 % is; 15 % more of R are not."""
    rng = np.random.default_rng(6)
    windows = [window(rng, 1, np.zeros(4)) for _ in range(12)]
    of = learn_scale(0, windows, np.full(4, 0.01), temperature_k=15.0)
    warm = 15.0 * np.array([0.00393, -0.001, 0.0, -0.003])
    for off, least, most in (
        (np.array([0.02, 0.0, 0.0, 0.0]), -9.0, 0.0),
        (warm, -9.0, 0.0),
        (warm + np.array([0.15, 0.0, 0.0, 0.0]), 1.0, 9.0),
    ):
        scores = scored(of, window(rng, 400, off)).mean(axis=0)
        assert least < scores.max() < most


def test_drifts_are_never_learned_but_noise_is() -> None:
    """Levels that drift by 25 % leave the scatter as it is; a scatter that doubles is learned."""
    rng = np.random.default_rng(7)
    scales = taught(rng)
    for size, expected in ((1.0, 1.0), (2.0, 4.0)):
        learned = Learned(scales)
        for k in range(200):
            level = np.array([0.25 * k / 200.0, 0.0, 0.0, 0.0])
            learned.hear([window(rng, 16, level, size), window(rng, 1, level, size)])
        for n, weight in ((0, 0.9), (1, 0.8)):
            taught_, now = (one.covariances[0, 0, 0] for one in (scales[n], learned.scale(n)))
            assert now == pytest.approx(weight * expected + (1.0 - weight) * taught_, rel=0.2)
    learned = Learned(scales)
    for off in (0.0, 0.3, 0.6):
        learned.hear([None, window(rng, 1, np.full(4, off))])
        learned.skip()  # no difference to the window before an alarm is learned
    assert learned.scale(1) is scales[1]
    assert learned.scale(0) is scales[0]


@pytest.mark.parametrize("is_cut", [False, True])
def test_a_window_is_not_compared_with_the_one_before_a_break(is_cut: bool) -> None:
    """What a motor does while nobody watches is no scatter from one window to the next."""
    rng, watch = np.random.default_rng(14), vigil(commissioned(steady=True))
    watch.ended(fit(rng, np.zeros(4)))
    if is_cut:
        watch.cut()
    watch.ended(fit(rng, np.zeros(4)))
    assert sum(watch.memory["learned"]) == (0.0 if is_cut else 1.0)


def test_counting_allows_what_a_healthy_motor_may_stay_off() -> None:
    """An inertia that stays 1.5 % off alarms by counting only where nothing but a fault moves the motor."""
    for steady in (False, True):
        rng, watch = np.random.default_rng(15), vigil(counting_only(commissioned(steady=steady)))
        told = [watch.ended(fit(rng, np.array([0.0, 0.0, 0.015, 0.0]))) for _ in range(12)]
        assert any(told) is steady


@cache
def commissioned(*, steady: bool, scatter: float = 1.0, seed: int = 8) -> Healthy:
    """Twelve windows of ten minutes, without shorter pieces."""
    rng = np.random.default_rng(seed)
    kelvin, prior = (0.0, np.zeros(4)) if steady else (15.0, np.full(4, 0.01))
    whole = [window(rng, 1, np.zeros(4), scatter) for _ in range(12)]

    def scale(some: list[Pieces]) -> Scale:
        return learn_scale(0, some, prior, temperature_k=kelvin)

    each = [(scale(whole[:n] + whole[n + 1 :]),) for n in range(12)]
    most = np.max([places_on_axes(scale(whole), one).distances[0] for one in whole], axis=0)
    windows = Windows(
        WINDOW_S, (), np.zeros(places.N_VALUES), "held", 1.0, 100.0,
        scales=(scale(whole),),
        most=tuple(most.tolist()),
        replayed=tuple(replay(each, [[one] for one in whole])),
    )  # fmt: skip
    return Healthy(12, 15.0, NAMES, np.ones(4), scatter**2 * ERROR, temperature_k=kelvin, windows=windows)


def vigil(healthy: Healthy, per_year: float = HOUR, memory: dict[str, list[float]] | None = None) -> Vigil:
    return Vigil(judge_of(healthy), healthy, false_alarms_per_year=per_year, memory=memory)


def counting_only(healthy: Healthy) -> Healthy:
    """The same, whose windows did not follow the tails."""
    assert healthy.windows is not None
    return replace(healthy, windows=replace(healthy.windows, replayed=(12, *[9] * 11)))


def fit(rng: Random, level: FloatArray, scatter: float = 1.0) -> FittedWindow:
    return FittedWindow(level + scatter * rng.multivariate_normal(np.zeros(4), ERROR), ERROR)


@pytest.mark.parametrize("counts", [False, True])
@pytest.mark.parametrize("steady", [False, True])
@pytest.mark.parametrize("direction", [[1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
def test_a_drift_of_one_per_cent_an_hour_is_told(direction: list[float], steady: bool, counts: bool) -> None:
    """In R, K or friction, up to 25 %, and by either procedure; before that 12 hours pass without a fault."""
    rng, healthy = np.random.default_rng(9), commissioned(steady=steady)
    watch = vigil(counting_only(healthy) if counts else healthy, HOUR / 24.0)
    assert watch.adds_up is not counts
    for _ in range(72):
        watch.ended(fit(rng, np.zeros(4)))
    assert not watch.goes_on
    told = [watch.ended(fit(rng, math.log1p(0.01 * k / 6.0) * np.array(direction))) for k in range(150)]
    assert any(told)
    assert all(told[-6:])  # and it goes on being told
    assert counts or watch.goes_on


@pytest.mark.parametrize(("sd", "is_learned"), [(0.0, True), (3.9, True), (4.1, False)])
def test_nothing_is_learned_from_a_window_that_may_be_of_a_faulty_motor(sd: float, is_learned: bool) -> None:
    """A fault that is no alarm yet would widen what windows scatter, and hide itself."""
    watch = vigil(commissioned(steady=True), HOUR / 1e6)
    watch._scored = lambda *_: (np.full((1, 9), sd), np.ones((1, 9)))  # type: ignore[method-assign]
    watch.ended(FittedWindow(np.zeros(4), ERROR))
    assert not watch.goes_on
    assert (watch._learned.memory["before"].any()) == is_learned


def test_an_alarm_goes_on_while_a_window_is_off_in_any_direction() -> None:
    """The pieces before it may have been too short to tell the direction."""
    watch = vigil(commissioned(steady=True))
    for highest, goes_on in ((2.1, True), (1.9, False)):
        scores = np.append(np.full(8, -3.0), highest)[None]
        watch._scored = lambda *_, row=scores: (row, np.full((1, 9), 1e-9))  # type: ignore[method-assign]
        watch._toward = 0
        assert watch.ended(FittedWindow(np.zeros(4), ERROR)) is goes_on
        assert watch.goes_on is goes_on


def test_false_alarms_of_windows_are_no_more_than_was_asked() -> None:
    """Commissionings with windows that scatter three times as much as their errors say; one alarm in 10 windows."""
    alarms, runs, windows = {False: 0, True: 0}, 8, 100
    for seed in range(runs):
        rng = np.random.default_rng([10, seed])
        healthy = commissioned(steady=True, scatter=3.0, seed=100 + seed)
        for counts in (False, True):
            watch = vigil(counting_only(healthy) if counts else healthy, HOUR * 0.6)
            told = [watch.ended(fit(rng, np.zeros(4), 3.0)) for _ in range(windows)]
            alarms[counts] += sum(now and not before for before, now in itertools.pairwise([False, *told]))
    assert 0 < max(alarms.values()) <= stats.poisson.ppf(0.99, runs * windows / 10.0)


def test_a_watch_says_what_it_can_promise() -> None:
    healthy = commissioned(steady=False)
    said = vigil(healthy, 1.0).promise
    assert said.startswith(
        "12 healthy windows of 600 s: one false alarm in 1 year if the fitted tails hold, as they do"
    )
    needed = fewest_in_a_row(12, YEAR_S / 600.0, len(AXES))
    assert f"by counting alone: {needed} windows in a row" in said
    said = vigil(counting_only(healthy)).promise
    assert (
        "12 healthy windows of 600 s do not follow the fitted tails, so that alarms are by counting alone"
        in said
    )
    assert "2 windows in a row beyond all healthy ones, at most one false alarm in 1.9 hours" in said
    assert "at most one false alarm in 1.9 hours" in said
    assert "one false alarm in 20 minutes if the fitted" in vigil(healthy, 3.0 * HOUR).promise
    assert "in 2 days if the fitted" in vigil(healthy, HOUR / 48.0).promise
    assert healthy.windows is not None
    untaught = replace(healthy, windows=replace(healthy.windows, scales=(), most=(), replayed=()))
    assert "commission the motor anew" in vigil(untaught).promise


def test_tails_hold_where_replayed_windows_alarm_as_they_should() -> None:
    due = [round(1000.0 / threshold) for threshold in THRESHOLDS.tolist()]
    assert tails_hold(due, 1000)
    assert not tails_hold([*due[:5], 6, *due[6:]], 1000)  # 0.24 due
    assert not tails_hold([*due[:-1], 1], 1000)  # 6e-5 due
    assert not tails_hold((), 1000)


def test_a_watch_goes_on_from_its_memory_as_if_it_had_never_ended() -> None:
    rng, healthy = np.random.default_rng(11), commissioned(steady=True)
    fits = [fit(rng, np.array([0.004 * (k > 60), 0.0, 0.0, 0.0])) for k in range(90)]
    whole = vigil(healthy)
    told = [whole.ended(one) for one in fits]
    part, again = vigil(healthy), []
    for k, one in enumerate(fits):
        if k % 7 == 0:
            part = vigil(healthy, HOUR, part.memory)
        again.append(part.ended(one))
    assert any(told)
    assert again == told
    assert part.memory["sums"] == pytest.approx(whole.memory["sums"])
    memory = part.memory
    for broken in (
        {**memory, "sums": memory["sums"][1:]},
        {**memory, "strange": [1.0]},
        {**memory, "counted": [-1.0, 0.0, 0.0]},
        {**memory, "scatter": [-1e9] * len(memory["scatter"])},
    ):
        with pytest.raises(InputError, match="the memory of the state"):
            vigil(healthy, HOUR, broken)


def driven_by(size: float, count: int = 600) -> Recording:
    values = size * np.resize([1.0, -1.0], count)
    return Recording(Path("it"), np.arange(count, dtype=np.float64), values, values, values)


def with_drives(logs: dict[float, FloatArray]) -> Healthy:
    """Driven by each of these and its negative, with these logarithms of R, K, J and B."""
    healthy = commissioned(steady=True)
    assert healthy.windows is not None
    drives = tuple(
        Drive((n,), driven(driven_by(size))[None], np.exp(at), healthy.log_covariance, 15.0)
        for n, (size, at) in enumerate(logs.items())
    )
    return replace(healthy, windows=replace(healthy.windows, drives=drives, alike=0.12))


@cache
def knows_its_drive() -> Healthy:
    """Driven by 1 and -1 in all windows."""
    return with_drives({1.0: np.zeros(4)})


def test_a_window_under_another_drive_is_no_evidence_and_teaches_nothing() -> None:
    one, other = vigil(knows_its_drive()), vigil(knows_its_drive())
    for watch in (one, other):
        watch.begin()
        watch.ended(fit(np.random.default_rng(5), np.zeros(4)))
        watch.begin()
    assert not one.sets_aside(driven_by(1.1))
    one._detector.add(0, np.full(len(one._along.weights), 4.0), 1)
    one._toward, one._quiet = 1, 3.0
    assert one.sets_aside(driven_by(2.0))
    assert not one.goes_on
    np.testing.assert_array_equal(one._detector.sums, other._detector.sums)
    # What is behind it is not compared with what was before.
    other.cut()
    for watch in (one, other):
        watch.begin()
        watch.ended(fit(np.random.default_rng(6), np.zeros(4)))
    assert one.memory == other.memory


@pytest.mark.parametrize(("size", "is_told"), [(1.1, True), (2.0, False)])
def test_an_alarm_under_another_drive_waits_for_the_window(
    monkeypatch: pytest.MonkeyPatch, size: float, is_told: bool
) -> None:
    watch = vigil(knows_its_drive())
    told = Judgement(Verdict.WINDING, ("because",))
    monkeypatch.setattr(Vigil, "_fitted", lambda *_: told)
    monkeypatch.setattr("motor_env.diagnosis.running.windows.WindowJudge.failed_sensor", lambda *_: None)
    watch._toward = 0
    watch._detector.sums[0, 0] = 1e9
    assert (watch.alarm(driven_by(size), 0.01) is not None) is is_told
    assert watch.goes_on is is_told
    assert (watch._detector.evidence == 0.0) is is_told  # what is not told now may be at the window's end
    monkeypatch.setattr("motor_env.diagnosis.running.windows.WindowJudge.failed_sensor", lambda *_: told)
    assert watch.alarm(driven_by(size), 0.01) is not None  # whatever the drive


@pytest.mark.parametrize("known", [1.0, 2.0])
def test_an_alarm_waits_where_the_drive_has_become_another_known_one(
    monkeypatch: pytest.MonkeyPatch, known: float
) -> None:
    """What was heard of the window was compared with healthy windows of the drive before."""
    monkeypatch.setattr(Vigil, "_fitted", lambda *_: Judgement(Verdict.WINDING, ("because",)))
    monkeypatch.setattr("motor_env.diagnosis.running.windows.WindowJudge.failed_sensor", lambda *_: None)
    watch = vigil(with_drives({1.0: np.zeros(4), 2.0: np.full(4, 0.1)}))
    monkeypatch.setattr(Vigil, "heard", lambda *_: False)
    assert not watch.sets_aside(driven_by(known))
    for size in (1.0, 2.0):
        watch._detector.sums[0, 0] = 1e9
        assert (watch.alarm(driven_by(size), 0.01) is not None) is (size == known)


def test_behind_a_window_under_another_drive_alarms_wait_until_one_is_driven_as_usual(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    watch = vigil(knows_its_drive())
    monkeypatch.setattr(Vigil, "_fitted", lambda *_: Judgement(Verdict.WINDING, ("because",)))
    monkeypatch.setattr("motor_env.diagnosis.running.windows.WindowJudge.failed_sensor", lambda *_: None)
    for size, is_aside in ((2.0, True), (1.0, False)):
        watch.begin()
        assert watch.sets_aside(driven_by(size)) is is_aside
        watch.begin()
        watch._detector.sums[0, 0] = 1e9
        assert (watch.alarm(driven_by(1.0), 0.01) is None) is is_aside


def test_an_alarm_is_named_by_its_evidence_where_its_samples_fit_no_fault(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    told, watch = Judgement(Verdict.OTHER, ("because",)), vigil(commissioned(steady=True))
    fitted: list[float] = []

    def _fitted(_: Vigil, __: object, span_s: float, ___: float) -> Judgement:
        fitted.append(span_s)
        return told

    monkeypatch.setattr(Vigil, "_fitted", _fitted)
    recording = SimpleNamespace(dt_s=1.0, time_s=np.arange(100.0))
    monkeypatch.setattr("motor_env.diagnosis.running.vigil.averaged", lambda *_: recording)
    monkeypatch.setattr("motor_env.diagnosis.running.windows.WindowJudge.failed_sensor", lambda *_: None)
    kinds = directions().kinds
    for kind, verdict in ((FaultKind.WINDING_CONTACT, "winding"), (None, "other")):
        watch._toward = kinds.index(kind)
        watch._detector.sums[0, watch._toward] = 1e9
        found = watch.alarm(recording, 0.01)  # type: ignore[arg-type]  # it is only handed on
        assert found is not None
        assert (found.verdict, found.fault_kind) == (verdict, kind)
        assert (found.duration_s, found.begin_s) == (WINDOW_S, 99.0 - WINDOW_S)
        assert watch._detector.evidence == 0.0
    # The fault begins in the first piece: it is fitted only where there is no other.
    watch._pieces, watch.piece_s = 8, WINDOW_S / 8.0
    fitted.clear()
    for age, span, kept in ((0.5, 1, 1), (2.2, 3, 2), (20.0, 8, 7)):
        watch._detector.sums[0, 0], watch._detector.ages[0, 0] = 1e9, 1e9 * age
        found = watch.alarm(recording, 0.01)  # type: ignore[arg-type]  # as above
        assert found is not None
        assert (found.duration_s, fitted.pop()) == (span * watch.piece_s, kept * watch.piece_s)
