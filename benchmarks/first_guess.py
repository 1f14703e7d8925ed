"""Where the fit of a start begins: the best of a grid over its edge and the classes.

The supply's ramp and the trigger's delay bend the edge of the current, a large fault bends all of it, and no straight
line follows that. At each point of a grid of these, the motor is made linear once for a recipe. The point whose linear
motor explains a start best, and that motor's most probable coordinates within their box, are close enough for one more
step to arrive.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from motor_env.inference.class_model import ClassModel
from motor_env.inference.work_features import (
    WorkFit,
    any_fault,
    class_positions,
    prior_of_any,
    read_of,
    work_fit,
)
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.recipes import Recipe

_POINTS = {"ramp_s": 6, "trigger_jitter": 2}  # of the grid
_PACE = 0.01  # of differences, relative to a range or a standard deviation
_PASSES = 4
_NEAR = 5e3  # gain that is left to the fits of each class


def bounded(
    at: FloatArray, precision: FloatArray, force: FloatArray, low: FloatArray, high: FloatArray
) -> FloatArray:
    """Points in a box that are nearly, and often exactly, the most probable of normal distributions, shape (n, size).

    Coordinates that leave the box stay at its side for good, and the others are sought again, given those.

    Args:
        at: where the slopes are known, shape (n, size).
        precision: inverse covariances, shape (n, size, size).
        force: slopes of the log densities at `at`, shape (n, size).
        low: of the box, shape (size,).
        high: the same; where both are one, that is the coordinate.
    """
    move, fixed = np.zeros_like(at), np.zeros(at.shape, dtype=bool)
    for _ in range(_PASSES):
        free = ~fixed
        pull = force - np.einsum("nij,nj->ni", precision, np.where(fixed, move, 0.0))
        among = np.where(free[:, :, None] & free[:, None, :], precision, np.eye(at.shape[1]))
        found = np.linalg.solve(among, np.where(free, pull, 0.0)[..., None])[..., 0]
        move = np.where(free, found, move)
        beyond = free & ((at + move < low) | (at + move > high))
        if not beyond.any():
            break
        move = np.where(beyond, np.clip(at + move, low, high) - at, move)
        fixed |= beyond
    return np.clip(at + move, low, high)


class StartGrid:
    """A motor made linear at each point of a grid: ramp and trigger, where its recipe leaves them open, and classes.

    Args:
        model: readings as a function of the coordinates.
        centre: means of the normal prior, shape (size,); where the other coordinates are in the grid.
        precision: its inverse variances, shape (size,).
        severities: of each class, the last coordinates, shape (n_classes, n_kinds).
    """

    def __init__(
        self, model: ClassModel, *, centre: FloatArray, precision: FloatArray, severities: FloatArray
    ) -> None:
        size, noise = len(centre), model.whole_noise
        open_ones = [name for name in _POINTS if name in model.names]
        axes = [(np.arange(_POINTS[name]) + 0.5) / _POINTS[name] for name in open_ones]
        open_places = [model.names.index(name) for name in open_ones]
        rows = []
        for *edge, fault in product(*axes, severities):
            row = centre.copy()
            row[open_places], row[-len(fault) :] = edge, fault
            rows.append(row)
        at = np.array(rows)
        beside = np.concatenate([np.zeros((1, size)), _PACE * np.eye(size)])
        read = model.readings((at[:, None] + beside).reshape(-1, size)).reshape(len(at), size + 1, -1)
        self.at, self.read, self.noise, self.box = at, read[:, 0], noise, model.box
        self.slopes = (read[:, 1:] - read[:, :1]) / (_PACE * noise)
        self.precision = self.slopes @ self.slopes.swapaxes(1, 2) + np.diag(precision)
        self.of_prior = precision * (centre - at)
        self.prior_misfit = np.square(centre - at) @ precision

    def guess(self, measured: FloatArray) -> FloatArray:
        """Most probable coordinates of starts of shape (n, n_values), by the best linear motor, shape (n, size)."""
        best = np.full(len(measured), np.inf)
        chosen, force = np.zeros(len(measured), dtype=np.intp), np.zeros((len(measured), self.at.shape[1]))
        for index, (read, slopes, precision) in enumerate(
            zip(self.read, self.slopes, self.precision, strict=True)
        ):
            left = (measured - read) / self.noise
            pull = left @ slopes.T + self.of_prior[index]
            gain = (pull * np.linalg.solve(precision, pull.T).T).sum(axis=1)
            misfit = np.square(left).sum(axis=1) + self.prior_misfit[index] - gain
            better = misfit < best
            best[better], chosen[better], force[better] = misfit[better], index, pull[better]
        return bounded(self.at[chosen], self.precision[chosen], force, *self.box)


def start_grid(recipe: Recipe) -> StartGrid | None:
    """Where fits of a recipe's starts begin; None for motors at work, whose fits begin at the priors' centres."""
    if recipe.duty is not None:
        return None
    model = ClassModel(recipe, any_fault(recipe))
    positions, _ = class_positions(recipe)
    centre, precision = prior_of_any(recipe, model)
    return StartGrid(model, centre=centre, precision=precision, severities=positions)


def begun_fit(recipe: Recipe, cases: FloatArray, grid: StartGrid | None) -> WorkFit:
    """`work_fit`; a start begins near its goal, and is made linear again only where the guess was bad.

    Args:
        recipe: one with a table `field` or `duty`.
        cases: shape (n_cases, n_channels, n_samples), of motors at work the applied voltage last.
        grid: `start_grid` of the recipe.
    """
    if grid is None:
        return work_fit(recipe, cases)
    measured, _ = read_of(recipe, cases)
    return work_fit(recipe, cases, grid.guess(measured), _NEAR)
