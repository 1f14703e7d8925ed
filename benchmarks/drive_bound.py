"""What no controller of the drive exceeds: the return of one that knows all and sets the speed of each period at will.

A winding grows whatever is done, so it has to be stopped before it fails. A bearing grows by power: beside tracking and
limping each period then pays a price for growth, the multiplier of Lagrange that makes the sum largest, and none of the
dynamics binds it. Both are told the fault, the load and the profile, and pay no heat. Neither can do better on these
episodes; the figure has their sampling error, and that of a table between whose points is interpolated (some 0.001).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.interpolate import RegularGridInterpolator

from motor_env.envs import DriveOptions, DriveVectorEnv
from motor_env.envs.drive.kernel import BEARING, WINDING
from motor_env.envs.drive.options import Control
from motor_env.motor.model import load_torque
from motor_env.motor.parameters import FloatArray

PRICES = np.concatenate([[0.0], np.geomspace(0.02, 60.0, 40)])  # of a unit of the logarithm of the severity
NEVER = 1e9


def cheapest(options: DriveOptions, growth_prices: FloatArray) -> RegularGridInterpolator:
    """Least cost of a period by price of growth per second, unknown load and speed asked for."""
    o, dt = options, options.period_s
    asked = np.linspace(o.lowest_speed_rad_s, o.top_speed_rad_s, 36)
    loads = o.load_std_n_m * np.linspace(-5.0, 5.0, 21)
    ratio = np.linspace(
        0.0, 1.1, 441
    )  # of the speed to what is asked; the scales of a limping motor are among them
    speeds = asked[:, None] * ratio
    full = (o.load_torque_n_m + o.fan_torque_n_m) * o.top_speed_rad_s
    torque = load_torque(o.load_torque_n_m, o.fan_n_m_s2, speeds) + loads[:, None, None]
    pace = 1.0 + o.stress_share * (np.maximum(torque * speeds, 0.0) / full - 1.0)  # (loads, asked, speeds)
    least = np.full(speeds.shape, np.inf)
    for scale in np.linspace(o.limp_share, 1.0, 21):
        error = o.tracking_cost_per_s * ((ratio - scale) * asked[:, None] / o.top_speed_rad_s) ** 2
        if o.tracking_limit_per_s > 0.0:
            error = error / (1.0 + error / o.tracking_limit_per_s)
        least = np.minimum(least, error + o.limp_cost_per_s * (1.0 - scale) / (1.0 - o.limp_share))
    costs = [(least + price * pace).min(axis=2) * dt for price in growth_prices]
    return RegularGridInterpolator((growth_prices, loads, asked), np.array(costs))


def bearing_costs(
    options: DriveOptions, growth: FloatArray, loads: FloatArray, asked: FloatArray
) -> FloatArray:
    """Least cost of each episode with a bad bearing; loads and speeds of each period, zero cost before the onset."""
    o, (count, steps) = options, loads.shape
    known = ~np.isnan(loads)
    table = cheapest(
        o, np.concatenate([[0.0], np.geomspace(0.005, 1.3 * PRICES[-1] * o.growth_per_s[1], 60)])
    )
    worst = np.log(o.failure_severity[0] / o.onset_severity[0])
    grown = np.linspace(0.0, worst, 400)
    worn = o.wear_cost * np.exp(grown - worst)
    left_s = o.period_s * (steps - np.arange(steps + 1))
    edge = 5.0 * o.load_std_n_m
    best = np.full((count, steps + 1), -np.inf)
    for price in PRICES:
        at = np.stack(
            np.broadcast_arrays(price * growth[:, None], np.clip(loads, -edge, edge), asked), axis=-1
        )
        spent = np.zeros((count, steps))
        spent[known] = table(at[known])
        so_far = np.concatenate([np.zeros((count, 1)), spent.cumsum(axis=1)], axis=1)
        best = np.maximum(best, so_far + (worn - price * grown).min())
    best = np.where(np.cumsum(known, axis=1)[:, -1:] > 0, best, 0.0)
    costs: FloatArray = (np.maximum(best, 0.0) + o.stop_cost_per_s * left_s).min(axis=1)
    return costs


def drive_bounds(options: DriveOptions, count: int, seed: int) -> FloatArray:
    """Return of each episode that no controller exceeds in the mean, shape (count,)."""
    o = options
    envs = DriveVectorEnv(
        count,
        replace(
            o,
            failure_severity=(NEVER, NEVER),
            burn_k=NEVER,
            control=Control.VOLTAGE_AND_DECISION,
            steps_per_decision=1,
        ),
    )
    envs.reset(seed=seed)
    kind, onset, growth = (envs.truth(name) for name in ("kind", "onset", "growth"))
    loads, asked = np.empty((2, count, o.n_steps))
    for k in range(o.n_steps):
        loads[:, k], asked[:, k] = envs.truth("load"), envs.truth("profile")
        envs.step(np.tile([0.0, -1.0], (count, 1)))
    costs = np.zeros(count)
    winding, bearing = kind == WINDING, kind == BEARING
    lasts = np.ceil(np.log(o.failure_severity[1] / o.onset_severity[1]) / (growth[winding] * o.period_s))
    fails = onset[winding] + lasts - 1.0  # in this step
    costs[winding] = o.stop_cost_per_s * o.period_s * np.maximum(o.n_steps - fails, 0.0)
    before = np.arange(o.n_steps) < onset[bearing, None]
    costs[bearing] = bearing_costs(
        o, growth[bearing], np.where(before, np.nan, loads[bearing]), asked[bearing]
    )
    return -costs


def drive_bound(options: DriveOptions) -> float:
    """Its mean over episodes that the reference scores play, too."""
    return float(np.mean([drive_bounds(options, 200, seed).mean() for seed in range(1, 11)]))
