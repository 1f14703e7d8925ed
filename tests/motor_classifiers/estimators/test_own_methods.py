"""Methods of one's own: how they are found, fed, judged and saved, and what is said of those that cannot be."""

import json
import subprocess
import sys
from functools import partial
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest
from hostile import odd_places, refused
from sklearn.base import BaseEstimator
from sklearn.decomposition import PCA
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.linear_model import LogisticRegression, RidgeClassifier
from sklearn.naive_bayes import GaussianNB
from sklearn.neural_network import MLPClassifier
from sklearn.pipeline import FeatureUnion, make_pipeline
from sklearn.preprocessing import MinMaxScaler, RobustScaler, StandardScaler
from torch import nn

from motor_classifiers import ResidualProjection, TorchClassifier, load_model, save_model
from motor_classifiers.cli.main import main
from motor_classifiers.estimators import methods
from motor_classifiers.estimators.methods import find_method, model_input, model_probabilities

# Reaches in: no public name shows under which key answers are kept, or how a process is judged that breaks.
from motor_classifiers.model_files.persistence import check_saveable
from motor_classifiers.scoring.judging import answer_key, judge, judge_in_subprocess
from motor_classifiers.scoring.task import class_task
from motor_datasets import generate_arrays, generate_dataset
from motor_env import InputError, Timing, load_recipe

RECIPE = load_recipe("bench", timing=Timing(1_000.0, 0.1))
TRAIN = generate_arrays(RECIPE, 1, range(150))
EXAMPLE = Path(__file__).resolve().parents[3] / "examples" / "own_method.py"
SOURCE = '''
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.ensemble import ExtraTreesClassifier
from sklearn.neighbors import KNeighborsClassifier

def trees(recipe, seed):
    """Fifty random trees on raw samples."""
    return ExtraTreesClassifier(50, random_state=seed)

def linear(recipe, seed):
    return LinearDiscriminantAnalysis()

def neighbours(recipe, seed):
    return KNeighborsClassifier()

def broken(recipe, seed):
    return 1 / 0
'''


@pytest.fixture
def own(tmp_path: Path) -> Path:
    path = tmp_path / "own.py"
    path.write_text(SOURCE, encoding="utf-8")
    return path


def test_a_function_of_a_file_is_a_method_with_its_own_answers(own: Path) -> None:
    name, cell = f"{own}:trees", class_task(RECIPE, 150, 100)
    assert find_method(name).title == "Fifty random trees on raw samples."
    answer = judge(name, cell)
    assert answer.is_graded
    assert (answer.decided == cell.starts().class_index).mean() > 0.5
    before = answer_key(name, cell)
    own.write_text(SOURCE.replace("(50,", "(60,"), encoding="utf-8")
    assert answer_key(name, cell) != before  # an edited method is another one


