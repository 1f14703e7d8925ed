"""The wheel as a stranger gets it: what is in it, what it asks for, and whom it lives beside."""

import email
import email.message
import json
import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("motor_env", "motor_datasets", "motor_classifiers")


def run_python(code: str, *arguments: str, cwd: Path, first_on_path: Path | None = None) -> str:
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    if first_on_path is not None:
        environment["PYTHONPATH"] = str(first_on_path)
    environment["HF_HUB_OFFLINE"] = "1"
    environment["HF_HOME"] = str(cwd / "huggingface")
    finished = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        cwd=cwd,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert finished.returncode == 0, finished.stderr
    return finished.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    subprocess.run(command, cwd=ROOT, capture_output=True, check=True)
    (built,) = folder.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    target = tmp_path_factory.mktemp("installed")
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--no-compile"]
    subprocess.run([*command, "--target", str(target), str(wheel)], capture_output=True, check=True)
    return target


@pytest.fixture(scope="module")
def metadata(wheel: Path) -> email.message.Message:
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        return email.message_from_bytes(archive.read(name))


def test_wheel_holds_the_three_packages_and_nothing_beside_them(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
    top_level = {name.split("/")[0] for name in names}
    assert {name for name in top_level if not name.endswith(".dist-info")} == set(PACKAGES)
    for package in PACKAGES:
        assert f"{package}/__init__.py" in names
        assert f"{package}/py.typed" in names
    assert "motor_classifiers/model_files/pretrained/paper-motor.safetensors" in names
    assert "motor_env/examples/startup_capture.csv" in names  # for `motor-env examples`


def test_description_for_the_package_index_has_no_link_into_the_repository(
    metadata: email.message.Message,
) -> None:
    description = metadata.get_payload()
    assert isinstance(description, str)
    assert "Is this DC motor failing" in description
    assert "Classifiers beside the best possible" in description
    assert re.findall(r"\]\((?!https?:)[^)]*\)", description) == []


def test_folders_around_the_packages_are_no_packages() -> None:
    for folder in ("datasets", "classifiers", "tests"):
        assert not (ROOT / folder / "__init__.py").exists()


def test_packages_import_from_the_wheel_beside_hugging_face_datasets(installed: Path, tmp_path: Path) -> None:
    code = """
import importlib, json, sys
files = [importlib.import_module(name).__file__ for name in sys.argv[1:]]
import datasets
rows = datasets.Dataset.from_dict({"label": [0, 1], "current_a": [[1.0, 2.0], [3.0, 4.0]]})
print(json.dumps({"files": files, "rows": rows.to_dict(), "hugging_face": hasattr(datasets, "load_dataset")}))
"""
    answer = json.loads(run_python(code, *PACKAGES, cwd=tmp_path, first_on_path=installed))
    assert [Path(file).parent for file in answer["files"]] == [installed / package for package in PACKAGES]
    assert answer["rows"] == {"label": [0, 1], "current_a": [[1.0, 2.0], [3.0, 4.0]]}
    assert answer["hugging_face"]


def test_hugging_face_datasets_imports_from_the_root_of_the_repository() -> None:
    finished = subprocess.run(
        [sys.executable, "-c", "import datasets; print(hasattr(datasets, 'load_dataset'))"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    assert finished.stdout.strip() == "True"


def test_core_asks_for_no_learning_library(metadata: email.message.Message) -> None:
    requirements: list[str] = metadata.get_all("Requires-Dist", [])
    core = [requirement.lower() for requirement in requirements if "extra ==" not in requirement]
    assert core
    assert not [requirement for requirement in core if requirement.startswith(("torch", "scikit-learn"))]


def test_importing_motor_env_is_light(tmp_path: Path) -> None:
    imported = set(run_python("import sys, motor_env; print(*sys.modules)", cwd=tmp_path).split())
    heavy = {"torch", "sklearn", "pandas", "pyarrow", "numba", "matplotlib", "pydantic", "cyclopts"}
    assert imported & heavy == set()


@pytest.mark.parametrize("command", ["motor-env", "motor-datasets", "motor-classifiers"])
def test_console_scripts_are_declared(command: str, installed: Path) -> None:
    (entry_points,) = installed.glob("motor_env-*.dist-info/entry_points.txt")
    module = f"{command.replace('-', '_')}.cli"
    module += ".main" if command == "motor-classifiers" else ""
    assert f"{command} = {module}:main" in entry_points.read_text().splitlines()


def test_pins_name_no_host_and_no_local_build() -> None:
    for file in (ROOT / "constraints.txt", ROOT / "benchmarks" / "constraints.txt"):
        for line in file.read_text().splitlines():
            name, separator, version = line.partition("==")
            assert separator, f"{file.name}: {line!r} is not a pin"
            assert name.isascii()
            assert "+" not in version
            assert "/" not in line
            assert "@" not in line
