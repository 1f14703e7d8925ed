"""A fleet of real robots: REGBOT, 78 records of SebastianBitsch/robobot-project. Nobody has labelled them."""

import os
from pathlib import Path

import pytest

from motor_env.diagnosis.fleet.fits import processes
from motor_env.diagnosis.fleet.judging import diagnose_fleet

recordings_path = os.environ.get("MOTOR_ENV_RECORDINGS")
GROUP = r"(?P<machine>\d+)(_(?P<repeat>[a-z]+))?_(?P<motor>left|right)"
DEAD = ("13 left", "13 right", "17 left")
"""Whose current reads nothing while they turn."""
HEAVY = ("19 left", "55 right", "11 left")
"""They draw clearly more current than their sisters."""


@pytest.mark.long
@pytest.mark.timeout(900)
@pytest.mark.skipif(
    recordings_path is None, reason="MOTOR_ENV_RECORDINGS does not point to the recordings of real motors"
)
def test_the_motors_that_draw_too_much_lead_and_no_dead_sensor_is_a_fault_of_a_motor() -> None:
    files = sorted((Path(recordings_path or "") / "regbot").glob("*.csv"))
    assert len(files) == 78
    with processes(2) as each:
        found = {one.unit_id.name: one for one in diagnose_fleet(files, group=GROUP, each=each).units}
    for name in (*DEAD, "11 right"):
        assert found[name].verdict not in ("healthy", "winding", "bearing", "magnet"), name
    told = [
        name for name, one in found.items() if one.p_value is not None and name not in (*DEAD, "11 right")
    ]
    assert set(sorted(told, key=lambda name: found[name].p_value or 0.0)[:3]) == set(HEAVY)
    assert all(found[name].verdict.is_fault for name in HEAVY)
    assert found["19 left"].ratios["B"] > 3.0
    healthy = sum(one.verdict == "healthy" for one in found.values())
    assert healthy > 50