def test_the_benchmark_takes_it_beside_others(own: Path, capsys: pytest.CaptureFixture[str]) -> None:
    added = ["--with", f"{own}:trees", "--with", f"{own}:broken"]
    plan = ["benchmark", "--methods", "rules", *added, "--dry-run"]
    assert main([*plan, "--json"]) == 0
    names = [unit["method"] for unit in json.loads(capsys.readouterr().out)]
    assert names == ["limit", "rules", f"{own}:trees", f"{own}:broken"]
    assert main([*plan, "--with", f"{own}:trees"]) == 2
    assert "methods must differ" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("missing.py:make", "missing.py: no such file; a method of your own is FILE.py:NAME"),
        ("{own}:nothing", "has no function 'nothing' of a recipe and a seed"),
        ("{bad}:make", r"cannot be run \(ModuleNotFoundError: No module named 'no_such_module'\)"),
        ("nobody", r"FILE.py:NAME or one of threshold, .*, stranger, got 'nobody'"),
    ],
)
def test_what_is_no_method_is_a_sentence(
    own: Path, name: str, sentence: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    point = EntryPoint("stranger", "sklearn.naive_bayes:GaussianNB", methods.GROUP)
    monkeypatch.setattr(methods, "entry_points", lambda group: [point])
    assert find_method("stranger").family == "own"
    bad = own.with_name("bad.py")
    bad.write_text("import no_such_module\n", encoding="utf-8")
    with pytest.raises(InputError, match=sentence):
        find_method(name.format(own=own, bad=bad))


def test_only_regular_files_of_methods_are_read(tmp_path: Path) -> None:
    for path in odd_places(tmp_path / "own.py"):
        if path.suffix == ".py":
            assert "is no regular file" in refused(partial(find_method, f"{path}:make"), path)


def test_a_method_that_fails_is_named_with_its_line(own: Path) -> None:
    with pytest.raises(InputError, match=r"ZeroDivisionError: division by zero \(.*own.py, line 17\)"):
        judge_in_subprocess(f"{own}:broken", class_task(RECIPE, 150, 100))


def _module(n_channels: int, n_samples: int, n_classes: int) -> nn.Module:
    assert (n_channels, n_samples, n_classes) == (1, 100, 5)
    return nn.Sequential(nn.Conv1d(1, 4, 9, stride=5), nn.GELU(), nn.Flatten(), nn.Linear(4 * 19, n_classes))


def test_a_torch_module_learns_the_same_from_the_same_seed() -> None:
    models = [TorchClassifier(RECIPE, module=_module, epochs=30, random_state=seed) for seed in (1, 1, 2)]
    first, again, other = (model.fit(TRAIN.X, TRAIN.class_name).predict_proba(TRAIN.X) for model in models)
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 1e-3
    assert models[0].score(TRAIN.X, TRAIN.class_name) > 0.5
    assert model_input(models[0], TRAIN.X).ndim == 3
    decides = make_pipeline(StandardScaler(), RidgeClassifier()).fit(TRAIN.X[:, 0], TRAIN.class_name)
    assert model_input(decides, TRAIN.X).shape == (150, 100)
    shares = model_probabilities(decides, TRAIN.X)
    np.testing.assert_array_equal(shares, decides.predict(TRAIN.X[:, 0])[:, None] == decides.classes_)


@pytest.mark.parametrize(
    "model",
    [
        make_pipeline(PCA(5, random_state=0), StandardScaler(), LogisticRegression()),
        make_pipeline(ResidualProjection(RECIPE, 6), MinMaxScaler(), GaussianNB()),
        make_pipeline(ResidualProjection(RECIPE, 6), RobustScaler(), GaussianNB()),
        LinearDiscriminantAnalysis(solver="lsqr", shrinkage="auto"),
        MLPClassifier((8,), max_iter=40, random_state=0),
        MLPClassifier((8,), solver="lbfgs", max_iter=2000, random_state=0),
    ],
    ids=["pipeline", "range", "quartiles", "alone", "perceptron", "perceptron of lbfgs"],
)
@pytest.mark.filterwarnings("ignore:Stochastic Optimizer")
def test_trusted_steps_are_saved_and_loaded(model: BaseEstimator, tmp_path: Path) -> None:
    model.fit(model_input(model, TRAIN.X), TRAIN.class_name)
    save_model(model, RECIPE, "own", tmp_path / "own.model")
    loaded, recipe, method = load_model(tmp_path / "own.model")
    assert (recipe, method) == (RECIPE, "own")
    np.testing.assert_array_equal(model_probabilities(loaded, TRAIN.X), model_probabilities(model, TRAIN.X))


def test_an_untrusted_step_is_refused_before_the_training(
    own: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data, model = tmp_path / "data", tmp_path / "own.model"
    generate_dataset(RECIPE, 200, 1, data)
    assert main(["train", str(data), "--method", f"{own}:neighbours", "--out", str(model)]) == 2
    error = capsys.readouterr().err
    assert "a model with a KNeighborsClassifier cannot be saved: a file may hold FeatureUnion," in error
    assert "motor-classifiers benchmark --with" in error
    assert not model.exists()
    assert main(["train", str(data), "--method", f"{own}:linear", "--out", str(model)]) == 0
    assert main(["evaluate", str(model), str(data)]) == 0
    assert main(["predict", str(data), "--split", "test", "--model", str(model)]) == 1
    with pytest.raises(ValueError, match="n_jobs=None"):
        check_saveable(FeatureUnion([("components", PCA(2))], n_jobs=2))


@pytest.mark.long
@pytest.mark.timeout(600)
def test_the_example_runs_from_the_method_to_the_score(tmp_path: Path) -> None:
    command = [sys.executable, str(EXAMPLE), str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=580)
    assert "own_method.py:small_network" in done.stdout
    assert "points more than the best possible" in done.stdout
