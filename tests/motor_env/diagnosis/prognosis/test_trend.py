"""Trends and remaining life: against closed forms and simulation."""

import json
import math
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
from recording_csv import write_csv
from scipy.special import ndtr

from motor_env import PAPER_MOTOR, Fault, FaultKind, InputError, Scenario, SensorParameters, Timing, simulate
from motor_env.cli import main
from motor_env.diagnosis.prognosis.degradation import first_passage_cdf, fit_degradation
from motor_env.diagnosis.prognosis.trend import Series, judge, parse_limits
from motor_env.diagnosis.prognosis.trend_report import Trends, date_of, read_estimates
from motor_env.motor.parameters import FloatArray


def array(*values: float) -> FloatArray:
    return np.array(values)


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
    np.testing.assert_allclose(found, ndtr((0.1 * life - 1.0) / (0.01 * life)), atol=1e-4)
    assert np.isfinite(found).all()


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
    limits = ["--limit", "B=1.5", "--limit", "R=0.9,1.1"]
    assert main(["trend", str(table), *limits, "--out", str(out), "--json"]) == 1
    found = {entry["quantity"]: entry for entry in json.loads(capsys.readouterr().out)}
    life = found["B"]["limits"][0]["remaining_life"]
    assert life["low"] < 20.5 < life["high"]
    assert (found["B"]["state"], found["R"]["state"]) == ("trending", "steady")
    assert all(limit["remaining_life"] is None for limit in found["R"]["limits"])
    assert out.read_text().count("<svg") == 2
    assert main(["trend", str(write_table(table, slope=0.0)), "--out", str(out)]) == 0


def test_a_folder_of_dated_recordings_becomes_a_trend(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    timing, sensor = Timing(5_000.0, 0.06, quiet_s=0.01), SensorParameters(current_noise_a=1e-3)
    for day in range(8):
        faults = (Fault(FaultKind.BEARING, 0.05 * day),)
        start = simulate(Scenario(PAPER_MOTOR, faults, sensor=sensor, timing=timing), 2, [day])
        columns = {"time_s": start.time_s, "CH1": start.measurements[0, 0], "voltage_v": start.voltage_v[0]}
        write_csv(tmp_path / f"2026-05-{day + 1:02d}T08-00-00.csv", columns, form=".6f")
    (tmp_path / "notes.csv").write_text("time_s,current_a\n")
    options = ["--limit", "B/J=1.5", "--column", "current=CH1:A", "--out", str(tmp_path / "out" / "t.html")]
    assert main(["trend", str(tmp_path), *options, "--json"]) == 1
    captured = capsys.readouterr()
    found = {entry["quantity"]: entry for entry in json.loads(captured.out)}
    assert "notes.csv: its name holds no date" in captured.err
    assert (found["B/J"]["state"], found["R"]["state"]) == ("trending", "steady")
    life = found["B/J"]["limits"][0]["remaining_life"]
    # reference 1.05, so 1.5 of it is 57.5 % more friction: day 11.5, in 4.5
    assert life["low"] < 4.5 < life["high"]


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("2026-01-31.csv", "2026-01-31T00:00:00"),
        ("start 2026-01-31T11:00:14.csv", "2026-01-31T11:00:14"),
        ("2026-01-31T11-00-14.csv", "2026-01-31T11:00:14"),
        ("Jan-15-2022_11-00-14.csv", "2022-01-15T11:00:14"),
    ],
)
def test_dates_in_names(name: str, expected: str) -> None:
    assert date_of(name) == datetime.fromisoformat(f"{expected}+00:00").timestamp() / 86_400.0
    assert date_of("startup_01.csv") is date_of("2026-13-31.csv") is None


def test_tables_and_json_of_estimates_are_read_alike(tmp_path: Path) -> None:
    wide, long, tabs, entries = (tmp_path / name for name in ("w.csv", "l.csv", "t.csv", "e.json"))
    wide.write_text("time_hours;B;B_se\n1;2,5;0,1\n2;2,6;0,1\n")
    long.write_text("time_hours,parameter,estimate,standard_error\n2,B,2.6,0.1\n1,B,2.5,0.1\n")
    tabs.write_text("# of the bench\n\ntime_hours\tB\tB_se\n1\t2.5\t0.1\n2\t2.6\t0.1\n", encoding="utf-16")
    both = ({"time": 1, "estimate": 2.5}, {"time": 2, "estimate": 2.6})
    entries.write_text(json.dumps([one | {"parameter": "B", "standard_error": 0.1} for one in both]))
    for path in (wide, long, tabs, entries):
        (series,) = read_estimates(path)
        np.testing.assert_array_equal(series.time, [1.0, 2.0])
        np.testing.assert_allclose(series.estimate, [2.5, 2.6])
        np.testing.assert_allclose(series.standard_error, 0.1)
    assert read_estimates(wide)[0].unit == "hours"


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "is empty"),
        ("a,b\n1,2\n", "a column named time"),
        ("# of the bench\n\ntime,B\n1,2\n2,x\n", "line 5: B must be a finite number, got 'x'"),
        ("time,B\n1,nan\n", "must be a finite number"),
        ("time,B,B_se\n1,2,-1\n", "must be >= 0, got -1"),
        ("time,B\n1,2,3\n", "has 3 cells where the header has 2"),
        ("time,B\n1,2\n2026-01-01,2\n", "all be dates or all be numbers"),
        ("time,temperature_c\n1,20\n", "holds no estimates"),
        (
            '[{"time": 1, "parameter": "B", "estimate": 1%s}]' % (400 * "0"),
            "entry 1: B must be a finite number",
        ),
    ],
)
def test_bad_tables_get_one_sentence(
    tmp_path: Path, text: str, sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / ("bad.json" if text.startswith("[") else "bad.csv")
    path.write_text(text)
    assert main(["trend", str(path), "--out", str(tmp_path / "t.html")]) == 2
    error = capsys.readouterr().err
    assert sentence in error
    assert error.count("\n") == 1
    assert not (tmp_path / "t.html").exists()


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
