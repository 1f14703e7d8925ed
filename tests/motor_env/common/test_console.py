"""The frame of the commands: exit statuses, one sentence for bad input."""

import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import cast

import pytest
from cyclopts import App

from motor_classifiers.cli import main as classifiers_cli
from motor_datasets import cli as datasets_cli
from motor_env import InputError, cli
from motor_env.common import console
from motor_env.common.console import ExitStatus
from motor_env.common.errors import require_extra
from motor_env.common.files import replacing, write_text


def _app(error: Exception | None = None, status: int | None = None) -> App:
    app = App(name="tool")

    @app.command
    def work(count: int = 1) -> int | None:
        if error is not None:
            raise error
        return None if status is None else status * count

    return app


def test_status_of_the_command_is_passed_on() -> None:
    assert console.run(_app(status=3), ["work"]) == ExitStatus.UNDECIDED
    assert console.run(_app(), ["work"]) == ExitStatus.HEALTHY


def test_a_closed_stream_is_no_bug(monkeypatch: pytest.MonkeyPatch) -> None:
    app = App(name="tool")
    app.command(lambda: sys.stdout.write("said"), name="work")
    monkeypatch.setattr("sys.stdout", None)
    monkeypatch.setattr("sys.stderr", None)
    assert console.run(app, ["work"]) != ExitStatus.BUG
    assert console.run(_app(InputError("no")), ["work"]) == ExitStatus.BAD_INPUT
    for stream in (sys.stdout, sys.stderr):
        stream.close()


@pytest.mark.parametrize(
    ("error", "sentence"),
    [
        (InputError("inductance_h must be > 0, got -0.1"), "tool: inductance_h must be > 0, got -0.1\n"),
        (ValueError("no such motor"), "tool: no such motor\n"),
        (PermissionError(13, "Permission denied", "there.csv"), "tool: there.csv: permission denied\n"),
        (MemoryError(), "tool: there is too little memory (no room left)\n"),
        (
            ImportError("a.so: failed to map segment from shared object"),
            "tool: there is too little memory (a.so: failed to map segment from shared object)\n",
        ),
    ],
)
def test_bad_input_is_one_sentence(
    error: Exception, sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert console.run(_app(error), ["work"]) == ExitStatus.BAD_INPUT
    captured = capsys.readouterr()
    assert (captured.out, captured.err) == ("", sentence)


@pytest.mark.parametrize("arguments", [["work", "--count", "many"], ["work", "--colour", "red"], ["rest"]])
def test_wrong_use_is_one_sentence(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert console.run(_app(status=0), arguments) == ExitStatus.BAD_INPUT
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("tool: ")
    assert captured.err.count("\n") == 1


@pytest.mark.parametrize("number", ["1.5", "2.7", "1e3", "nan", "0.0", "9" * 5000, "1_0", "\u0661"])
def test_whole_numbers_are_not_rounded(number: str, capsys: pytest.CaptureFixture[str]) -> None:
    commands = [
        (datasets_cli.main, ["generate", "bench", "--cases", "3", "--out", "x", "--seed", number]),
        (datasets_cli.main, ["generate", "bench", "--cases", number, "--out", "x", "--seed", "1"]),
        (cli.main, ["lab", "--no-browser", "--port", number]),
        (cli.main, ["diagnose", "x.csv", "--start", number]),
        (classifiers_cli.main, ["benchmark", "--dry-run", "--seed", number]),
    ]
    for main, arguments in commands:
        assert main(arguments) == ExitStatus.BAD_INPUT
        said = capsys.readouterr().err
        assert "must be a whole number" in said
        assert said.count("\n") == 1
    assert classifiers_cli.main(["benchmark", "--dry-run", "--n-train", "100.5"]) == ExitStatus.BAD_INPUT


@pytest.mark.parametrize("cases", [10**12, 10**18])
def test_more_cases_than_files_can_be_named_are_refused_at_once(
    cases: int, capsys: pytest.CaptureFixture[str]
) -> None:
    for more in ([], ["--dry-run"]):
        command = ["generate", "bench", "--cases", str(cases), "--seed", "1", "--out", "x", *more]
        assert datasets_cli.main(command) == ExitStatus.BAD_INPUT
        assert "cases must" in capsys.readouterr().err


def test_a_bug_is_neither_bad_input_nor_a_fault(capsys: pytest.CaptureFixture[str]) -> None:
    assert console.run(_app(ZeroDivisionError("by zero")), ["work"]) == ExitStatus.BUG
    assert "Traceback" in (captured := capsys.readouterr().err)
    assert captured.endswith("ZeroDivisionError: by zero\n")


def test_interrupt(capsys: pytest.CaptureFixture[str]) -> None:
    app = App(name="tool")

    @app.command
    def work() -> None:
        raise KeyboardInterrupt

    assert console.run(app, ["work"]) == 130
    assert capsys.readouterr().err == "tool: interrupted\n"


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_with_the_status_that_a_shell_gives_it(number: int) -> None:
    assert console.run(_app(cast("Exception", KeyboardInterrupt(number))), ["work"]) == 128 + number


def test_sigterm_interrupts_as_ctrl_c_does() -> None:
    """In a process of its own, which waits."""
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
    for again in ("raise", "raise SystemError('initialization failed')", "raise ImportError('no core')"):
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

    def fail() -> None:
        with replacing(target) as temporary:
            temporary.write_text("half")
            assert temporary.parent == target.parent
            raise KeyError

    with pytest.raises(KeyError):
        fail()
    assert list(target.parent.iterdir()) == []
    write_text(target, "whole\n")
    assert target.read_text() == "whole\n"
    umask = os.umask(0)
    os.umask(umask)
    assert target.stat().st_mode & 0o777 == 0o666 & ~umask


def test_missing_extra_names_what_to_install() -> None:
    with pytest.raises(InputError, match=r"pip install 'motor-env\[dask\]'"):
        require_extra("no_such_module_anywhere", "dask")
    require_extra("numpy", "dask")


def test_help_and_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--help"]) == 0
    assert "reproduce" in capsys.readouterr().out
    assert cli.main(["reproduce", "--help"]) == 0
    assert "Example: motor-env reproduce" in " ".join(capsys.readouterr().out.split())


def test_unwritable_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("")
    assert cli.main(["reproduce", "--out", str(tmp_path / "file" / "out")]) == ExitStatus.BAD_INPUT
    assert capsys.readouterr().err.count("\n") == 1


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
    assert (
        console.json_text(value, indent=None)
        == '{"a": [1, null, [null]], "b": "inf", "c": {"d": 0.5}, "e": null}'
    )
