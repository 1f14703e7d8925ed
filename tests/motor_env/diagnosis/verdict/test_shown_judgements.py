"""A judgement as it is shown: status, text, JSON and pages."""

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from judged_by_hand import CURRENT, EXAMPLES, EXPONENTS, SHEET, fitted, judged, moved, of_one
from scipy import stats

from motor_env import (
    Diagnosis,
    FaultKind,
    Verdict,
    commission,
    diagnose,
    identify,
    read_recording,
)
from motor_env.cli import main

# Reaches in: fits are altered by hand.
from motor_env.diagnosis.estimation.starts.start_fit import StartFit
from motor_env.diagnosis.file_verdicts import page_path
from motor_env.diagnosis.readers.noise import PeriodicLine
from motor_env.diagnosis.verdict import report_page, report_text
from motor_env.diagnosis.verdict.hypotheses import (
    Change,
    joint_share,
)


def test_every_other_verdict_is_a_fault() -> None:
    calm = {Verdict.HEALTHY: 0, Verdict.NO_REFERENCE: 3, Verdict.UNUSABLE: 3}
    assert {one: one.status for one in Verdict} == dict.fromkeys(Verdict, 1) | calm
    assert [one for one in Verdict if not one.is_fault] == list(calm)


def faulty() -> Diagnosis:
    changes = (Change("R", 1.2, 1.1, 1.31, "moved"), Change("B/J", 0.95, 0.9, 1.0, "undecided"))
    return of_one(
        verdict=Verdict.WINDING,
        fault_kind=FaultKind.WINDING_CONTACT,
        kind_probability=0.95,
        severity=0.2,
        severity_interval=(0.1, 0.31),
        confidence=0.876,
        changes=changes,
        smallest_changes={"bearing": 0.123, "winding_contact": 0.045},
    )


def test_text_and_json_say_the_same() -> None:
    found, fit, _ = fitted()
    check = found.consistency
    assert check is not None
    told, text = report_text.as_json(faulty()), report_text.as_text(faulty(), verbose=True)
    said = "winding (winding_contact) +20% (95 %: +10% to +31%), confidence 0.88"
    assert text.splitlines()[0] == f"start.csv: {said}"
    unsure = replace(faulty().decisive, kind_probability=0.94)
    assert report_text.headline(unsure) == said.replace(" (winding_contact)", "")
    bearing = replace(faulty().decisive, verdict=Verdict.BEARING, fault_kind=FaultKind.BEARING)
    assert report_text.headline(bearing).startswith("bearing +20%")
    assert "R            " in text
    assert "+20.0% from the reference (95 %: +10.0% to +31.0%)\n" in text
    assert "-5.0% from the reference (95 %: -10.0% to +0.0%), undecided\n" in text
    assert "\n  taken for a start (the voltage is switched on)\n" in text
    assert "bearing 12%, winding_contact 4% (bearing: of the motor's own friction)" in text
    assert f"judged by the filter's innovations; sensor noise {fit.noise_a:.3g} A\n" in text
    assert f"(NIS) {check.mean_square:.2f}\n" in text
    expected = {
        "file": "start.csv", "verdict": "winding", "kind": "winding_contact", "severity": 0.2,
        "severity_interval": [0.1, 0.31], "confidence": 0.876, "r2_current": fit.r2_current, "r2_speed": None,
        "mean_nis": check.mean_square, "sensor_noise_a": fit.noise_a,
        "model": ["textbook", *fit.model], "reference": found.reference and found.reference.source,
        "smallest_changes": {"bearing": 0.123, "winding_contact": 0.045}, "residual_autocorrelation": fit.lag_one,
        "consistent": True, "columns": ["read so"], "pieces_of_recording": 1,
        "taken_for": {"regime": "start", "why": "the voltage is switched on"},
    }  # fmt: skip
    assert {name: told[name] for name in expected} == expected
    assert told["changes"] == {
        "R": {"verdict": "moved", "ratio": 1.2, "interval": [1.1, 1.31]},
        "B/J": {"verdict": "undecided", "ratio": 0.95, "interval": [0.9, 1.0]},
    }
    (piece,) = told["pieces"]
    begin, length = piece.pop("begin_s"), piece.pop("duration_s")
    time_s = judged().recording.time_s
    assert (begin, length) == pytest.approx((time_s[0], len(time_s) * judged().recording.dt_s))
    assert piece == {name: told[name] for name in piece}
    assert set(piece) == {
        "verdict", "kind", "severity", "severity_interval", "confidence", "also", "reasons", "changes",
        "smallest_changes",
    }  # fmt: skip
    units = ("ohm", "H", "V/(A s)", "1/s")
    for name, value, error, unit in zip(CURRENT, fit.values, fit.standard_errors, units, strict=True):
        row = told["parameters"][name]
        assert (row["value"], row["standard_error"], row["unit"]) == (
            pytest.approx(value),
            pytest.approx(error),
            unit,
        )
        half = 1.96 * error / value  # the interval is even in the logarithm
        assert row["interval"] == pytest.approx([value * math.exp(-half), value * math.exp(half)])
        assert f"{value:.4g} +- {error:.2g} {unit}" in text
    assert told["parameters"]["onset_s"] == {"value": fit.onset_s, "unit": "s"}
    assert told["parameters"]["offset_a"] == {"value": fit.offset_a, "unit": "A"}
    assert report_text.describe_friction_share(0.4).endswith("own friction, 40% of the drag")
    assert of_one(severity_interval=(0.1, 0.31)).severity_interval == (0.1, 0.31)
    for number in (math.nan, math.inf):
        assert report_text.as_json(of_one(severity=number))["severity"] is None
    assert report_text.headline(of_one(confidence=None).decisive) == "healthy"


