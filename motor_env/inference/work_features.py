"""Features of a motor at work: severities from a fit of each record.

Damped Gauss-Newton steps (Levenberg 1944; Marquardt 1963) fit the coordinates of `ClassModel`. A class's probability
follows from the distance of its severities (Mahalanobis 1936).
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

_MOST_STEPS = 16
_ARRIVED = 3.0  # gain of a step, in the objective, below which a fit ends
_FIRST_DAMPING = 1.0  # relative to the information
_LEAST_DAMPING = 0.1  # after a step that failed
_PACE = 0.01  # of differences, relative to a range or a standard deviation
_RANGE = 2.0  # of the severities, in largest ones
_BEGIN = 0.2  # within that range
_FLAT = 0.01  # precision of a severity, which has hardly a prior
_UNIFORM = 12.0  # of a uniform coordinate
_RAREST = -12.0  # smallest logarithm of a probability that a feature tells
AT_ONCE = 64
"""Cases that are fitted side by side, limited by memory."""


def _kinds(recipe: Recipe) -> tuple[FaultKind, ...]:
    return tuple(kind for kind in recipe.kinds if kind.motor_powers)


def _severities(recipe: Recipe) -> FloatArray:
    """Return smallest and largest severity of each class and kind, shape (2, n_classes, n_kinds)."""
    kinds = _kinds(recipe)
    table = np.zeros((2, len(recipe.classes), len(kinds)))
    for row, fault_class in enumerate(recipe.classes):
        for part in fault_class.parts:
            if part.kind in kinds:
                table[:, row, kinds.index(part.kind)] = part.severity, part.largest_severity
    return table


def all_faults(recipe: Recipe) -> FaultClass:
    """Return one class with all kinds of faults at once, each of unknown severity."""
    largest = _RANGE * _severities(recipe).mean(axis=0).max(axis=0)
    parts = [
        FaultClass(kind, 0.0, severity_to=float(top))
        for kind, top in zip(_kinds(recipe), largest, strict=True)
    ]
    return replace(parts[0], also=tuple(parts[1:]))


def class_positions(recipe: Recipe) -> tuple[FloatArray, FloatArray]:
    """Return severities of each class as coordinates, and widths of their ranges, both (n_classes, n_kinds)."""
    tops = np.array([part.largest_severity for part in all_faults(recipe).parts])
    # The severities stand last, the last part's first.
    low, high = (_severities(recipe) / tops)[..., ::-1]
    return 0.5 * (low + high), high - low


def work_feature_names(recipe: Recipe) -> tuple[str, ...]:
    """Return the names of the columns of `work_features`."""
    names = ClassModel(recipe, all_faults(recipe)).names
    stds = (f"log_std_{name}" for name in names[len(names) - len(_kinds(recipe)) :])
    return (*names, *stds, *(f"log_probability_{name}" for name in recipe.class_names), "log1p_chi2")


def work_features(recipe: Recipe, cases: FloatArray) -> FloatArray:
    """Compute most probable coordinates, errors of severities, log probabilities of classes, and the misfit.

    Args:
        recipe: with a table `duty` and faults that change the motor.
        cases: shape (n_cases, n_channels, n_samples), the applied voltage last.

    Returns:
        Shape (n_cases, n_features), columns as `work_feature_names`.
    """
    begins = range(0, len(cases), AT_ONCE)
    return np.concatenate([_features(recipe, cases[begin : begin + AT_ONCE]) for begin in begins])


def work_probabilities(recipe: Recipe, cases: FloatArray) -> FloatArray:
    """Estimate the posterior of each class, shape (n_cases, n_classes), linear around the fit.

    Arguments as `work_features`; probabilities below 6e-6 are equal.
    """
    names = work_feature_names(recipe)
    columns = [names.index(f"log_probability_{name}") for name in recipe.class_names]
    probabilities: FloatArray = softmax(work_features(recipe, cases)[:, columns], axis=1)
    return probabilities


class WorkFit(NamedTuple):
    """Fitted motors at work.

    Attributes:
        values: most probable coordinates, the severities last, shape (n_cases, size).
        simulated: point of linearisation, within the box, shape (n_cases, size).
        covariance: of `values`, shape (n_cases, size, size).
        chi2: mean square of the residual, shape (n_cases,).
        positions: severities of each class in the same coordinates, shape (n_classes, n_kinds).
        log_probability: of each class, linear around the fit, shape (n_cases, n_classes).
    """

    values: FloatArray
    simulated: FloatArray
    covariance: FloatArray
    chi2: FloatArray
    positions: FloatArray
    log_probability: FloatArray


def measured_and_voltage(recipe: Recipe, cases: FloatArray) -> tuple[FloatArray, FloatArray | None]:
    """Split cases into measurements, shape (n_cases, n_values), and voltage (None for starts)."""
    measured = cases[:, : len(recipe.sensor.channels)].reshape(len(cases), -1)
    return measured, None if recipe.duty is None else cases[:, -1]


def prior_of_all_faults(recipe: Recipe, model: ClassModel) -> tuple[FloatArray, FloatArray]:
    """Return means and precisions of the coordinates of `all_faults`, both (size,)."""
    kinds = slice(-len(_kinds(recipe)), None)
    centre = model.prior[0].copy()
    precision = np.where(np.arange(len(centre)) < len(FACTORS), 1.0, _UNIFORM)
    centre[kinds], precision[kinds] = _BEGIN, _FLAT
    return centre, precision


def work_fit(
    recipe: Recipe, cases: FloatArray, begin: FloatArray | None = None, enough: float = 0.0
) -> WorkFit:
    """Fit cases side by side.

    Args:
        recipe: with a table `duty`, or (starts) `field`.
        cases: shape (n_cases, n_channels, n_samples).
        begin: first coordinates, shape (n_cases, size); the middle of the prior by default.
        enough: see `most_probable`.
    """
    fault = all_faults(recipe)
    model = ClassModel(recipe, fault)
    centre, precision = prior_of_all_faults(recipe, model)
    measured, voltage = measured_and_voltage(recipe, cases)
    at, information, pull, left = most_probable(
        model,
        measured,
        voltage,
        begin=np.tile(centre, (len(cases), 1)) if begin is None else begin,
        centre=centre,
        precision=precision,
        box=model.box,
        enough=enough,
    )
    whole = information + np.diag(precision)
    found = at + np.linalg.solve(whole, (pull + precision * (centre - at))[..., None])[..., 0]
    covariance = np.asarray(np.linalg.inv(whole), dtype=np.float64)
    kinds = slice(-len(fault.parts), None)
    positions, _ = class_positions(recipe)
    away = found[:, None, kinds] - positions
    distance = np.einsum("nci,nij,ncj->nc", away, np.linalg.inv(covariance[:, kinds, kinds]), away)
    with np.errstate(divide="ignore"):  # a class that is never drawn
        logs = log_softmax(np.log(recipe.class_probabilities) - 0.5 * distance, axis=1)
    return WorkFit(found, at, covariance, np.square(left).mean(axis=1), positions, logs)


def _features(recipe: Recipe, cases: FloatArray) -> FloatArray:
    fitted = work_fit(recipe, cases)
    n_kinds = fitted.positions.shape[1]
    stds = np.sqrt(np.einsum("nii->ni", fitted.covariance)[:, -n_kinds:])
    logs = np.maximum(fitted.log_probability, _RAREST)
    return np.column_stack([fitted.values, np.log(stds), logs, np.log1p(fitted.chi2)])


class Fit(NamedTuple):
    """Motors at their most probable coordinates.

    Attributes:
        at: most probable simulated coordinates, shape (n, size).
        information: of the readings alone, linear there, shape (n, size, size).
        pull: slope of the log likelihood there, shape (n, size).
        left: residual in units of the noise, shape (n, n_values).
    """

    at: FloatArray
    information: FloatArray
    pull: FloatArray
    left: FloatArray


def most_probable(
    model: ClassModel,
    measured: FloatArray,
    voltage_v: FloatArray | None,
    *,
    begin: FloatArray,
    centre: FloatArray,
    precision: FloatArray,
    box: FloatArray,
    damping: float = _FIRST_DAMPING,
    enough: float = 0.0,
) -> Fit:
    """Find the most probable coordinates under an independent normal prior by damped Gauss-Newton steps.

    Args:
        model: readings as a function of the coordinates.
        measured: shape (n, n_values).
        voltage_v: of motors at work, shape (n, n_samples); None for starts.
        begin: first coordinates, shape (n, size).
        centre: means of the prior, shape (size,).
        precision: inverse variances of the prior, shape (size,).
        box: bounds of the coordinates, shape (2, size).
        damping: of the first step, relative to the information.
        enough: predicted gain of -2 log density at which a fit ends.
    """
    n, size = begin.shape
    noise = model.whole_noise
    beside = np.concatenate([np.zeros((1, size)), _PACE * np.eye(size)])
    at, information, pull = begin.copy(), np.zeros((n, size, size)), np.zeros((n, size))
    trial, best, dampings = begin.copy(), np.full(n, np.inf), np.full(n, 10.0 * damping)
    left = np.zeros_like(measured)
    going = np.arange(n)
    for _ in range(_MOST_STEPS):
        each = model
        if voltage_v is not None:
            each = replace(model, voltage_v=np.repeat(voltage_v[going], len(beside), axis=0))
        read = each.readings((trial[going, None] + beside).reshape(-1, size))
        read = read.reshape(len(going), len(beside), -1)
        error = (measured[going] - read[:, 0]) / noise
        objective = np.square(error).sum(axis=1) + np.square(centre - trial[going]) @ precision
        gain = best[going] - objective
        better = gain > 0.0
        dampings[going] = np.where(
            better, 0.1 * dampings[going], np.maximum(10.0 * dampings[going], _LEAST_DAMPING)
        )
        nearer = going[better]
        at[nearer], best[nearer], left[nearer] = trial[nearer], objective[better], error[better]
        slopes = (read[better, 1:] - read[better, :1]) / (_PACE * noise)
        information[nearer] = slopes @ slopes.swapaxes(1, 2)
        pull[nearer] = np.einsum("njk,nk->nj", slopes, error[better])
        whole = information[going] + np.diag(precision)
        force = pull[going] + precision * (centre - at[going])
        step = np.linalg.solve(whole, force[..., None])[..., 0]
        step = np.clip(at[going] + step, *box) - at[going]
        promised = 2.0 * (step * force).sum(axis=1) - np.einsum("ni,nij,nj->n", step, whole, step)
        damped = whole * (1.0 + dampings[going, None, None] * np.eye(size))
        trial[going] = np.clip(at[going] + np.linalg.solve(damped, force[..., None])[..., 0], *box)
        going = going[(np.abs(promised) > enough) & (~better | (gain > _ARRIVED))]
        if not len(going):
            break
    return Fit(at, information, pull, left)
