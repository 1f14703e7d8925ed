"""Files of instruments and programs, whole and mangled: right, or refused; what a refusal suggests reads them right."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from foreign_files import CURRENT, INSTRUMENTS, OTHERS, PWM, RATE_HZ, RPM, SPEED, TIME, VOLTAGE, ForeignFile
from hostile import refused, refused_or_same
from recording_csv import write_csv

from motor_env import ColumnChoice, Recording, cli, read_recording
from motor_env.diagnosis.readers.text_block import legend_of

Random = np.random.Generator
_OPTION = re.compile(r'--column (?:"([^"]+)"|([^\s,;]+))')
_NUMBER = r"[-+]?[\d.]+"
_BLANKS = {"UNIT": r"\w+", "SCALE": _NUMBER, r"\+OFFSET": _NUMBER}


def options_of(sentence: str) -> list[str]:
    """What stands behind each `--column`, blanks in capitals among it; with the columns for COLUMN put in."""
    found = [quoted or plain for quoted, plain in _OPTION.findall(sentence)]
    several = re.search(r"where COLUMN is one of (.+?), and ", sentence)
    columns = several[1].split(", ") if several else []
    return [
        option.replace("COLUMN", column)
        for option in found
        for column in (columns if "COLUMN" in option else [""])
    ]


def fits(option: str, named: str) -> bool:
    """Whether an option with its blanks filled is the one that was named."""
    pattern = re.escape(re.sub(r" ?\(mV\)", "", option))
    for blank, form in _BLANKS.items():
        pattern = pattern.replace(blank, form)
    return re.fullmatch(pattern, named.replace(" (mV)", "")) is not None


def chosen(path: Path, *options: str, rate_hz: float | None = None) -> Recording:
    sampled = [] if rate_hz is None else [ColumnChoice.sampled(rate_hz)]
    return read_recording(path, [*map(ColumnChoice.parse, options), *sampled])


def check(recording: Recording, file: ForeignFile) -> None:
    """One of the currents, at its rate; of instruments the voltage, too."""
    offs = [float(np.max(np.abs(recording.current_a - current))) for current in file.currents_a]
    assert min(offs, default=np.inf) < file.tolerance_a, recording.columns
    assert recording.dt_s == pytest.approx(1.0 / RATE_HZ, rel=1e-3), recording.columns


@pytest.mark.parametrize("name", INSTRUMENTS)
def test_an_instrument_is_read_right(name: str, tmp_path: Path) -> None:
    file, path = INSTRUMENTS[name](), tmp_path / "a.csv"
    path.write_text(file.text)
    recording = chosen(path, *file.named, rate_hz=file.rate_hz)
    check(recording, file)
    assert (recording.voltage_v is None) == (name.startswith(("LeCroy", "Hantek")))
    if recording.voltage_v is not None:
        np.testing.assert_allclose(recording.voltage_v, VOLTAGE[: len(recording.time_s)], atol=0.015)


def outcomes(path: Path, file: ForeignFile, options: tuple[str, ...] = ()) -> list[str]:
    """How each way of following the sentences ends: read, or with the last sentence. A wrong current fails."""
    sentence = refused_or_same(lambda: chosen(path, *options), path, lambda recording: check(recording, file))
    if not sentence:
        return ["read"]
    found = []
    for option in options_of(sentence):
        has_blanks = any(blank in option for blank in ("UNIT", "SCALE", "COLUMN"))
        named = [named for named in file.named if fits(option, named)] if has_blanks else [option]
        found += [end for one in named if len(options) < 5 for end in outcomes(path, file, (*options, one))]
    return found or [sentence]


@pytest.mark.parametrize("name", INSTRUMENTS | OTHERS)
def test_what_a_refusal_suggests_reads_no_wrong_channel(name: str, tmp_path: Path) -> None:
    file, path = (INSTRUMENTS | OTHERS)[name](), tmp_path / "a.csv"
    path.write_text(file.text)
    found = outcomes(path, file)
    if file.rate_hz is None and "Arduino" not in name:  # where the options for two columns go together
        assert ("read" in found) == bool(file.currents_a), found


def mark_of(line: str) -> str:
    return ";" if ";" in line else "\t" if "\t" in line else ","


def one_row(change: Callable[[str], list[str]]) -> Callable[[str, Random], str]:
    """A change of one of the last two thirds of a file's lines."""

    def changed(text: str, rng: Random) -> str:
        lines = text.splitlines()
        place = int(rng.integers(len(lines) // 3, len(lines) - 1))
        return "\n".join([*lines[:place], *change(lines[place]), *lines[place + 1 :]]) + "\n"

    return changed


def last_cell(cell: str) -> Callable[[str, Random], str]:
    """Another last cell of one row."""
    return one_row(lambda row: [re.sub(r"[^,;\t]+([,;]?)$", rf"{cell}\1", row)])


def delimited(mark: str, decimal: str = ".") -> Callable[[str, Random], str]:
    def changed(text: str, _: Random) -> str:
        if mark_of(text) != ",":
            return text
        return text.replace(",", "\0").replace(".", decimal).replace("\0", mark)

    return changed


MANGLINGS: dict[str, Callable[[str, Random], str]] = {
    "line ends of Windows": lambda text, _: text.replace("\n", "\r\n"),
    "mark of UTF-8": lambda text, _: "\ufeff" + text,
    "semicolons and decimal commas": delimited(";", ","),
    "tabs": delimited("\t"),
    "decimal commas between commas": delimited(",", ","),
    "blank lines": one_row(lambda row: [row, "", "  "]),
    "cut off": lambda text, rng: text[: int(rng.integers(len(text) // 2, len(text)))],
    "cell empty": last_cell(""),
    "cell that is no number": last_cell("1.#INF"),
    "cell with a letter": last_cell("1.5x"),
    "digits in groups": last_cell("1 234.5"),
    "cell in excess": one_row(lambda row: [row.rstrip(",;") + ",1.5"]),
    "row short": one_row(lambda row: [re.split("[,;\t]", row)[0]]),
    "row doubled": one_row(lambda row: [row, row]),
    "row missing": one_row(lambda _: []),
    "row split": one_row(lambda row: [row[: len(row) // 2], row[len(row) // 2 :]]),
    "header between": lambda text, _: text + text,
    "quotes": lambda text, _: re.sub(rf"[^{mark_of(text)}\n]+", r'"\g<0>"', text),
    "blanks": lambda text, _: text.replace(mark_of(text), f" {mark_of(text)} "),
    "no header": lambda text, _: "\n".join(text.splitlines()[-500:]),
    "another minus": lambda text, _: text.replace("-", "\u2212"),
    "bytes of nothing": lambda text, rng: text[: int(rng.integers(len(text)))] + "\0" * 9 + text[9:],
}
_OF_ROWS = ("row missing", "row doubled", "cut off", "header between", "row split", "no header")


def check_mangled(file: ForeignFile, begin_s: float, name: str, path: Path, rng: Random) -> str:
    """What became of a mangled file: right, said or refused."""
    path.write_text(MANGLINGS[name](file.text, rng), encoding="utf-8", newline="")
    became = "right"

    def same(recording: Recording) -> None:
        nonlocal became
        time_s = recording.time_s - begin_s
        off = np.abs(recording.current_a - np.interp(time_s, TIME, CURRENT)) > 2.0 * file.tolerance_a + 1e-3
        if recording.voltage_v is not None:
            off |= np.abs(recording.voltage_v - np.interp(time_s, TIME, VOLTAGE)) > 0.05
        wrong = int(off.sum()) + int((time_s > TIME[-1] + 1e-6).sum())
        told = "; ".join(recording.columns)
        if wrong > 2 and any(words in told for words in ("taken as", "cut off", "begins anew")):
            became = "said"
        else:  # a row that is missing is interpolated
            assert wrong <= 2, (name, wrong, recording.columns)

    sentence = refused_or_same(lambda: chosen(path, *file.named, rate_hz=file.rate_hz), path, same)
    return "refused" if sentence else became


@pytest.mark.parametrize("name", [*INSTRUMENTS][::2])
def test_mangled_files_are_right_or_refused(name: str, tmp_path: Path) -> None:
    file, path = INSTRUMENTS[name](), tmp_path / "a.csv"
    path.write_text(file.text)
    begin_s = float(chosen(path, *file.named, rate_hz=file.rate_hz).time_s[0])
    rng, timeless = np.random.default_rng(20), file.rate_hz is not None
    names = [one for one in MANGLINGS if not (timeless and one in _OF_ROWS)]
    seen = [check_mangled(file, begin_s, one, path, rng) for one in names]
    assert seen.count("right") >= 4
    assert seen.count("refused") >= 4
    assert seen.count("said") <= 2


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


def test_a_legend_names_columns_and_units() -> None:
    lines = [
        "%  7  8 Motor current left, right [A]: 0.1 0.2",
        "% 9 10 11 Pose x,y,tilt [m,m,rad]: 0 0 0",
        "% 16 .. 18 Line sensor: left 0.0 0",
        "% 18    Battery voltage [V]: 12.0",
        "# column 2: supply (mV)",
        "# 40 beyond the table",
        "// 3 = gear",
        "a remark, 5 of them",
    ]
    found = {k + 1: told for k, told in legend_of(lines, 20).items()}
    assert found == {
        2: ("supply", "mV"), 3: ("gear", ""), 7: ("Motor current left", "A"), 8: ("Motor current right", "A"),
        9: ("Pose x", "m"), 10: ("Pose y", "m"), 11: ("Pose tilt", "rad"), 16: ("Line sensor 1", ""),
        17: ("Line sensor 2", ""), 18: ("Battery voltage", "V"),
    }  # fmt: skip
    assert legend_of(["# 3 motors [A] were measured"], 20) == {}


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
        ("a.dat", b"\x89HDF\r\n", "must be named .mat, .h5 or .hdf5"),
        ("a.bin", b"TDSm", "must be named .tdms"),
    ],
)
def test_a_file_that_another_program_must_convert_says_how(
    name: str, begin: bytes, words: str, tmp_path: Path
) -> None:
    path = tmp_path / name
    path.write_bytes(begin + bytes(range(200)))
    assert words in refused(lambda: read_recording(path), path)