def test_something_else_names_what_moved_most() -> None:
    found = moved(0.0, 0.0, -0.5, 0.0)
    assert found.verdict is Verdict.OTHER
    assert found.reasons[0].startswith("K^2/J is down by 39% (-")
    assert "K down looks the same as J and B up" in found.reasons[0]
    assert found.confidence is not None
    assert found.severity is None


def drawn(html: str, name: str) -> list[tuple[float, ...]]:
    """Numbers of the pieces of a class."""
    found = re.findall(rf'<(?:line|circle)[^>]*class="{name}"[^>]*>', html)
    return [tuple(map(float, re.findall(r'(?:x1|x2|cx|y1|y2|cy)="([-\d.]+)"', one))) for one in found]


@pytest.mark.parametrize(("high", "edge"), [(1.5, 1.65), (1.01, 1.1 * 1.01), (30.0, 8.0)])
def test_bars_stand_on_a_logarithmic_axis_a_tenth_wider_than_they_are(high: float, edge: float) -> None:
    changes = (Change("R", 1.005, 0.995, high, "healthy"), Change("B/J", 1.0, 0.999, 1.001, "moved"))
    html = report_page.page(of_one(changes=changes))
    edge = max(edge, 1.1)

    def x(ratio: float) -> float:
        return 150.0 + (480.0 - 150.0 - 64.0) * (math.log(ratio) / math.log(edge) + 1.0) / 2.0

    low, height, end, _ = drawn(html, "interval")[0]
    assert low == pytest.approx(x(0.995), abs=0.1)
    assert end == pytest.approx(x(high) if high < edge else end, abs=0.1)
    assert drawn(html, "dot")[0] == pytest.approx((x(1.005), height), abs=0.1)
    assert [dot[1] for dot in drawn(html, "dot")] == [17.0, 51.0]


def test_pieces_stand_at_their_middles_on_one_axis_of_time() -> None:
    """From the begin of the first to the end of the last; of quantities that the first and the last have."""
    ratios = [(0.0, 8.0, 1.5), (8.0, 10.0, 1.0), (30.0, 10.0, 0.8)]
    pieces = [
        replace(
            judged().decisive,
            begin_s=begin,
            duration_s=length,
            changes=(
                Change("R", ratio, 0.9 * ratio, 1.1 * ratio, "healthy"),
                Change("L" if begin else "B/J", 1.0, 0.99, 1.01, "healthy"),
            ),
        )
        for begin, length, ratio in ratios
    ]
    silent = replace(pieces[1], changes=(), begin_s=99.0)
    html = report_page.pieces_chart([*pieces[:2], silent, pieces[2]])
    assert html.count("<svg") == 1
    edge = math.log(1.1 * 1.65)
    spots = [66.0 + 382.0 * (begin + 0.5 * length) / 40.0 for begin, length, _ in ratios]

    def y(ratio: float) -> float:
        return 102.0 - 78.0 * (math.log(ratio) / edge + 1.0) / 2.0

    for spot, (*_, ratio), dot, line in zip(
        spots, ratios, drawn(html, "dot"), drawn(html, "interval"), strict=True
    ):
        assert dot == pytest.approx((spot, y(ratio)), abs=0.1)
        assert line == pytest.approx((spot, y(0.9 * ratio), spot, y(1.1 * ratio)), abs=0.1)
    assert report_page.pieces_chart([silent]) == ""


