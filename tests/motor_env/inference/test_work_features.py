"""What a record of a motor at work tells: against the truth, and against the sampled posterior."""

import numpy as np

from motor_env.inference.field_posterior import sampled_probabilities
from motor_env.inference.work_features import work_feature_names, work_features, work_probabilities
from motor_env.simulation.drawing import draw, measure_draw
from motor_env.simulation.named_recipes import named_recipe

OPERATION = named_recipe("operation")
DRAWN = draw(OPERATION, 5, np.arange(150))
CASES = measure_draw(DRAWN, OPERATION, 5).astype(np.float64)


def test_the_severity_of_a_winding_and_the_fit() -> None:
    features = work_features(OPERATION, CASES)
    names = work_feature_names(OPERATION)
    assert features.shape == (150, len(names))
    assert np.isfinite(features).all()
    # In units of a range from 0 to 50 %; the temperature takes part of it.
    winding = 0.5 * features[:, names.index("winding_contact")]
    truth = np.asarray(next(f.severity for f in DRAWN.scenario.faults if f.kind == "winding_contact"))
    assert np.quantile(np.abs(winding - truth), 0.9) < 0.05
    assert np.median(np.expm1(features[:, -1])) < 1.2


def test_the_linear_posterior_is_near_the_sampled_one_of_which_two_runs_agree() -> None:
    linear = work_probabilities(OPERATION, CASES)
    np.testing.assert_allclose(linear.sum(axis=1), 1.0)
    assert (linear.argmax(axis=1) == DRAWN.class_index).mean() > 0.65
    runs = np.array(
        [
            [sampled_probabilities(OPERATION, case, np.random.default_rng(seed))[0] for case in CASES[:6]]
            for seed in (1, 2)
        ]
    )
    assert np.abs(runs[0] - runs[1]).mean() < 0.03
    assert np.abs(linear[:6] - runs[0]).mean() < 0.1
