"""Trends and remaining life: against closed forms and simulation."""

import json
import math
import re
from collections import Counter
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import invgauss
from trend_laws import verdicts

from motor_env import InputError
from motor_env.cli import main
from motor_env.diagnosis.prognosis.degradation import first_passage_cdf, fit_degradation
from motor_env.diagnosis.prognosis.trend import Series, judge, parse_limits
from motor_env.diagnosis.prognosis.trend_report import Trends, date_of, read_estimates


def array(*values: float) -> np.ndarray:
    return np.array(values)


def test_first_passage_of_a_known_drift_is_inverse_gaussian() -> None:
    life = np.geomspace(0.1, 100.0, 50)
    distance, drift, diffusion = 2.0, 0.3, 0.5
    found = first_passage_cdf(life, array(distance), array(drift), array(0.0), array(diffusion))
    scale = distance**2 / diffusion**2
    np.testing.assert_allclose(found, invgauss.cdf(life, distance / drift / scale, scale=scale), atol=1e-12)


@pytest.mark.parametrize(("drift", "variance"), [(0.3, 0.01), (-0.2, 0.04), (0.3, 0.0), (0.0, 0.25)])
def test_first_passage_of_a_gaussian_drift_is_the_mixture(drift: float, variance: float) -> None:
    life = np.geomspace(0.05, 200.0, 40)
    z = np.linspace(-9.0, 9.0, 6001)
    weights = np.exp(-0.5 * z**2)
    each = first_passage_cdf(
        life[:, None], array(2.0), drift + math.sqrt(variance) * z, array(0.0), array(0.6)
    )
    closed = first_passage_cdf(life, array(2.0), array(drift), array(variance), array(0.6))
    np.testing.assert_allclose(closed, each @ weights / weights.sum(), atol=1e-9)


def test_first_passage_keeps_its_digits_for_a_small_diffusion() -> None:
    life = np.linspace(5.0, 20.0, 30)
    found = first_passage_cdf(life, array(1.0), array(0.1), array(1e-4), array(1e-5))
    from scipy.special import ndtr

    np.testing.assert_allclose(found, ndtr((0.1 * life - 1.0) / (0.01 * life)), atol=1e-4)
    assert np.isfinite(found).all()


def test_a_certain_line_reaches_the_limit_when_it_says() -> None:
    time = np.arange(30.0)
    life = fit_degradation(time, 1.0 + 0.01 * time, np.full(30, 1e-4), 1.5).remaining_life()
    assert life.low < 21.0 < life.high
    assert abs(life.median - 21.0) < 0.3
    down = fit_degradation(time, 1.0 - 0.01 * time, np.full(30, 1e-4), 0.5)
    np.testing.assert_allclose(down.remaining_life().median, life.median, rtol=1e-9)
    assert down.mean_drift == pytest.approx(-0.01, rel=0.01)


def test_the_interval_of_a_remaining_life_holds_as_often_as_it_says() -> None:
    """On 40 straight lines with a little chance; 0.9 is claimed, and a standard error is 5 points."""
    said = Counter[str]()
    for number in range(40):
        said.update(verdicts("drift", 0.02, np.random.default_rng([11, number])))
    assert said["life"] > 0.75 * said["case"]
    assert 0.8 * said["life"] < said["hold"]
    assert said["median late"] <= 0.1 * said["life"]


def test_a_steady_motor_is_said_to_have_no_trend() -> None:
    rng = np.random.default_rng(8)
    false = 0
    for _ in range(10):
        series = Series("B", np.arange(30.0), 1.0 + 0.05 * rng.standard_normal(30), np.full(30, 0.05))
        trend = judge(series)
        false += any(forecast.trends for forecast in trend.forecasts)
    assert false <= 1
    assert "no trend" in trend.sentence
    assert "no remaining life" in trend.sentence


def write_table(path: Path, *, rows: int = 30, slope: float = 0.01) -> Path:
    lines = ["date,B,B_se,R,R_se"]
    lines += [
        f"2026-03-{day + 1:02d},{1.2e-6 * (1 + slope * day):.9g},1e-8,{2.18 + 0.002 * (-1) ** day:.9g},0.002"
        for day in range(rows)
    ]
    path.write_text("\n".join(lines) + "\n")
    return path


