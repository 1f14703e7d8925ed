"""Faults: their exact effect on the parameters, when they switch, how they grow."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from motor_env import PAPER_MOTOR, Fault, FaultKind, register_fault_kind
from motor_env.motor.faults import BUILT_IN_KINDS, NoiseSource, apply_fault, noise_variance_factor
from motor_env.motor.parameters import QUANTITY_FIELDS

GRID_S = np.arange(1000, dtype=np.float64) * 1e-4
WEAKER = {"back_emf_constant_v_s_per_rad": 0.8, "torque_constant_n_m_per_a": 0.8}


@pytest.mark.parametrize(
    ("kind", "severity", "factors"),
    [
        (FaultKind.BEARING, 0.25, {"viscous_friction_n_m_s_per_rad": 1.25}),
        (FaultKind.WINDING_CONTACT, 0.10, {"resistance_ohm": 1.10}),
        (FaultKind.WINDING_SHORT, 0.2, {"resistance_ohm": 0.8, "inductance_h": 0.8 * 0.8} | WEAKER),
        (FaultKind.MAGNET, 0.2, WEAKER),
    ],
)
def test_a_fault_changes_its_parameters_and_no_other(
    kind: FaultKind, severity: float, factors: dict[str, float]
) -> None:
    assert apply_fault(PAPER_MOTOR, Fault(kind, severity)) == PAPER_MOTOR.scaled(**factors)


def test_the_order_of_the_kinds_is_that_of_a_cases_random_numbers() -> None:
    kinds = ("bearing", "winding_contact", "winding_short", "noise", "magnet")
    assert kinds == BUILT_IN_KINDS
    assert [kind.verdict for kind in BUILT_IN_KINDS] == ["bearing", "winding", "winding", "noise", "magnet"]


def unregistered(**powers: float) -> FaultKind:
    """A kind that no other test sees."""
    kind = str.__new__(FaultKind, "mine")
    vars(kind).update(powers=powers, verdict="mine", finding="")
    return kind


@pytest.mark.parametrize(
    "kind",
    [
        *BUILT_IN_KINDS,
        unregistered(resistance=0.5, constants=-1.5, noise=2.0),
        unregistered(friction=-0.5, inertia=-3.0),
    ],
)
def test_a_fault_is_a_ray_in_the_logarithms(kind: FaultKind) -> None:
    """(1 + s)^power, or (1 - s)^-power where all is lost, is exp(power * log size)."""
    severity = np.array([0.0, 0.1, 0.25, 0.7])
    size = kind.log_size(severity)
    loses = max(kind.powers.values()) < 0.0
    assert kind.loses == loses
    np.testing.assert_allclose(size, -np.log(1.0 - severity) if loses else np.log(1.0 + severity), rtol=1e-14)
    np.testing.assert_allclose(kind.severity(size), severity, rtol=1e-14)
    names = [*QUANTITY_FIELDS, "noise"]
    for name, slope in zip(names, kind.direction(names), strict=True):
        assert slope == kind.powers.get(name, 0.0)
        factor = np.broadcast_to(kind.factor(name, severity), severity.shape)
        np.testing.assert_allclose(factor, np.exp(slope * size), rtol=1e-14)
    assert kind.motor_powers == {name: power for name, power in kind.powers.items() if name != "noise"}


def test_noise_leaves_the_motor_and_raises_one_source_by_the_product_of_all_factors() -> None:
    fault = Fault(FaultKind.NOISE, 3.0, noise_source=NoiseSource.PROCESS)
    both = [fault, replace(fault, severity=np.array([0.0, 4.0]), onset_s=1e-4)]
    assert apply_fault(PAPER_MOTOR, fault) == PAPER_MOTOR
    factor = noise_variance_factor(both, NoiseSource.PROCESS, GRID_S[:3])
    assert factor.tolist() == [[4.0, 4.0, 4.0], [4.0, 20.0, 20.0]]
    assert noise_variance_factor(both, NoiseSource.MEASUREMENT, GRID_S[:2]).tolist() == [[1.0, 1.0]]


@pytest.mark.parametrize(
    ("onset_s", "first"),
    [*((round(index * 1e-4, 4), index) for index in (0, 1, 7, 29, 333, 999)), (2.5e-4, 3)],
)
def test_an_onset_acts_from_its_interval_on_or_from_the_next(onset_s: float, first: int) -> None:
    """7 * 1e-4 and 0.0007 differ in the last bit: the comparison must not."""
    fraction = Fault(FaultKind.BEARING, 0.1, onset_s=onset_s).fraction_at(GRID_S)
    np.testing.assert_array_equal(fraction, np.arange(1000) >= first)


def test_growth_is_linear_and_ends() -> None:
    fault = Fault(FaultKind.BEARING, 0.1, onset_s=0.01, growth_s=0.02)
    at = fault.fraction_at(np.array([0.0, 0.01, 0.015, 0.02, 0.03, 1.0]))
    np.testing.assert_allclose(at, [0.0, 0.0, 0.25, 0.5, 1.0, 1.0], atol=1e-6)


def test_a_finding_is_one_line_of_text() -> None:
    for line in ("two\nlines", 7):
        with pytest.raises(ValueError, match=r"^finding of fouling must be one line of text, got "):
            register_fault_kind("fouling", {"inertia": 1.0}, finding=line)  # type: ignore[arg-type]  # on purpose


def test_nothing_changes_a_kind() -> None:
    kind: Any = FaultKind.BEARING
    with pytest.raises(TypeError):
        kind.powers["friction"] = -5.0
    with pytest.raises(AttributeError, match="cannot be changed"):
        kind.powers = {"friction": -5.0}


def test_a_word_is_the_verdict_of_one_family() -> None:
    with pytest.raises(
        ValueError, match=r"^winding is the name of .*verdict fouling, .*verdict of winding_contact"
    ):
        register_fault_kind("winding", {"inertia": 1.0}, "fouling")
    with pytest.raises(
        ValueError, match=r"^winding_short is the name of .*verdict winding, .*verdict of fouling"
    ):
        register_fault_kind("fouling", {"inertia": 1.0}, "winding_short")
