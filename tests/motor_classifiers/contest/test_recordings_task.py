"""Verdicts on recordings that the user brings are scored by motor."""

import json
from functools import partial
from pathlib import Path

import pytest
from hostile import deep, odd_places, refused

from motor_classifiers.cli.main import main
from motor_classifiers.contest import recordings
from motor_classifiers.contest.recordings import score_recordings
from motor_env import InputError

TRUTH = "file,motor,verdict\na.csv,1,healthy\nb.csv,1,bearing\nc.csv,2,winding\nd.csv,3,healthy\n"
SAID = [
    {"file": "a.csv", "verdict": "healthy", "model_based": {"verdict": "healthy"}},
    {"file": "b.csv", "verdict": "healthy", "model_based": {"verdict": "bearing"}},
    {"file": "c.csv", "verdict": "unusable", "model_based": {"verdict": "winding"}},
    {"file": "d.csv", "verdict": "healthy", "model_based": {"verdict": "healthy"}},
]


def written(folder: Path, truth: str, said: object) -> tuple[Path, Path]:
    paths = folder / "truth.csv", folder / "said.json"
    paths[0].write_text(truth, encoding="utf-8")
    paths[1].write_text(json.dumps(said), encoding="utf-8")
    return paths


def test_wrong_and_silent_shares(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    paths = written(tmp_path, TRUTH, SAID)
    method, model_based = score_recordings(*paths)
    assert (method["wrong"], method["silent"], method["n_motors"]) == (0.5, 0.25, 3)
    assert (method["low"], method["high"]) == (0.0, 1.0)  # motors 1 and 2 are not always drawn
    assert (model_based["method"], model_based["wrong"], model_based["high"]) == ("model_based", 0.0, 0.0)
    assert main(["score-recordings", *map(str, paths)]) == 0
    first, second = capsys.readouterr().out.splitlines()
    assert first == "method, 4 recordings of 3 motors: wrong 50.0 % (0.0 to 100.0), no verdict 25.0 %"
    assert second.startswith("model_based, 4 recordings of 3 motors: wrong 0.0 % (0.0 to 0.0)")


def test_verdicts_of_the_shipped_network_on_the_example(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["predict", "examples/startup_capture.csv", "--json"]) == 1
    said = json.loads(capsys.readouterr().out)
    paths = written(tmp_path, "file,motor,verdict\nexamples/startup_capture.csv,1,bearing\n", said)
    assert [row["wrong"] for row in score_recordings(*paths)] == [0.0, 0.0]


@pytest.mark.parametrize(
    ("truth", "said", "sentence"),
    [
        ("file,motor\na.csv,1\n", SAID, "must have the columns file, motor, verdict"),
        (TRUTH + "a.csv,1,healthy\n", SAID, "a.csv stands in it twice"),
        (TRUTH, [*SAID, SAID[0]], "a.csv stands in it twice"),
        (TRUTH, SAID[:3], "has no verdict of method on 1 recordings, the first is d.csv"),
        (TRUTH, {"a": 1}, "must be a JSON list"),
        (TRUTH, [{"verdict": "healthy"}], "must be a JSON list"),
    ],
)
def test_bad_files_are_one_sentence(tmp_path: Path, truth: str, said: object, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        score_recordings(*written(tmp_path, truth, said))


@pytest.mark.timeout(20)
def test_only_small_regular_files_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    paths = written(tmp_path, TRUTH, SAID)
    for at in paths:
        content = at.read_bytes()
        for odd in odd_places(at):
            asked = [odd if path == at else path for path in paths]
            assert "is no regular file" in refused(partial(score_recordings, *asked), odd)
        at.write_bytes(content)
    paths[1].write_text(deep())
    assert "is not JSON (nested too deep)" in refused(partial(score_recordings, *paths), paths[1])
    paths = written(tmp_path, TRUTH, SAID)
    monkeypatch.setattr(recordings, "MOST_RECORDINGS", 3)
    assert "at most 3 recordings, got 4" in refused(partial(score_recordings, *paths), paths[0])
    monkeypatch.undo()
    for at, small in ((paths[0], len(TRUTH) - 1), (paths[1], len(json.dumps(SAID)) - 1)):
        monkeypatch.setattr(recordings, "LARGEST_TABLE_BYTES", small)
        assert "is larger than" in refused(partial(score_recordings, *paths), at)
