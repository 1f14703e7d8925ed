"""What a user of the installed package meets: a missing extra is named in one sentence, and the examples are there."""

import importlib
import sys
from pathlib import Path

import pytest

from motor_env import InputError, cli, load_recipe


@pytest.mark.parametrize(
    ("library", "package", "name", "extra", "loaded"),
    [
        ("stable_baselines3", "motor_env.envs", "StableBaselinesVecEnv", "rl", "motor_env.envs.adapters"),
        ("pyarrow", "motor_datasets", "generate_dataset", "datasets", "motor_datasets.parquet"),
        (
            "sklearn",
            "motor_classifiers",
            "make_method",
            "classifiers",
            "motor_classifiers.estimators.methods",
        ),
        ("torch", "motor_classifiers", "PosteriorNetwork", "classifiers", "motor_classifiers.estimators"),
    ],
)
def test_missing_extra_is_named(
    monkeypatch: pytest.MonkeyPatch, library: str, package: str, name: str, extra: str, loaded: str
) -> None:
    module = importlib.import_module(package)
    for each in (library, loaded, "motor_datasets.folder"):
        monkeypatch.delitem(sys.modules, each, raising=False)
    monkeypatch.delitem(vars(module), name, raising=False)
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(InputError, match=rf"^this needs {library}, .* pip install 'motor-env\[{extra}\]'$"):
        getattr(module, name)


def test_missing_torch_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    from motor_datasets import generate_arrays, to_torch, to_torch_iterable

    starts = generate_arrays(load_recipe("bench"), 1, range(2))
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(InputError, match="pip install"):
        to_torch(starts)
    with pytest.raises(InputError, match="pip install"):
        to_torch_iterable(load_recipe("bench"), 1)


def test_examples_are_copied_and_nothing_is_overwritten(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "motor.toml").write_text("mine")
    assert cli.main(["examples", str(tmp_path)]) == 0
    written = capsys.readouterr().out.split()
    assert str(tmp_path / "startup_capture.csv") in written
    assert (tmp_path / "motor.toml").read_text() == "mine"
    assert {Path(each).suffix for each in written} == {".py", ".csv"}
