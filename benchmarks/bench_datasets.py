"""Making labelled transients: against scipy's simulators, NumPy's generator and pyarrow's writer. One thread each.

The linear motor: `bench` recipe, 1000 samples, one channel, float32 with noise; the peers scipy.signal.dlsim (without
noise, one case at a time) and NumPy's SFC64 that draws the noise alone. The nonlinear one: `field` recipe, against
solve_ivp at its default tolerance. To disk: `generate_dataset` against pyarrow writing the same ready tables.
"""

import math
import shutil
import tempfile
from dataclasses import fields
from pathlib import Path

import numpy as np
import pyarrow as pa
from run import Result, best_rate
from scipy.integrate import solve_ivp
from scipy.signal import dlsim

from motor_datasets import generate_arrays, generate_dataset, parquet
from motor_datasets.layout import make_plan
from motor_env.motor.faults import apply_faults
from motor_env.motor.model import discretize
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.drawing import draw, measure_draw
from motor_env.simulation.named_recipes import RECIPES

N_CASES = 1024
N_CASES_TO_DISK = 20_000
SEED = 1


def _dlsim_cases(count: int) -> list[FloatArray]:
    recipe = RECIPES["bench"]
    drawn = draw(recipe, SEED, np.arange(count))
    model = discretize(apply_faults(drawn.scenario.parameters, drawn.scenario.faults), recipe.timing.dt_s)
    answers = []
    for n in range(count):
        system = (
            model.transition[n],
            model.gain[n][:, :1],
            np.array([[1.0, 0.0]]),
            np.zeros((1, 1)),
            model.dt_s,
        )
        level = np.broadcast_to(drawn.scenario.supply.voltage_v, (count,))[n]
        answers.append(dlsim(system, np.full(recipe.timing.n_samples + 1, level))[1][1:, 0])
    return answers


def _solve_ivp_case(case: int) -> FloatArray:
    """The field recipe's motor as one would write it for scipy: plain floats, equations of simulation.nonlinear."""
    recipe = RECIPES["field"]
    drawn = draw(recipe, SEED, [case])
    p = apply_faults(drawn.scenario.parameters, drawn.scenario.faults).motor(0)
    assert drawn.effects is not None
    e = {f.name: float(np.ravel(getattr(drawn.effects, f.name))[0]) for f in fields(drawn.effects)}
    r_hot = float(p.resistance_ohm) * (1.0 + 0.00393 * e["temperature_rise_k"])
    magnet = 1.0 - 0.001 * e["temperature_rise_k"]
    k_b, k_t = p.back_emf_constant_v_s_per_rad * magnet, p.torque_constant_n_m_per_a * magnet
    inductance, inertia, viscous = p.inductance_h, p.inertia_kg_m2, p.viscous_friction_n_m_s_per_rad
    level = float(np.ravel(drawn.scenario.supply.voltage_v)[0])
    ramp, ripple, omega = e["ramp_s"], e["ripple_v"], 2.0 * math.pi * e["ripple_hz"]
    brush, source = e["brush_drop_v"], e["supply_resistance_ohm"]
    dry, stribeck = e["coulomb_friction_n_m"] + e["load_torque_n_m"], e["stribeck_friction_n_m"]
    w_s, bearing, q = e["stribeck_speed_rad_s"], e["bearing_ripple_n_m"], e["bearing_per_turn"]
    commutation, n = e["commutation_ripple"], e["commutation_per_turn"]
    capacity, leak = e["heat_capacity_j_per_k"], 1.0 / e["thermal_resistance_k_per_w"]

    def rhs(t: float, x: FloatArray) -> tuple[float, float, float, float]:
        i, w, angle, heat = x.tolist()
        resistance = r_hot * (1.0 + 0.00393 * heat)
        r = min(t / ramp, 1.0) if ramp > 0.0 else 1.0
        supply = (level + ripple * math.cos(omega * t)) * r * r * (3.0 - 2.0 * r)
        drop = (resistance + source) * i + k_b * w + brush * i / math.sqrt(i * i + 4e-4)
        sign = w / math.sqrt(w * w + 1.0)
        friction = dry + stribeck / (1.0 + (w / w_s) ** 2) + bearing * math.cos(q * angle)
        torque = k_t * (1.0 + commutation * math.cos(n * angle)) * i - viscous * w - friction * sign
        return (
            (supply - drop) / inductance,
            torque / inertia,
            w,
            (i * i * resistance - heat * leak) / capacity,
        )

    times = recipe.timing.time_s
    times = times[times > 0.0] - e["delay_s"]
    answer: FloatArray = solve_ivp(rhs, (0.0, times[-1]), np.zeros(4), t_eval=times).y[0]
    return answer


