"""The posterior over the classes of a recipe, from a fit of each class that comes into question.

The fit of all severities (`work_fit`) says which classes those are, and where each one's coordinates lie. There each
class is simulated exactly and made linear, until another step promises little. Its evidence is then the integral of a
normal density over the box of the recipe's priors, by separation of variables (Genz 1992).
"""

from __future__ import annotations

import numpy as np
from box_mass import log_box_masses
from first_guess import StartGrid, begun_fit, bounded, start_grid
from numpy.typing import NDArray
from scipy.special import logsumexp, softmax

from motor_env.inference.class_model import ClassModel
from motor_env.inference.work_features import AT_ONCE, WorkFit, most_probable, read_of
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.recipes import FACTORS, FaultClass, Recipe

_HOPELESS = 3.5  # log ratio to the best class beyond which the fit's word counts
_DRAWS = 128
_ENOUGH = 100.0  # gain of a class's objective that is left to the linear motor
_DAMPING = 0.3  # little: the fit has done the searching
_INSIDE = 0.02  # distance from the box at which the motor is made linear
_UNIFORM = 12.0  # precision of the normal that stands for a uniform prior while a mode is sought
_FLAT = 1e-3  # the same in the integral, whose box says the rest


def refined_probabilities(
    recipe: Recipe, cases: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Posterior of each class, and the effective number of draws behind it (Kish 1965), both (n_cases, n_classes).

    Classes that are out of the question keep the fit's probability, and have no draws. Where only one is left, all do.
    Below 8 effective draws the box cuts off all but a corner: do not believe a probability.

    Args:
        recipe: one with a table `field` or `duty`, and faults that change the motor.
        cases: shape (n_cases, n_channels, n_samples), of motors at work the applied voltage last.
        rng: of the draws, 128 for all cases alike.
    """
    shares = rng.random((len(ClassModel(recipe, recipe.classes[0]).names) + len(recipe.kinds), _DRAWS))
    grid = start_grid(recipe)
    parts = [
        _refined(recipe, cases[begin : begin + AT_ONCE], shares, grid)
        for begin in range(0, len(cases), AT_ONCE)
    ]
    probabilities, effective = (np.concatenate(part) for part in zip(*parts, strict=True))
    return probabilities, effective


def _refined(
    recipe: Recipe, cases: FloatArray, shares: FloatArray, grid: StartGrid | None
) -> tuple[FloatArray, FloatArray]:
    fitted = begun_fit(recipe, cases, grid)
    logs, effective = fitted.log_probability.copy(), np.zeros_like(fitted.log_probability)
    likely = logs > logs.max(axis=1, keepdims=True) - _HOPELESS
    likely &= likely.sum(axis=1, keepdims=True) > 1
    found = np.full_like(logs, -np.inf)
    for index, (fault_class, share) in enumerate(
        zip(recipe.classes, recipe.class_probabilities, strict=True)
    ):
        rows = np.flatnonzero(likely[:, index])
        if len(rows):
            evidence, effective[rows, index] = _evidence(
                recipe, fault_class, cases[rows], _begun(recipe, fault_class, fitted, index, rows), shares
            )
            found[rows, index] = evidence + np.log(share)
    some = likely.any(axis=1)
    # Both are known up to a constant of the case.
    told = np.where(likely, logs, -np.inf)
    offset = logsumexp(found[some], axis=1) - logsumexp(told[some], axis=1)
    logs[some] = np.where(likely[some], found[some], logs[some] + offset[:, None])
    probabilities: FloatArray = softmax(logs, axis=1)
    return probabilities, effective


def _begun(
    recipe: Recipe, fault_class: FaultClass, fitted: WorkFit, index: int, rows: NDArray[np.intp]
) -> FloatArray:
    """Coordinates of a class where the fit of all severities puts them, shape (n_rows, size)."""
    model, at = ClassModel(recipe, fault_class), fitted.simulated[rows]
    position = fitted.positions[index]
    n_others = at.shape[1] - len(position)
    low, high = (np.concatenate([end[:n_others], position]) for end in _inner(model))
    precision = np.asarray(np.linalg.inv(fitted.covariance[rows]), dtype=np.float64)
    force = np.einsum("nij,nj->ni", precision, fitted.values[rows] - at)
    others = bounded(at, precision, force, low, high)[:, :n_others]
    severities = np.full((len(rows), len(model.names) - n_others), 0.5)
    return np.hstack([others, severities])


def _inner(model: ClassModel) -> FloatArray:
    """Ends of the coordinates where a class is made linear, shape (2, size)."""
    uniform = np.arange(len(model.names)) >= len(FACTORS)
    return model.box + _INSIDE * np.array([uniform, -1.0 * uniform])


def _evidence(
    recipe: Recipe, fault_class: FaultClass, cases: FloatArray, begin: FloatArray, shares: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Log evidence of a class, and the effective draws behind it, both of shape (n_cases,)."""
    model = ClassModel(recipe, fault_class)
    size = len(model.names)
    uniform = np.arange(size) >= len(FACTORS)
    measured, voltage = read_of(recipe, cases)
    centre, _ = model.prior
    fit = most_probable(
        model,
        measured,
        voltage,
        begin=begin,
        centre=centre,
        precision=np.where(uniform, _UNIFORM, 1.0),
        box=_inner(model),
        enough=_ENOUGH,
        damping=_DAMPING,
    )
    precision = np.where(uniform, _FLAT, 1.0)
    away = fit.at - centre
    whole, force = fit.information + np.diag(precision), fit.pull - precision * away
    step = np.linalg.solve(whole, force[..., None])[..., 0]
    low, high = model.box
    masses = log_box_masses(fit.at + step, whole, low, high, shares[:size])
    weights = np.exp(masses - masses.max(axis=1, keepdims=True))
    at_peak = 0.5 * (
        (force * step).sum(axis=1) - np.square(fit.left).sum(axis=1) - np.square(away) @ precision
    )
    # The normal factors' prior has a constant that all classes share; that of the noise they do not.
    constant = 0.5 * uniform.sum() * np.log(2.0 * np.pi) - np.log(model.whole_noise).sum()
    volume = constant - 0.5 * np.linalg.slogdet(whole)[1]
    mass = logsumexp(masses, axis=1) - np.log(shares.shape[1])
    return at_peak + volume + mass, weights.sum(axis=1) ** 2 / np.square(weights).sum(axis=1)