def test_command_writes_page_and_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table, out = write_table(tmp_path / "estimates.csv"), tmp_path / "page.html"
    status = main(
        ["trend", str(table), "--limit", "B=1.5", "--limit", "R=0.9,1.1", "--out", str(out), "--json"]
    )
    found = {entry["quantity"]: entry for entry in json.loads(capsys.readouterr().out)}
    assert status == 1
    assert found["B"]["state"] == "trending"
    life = found["B"]["limits"][0]["remaining_life"]
    assert life["low"] < 20.5 < life["high"]
    assert found["R"]["state"] == "steady"
    assert all(limit["remaining_life"] is None for limit in found["R"]["limits"])
    text = out.read_text()
    assert text.count("<svg") == 2
    assert "http" not in text
    assert "<script" not in text
    assert main(["trend", str(write_table(table, slope=0.0)), "--out", str(out)]) == 0


def test_a_folder_of_dated_recordings_becomes_a_trend(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from motor_env import PAPER_MOTOR, Fault, FaultKind, Scenario, SensorParameters, Timing, simulate

    timing = Timing(sampling_rate_hz=5_000.0, duration_s=0.06, quiet_s=0.01)
    for day in range(8):
        fault = Fault(FaultKind.BEARING, 0.05 * day)
        scenario = Scenario(
            PAPER_MOTOR, (fault,), sensor=SensorParameters(current_noise_a=1e-3), timing=timing
        )
        start = simulate(scenario, 2, [day])
        rows = zip(start.time_s, start.measurements[0, 0], start.voltage_v[0], strict=True)
        text = "\n".join(["time_s,CH1,voltage_v", *(f"{t:.6f},{i:.6f},{v:g}" for t, i, v in rows)])
        (tmp_path / f"2026-05-{day + 1:02d}T08-00-00.csv").write_text(text + "\n")
    (tmp_path / "notes.csv").write_text("time_s,current_a\n")
    status = main(
        [
            *("trend", str(tmp_path), "--limit", "B/J=1.5", "--column", "current=CH1:A"),
            *("--out", str(tmp_path / "out" / "t.html"), "--json"),
        ]
    )
    captured = capsys.readouterr()
    found = {entry["quantity"]: entry for entry in json.loads(captured.out)}
    assert "notes.csv: its name holds no date" in captured.err
    assert status == 1
    assert found["B/J"]["state"] == "trending"
    life = found["B/J"]["limits"][0]["remaining_life"]
    # reference 1.05, so 1.5 of it is 57.5 % more friction: day 11.5, in 4.5
    assert life["low"] < 4.5 < life["high"]
    assert found["R"]["state"] == "steady"


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("2026-01-31.csv", "2026-01-31T00:00:00"),
        ("start 2026-01-31T11:00:14.csv", "2026-01-31T11:00:14"),
        ("2026-01-31T11-00-14.csv", "2026-01-31T11:00:14"),
        ("Jan-15-2022_11-00-14.csv", "2022-01-15T11:00:14"),
        ("startup_01.csv", None),
        ("2026-13-31.csv", None),
    ],
)
def test_dates_in_names(name: str, expected: str | None) -> None:
    found = date_of(name)
    expected_day = (
        None if expected is None else datetime.fromisoformat(f"{expected}+00:00").timestamp() / 86_400.0
    )
    assert found == expected_day


def test_long_tables_and_json_read_like_wide_ones(tmp_path: Path) -> None:
    wide, long, entries = tmp_path / "w.csv", tmp_path / "l.csv", tmp_path / "e.json"
    wide.write_text("time_hours;B;B_se\n1;2,5;0,1\n2;2,6;0,1\n")
    long.write_text("time_hours,parameter,estimate,standard_error\n2,B,2.6,0.1\n1,B,2.5,0.1\n")
    both = ({"time": 1, "estimate": 2.5}, {"time": 2, "estimate": 2.6})
    entries.write_text(json.dumps([one | {"parameter": "B", "standard_error": 0.1} for one in both]))
    for path in (wide, long, entries):
        (series,) = read_estimates(path)
        np.testing.assert_array_equal(series.time, [1.0, 2.0])
        np.testing.assert_allclose(series.estimate, [2.5, 2.6])
        np.testing.assert_allclose(series.standard_error, 0.1)
    assert read_estimates(wide)[0].unit == "hours"