def linear() -> list[Result]:
    """Samples a second, drawn, simulated and with noise, in memory."""
    recipe = RECIPES["bench"]
    shape = (N_CASES, 1, recipe.timing.n_samples)
    out = np.empty(shape, dtype=np.float32)
    cases = np.arange(N_CASES)
    generator = np.random.Generator(np.random.SFC64(SEED))
    noiseless = np.stack(_dlsim_cases(4))
    ours_noisy = measure_draw(draw(recipe, SEED, cases[:4]), recipe, SEED)[:, 0]
    assert np.abs(ours_noisy - noiseless).max() < 7.0 * recipe.sensor.current_noise_a
    ours = best_rate(lambda: measure_draw(draw(recipe, SEED, cases), recipe, SEED, out), out.size)
    peer = best_rate(lambda: _dlsim_cases(4), 4 * shape[-1], rounds=3)
    noise = best_rate(lambda: generator.standard_normal(shape, dtype=np.float32), out.size)
    name = f"linear motor with tolerances and noise, {N_CASES} x {shape[-1]} samples"
    return [
        Result(name, ours, peer, "scipy.signal.dlsim, no noise", bar=1000.0),
        Result(name, ours, noise, "NumPy SFC64 float32, noise alone", bar=2.0),
    ]


def nonlinear() -> list[Result]:
    """Samples a second of the field recipe; the peer simulates without noise and sensor."""
    recipe = RECIPES["field"]
    cases = np.arange(256)
    samples = recipe.timing.n_samples
    out = np.empty((len(cases), 1, samples), dtype=np.float32)
    ours = best_rate(lambda: measure_draw(draw(recipe, SEED, cases), recipe, SEED, out), out.size)
    driven = recipe.timing.n_after
    quiet = measure_draw(draw(recipe, SEED, [0]), recipe, SEED)[0, 0, -driven:]
    assert np.abs(quiet - _solve_ivp_case(0)).max() < 0.1
    peer = best_rate(lambda: _solve_ivp_case(0), samples, rounds=3)
    return [
        Result(
            "field recipe, 256 x 1200 samples", ours, peer, "scipy solve_ivp, default tolerance", bar=200.0
        )
    ]


def _to_disk(folder: Path) -> None:
    generate_dataset(RECIPES["bench"], N_CASES_TO_DISK, SEED, folder)
    shutil.rmtree(folder)


def _write_ready(tables: list[pa.Table], folder: Path) -> None:
    folder.mkdir()
    for n, table in enumerate(tables):
        parquet.write_table(table, folder / f"{n}.parquet")
    shutil.rmtree(folder)


def to_disk() -> list[Result]:
    """Cases a second: made and written, against ready tables written by pyarrow with the same settings."""
    recipe = RECIPES["bench"]
    plan = make_plan(recipe, N_CASES_TO_DISK, SEED)
    tables = [
        parquet.to_table(generate_arrays(recipe, SEED, file.case_id(recipe, SEED))) for file in plan.files
    ]
    ours = peer = 0.0
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(5):  # in turns: a disk is not equally quick all the time
            ours = max(ours, best_rate(lambda: _to_disk(Path(folder) / "ours"), N_CASES_TO_DISK, rounds=2))
            peer = max(
                peer,
                best_rate(lambda: _write_ready(tables, Path(folder) / "peer"), N_CASES_TO_DISK, rounds=2),
            )
    return [Result("bench recipe to disk", ours, peer, "pyarrow, ready arrays", bar=0.6)]


def run() -> list[Result]:
    """All of them."""
    return [*linear(), *nonlinear(), *to_disk()]
