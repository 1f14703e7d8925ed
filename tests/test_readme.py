"""Every line of the README runs."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

README = Path(__file__).parent.parent / "README.md"


def blocks(language: str) -> list[str]:
    return re.findall(
        rf"^```{language}\n(.*?)^```", README.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL
    )


def commands() -> list[str]:
    lines = "\n".join(blocks("bash")).replace("\\\n", " ").splitlines()
    return [line.split("  #")[0].strip() for line in lines if line.startswith("motor-")]


def test_python_blocks_run() -> None:
    code = blocks("python")
    assert code
    for block in code:
        done = subprocess.run(
            [sys.executable, "-W", "error", "-c", block],
            cwd=README.parent,
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        assert done.stdout


@pytest.mark.timeout(600)
def test_commands_run(tmp_path: Path) -> None:
    """In order, in an empty folder: what one writes, a later one may read."""
    (tmp_path / "examples").symlink_to(README.parent / "examples")
    assert len(commands()) >= 5
    for command in commands():
        program, *arguments = shlex.split(command)
        module = program.replace("-", "_")
        done = subprocess.run(
            [sys.executable, "-m", module, *arguments],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
        )
        # 1 is a verdict too: the README's example motor has a fault.
        expected = (0, 1) if arguments[0] in ("diagnose", "predict") else (0,)
        assert done.returncode in expected, f"{command}\n{done.stderr}"


def test_linked_files_exist() -> None:
    links = re.findall(r"\]\((?!https?:)([^)#]+)", README.read_text(encoding="utf-8"))
    assert links
    missing = [link for link in links if not (README.parent / link).exists()]
    assert missing == []
