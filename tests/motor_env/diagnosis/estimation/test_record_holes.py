"""Records with holes: what is marked, what an unknown voltage changes, what still counts."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recorded_motor import plain, values

from motor_env import Recording
from motor_env.diagnosis.estimation import parameter_index as index
from motor_env.diagnosis.estimation.ekf import BEGIN, FOUND, LOST, OPEN
from motor_env.diagnosis.estimation.preprocessing import at_terminals, from_recordings, missing_blocks
from motor_env.diagnosis.estimation.record import Record, with_begins, with_holes
from motor_env.diagnosis.readers.recording import UnusableError
from motor_env.diagnosis.readers.start import Circuit
from motor_env.motor.parameters import FloatArray

BOTH = np.ones(2)
VALUES = values(COULOMB=0.0, NOISE_I=0.02, NOISE_W=0.5)


def holed(
    n: int, voltage: Sequence[int], current: Sequence[int] = (), speed: Sequence[int] = ()
) -> Recording:
    columns: FloatArray = np.random.default_rng(2).uniform(4.0, 5.0, (3, n))
    columns[0] = np.linspace(3.0, 9.0, n)
    for column, lost in zip(columns, (voltage, current, speed), strict=True):
        column[list(lost)] = np.nan
    return Recording(Path("x"), np.linspace(0.0, 1e-3 * (n - 1), n), columns[1], columns[0], columns[2])


def marked(**lost: list[int]) -> dict[float, list[int]]:
    """Samples of each mark of a record of 60."""
    record = from_recordings(
        [holed(60, lost.get("voltage", []), lost.get("current", []), lost.get("speed", []))]
    )
    return {mark: np.flatnonzero(record.marks == mark).tolist() for mark in (BEGIN, LOST, FOUND)}


def test_an_interval_that_may_have_held_a_missing_voltage_is_lost_and_then_the_state_is_found() -> None:
    assert marked(voltage=[20]) == {BEGIN: [0], LOST: [19, 20, 21, 22], FOUND: [23]}
    assert marked(voltage=[20, 22]) == {BEGIN: [0], LOST: [*range(19, 25)], FOUND: [25]}
    assert marked(voltage=[20, 24])[FOUND] == [27], "one hole follows the other"
    assert marked(voltage=[20], current=[22, 23]) == {BEGIN: [0], LOST: [*range(19, 25)], FOUND: [25]}
    assert marked(voltage=[20], speed=[23, 24]) == {BEGIN: [0], LOST: [19, 20, 21, 22], FOUND: [23, 24, 25]}
    assert marked(current=[20, 21], speed=[40]) == {BEGIN: [0], LOST: [], FOUND: []}
    assert marked(voltage=[59])[LOST] == [58, 59]


def test_a_recording_begins_once_all_channels_are_read() -> None:
    assert marked(current=[0, 1], speed=[3]) == {BEGIN: [*range(5)], LOST: [], FOUND: []}
    assert marked(voltage=[1])[BEGIN] == [0, 1, 2, 3]
    marks = np.zeros(8)
    marks[[0, 5]] = BEGIN
    readings = np.zeros((8, 2))
    readings[[0, 5], 1] = np.nan
    assert np.flatnonzero(with_begins(marks, readings, BOTH)).tolist() == [0, 1, 5, 6]
    assert np.flatnonzero(with_begins(marks, readings, np.array([1.0, 0.0]))).tolist() == [0, 5]
    stretches = from_recordings([holed(120, [], current=[60, 61])]).sample(80)
    assert np.flatnonzero(stretches.marks).tolist() == sorted([*range(0, 80, 8), 41, 42])


def test_an_open_circuit_needs_no_voltage_but_a_hole_does_not_know_of_it() -> None:
    marks = np.full(10, OPEN)
    found = with_holes(marks, np.arange(10) == 5, np.zeros((10, 2)), BOTH)
    assert found.tolist() == [OPEN] * 4 + [LOST] * 4 + [FOUND, OPEN]


def test_what_counts() -> None:
    record = from_recordings([holed(60, [20], current=[40], speed=[41])])
    assert (~record.informative[:, 0]).nonzero()[0].tolist() == [19, 20, 21, 22, 23, 40]
    assert (~record.informative[:, 1]).nonzero()[0].tolist() == [19, 20, 21, 22, 23, 41]
    assert record.count == 2 * 60 - 12 - 2
    with pytest.raises(
        UnusableError, match=r"only 34 of 60 samples are there, and follow others 0\.001 s apart"
    ):
        from_recordings([holed(60, [10, 14, 18, 22, 26, 30])])


def worked() -> tuple[Record, FloatArray]:
    """A record whose voltage steps every 20 samples, with its noise, and the voltage that was."""
    rng = np.random.default_rng(3)
    volts = np.repeat(rng.uniform(-9.0, 9.0, 20), 20)
    record = plain(400, volts, "late")
    shown = record.predict(VALUES, learn=False)[0][:, 2:4]
    return replace(record, readings=shown + rng.standard_normal((400, 2)) * [0.02, 0.5]), volts


@pytest.mark.parametrize("lag", [0.0, 1e-3])
def test_behind_an_unknown_voltage_the_model_is_as_sure_as_before(lag: float) -> None:
    record, volts = worked()
    lagging = VALUES.copy()
    lagging[index.LAG_I] = lag
    clean = record.predict(lagging, learn=False)[0][:, 2:4]
    readings = clean + np.random.default_rng(8).standard_normal((400, 2)) * [0.02, 0.5]
    steps = np.append(False, np.diff(volts) != 0.0)
    wrong = np.where(steps, -volts, volts)
    known, lied = replace(record, readings=readings), replace(record, readings=readings, voltage_v=wrong)
    marked = replace(lied, marks=with_holes(record.marks, steps, readings, BOTH))
    first, second, white = (one.predict(lagging)[0][:, :2] for one in (known, lied, marked))
    assert first.std() == pytest.approx(1.0, abs=0.1)
    assert second.std() > 5.0
    told = white[marked.informative & (marked.marks != BEGIN)[:, None]]
    assert told.std() == pytest.approx(1.0, abs=0.1)
    assert np.abs(told).max() < 4.5
    assert not white[~marked.informative].any()


def test_the_free_model_begins_again_behind_a_hole() -> None:
    record, volts = worked()
    hole = np.zeros(400, dtype=np.bool_)
    hole[200:260] = True
    readings = np.where(hole[:, None], np.nan, record.readings)
    guessed = np.where(hole, 0.0, volts)
    marked = replace(
        record, voltage_v=guessed, readings=readings, marks=with_holes(record.marks, hole, readings, BOTH)
    )
    table, logs = marked.predict(VALUES, learn=False)
    free = table[:, 2:4]
    # What is lost tells nothing of the noise: of the others each variance counts, with that of the first reading.
    counted = (marked.informative & (marked.marks != BEGIN)[:, None]).sum(axis=0)
    assert logs == pytest.approx(counted @ np.log(2.0 * np.square([0.02, 0.5])))
    assert np.nanmax(np.abs((free - record.readings)[262:] / [0.02, 0.5])) < 5.0
    changes = np.square(np.diff(guessed))
    seen = changes[marked.marks[1:] != LOST].sum() / changes.sum()
    assert marked.visible_step_share == pytest.approx(seen)
    assert 0.5 < seen < 0.95
    assert record.visible_step_share == 1.0


def test_a_mean_is_missing_where_more_than_a_tenth_of_it_is() -> None:
    recording = holed(80, [3, 25, 26], current=[45])
    assert missing_blocks(recording, 20)[:, 0].tolist() == [False, False, False, False]
    assert missing_blocks(recording, 10)[:, 0].tolist() == [False, False, True, *[False] * 5]
    assert missing_blocks(recording, 5)[:, 1].tolist() == [n == 9 for n in range(16)]
    assert not missing_blocks(replace(recording, missing=None), 7).any()


def test_a_voltage_less_that_of_a_shunt_is_missing_with_the_current() -> None:
    recording = holed(50, [3], current=[7])
    for ohm, lost in ((0.1, [3, 7]), (0.0, [3])):
        missing = at_terminals(recording, circuit=Circuit(shunt_ohm=ohm)).missing
        assert missing is not None
        assert np.flatnonzero(missing[:, 0]).tolist() == lost
