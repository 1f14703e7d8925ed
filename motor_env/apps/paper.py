"""Compute the source paper's numbers beside ours, and its errors.

The paper: "Simulation of Incipient Fault Detection, Confirmation and Diagnosis Using Kalman Filter". It prints a
table of parameters, a pair of discrete matrices, two faulty resistances and two faulty frictions; no curve's numbers.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from motor_env.motor.faults import Fault, FaultKind, apply_fault
from motor_env.motor.model import State, discretize, steady_state
from motor_env.motor.parameters import (
    PAPER_MATRICES_DT_S,
    PAPER_MATRICES_MOTOR,
    PAPER_MOTOR,
    RAD_S_PER_RPM,
    MotorParameters,
)
from motor_env.simulation.simulate import simulate_states

VOLTAGE_V = 12.0
STATED_DT_S = 10e-6
"""Sampling time that the paper states."""

PRINTED_A = (("-0.0344", "-0.0007"), ("1.6343", "0.0300"))
PRINTED_B = ("0.0334", "41.0557")
PRINTED_RESISTANCES = {0.10: "2.266", 0.25: "2.575"}
PRINTED_FRICTIONS = {0.10: "13.2e-7", 0.25: "15e-7"}
PRINTED_SPEED_RPM = "4850"

OTHER_MATRICES_MOTOR = replace(
    PAPER_MOTOR, resistance_ohm=PAPER_MATRICES_MOTOR.resistance_ohm, inertia_kg_m2=1.07e-7
)
"""Parameters that give the printed matrices too, at `OTHER_MATRICES_DT_S`."""

OTHER_MATRICES_DT_S = 1e-3

SETTLING_BAND = 0.02
"""Settled: within this share of the peak from the final value (our choice)."""

FINE_DT_S = 1e-6
_SETTLING_SPAN_S = 0.04

FAULT_LEVELS: tuple[Fault | None, ...] = (
    None,
    Fault(FaultKind.WINDING_CONTACT, 0.10),
    Fault(FaultKind.WINDING_CONTACT, 0.25),
    Fault(FaultKind.BEARING, 0.10),
    Fault(FaultKind.BEARING, 0.25),
)
"""The paper's levels (part 4): healthy, resistance and friction up by 10 and 25 %."""


class StartUp(NamedTuple):
    """Figures of a start-up under a constant voltage, from rest."""

    peak_a: float
    peak_time_s: float
    settling_time_s: float
    final_current_a: float
    final_speed_rpm: float


class Comparison(NamedTuple):
    """A number of the paper beside ours.

    Attributes:
        quantity: its name.
        unit: its unit, empty for a pure number.
        paper: as the paper prints it, None where it prints none.
        ours: as computed.
        decimals: number of shown decimals.
        parameters: source of `ours`.
    """

    quantity: str
    unit: str
    paper: str | None
    ours: float
    decimals: int
    parameters: str

    @property
    def ours_text(self) -> str:
        """Our value, rounded as shown."""
        return f"{self.ours:.{self.decimals}f}"

    @property
    def agrees(self) -> bool | None:
        """Whether ours rounds to every printed digit; None where the paper prints none.

        Final zeros of a whole number (4850) do not count.
        """
        if self.paper is None:
            return None
        mantissa, _, exponent = self.paper.partition("e")
        whole, point, fraction = mantissa.partition(".")
        decimals = len(fraction) if point else len(whole.rstrip("0")) - len(whole)
        decimals -= int(exponent or 0)
        # Half a unit of the last printed digit, and the rounding error of that half itself.
        return abs(self.ours - float(self.paper)) <= (0.5 + 1e-6) * 10.0**-decimals


class Slip(NamedTuple):
    """Error of the paper: its statement, and one sentence with the number that disproves it."""

    says: str
    holds: str


def faulty(fault: Fault | None) -> MotorParameters:
    """Apply one of the paper's faults to its motor."""
    return PAPER_MOTOR if fault is None else apply_fault(PAPER_MOTOR, fault)


def level_name(fault: Fault | None) -> str:
    """Name a fault level: healthy, bearing 10 %, ..."""
    if fault is None:
        return "healthy"
    return f"{str(fault.kind).replace('_', ' ')} {100.0 * float(fault.severity):g} %"


