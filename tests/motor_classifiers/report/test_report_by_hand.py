"""Charts to the pixel on tiny examples, and what the page makes of made results."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import opened
from made_results import RECIPE, TASK, answer, decisions, made_results

# Reaches in: the page is drawn from results made by hand, in the types that the other rooms give it.
from motor_classifiers.report import page
from motor_classifiers.report.page import (
    Line,
    interval_chart,
    line_chart,
    readable,
    reliability_chart,
    share_axis,
    short,
)
from motor_classifiers.scoring.metrics import Reliability, Score
from motor_classifiers.scoring.score import Results
from motor_classifiers.scoring.task import class_task
from motor_env.common.pages import Axis


def shapes(chart: str, tag: str, style: str | None = None) -> list[list[float]]:
    """Numbers of each element of a tag, in the order in which they are written."""
    found = re.findall(rf"<{tag}((?: [a-z0-9-]+=\"[^\"]*\")*)>", chart)
    mine = [a for a in found if style is None or f'class="{style}"' in a]
    return [
        [float(v) for v in re.findall(r' (?:x|y|x1|y1|x2|y2|cx|cy|r|width|height)="([\d.-]+)"', a)]
        for a in mine
    ]


def test_intervals_stand_where_their_scores_say() -> None:
    bars = [("a", "torch", Score(0.80, 0.75, 0.85)), ("b", "own", Score(0.90, 0.88, 0.93))]
    chart = interval_chart(bars, 0.95, "limit: 95.0 %")

    def x(share: float) -> float:
        return round(170 + (760 - 54 - 170) * (share - 0.74) / (0.96 - 0.74), 1)

    assert 'viewBox="0 0 760 120"' in chart
    assert shapes(chart, "line", "limit") == [[x(0.95), 28.0, x(0.95), 90.0]]
    assert shapes(chart, "line", "range") == [[x(0.75), 48.0, x(0.85), 48.0], [x(0.88), 76.0, x(0.93), 76.0]]
    assert shapes(chart, "circle") == [[x(0.8), 48.0, 5.5], [x(0.9), 76.0, 5.5]]
    assert shapes(chart, "text", "limit-label") == [[round(x(0.95) + 4, 1), 21.0]]
    assert 'class="limit-label" text-anchor="end"' in chart
    assert shapes(chart, "text", "value") == [
        [pytest.approx(x(0.85) + 8, abs=0.11), 52.0],
        [pytest.approx(x(0.93) + 8, abs=0.11), 80.0],
    ]
    assert shapes(chart, "text", "name") == [[158.0, 52.0], [158.0, 80.0]]
    assert ">80.0</text>" in chart
    assert re.findall(r">(\d+ %)<", chart) == ["75 %", "80 %", "85 %", "90 %", "95 %"]
    low = interval_chart(bars, 0.76, "limit", width=440, left=166)
    assert re.findall(r">(\d+ %)<", low) == ["80 %", "90 %"]
    assert 'class="limit-label" text-anchor="middle"' in low
    top = interval_chart([("a", "own", Score(0.999, 0.99, 1.0))], 0.995, "limit")
    (point,) = shapes(top, "circle")  # the axis ends at 1
    assert point[0] == pytest.approx(170 + 536 * (0.999 - 0.98) / 0.02, abs=0.06)


def test_reliability_has_bars_of_one_error_and_dots_by_their_cases() -> None:
    binned = Reliability(
        np.array([0.6, np.nan, 0.9]), np.array([0.5, np.nan, 0.8]), np.array([25.0, 0.0, 100.0])
    )
    chart = reliability_chart(binned, 0.5)

    def x(share: float) -> float:
        return 34 + 148 * (share - 0.5) / 0.5

    def y(share: float) -> float:
        return 164 - 156 * (share - 0.5) / 0.5

    close = pytest.approx
    assert shapes(chart, "circle") == [
        close([x(0.6), y(0.5), 3.0], abs=0.06),
        close([x(0.9), y(0.8), 4.2], abs=0.06),
    ]
    first, second = shapes(chart, "line", "range")
    assert first == close([x(0.6), y(0.6), x(0.6), y(0.5)], abs=0.06)  # 0.4 lies below the axis
    assert second == close([x(0.9), y(0.84), x(0.9), y(0.76)], abs=0.06)
    assert shapes(chart, "line", "threshold") == [[34.0, 164.0, 182.0, 8.0]]
    assert "25 starts" in chart


@pytest.mark.parametrize(
    ("wanted", "expected"),
    [
        ([10.0, 12.0, 100.0], [10.0, 22.0, 60.0]),
        ([54.0, 50.0, 52.0], [60.0, 40.0, 50.0]),
        ([30.0, 1.0], [30.0, 4.0]),
        ([70.0], [60.0]),
    ],
)
def test_labels_move_no_further_than_they_must(wanted: list[float], expected: list[float]) -> None:
    """Ten apart between 4 and 60 pixels, of which a chart of this size has its own: by the places of the labels."""
    from motor_classifiers.report.page import _spread_out  # its arithmetic; the chart below shows its use

    assert _spread_out(wanted, 12.0 if wanted[0] == 10.0 else 10.0, 4.0, 60.0) == expected


def test_lines_end_at_their_labels() -> None:
    lines = [
        Line("one", "s0", [0.0, 5.0, 10.0], [0.5, 0.5, 1.0]),
        Line("two", "s1", [0.0, 5.0, 10.0], [0.5, 0.5, 1.0]),
    ]
    axes = Axis("x", 0.0, 10.0, [0.0, 10.0]), Axis("accuracy", 0.5, 1.0, [0.5, 1.0])
    chart = line_chart(lines, *axes)
    assert 'points="58.0,360.0 223.0,360.0 388.0,24.0"' in chart
    assert shapes(chart, "circle")[:3] == [[58.0, 360.0, 3.0], [223.0, 360.0, 3.0], [388.0, 24.0, 3.0]]
    assert shapes(chart, "line", "lead") == [[388.0, 24.0, 400.0, 28.0], [388.0, 24.0, 400.0, 41.0]]
    assert re.findall(r'x="([\d.]+)" y="([\d.]+)">(one|two)<', chart) == [
        ("403.0", "32.0", "one"),
        ("403.0", "45.0", "two"),
    ]
    assert "accuracy against x" in chart
    plain = line_chart(lines, axes[0], axes[1]._replace(title=""), named=False, marked=False)
    assert 'points="52.0,360.0 275.0,360.0 498.0,12.0"' in plain
    assert "<circle" not in plain
    low = line_chart([lines[0]._replace(y=[1.0, 1.0, 0.5])], *axes)
    assert shapes(low, "line", "lead") == [[388.0, 360.0, 400.0, 360.0]]
    assert (share_axis([0.6, 0.8]).low, share_axis([0.6, 0.8]).high) == pytest.approx((0.59, 0.81))
    assert share_axis([0.6, 0.995]).high == 1.0


def test_names_for_people() -> None:
    assert [readable(name) for name in ("healthy", "winding_contact_25", "bearing_2.5", "winding_short")] == [
        "healthy", "winding contact 25 %", "bearing 2.5 %", "winding short",
    ]  # fmt: skip
    assert [short(name) for name in ("healthy", "winding_contact_25", "bearing_10", "noise")] == [
        "ok",
        "WC 25",
        "B 10",
        "noi",
    ]


@pytest.fixture(scope="module")
def made() -> tuple[Any, Results]:
    """Two methods, one of which only decides; the limit errs on the first ten starts."""
    return made_results(
        answer(decisions(slice(0, 10)), 0.8125), threshold=answer(decisions(slice(5, 21))),
        residual_qda=answer(decisions(slice(2, 14)), 1.0), network=answer(decisions(slice(0, 13)), 0.5625),
    )  # fmt: skip


def test_the_page_is_given_what_was_scored(
    made: tuple[Any, Results], monkeypatch: pytest.MonkeyPatch
) -> None:
    given: dict[str, list[tuple[Any, ...]]] = {"interval": [], "reliability": []}
    for name, calls in given.items():

        def noted(*arguments: Any, calls: Any = calls, **options: Any) -> Any:
            calls.append((*arguments, options))
            return []

        monkeypatch.setattr(page, f"{name}_chart", noted)
    words: dict[str, Any] = {}

    def rendered(*_: Any, **context: Any) -> str:
        words.update(context)
        return "page"

    monkeypatch.setattr(page, "render", rendered)
    plan, plain = made
    peers = tuple(
        replace(plain.methods[n], name=name, answer=plain.methods[n].answer._replace(origin="elsewhere"))
        for n, name in ((0, "quant"), (2, "peer"))
    )
    assert page.render_report(plan, [replace(plain, methods=plain.methods + peers)], "a machine") == "page"
    assert not words["sweep"]
    assert (words["best_peer"].name, words["origins"]) == ("peer", ["elsewhere"])
    assert page.render_report(plan, [plain, plain], "a machine") == "page"
    sweep: Any = words["sweep"]
    assert sweep["settings"][0][0] == TASK
    for calls in given.values():
        calls.clear()
    assert page.render_report(plan, [plain], "a machine") == "page"
    assert [one.name for one in words["methods"]] == ["residual-qda", "network", "threshold"]
    assert words["best"].name == "residual-qda"
    assert words["best_peer"] is None
    assert (words["limit_name"], words["estimated"]) == ("Bayes limit", False)
    assert words["limit_expected"] == pytest.approx(0.8125)
    assert words["n_comparisons"] == 3
    assert words["significance"] == 0.01
    assert [name for name, _ in words["against"]] == ["network", "threshold"]
    between = words["against"][1][1]
    assert (between.only_first, between.only_second) == (3, 7)  # rows 2 .. 4, and 14 .. 20
    bars, limit, label, _ = given["interval"][0]
    assert [name for name, *_ in bars] == ["residual-qda", "network", "threshold"]
    assert (limit, label) == (pytest.approx(50 / 60), "Bayes limit on these motors: 83.3 %")
    assert [call[-1]["title"] for call in given["interval"][1:]] == ["Winding", "Bearing", "Severity"]
    assert given["interval"][2][1] == plain.limit.scores.bearing.value
    assert [one["name"] for one in words["confusions"]] == ["limit", "residual-qda", "network", "threshold"]
    shares = np.array(words["confusions"][0]["shares"])
    np.testing.assert_allclose(shares.sum(axis=1), 100.0)
    counts = plain.limit.scores.confusion
    np.testing.assert_allclose(shares, 100.0 * counts / counts.sum(axis=1, keepdims=True))
    # Confidences are 0.8125, 0.5625 and 0.75; what only decides has no curve.
    assert [one["name"] for one in words["reliability"]] == ["limit", "network", "threshold"]
    assert [call[1] for call in given["reliability"]] == pytest.approx([0.5] * 3)


def test_numbers_on_the_page() -> None:
    from motor_classifiers.report.page import _points, _quantity, _share  # the template's filters

    assert [_share(Score(value, 0, 0)) for value in (0.12345, 1.0, float("nan"))] == ["12.3", "100.0", "–"]
    assert [_points(value) for value in (1.234, -1.234, -0.004)] == ["1.23", "−1.23", "0.00"]
    assert [_quantity(value) for value in (19.94, 20.0, 123.4, 0.25, None, float("nan"))] == [
        "19.9",
        "20",
        "123",
        "0.2",
        "–",
        "–",
    ]


def noted_lines(monkeypatch: pytest.MonkeyPatch, module: Any) -> list[tuple[Any, ...]]:
    drawn: list[tuple[Any, ...]] = []

    def noted(lines: Any, x_axis: Axis, y_axis: Axis, **options: Any) -> str:
        drawn.append((lines, x_axis, y_axis, options))
        return "chart"

    monkeypatch.setattr(module, "line_chart", noted)
    return drawn


def test_a_sweep_is_drawn_by_size_and_by_noise(
    made: tuple[Any, Results], monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn = noted_lines(monkeypatch, page)
    plan, result = made

    def at(noise_a: float, n_train: int) -> Results:
        recipe = replace(RECIPE, sensor=replace(RECIPE.sensor, current_noise_a=noise_a))
        return replace(result, task=class_task(recipe, n_train, 60))

    told = page.sweep_section(plan, [at(0.02, 200), at(0.1, 200), at(0.02, 100), at(0.005, 200)])
    assert told["learning"] == told["noise"] == [{"title": "bench, 1 kHz", "chart": "chart"}]
    by_size, by_noise = drawn
    assert by_size[1]._replace(number=str) == Axis(
        "training starts", 100.0, 200.0, [100.0, 200.0], str, is_log=True
    )
    assert by_noise[1].ticks == pytest.approx([5.0, 20.0, 100.0])
    assert by_noise[1].title == "noise, mA"
    lines = {line.label: line for line in by_size[0]}
    assert list(lines) == ["threshold", "residual-qda", "network", "Bayes limit"]
    assert [line.style for line in lines.values()] == ["s0", "s1", "s2", "limit"]
    assert lines["threshold"].y == pytest.approx([44 / 60] * 2)
    assert lines["Bayes limit"].y == pytest.approx([50 / 60] * 2)
    assert (by_size[2].low, by_size[2].high) == pytest.approx((44 / 60 - 0.01, 50 / 60 + 0.01))
    alone = page.sweep_section(plan, [at(0.02, 200)])
    assert alone["learning"] == alone["noise"] == []
    assert len(alone["settings"]) == 1


def test_the_page_in_a_browser(made: tuple[Any, Results], tmp_path: Path) -> None:
    plan, result = made
    page.write_results(plan, [result], tmp_path)
    names = "[...document.querySelectorAll('table.sortable tbody')[0].rows].map((row) => row.cells[0].textContent)"
    with opened((tmp_path / "report.html").as_uri()) as browser:
        assert browser.value("document.querySelectorAll('svg').length") >= 3
        before = browser.value(names)
        browser.click("table.sortable th button")
        assert browser.value(names) == sorted(before, key=str.lower)
        browser.click("table.sortable th button")
        assert browser.value(names) == sorted(before, key=str.lower, reverse=True)
