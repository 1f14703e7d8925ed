"""Recordings in a folder: one verdict each, a trend at the end."""

import json
from pathlib import Path

import pytest

from motor_env import InputError
from motor_env.apps.folder import appearing, recordings_in, trend_of
from motor_env.cli import main

# Reaches in: a file that is gone since it was seen is refused there.
from motor_env.diagnosis.file_verdicts import diagnose_files

EXAMPLES = Path(__file__).parents[3] / "examples"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three starts, and what else may lie beside them."""
    there = tmp_path / "starts"
    there.mkdir()
    for number in (1, 2, 3):
        (there / f"{number}.csv").write_bytes((EXAMPLES / "startup_capture.csv").read_bytes())
    for name in ("motor.toml", ".4.csv", "page.html"):
        (there / name).write_text("no recording")
    return there


def test_each_start_of_a_folder_has_a_verdict_and_a_trend_follows(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    motor = str(EXAMPLES / "motor.toml")
    assert main(["diagnose", str(folder), "--motor", motor]) == 1
    told = capsys.readouterr().out
    assert told.count(": bearing +31%") == 3
    assert "K^2/J" in told.partition("trends of the starts:\n")[2]
    assert main(["diagnose", str(folder), "--motor", motor, "--json"]) == 1
    assert len(json.loads(capsys.readouterr().out)) == 3
    (folder / "3.csv").write_text("nonsense")
    assert main(["watch", motor, str(folder)]) == 2
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [event["verdict"] for event in events] == ["bearing", "bearing", "unusable"]
    assert [Path(event["file"]).name for event in events] == ["1.csv", "2.csv", "3.csv"]
    (folder / "3.csv").write_bytes((folder / "2.csv").read_bytes())
    assert main(["watch", motor, str(folder)]) == 1
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [event["event"] for event in events[:4]] == [*3 * ["recording"], "trend"]
    assert main(["watch", motor, str(folder), "--state", "s.json"]) == 2
    assert "--state does not go with a folder" in capsys.readouterr().err


def test_a_start_that_is_gone_does_not_take_the_trend_of_the_others_along(folder: Path) -> None:
    starts = [folder / "0.csv", *recordings_in([folder])]
    starts[0].write_bytes(starts[1].read_bytes())
    outcomes = diagnose_files(starts, motor=str(EXAMPLES / "motor.toml"))
    starts[0].unlink()
    assert trend_of(outcomes) is not None
    starts[1].unlink()
    assert trend_of(outcomes) is None


def test_a_recording_is_judged_once_it_grows_no_more(folder: Path) -> None:
    grown = folder / "4.csv"

    def sleep(_: float) -> None:
        if grown.exists() and len(grown.read_text()) < 6:
            grown.write_text(grown.read_text() + "1\n")
        elif not grown.exists():
            grown.write_text("")

    found = appearing(folder, follow=True, sleep=sleep)
    assert [next(found).name for _ in range(4)] == ["1.csv", "2.csv", "3.csv", "4.csv"]
    assert grown.read_text() == "1\n1\n1\n"
    assert [path.name for path in appearing(folder, follow=False)] == ["1.csv", "2.csv", "3.csv", "4.csv"]


def test_a_folder_without_recordings_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no recording"):
        recordings_in([tmp_path])
    assert recordings_in([tmp_path / "any.name"]) == [tmp_path / "any.name"]
