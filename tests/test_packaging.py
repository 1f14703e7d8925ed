"""The wheel as a stranger gets it: what is in it, what it asks for, whom it lives beside, what a missing extra says."""

import email
import email.message
import importlib
import json
import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from motor_datasets import generate_arrays, to_torch, to_torch_iterable
from motor_env import InputError, cli, load_recipe

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("motor_env", "motor_datasets", "motor_classifiers")
EXTRAS = [
    ("stable_baselines3", "motor_env.envs", "StableBaselinesVecEnv", "rl", "adapters"),
    ("pyarrow", "motor_datasets", "generate_dataset", "datasets", "parquet"),
    ("sklearn", "motor_classifiers", "make_method", "classifiers", "estimators.methods"),
    ("torch", "motor_classifiers", "PosteriorNetwork", "classifiers", "estimators"),
]
BESIDE_HUGGING_FACE = """
import importlib, json, sys
files = [importlib.import_module(name).__file__ for name in sys.argv[1:]]
import datasets
rows = datasets.Dataset.from_dict({"label": [0, 1]})
print(json.dumps({"files": files, "rows": rows.to_dict(), "is_theirs": hasattr(datasets, "load_dataset")}))
"""


def run_python(code: str, *arguments: str, cwd: Path, path: str = "") -> str:
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    environment |= {"HF_HUB_OFFLINE": "1", "HF_HOME": str(cwd / "huggingface"), "PYTHONPATH": path}
    command = [sys.executable, "-c", code, *arguments]
    done = subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


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
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(target)
    return target


@pytest.fixture(scope="module")
def metadata(installed: Path) -> email.message.Message:
    (path,) = installed.glob("*.dist-info/METADATA")
    return email.message_from_bytes(path.read_bytes())


def test_wheel_holds_the_three_packages_and_nothing_beside_them(installed: Path) -> None:
    assert {path.name for path in installed.iterdir() if path.suffix != ".dist-info"} == set(PACKAGES)
    for package in PACKAGES:
        assert (installed / package / "__init__.py").exists()
        assert (installed / package / "py.typed").exists()
    assert (installed / "motor_classifiers/model_files/pretrained/paper-motor.safetensors").exists()
    assert (installed / "motor_env/examples/startup_capture.csv").exists()  # for `motor-env examples`
    (entry_points,) = installed.glob("*.dist-info/entry_points.txt")
    scripts = entry_points.read_text().splitlines()
    for command, module in zip(("motor-env", "motor-datasets"), PACKAGES, strict=False):
        assert f"{command} = {module}.cli:main" in scripts
    assert "motor-classifiers = motor_classifiers.cli.main:main" in scripts


def test_description_for_the_package_index_has_no_link_into_the_repository(
    metadata: email.message.Message,
) -> None:
    description = str(metadata.get_payload())
    assert "Is this DC motor failing" in description
    assert re.findall(r"\]\((?!https?:)[^)]*\)", description) == []


def test_packages_import_from_the_wheel_beside_hugging_face_datasets(installed: Path, tmp_path: Path) -> None:
    answer = json.loads(run_python(BESIDE_HUGGING_FACE, *PACKAGES, cwd=tmp_path, path=str(installed)))
    assert [Path(file).parent for file in answer["files"]] == [installed / package for package in PACKAGES]
    assert answer["rows"] == {"label": [0, 1]}
    assert answer["is_theirs"]


def test_folders_around_the_packages_are_no_packages(tmp_path: Path) -> None:
    """Our folder `datasets` hides theirs from nobody who works in the root of the repository."""
    for folder in ("datasets", "classifiers", "tests"):
        assert not (ROOT / folder / "__init__.py").exists()
    code = "import os, sys; os.chdir(sys.argv[1]); import datasets; print(hasattr(datasets, 'load_dataset'))"
    assert run_python(code, str(ROOT), cwd=tmp_path, path=str(ROOT)).strip() == "True"


def test_core_asks_for_no_learning_library(metadata: email.message.Message) -> None:
    requirements: list[str] = metadata.get_all("Requires-Dist", [])
    core = [requirement.lower() for requirement in requirements if "extra ==" not in requirement]
    assert core
    assert not [requirement for requirement in core if requirement.startswith(("torch", "scikit-learn"))]


def test_importing_motor_env_is_light(tmp_path: Path) -> None:
    imported = set(run_python("import sys, motor_env; print(*sys.modules)", cwd=tmp_path).split())
    heavy = {"torch", "sklearn", "pandas", "pyarrow", "numba", "matplotlib", "pydantic", "cyclopts"}
    assert imported & heavy == set()


def test_pins_name_no_host_and_no_local_build() -> None:
    for file in (ROOT / "constraints.txt", ROOT / "benchmarks" / "constraints.txt"):
        lines = file.read_text().splitlines()
        assert [line for line in lines if "==" not in line or set("+/@") & set(line)] == []


@pytest.mark.parametrize(("library", "package", "name", "extra", "loaded"), EXTRAS)
def test_missing_extra_is_named(
    monkeypatch: pytest.MonkeyPatch, library: str, package: str, name: str, extra: str, loaded: str
) -> None:
    module = importlib.import_module(package)
    for each in (library, f"{package}.{loaded}", "motor_datasets.folder"):
        monkeypatch.delitem(sys.modules, each, raising=False)
    monkeypatch.delitem(vars(module), name, raising=False)
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(InputError, match=rf"^this needs {library}, .* pip install 'motor-env\[{extra}\]'$"):
        getattr(module, name)


def test_missing_torch_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    recipe = load_recipe("bench")
    starts = generate_arrays(recipe, 1, range(2))
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(InputError, match="pip install"):
        to_torch(starts)
    with pytest.raises(InputError, match="pip install"):
        to_torch_iterable(recipe, 1)


def test_examples_are_copied_and_nothing_is_overwritten(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "motor.toml").write_text("mine")
    assert cli.main(["examples", str(tmp_path)]) == 0
    written = capsys.readouterr().out.split()
    assert str(tmp_path / "startup_capture.csv") in written
    assert (tmp_path / "motor.toml").read_text() == "mine"
    assert {Path(each).suffix for each in written} == {".py", ".csv"}
