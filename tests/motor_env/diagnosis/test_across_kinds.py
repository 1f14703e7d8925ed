"""A motor that is known by windows of its work judges a start, and one that is known by starts judges windows."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from present import present
from started_motor import step_start

from motor_env import PAPER_MOTOR, Diagnosis, FaultKind, Motor, MotorParameters, Recording, Verdict, diagnose
from motor_env.diagnosis.estimation import parameter_index as index
from motor_env.diagnosis.readers.regime import taken_for
from motor_env.diagnosis.verdict.healthy_motor import (
    Reference,
    ReferenceShift,
    motor_of_windows,
    reference_of,
)
from motor_env.diagnosis.verdict.report_page import reference_current

# Reaches in: a window is off in the direction of a fault.
from motor_env.motor.healthy import Healthy, Starts, Windows
from motor_env.motor.model import steady_state
from motor_env.motor.parameters import FloatArray

RKJB = ("R", "K", "J", "B")
SPEED = 200.0
TIME_S: FloatArray = np.linspace(-0.02, 0.1999, 2200)
TRUE = np.array(
    [
        PAPER_MOTOR.resistance_ohm,
        PAPER_MOTOR.back_emf_constant_v_s_per_rad,
        PAPER_MOTOR.inertia_kg_m2,
        PAPER_MOTOR.viscous_friction_n_m_s_per_rad,
    ],
    dtype=np.float64,
)


def of_windows(dry_n_m: float = 0.0, drop_v: float = 0.0) -> Motor:
    """The motor known by twelve windows, whose effective speed is far below that of a start."""
    physical = np.zeros(index.N_VALUES)
    physical[[index.R, index.K, index.J, index.B]] = TRUE
    physical[[index.L, index.COULOMB, index.DRAG]] = [float(PAPER_MOTOR.inductance_h), dry_n_m, 1.0]
    physical[index.DROP] = drop_v
    values = TRUE + np.array([0.0, 0.0, 0.0, dry_n_m / SPEED])
    covariance = np.diag([0.02, 0.01, 0.02, 0.05]) ** 2
    windows = Windows(0.5, (), physical, "held", 1e-3, SPEED, window_excess=0.7)
    return motor_of_windows(Healthy(12, 15.0, RKJB, values, covariance, windows=windows), "work")


def of_starts(names: tuple[str, ...], covariance: FloatArray) -> Motor:
    """The motor known by five starts that told these quantities."""
    k = float(PAPER_MOTOR.back_emf_constant_v_s_per_rad)
    told = dict(zip(RKJB, TRUE.tolist(), strict=True)) | {"L": float(PAPER_MOTOR.inductance_h)}
    told |= {"K^2/J": k * k / told["J"], "B/J": told["B"] / told["J"]}
    values = np.array([told[name] for name in names])
    starts = Starts(math.log(0.02), 0.1, model=("supply_ramp",), model_low=(1e-3,), model_high=(2e-3,))
    healthy = Healthy(5, 8.0, names, values, covariance, temperature_k=0.0, own_friction=0.8, starts=starts)
    return Motor("started", "commissioned", PAPER_MOTOR, healthy=healthy)


def start(
    motor: MotorParameters, dry_n_m: float, *, has_speed: bool, drop_v: float = 0.0, volts: float = 12.0
) -> Recording:
    states = step_start(motor, TIME_S, 3e-5, volts, COULOMB=dry_n_m, DROP=drop_v)
    noisy: FloatArray = states + np.random.default_rng(4).standard_normal(states.shape) * [0.003, 0.2]
    return Recording(Path("start"), TIME_S, noisy[:, 0], None, noisy[:, 1] if has_speed else None)


@pytest.mark.parametrize(
    ("dry_n_m", "has_speed", "names"),
    [(4e-4, False, ("R", "K^2/J", "B/J")), (0.0, True, RKJB), (4e-4, True, RKJB)],
)
def test_windows_judge_a_start_without_its_inductance(
    dry_n_m: float, has_speed: bool, names: tuple[str, ...]
) -> None:
    """A dry friction counts less at the start's higher speed: half of the windows' drag over their speed is left."""
    motor = of_windows(dry_n_m)
    found = diagnose(start(PAPER_MOTOR, dry_n_m, has_speed=has_speed), motor, voltage_v=12.0)
    assert found.verdict is Verdict.HEALTHY
    assert found.reasons == (
        "no quantity has moved further than 12 healthy windows of work and the fit's own error allow",
    )
    assert [change.name for change in found.changes] == list(names)
    assert [change.ratio for change in found.changes] == pytest.approx([1.0] * len(names), abs=0.06)
    assert found.decisive.reference is not None
    assert not found.decisive.reference.includes_fit_error
    # The healthy motor's current takes the inductance, of which the windows say nothing, from the fit.
    expected, fit = reference_current(found.decisive), found.decisive.identified
    assert expected is not None
    assert fit is not None
    np.testing.assert_allclose(expected, fit.states[:, 0], atol=0.05)


@pytest.mark.parametrize("has_speed", [False, True])
@pytest.mark.parametrize("by_windows", [False, True])
def test_a_start_counts_brush_drop_and_dry_friction_in(has_speed: bool, by_windows: bool) -> None:
    """In R and K, and in B: a file that tells them apart is put together as the start's fit does."""
    drop_v, dry_n_m, volts = 1.5, 8e-4, 9.0
    sheet = Motor("sheet", "data_sheet", PAPER_MOTOR, coulomb_friction_n_m=dry_n_m, brush_drop_v=drop_v)
    motor = of_windows(dry_n_m, drop_v) if by_windows else sheet

    def judged(real: MotorParameters, known: Motor) -> Diagnosis:
        recording = start(real, dry_n_m, has_speed=has_speed, drop_v=drop_v, volts=volts)
        return diagnose(recording, known, voltage_v=volts)

    found = judged(PAPER_MOTOR, motor)
    assert found.verdict is Verdict.HEALTHY
    ratios = {change.name: change.ratio for change in found.changes}
    assert ratios == pytest.approx(dict.fromkeys(ratios, 1.0), abs=0.03)
    worn = judged(PAPER_MOTOR.scaled(resistance_ohm=1.25), motor)
    assert (worn.verdict, worn.kind) == (Verdict.WINDING, FaultKind.WINDING_CONTACT)
    assert worn.severity == pytest.approx(0.25, abs=0.03)
    assert judged(PAPER_MOTOR, replace(motor, brush_drop_v=0.0)).verdict is not Verdict.HEALTHY


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_a_sheet_does_not_say_how_much_of_its_friction_is_dry(share: float) -> None:
    """Of 12 and of 6 V the brushes leave 10 and 4 V: dry friction is 2.5 times as much over the speed, viscous not."""
    nominal_v, drop_v = 12.0, 2.0
    sheet = Motor("sheet", "data_sheet", PAPER_MOTOR, nominal_voltage_v=nominal_v, brush_drop_v=drop_v)
    friction = float(PAPER_MOTOR.viscous_friction_n_m_s_per_rad)
    speed = float(steady_state(PAPER_MOTOR, nominal_v - drop_v)[1])

    def made(times: float, volts: float) -> Recording:
        motor = PAPER_MOTOR.scaled(viscous_friction_n_m_s_per_rad=times * (1.0 - share))
        return start(motor, times * share * friction * speed, has_speed=False, drop_v=drop_v, volts=volts)

    def judged(times: float, volts: float = 0.5 * nominal_v) -> Diagnosis:
        return diagnose(made(times, volts), sheet, voltage_v=volts)

    assert judged(1.0).verdict is Verdict.HEALTHY
    assert judged(4.0).verdict is Verdict.BEARING
    # At the sheet's voltage friction is known, and a quarter more of it is told.
    assert judged(1.0, nominal_v).verdict is Verdict.HEALTHY
    assert judged(1.25, nominal_v).verdict is Verdict.BEARING
    (half,) = (change for change in judged(1.0).changes if change.name == "B/J")
    assert half.ratio == pytest.approx(2.5**share / math.sqrt(2.5), rel=0.05)


