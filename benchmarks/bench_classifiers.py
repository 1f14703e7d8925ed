"""Judging starts: ours against QUANT of aeon and against a general least-squares fit. One core, one run, in turns.

Setting: recipe `bench`, 10 kHz, 20 mA, 1000 samples, one batch. QUANT runs in aeon's own environment (`make peers`) on
the same starts and answers its rate when asked, so that both sides are measured in turns. The general fit is
`scipy.optimize.least_squares` on the five tolerances of one start, with their prior, and our own compiled simulation
inside. Ours is a fitted model's `predict_proba`: raw samples to probabilities.
"""

import subprocess
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from peers import command, environment, export_starts
from run import Result, best_rate
from scipy.optimize import least_squares

from motor_classifiers.estimators.methods import make_method
from motor_classifiers.estimators.networks.posterior_network import PosteriorNetwork
from motor_classifiers.scoring.task import class_task
from motor_datasets.arrays import Dataset
from motor_env.inference.fit import Prior, fit
from motor_env.inference.posterior import class_coordinates, recipe_observed
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.drawing import apply_factors
from motor_env.simulation.named_recipes import named_recipe
from motor_env.simulation.recipes import FACTORS
from motor_env.simulation.simulate import simulate_states

TASK = class_task(named_recipe("bench"), 2000, 1000)
ROUNDS = 4
FITTED = 10
"""Starts that the general fit is measured on."""

Judge = Callable[[], object]


def _judges(train: Dataset, test: Dataset) -> dict[str, Judge]:
    """Fitted methods of ours. The posterior network's speed does not depend on how long it has learned."""
    made = {
        name: make_method(name, TASK.recipe, 0) for name in ("residual-qda", "network", "physical-logistic")
    }
    made["posterior-network"] = PosteriorNetwork(TASK.recipe, steps=20, random_state=0)
    return {
        name: partial(method.fit(train.X, train.class_name).predict_proba, test.X)
        for name, method in made.items()
    }


def general_fit(measured: FloatArray) -> FloatArray:
    """Most probable tolerances of one start, in standard deviations, shape (5,): as one would write it for scipy."""
    recipe = TASK.recipe
    std = recipe.spread.std
    supply = FACTORS.index("supply")
    voltage = recipe.nominal_voltage_v

    def residual(z: FloatArray) -> FloatArray:
        factors = 1.0 + std * z
        motor = apply_factors(recipe.motor, factors)
        states = simulate_states(motor, voltage * factors[supply], recipe.timing.dt_s)
        off = (measured - states[:, 0]) / recipe.sensor.current_noise_a
        return np.concatenate([off, z])

    found: FloatArray = least_squares(residual, np.zeros(len(std))).x
    return found


def _check_fit(test: Dataset) -> None:
    """Both fits find the same tolerances: what is compared does the same work."""
    recipe = TASK.recipe
    healthy = np.flatnonzero(test.class_index == 0)[:3]
    coordinates = class_coordinates(recipe, recipe.classes[0])
    ours = fit(recipe_observed(recipe, test.X[healthy]), coordinates, Prior.from_std(np.ones(5))).values
    peer = np.stack([general_fit(test.X[case, 0].astype(np.float64)) for case in healthy])
    assert np.abs(ours - peer).max() < 0.01


def run() -> list[Result]:
    """Rates in starts a second."""
    train, test = TASK.train(), TASK.starts()
    judges = _judges(train, test)
    _check_fit(test)
    rates = dict.fromkeys([*judges, "quant", "fit"], 0.0)
    with tempfile.TemporaryDirectory() as folder:
        cases = Path(folder) / "cases.npz"
        export_starts(train, test, cases)
        with subprocess.Popen(
            command(cases, "--rate", "quant"),
            env=environment(),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        ) as peer:
            assert peer.stdin is not None
            assert peer.stdout is not None
            assert peer.stdout.readline() == "ready\n"
            fits = [test.X[n, 0].astype(np.float64) for n in range(FITTED)]
            for _ in range(ROUNDS):
                peer.stdin.write("go\n")
                peer.stdin.flush()
                rates["quant"] = max(rates["quant"], float(peer.stdout.readline()))
                for name, judge in judges.items():
                    rates[name] = max(rates[name], best_rate(judge, TASK.n_test, rounds=1))
                rate = best_rate(lambda: [general_fit(measured) for measured in fits], FITTED, rounds=1)
                rates["fit"] = max(rates["fit"], rate)
            peer.stdin.close()
    least = "scipy least_squares, a start at a time"
    return [
        Result(f"{name}, {TASK.n_test} starts", rates[name], rates[peer], title, 10.0)
        for peer, title in (("quant", "QUANT of aeon"), ("fit", least))
        for name in judges
    ]
