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
HAS_OWN_TEST = {
    "motor-env reproduce --out out/paper"
}  # tests/motor_env/apps/test_paper.py runs it in a new folder
README = Path(__file__).parent.parent / "README.md"


def blocks(language: str) -> list[str]:
    return re.findall(
        rf"^```{language}\n(.*?)^```", README.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL
    )


def test_the_path_through_the_code_runs(capsys: pytest.CaptureFixture[str]) -> None:
    """From an equation to an agent: one session, block after block."""
    door = README.parent / "motor_env" / "README.md"
    path = re.findall(r"^```python\n(.*?)^```", door.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    exec(compile("\n".join(path), door.name, "exec"), {"__name__": "__main__"})  # noqa: S102  # it is our own
    assert "alarm at sample [362]" in capsys.readouterr().out


def commands() -> list[str]:
    lines = "\n".join(blocks("bash")).replace("\\\n", " ").splitlines()
    return [line.split("  #")[0].strip() for line in lines if line.startswith("motor-")]


@pytest.mark.parametrize("block", blocks("python"))
def test_python_blocks_run(
    block: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(README.parent)
    shorter = block.replace("300_000", "2_048")  # a training that takes two minutes
    exec(compile(shorter, README.name, "exec"), {"__name__": "__main__"})  # noqa: S102  # it is our own
    assert capsys.readouterr().out


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
        if command in HAS_OWN_TEST:
            continue
        program, *arguments = shlex.split(command)
        # 1 is a verdict too: the README's example motor has a fault.
        expected = (0, 1) if arguments[0] in ("diagnose", "predict") else (0,)
        assert PROGRAMS[program](arguments) in expected, f"{command}\n{capsys.readouterr().err}"
    plt.close("all")