def test_the_residuals_band_and_edge() -> None:
    """Averaged over a fiftieth; the axis reaches 1.2 times what 98 of 100 samples after the start lie within."""
    found, fit, _ = fitted()
    ripple = PeriodicLine(30.0, 0.05, 0.02)  # so slow that the mean over a fiftieth shows it
    fit = replace(fit, start=replace(fit.start, lines=(ripple,)))
    found = replace(found, fit=fit)
    expected = report_page.reference_current(found)
    assert expected is not None
    beyond_ = fit.start.current_a - fit.start.ripple_a - expected
    span = len(beyond_) // 50
    padded = np.pad(beyond_, (span // 2, span - 1 - span // 2), "reflect")
    smooth = np.convolve(padded, np.full(span, 1.0 / span), "valid")
    time_ms = 1e3 * (fit.start.time_s - fit.onset_s)
    begin = np.searchsorted(time_ms, -0.02 * time_ms[-1])
    shown = slice(begin, None, max((len(time_ms) - begin) // 700, 1))
    noise = 2.0 * fit.noise_a / math.sqrt(span)
    largest = max(np.quantile(np.abs(smooth[shown][time_ms[shown] > 0.0]), 0.98), 2.0 * noise)
    html = (
        report_page.page(of_one(fit=fit))
        .split('aria-label="Measured less healthy current')[1]
        .split("</svg>")[0]
    )
    ticks = [(float(y), float(value)) for y, value in re.findall(r'y="([-\d.]+)"[^>]*>([-\d.]+) mA<', html)]
    (y0, v0), (y1, v1) = ticks[0], ticks[-1]
    per_pixel = (v1 - v0) / (y0 - y1)
    # 194 pixels between the margins show the edges and a tenth beyond.
    assert per_pixel * 194.0 == pytest.approx(2.0 * 1.1 * 1.2 * 1e3 * largest, rel=0.01)
    at = {float(t): float(x) for x, t in re.findall(r'x="([-\d.]+)"[^>]*>([-\d.]+) ms<', html)}
    first, last = min(at), max(at)
    begin_ms = first - (at[first] - 66.0) * (last - first) / (at[last] - at[first])
    assert begin_ms == pytest.approx(
        -0.02 * time_ms[-1], abs=0.2
    )  # a fiftieth of the recording before the start
    corners = re.findall(r'<polygon[^>]*points="([^"]+)"', html)[0].split()
    ys = [float(corner.split(",")[1]) for corner in corners]
    assert (max(ys) - min(ys)) * per_pixel == pytest.approx(2.0 * 1e3 * noise, rel=0.02)


@pytest.mark.parametrize(
    ("high", "ticks"),
    [
        (30.0, {-75, 0, 300}),
        (4.0, {-75, -50, 0, 100, 300}),
        (2.0, {-50, -25, 0, 50, 100}),
        (1.5, {-25, 0, 25, 50}),
        (1.23, {-25, 0, 25}),
        (1.12, {-10, 0, 10}),
        (1.03, {-10, -5, 0, 5, 10}),
    ],
)
def test_ticks_of_the_bars(high: float, ticks: set[int]) -> None:
    """The most welcome ones that lie more than 0.36 of the axis' half apart."""
    html = report_page.page(of_one(changes=(Change("R", 1.005, 0.995, high, "undecided"),)))
    bars = html.split('aria-label="Deviation of each quantity')[1].split("</svg>")[0]
    assert set(map(int, re.findall(r">([-+]\d+) %<", bars))) == ticks


def test_words_of_the_page() -> None:
    html = report_page.page(faulty())
    assert "Winding resistance up by 20%, between 10% and 31%" in html
    assert "88% sure" in html
    assert "over 99 % sure" in report_page.page(of_one(confidence=0.991))
    assert "99% sure" in report_page.page(of_one(confidence=0.99))
    assert "more friction" in html
    assert "12%" in html


@pytest.mark.parametrize(
    ("said", "telling"),
    [
        ([("healthy", 0.9), ("bearing", 0.8), ("winding", 0.99), ("bearing", 0.85)], 3),
        ([("winding", 0.7), ("bearing", 0.8)], 1),
        ([("bearing", None), ("magnet", 0.9), ("bearing", 0.5), ("unusable", None)], 2),
        ([("unusable", None), ("healthy", 0.6), ("healthy", 0.9)], 1),
        ([("no_reference", None), ("unusable", None)], 0),
        ([("healthy", 0.9), ("other", None)], 1),
    ],
)
def test_the_piece_that_a_verdict_rests_on(said: list[tuple[str, float | None]], telling: int) -> None:
    """The surest of the most frequent fault; without a fault a healthy one, else the first."""
    pieces = tuple(
        replace(judged().decisive, verdict=Verdict(word), confidence=sure, begin_s=float(n))
        for n, (word, sure) in enumerate(said)
    )
    found = replace(judged(), pieces=pieces, of=9)
    assert found.decisive is pieces[telling]
    assert (found.verdict, found.confidence) == (Verdict(said[telling][0]), said[telling][1])
    told = report_text.as_json(found)
    assert (told["verdict"], told["pieces_of_recording"]) == (said[telling][0], 9)
    assert [(one["verdict"], one["confidence"]) for one in told["pieces"]] == said
    first, *lines = report_text.as_text(found).splitlines()
    same = sum(word == said[telling][0] for word, _ in said)
    assert first.endswith(f"; {same} of {len(said)} starts judged, of 9")
    marked = [line for line in lines if line.endswith(" <")]
    assert [line.startswith(f"  from {telling} s: {said[telling][0]}") for line in marked] == [True]


def test_a_page_of_fits_shows_what_was_measured_beside_it() -> None:
    found = identify(EXAMPLES / "startup_capture.csv")
    ((recording, fit),) = found.starts
    charts = re.findall(r'aria-label="([^"]*)"(.*?)</svg>', found.page())
    assert [label for label, _ in charts] == ["Current, measured and fitted", "Current: residual"]
    heights = {
        style: np.array([float(point.split(",")[1]) for point in points.split()])
        for _, chart in charts
        for style, points in re.findall(r'<polyline class="(\w+)" points="([^"]*)"', chart)
    }
    kept = slice(None, None, len(recording.time_s) // 700)
    measured = np.asarray(fit.start.current_a)[kept]
    assert np.corrcoef(measured, -heights["measured"])[0, 1] > 0.99999
    assert np.corrcoef(fit.expected[kept, 0], -heights["healthy"])[0, 1] > 0.99999
    assert np.corrcoef(measured - fit.expected[kept, 0], -heights["beyond"])[0, 1] > 0.999


def test_a_page_of_a_commissioning_has_a_dot_for_each_piece() -> None:
    example = read_recording(EXAMPLES / "startup_capture.csv")
    starts = [replace(example, path=Path(f"{n}.csv"), current_a=n * example.current_a) for n in (1.0, 1.1)]
    html = commission(starts, fewest=2).page()
    (spread,) = re.findall(r'aria-label="Deviation of each quantity.*?</svg>', html, re.DOTALL)
    assert (spread.count('class="interval"'), spread.count('class="dot"')) == (4, 8)
    assert "Healthy start 2" in html


def test_names_of_pages_are_numbered() -> None:
    assert page_path(Path("a.b/c.d.csv"), Path("out"), 7) == Path("out/007-c-d-csv.html")
    assert len(page_path(Path("x" * 99), Path("out"), 7).stem) == 4 + 50


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--false-alarm-rate", "0.5"], "false-alarm-rate must lie between 0 and 0.5, got 0.5"),
        (["--false-alarm-rate", "0"], "false-alarm-rate must lie between 0 and 0.5, got 0"),
        (["--ripple-periods-per-turn", "0"], "ripple-periods-per-turn must be > 0"),
    ],
)
def test_options_out_of_range_are_one_sentence(
    options: list[str], sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["diagnose", str(EXAMPLES / "startup_capture.csv"), *options]) == 2
    assert sentence in capsys.readouterr().err


def test_a_false_alarm_rate_reaches_the_tests(capsys: pytest.CaptureFixture[str]) -> None:
    """A smaller rate asks for larger changes: in the ratio of their limits."""
    smallest = {}
    for rate in ("0.01", "0.2", ""):
        command = ["diagnose", str(EXAMPLES / "startup_capture.csv"), "--motor", str(EXAMPLES / "motor.toml")]
        main([*command, *(["--false-alarm-rate", rate] if rate else []), "--json"])
        (told,) = json.loads(capsys.readouterr().out)
        smallest[rate] = math.log1p(told["smallest_changes"]["bearing"])
    one = diagnose(read_recording(EXAMPLES / "startup_capture.csv"), SHEET)  # the library's own default
    assert smallest[""] == smallest["0.01"] == math.log1p(one.decisive.smallest_changes["bearing"])
    (judgement,) = one.pieces
    assert isinstance(judgement.identified, StartFit)
    assert judgement.reference is not None
    covariance = judgement.identified.log_covariance + judgement.reference.log_covariance
    shares = {rate: joint_share(0.8 * float(rate), covariance, EXPONENTS, 1e6) for rate in ("0.01", "0.2")}
    limits = {rate: stats.norm.isf(share) + 1.645 for rate, share in shares.items()}
    expected = limits["0.01"] / limits["0.2"]
    assert smallest["0.01"] / smallest["0.2"] == pytest.approx(expected, rel=1e-4)
