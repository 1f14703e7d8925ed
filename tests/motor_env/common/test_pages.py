"""Charts: where values stand, and at which numbers the ticks are."""

import pytest

from motor_env.common.pages import Axis, Chart, percent, round_ticks


def test_places_on_plain_logarithmic_and_reversed_axes() -> None:
    plain = Axis("ms", 0.0, 100.0, [0.0, 100.0])
    assert [plain.place(value) for value in (0.0, 25.0, 100.0, 130.0)] == [0.0, 0.25, 1.0, 1.0]
    assert plain._replace(is_reversed=True).place(25.0) == 0.75
    assert plain._replace(is_reversed=True, low=20.0).place(40.0) == 0.75
    assert plain._replace(low=-100.0).place(50.0) == 0.75
    assert plain._replace(low=100.0).place(100.0) == 0.0  # a range of nothing
    log = Axis("wrong", 0.001, 1.0, [], percent, is_log=True)
    assert log.place(0.001) == 0.0
    assert log.place(0.1) == pytest.approx(2.0 / 3.0)
    assert log.place(1e-9) == 0.0
    assert (plain.number(20.0), log.number(0.002), log.number(0.5)) == ("20", "0.2 %", "50 %")


@pytest.mark.parametrize(
    ("low", "high", "most", "ticks"),
    [
        (0.0, 5.0, 5, [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]),  # a range of just `most` steps of each size
        (0.0, 10.0, 5, [0.0, 2.0, 4.0, 6.0, 8.0, 10.0]),
        (0.0, 5.03, 5, [0.0, 2.0, 4.0]),
        (0.0, 10.06, 5, [0.0, 5.0, 10.0]),
        (0.03, 0.97, 5, [0.2, 0.4, 0.6, 0.8]),
        (-30.0, -10.0, 2, [-30.0, -20.0, -10.0]),
        (1.1, 1.5, 5, [1.1, 1.2, 1.3, 1.4, 1.5]),
        (1.1e3, 2.9e3, 4, [1500.0, 2000.0, 2500.0]),
    ],
)
def test_steps_are_one_two_or_five(low: float, high: float, most: int, ticks: list[float]) -> None:
    """The smallest step of which no more than `most` fit; a tick on an end is inside, in spite of rounding."""
    assert round_ticks(low, high, most) == pytest.approx(ticks, rel=1e-12)
    assert "-0.0" not in map(str, round_ticks(low, high, most))
    assert "-0.0" not in map(str, round_ticks(-high, -low, most))


def test_shapes_stand_where_their_values_are() -> None:
    chart = Chart(
        Axis("x", 2.0, 12.0, [2.0, 7.0]),
        Axis("y", -1.0, 2.0, [0.5], percent),
        size=(100, 50),
        margins=(10, 20, 5, 15),
        label="a < b",
    )
    chart.curve("a", [2.0, 7.0, 12.0], [-1.0, 0.0, 2.0])
    chart.across("b", 0.0)
    chart.upright("c", 4.0)
    chart.line("d", (1.0, 2.0), (3.0, 4.0))
    chart.dot("e", (1.0, 2.0), 3.0, "<t>")
    chart.shape("path", content="<g/>", d="M 0 0")
    with chart.group("f", "now"):
        chart.text((1.0, 2.0), "t", "g", anchor="end")
    chart.x_numbers(grid=True)
    chart.y_numbers()
    assert chart.svg() == (
        '<svg viewBox="0 0 100 50" role="img" aria-label="a &lt; b">'
        '<polyline class="a" points="10.0,35.0 45.0,25.0 80.0,5.0"></polyline>'
        '<line class="b" x1="10.0" y1="25.0" x2="80.0" y2="25.0"></line>'
        '<line class="c" x1="24.0" y1="5.0" x2="24.0" y2="35.0"></line>'
        '<line class="d" x1="1.0" y1="2.0" x2="3.0" y2="4.0"></line>'
        '<circle class="e" cx="1.0" cy="2.0" r="3.0"><title>&lt;t&gt;</title></circle>'
        '<path d="M 0 0"><g/></path>'
        '<g class="f"><title>now</title><text class="g" text-anchor="end" x="1.0" y="2.0">t</text></g>'
        '<line class="grid" x1="10.0" y1="5.0" x2="10.0" y2="35.0"></line>'
        '<text class="tick" text-anchor="middle" x="10.0" y="53.0">2</text>'
        '<line class="grid" x1="45.0" y1="5.0" x2="45.0" y2="35.0"></line>'
        '<text class="tick" text-anchor="middle" x="45.0" y="53.0">7</text>'
        '<line class="grid" x1="10.0" y1="20.0" x2="80.0" y2="20.0"></line>'
        '<text class="tick" text-anchor="end" x="4.0" y="24.0">50 %</text>'
        "</svg>"
    )
