"""A judgement as it is shown: status, text, JSON and pages."""

import math
import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from browser import opened
from judged_by_hand import CURRENT, EXAMPLES, SHEET, fitted, judged, of_one, start
from present import present

from motor_env import Diagnosis, Fault, FaultKind, Verdict, commission, diagnose, identify, read_recording
from motor_env.diagnosis.verdict import report_page, report_text
from motor_env.diagnosis.verdict.hypotheses import Change


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
    check = present(found.consistency)
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
        assert (row["value"], row["standard_error"]) == pytest.approx((value, error))
        assert row["unit"] == unit
        half = 1.96 * error / value  # the interval is even in the logarithm
        assert row["interval"] == pytest.approx([value * math.exp(-half), value * math.exp(half)])
        assert f"{value:.4g} +- {error:.2g} {unit}" in text
    assert told["parameters"]["onset_s"] == {"value": fit.onset_s, "unit": "s"}
    for number in (math.nan, math.inf):
        assert report_text.as_json(of_one(severity=number))["severity"] is None
    assert report_text.headline(of_one(confidence=None).decisive) == "healthy"


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


def test_pieces_stand_at_their_middles_on_one_axis_of_time() -> None:
    spans = [(0.0, 8.0), (8.0, 10.0), (30.0, 10.0)]
    change = Change("R", 1.1, 1.0, 1.2, "healthy")
    pieces = [replace(judged().decisive, begin_s=b, duration_s=d, changes=(change,)) for b, d in spans]
    html = report_page.pieces_chart([*pieces, replace(pieces[0], changes=())])
    found = [
        float(re.findall(r'cx="([-\d.]+)"', dot)[0])
        for dot in re.findall(r'<circle[^>]*class="dot"[^>]*>', html)
    ]
    assert found == pytest.approx(
        [66.0 + 382.0 * (begin + 0.5 * length) / 40.0 for begin, length in spans], abs=0.1
    )


def test_fits_are_shown_with_what_goes_together() -> None:
    found = identify(EXAMPLES / "startup_capture.csv")
    ((_, fit),) = found.starts
    labels = re.findall(r'aria-label="([^"]*)"', found.page())
    assert labels == ["Current, measured and fitted", "Current: residual"]
    assert found.parameters["L"]["standard_error"] == pytest.approx(fit.standard_errors[1])
    sd = np.sqrt(np.diag(fit.log_covariance))
    correlation = fit.log_covariance / np.outer(sd, sd)
    np.testing.assert_allclose(found.to_json()[0]["correlations"], correlation, rtol=1e-9)
    assert f"L with R {correlation[1, 0]:+.2f}" in repr(found)


def test_a_page_of_a_commissioning_has_a_dot_for_each_piece() -> None:
    example = read_recording(EXAMPLES / "startup_capture.csv")
    starts = [replace(example, path=Path(f"{n}.csv"), current_a=n * example.current_a) for n in (1.0, 1.1)]
    html = commission(starts, fewest=2).page()
    (spread,) = re.findall(r'aria-label="Deviation of each quantity.*?</svg>', html, re.DOTALL)
    assert (spread.count('class="interval"'), spread.count('class="dot"')) == (4, 8)
    assert "Healthy start 2" in html


Answers = tuple[str, str, str]


@cache
def shown(case: str) -> Diagnosis:
    """The five captures of the technician's test."""
    healthy = start()
    recordings = {
        "healthy": healthy,
        "bearing": start(Fault(FaultKind.BEARING, 0.5)),
        "both": start(Fault(FaultKind.WINDING_CONTACT, 0.4), Fault(FaultKind.BEARING, 0.8)),
        "short": start(Fault(FaultKind.WINDING_SHORT, 0.12)),
        "clipped": replace(healthy, current_a=np.minimum(healthy.current_a, 2.5)),
        "probe": replace(healthy, current_a=10.0 * healthy.current_a),
    }
    return diagnose(recordings[case], SHEET)


# Written before the pages were: what is wrong, how much of it, what to do next.
ANSWERS: dict[str, Answers] = {
    "healthy": ("Healthy", "more friction (2[0-9]|30)%", "Nothing to do"),
    "bearing": (
        "More friction: bearing, lubricant or load",
        "Friction up by (4|5)[0-9]%",
        "turn the shaft by hand",
    ),
    "both": (
        "More friction: bearing, lubricant or load, and: Winding or brushes",
        "Friction up by [78][0-9]%.*; Winding resistance up by [34][0-9]%",
        "turn the shaft by hand.*measure the resistance",
    ),
    "short": ("Winding: shorted turns", "1[0-9]% of the turns shorted", "Measure the resistance"),
    "clipped": ("This recording cannot be judged", "clipped", "Record again"),
    "probe": ("Something changed", "R is down by 90%", "the probe.s scale"),
}


@pytest.mark.parametrize("case", list(ANSWERS))
def test_a_technician_finds_verdict_size_and_next_action(case: str) -> None:
    html = report_page.page(shown(case))
    assert html.count("<html") == 1
    assert "NIS" not in html.partition("<details")[0]  # numbers of experts lie behind the fold
    assert "http" not in html.replace("http-equiv", "")  # nothing is loaded from elsewhere
    above_the_fold = re.sub(
        r"<details.*?</details>|<style.*?</style>|<svg.*?</svg>", " ", html, flags=re.DOTALL
    )
    text = " ".join(re.sub(r"<[^>]+>", " ", above_the_fold).replace("&#39;", "'").split())
    for answer in ANSWERS[case]:
        assert re.search(answer, text), (answer, text)
    verdict, _, action = (re.search(answer, text) for answer in ANSWERS[case])
    assert verdict is not None
    assert action is not None
    assert verdict.start() < action.start() < 900  # on the first screen


def test_the_page_says_whether_the_motor_may_run_on() -> None:
    assert set(report_page.RUN_ON_TEXTS) >= set(Verdict)
    words_of = {"healthy": "It may run on.", "short": "It should not run on", "probe": "Not known: stop it"}
    for case, words in words_of.items():
        assert f"<b>May it run on?</b> {words}" in report_page.page(shown(case))


def test_a_page_shows_hostile_names_as_text() -> None:
    recording = replace(start(), path=Path("<script>alert(1)</script>.csv"), columns=("<b>read</b>",))
    html = report_page.page(diagnose(recording))
    assert "<script>" not in html
    assert "<b>read" not in html
    assert "Nothing to compare with" in html


def test_the_page_in_a_browser(tmp_path: Path) -> None:
    (tmp_path / "page.html").write_text(report_page.page(shown("bearing")), encoding="utf-8")
    with opened((tmp_path / "page.html").as_uri()) as browser:
        assert browser.value("document.querySelector('h1').innerText").startswith("More friction")
        is_shown = "document.querySelector('details pre').checkVisibility()"
        assert not browser.value(is_shown)
        browser.click("details summary")
        browser.wait(is_shown)
        assert browser.value("document.documentElement.scrollWidth <= window.innerWidth")
