"""A method of one's own: its row beside all others, and its score on a frozen task.

`python examples/own_method.py out/own` writes all of it below that folder, in less than a minute.
"""

import subprocess
import sys
from pathlib import Path

from sklearn.decomposition import PCA
from sklearn.neural_network import MLPClassifier
from sklearn.pipeline import Pipeline, make_pipeline
from sklearn.preprocessing import StandardScaler

from motor_classifiers import load_task, score_answers
from motor_env import Recipe


def small_network(recipe: Recipe, seed: int) -> Pipeline:
    """Twelve principal components, and a perceptron of 24."""
    return make_pipeline(
        PCA(12, random_state=seed),  # its solver is a randomised one for tables of this size
        StandardScaler(),
        MLPClassifier((24,), alpha=1.0, max_iter=1000, random_state=seed),
    )


if __name__ == "__main__":
    out = Path(sys.argv[1])
    benchmark = [sys.executable, "-m", "motor_classifiers", "benchmark", "--methods", "residual-qda"]
    own = [f"--with={__file__}:small_network", f"--out={out / 'benchmark'}", "--n-test=500"]
    subprocess.run([*benchmark, *own], check=True)  # noqa: S603  # prints the row

    task = load_task("bench")
    train, X = task.train(), task.test().X
    model = small_network(task.recipe, 0).fit(train.X[:, 0], train.class_name)
    answers = model.predict_proba(X[:, 0])[:, [list(model.classes_).index(name) for name in task.columns]]
    scored = score_answers(task, answers)
    print(f"{scored['value']:.2f} % wrong, {scored['above_limit']:.2f} points more than the best possible")
