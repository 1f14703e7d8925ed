"""The script of a stranger: public names alone, from a method to its row, answers and score."""

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).resolve().parents[3] / "examples" / "own_method.py"


def test_it_takes_public_names_alone() -> None:
    text = SCRIPT.read_text(encoding="utf-8")
    imports = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.ImportFrom)]
    ours = {
        node.module: [alias.name for alias in node.names]
        for node in imports
        if (node.module or "").startswith("motor_")
    }
    assert set(ours) == {"motor_classifiers", "motor_env"}
    for module, names in ours.items():
        assert set(names) <= set(importlib.import_module(str(module)).__all__)


@pytest.mark.long
@pytest.mark.timeout(600)
def test_it_runs_from_the_method_to_the_score(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, str(SCRIPT), str(tmp_path)], capture_output=True, text=True, check=True, timeout=580
    )
    assert "own_method.py:small_network" in done.stdout
    assert "points more than the best possible" in done.stdout
