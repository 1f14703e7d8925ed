"""Machine and motor, read from names of files."""

from pathlib import Path

import pytest

from motor_env.common.errors import InputError
from motor_env.diagnosis.fleet.learning import UnitId, unit_ids

GROUP = r"(?P<machine>\d+)(_(?P<repeat>[a-z]+))?_(?P<motor>left|right)"


def test_each_file_is_a_machine_without_a_group() -> None:
    assert unit_ids([Path("a/one.csv"), Path("b/two.csv")], None) == [UnitId("one"), UnitId("two")]


@pytest.mark.parametrize(
    ("name", "place"),
    [
        ("robot_07_left.csv", UnitId("07", "left")),
        ("robot_07_b_left.csv", UnitId("07", "left")),
        ("robot_86_dagmar_right.csv", UnitId("86", "right")),
    ],
)
def test_a_repeat_is_the_same_motor(name: str, place: UnitId) -> None:
    assert unit_ids([Path(name)], GROUP) == [place]
    assert place.name == f"{place.machine} {place.motor}"


def test_motors_alone_are_machines_of_one_motor() -> None:
    assert unit_ids([Path("pump_3_b.csv")], r"_(?P<motor>\d)_(?P<repeat>[a-z])") == [UnitId("3")]


@pytest.mark.parametrize(
    ("group", "words"),
    [
        ("(", "must be a regular expression, got '\\('"),
        ("robot", "must have named groups of machine, motor, repeat"),
        ("(?P<side>left)", "must have named groups of machine, motor, repeat, got \\['side'\\]"),
        ("(?P<repeat>left)", "a repeat alone names no motor"),
        ("(?P<machine>[0-9]{3})", "robot_07_left.csv: --group .* does not match its name"),
    ],
)
def test_what_cannot_be_read_is_refused(group: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        unit_ids([Path("robot_07_left.csv")], group)
