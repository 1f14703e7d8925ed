"""Update a fleet's motor by a motor's own healthy records: `motor-env commission --motor fleet.toml`.

The fleet is the prior of where the motor lies and of how far its records scatter. Each record adds what it tells
(Gelman et al. 2013, ch. 5): after ten the healthy values are the motor's own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from motor_env.common.errors import InputError
from motor_env.diagnosis.commission import intervals
from motor_env.diagnosis.diagnose import diagnose
from motor_env.diagnosis.fleet.initial_fit import Reading
from motor_env.diagnosis.fleet.learning import at_centre
from motor_env.diagnosis.fleet.population import floor_covariance
from motor_env.diagnosis.verdict.healthy_spread import PRIOR_WEIGHT
from motor_env.diagnosis.verdict.hypotheses import Fitted
from motor_env.diagnosis.verdict.judgement import Verdict
from motor_env.motor.data_sheet import Motor
from motor_env.motor.healthy import Fleet, Healthy
from motor_env.motor.parameters import FloatArray


def update_unit(
    files: Sequence[str | Path], fleet_motor: Motor, name: str, *, reading: Reading | None = None
) -> Motor:
    """Learn the healthy motor from its records and its fleet.

    Args:
        files: healthy records of this motor.
        fleet_motor: motor that was learned from a fleet, or by this function before.
        name: of the motor.
        reading: how the files are read.

    Raises:
        InputError: the motor was not learned from a fleet, or a record cannot be used.
    """
    healthy = fleet_motor.healthy
    if healthy is None or healthy.fleet is None:
        raise InputError("--motor must be a motor file that `motor-env commission --fleet` has written")
    fits = [fit for path in files for fit in _fits(Path(path), fleet_motor, reading or Reading())]
    learned = combine_with_records(
        healthy,
        np.array([fit.log_values for fit in fits]),
        np.array([fit.log_covariance for fit in fits]),
    )
    return replace(fleet_motor, name=name, healthy=learned)


def unit_quantities(motor: Motor) -> dict[str, dict[str, Any]]:
    """List value, interval (95 %) and unit of each quantity.

    Args:
        motor: that `update_unit` has given.
    """
    healthy = motor.healthy
    assert healthy is not None  # noqa: S101  # it was learned
    assert healthy.fleet is not None  # noqa: S101
    return intervals(healthy, np.maximum(healthy.log_covariance - healthy.fleet.log_within, 0.0), 0.05)


def combine_with_records(healthy: Healthy, logs: FloatArray, errors: FloatArray) -> Healthy:
    """Combine a fleet's motor with records.

    Args:
        healthy: what the fleet teaches.
        logs: logarithms of the quantities of each record, shape (n, p).
        errors: their covariance by the fit, shape (n, p, p).
    """
    assert healthy.fleet is not None  # noqa: S101  # the callers have seen to it
    within = _within_covariance(logs, errors, healthy.fleet)
    between = floor_covariance(
        healthy.log_covariance - healthy.fleet.log_within, 1e-6 * healthy.log_covariance
    )
    prior, information = np.linalg.inv(between), np.linalg.inv(within + errors)
    left = np.linalg.inv(prior + information.sum(axis=0))
    centre = left @ (prior @ np.log(healthy.values) + np.einsum("npq,nq->p", information, logs))
    return replace(
        healthy,
        pieces=len(logs),
        degrees_of_freedom=healthy.degrees_of_freedom + len(logs),
        values=np.exp(centre),
        log_covariance=left + within,
        windows=None if healthy.windows is None else at_centre(healthy.windows, centre),
        fleet=replace(healthy.fleet, log_within=within),
    )


def _fits(path: Path, fleet_motor: Motor, reading: Reading) -> list[Fitted]:
    """Fit a record's pieces.

    Raises:
        InputError: it has none, or they tell other quantities than the fleet's records.
    """
    diagnosis = diagnose(path, fleet_motor, **reading.options)
    fits = [
        piece.fit
        for piece in diagnosis.pieces
        if piece.fit is not None and piece.verdict is not Verdict.UNUSABLE
    ]
    if not fits:
        raise InputError(f"{path}: a healthy record cannot be used: {diagnosis.reasons[0]}")
    names = fleet_motor.healthy.quantities if fleet_motor.healthy is not None else ()
    if any(fit.quantity_names != names for fit in fits):
        raise InputError(f"{path}: its columns are not those of the sisters, which tell {', '.join(names)}")
    return fits


def _within_covariance(logs: FloatArray, errors: FloatArray, fleet: Fleet) -> FloatArray:
    """Estimate the scatter from record to record; own records count by their number."""
    off = logs - logs.mean(axis=0)
    scatter = off.T @ off - max(len(logs) - 1, 0) * errors.mean(axis=0)
    spread = (scatter + PRIOR_WEIGHT * fleet.log_within) / (len(logs) - 1 + PRIOR_WEIGHT)
    return floor_covariance(spread, fleet.log_within / PRIOR_WEIGHT)
