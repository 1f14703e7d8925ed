"""Numbers of the compiled step of Monitor and Probe, from their options."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are

from motor_env.envs import layout
from motor_env.envs.episode_sampling import SENSOR_ERRORS, make_prior, motor_table
from motor_env.envs.layout import TaskNumbers
from motor_env.envs.options import Drive, MonitorOptions, Start
from motor_env.filters.kalman import KalmanFilter, gain_and_covariance
from motor_env.motor.faults import HEALTHY, Fault, FaultKind, apply_fault
from motor_env.motor.model import DiscreteModel, Input, State, discretize, steady_state
from motor_env.motor.parameters import Channel, FloatArray, require
from motor_env.simulation.recipes import Recipe

INNOVATION_BOUND = 10.0
EVIDENCE_SCALE, EVIDENCE_BOUND = 0.1, 10.0  # up to a log-likelihood ratio of 100
FAST_MEMORY_S = 1e-3
SLOW_MEMORY_S = 10e-3


class Setup(NamedTuple):
    """A task as the compiled step, the policies and the scores read it.

    Attributes:
        options: of the task.
        kinds: verdicts that can be declared, in the order of the actions.
        belief: the filter of the healthy motor.
        numbers: of the compiled step.
        rest: current and speed at which the healthy motor rests; the kernel counts from there.
        view: scale, bound and offset of every feature, shape (3, n_features).
        chosen: indices of the observed features.
        observed: their names.
        offsets_v: voltage offset of each discrete action.
        declarations: number of the verdict that each action declares, 0 for none.
        labels: label kind of every class of the recipe.
        right_declarations: number of the right verdict of every class, 0 for healthy.
    """

    options: MonitorOptions
    kinds: tuple[str, ...]
    belief: KalmanFilter
    numbers: TaskNumbers
    rest: FloatArray
    view: FloatArray
    chosen: NDArray[np.int64]
    observed: tuple[str, ...]
    offsets_v: FloatArray
    declarations: NDArray[np.int64]
    labels: tuple[str, ...]
    right_declarations: NDArray[np.int64]


class LinearBelief(NamedTuple):
    """Model of a filter with more states than current and speed, by the names of `KalmanFilter`."""

    model: DiscreteModel
    observation: FloatArray
    process_covariance: FloatArray
    measurement_covariance: FloatArray


def converged_gain(belief: KalmanFilter | LinearBelief) -> tuple[FloatArray, FloatArray]:
    """Steady-state gain and innovation covariance of the filter, by its Riccati equation."""
    solution = solve_discrete_are(
        belief.model.transition.T,
        belief.observation.T,
        belief.process_covariance,
        belief.measurement_covariance,
    )
    predicted = np.asarray(solution, dtype=np.float64)
    gain, innovation_covariance, _ = gain_and_covariance(
        predicted, belief.observation, belief.measurement_covariance
    )
    return gain, innovation_covariance


def make_setup(options: MonitorOptions) -> Setup:
    """Derive the setup from the options.

    Raises:
        ValueError: the recipe has no fault, or failed sensors, or a feature cannot be observed with its sensor.
    """
    recipe = options.task
    for kind in recipe.kinds:
        channel, _, failure = kind.partition("_")
        require(
            not kind.is_sensor or (channel in recipe.sensor.channels and failure in SENSOR_ERRORS),
            f"recipe {recipe.name} has {kind}, which an environment does not simulate; of the recipe's sensor it knows "
            + ", ".join(f"{c}_{failure}" for c in recipe.sensor.channels for failure in SENSOR_ERRORS),
        )
    kinds = tuple(dict.fromkeys(kind.component for kind in recipe.kinds))
    require(bool(kinds), f"recipe {recipe.name} must have a class with a fault, got healthy only")
    rest = steady_state(recipe.motor, float(recipe.supply.voltage_v), options.load_n_m)
    require(
        rest[State.SPEED] * float(recipe.supply.voltage_v) > 0.0,
        f"motor of recipe {recipe.name} must turn with its supply of {recipe.supply.voltage_v:g} V, but a load of "
        f"{options.load_n_m:.3g} N m would drive it backwards",
    )
    belief = KalmanFilter.from_parameters(
        recipe.motor,
        recipe.sensor,
        options.dt_s,
        initial_state=rest if options.start is Start.RUNNING else np.zeros(2),
    )
    features = (*layout.FEATURES, *(f"evidence_{kind}" for kind in bank_kinds(recipe)))
    unmeasured = [f"{kind}_{c}" for c in Channel if c not in recipe.sensor.channels for kind in _MEASURED]
    names = [name for name in features if name not in unmeasured]
    for name in options.observe:
        require(name in names, f"observe must name features among {', '.join(names)}, got {name!r}")
    usual = [name for name in names if options.moves_voltage or not name.startswith("evidence")]
    view, observed = _view(options, rest, features), options.observe or tuple(usual)
    chosen = [features.index(name) for name in observed]
    offsets: tuple[float, ...] = options.offsets_v
    labels = tuple(c.label_kind for c in recipe.classes)
    right = [0 if label == HEALTHY else 1 + kinds.index(FaultKind(label).component) for label in labels]
    return Setup(
        options=options,
        kinds=kinds,
        belief=belief,
        numbers=_numbers(
            options,
            belief,
            rest,
            np.vstack([layout.FIELD_OF_FEATURE[: len(features)], view])[:, chosen].T,
            right,
        ),
        rest=rest,
        view=view,
        chosen=np.array(chosen, dtype=np.int64),
        observed=observed,
        offsets_v=np.array([*offsets, *(0.0 for _ in kinds)]),
        declarations=np.array([0] * len(offsets) + [1 + m for m in range(len(kinds))]),
        labels=labels,
        right_declarations=np.array(right),
    )


def _numbers(
    options: MonitorOptions, belief: KalmanFilter, rest: FloatArray, view: FloatArray, right: list[int]
) -> TaskNumbers:
    bank, constants = make_bank(options, belief.model, rest), _constants(options, belief, rest)
    evidence = np.arange(layout.EVIDENCE, layout.EVIDENCE + layout.MAX_BANK)
    bank[~np.isin(evidence, view[:, layout.FIELD])] = 0.0  # what nobody sees need not run
    constants[layout.FULL] = options.moves_voltage or options.drive is Drive.SPEED_LOOP or bank.any()
    prior, classes = make_prior(options, belief, rest, right, len(view))
    motors = np.zeros((len(classes), options.n_levels + 1, layout.ROW_LENGTH))
    numbers = TaskNumbers(constants, bank, view, motors, prior, classes)
    return numbers._replace(motors=motor_table(numbers))


def _constants(options: MonitorOptions, belief: KalmanFilter, rest: FloatArray) -> FloatArray:
    channels = [(Channel.CURRENT, Channel.SPEED).index(channel) for channel in options.task.sensor.channels]
    gain, covariance = converged_gain(belief)
    full_gain, whitening = np.zeros((2, 2)), np.zeros((2, 2))
    full_gain[:, channels] = gain
    whitening[np.ix_(channels, channels)] = np.linalg.inv(np.linalg.cholesky(covariance))
    require(
        channels == sorted(channels),
        "channels of an environment's sensor must be current, then speed, got speed first",
    )
    fast, slow = math.exp(-options.dt_s / FAST_MEMORY_S), math.exp(-options.dt_s / SLOW_MEMORY_S)
    loop_p, loop_i = _loop_gains(options) if options.drive is Drive.SPEED_LOOP else (0.0, 0.0)
    filters = [  # the first fields, up to c1
        *transition_row(belief.model),
        *belief.model.gain[:, Input.VOLTAGE],
        *full_gain.ravel(),
        *(whitening[0, 0], whitening[1, 0], whitening[1, 1]),
        *(float(channel in channels) for channel in State),
    ]
    numbers = layout.Constants(
        **dict(zip(layout.Constants._fields, filters, strict=False)),
        memory_fast=fast,
        memory_slow=slow,
        into_fast=math.sqrt(1.0 - fast**2),
        into_slow=math.sqrt(1.0 - slow**2),
        into_excess=math.sqrt((1.0 - slow**2) / (2.0 * len(channels))),
        n_channels=len(channels),
        horizon=options.n_samples,
        delay_cost=options.delay_cost_per_s * options.dt_s,
        correct=options.correct_reward,
        silent=options.silent_reward,
        false_alarm=options.false_alarm_cost,
        wrong_kind=options.wrong_kind_cost,
        miss=options.miss_cost,
        rest_voltage=float(options.task.supply.voltage_v),
        rest_current=float(rest[State.CURRENT]),
        rest_speed=float(rest[State.SPEED]),
        probe_cost=options.probe_cost_per_v2_s * options.dt_s,
        energy_cost=options.energy_cost_per_j * options.dt_s,
        growth=round(options.growth_s / options.dt_s),
        n_levels=options.n_levels,
        zero=0.0,
        half=0.5,
        one=1.0,
        full=0.0,  # set once it is known
        loop_p=loop_p,
        loop_i=loop_i,
        confirm=options.confirm_steps,
        failing=any(kind.is_sensor for kind in options.task.kinds),
    )
    return np.array(numbers, dtype=np.float64)


def _loop_gains(options: MonitorOptions) -> tuple[float, float]:
    """Gains of the speed loop: its zero cancels the motor's slow pole."""
    supply, slow_s = options.task.supply.voltage_v, options.task.motor.mechanical_time_constant_s
    no_load = steady_state(options.task.motor, float(supply), 0.0)[State.SPEED]
    gain = float(supply) / no_load / options.loop_time_s
    return gain * float(slow_s), gain * options.dt_s


