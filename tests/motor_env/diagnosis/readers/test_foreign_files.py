"""Foreign files: what a refusal suggests is followed to the letter, and never reads another channel."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from foreign_files import CURRENT, MAKERS, PWM, RATE_HZ, RPM, SECOND, SPEED, TIME, VOLTAGE, ForeignFile
from hostile import refused, refused_or_same
from recording_csv import write_csv
from suggested_options import fits, has_blanks, options_of

from motor_env import ColumnChoice, Recording, cli, read_recording
from motor_env.diagnosis.readers.columns import evenly_rounded
from motor_env.diagnosis.readers.headers import follows
from motor_env.diagnosis.readers.text_block import legend_of
from motor_env.motor.parameters import FloatArray

_DEEPEST = 5  # options one after another


def outcomes(path: Path, file: ForeignFile, options: tuple[str, ...] = ()) -> list[str]:
    """How each way of following the sentences ends: read, or with the last sentence. A wrong current fails."""

    def right(recording: Recording) -> None:
        offs = [float(np.max(np.abs(recording.current_a - current))) for current in file.currents_a]
        assert min(offs, default=np.inf) < file.tolerance_a, (options, recording.columns)
        assert recording.dt_s == pytest.approx(1.0 / RATE_HZ, rel=1e-3), recording.columns

    sentence = refused_or_same(
        lambda: read_recording(path, [ColumnChoice.parse(option) for option in options]), path, right
    )
    if not sentence:
        return ["read"]
    found = []
    for option in options_of(sentence):
        named = [named for named in file.named if fits(option, named)] if has_blanks(option) else [option]
        found += [
            end for one in named if len(options) < _DEEPEST for end in outcomes(path, file, (*options, one))
        ]
    return found or [sentence]


@pytest.mark.parametrize("kind", list(MAKERS))
def test_what_a_refusal_suggests_reads_no_wrong_channel(kind: str, tmp_path: Path) -> None:
    file, path = MAKERS[kind](), tmp_path / "a.csv"
    path.write_text(file.text)
    found = outcomes(path, file)
    assert ("read" in found) == bool(file.currents_a), found


def chosen(path: Path, *options: str) -> Recording:
    return read_recording(path, [ColumnChoice.parse(option) for option in options])


@pytest.mark.parametrize(
    ("option", "sentence"),
    [
        ("current=Commanded_PWM:A", "reaches 3499 A, which is no reading of a motor"),
        ("current=X:A", "is a linear function of the voltage (column 2 (U [V])), without any noise"),
        ("current=clock:A", "is a linear function of the time"),
        ("current=tacho*0.02", "is a linear function of the speed"),
    ],
)
def test_a_current_that_none_is_is_refused(option: str, sentence: str, tmp_path: Path) -> None:
    columns = {"time_s": TIME, "U [V]": VOLTAGE, "Commanded_PWM": PWM, "speed [rpm]": RPM}
    columns |= {"clock": 2.0 * TIME + 1.0, "tacho": np.round(SPEED, 1), "X": np.round(1.0 - 0.5 * VOLTAGE, 3)}
    path = write_csv(tmp_path / "a.csv", columns, form=".6f")
    assert sentence in refused(lambda: cli.main(["identify", str(path), "--column", option]), path)


def test_what_a_user_names_against_its_name_or_size_is_warned_of(tmp_path: Path) -> None:
    path = write_csv(tmp_path / "a.csv", {"time_s": TIME, "Velo": SPEED, "IA": 20.0 * CURRENT}, form=".6f")
    largest = np.max(np.abs(np.round(SPEED, 6)))
    (warning,) = chosen(path, "current=Velo:A").warnings
    assert warning.startswith("by its name, column Velo is no current; ")
    assert f"column Velo gives a current of {largest:.4g} A: are its unit and its scale right?" in warning
    assert chosen(path, "current=IA:A").warnings == ()
    assert chosen(path, "current=IA:A", "speed=Velo:rpm").warnings == ()


def test_a_stamp_is_no_current(tmp_path: Path) -> None:
    path = write_csv(tmp_path / "a.csv", {"stamp": TIME, "clamp (mA)": 1e3 * CURRENT}, form=".6f")
    assert "name it: --column time=stamp:UNIT" in refused(lambda: read_recording(path), path)
    assert chosen(path, "time=stamp:s").warnings == ()


def test_whole_numbers_may_be_milliampere(tmp_path: Path) -> None:
    path = write_csv(tmp_path / "a.csv", {"time_s": TIME, "clamp": np.rint(1e3 * CURRENT)}, form=".6g")
    sentence = refused(lambda: read_recording(path), path)
    assert "--column current=clamp:UNIT (UNIT is A or mA; " in sentence
    assert '--column "current=clamp*SCALE+OFFSET"' in sentence
    check = np.rint(1e3 * CURRENT) / 1e3
    np.testing.assert_allclose(chosen(path, "current=clamp:mA").current_a, check, atol=1e-9)


def test_numbers_are_no_names(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    rows = "\n".join(f"{1e3 * t:.6g},{i:.6g}" for t, i in zip(TIME, CURRENT, strict=True))
    path.write_text(f"x-axis,1\n{rows}\n", encoding="utf-8")
    sentence = refused(lambda: chosen(path, "time=x-axis:ms"), path)
    assert "numbers are none: use the column's number, such as --column time=1" in sentence


@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_a_current_follows_others_only_without_noise(noise: float) -> None:
    rng = np.random.default_rng(3)
    computed = 0.02 * SPEED - 1.0 + noise * rng.standard_normal(len(SPEED))
    assert follows(computed, SPEED, "voltage") is (noise == 0.0)
    assert follows(np.round(computed, 2), np.round(SPEED, 1), "voltage") is (noise == 0.0)
    # An ideal motor's falls as its speed rises; a tachometer that is wired the other way round does not.
    assert not follows(5.0 - 0.02 * np.abs(SPEED), np.abs(SPEED), "speed")
    assert follows(-0.02 * SPEED, SPEED, "speed")
    assert not follows(np.zeros(9), np.arange(9.0), "time")
    assert not follows(np.repeat([0.0, 1.0], 50), np.arange(100.0), "time")


@pytest.mark.parametrize("rate_hz", [1234.5, 2000.0, 5000.0])
@pytest.mark.parametrize("rounded", [np.round, np.floor])
def test_times_that_repeat_by_rounding_tell_their_rate(
    rate_hz: float, rounded: Callable[[FloatArray], FloatArray]
) -> None:
    time_s: FloatArray = np.arange(3000) / rate_hz
    spread = evenly_rounded(rounded(1e3 * time_s) / 1e3 + 1.7e6)
    assert spread is not None
    assert spread[1:] == pytest.approx((rate_hz, 1e-3), rel=1e-5)
    np.testing.assert_allclose(np.diff(spread[0]), 1.0 / rate_hz, rtol=1e-3)
    assert abs(np.mean(spread[0]) - 1.7e6 - np.mean(time_s)) < 0.6e-3


@pytest.mark.parametrize(
    ("names", "alike"),
    [
        (("left (A)", "right (A)"), "left (A) and right (A) both"),
        (("red (A)", "blue (A)", "green (A)"), "red (A), blue (A) and green (A) all"),
    ],
)
def test_columns_that_look_alike_are_offered_one_by_one(
    names: tuple[str, ...], alike: str, tmp_path: Path
) -> None:
    path = write_csv(tmp_path / "a.csv", {"time_s": TIME} | dict.fromkeys(names, CURRENT))
    options = " or ".join(f'--column "current={name}"' for name in names)
    sentence = refused(lambda: read_recording(path), path)
    assert sentence == f"{path}: the columns {alike} look like the current; say which: {options}"


@pytest.mark.parametrize(("interval", "spreads"), [(0.895, True), (0.905, False)])
def test_times_that_repeat_seldom_are_not_spread(interval: float, spreads: bool) -> None:
    """From nine tenths of the rounding on."""
    found = evenly_rounded(np.round(interval * np.arange(3000.0)) * 1e-3)
    assert (found is not None) is spreads


def test_times_that_repeat_otherwise_are_not_spread() -> None:
    even: FloatArray = np.arange(300.0) / 1e3
    fast = even / 5.0
    stood = np.insert(fast, 150, np.full(20, 0.03))
    with_gap = np.concatenate([fast[:150], fast[:150] + 0.1])
    for time_s in (even, np.insert(even, 100, even[100]), stood.round(3), with_gap.round(3), 0.0 * even):
        assert evenly_rounded(time_s) is None
    assert evenly_rounded(fast.round(3)) is not None


def test_a_legend_names_columns_and_units() -> None:
    lines = [
        "% 1    time 0.000 sec",
        "%  7  8 Motor current left, right [A]: 0.1 0.2",
        "% 9 10 11 Pose x,y,tilt [m,m,rad]: 0 0 0",
        "% 16 .. 18 Line sensor: left 0.0 0",
        "% 18    Battery voltage [V]: 12.0",
        "# column 2: supply (mV)",
        "# 40 beyond the table",
        "// 3 = gear",
        "a remark, 5 of them",
    ]
    found = legend_of(lines, 20)
    assert {k + 1: told for k, told in found.items()} == {
        1: ("time", "sec"),
        2: ("supply", "mV"),
        3: ("gear", ""),
        7: ("Motor current left", "A"),
        8: ("Motor current right", "A"),
        9: ("Pose x", "m"),
        10: ("Pose y", "m"),
        11: ("Pose tilt", "rad"),
        16: ("Line sensor 1", ""),
        17: ("Line sensor 2", ""),
        18: ("Battery voltage", "V"),
    }
    assert legend_of(["# 3 motors [A] were measured"], 20) == {}


def test_of_two_motors_the_columns_of_the_one_that_was_named_are_suggested(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text(MAKERS["legend"]().text)
    sentence = refused(lambda: chosen(path, "voltage=Motor voltage right"), path)
    assert options_of(sentence) == ["current=Motor current right"]
    read = chosen(path, "current=Motor current right", "voltage=Motor voltage right")
    np.testing.assert_allclose(read.current_a, SECOND, atol=1e-4)


TEXT = "time_s,voltage_v,current_a\n" + "".join(f"{k / 1000},12.5,{k % 7}.25\n" for k in range(60))


QUOTED = "time_s,voltage_v,current_a\n" + "".join(f'"0,{k:03d}","12,5","{k % 7},25"\n' for k in range(60))
MIDNIGHT = "time,current_a\n" + "".join(
    f"{'23:59:59' if k < 100 else '00:00:00'}.{k % 100:02d},{k % 7}.5\n" for k in range(150)
)


def counted(begin: int, top: int, low: int = 0) -> str:
    """Microseconds of a counter that begins anew at `low` after `top`."""
    rows = (f"{(begin + 1000 * k - low) % (top - low) + low},{k % 7}.25\n" for k in range(60))
    return "micros,current_a\n" + "".join(rows)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (TEXT + "\0", "1 NUL byte is skipped"),
        (TEXT[:500] + "\0\0\0" + TEXT[500:], "3 NUL bytes are skipped"),
        (TEXT + "\0" * 4096, "4096 NUL bytes are skipped"),
        (QUOTED, "decimal comma"),
        (counted(2**32 - 20_500, 2**32), "whose counter begins anew after 4294.967296 s"),
        (counted(2**31 - 20_500, 2**31, -(2**31)), "whose counter begins anew after 4294.967296 s"),
        (counted(2**16 - 20_500, 2**16), "whose counter begins anew after 0.065536 s"),
        (MIDNIGHT, "begins anew after 86400 s"),
    ],
)
def test_what_loggers_leave_in_their_files_is_read_and_told(text: str, told: str, tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text(text)
    found = read_recording(path)
    assert told in "; ".join(found.columns)
    np.testing.assert_allclose(np.diff(found.time_s), found.dt_s)
    assert found.dt_s in (pytest.approx(1e-3), pytest.approx(1e-2))
    assert found.missing is None


def test_a_clock_that_begins_anew_begins_a_piece(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    body = TEXT.partition("\n")[2]
    for text in (TEXT + body, TEXT + TEXT):
        path.write_text(text)
        found = read_recording(path)
        assert any("the clock begins anew in line 6" in note for note in found.columns)
        assert found.missing is not None
        assert np.flatnonzero(found.missing[:, :2].all(axis=1)).tolist() == [60, 61]
    for time in ("0.03", "-1e16"):  # said as the file has it, not as counted on
        path.write_text(f"{TEXT}{time},12.5,1\n0.06,12.5,1\n")
        assert f"must rise, got {float(time):.10g} after 0.059" in refused(lambda: read_recording(path), path)


@pytest.mark.parametrize("unit", ["ms", "s"])
def test_a_time_that_may_be_in_ms_is_asked_for_its_unit(unit: str, tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text(
        "Zeit;Strom;Spannung\n" + "".join(f"{k / 10};{k % 7},25;12\n".replace(".", ",") for k in range(600))
    )
    sentence = refused(lambda: read_recording(path), path)
    assert "the time (Zeit) names no unit" in sentence
    assert f"time=Zeit:{unit}" in options_of(sentence)
    found = read_recording(path, [ColumnChoice.parse(f"time=Zeit:{unit}")])
    assert found.dt_s == pytest.approx(0.1 if unit == "s" else 1e-4)


@pytest.mark.parametrize(
    ("name", "begin", "words"),
    [
        ("a.xls", b"PK\x03\x04", "a workbook must be named .xlsx"),
        ("a.xls", b"\xd0\xcf\x11\xe0", "save it as .xlsx or CSV"),
        ("a.xlsx", b"\xd0\xcf\x11\xe0", "save it as .xlsx or CSV"),
        ("a.dat", b"\x89HDF\r\n", "must be named .mat, .h5 or .hdf5"),
        ("a.bin", b"TDSm", "must be named .tdms"),
        ("a.tdms", b"TDSm", "holds no column of numbers"),
    ],
)
def test_a_file_that_another_program_must_convert_says_how(
    name: str, begin: bytes, words: str, tmp_path: Path
) -> None:
    path = tmp_path / name
    path.write_bytes(begin + bytes(range(200)))
    assert words in refused(lambda: read_recording(path), path)