def start_up(parameters: MotorParameters) -> StartUp:
    """Simulate the start under 12 V: peak, peak time, settling time and final values.

    Exact at every microsecond; the peak is interpolated by a parabola, the settling by a line.
    """
    n_samples = round(_SETTLING_SPAN_S / FINE_DT_S)
    states = simulate_states(parameters, np.full(n_samples, VOLTAGE_V), FINE_DT_S)
    current = states[:, State.CURRENT]
    final_current, final_speed = steady_state(parameters, VOLTAGE_V)
    top = int(current.argmax())
    before, peak, after = current[top - 1 : top + 2].tolist()
    shift = 0.5 * (before - after) / (before - 2.0 * peak + after)
    distance = np.abs(current - final_current) - SETTLING_BAND * peak
    last = int(np.flatnonzero(distance > 0.0)[-1])
    crossing = last + float(distance[last] / (distance[last] - distance[last + 1]))
    # Sample k is read at the end of interval k, at (k + 1) dt.
    return StartUp(
        peak_a=peak,
        peak_time_s=(top + 1 + shift) * FINE_DT_S,
        settling_time_s=(crossing + 1) * FINE_DT_S,
        final_current_a=float(final_current),
        final_speed_rpm=float(final_speed) / RAD_S_PER_RPM,
    )


def comparisons() -> list[Comparison]:
    """Compute every number that the paper prints or plots, beside ours."""
    healthy, table = start_up(PAPER_MOTOR), "table, 12 V"
    # The paper gives no final value of its simulation; 4850 rpm is how it names the motor.
    return [
        Comparison("final speed", "rpm", PRINTED_SPEED_RPM, healthy.final_speed_rpm, 1, table),
        Comparison("final current", "mA", None, 1e3 * healthy.final_current_a, 2, table),
        *_matrices(),
        *_faulty_parameters(),
        *_start_ups(),
    ]


def _matrices() -> list[Comparison]:
    rows = []
    cases = (
        ("R 2.06 Ω, L 2.38 mH, 10 ms", PAPER_MATRICES_MOTOR, PAPER_MATRICES_DT_S, 4),
        ("table, 10 µs (as stated)", PAPER_MOTOR, STATED_DT_S, 5),
    )
    for text, motor, dt_s, decimals in cases:
        model = discretize(motor, dt_s)
        names, printed = ("A11", "A12", "A21", "A22", "B1", "B2"), (*PRINTED_A[0], *PRINTED_A[1], *PRINTED_B)
        ours = [*model.transition.ravel().tolist(), *model.gain[:, 0].tolist()]
        rows += [
            Comparison(name, "", digits, value, decimals, text)
            for name, digits, value in zip(names, printed, ours, strict=True)
        ]
    return rows


def _faulty_parameters() -> list[Comparison]:
    rows = []
    bases = (("1 + s times 2.06 Ω", PAPER_MATRICES_MOTOR), ("1 + s times the table's 2.18 Ω", PAPER_MOTOR))
    for text, motor in bases:
        for severity, printed in PRINTED_RESISTANCES.items():
            resistance = apply_fault(motor, Fault(FaultKind.WINDING_CONTACT, severity)).resistance_ohm
            name = f"resistance, winding contact {100 * severity:g} %"
            rows.append(Comparison(name, "Ω", printed, float(resistance), 3, text))
    for severity, printed in PRINTED_FRICTIONS.items():
        friction = apply_fault(PAPER_MOTOR, Fault(FaultKind.BEARING, severity)).viscous_friction_n_m_s_per_rad
        name = f"friction, bearing {100 * severity:g} %"
        rows.append(Comparison(name, "N m s/rad", printed, float(friction), 8, "1 + s times the table's"))
    return rows


def _start_ups() -> list[Comparison]:
    rows = []
    for fault in FAULT_LEVELS:
        figures, name = start_up(faulty(fault)), level_name(fault)
        shown = (
            ("peak current", "A", figures.peak_a, 3),
            ("peak time", "ms", 1e3 * figures.peak_time_s, 3),
            ("settling time", "ms", 1e3 * figures.settling_time_s, 2),
            ("final current", "mA", 1e3 * figures.final_current_a, 2),
            ("final speed", "rpm", figures.final_speed_rpm, 1),
        )
        rows += [
            Comparison(f"{quantity}, {name}", unit, None, value, decimals, "table, 12 V")
            for quantity, unit, value, decimals in shown
        ]
    return rows


def slips() -> list[Slip]:
    """List the paper's errors, each with the number that shows it."""
    return [*_slips_of_the_model(), *_slips_of_the_faults()]


