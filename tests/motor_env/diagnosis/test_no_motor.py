"""What is no motor that turns: switched on like one, it is never called a motor with a worn bearing."""

from pathlib import Path

import numpy as np
import pytest

from motor_env import Recording, diagnose, identify
from motor_env.motor.parameters import FloatArray

SHEET = Path(__file__).resolve().parents[3] / "examples" / "motor.toml"
TIME_S: FloatArray = np.linspace(0.0, 0.2, 1001)
SINCE_S: FloatArray = np.maximum(TIME_S - 0.02, 0.0)
LOADS = {
    "resistor": np.where(SINCE_S > 0.0, 5.5, 0.0),
    "blocked rotor": 5.5 * -np.expm1(-SINCE_S * 2.18 / 0.238e-3),
    "solenoid": 5.5 * -np.expm1(-SINCE_S / 0.01) - 1.5 * np.exp(-(((SINCE_S - 0.015) / 0.003) ** 2)),
}


@pytest.mark.parametrize("has_voltage", [True, False])
@pytest.mark.parametrize("load", LOADS)
def test_what_does_not_turn_has_no_bearing(load: str, has_voltage: bool) -> None:
    rng = np.random.default_rng(1)
    volts = 12.0 * (SINCE_S > 0.0) + 0.02 * rng.standard_normal(len(TIME_S))
    current = LOADS[load] * (SINCE_S > 0.0) + 0.03 * rng.standard_normal(len(TIME_S))
    recording = Recording(Path(f"{load}.csv"), TIME_S, current, volts if has_voltage else None, None)
    found = diagnose(recording, SHEET)
    assert found.verdict == "other"
    assert found.severity is None
    warnings = identify(recording).to_json()[0]["warnings"]
    assert any("does not show that a motor turns" in sentence for sentence in warnings)
    if has_voltage or load != "resistor":  # for that one the sheet's L leaves a K^2/J, and all of it moved
        assert "does not show that a motor turns" in found.reasons[0]
