"""The ONNX graph against torch, from raw transients to severities."""

import json
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from motor_classifiers import PosteriorNetwork, load_model, make_method, save_model
from motor_classifiers.cli.main import main
from motor_classifiers.model_files.onnx_export import INPUT, OUTPUTS, Deployed
from motor_classifiers.model_files.persistence import PRETRAINED
from motor_datasets import generate_arrays
from motor_env import Timing, load_recipe

SHORT = load_recipe("bench-full", timing=Timing(1_000.0, 0.02))


@pytest.fixture(scope="module")
def graph(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("onnx") / "paper.onnx"
    assert main(["export", "-o", str(path)]) == 0
    return path


def test_the_graph_agrees_with_torch_for_any_number_of_starts(graph: Path) -> None:
    onnx.checker.check_model(onnx.load(graph), full_check=True)
    session = onnxruntime.InferenceSession(str(graph))
    model, recipe, _ = load_model(PRETRAINED)
    assert isinstance(model, PosteriorNetwork)
    deployed = Deployed(model)
    for n_cases in (1, 7, 300):
        X = generate_arrays(recipe, 3, n_cases).X
        found = dict(zip(OUTPUTS, session.run(list(OUTPUTS), {INPUT: X}), strict=True))
        with torch.inference_mode():
            for value, expected in zip(found.values(), deployed(torch.from_numpy(X)), strict=True):
                np.testing.assert_allclose(value, expected.numpy(), rtol=0.0, atol=1e-5)
        # And what the estimator itself says, in double precision.
        np.testing.assert_allclose(found["probabilities"], model.predict_proba(X), rtol=0.0, atol=1e-5)
        for column, prior in enumerate(model.severity_priors_):
            told = model.predict_severity(X, str(prior.kind))
            for name, expected_severity in zip(OUTPUTS[1:], (told.mean, told.low, told.high), strict=True):
                np.testing.assert_allclose(found[name][:, column], expected_severity, rtol=0.0, atol=1e-5)


def test_the_graph_says_what_its_columns_are(graph: Path) -> None:
    words = {entry.key: json.loads(entry.value) for entry in onnx.load(graph).metadata_props}
    model, recipe, _ = load_model(PRETRAINED)
    assert words["classes"] == model.classes_.tolist()
    assert words["kinds"] == ["bearing", "winding_contact", "winding_short"]
    assert words["recipe"]["name"] == recipe.name
    assert list(graph.parent.iterdir()) == [graph]


@pytest.mark.long
def test_a_network_that_looks_at_the_noise(tmp_path: Path) -> None:
    """Its graph has one more coordinate, and a kind whose range is not 30 %."""
    model = PosteriorNetwork(SHORT, steps=20, batch_size=64, n_components=6, random_state=0).fit_stream()
    save_model(model, SHORT, "posterior-network", tmp_path / "model")
    assert main(["export", str(tmp_path / "model"), "-o", str(tmp_path / "graph.onnx")]) == 0
    X = generate_arrays(SHORT, 3, 50).X
    session = onnxruntime.InferenceSession(str(tmp_path / "graph.onnx"))
    probabilities, severity, *_ = session.run(None, {INPUT: X})
    np.testing.assert_allclose(probabilities, model.predict_proba(X), rtol=0.0, atol=1e-5)
    np.testing.assert_allclose(severity[:, 3], model.predict_severity(X, "noise").mean, rtol=0.0, atol=1e-5)


def test_what_cannot_be_exported_is_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recipe = load_recipe("bench", timing=Timing(1_000.0, 0.02))
    train = generate_arrays(recipe, 1, 100)
    model = make_method("residual-qda", recipe, 0).fit(train.X, train.class_name)
    save_model(model, recipe, "residual-qda", tmp_path / "qda.model")
    (tmp_path / "there.onnx").touch()
    capsys.readouterr()  # that something was compiled
    for arguments, words in (
        (["qda.model", "-o", "qda.onnx"], "only a posterior-network becomes an ONNX graph"),
        (["none.model", "-o", "none.onnx"], "no such file"),
        (["-o", "there.onnx"], "exists already"),
    ):
        absolute = [str(tmp_path / a) if a.endswith(("model", "onnx")) else a for a in arguments]
        assert main(["export", *absolute]) == 2
        error = capsys.readouterr().err
        assert words in error
        assert len(error.strip().splitlines()) == 1
    assert {path.name for path in tmp_path.iterdir()} == {"qda.model", "there.onnx"}
