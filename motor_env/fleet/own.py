"""A motor between its sisters and its own healthy records: `motor-env commission --motor fleet.toml`.

The sisters are the prior of where the motor lies (mean and spread from motor to motor), and of how far its records
scatter. Each record of its own adds what it tells (Gelman et al. 2013, ch. 5): after the first the healthy values lie
where sisters and record agree, after ten they are the motor's own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from motor_env.diagnosis.commission import intervals
from motor_env.diagnosis.diagnose import diagnose
from motor_env.diagnosis.healthy_spread import PRIOR_WEIGHT
from motor_env.diagnosis.hypotheses import Fitted
from motor_env.diagnosis.verdict import Verdict
from motor_env.errors import InputError
from motor_env.fleet.first import Reading
from motor_env.fleet.learning import at_centre
from motor_env.fleet.population import at_least
from motor_env.motor.data_sheet import Motor
from motor_env.motor.healthy import Fleet, Healthy
from motor_env.motor.parameters import FloatArray


def learn_own(
    files: Sequence[str | Path], sisters: Motor, name: str, *, reading: Reading | None = None
) -> Motor:
    """The healthy motor that own records and sisters teach together.

    Args:
        files: healthy records of this motor.
        sisters: motor that was learned from a fleet, or by this function before.
        name: of the motor.
        reading: how the files are read.

    Raises:
        InputError: the motor was not learned from a fleet, or a record cannot be used.
    """
    healthy = sisters.healthy
    if healthy is None or healthy.fleet is None:
        raise InputError("--motor must be a motor file that `motor-env commission --fleet` has written")
    fits = [fit for path in files for fit in _fits(Path(path), sisters, reading or Reading())]
    learned = with_own(
        healthy,
        np.array([fit.log_values for fit in fits]),
        np.array([fit.log_covariance for fit in fits]),
    )
    return replace(sisters, name=name, healthy=learned)


def quantities_of(motor: Motor) -> dict[str, dict[str, Any]]:
    """What is known of a motor by its sisters and its own records: value, interval (95 %) and unit by quantity.

    Args:
        motor: that `learn_own` has given.
    """
    healthy = motor.healthy
    assert healthy is not None  # noqa: S101  # it was learned
    assert healthy.fleet is not None  # noqa: S101
    return intervals(healthy, np.maximum(healthy.log_covariance - healthy.fleet.log_within, 0.0), 0.05)


def with_own(healthy: Healthy, logs: FloatArray, errors: FloatArray) -> Healthy:
    """What sisters and own records teach together.

    Args:
        healthy: what the sisters teach.
        logs: logarithms of the quantities of each own record, shape (n, p).
        errors: their covariance by the fit, shape (n, p, p).
    """
    assert healthy.fleet is not None  # noqa: S101  # the callers have seen to it
    within = _of_records(logs, errors, healthy.fleet)
    between = at_least(healthy.log_covariance - healthy.fleet.log_within, 1e-6 * healthy.log_covariance)
    prior, told = np.linalg.inv(between), np.linalg.inv(within + errors)
    left = np.linalg.inv(prior + told.sum(axis=0))
    centre = left @ (prior @ np.log(healthy.values) + np.einsum("npq,nq->p", told, logs))
    return replace(
        healthy,
        pieces=len(logs),
        degrees_of_freedom=healthy.degrees_of_freedom + len(logs),
        values=np.exp(centre),
        log_covariance=left + within,
        windows=None if healthy.windows is None else at_centre(healthy.windows, centre),
        fleet=replace(healthy.fleet, log_within=within),
    )


def _fits(path: Path, sisters: Motor, reading: Reading) -> list[Fitted]:
    """The fits of a record's pieces.

    Raises:
        InputError: it has none, or they tell other quantities than the sisters' records.
    """
    found = diagnose(path, sisters, **reading.options)
    fits = [one.fit for one in found.pieces if one.fit is not None and one.verdict is not Verdict.UNUSABLE]
    if not fits:
        raise InputError(f"{path}: a healthy record cannot be used: {found.reasons[0]}")
    names = sisters.healthy.quantities if sisters.healthy is not None else ()
    if any(fit.quantity_names != names for fit in fits):
        raise InputError(f"{path}: its columns are not those of the sisters, which tell {', '.join(names)}")
    return fits


def _of_records(logs: FloatArray, errors: FloatArray, fleet: Fleet) -> FloatArray:
    """How far records of the motor scatter: as the fleet's, and as its own, which count by their number."""
    off = logs - logs.mean(axis=0)
    seen = off.T @ off - max(len(logs) - 1, 0) * errors.mean(axis=0)
    spread = (seen + PRIOR_WEIGHT * fleet.log_within) / (len(logs) - 1 + PRIOR_WEIGHT)
    return at_least(spread, fleet.log_within / PRIOR_WEIGHT)
