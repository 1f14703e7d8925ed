"""Charts: where values stand, and at which numbers the ticks are."""

import pytest

from motor_env.pages.svg import Axis, Chart, percent, round_ticks


def test_places_on_plain_logarithmic_and_reversed_axes() -> None:
    plain = Axis("ms", 0.0, 100.0, [0.0, 100.0])
    assert [plain.place(value) for value in (0.0, 25.0, 100.0, 130.0)] == [0.0, 0.25, 1.0, 1.0]
    assert plain._replace(is_reversed=True).place(25.0) == 0.75
    log = Axis("wrong", 0.001, 1.0, [], percent, is_log=True)
    assert log.place(0.001) == 0.0
    assert log.place(0.1) == pytest.approx(2.0 / 3.0)
    assert log.place(1e-9) == 0.0
    assert (plain.number(20.0), log.number(0.002), log.number(0.5)) == ("20", "0.2 %", "50 %")


def test_ticks_are_round_and_inside() -> None:
    assert round_ticks(0.03, 0.97, 5) == pytest.approx([0.2, 0.4, 0.6, 0.8])
    assert round_ticks(-1.0, 1.0, 4) == [-1.0, -0.5, 0.0, 0.5, 1.0]
    assert round_ticks(7.0, 7.0) == [7.0]


def test_text_is_escaped_and_up_is_up() -> None:
    chart = Chart(
        Axis("x", 0.0, 1.0), Axis("y", 0.0, 1.0), size=(100, 50), margins=(10, 20, 5, 15), label="a < b"
    )
    assert (chart.x(0.0), chart.x(1.0), chart.y(0.0), chart.y(1.0)) == (10, 80, 35, 5)
    chart.text((1.0, 2.0), "<script>")
    assert "<script" not in chart.svg()
    assert 'aria-label="a &lt; b"' in chart.svg()