def _slips_of_the_model() -> list[Slip]:
    healthy, source = PAPER_MOTOR, PAPER_MATRICES_MOTOR
    swapped = replace(
        source,
        back_emf_constant_v_s_per_rad=source.torque_constant_n_m_per_a,
        torque_constant_n_m_per_a=source.back_emf_constant_v_s_per_rad,
    )
    swapped_a21 = discretize(swapped, PAPER_MATRICES_DT_S).transition[1, 0]
    other = discretize(OTHER_MATRICES_MOTOR, OTHER_MATRICES_DT_S).transition[1, 0]
    stated = discretize(healthy, STATED_DT_S)
    a, b = stated.transition, stated.gain[:, 0]
    source_l_mh, l_mh = 1e3 * float(source.inductance_h), 1e3 * float(healthy.inductance_h)
    return [
        Slip(
            "Eq. (1) has Kt and eq. (2) has Kb.",
            "They are swapped: the back-EMF constant belongs in the electrical equation, the torque constant in the "
            f"torque; with the two as printed A21 would be {swapped_a21:.4f}, and the paper's own matrix has "
            f"{PRINTED_A[1][0]}.",
        ),
        Slip(
            "The printed A and B are for a sampling time of 10 microseconds.",
            "Every printed digit comes from the exact zero-order hold at 10 milliseconds with R = "
            f"{source.resistance_ohm:.2f} Ω and L = {source_l_mh:.2f} mH, where the table has "
            f"{healthy.resistance_ohm} Ω and {l_mh:.3f} mH (the same digits also come at 1 ms from R = 2.06 Ω, "
            f"L = {l_mh:.3f} mH and J = 1.07e-7 kg m²: A21 = {other:.4f}).",
        ),
        Slip(
            "The printed A and B belong to the table's parameters.",
            f"The table at 10 microseconds gives A = [[{a[0, 0]:.5f}, {a[0, 1]:.5f}], [{a[1, 0]:.5f}, "
            f"{a[1, 1]:.5f}]] and B = [{b[0]:.5f}, {b[1]:.5f}]: in so short a step {100 * a[0, 0]:.0f} % of the "
            "current is left, not -3 %.",
        ),
        Slip(
            "The rotor inertia is in kg/m².",
            "It is in kg m²: with 1.07e-6 kg m² the mechanical time constant "
            f"R J / (Kt Kb + R B) is {1e3 * float(healthy.mechanical_time_constant_s):.2f} ms.",
        ),
    ]


def _slips_of_the_faults() -> list[Slip]:
    healthy = start_up(PAPER_MOTOR)
    ten, quarter = (start_up(faulty(Fault(FaultKind.BEARING, severity))) for severity in (0.10, 0.25))
    raised = start_up(faulty(Fault(FaultKind.WINDING_CONTACT, 0.25)))
    lowered = start_up(PAPER_MOTOR.scaled(resistance_ohm=0.75))
    noisy = start_up(faulty(Fault(FaultKind.NOISE, 0.25)))
    more = [
        100.0 * (float(printed) / float(PAPER_MOTOR.resistance_ohm) - 1.0)
        for printed in PRINTED_RESISTANCES.values()
    ]
    moved = 100.0 * (1.0 - quarter.settling_time_s / healthy.settling_time_s)
    levels = [1e3 * figures.final_current_a for figures in (healthy, ten, quarter)]
    return [
        Slip(
            "The resistance varied by 10 % is 2.266 Ω, by 25 % 2.575 Ω.",
            "These are 1.10 and 1.25 times 2.06 Ω; of the table's 2.18 Ω they are only "
            f"{more[0]:.1f} and {more[1]:.1f} % more.",
        ),
        Slip(
            "An armature winding fault is a decrease of the resistance.",
            "The paper raises the resistance twice. The peak current tells an increase from a decrease: "
            f"{raised.peak_a:.3f} A at +25 %, {healthy.peak_a:.3f} A healthy, {lowered.peak_a:.3f} A at -25 % "
            "(here a bad contact raises R; shorted turns lower R, L and both constants).",
        ),
        Slip(
            "A bearing fault changes the current's settling time.",
            f"It moves by {moved:.2f} %, from {1e3 * healthy.settling_time_s:.3f} to "
            f"{1e3 * quarter.settling_time_s:.3f} ms at +25 %; what moves is the final current, "
            f"{levels[0]:.1f}, {levels[1]:.1f} and {levels[2]:.1f} mA at 0, +10 and +25 %.",
        ),
        Slip(
            "An incipient fault is Gaussian noise.",
            "More noise leaves every parameter as it was (the final current without the noise stays at "
            f"{1e3 * noisy.final_current_a:.2f} mA) and shows in the variance of the filter's innovation alone: "
            "a third kind of fault, beside bearing and winding.",
        ),
    ]
