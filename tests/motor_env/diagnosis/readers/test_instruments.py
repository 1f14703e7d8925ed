"""Files of common instruments, whole and mangled: their values are right, or they are refused in a sentence."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hostile import refused_or_same
from instrument_files import INSTRUMENTS, Capture, InstrumentFile, bare, capture, serial_monitor
from suggested_options import fits, options_of

from motor_env import ColumnChoice, Recording, read_recording

Random = np.random.Generator


@cache
def truth() -> Capture:
    return capture()


@cache
def file_of(instrument: Callable[[Capture], InstrumentFile]) -> InstrumentFile:
    return instrument(truth())


@cache
def first_s(instrument: Callable[[Capture], InstrumentFile]) -> float:
    """When the whole file begins."""
    file = file_of(instrument)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "whole.csv"
        path.write_text(file.text)
        return float(read_recording(path, choices(file)).time_s[0])


def choices(file: InstrumentFile) -> list[ColumnChoice]:
    sampled = [] if file.sampling_rate_hz is None else [ColumnChoice.sampled(file.sampling_rate_hz)]
    return [*map(ColumnChoice.parse, file.columns), *sampled]


def wrong_samples(recording: Recording, file: InstrumentFile, shift_s: float) -> int:
    """How many samples are not what was measured then, of current or voltage."""
    time_s = recording.time_s - shift_s
    wrong = (
        np.abs(recording.current_a - np.interp(time_s, truth().time_s, truth().current_a)) > file.resolution_a
    )
    if recording.voltage_v is not None:
        wrong |= np.abs(recording.voltage_v - np.interp(time_s, truth().time_s, truth().voltage_v)) > 0.05
    return int(wrong.sum()) + int((time_s > truth().time_s[-1] + 1e-6).sum())


@pytest.mark.parametrize("instrument", INSTRUMENTS)
def test_an_instrument_is_read_right(instrument: Callable[[Capture], InstrumentFile], tmp_path: Path) -> None:
    file, path = file_of(instrument), tmp_path / "a.csv"
    path.write_text(file.text)
    recording = read_recording(path, choices(file))
    shift_s = recording.time_s[0] - truth().time_s[0]
    assert wrong_samples(recording, file, shift_s) == 0
    assert len(recording.time_s) == len(truth().time_s)
    assert (recording.voltage_v is not None) == file.has_voltage


@pytest.mark.parametrize("instrument", INSTRUMENTS)
def test_without_an_option_it_is_read_right_or_the_sentence_names_one(
    instrument: Callable[[Capture], InstrumentFile], tmp_path: Path
) -> None:
    """The option that the sentence names is the right one, but for the blanks that only the user can fill."""
    file, path = file_of(instrument), tmp_path / "a.csv"
    path.write_text(file.text)

    def right(recording: Recording) -> None:
        assert wrong_samples(recording, file, recording.time_s[0] - truth().time_s[0]) == 0

    sentence = refused_or_same(lambda: read_recording(path), path, right)
    if sentence and "--sampling-rate HZ" not in sentence:
        options = [option.replace("(mV)", "") for option in options_of(sentence)]
        assert any(fits(option, named) for option in options for named in file.columns), sentence


def rows_begin(lines: list[str]) -> int:
    """Where the numbers begin."""
    tail = lines[-1].count(",") + lines[-1].count(";") + lines[-1].count("\t")
    return next(
        n
        for n, line in enumerate(lines)
        if re.match(r"^\s*[-+]?\d", line) and line.count(",") + line.count(";") + line.count("\t") == tail
    )


def with_rows(change: Callable[[list[str], Random], list[str]]) -> Callable[[str, Random], str]:
    """A change of the rows below the header."""

    def changed(text: str, rng: Random) -> str:
        lines = text.splitlines()
        begin = rows_begin(lines)
        return "\n".join([*lines[:begin], *change(lines[begin:], rng)]) + "\n"

    return changed


def with_row(change: Callable[[str, Random], list[str]]) -> Callable[[str, Random], str]:
    """A change of one row."""

    def changed(rows: list[str], rng: Random) -> list[str]:
        place = int(rng.integers(1, len(rows) - 1))
        return [*rows[:place], *change(rows[place], rng), *rows[place + 1 :]]

    return with_rows(changed)


def with_cell(change: Callable[[str, Random], str]) -> Callable[[str, Random], str]:
    """A change of one cell of one row."""

    def changed(row: str, rng: Random) -> list[str]:
        mark = ";" if ";" in row else "\t" if "\t" in row else ","
        cells = row.split(mark)
        place = int(rng.integers(len([cell for cell in cells if cell])))
        cells[place] = change(cells[place], rng)
        return [mark.join(cells)]

    return with_row(changed)


def delimited(mark: str, decimal: str = ".") -> Callable[[str, Random], str]:
    def changed(text: str, _: Random) -> str:
        if ";" in text or "\t" in text:
            return text
        return text.replace(",", "\0").replace(".", decimal).replace("\0", mark)

    return changed


def swapped(rows: list[str], rng: Random) -> list[str]:
    place = int(rng.integers(len(rows) - 1))
    return [*rows[:place], rows[place + 1], rows[place], *rows[place + 2 :]]


def without_header(text: str, _: Random) -> str:
    lines = text.splitlines()
    return "\n".join(lines[rows_begin(lines) :]) + "\n"


def without_last_header_row(text: str, _: Random) -> str:
    lines = text.splitlines()
    begin = rows_begin(lines)
    return "\n".join([*lines[: max(begin - 1, 0)], *lines[begin:]]) + "\n"


def with_preamble(text: str, rng: Random) -> str:
    return "".join(f"Setting {n},{rng.integers(100)}\n" for n in range(int(rng.integers(1, 9)))) + "\n" + text


def quoted(text: str, _: Random) -> str:
    mark = ";" if ";" in text else "\t" if "\t" in text else ","
    return "\n".join(
        mark.join(f'"{cell}"' if cell else "" for cell in line.split(mark)) for line in text.split("\n")
    )


NO_NUMBERS = ["nan", "---", "OL", "1.#INF", "#N/A", "inf", "0x1F"]
MANGLINGS: dict[str, Callable[[str, Random], str]] = {
    "line ends of Windows": lambda text, _: text.replace("\n", "\r\n"),
    "line ends of an old Mac": lambda text, _: text.replace("\n", "\r"),
    "mark of UTF-8": lambda text, _: "\ufeff" + text,
    "semicolons": delimited(";"),
    "tabs": delimited("\t"),
    "semicolons and decimal commas": delimited(";", ","),
    "tabs and decimal commas": delimited("\t", ","),
    "decimal commas between commas": delimited(",", ","),
    "blank lines": with_row(lambda row, _: [row, "", "  "]),
    "marks at the ends": lambda text, _: re.sub("\n", ",\n", text) if ";" not in text else text,
    "blank end": lambda text, _: text + "\n \n\n",
    "cut off": lambda text, rng: text[: int(rng.integers(len(text) // 2, len(text)))],
    "cell empty": with_cell(lambda cell, _: ""),
    "cell no number": with_cell(lambda cell, rng: str(rng.choice(NO_NUMBERS))),
    "cell with a letter": with_cell(lambda cell, rng: cell + str(rng.choice(list("abxV%")))),
    "cell doubled": with_row(lambda row, _: [row + "," + row.split(",")[-1]]),
    "cell in excess": with_row(lambda row, _: [row.rstrip(",;") + ",1.5"]),
    "row short": with_row(lambda row, _: [re.split("[,;\t]", row)[0]]),
    "row doubled": with_row(lambda row, _: [row, row]),
    "row missing": with_row(lambda row, _: []),
    "rows swapped": with_rows(swapped),
    "rows joined": with_rows(lambda rows, _: [rows[0] + "," + rows[1], *rows[2:]]),
    "row split": with_row(lambda row, _: [row[: len(row) // 2], row[len(row) // 2 :]]),
    "remark between": with_row(lambda row, _: [row, "# trigger"]),
    "header between": lambda text, _: text + text,
    "quotes": quoted,
    "blanks": lambda text, _: text.replace(",", " , ") if ";" not in text else text.replace(";", " ; "),
    "thousands": with_cell(lambda cell, _: re.sub(r"^(-?\d)(\d{3})", r"\1'\2", cell + "1234")),
    "digits grouped": with_cell(lambda cell, _: "1 234.5"),
    "no header": without_header,
    "no units": without_last_header_row,
    "preamble": with_preamble,
    "capitals": lambda text, _: text.upper(),
    "another minus": lambda text, _: text.replace("-", "\u2212"),
    "bytes of nothing": lambda text, rng: text[: int(rng.integers(len(text)))] + "\0" * 9 + text[9:],
}  # fmt: skip
_OF_ROWS = ("row missing", "row doubled", "rows swapped", "cut off", "header between", "row split")


def check_mangled(n: int, path: Path) -> str:
    """Mangle one file; what became of it: right, said or refused."""
    rng = np.random.default_rng([20, n])
    instrument = INSTRUMENTS[n % len(INSTRUMENTS)]
    names = [name for name in MANGLINGS if instrument not in (bare, serial_monitor) or name not in _OF_ROWS]
    name = names[int(rng.integers(len(names)))]
    file = file_of(instrument)
    path.write_text(MANGLINGS[name](file.text, rng), encoding="utf-8", newline="")
    became = "right"

    def same(recording: Recording) -> None:
        nonlocal became
        wrong = wrong_samples(recording, file, first_s(instrument) - truth().time_s[0])
        if wrong > 2 and any(
            words in note for note in recording.columns for words in ("taken as", "cut off", "begins anew")
        ):
            became = "said"
        else:  # a row that is missing is interpolated
            assert wrong <= 2, (instrument.__name__, name, wrong, recording.columns)

    return "refused" if refused_or_same(lambda: read_recording(path, choices(file)), path, same) else became


def test_two_hundred_mangled_files_are_right_or_refused(tmp_path: Path) -> None:
    seen = [check_mangled(n, tmp_path / "a.csv") for n in range(200)]
    assert seen.count("right") > 60
    assert seen.count("refused") > 60
    assert seen.count("said") < 10
