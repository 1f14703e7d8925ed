"""What is believed of a start before it is fitted: residuals, priors and bounds written out, and its record."""

from dataclasses import replace

import numpy as np
import pytest
from measured_starts import (
    DT_S,
    MOTOR,
    ONSET_S,
    QUIET,
    TIME_S,
    left_of,
    place,
    problem_of,
    start,
    truth,
)
from scipy.integrate import quad
from scipy.stats import norm
from started_motor import step_start, values_of

from motor_env.diagnosis.estimation import parameter_index as index
from motor_env.diagnosis.estimation.problem import Solution
from motor_env.diagnosis.estimation.record import rectified_mean
from motor_env.diagnosis.estimation.starts.start_fit import record_of
from motor_env.diagnosis.estimation.starts.start_identification import identify
from motor_env.diagnosis.estimation.starts.start_prior import start_prior
from motor_env.diagnosis.readers.start import Circuit


@pytest.mark.parametrize("speed", [False, True])
def test_residuals_at_the_truth_are_the_noise(speed: bool) -> None:
    """Over the noises believed, times their geometric mean; weighed by what is left, they have the scatter 1."""
    measured = start(speed=speed)
    problem = problem_of(measured)
    assert problem.names == ("R", "L", *(("K",) if speed else ()), "J", "B", "onset", "offset_current")
    turned = measured.current_a if measured.speed_rad_s is None else measured.speed_rad_s
    left = [measured.current_a - 0.02, turned][: 1 + speed]
    shown = step_start(MOTOR, TIME_S, ONSET_S, 12.0)[:, : 1 + speed]
    noises = problem.known[[index.NOISE_I, index.NOISE_W][: 1 + speed]]
    assert noises == pytest.approx([0.02 * np.ptp(each) for each in left])
    got, beliefs = left_of(problem, truth(problem, measured))
    expected = np.transpose(left) - shown
    np.testing.assert_allclose(got * noises / np.exp(np.mean(np.log(noises))), expected, atol=1e-6)
    assert not beliefs.any()
    weighed = Solution(problem, truth(problem, measured), 0.0).reweighted()
    found = weighed.known[[index.NOISE_I, index.NOISE_W][: 1 + speed]]
    again = left_of(weighed, truth(problem, measured))[0] / np.exp(np.mean(np.log(found)))
    assert again.std(axis=0) == pytest.approx(np.ones(1 + speed))


@pytest.mark.parametrize(("quiet", "share"), [(True, 0.05), (False, 0.0002)])
def test_the_offset_is_held_near_that_of_the_quiet_part(quiet: bool, share: float) -> None:
    measured = start(quiet=quiet)
    problem = problem_of(measured)
    unknowns, span = truth(problem, measured), np.ptp(measured.current_a)
    unknowns[-1] += 0.01 / problem.free[-1].unit
    belief = left_of(problem, unknowns)[1][-1] / problem.known[index.NOISE_I]
    assert belief == pytest.approx(0.01 / (share * span))
    # A fiftieth of what follows the onset, no earlier than two samples before the first.
    onset_term, onset = problem.free[-2], measured.alignment.onset_s
    latest = 0.02 * (measured.time_s[-1] - onset)
    earliest = max(-latest, measured.time_s[0] - 2.0 * DT_S - onset)
    assert [onset_term.value(x) for x in (onset_term.low, onset_term.high)] == pytest.approx(
        [earliest, latest]
    )
    assert problem_of(replace(measured, voltage_v=np.full(len(measured.time_s), 12.0))).names[-2] == "delay"


def test_a_typical_inductance_is_believed_to_thirty_per_cent() -> None:
    """Where a lag of supply or sensor takes its place; the current alone tells J and B as multiples of K^2."""
    typical, measured = {"R": 2.0, "L": 3e-4, "K^2/J": 500.0, "B/J": 1.2}, start()
    belief, unknown = start_prior(measured, 0.02352, typical), start_prior(measured, 0.02352, None)
    for name, sd in (("supply_ramp", 0.3), ("supply_curve", 0.3), ("sensor_lag", 0.3), ("coulomb", np.inf)):
        assert belief.problem((name,)).free[1].prior_sd == sd
    ramp, off = belief.problem(("supply_ramp",)), np.log(0.238e-3 / 3e-4) / 0.3
    unknowns = truth(ramp, measured, supply_ramp=1e-3)
    assert belief.inductance_deviation(unknowns) == pytest.approx(off)
    assert left_of(ramp, unknowns)[1][1] / ramp.known[index.NOISE_I] == pytest.approx(off)
    assert belief.typical["J"] == pytest.approx(np.log(0.02352**2 / 500.0 / ramp.known[index.J]))
    assert belief.typical["B"] == pytest.approx(np.log(1.2 * 0.02352**2 / 500.0 / ramp.known[index.B]))
    far = truth(belief.problem(()), measured)
    assert belief.is_typical(far)
    far[0] = belief.typical["R"] + 1.01
    assert not belief.is_typical(far)
    assert unknown.problem(("supply_ramp",)).free[1].prior_sd == np.inf
    assert unknown.inductance_deviation(unknowns) == 0.0


