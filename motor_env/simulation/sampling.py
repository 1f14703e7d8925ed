"""Cases drawn from a recipe, and their readings: case n depends on (recipe, seed, n) alone."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from motor_env.common.arrays import instance, whole
from motor_env.motor.faults import HEALTHY, Fault, FaultKind
from motor_env.motor.parameters import (
    QUANTITY_FIELDS,
    FloatArray,
    MotorParameters,
    SupplyParameters,
)
from motor_env.simulation.disturbances import N_UNIFORMS, PER_MOTOR
from motor_env.simulation.fast_path import measure
from motor_env.simulation.nonlinear import Driving, Effects
from motor_env.simulation.random_streams import Stream, normals, uniforms
from motor_env.simulation.recipes import FACTORS, FaultClass, Recipe
from motor_env.simulation.sensor import SensorChain
from motor_env.simulation.sensor_faults import SWAPPED
from motor_env.simulation.simulate import LARGEST_SEED, Scenario, case_numbers


class Draw(NamedTuple):
    """True properties of cases drawn from a recipe.

    Attributes:
        cases: case numbers, shape (n_cases,).
        class_index: index into `recipe.classes`, shape (n_cases,).
        factors: nuisance factors in the order of `FACTORS`, shape (n_cases, 5).
        scenario: input of the simulation.
        motor_id: motor of each case, shape (n_cases,).
        severity: of the class's first fault, 0 for healthy, shape (n_cases,).
        effects: departures from the textbook motor; None for none.
        chain: errors of the current sensor; None for none.
        driving: voltage and load of motors at work; None for starts.
    """

    cases: NDArray[np.int64]
    class_index: NDArray[np.int64]
    factors: FloatArray
    scenario: Scenario
    motor_id: NDArray[np.int64]
    severity: FloatArray
    effects: Effects | None = None
    chain: SensorChain | None = None
    driving: Driving | None = None


def draw(recipe: Recipe, seed: int, cases: ArrayLike) -> Draw:
    """Draw motors and faults of a recipe, for case numbers of shape (n_cases,)."""
    instance("recipe", recipe, Recipe)
    seed, numbers = whole("seed", seed, most=LARGEST_SEED), case_numbers(cases)
    motor_id = recipe.motor_id(numbers)
    class_index = _draw_classes(recipe, seed, numbers, motor_id)
    z = normals(seed, Stream.MOTOR, motor_id, len(FACTORS))
    supply = FACTORS.index("supply")
    z[:, supply] = normals(seed, Stream.SUPPLY, numbers, 1)[:, 0]
    factors = 1.0 + recipe.spread.std * z
    severities = _draw_severities(recipe, seed, class_index, motor_id)
    scenario = Scenario(
        parameters=apply_factors(recipe.motor, factors),
        faults=tuple(
            Fault(kind, severity, changes_s=_draw_changes(recipe, seed, kind, class_index, numbers))
            for kind, severity in severities.items()
        ),
        supply=SupplyParameters(recipe.supply.voltage_v * factors[:, supply]),
        sensor=recipe.sensor,
        timing=recipe.timing,
    )
    first = np.zeros(len(numbers))
    for kind, severity in severities.items():
        first += severity * np.array([c.kind == kind for c in recipe.classes])[class_index]
    drawn = Draw(numbers, class_index, factors, scenario, motor_id, first)
    if recipe.field is None:
        return drawn
    priors = _draw_priors(recipe, seed, numbers)
    effects, chain = surroundings(recipe, priors, severities)
    drawn = drawn._replace(effects=effects, chain=chain)
    if recipe.duty is None:
        return drawn
    share, is_loop = recipe.duty.profile(uniforms(seed, Stream.DUTY, numbers, N_UNIFORMS), recipe.timing)
    level = np.asarray(scenario.supply.voltage_v)
    return drawn._replace(driving=driven(recipe, priors, share * level[:, None], is_loop, level))


def _draw_classes(
    recipe: Recipe, seed: int, cases: NDArray[np.int64], motor_id: NDArray[np.int64]
) -> NDArray[np.int64]:
    cumulated = np.cumsum(recipe.class_probabilities)
    index = np.searchsorted(cumulated[:-1], uniforms(seed, Stream.CLASS, motor_id, 1)[:, 0], side="right")
    if recipe.healthy_starts:
        commissioning = cases % recipe.starts_per_motor < recipe.healthy_starts
        index = np.where(commissioning, recipe.class_names.index(HEALTHY), index)
    return index.astype(np.int64)


def _draw_severities(
    recipe: Recipe, seed: int, class_index: NDArray[np.int64], motor_id: NDArray[np.int64]
) -> dict[FaultKind, FloatArray]:
    """Return the severity of each fault kind, shape (n_cases,); continuous ones are drawn once a motor."""
    columns = recipe.severity_columns
    u = uniforms(seed, Stream.SEVERITY, motor_id, len(columns))
    severities: dict[FaultKind, FloatArray] = {}
    for kind in recipe.kinds:
        low, high = np.array(
            [
                next(((p.severity, p.largest_severity) for p in c.parts if p.kind == kind), (0.0, 0.0))
                for c in recipe.classes
            ]
        )[class_index].T
        severities[kind] = low + (high - low) * u[:, columns.index(kind)]
    return severities


def _draw_changes(
    recipe: Recipe,
    seed: int,
    kind: FaultKind,
    class_index: NDArray[np.int64],
    cases: NDArray[np.int64],
) -> FloatArray | None:
    """Return the times at which a kind ends and returns in turn, shape (n_cases, n_changes); None if it stays."""
    dt_s, count = recipe.timing.dt_s, recipe.timing.n_samples
    changes = np.full((len(cases), count), np.inf)
    for index, fault_class in enumerate(recipe.classes):
        for part in fault_class.parts:
            if part.kind == kind and part.recovery is not None:
                rows = class_index == index
                u = uniforms(seed, Stream.RECOVERY, cases[rows], count)
                changes[rows] = part.recovery.changes(u, dt_s)
    seen = changes < count
    if not seen.any():
        return None
    begin_s = float(recipe.timing.interval_start_s[0])
    return np.where(seen, begin_s + dt_s * changes, np.inf)[:, : seen.sum(axis=1).max()]


def _draw_priors(recipe: Recipe, seed: int, cases: NDArray[np.int64]) -> FloatArray:
    low, high = np.array(list(recipe.priors.values())).T
    by_motor = uniforms(seed, Stream.FIELD_MOTOR, recipe.motor_id(cases), len(low))
    by_start = uniforms(seed, Stream.FIELD_START, cases, len(low))
    is_motor = np.array([name in PER_MOTOR for name in recipe.priors])
    drawn: FloatArray = low + (high - low) * np.where(is_motor, by_motor, by_start)
    return drawn


def surroundings(
    recipe: Recipe, values: FloatArray, severities: dict[FaultKind, FloatArray]
) -> tuple[Effects, SensorChain]:
    """Return effects and sensor of cases in the field.

    `values` are of the recipe's priors, shape (n_cases, n_priors).
    """
    field = recipe.field
    if field is None:
        raise ValueError(f"recipe {recipe.name} must have a table field")
    v = dict(zip(recipe.priors, values.T, strict=True))
    bearing = np.zeros(len(values))
    for kind, severity in severities.items():
        if kind.verdict == FaultKind.BEARING.verdict:
            bearing = bearing + severity
    torque = _torque(recipe)
    effects = Effects(
        coulomb_friction_n_m=v["coulomb_ratio"] * torque * (1.0 + bearing),
        stribeck_friction_n_m=v["stribeck_ratio"] * torque,
        load_torque_n_m=v["load_ratio"] * torque,
        bearing_ripple_n_m=v["bearing_ripple_ratio"] * torque * bearing,
        ripple_hz=field.ripple_hz,
        delay_s=v["trigger_jitter"] * recipe.timing.dt_s,
        **{f.name: v[f.name] for f in fields(Effects) if f.name in v},
    )
    return effects, field.sensor_chain(v["sensor_gain"], v["sensor_offset_a"])


def _torque(recipe: Recipe) -> float:
    return float(recipe.motor.viscous_friction_n_m_s_per_rad * _no_load_speed(recipe))


def _no_load_speed(recipe: Recipe) -> float:
    return float(recipe.supply.voltage_v / recipe.motor.back_emf_constant_v_s_per_rad)


def driven(
    recipe: Recipe,
    values: FloatArray,
    voltage_v: FloatArray,
    is_loop: NDArray[np.bool_] | None = None,
    limit_v: FloatArray | None = None,
) -> Driving:
    """Return the voltage and load that drive motors at work.

    Args:
        recipe: with a table `duty`.
        values: of the recipe's priors, shape (n_cases, n_priors).
        voltage_v: applied voltage, or a speed loop's target back-EMF, shape (n_cases or 1, n_samples).
        is_loop: which cases have a speed loop; none by default.
        limit_v: largest voltage of each loop.
    """
    v, torque, zeros = dict(zip(recipe.priors, values.T, strict=True)), _torque(recipe), np.zeros(len(values))
    return Driving(
        voltage_v=np.ascontiguousarray(voltage_v),
        is_loop=zeros > 0.0 if is_loop is None else is_loop,
        resistance_ohm=float(recipe.motor.resistance_ohm),
        limit_v=zeros if limit_v is None else limit_v,
        load_rise_n_m=torque * (v["load_end_ratio"] - v["load_ratio"]),
        fan_n_m_s2=torque * v["fan_ratio"] / _no_load_speed(recipe) ** 2,
    )


def measure_draw(
    drawn: Draw, recipe: Recipe, seed: int, out: NDArray[np.float32] | None = None
) -> NDArray[np.float32]:
    """Return readings of drawn cases, float32, shape (n_cases, n_channels, n_samples).

    Where columns are swapped, the first channel is that of a healthy case of the same number under the next seed.
    """
    faults = drawn.scenario.faults
    out = measure(
        replace(drawn.scenario, faults=tuple(fault for fault in faults if fault.kind != SWAPPED)),
        seed,
        drawn.cases,
        effects=drawn.effects,
        chain=drawn.chain,
        nominal=recipe.motor,
        driving=drawn.driving,
        out=out,
    )
    swaps = [np.broadcast_to(fault.severity, drawn.cases.shape) for fault in faults if fault.kind == SWAPPED]
    rows = np.flatnonzero(swaps[0]) if swaps else drawn.cases[:0]
    if len(rows):
        others, following = replace(recipe, classes=(FaultClass(),)), (seed + 1) % 2**64
        out[rows, 0] = measure_draw(draw(others, following, drawn.cases[rows]), others, following)[:, 0]
    return out


def apply_factors(parameters: MotorParameters, factors: FloatArray) -> MotorParameters:
    """Return parameters times `factors` of shape (n, 5); the supply's column is not used."""
    by_name = dict(zip(FACTORS, np.moveaxis(factors, -1, 0), strict=True))
    return parameters.scaled(
        **{field: factor for name, factor in by_name.items() for field in QUANTITY_FIELDS.get(name, ())}
    )
