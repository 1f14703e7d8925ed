"""What a wrong model adds to the errors of a fit: scores of parts of a record, and what no term says."""

import math
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
from recorded_motor import LOGS, Line, least_squares, plain, solution, values, worked
from scipy.linalg import sqrtm

from motor_env.diagnosis.estimation import model_selection as fitting, parameter_index as index, uncertainty
from motor_env.diagnosis.estimation.model_selection import fit
from motor_env.diagnosis.estimation.problem import Solution, motor_unknowns
from motor_env.diagnosis.estimation.record import Record
from motor_env.diagnosis.estimation.uncertainty import (
    covariance,
    excess_covariance,
    model_error,
    normalised,
    sandwich,
    unmodelled_effects,
)

# Reaches in: of a residual, white noise alone averages away.
from motor_env.diagnosis.readers.noise import difference_noise
from motor_env.motor.parameters import FloatArray


def line(seed: int = 0, n: int = 400) -> Line:
    """Straight lines; the first twentieth tells most of the first unknown."""
    rng = np.random.default_rng(seed)
    design = rng.standard_normal((n, 2)) * [0.05, 1.0]
    design[: n // 20, 0] = 1.0
    return Line(design, rng.standard_normal(n), ("R", "K"))


def told(of: Line) -> tuple[FloatArray, FloatArray]:
    return normalised(cast("Any", of), least_squares(of), of.design, range(of.design.shape[1]))


def both(of: Line) -> tuple[FloatArray, FloatArray]:
    """Covariance of a stationary series, and what the model's error adds."""
    series, _ = sandwich(*told(of))
    return series, model_error(*told(of), series, states=np.empty((len(of.design), 0)))


def test_scores_of_parts_are_scaled_as_bell_and_mccaffrey_have_it() -> None:
    of = line()
    of.target[:10] += 6.0
    series, found = both(of)
    design, left = of.design, of.residuals(least_squares(of))
    size = np.sqrt(left @ left / len(left))
    design, left = design / size, left / size
    weak = np.eye(2) / 9.0  # logarithms are known to 3 beforehand
    bread = np.linalg.inv(design.T @ design + weak)
    hat = design @ bread @ design.T
    told = np.cumsum(np.diag(hat))
    part = np.minimum((20.0 * told / told[-1]).astype(int), 19)
    expected = np.zeros((2, 2))
    for number in range(20):
        some = part == number
        scale = np.linalg.inv(np.real(sqrtm(np.eye(some.sum()) - hat[np.ix_(some, some)])))
        moved = bread @ design[some].T @ scale @ left[some]
        expected += np.outer(moved, moved)
    np.testing.assert_allclose(found, excess_covariance(series, expected), rtol=1e-3, atol=1e-9)
    assert found[0, 0] > 1.5 * series[0, 0]  # what no stationary series shows


def test_a_right_model_adds_little() -> None:
    """Scores of twenty parts scatter by chance; what they add is an excess only."""
    shares = [np.diag(added) / np.diag(series) for series, added in map(both, map(line, range(40)))]
    assert np.mean(shares, axis=0).max() < 0.5
    assert np.median(shares, axis=0).max() < 0.25


def test_an_error_that_follows_a_state_shows_under_a_periodic_command() -> None:
    """Every period errs alike: parts in time agree, and those of small to large current do not."""
    phase = 2.0 * np.pi * np.arange(1600) / 32.0
    current = np.cos(phase)
    design, noise = np.stack([current, np.sin(phase)], axis=1), np.random.default_rng(4).standard_normal(1600)
    for bent, seen in ((0.0, False), (2.0, True)):
        of = Line(design, noise + bent * np.cos(3.0 * phase), ("R", "K"))
        series, in_time = both(of)
        by_state = model_error(*told(of), series, states=current[:, None])
        assert np.trace(in_time) < np.trace(series)
        assert (np.trace(by_state) > 5.0 * np.trace(series)) == seen
        assert np.linalg.eigvalsh(by_state - in_time).min() > -1e-12


def test_states_that_have_no_part_in_it_add_next_to_nothing() -> None:
    """Six unknowns, cut by four states: chance alone would add a third and more."""
    added = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        of = Line(rng.standard_normal((400, 6)), rng.standard_normal(400), tuple("RLKJBT"))
        series, in_time = both(of)
        by_state = model_error(*told(of), series, states=rng.standard_normal((400, 4)))
        added.append(np.trace(by_state - in_time) / np.trace(series))
    assert np.mean(added) < 0.1


def lossy(gear: float = 0.0, brushes: float = 0.0, noise: float = 1.0, knee: float = 0.1) -> Record:
    """A record of the motor whose gear takes a share of its torque, and whose brushes resist small currents more."""
    p, record = values(), worked(values(), noise=0.0)
    shown = record.readings
    rng = np.random.default_rng(3)
    for _ in range(30):
        amps, current = np.quantile(np.abs(shown[:, 0]), 0.999), shown[:, 0]
        drop = (
            brushes * np.quantile(np.abs(record.voltage_v), 0.999) * current / (np.abs(current) + knee * amps)
        )
        one = plain(len(shown), record.voltage_v - drop, record.hold)
        free = one.predict(values(GEAR=gear), learn=False)[0][:, 2:4]
        shown = 0.7 * shown + 0.3 * free
    shown = shown + noise * rng.standard_normal(shown.shape) * p[[index.NOISE_I, index.NOISE_W]]
    return replace(record, readings=shown)


@pytest.mark.parametrize(("gear", "brushes"), [(0.0, 0.0), (0.035, 0.0), (0.0, 0.04)])
def test_what_real_motors_have_is_found_at_its_size(gear: float, brushes: float) -> None:
    found = unmodelled_effects(solution(lossy(gear, brushes), LOGS, values()))
    assert (
        len(unmodelled_effects(solution(lossy(gear, brushes), [*LOGS, "gear_loss"], values()))) == 2
    )  # of the brushes
    sizes = [(test.value, test.sd) for test in (found[0], found[2])]
    for (value, sd), true in zip(sizes, (brushes / 0.04, gear / 0.07), strict=True):
        assert sd < 0.2
        assert value == pytest.approx(true, abs=0.25)


def test_brushes_that_resist_nearly_all_currents_alike_are_found_at_their_size() -> None:
    found = unmodelled_effects(solution(lossy(brushes=0.08, knee=1.0), LOGS, values()))
    assert found[1].value == pytest.approx(1.0, abs=0.25)
    assert found[1].sd < 0.2


def test_what_real_motors_have_widens_the_errors_by_what_it_moves() -> None:
    wrong = solution(lossy(brushes=0.08), LOGS, values())
    spread = np.sqrt(np.diag(covariance(wrong)))
    test = unmodelled_effects(wrong)[0]
    assert test.value > 1.0
    assert abs(wrong.theta[0]) > 0.02  # R is off by more than 2 %
    assert spread[0] > 0.5 * abs(wrong.theta[0])
    right = solution(lossy(), LOGS, values())
    assert np.sqrt(np.diag(covariance(right)))[0] < 0.2 * spread[0]


def test_a_share_of_what_no_term_says_never_averages_away() -> None:
    """Of a record twice as long the same; of one unknown, a share of the error over its slope, the noise left out."""
    p = values()
    once = lossy(brushes=0.16, noise=0.01)
    twice = Record(
        once.dt_s,
        np.tile(once.voltage_v, 2),
        np.tile(once.readings, (2, 1)),
        once.recorded,
        np.tile(once.marks, 2),
        once.hold,
    )
    one, two = (
        np.diag(uncertainty._systematic_covariance(solution(each, LOGS, p), [0, 1])) for each in (once, twice)
    )
    np.testing.assert_allclose(two, one, rtol=0.02)
    best = solution(once.only(current=True, speed=False), ["R"], p)
    shown = best.free[1][:, 2]
    moved = best.problem.record.predict(best.problem.values(best.theta + 1e-4), learn=False)[0][:, 2]
    left = once.readings[:, 0] - shown
    size = np.sqrt(np.mean(left**2) - difference_noise(left) ** 2 * (1.0 + 4.0 / np.sqrt(len(left))))
    sd = 0.15 * size / np.sqrt(np.mean(np.square((moved - shown) / 1e-4)))
    assert np.sqrt(uncertainty._systematic_covariance(best, [0])[0, 0]) == pytest.approx(sd, rel=1e-3)
    right = solution(lossy(), ["R"], p)
    assert uncertainty._systematic_covariance(right, [0])[0, 0] < 0.1 * covariance(right)[0, 0]


def test_the_speed_alone_says_nothing_of_brushes_and_gears() -> None:
    p = values()
    record = worked(p).only(current=False, speed=True)
    assert unmodelled_effects(solution(record, ["K", "J"], p)) == []


@pytest.mark.parametrize("chosen_on", [4000, 300])
def test_a_voltage_without_steps_may_be_timed_otherwise(
    chosen_on: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A sample late or early looks like a lag of L/R, here 0.5 ms with samples 2 ms apart; in long records, too."""
    monkeypatch.setattr("motor_env.diagnosis.estimation.model_selection.SELECTION_SAMPLES", chosen_on)
    p, at, rng = values(), np.arange(800.0), np.random.default_rng(2)
    waves = 6.0 * np.sin(2.0 * np.pi * at / 150.0) + 3.0 * np.sin(2.0 * np.pi * at / 67.0)
    for volts, is_open in ((waves, True), (np.repeat(rng.uniform(-9.0, 9.0, 40), 20), False)):
        record = plain(800, volts)
        clean = record.predict(p, learn=False)[0][:, 2:4]
        shown = clean + 10.0 * rng.standard_normal((800, 2)) * p[[index.NOISE_I, index.NOISE_W]]
        found = fit(replace(record, readings=shown))
        spread = covariance(found)
        row = motor_unknowns(found.problem).index(found.names.index("L"))
        told = found.problem.free[found.names.index("L")].unit * np.sqrt(spread[row, row])
        others = [found.problem.values(theta)[index.L] for theta, _ in found.alternative_optima]
        assert (max(others, default=0.0) > 3.0 * p[index.L]) == is_open
        assert (told > p[index.L]) == is_open


@pytest.mark.parametrize(("left", "is_rival"), [([0.69, 0.69], True), ([0.70, 0.70], False)])
def test_a_fit_without_noise_inside_is_a_rival_if_it_explains_nearly_as_much(
    left: list[float], is_rival: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    p = values()
    best = solution(worked(p), ["R", "noise_voltage", "K"], p, np.array([0.1, 0.2, 0.3]))
    other = solution(worked(p), ["R", "K"], p, np.array([0.4, 0.5]))
    asked = []

    def undisturbed(of: list[Solution]) -> list[Solution]:
        asked.append(of)
        return [other]

    monkeypatch.setattr(fitting, "_output_error_fits", undisturbed)
    monkeypatch.setattr(
        fitting, "_log_unexplained", lambda one: np.array(left if one is other else [0.0, 0.0])
    )
    rivals = fitting._without_process_noise(replace(best, alternative_optima=((p, 7.0),))).alternative_optima
    assert rivals[0] == (p, 7.0)
    assert [(theta.tolist(), misfit) for theta, misfit in rivals[1:]] == [
        ([0.4, 0.2, 0.5], best.misfit)
    ] * is_rival
    assert len(asked) == 1
    assert fitting._without_process_noise(other) is other
    assert len(asked) == 1


@pytest.mark.parametrize(("channel", "told"), [(0, "J"), (1, "K")])
def test_errors_allow_for_what_the_steps_of_a_reading_hide(
    channel: int, told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A converter of ten steps that cuts off, so that it shows half a step too little."""
    record = lossy()
    step = 0.1 * record.peaks[1 + channel]
    cut = record.readings.copy()
    cut[:, channel] = step * np.trunc(cut[:, channel] / step)
    coarse = replace(record, readings=cut)
    assert coarse.steps[channel] == pytest.approx(step)
    wrong = solution(coarse, LOGS, values())
    at = wrong.names.index(told)
    allowed = abs(wrong.theta[at]) / math.sqrt(covariance(wrong)[at, at])
    monkeypatch.setattr(uncertainty, "quantisation_effects", lambda _: [])
    monkeypatch.setattr(uncertainty, "_FOLLOWS", 1e-6)
    assert 1.0 < allowed < 1.5
    assert abs(wrong.theta[at]) > 3.0 * math.sqrt(covariance(wrong)[at, at])


def test_a_channel_that_never_changes_has_no_steps() -> None:
    record = lossy()
    readings = record.readings.copy()
    readings[:, 1] = np.nan
    readings[::2, 0], readings[1::2, 0] = 3.0, 3.0 + 1e-12  # steps of floating-point numbers
    assert replace(record, readings=readings).steps.tolist() == [0.0, 0.0]