def transition_row(model: DiscreteModel) -> FloatArray:
    """A, with A - I in the row of the speed, shape (..., 4)."""
    row: FloatArray = model.transition.reshape(*model.transition.shape[:-2], 4) - [0.0, 0.0, 0.0, 1.0]
    return row


def _drift(options: MonitorOptions, model: DiscreteModel, rest: FloatArray) -> FloatArray:
    """Movement in one sample from the rest point: A rest + B (V, load) - rest, shape (2,)."""
    voltage = float(options.task.supply.voltage_v)
    away: FloatArray = (
        model.transition @ rest
        + model.gain[:, Input.VOLTAGE] * voltage
        + model.gain[:, Input.LOAD_TORQUE] * options.load_n_m
        - rest
    )
    return away


def bank_kinds(recipe: Recipe) -> tuple[FaultKind, ...]:
    """Kinds of the recipe with a filter in the bank: the first `MAX_BANK` of those that change the motor."""
    return tuple(kind for kind in recipe.kinds if kind.motor_powers)[: layout.MAX_BANK]


def make_bank(options: MonitorOptions, belief: DiscreteModel, rest: FloatArray) -> FloatArray:
    """Models of the bank of filters: each kind that changes the motor, at its smallest severity."""
    recipe = options.task
    rows = np.zeros((layout.MAX_BANK, layout.MODEL_LENGTH))
    for row, kind in zip(rows, bank_kinds(recipe), strict=False):
        smallest = min(c.severity or c.largest_severity for c in recipe.classes if c.kind == kind)
        model = discretize(apply_fault(recipe.motor, Fault(kind, smallest)), options.dt_s)
        row[:] = np.concatenate(
            [
                transition_row(model),
                (model.transition - belief.transition).ravel(),
                (model.gain - belief.gain)[:, Input.VOLTAGE],
                _drift(options, model, rest),
            ]
        )
    return rows