def reference(motor: Motor, names: tuple[str, ...], friction: float = 1.0) -> Reference:
    return present(reference_of(motor, names, are_starts=False, shift=ReferenceShift(friction=friction)))


def test_the_kind_of_the_pieces_tells_whose_errors_the_spread_holds() -> None:
    """Errors and excess scatter of other fits do not count for this one; the noise of starts is none of windows."""
    spread = np.diag([0.03, 0.2, 0.02, 0.03, 0.06]) ** 2
    by_starts = reference(of_starts(("R", "L", "K", "J", "B"), spread), RKJB, 0.5)
    assert (by_starts.names, by_starts.source) == (RKJB, "5 healthy starts of started")
    np.testing.assert_allclose(np.exp(by_starts.log_values), TRUE * [1.0, 1.0, 1.0, 0.5])
    np.testing.assert_allclose(
        by_starts.log_covariance, spread[np.ix_([0, 2, 3, 4], [0, 2, 3, 4])], atol=1e-12
    )
    assert (by_starts.includes_fit_error, by_starts.log_noise, by_starts.model) == (False, None, None)
    same = present(reference_of(of_starts(("R", "L", "K", "J", "B"), spread), ("R", "B/J")))
    assert (same.includes_fit_error, same.log_noise, same.model) == (True, math.log(0.02), ("supply_ramp",))
    assert same.log_covariance == pytest.approx(np.diag([0.03**2, 0.03**2 + 0.06**2]), abs=1e-12)
    own, other = reference(of_windows(), RKJB), reference_of(of_windows(), ("R", "L", "K^2/J", "B/J"))
    assert other is not None
    assert other.names == ("R", "K^2/J", "B/J")
    assert (own.includes_fit_error, other.includes_fit_error) == (True, False)
    assert (own.excess, other.excess) == (0.7, 1.0)
    # Of R, L, K^2/J and B/J, windows learn R alone.
    assert reference(of_starts(("R", "L", "K^2/J", "B/J"), spread[:4, :4]), RKJB).names == ("R",)


@pytest.mark.parametrize(("samples", "chosen"), [(499, None), (500, None), (500, 1)])
def test_a_recording_as_long_as_a_healthy_window_is_judged_as_a_window(
    samples: int, chosen: int | None
) -> None:
    """A motor that stands at its begin, and is switched on: a start by what its voltage does."""
    time_s = 1e-3 * np.arange(-20.0, samples - 20.0)
    states = step_start(PAPER_MOTOR, time_s, 0.0, 12.0, COULOMB=0.0)
    noisy = states + np.random.default_rng(4).standard_normal(states.shape) * [0.003, 0.2]
    recording = Recording(Path("x"), time_s, noisy[:, 0], np.where(time_s >= 0.0, 12.0, 0.0), noisy[:, 1])
    taken = diagnose(recording, of_windows(), start=chosen).taken
    assert (taken == ("operation", "as its healthy recordings")) is (samples == 500 and chosen is None)
    assert taken_for(recording).regime == "start"