def test_a_curve_of_the_supply_is_shares_of_its_rise() -> None:
    measured = start()
    problem = problem_of(measured, ("supply_ramp", "supply_curve"))
    curve = {f"curve_{n + 1}": share for n, share in enumerate((2.0, 0.5, 1.0, 3.0))}
    assert problem.names[4:-2] == ("supply_ramp", *curve)
    unknowns = truth(problem, measured, supply_ramp=1e-3, **curve)
    values = problem.values(unknowns)
    assert values[index.RISE] == pytest.approx(1e-3)
    assert values[index.CURVE] == pytest.approx([2.0, 0.5, 1.0, 3.0])
    beliefs = left_of(problem, unknowns)[1][5:-2] / problem.known[index.NOISE_I]
    np.testing.assert_allclose(beliefs, np.log([2.0, 0.5, 1.0, 3.0]) / 1.5)


def test_what_a_start_shows_of_another_motor() -> None:
    measured = replace(start(speed=True), circuit=Circuit(shunt_ohm=0.3))
    whole = MOTOR.scaled(resistance_ohm=1.2 + 0.3 / 2.18)
    values = values_of(
        MOTOR.scaled(resistance_ohm=1.2), ONSET=ONSET_S - measured.alignment.onset_s, OFFSET_I=0.1
    )
    expected = step_start(whole, TIME_S, ONSET_S, 12.0) + np.array([0.1, 0.0])
    np.testing.assert_allclose(identify(measured).run(values), expected, atol=1e-9)
    driven = record_of(replace(measured, voltage_v=np.full(500, 12.0), from_rest=False))
    assert (driven.onset_s, driven.shunt_ohm, driven.rectified_a) == (None, 0.3, None)


def test_the_record_of_a_start_is_what_counts_of_it() -> None:
    """Without the quiet part's offset; wild and missing samples are none; a speed where there is one."""
    measured = start(speed=True)
    missing = np.zeros((500, 2), dtype=np.bool_)
    missing[70, 0] = missing[[80, 90], 1] = True
    wild = replace(measured, alignment=replace(measured.alignment, wild=(3, 60)), missing=missing)
    record = record_of(wild)
    assert [np.flatnonzero(np.isnan(one)).tolist() for one in record.readings.T] == [[3, 60, 70], [80, 90]]
    expected = np.stack([measured.current_a - 0.02, measured.speed_rad_s], axis=1)  # type: ignore[list-item]
    np.testing.assert_allclose(record.readings, np.where(np.isnan(record.readings), np.nan, expected))
    assert (record.is_start, record.recorded.tolist()) == (True, [1.0, 1.0])
    assert record_of(replace(measured, speed_rad_s=None)).recorded.tolist() == [1.0, 0.0]
    assert record.onset_s == pytest.approx((QUIET + 1) * DT_S)  # from the first sample to where it was found
    assert problem_of(wild).count == 995
    rectified = replace(measured, alignment=replace(measured.alignment, rectified=True))
    assert record_of(rectified).rectified_a == 0.01
    assert "offset_current" not in problem_of(rectified).names


@pytest.mark.parametrize("current", [-0.03, 0.0, 0.01, 0.5])
def test_the_mean_of_a_rectified_reading(current: float) -> None:
    expected = quad(lambda x: x * norm.pdf(x, current, 0.02), 0.0, max(current, 0.0) + 0.3)[0]
    assert rectified_mean(np.array([current]), 0.02)[0] == pytest.approx(expected, rel=1e-6)
    assert rectified_mean(np.array([current]), 0.0)[0] == max(current, 0.0)


def test_a_fit_is_given_finite_numbers() -> None:
    """A missing sample counts nothing, an infinite one much, and so does every sample under values that are none."""
    measured = start()
    problem = problem_of(measured)
    unknowns = truth(problem, measured)
    for wild in (np.inf, -np.inf):
        problem.record.readings[:3, 0] = [wild, wild, np.nan]
        got, scale = left_of(problem, unknowns)[0][:, 0], problem.known[index.NOISE_I]
        # Two of 500 count otherwise.
        assert got[:3] == pytest.approx([1e6 * scale, 1e6 * scale, 0.0], rel=0.01)
    assert problem.count == 497
    unknowns[place(problem, "R")] = np.nan
    np.testing.assert_allclose(left_of(problem, unknowns)[0][QUIET + 1 :, 0], 1e6 * scale, rtol=0.01)