def _view(options: MonitorOptions, rest: FloatArray, features: tuple[str, ...]) -> FloatArray:
    """Scale, bound and offset of every feature."""
    recipe = options.task
    voltage = float(recipe.supply.voltage_v)
    require(voltage != 0.0, "voltage_v of the recipe's supply must not be 0")
    current = abs(voltage) / float(recipe.motor.resistance_ohm)
    speed = abs(voltage) / float(recipe.motor.back_emf_constant_v_s_per_rad)
    white = 1.0 / math.sqrt(options.samples_per_step)
    by_name: dict[str, tuple[float, float]] = {
        "voltage": (1.0 / abs(voltage), 3.0),
        "time": (1.0 / options.n_samples, 1.0),
        "excess": (1.0, INNOVATION_BOUND),
        **{name: (EVIDENCE_SCALE, EVIDENCE_BOUND) for name in features if name.startswith("evidence")},
    }
    for channel, unit in (("current", current), ("speed", speed)):
        by_name[f"measured_{channel}"] = by_name[f"estimated_{channel}"] = (1.0 / unit, 3.0)
        by_name[f"innovation_{channel}"] = (white, INNOVATION_BOUND)
        by_name[f"fast_{channel}"] = by_name[f"slow_{channel}"] = (1.0, INNOVATION_BOUND)
    offsets = {"current": float(rest[0]), "speed": float(rest[1]), "voltage": voltage}
    offset = [offsets[name.split("_")[-1]] if name in _FROM_REST else 0.0 for name in features]
    return np.vstack([np.array([by_name[name] for name in features]).T, offset])


_FROM_REST = ("measured_current", "measured_speed", "estimated_current", "estimated_speed", "voltage")
_MEASURED = ("measured", "innovation", "fast", "slow")
