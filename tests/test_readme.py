"""Every line of the README runs: in this process, as starting one for each would take most of the time."""

import re
import shlex
from pathlib import Path

import matplotlib.pyplot as plt
import pytest

from motor_classifiers.cli.main import main as classifiers
from motor_datasets.cli import main as datasets
from motor_env.cli import main as env

PROGRAMS = {"motor-env": env, "motor-datasets": datasets, "motor-classifiers": classifiers}
# tests/motor_env/apps/test_paper.py runs it in a new folder.
HAS_OWN_TEST = {"motor-env reproduce --out out/paper"}
README = Path(__file__).parent.parent / "README.md"
DOOR = README.parent / "motor_env" / "README.md"


def blocks(page: Path, language: str) -> list[str]:
    text = page.read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


def commands() -> list[str]:
    lines = "\n".join(blocks(README, "bash")).replace("\\\n", " ").splitlines()
    return [line.split("  #")[0].strip() for line in lines if line.startswith("motor-")]


@pytest.mark.parametrize(
    ("block", "printed"),
    [
        ("\n".join(blocks(DOOR, "python")), "alarm at sample [362]"),
        *((b, "") for b in blocks(README, "python")),
    ],
)
def test_python_runs(
    block: str, printed: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(README.parent)
    shorter = block.replace("300_000", "2_048")  # a training that takes two minutes
    exec(compile(shorter, README.name, "exec"), {"__name__": "__main__"})  # noqa: S102  # it is our own
    out = capsys.readouterr().out
    assert out
    assert printed in out


@pytest.mark.timeout(600)
def test_commands_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """In order, in an empty folder: what one writes, a later one may read."""
    (tmp_path / "examples").symlink_to(README.parent / "examples")
    monkeypatch.chdir(tmp_path)
    assert len(commands()) >= 5
    assert set(commands()) >= HAS_OWN_TEST
    for command in commands():
        program, *arguments = shlex.split(command)
        # 1 is a verdict too: the README's example motor has a fault.
        expected = (0, 1) if arguments[0] in ("diagnose", "predict") else (0,)
        if command not in HAS_OWN_TEST:
            assert PROGRAMS[program](arguments) in expected, f"{command}\n{capsys.readouterr().err}"
    plt.close("all")
