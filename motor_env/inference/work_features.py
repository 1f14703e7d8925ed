"""Features of a motor at work: what a record tells of its severities when the motor is made linear around a fit.

Readings depend on the coordinates of `ClassModel`, the severity of each kind among them. Damped Gauss-Newton steps
(Levenberg 1944; Marquardt 1963), all cases side by side, give the most probable coordinates and their covariance. A
class is then a point among the severities, and its distance from the estimate (Mahalanobis 1936) a probability.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.special import log_softmax, softmax

from motor_env.inference.class_model import ClassModel
from motor_env.motor.faults import FaultKind
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.recipes import FACTORS, FaultClass, Recipe

_STEPS = 6
_FIRST_DAMPING = 1.0  # relative to the information
_LEAST_DAMPING = 0.1  # after a step that failed
_PACE = 0.01  # of differences, relative to a range or a standard deviation
_RANGE = 2.0  # of the severities, in largest ones
_BEGIN = 0.2  # within that range
_FLAT = 0.01  # precision of a severity, which has hardly a prior
_UNIFORM = 12.0  # of a uniform coordinate
_RAREST = -12.0  # smallest logarithm of a probability that a feature tells
_AT_ONCE = 64


def _kinds(recipe: Recipe) -> tuple[FaultKind, ...]:
    return tuple(kind for kind in recipe.kinds if kind.motor_powers)


def _severities(recipe: Recipe) -> FloatArray:
    """Severity of each class and kind, in the middle of its range, shape (n_classes, n_kinds)."""
    kinds = _kinds(recipe)
    table = np.zeros((len(recipe.classes), len(kinds)))
    for row, fault_class in zip(table, recipe.classes, strict=True):
        for part in fault_class.parts:
            if part.kind in kinds:
                row[kinds.index(part.kind)] = 0.5 * (part.severity + part.largest_severity)
    return table


def _any_fault(recipe: Recipe) -> FaultClass:
    """All kinds at once, each of a severity to be found."""
    largest = _RANGE * _severities(recipe).max(axis=0)
    parts = [
        FaultClass(kind, 0.0, severity_to=float(top))
        for kind, top in zip(_kinds(recipe), largest, strict=True)
    ]
    return replace(parts[0], also=tuple(parts[1:]))


def work_feature_names(recipe: Recipe) -> tuple[str, ...]:
    """Names of the columns of `work_features`."""
    names = ClassModel(recipe, _any_fault(recipe)).names
    stds = (f"log_std_{name}" for name in names[len(names) - len(_kinds(recipe)) :])
    return (*names, *stds, *(f"log_probability_{name}" for name in recipe.class_names), "log1p_chi2")


def work_features(recipe: Recipe, cases: FloatArray) -> FloatArray:
    """Most probable coordinates, errors of the severities, log probabilities of the classes, and what is left over.

    Args:
        recipe: one with a table `duty` and faults that change the motor.
        cases: shape (n_cases, n_channels, n_samples), the applied voltage last.

    Returns:
        Shape (n_cases, n_features), columns as `work_feature_names` says.
    """
    begins = range(0, len(cases), _AT_ONCE)
    return np.concatenate([_features(recipe, cases[begin : begin + _AT_ONCE]) for begin in begins])


def work_probabilities(recipe: Recipe, cases: FloatArray) -> FloatArray:
    """Posterior of each class, shape (n_cases, n_classes), of a motor that is linear around its fit: an estimate.

    As `work_features`; probabilities below 6e-6 are not told apart.
    """
    names = work_feature_names(recipe)
    columns = [names.index(f"log_probability_{name}") for name in recipe.class_names]
    probabilities: FloatArray = softmax(work_features(recipe, cases)[:, columns], axis=1)
    return probabilities


class WorkFit(NamedTuple):
    """Fitted motors at work.

    Attributes:
        values: most probable coordinates, the severities last, shape (n_cases, size).
        covariance: theirs, shape (n_cases, size, size).
        chi2: mean square of what is left over, shape (n_cases,).
        positions: severities of each class in the same coordinates, shape (n_classes, n_kinds).
        log_probability: of each class, of a motor linear around its fit, shape (n_cases, n_classes).
    """

    values: FloatArray
    covariance: FloatArray
    chi2: FloatArray
    positions: FloatArray
    log_probability: FloatArray


def work_fit(recipe: Recipe, cases: FloatArray) -> WorkFit:
    """Fit cases, all side by side; arguments as of `work_features`."""
    fault, n = _any_fault(recipe), len(cases)
    measured, voltage = cases[:, :-1].reshape(n, -1), cases[:, -1]
    found, covariance, chi2 = _fitted(recipe, fault, measured, voltage)
    kinds = slice(-len(fault.parts), None)
    tops = np.array([part.largest_severity for part in fault.parts])
    # The severities stand last, the last part's first.
    positions = (_severities(recipe) / tops)[:, ::-1]
    away = found[:, None, kinds] - positions
    distance = np.einsum("nci,nij,ncj->nc", away, np.linalg.inv(covariance[:, kinds, kinds]), away)
    with np.errstate(divide="ignore"):  # a class that is never drawn
        logs = log_softmax(np.log(recipe.class_probabilities) - 0.5 * distance, axis=1)
    return WorkFit(found, covariance, chi2, positions, logs)


def _features(recipe: Recipe, cases: FloatArray) -> FloatArray:
    fitted = work_fit(recipe, cases)
    n_kinds = fitted.positions.shape[1]
    stds = np.sqrt(np.einsum("nii->ni", fitted.covariance)[:, -n_kinds:])
    logs = np.maximum(fitted.log_probability, _RAREST)
    return np.column_stack([fitted.values, np.log(stds), logs, np.log1p(fitted.chi2)])


def _fitted(
    recipe: Recipe, fault: FaultClass, measured: FloatArray, voltage_v: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Coordinates (n, size), their covariance (n, size, size), and mean square of what is left over (n,)."""
    model, n = ClassModel(recipe, fault), len(measured)
    size, severities = len(model.names), slice(-len(fault.parts), None)
    precision = np.where(np.arange(size) < len(FACTORS), 1.0, _UNIFORM)
    centre = model.prior[0].copy()
    centre[severities], precision[severities] = _BEGIN, _FLAT
    noise = model.whole_noise
    beside = np.concatenate([np.zeros((1, size)), _PACE * np.eye(size)])
    each = replace(model, voltage_v=np.repeat(voltage_v, len(beside), axis=0))
    at = trial = np.tile(centre, (n, 1))
    damping, best = np.full(n, 10.0 * _FIRST_DAMPING), np.full(n, np.inf)
    left, slopes = np.zeros_like(measured), np.zeros((n, size, measured.shape[1]))
    for _ in range(_STEPS):
        read = each.readings((trial[:, None] + beside).reshape(-1, size)).reshape(n, len(beside), -1)
        error = (measured - read[:, 0]) / noise
        objective = np.square(error).sum(axis=1) + (precision * np.square(trial - centre)).sum(axis=1)
        better = objective < best
        damping = np.where(better, 0.1 * damping, np.maximum(10.0 * damping, _LEAST_DAMPING))
        at, best = np.where(better[:, None], trial, at), np.minimum(best, objective)
        left = np.where(better[:, None], error, left)
        change = (read[:, 1:] - read[:, :1]) / (_PACE * noise)
        slopes = np.where(better[:, None, None], change, slopes)
        information = slopes @ slopes.swapaxes(1, 2) + np.diag(precision)
        pull = np.einsum("njk,nk->nj", slopes, left) + precision * (centre - at)
        damped = information * (1.0 + damping[:, None, None] * np.eye(size))
        trial = np.clip(at + np.linalg.solve(damped, pull[..., None])[..., 0], *model.box)
    found = at + np.linalg.solve(information, pull[..., None])[..., 0]
    return found, np.linalg.inv(information), np.square(left).mean(axis=1)
