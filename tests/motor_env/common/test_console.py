"""The frame of the commands: exit statuses, one sentence for bad input, files whole or not at all."""

import math
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from cyclopts import App

from motor_classifiers.cli import main as classifiers_cli
from motor_datasets import cli as datasets_cli
from motor_env import InputError, cli, diagnose, identify
from motor_env.common import console
from motor_env.common.arrays import shown
from motor_env.common.console import ExitStatus
from motor_env.common.errors import require_extra, require_options
from motor_env.common.files import replacing, write_text


def _app(error: BaseException | None = None) -> App:
    app = App(name="tool")

    @app.command
    def work(count: int = 1) -> int:
        if error is not None:
            raise error
        return 0 * count

    return app


def test_a_closed_stream_is_no_bug(monkeypatch: pytest.MonkeyPatch) -> None:
    for stream in ("sys.stdout", "sys.stderr"):
        monkeypatch.setattr(stream, None)
    assert console.run(_app(InputError("no")), ["work"]) == ExitStatus.BAD_INPUT
    for opened in (sys.stdout, sys.stderr):
        opened.close()


NO_ROOM = ImportError("a.so: failed to map segment from shared object")


@pytest.mark.parametrize(
    ("error", "status", "sentence"),
    [
        (None, ExitStatus.HEALTHY, ""),
        (InputError("inductance_h must be > 0"), ExitStatus.BAD_INPUT, "tool: inductance_h must be > 0\n"),
        (ValueError("no such motor"), ExitStatus.BAD_INPUT, "tool: no such motor\n"),
        (PermissionError(13, "Permission denied", "a"), ExitStatus.BAD_INPUT, "tool: a: permission denied\n"),
        (MemoryError(), ExitStatus.BAD_INPUT, "tool: there is too little memory (no room left)\n"),
        (NO_ROOM, ExitStatus.BAD_INPUT, f"tool: there is too little memory ({NO_ROOM})\n"),
        (KeyboardInterrupt(), 130, "tool: interrupted\n"),
        (KeyboardInterrupt(signal.SIGTERM), 143, "tool: interrupted\n"),
        (ZeroDivisionError("by zero"), ExitStatus.BUG, "ZeroDivisionError: by zero\n"),
    ],
)
def test_an_error_has_its_status_and_is_one_sentence_but_for_a_bug(
    error: BaseException | None, status: int, sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert console.run(_app(error), ["work"]) == status
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.endswith(sentence)
    assert ("Traceback" in captured.err) == (status == ExitStatus.BUG)
    assert status == ExitStatus.BUG or captured.err == sentence


@pytest.mark.parametrize("arguments", [["work", "--count", "many"], ["work", "--colour", "red"], ["rest"]])
def test_wrong_use_is_one_sentence(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert console.run(_app(), arguments) == ExitStatus.BAD_INPUT
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("tool: ")
    assert captured.err.count("\n") == 1


@pytest.mark.parametrize("number", ["1.5", "1e3", "nan", "9" * 5000, "1_0", "\u0661"])
@pytest.mark.parametrize(
    ("main", "arguments"),
    [
        (datasets_cli.main, ["generate", "bench", "--cases", "3", "--out", "x", "--seed"]),
        (cli.main, ["lab", "--no-browser", "--port"]),
        (cli.main, ["diagnose", "x.csv", "--start"]),
        (classifiers_cli.main, ["benchmark", "--dry-run", "--seed"]),
    ],
)
def test_whole_numbers_are_not_rounded(
    main: Callable[[list[str]], int], arguments: list[str], number: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*arguments, number]) == ExitStatus.BAD_INPUT
    said = capsys.readouterr().err
    assert "must be a whole number" in said
    assert said.count("\n") == 1


def test_sigterm_interrupts_as_ctrl_c_does() -> None:
    code = (
        "import os, signal, time; from cyclopts import App; from motor_env.common import console\n"
        "app = App(name='tool')\n"
        "@app.command\n"
        "def work():\n"
        "    try: os.kill(os.getpid(), signal.SIGTERM); time.sleep(30)\n"
        "    except KeyboardInterrupt: AGAIN\n"
        "raise SystemExit(console.run(app, ['work']))"
    )
    # A compiled library that is being imported makes an error of its own of it.
    for again in ("raise", "raise SystemError('initialization failed')"):
        command = [sys.executable, "-c", code.replace("AGAIN", again)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert (done.returncode, done.stderr) == (143, "tool: interrupted\n")


def test_whoever_waits_without_a_terminal_is_told_what_for_and_how_long(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with console.working("reading"):
        pass
    assert capsys.readouterr().err == ""  # it was done before anybody lost patience
    monkeypatch.setattr(console, "PATIENCE_S", 0.01)
    monkeypatch.setattr(console, "LATER_S", 0.01)
    said = ""
    with console.working("reading", 4.0) as update:
        while "\n" not in said:
            said += capsys.readouterr().err
        assert said.startswith("reading ...\n")
        update(advance=1.0, description="fitting b.csv")
        while not re.search("fitting b\\.csv \\.\\.\\. 25%, about \\d+ s left\n", said):
            said += capsys.readouterr().err


def test_what_steers_a_terminal_is_shown_as_text() -> None:
    assert console.printable("a\x1b[31mb\tc\nd\u202e é") == "a\\x1b[31mb\tc\nd\\u202e é"


def test_examples_are_written_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = Path(console.__file__).parents[2] / "examples"
    names = sorted(file.name for file in source.glob("*.*"))
    (tmp_path / names[0]).write_text("mine")
    assert cli.main(["examples", str(tmp_path)]) == 0
    assert capsys.readouterr().out.split() == [str(tmp_path / name) for name in names[1:]]
    assert (tmp_path / names[0]).read_text() == "mine"
    for name in names[1:]:
        assert (tmp_path / name).read_bytes() == (source / name).read_bytes()
    assert cli.main(["examples", str(tmp_path)]) == 0
    assert capsys.readouterr().out == ""


def test_files_appear_whole_or_not_at_all(tmp_path: Path) -> None:
    target = tmp_path / "deep" / "a.txt"
    with pytest.raises(KeyError), replacing(target) as temporary:
        raise KeyError(temporary.write_text("half"))
    assert list(target.parent.iterdir()) == []
    write_text(target, "whole\n")
    assert target.read_text() == "whole\n"
    umask = os.umask(0)
    os.umask(umask)
    assert target.stat().st_mode & 0o777 == 0o666 & ~umask


def test_a_closed_pipe_ends_quietly() -> None:
    command = [sys.executable, "-m", "motor_datasets", "describe", "bench"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        said = process.stderr.read()
    assert said == b""
    assert process.returncode == 128 + 13  # SIGPIPE


def test_what_is_no_number_of_json_is_null() -> None:
    value = {"a": (1, float("nan"), [float("-inf")]), "b": "inf", "c": {"d": 0.5}, "e": None}
    text = '{"a": [1, null, [null]], "b": "inf", "c": {"d": 0.5}, "e": null}'
    assert console.json_text(value, indent=None) == text


def test_a_missing_extra_names_what_to_install() -> None:
    require_extra("numpy", "dask")
    with pytest.raises(InputError, match=r"pip install 'motor-env\[dask\]'"):
        require_extra("no_such_module_anywhere", "dask")


def test_options_are_refused_beyond_their_bounds_by_the_name_that_a_command_has() -> None:
    require_options(false_alarm_rate=1e-300, voltage=1e-300, window=None)
    require_options(false_alarm_rate=math.nextafter(0.5, 0.0))
    with pytest.raises(InputError, match=r"^false-alarm-rate must lie between 0 and 0\.5, got 0\.5$"):
        diagnose("none.csv", false_alarm_rate=0.5)
    with pytest.raises(InputError, match=r"^torque-constant must be > 0, got nan$"):
        identify(["none.csv"], constant=math.nan)


def test_a_sentence_is_one_line_and_has_an_end() -> None:
    assert str(InputError("a\nb\u2028c")) == "a b c"
    assert str(InputError("x" * 1000)) == "x" * 1000
    assert str(InputError("x" * 1001)) == "x" * 1000 + " ..."


@pytest.mark.parametrize(("size", "text"), [(3, "[0.0, 0.0, 0.0]"), (4, "an array of shape (4,)")])
def test_a_short_array_is_shown(size: int, text: str) -> None:
    assert shown(np.zeros(size)) == text


def test_an_unwritable_folder_is_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("")
    assert cli.main(["reproduce", "--out", str(tmp_path / "file" / "out")]) == ExitStatus.BAD_INPUT
    assert capsys.readouterr().err.count("\n") == 1
