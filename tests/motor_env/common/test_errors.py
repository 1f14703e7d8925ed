"""What the commands refuse, the functions behind them refuse, in the same sentence and before a file is read."""

import math
from collections.abc import Callable

import pytest

from motor_env import InputError, commission, diagnose, identify
from motor_env.common.errors import require_options


@pytest.mark.parametrize("value", [-1.0, 0.0, math.inf, math.nan])
@pytest.mark.parametrize(
    ("function", "option", "name"),
    [
        (diagnose, "periods_per_turn", "ripple-periods-per-turn"),
        (diagnose, "voltage_v", "voltage"),
        (diagnose, "false_alarm_rate", "false-alarm-rate"),
        (identify, "periods_per_turn", "ripple-periods-per-turn"),
        (identify, "voltage_v", "voltage"),
        (identify, "constant", "torque-constant"),
        (commission, "voltage_v", "voltage"),
        (commission, "constant", "torque-constant"),
        (commission, "no_load_current_a", "no-load-current"),
        (commission, "window_s", "window"),
        (commission, "false_alarm_rate", "false-alarm-rate"),
    ],
)
def test_options_out_of_range_are_refused(
    function: Callable[..., object], option: str, name: str, value: float
) -> None:
    files = "none.csv" if function is diagnose else ["none.csv"]
    with pytest.raises(InputError, match=rf"^{name} must (be > 0|lie between 0 and 0\.5), got {value:g}$"):
        function(files, **{option: value})


def test_options_at_their_bounds() -> None:
    require_options(false_alarm_rate=1e-300, voltage=1e-300, window=None)
    require_options(false_alarm_rate=math.nextafter(0.5, 0.0))
    with pytest.raises(InputError):
        require_options(false_alarm_rate=0.5)


def test_a_sentence_is_one_line_and_has_an_end() -> None:
    assert str(InputError("a\nb\u2028c")) == "a b c"
    assert str(InputError("x" * 1000)) == "x" * 1000
    assert str(InputError("x" * 1001)) == "x" * 1000 + " ..."