def test_tables_of_estimates_are_read_like_recordings(tmp_path: Path) -> None:
    """Code pages, tabs, comments and blank lines; an error names the line of the file."""
    path = tmp_path / "e.csv"
    path.write_text("# of the bench\n\ntime_hours\tB\tB_se\n1\t2.5\t0.1\n2\t2.6\t0.1\n", encoding="utf-16")
    (series,) = read_estimates(path)
    np.testing.assert_allclose(series.estimate, [2.5, 2.6])
    path.write_text("# of the bench\n\ntime,B\n1,2\n2,x\n")
    with pytest.raises(InputError, match="line 5: B must be a finite number"):
        read_estimates(path)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "is empty"),
        ("a,b\n1,2\n", "a column named time"),
        ("time,B\n1,x\n", "line 2: B must be a finite number, got 'x'"),
        ("time,B\n1,nan\n", "must be a finite number"),
        ("time,B,B_se\n1,2,-1\n", "must be >= 0, got -1"),
        ("time,B\n1,2,3\n", "has 3 cells where the header has 2"),
        ("time,B\n1,2\n2026-01-01,2\n", "all be dates or all be numbers"),
        ("time,B\n", "holds no estimates"),
        ("time,temperature_c\n1,20\n", "holds no estimates"),
    ],
)
def test_bad_tables_get_one_sentence(
    tmp_path: Path, text: str, sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "bad.csv"
    path.write_text(text)
    assert main(["trend", str(path), "--out", str(tmp_path / "t.html")]) == 2
    error = capsys.readouterr().err
    assert sentence in error
    assert error.count("\n") == 1
    assert not (tmp_path / "t.html").exists()


def test_whole_numbers_too_large_for_a_float_get_one_sentence(tmp_path: Path) -> None:
    path = tmp_path / "e.json"
    path.write_text(json.dumps([{"time": 1, "parameter": "B", "estimate": 10**400}]))
    with pytest.raises(InputError, match="entry 1: B must be a finite number, got '1000"):
        read_estimates(path)


def test_bad_options_get_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = str(write_table(tmp_path / "t.csv"))
    for options, sentence in (
        (["--limit", "B"], "--limit must look like"),
        (["--limit", "X=1.5"], "the quantities are B, R"),
        (["--level", "1.5"], "level must lie between 0 and 1, got 1.5"),
        (["--date", "moon"], 'Choose from: "name", "modified", "order"'),
        (["--reference-count", "0"], "must be >= 1, got 0"),
    ):
        assert main(["trend", table, *options, "--out", str(tmp_path / "t.html")]) == 2
        assert sentence in capsys.readouterr().err
    assert main(["trend", str(tmp_path / "none.csv")]) == 2
    with pytest.raises(InputError, match="factors on the reference"):
        parse_limits(["B=1.0"])


def test_names_of_quantities_are_text_on_the_page() -> None:
    series = Series("<script>alert(1)</script>", np.arange(6.0), np.linspace(1.0, 1.2, 6), np.full(6, 0.01))
    html = Trends((judge(series),), ("<b>note</b>",)).page()
    assert "<script" not in html
    assert "<b>" not in html


def test_estimates_are_checked() -> None:
    with pytest.raises(ValueError, match="must be finite"):
        fit_degradation(np.arange(5.0), array(1.0, 1.0, math.inf, 1.0, 1.0), np.ones(5), 1.5)
    with pytest.raises(ValueError, match="limit must differ from the first level, got 1"):
        fit_degradation(np.arange(5.0), np.ones(5), np.ones(5), 1.0)


def test_estimates_that_never_move_have_no_trend_and_no_jump() -> None:
    for count in (5, 40):
        still = judge(Series("R", np.arange(float(count)), np.full(count, 0.3), np.zeros(count)))
        assert "probability of a drift to a limit 0 %" in still.sentence
        assert still.sentence.startswith("no trend: last change +0 %")


def history(values: np.ndarray, name: str = "friction", error: float = 0.004) -> Series:
    noisy = values + error * np.random.default_rng(3).standard_normal(len(values))
    return Series(name, np.arange(float(len(values))), noisy, np.full(len(values), error))


def test_the_picture_shows_levels_ahead_within_an_interval_that_widens() -> None:
    """The band's upper edge goes ahead in time, its lower edge back."""
    noise = 0.004 * np.random.default_rng(2).standard_normal(30)
    page = Trends((judge(history(1.0 + 0.01 * np.arange(30.0) + noise), (1.5,)),)).page()
    (points,) = re.findall(r'<polygon[^>]*points="([^"]+)"', page)
    x, y = np.array([pair.split(",") for pair in points.split()], dtype=float).T
    n = len(x) // 2
    np.testing.assert_allclose(x[n:], x[n - 1 :: -1])
    assert (np.diff(x[:n]) > 0.0).all()
    width = (y[n:][::-1] - y[:n])[y[:n] > y.min()]  # downwards, and cut at the edge of the picture
    assert len(width) > 20
    assert (np.diff(width) > 0.0).all()


def test_a_repair_is_told_and_the_trend_begins_there() -> None:
    day = np.arange(40.0)
    found = judge(history(1.0 + 0.006 * np.where(day < 15.0, day, day - 15.0)), (1.25,))
    assert "a jump of -9 % at 15 starts" in found.sentence.replace("days", "starts")
    life = found.forecasts[0].life
    assert life.low < 15.0 + 0.25 / 0.006 - 39.0 < life.high


def test_wear_that_accelerates_has_a_life_that_holds() -> None:
    day = np.arange(45.0)
    found = judge(history(1.0 + 0.002 * np.expm1(day / 12.0)), (1.25,)).forecasts[0]
    left = 12.0 * math.log(126.0) - 44.0
    assert found.has_remaining_life
    assert found.life.low <= left <= found.life.high
    assert found.life.median < 2.0 * left  # a straight line would be 4 times too late
    assert found.wear.growth @ found.wear.weights > 1.0


def test_wear_in_steps_is_close_to_its_limit() -> None:
    day = np.arange(40.0)
    values = 1.0 + 0.07 * (np.greater_equal.outer(day, [10.0, 18.0, 30.0])).sum(axis=1)
    found = judge(history(values), (1.25,))
    (one,) = found.forecasts
    assert found.state == "close"
    assert one.life.low < 1.0 / (3.0 / 39.0) < one.life.high  # one more step of this pace


def test_a_jump_towards_a_limit_is_wear_and_a_repair_from_the_other_one() -> None:
    found = judge(history(1.0 + 0.21 * (np.arange(40.0) >= 20.0)))
    below, above = found.forecasts
    assert (
        "a jump of +21 % at 20 days (a repair or a step), judged since then against -25 %: " in found.sentence
    )
    assert (found.state, above.close, below.close) == ("close", True, False)
    assert below.wear.span.max() == 19.0
    assert above.wear.span.max() > 19.0


def test_a_level_close_to_its_limit_is_told_without_a_trend() -> None:
    values = np.array([1.0, 1.0, 1.0, 1.22, 1.22, 1.22, 1.22])
    found = judge(history(values, error=0.02), (1.25,))
    assert found.state == "close"
    assert "close to the limit at +25 %: above 80 % of the way to it with a probability of" in found.sentence
    shown = Trends((found,))
    assert repr(shown).endswith(found.sentence)
    assert shown.to_json()[0]["limits"][0]["close"]
    assert "close to a limit</td><td>–" in shown.page()
    assert judge(history(values, error=0.02), (1.4,)).state == "steady"  # 55 % of the way


def test_no_life_where_another_temperature_would_explain_the_drift() -> None:
    day = np.arange(60.0)
    warm = history(np.exp(0.00393 * 0.3 * day), "R")
    assert "a change of the temperature" in judge(warm, (1.25,)).sentence
    kelvin = Series("temperature_c", day, 20.0 + 0.3 * day, np.full(60, 0.1))
    assert "no trend" in judge(warm, (1.25,), temperature=kelvin).sentence


def test_inductance_has_no_limit_unless_one_is_given() -> None:
    assert "no limit is given" in judge(history(1.0 + 0.02 * np.arange(30.0), "L")).sentence
    assert judge(history(1.0 + 0.02 * np.arange(30.0), "L"), (1.25,)).forecasts[0].reached
